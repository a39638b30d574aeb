"""What an inertial sensor on the camera measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.core.checks import as_number, as_rigid, to_numpy
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import make_transform

ROTATION_TOLERANCE = 1e-3
"""By which the axes of a sensor may differ from a rotation, entry by entry."""


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """Rates of a gyroscope that is fixed to a camera.

    Attributes:
        stamps: (N,) seconds, increasing, on the clock of the frames.
        rates: (N, 3) rad/s about the axes of the sensor.
        R_cam_imu: (3, 3) rotation from the axes of the sensor to those of the camera.
        accelerations: (N, 3) m/s^2 along the axes of the sensor, with gravity; or None. They are
            kept and not used.

    Raises:
        InputError: the stamps do not increase, a value is not finite, a shape is wrong, or
            ``R_cam_imu`` is no rotation.

    >>> samples = ImuSamples(np.array([0.0, 0.01]), np.zeros((2, 3)))
    >>> len(samples), len(samples.between(0.005, 0.02))
    (2, 2)
    """

    stamps: np.ndarray
    rates: np.ndarray
    R_cam_imu: np.ndarray | None = None
    accelerations: np.ndarray | None = None

    def __post_init__(self) -> None:
        stamps = to_numpy(self.stamps, "ImuSamples.stamps")
        _set(self, "stamps", stamps, stamps.shape[:1])
        if self.stamps.ndim != 1 or not (np.diff(self.stamps) > 0).all():
            raise InputError(
                "ImuSamples.stamps: expected (N,) that rise, got others."
            )
        count = len(self.stamps)
        _set(self, "rates", self.rates, (count, 3))
        if self.accelerations is not None:
            _set(self, "accelerations", self.accelerations, (count, 3))
        R = np.eye(3) if self.R_cam_imu is None else self.R_cam_imu
        _set(self, "R_cam_imu", R, (3, 3))
        T = make_transform(np.asarray(self.R_cam_imu), np.zeros(3))
        as_rigid(T, "ImuSamples.R_cam_imu", ROTATION_TOLERANCE)

    def __len__(self) -> int:
        return len(self.stamps)

    def between(self, start: float, end: float) -> ImuSamples:
        """Return the samples that are in force between two times.

        Args:
            start: seconds; the last sample at or before it is among them.
            end: seconds.

        Returns:
            These samples.
        """
        first = int(np.searchsorted(self.stamps, as_number(start), "right")) - 1
        last = int(np.searchsorted(self.stamps, as_number(end), "left"))
        return self._part(slice(max(first, 0), last))

    def joined(self, later: ImuSamples) -> ImuSamples:
        """Return these samples and those that come after them.

        Args:
            later: of the same sensor; what is not after the last of these is left out.

        Returns:
            All of them, without accelerations.
        """
        if not len(self):
            return later
        new = later.stamps > self.stamps[-1]
        return ImuSamples(
            np.concatenate([self.stamps, later.stamps[new]]),
            np.concatenate([self.rates, later.rates[new]]),
            later.R_cam_imu,
        )

    def _part(self, chosen: slice) -> ImuSamples:
        accelerations = self.accelerations
        return ImuSamples(
            self.stamps[chosen],
            self.rates[chosen],
            self.R_cam_imu,
            None if accelerations is None else accelerations[chosen],
        )


def _set(
    samples: ImuSamples, name: str, value: object, shape: tuple[int, ...]
) -> None:
    """Set an attribute to finite numbers of a shape, as float64."""
    array = to_numpy(value, f"ImuSamples.{name}")
    is_number = array.dtype.kind in "fiu"
    if array.shape != shape or not is_number or not np.isfinite(array).all():
        raise InputError(
            f"ImuSamples.{name}: expected finite numbers of shape {shape}, got "
            f"{array.dtype} {array.shape}."
        )
    object.__setattr__(samples, name, array.astype(np.float64))
