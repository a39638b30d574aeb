"""Whether the depths of two frames belong to the same world.

The flow and the depth of the previous frame give the motion; depth that is noise, or of another
scale in the current frame, does not show there. It shows where the motion takes each point to a
pixel whose depth is known as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybridvo.refinement import kernels
from hybridvo.types import Frame

PIXELS = 4000
MIN_PIXELS = 100
"""Pixels that are asked, and the fewest that can tell."""
FOLLOWS = 0.5
"""Robust weight from which a pixel follows the motion."""
DOUBTFUL_SPREAD = 0.15
NO_SPREAD = 0.35
"""Spread from which an answer is degraded, and from which it is none. Two depths with independent
noise of s differ by 0.95 s, so these are 16 and 37 % of noise in every pixel; real sensors and
rendered depth with DIS flow measure 0.001 to 0.018, depth that is noise from 0.5 to 10 m 0.49 to
0.6, from 2 to 4 m 0.2."""
DOUBTFUL_RATIO = 1.15
"""Of the scales of the two depths: the translation is as long as the first one says."""


@dataclass(frozen=True)
class DepthAgreement:
    """Second depth over the depth of the first frame's points, moved.

    Args:
        ratio: its median; 1 where both frames have one scale.
        spread: median distance of its log from that of the median.
    """

    ratio: float
    spread: float

    @property
    def is_none(self) -> bool:
        """Whether the two depths have nothing to do with each other."""
        return self.spread > NO_SPREAD

    @property
    def doubt(self) -> str:
        """What is wrong between the two depths, in words; empty where nothing is."""
        if self.spread > DOUBTFUL_SPREAD:
            percent = 100 * np.expm1(self.spread)
            return f"along the motion the depths of the two frames differ by {percent:.0f} %"
        if abs(np.log(self.ratio)) > np.log(DOUBTFUL_RATIO):
            return (
                f"the current frame's depth is {self.ratio:.3g} times the previous one's, so the "
                f"length of the translation is as uncertain"
            )
        return ""


def depth_agreement(
    curr: Frame,
    samples: np.ndarray,
    robust: np.ndarray,
    pose: np.ndarray,
    origin: tuple[float, float],
) -> DepthAgreement | None:
    """Compare the depths of two frames along a motion.

    It asks the nearest pixel, whatever its neighbours are: in noise none agree.

    Args:
        curr: the current frame.
        samples: (rows, n) gathered pixels of the previous one, see
            :mod:`hybridvo.refinement.kernels`.
        robust: (n,) robust weights about the motion.
        pose: (3, 4) T_curr_prev.
        origin: (u, v) of the current image's coordinates in ``samples``.

    Returns:
        None where too few pixels of both frames have depth.
    """
    assert curr.depth is not None  # asked by the caller
    follow = np.flatnonzero((robust > FOLLOWS) & (samples[kernels.W] > 0))
    follow = follow[:: max(1, len(follow) // PIXELS)]
    x, y, z, u, v = (
        samples[row, follow].astype(np.float64)
        for row in (kernels.XN, kernels.YN, kernels.Z, kernels.MU, kernels.MV)
    )
    moved = z * (pose[2, 0] * x + pose[2, 1] * y + pose[2, 2]) + pose[2, 3]
    u, v = u + origin[0], v + origin[1]
    height, width = curr.depth.shape
    inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5) & (moved > 1e-6)
    rows, columns = np.rint(v[inside]).astype(np.intp), np.rint(u[inside]).astype(np.intp)
    seen = curr.depth[rows, columns].astype(np.float64)
    known = (seen > 1e-6) & (seen < 1e9)
    if curr.mask is not None:
        known &= curr.mask[rows, columns]
    if np.count_nonzero(known) < MIN_PIXELS:
        return None
    log_ratio = np.log(seen[known] / moved[inside][known])
    middle = float(np.median(log_ratio))
    return DepthAgreement(float(np.exp(middle)), float(np.median(np.abs(log_ratio - middle))))
