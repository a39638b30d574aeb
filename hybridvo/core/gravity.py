"""Which way is down, and the world that stands upright."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hybridvo.core.geometry import make_transform

# of the first camera's optical axis, as a fraction: below the sine of 15 degrees an
# error of the vertical turns the heading four times as far
MIN_HORIZONTAL = 0.26


@dataclass(frozen=True, eq=False)
class Gravity:
    """The direction of gravity, as an accelerometer on the camera shows it.

    Attributes:
        direction: (3,) unit vector that points down, in the world of ``T_world_cam``.
        covariance: (3, 3) of the direction, rad^2; zero along the direction itself.

    >>> level = Gravity(np.array([0.0, 1.0, 0.0]), np.diag([1e-4, 0.0, 1e-4]))
    >>> ahead = level.T_gravity_world[:3, :3] @ [0, 0, 1]  # a camera looks along z
    >>> ahead.tolist()
    [1.0, 0.0, 0.0]
    """

    direction: np.ndarray
    covariance: np.ndarray

    @property
    def std(self) -> float:
        """Standard deviation of the angle to the true direction, rad, of both axes together."""
        return float(np.sqrt(np.trace(self.covariance)))

    @property
    def T_gravity_world(self) -> np.ndarray:
        """(4, 4) from the world into one with the same origin whose z axis points up.

        Its x axis is the horizontal part of the world's z axis, along which the first camera
        looks: that camera has no yaw, and y is to its left. If the world's z axis is within 15
        degrees of the vertical, x is where the upper edge of the first image points if the
        camera looks down, and the lower edge if it looks up.
        """
        up = -self.direction
        ahead = _horizontal(np.array([0.0, 0.0, 1.0]), up)
        if np.linalg.norm(ahead) < MIN_HORIZONTAL:
            ahead = _horizontal(np.array([0.0, np.copysign(1.0, up[2]), 0.0]), up)
        x = ahead / np.linalg.norm(ahead)
        R_gravity_world = np.stack([x, np.cross(up, x), up])
        return make_transform(R_gravity_world, np.zeros(3))

    def summary(self) -> dict[str, Any]:
        """Return the direction and how sure it is, JSON-ready.

        Returns:
            ``direction``, ``sigma_deg`` (``std`` in degrees) and ``T_gravity_world``.
        """
        return {
            "direction": self.direction.tolist(),
            "sigma_deg": float(np.rad2deg(self.std)),
            "T_gravity_world": self.T_gravity_world.tolist(),
        }


def _horizontal(vector: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The part (3,) of a vector that is perpendicular to the vertical."""
    return vector - (vector @ up) * up
