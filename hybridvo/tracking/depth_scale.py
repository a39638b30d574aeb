"""One scale for depth that breathes: networks that predict depth change its scale per frame.

The tracker estimates each motion from the earlier frame's depth alone. The static pixels then give
the ratio of the new frame's depth to that of the points that they saw before, moved. This ratio
is divided out, and the motion is estimated once more from both depth maps. So all frames have one
scale: that of the first frame. The first frame's own
scale is no better than any other's, so the common scale is moved towards the mean of all frames, as
a Kalman filter of one number does. This also bounds the drift of a long chain of ratios.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    chain,
    invert,
    project,
    transform_points,
)
from hybridvo.core.results import RelativePose
from hybridvo.core.types import Frame
from hybridvo.core.unchecked import changed
from hybridvo.solver.calibration import FOLLOWING_WEIGHT, MIN_COMPARED_DEPTHS
from hybridvo.tracking.calibration import DEPTH_SCALE_DRIFT, DEPTH_SCALE_STD

COMPARED = 8000
"""About how many pixels are compared."""


@dataclass(frozen=True)
class ScaleFilter:
    """How well the common scale of the frames is known.

    Attributes:
        variance: of the log of the common scale over the network's mean scale.

    Example:
        >>> ScaleFilter().gain
        0.5
    """

    variance: float = DEPTH_SCALE_STD**2

    @property
    def gain(self) -> float:
        """Fraction of a new frame's log ratio by which the common scale follows it."""
        return self.variance / (self.variance + DEPTH_SCALE_STD**2)

    def observed(self) -> ScaleFilter:
        """Return the filter after one more frame, whose ratio may have erred a little."""
        left = (1 - self.gain) * self.variance
        return ScaleFilter(left + DEPTH_SCALE_DRIFT**2)


def measured_scale(prev: Frame, curr: Frame, motion: RelativePose) -> float | None:
    """Return by how much the current depth is too large for a motion, on static pixels.

    Args:
        prev: the frame that the motion starts from, with depth in the common scale.
        curr: the current frame, with depth as it was predicted.
        motion: from ``prev`` to ``curr``; its weights mark the static pixels.

    Returns:
        The median ratio; None where the motion failed, or too few pixels have both depths.
    """
    if not motion.usable or prev.depth is None or curr.depth is None:
        return None
    stride = max(1, math.isqrt(prev.depth.size // COMPARED))
    first = stride // 2
    used = prev.depth[first::stride, first::stride] > 0
    if motion.weights is not None:
        used &= motion.weights[first::stride, first::stride] > FOLLOWING_WEIGHT
    rows, columns = np.nonzero(used)
    index = np.stack([first + stride * rows, first + stride * columns], axis=1)
    moved = transform_points(
        motion.T_curr_prev, backproject(prev.depth, prev.camera, index)
    )
    places = project(moved, curr.camera).astype(np.float32)
    # interpolated: whole pixels would all err to the same side of a slope
    measured = cv2.remap(
        np.where(curr.depth > 0, curr.depth, np.float32(np.nan)),
        places[:, None, 0],
        places[:, None, 1],
        cv2.INTER_LINEAR,
        borderValue=np.nan,
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = measured[:, 0] / moved[:, 2]
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    if len(ratio) < MIN_COMPARED_DEPTHS:
        return None
    return float(np.median(ratio))


def divided(frame: Frame, scale: float) -> Frame:
    """Return a frame whose depth is divided by a scale, which ``depth_scale`` keeps.

    Example:
        >>> from hybridvo.core.types import Camera
        >>> frame = Frame(None, np.full((1, 2), 3.0), Camera(1.0, 1.0, 0.0, 0.0, height=1, width=2))
        >>> halved = divided(frame, 2.0)
        >>> float(halved.depth[0, 0]), halved.depth_scale
        (1.5, 2.0)
    """
    if frame.depth is None:
        return frame
    depth = frame.depth / np.float32(scale)
    return changed(frame, depth=depth, depth_scale=frame.depth_scale * scale)


def lengthened(T: np.ndarray, factor: float) -> np.ndarray:
    """Return a pose or motion (4, 4) whose translation is multiplied by a factor."""
    T = np.array(T)
    T[:3, 3] *= factor
    return T


def rescaled_about(
    T_world_frame: np.ndarray, T_world_cam: np.ndarray, factor: float
) -> np.ndarray:
    """Return the pose of a frame after the space around a camera grew by a factor.

    Args:
        T_world_frame: (4, 4) pose of the frame.
        T_world_cam: (4, 4) pose of the camera, which stays.
        factor: on all distances from the camera.
    """
    shift = T_world_frame[:3, 3] - T_world_cam[:3, 3]
    T = np.array(T_world_frame)
    T[:3, 3] = T_world_cam[:3, 3] + factor * shift
    return T


def common_scales(scales: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Return the log scale of the chain of ratios at each frame, by all frames.

    Each ratio errs a little to one side, and so the chain drifts. The mean of the frames
    around each one shows by how much: the filter of the tracker, run backwards as well
    (Rauch, Tung and Striebel 1965).

    Args:
        scales: (N,) by how much each frame's depth was too large for its time.
        changes: (N,) by how much lengths are longer from the next step on.

    Returns:
        (N,) log of the chain's scale over that of the network in the mean.
    """
    known = np.cumsum(np.log(changes))
    filters = [ScaleFilter()]
    for i in range(1, len(scales)):
        lost = is_lost(scales[i], changes[i])
        filters.append(ScaleFilter() if lost else filters[-1].observed())
    smoothed = np.array(known)
    for i in range(len(scales) - 2, -1, -1):
        # of a frame that was lost, none before knows the scale
        if is_lost(scales[i + 1], changes[i + 1]):
            continue
        # its variance holds the drift to the next frame already
        ahead = filters[i].variance
        gain = (ahead - DEPTH_SCALE_DRIFT**2) / ahead if i else 1.0
        smoothed[i] += gain * (smoothed[i + 1] - known[i])
    return smoothed


def is_lost(scale: float, change: float) -> bool:
    """Whether the scale of a frame could not be measured, so that it began a new chain."""
    return scale == 1.0 and change == 1.0


def in_one_scale(
    poses: np.ndarray,
    motions: np.ndarray,
    starts: list[int | None],
    factors: np.ndarray,
) -> np.ndarray:
    """Return a path whose every motion is brought to one scale.

    Args:
        poses: (N, 4, 4) T_world_cam as they were tracked.
        motions: (N, 4, 4) T_curr_prev of each step.
        starts: which of the poses each motion starts from; None: it starts nowhere.
        factors: (N,) by which each motion's translation is multiplied.

    Returns:
        (N, 4, 4) T_world_cam.
    """
    if np.all(factors == 1):
        return poses
    path = [poses[0]]
    for i in range(1, len(poses)):
        start = starts[i]
        if start is None:
            path.append(poses[i])
            continue
        T_prev_curr = lengthened(invert(motions[i]), factors[i])
        path.append(chain(path[start], invert(T_prev_curr)))
    return np.stack(path)


def scale_factors(scales: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Return by how much each motion (N,) is longer in the network's mean scale.

    Args:
        scales: (N,) ``Step.depth_scale``.
        changes: (N,) ``Step.scale_change``.
    """
    at_its_time = np.concatenate([[0.0], np.cumsum(np.log(changes))[:-1]])
    return np.asarray(np.exp(common_scales(scales, changes) - at_its_time))
