"""How much later than its image a depth map is measured, by some tens of neighbouring frames.

A camera whose turn grows faster has turned more between two depth maps that are measured later
than their images: by its angular acceleration times the lag. One pair shows that to tens of
milliseconds, a camera that is turned to and fro for some seconds to a few.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hybridvo.core.geometry import invert, rotation_vector
from hybridvo.core.results import (
    MotionPrior,
    RelativePose,
    Step,
    identity_covariance,
)
from hybridvo.core.types import Frame, FramePair
from hybridvo.judge.consistency import by_images_alone
from hybridvo.solver.depth_alone import motion_by_depth
from hybridvo.solver.newton import positive_inverse
from hybridvo.tracking.calibration import MIN_TURN_GROWTH
from hybridvo.tracking.camera_drift import MAX_EVEN_MS, Bend, robust_mean
from hybridvo.tracking.repeated import repeat_of
from hybridvo.tracking.tracker import Tracker

# Pairs before which nothing is stated of the lag.
MIN_LAG_PAIRS = 20


class Lag(NamedTuple):
    """How much later than the image depth is measured."""

    ms: float
    std_ms: float
    pairs: int  # that show it


class _Turn(NamedTuple):
    """A step between two neighbouring frames."""

    pair: FramePair
    motion: RelativePose
    rate: np.ndarray  # (3,) rotation vector, rad/s


def find_lag(frames: Iterable[Frame]) -> Lag | None:
    """Find how much later than their images the depth maps of a turning camera are measured.

    Args:
        frames: neighbours, with images, depth and stamps, of a scene that is mostly static.

    Returns:
        The lag; None where too few of them show it.
    """
    tracker = Tracker()
    turns: list[_Turn | None] = []
    before = None
    for each in frames:
        # as it was measured, whatever lag is stated
        camera = replace(each.camera, depth_lag_ms=0.0)
        frame = replace(each, camera=camera)
        step = tracker.track(frame)
        if before is not None:
            turns.append(_turn_of(before, frame, step))
        before = frame
    shown = []
    for earlier, turn, later in zip(turns, turns[1:], turns[2:], strict=False):
        if earlier is None or turn is None or later is None:
            continue
        bend = lag_shown(turn.pair, turn.motion, (later.rate - earlier.rate) / 2)
        if bend is not None:
            shown.append(bend)
    return mean_lag(shown)


def _turn_of(prev: Frame, curr: Frame, step: Step) -> _Turn | None:
    """A step from the frame before; None where it does not tell how the camera turned."""
    between_s = curr.timestamp - prev.timestamp
    is_even = 0 < 1000 * between_s <= MAX_EVEN_MS
    repeat = repeat_of(prev, curr)
    is_fresh = not (repeat.colour or repeat.depth)
    is_neighbour = step.index is not None and step.prev_index == step.index - 1
    if not (is_even and is_fresh and is_neighbour and step.ok):
        return None
    rate = rotation_vector(step.T_curr_prev[:3, :3]) / between_s
    return _Turn(FramePair(prev, curr, None), step.motion, rate)


def lag_shown(
    pair: FramePair, motion: RelativePose, growth: np.ndarray
) -> Bend | None:
    """Return what a pair shows of the lag of its depth maps.

    Args:
        pair: two neighbouring frames of a static scene, with images and depth.
        motion: between them.
        growth: (3,) by how much the rotation vector from frame to frame grows in a second, rad.

    Returns:
        The lag, ms, and its information; None where images or depth alone do not determine the
        rotation, or the turn hardly grows.
    """
    if np.linalg.norm(growth) < MIN_TURN_GROWTH:
        return None
    everywhere = np.ones(pair.prev.camera.shape, np.float32)
    images = by_images_alone(pair, motion.replace(weights=everywhere))
    if images is None or images.covariance is None:
        return None
    unknown = MotionPrior(images.T_curr_prev, identity_covariance())
    depth = motion_by_depth(pair, unknown)
    covariance = (images.covariance + depth.covariance)[3:, 3:]
    information = positive_inverse(covariance)
    if information is None:
        return None
    difference = depth.T_curr_prev @ invert(images.T_curr_prev)
    turned_more = rotation_vector(difference[:3, :3])
    along = growth / 1000 @ information
    of_lag = float(along @ growth / 1000)
    return Bend(float(along @ turned_more) / of_lag, of_lag)


def mean_lag(shown: Sequence[Bend]) -> Lag | None:
    """Return the robust mean of what some pairs show; None where they are too few.

    Example:
        >>> mean_lag([Bend(12.0, 1.0), Bend(13.0, 1.0), Bend(11.0, 1.0)]) is None
        True
    """
    if len(shown) < MIN_LAG_PAIRS:
        return None
    lag = robust_mean(shown)
    return Lag(lag.error, lag.std, lag.pairs)
