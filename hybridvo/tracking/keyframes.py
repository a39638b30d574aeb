"""Keyframes: earlier frames from which the motion to the current frame is estimated.

In one step of a slow camera an object that moves may differ from the static scene by less than the
noise, and its motion is taken for the camera's. Over some steps it has moved by pixels. So a
tracker estimates motions from the oldest frame that the current one still overlaps well, and errors
do not add up from frame to frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from hybridvo.core.geometry import (
    adjoint,
    backproject,
    invert,
    mean_flow,
    project,
    valid_depth,
)
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.core.types import Frame
from hybridvo.core.unchecked import changed
from hybridvo.tracking.calibration import (
    KEYFRAME_AGE,
    KEYFRAME_CORRELATION,
    KEYFRAME_FLOW,
    MIN_DEPTH_SHARE,
)

# pixels, both ways, between those at which weights are carried over
WEIGHT_STRIDE = 4


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame with a known pose, from which a later motion can be estimated.

    The reference, the frame before, is one as well; it is no keyframe where it is not sure.
    """

    frame: Frame
    T_world_cam: np.ndarray  # (4, 4)
    count: int  # number of the frame since the tracker began
    origin: int  # the same of the frame that its own motion was estimated from
    covariance: np.ndarray  # (6, 6) of that motion; zero of the first frame
    is_sure: bool = True  # whether that motion was ok

    def moved(self, T_new_old: np.ndarray) -> Keyframe:
        """Return the keyframe in another world frame, for instance after a loop closure."""
        return replace(self, T_world_cam=T_new_old @ self.T_world_cam)


def has_enough_depth(frame: Frame) -> bool:
    """Whether so many of a frame's pixels have depth that a motion can start from it."""
    if frame.depth is None:
        return False
    valid = valid_depth(frame.depth)
    return bool(np.count_nonzero(valid) >= MIN_DEPTH_SHARE * valid.size)


def trimmed(
    keyframes: Sequence[Keyframe], T_world_cam: np.ndarray, count: int
) -> tuple[Keyframe, ...]:
    """Drop the keyframes, oldest first, that are too far from the next frame or too old for it.

    The first of those that stay is the one to estimate from. It stays the same as long as it can,
    and then hands over to one half as far away, so that the baseline is never short.

    Args:
        keyframes: oldest first.
        T_world_cam: (4, 4) expected pose of the next frame.
        count: number of the next frame since the tracker began.
    """
    if not keyframes or is_near(keyframes[0], T_world_cam, count):
        return tuple(keyframes)
    for k, keyframe in enumerate(keyframes):
        if is_near(keyframe, T_world_cam, count, limit=0.5):
            return tuple(keyframes[k:])
    return tuple(keyframes[-1:])


def is_near(
    keyframe: Keyframe, T_world_cam: np.ndarray, count: int, limit: float = 1.0
) -> bool:
    """Whether a keyframe is near enough to a pose (4, 4); ``limit``: factor on what is allowed."""
    if count - keyframe.count > limit * KEYFRAME_AGE:
        return False
    return mean_flow(
        keyframe.frame, invert(T_world_cam) @ keyframe.T_world_cam
    ) <= (limit * KEYFRAME_FLOW)


def expected_motion(prior: MotionPrior, T_prev_key: np.ndarray) -> MotionPrior:
    """Return what is known of the motion from a keyframe, given that from the previous frame."""
    return changed(prior, T_curr_prev=prior.T_curr_prev @ T_prev_key)


def between_frames(
    motion: RelativePose, keyframe: Keyframe, reference: Keyframe
) -> RelativePose:
    """Turn the motion from a keyframe into that from the reference, the frame before.

    Args:
        motion: from ``keyframe`` to the current frame.
        keyframe: what the motion was estimated from.
        reference: the frame before, later than the keyframe.

    Returns:
        The motion from the reference to the current frame. Its covariance is the sum of those of
        both motions from the keyframe, less what they have in common: they share the keyframe's
        noise. Its weights stand on the reference's pixels.
    """
    T_key_ref = invert(keyframe.T_world_cam) @ reference.T_world_cam
    known = reference.covariance
    if reference.origin != keyframe.count:
        # both stem from an earlier keyframe: the error of this one counts as well
        back = adjoint(invert(T_key_ref))
        known = known + back @ keyframe.covariance @ back.T

    def between(T_curr_key: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
        T_curr_ref = T_curr_key @ T_key_ref
        A = adjoint(T_curr_ref)
        both = covariance + A @ known @ A.T
        return {
            "T_curr_prev": T_curr_ref,
            "covariance": (1 - KEYFRAME_CORRELATION) * both,
        }

    rivals = [
        replace(each, **between(each.T_curr_prev, each.covariance))
        for each in motion.rivals
    ]
    weights = motion.weights
    if weights is not None and reference.frame.depth is not None:
        weights = carried_weights(
            weights, keyframe.frame, reference.frame, T_key_ref
        )
    return motion.replace(
        **between(motion.T_curr_prev, motion.covariance),
        weights=weights,
        rivals=tuple(rivals),
    )


def carried_weights(
    weights: np.ndarray, key: Frame, reference: Frame, T_key_ref: np.ndarray
) -> np.ndarray:
    """Return weights (H, W) of a keyframe's pixels where the reference sees the same points.

    Pixels of which the reference has no depth, or which the keyframe does not see, get 0.
    """
    assert reference.depth is not None
    height, width = reference.camera.shape
    half = WEIGHT_STRIDE // 2
    rows, columns = np.mgrid[half:height:WEIGHT_STRIDE, half:width:WEIGHT_STRIDE]
    pixels = np.stack([rows.ravel(), columns.ravel()], axis=1)
    points = backproject(reference.depth, reference.camera, pixels)
    points = np.where((points[:, 2:] > 0) & np.isfinite(points), points, np.nan)
    places = project(points @ T_key_ref[:3, :3].T + T_key_ref[:3, 3], key.camera)
    places = (
        np.nan_to_num(places, nan=-1e6).astype(np.float32).reshape(*rows.shape, 2)
    )
    carried = cv2.remap(
        weights, places[..., 0], places[..., 1], cv2.INTER_NEAREST, borderValue=0.0
    )
    return cv2.resize(carried, (width, height), interpolation=cv2.INTER_NEAREST)
