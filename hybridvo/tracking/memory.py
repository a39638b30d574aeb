"""The memory of a tracker: what was static stays static until it is found to move.

A tracker that judges each pair alone forgets what it found out: which pixels are static. The memory
keeps that as the log odds of every point of a keyframe (:class:`hybridvo.core.belief.Belief`).
Every frame whose motion is known is evidence: under the camera's motion a static point keeps its
grey level and its depth. What something nearer hides is no evidence. A later keyframe gets the
belief through the motion between the two, where both see the same surface
(:mod:`hybridvo.evidence.remembered`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import logit

from hybridvo.core.belief import Belief
from hybridvo.core.geometry import (
    invert,
    transform_points,
)
from hybridvo.core.results import RelativePose, Term
from hybridvo.core.stages import stage
from hybridvo.core.types import Frame
from hybridvo.evidence.remembered import Remembered, carried_belief
from hybridvo.flow.frame_images import blurred, gradient_at
from hybridvo.solver.points import Points, grid_index, points_of
from hybridvo.solver.visibility import visibility
from hybridvo.tracking.calibration import (
    BELIEF_DECAY,
    BELIEF_LIMIT,
    BELIEF_SURE,
    CERTAINTY_BY_IMAGES,
    DEPTH_RATIO,
    GREY_RATIO,
    GREY_STD,
    GREY_STD_OF_GRADIENT,
    MAX_CERTAINTY,
    OTHER_STD_OF_GRADIENT,
)
from hybridvo.tracking.keyframes import Keyframe

# Side of the square, in points of the grid, over which what each shows is averaged: its
# likelihood ratios, its prices and its neighbours.
AVERAGED_SIDE = 3
# Sides, in points of the grid, for a change of light, and for the contrast around a point.
LIGHT_CHANGE_SIDE = 9
CONTRAST_SIDE = 5


@dataclass(frozen=True, eq=False)
class Memory:
    """What is believed of a keyframe's view.

    Attributes:
        keyframe: on whose pixels the belief stands.
        belief: which of them are static.
    """

    keyframe: Keyframe
    belief: Belief

    def moved(self, T_new_old: np.ndarray) -> Memory:
        """Return the memory in another world frame."""
        return replace(self, keyframe=self.keyframe.moved(T_new_old))


def nothing_known(keyframe: Keyframe) -> Memory:
    """The memory of a keyframe of which nothing is known yet."""
    shape = grid_index(keyframe.frame.camera.shape).shape[:2]
    return Memory(keyframe, Belief(np.zeros(shape, np.float16)))


def remembered_at(memory: Memory, keyframe: Keyframe) -> Remembered:
    """Return what is remembered, for the view of another keyframe."""
    old = memory.keyframe
    if old.count == keyframe.count:
        return Remembered(memory.belief, old.frame)
    T_old_new = invert(old.T_world_cam) @ keyframe.T_world_cam
    return Remembered(memory.belief, old.frame, T_old_new)


def carried_to(memory: Memory | None, keyframe: Keyframe) -> Memory:
    """Return what is believed of another keyframe's view, see :func:`carried_belief`."""
    if memory is None:
        return nothing_known(keyframe)
    known = remembered_at(memory, keyframe)
    return Memory(keyframe, carried_belief(known, keyframe.frame))


def faded(memory: Memory) -> Memory:
    """Return a memory after a frame that showed nothing: every belief decays."""
    belief = memory.belief
    log_odds = (BELIEF_DECAY * belief.log_odds).astype(np.float16)
    return replace(memory, belief=Belief(log_odds, BELIEF_DECAY * belief.certainty))


def memory_after(
    memory: Memory | None, home: Keyframe, frame: Frame, motion: RelativePose
) -> Memory:
    """Return what is remembered after a motion, on a keyframe.

    Args:
        memory: before.
        home: the keyframe.
        frame: the current one.
        motion: from the keyframe to the frame.
    """
    return after_step(carried_to(memory, home), frame, motion)


@stage("memory")
def after_step(memory: Memory, frame: Frame, motion: RelativePose) -> Memory:
    """Return a memory after a frame whose motion was estimated.

    Args:
        memory: before the frame.
        frame: the current one.
        motion: from the keyframe of the memory to the frame. One that is not ok says nothing.
    """
    if not motion.ok:
        return faded(memory)
    points = points_of(memory.keyframe.frame)
    ratios = likelihood_ratios(points, memory.keyframe.frame, frame, motion)
    belief = memory.belief
    ratio = points.on_grid(ratios)
    certainty = _certainty_after(belief, motion, ratio)
    if certainty < 0:
        belief = nothing_known(memory.keyframe).belief
        certainty = 0.0
    log_odds = updated_log_odds(belief.log_odds, ratio, motion.probability)
    return replace(memory, belief=Belief(log_odds, certainty))


def updated_log_odds(
    log_odds: np.ndarray, ratio: np.ndarray, probability: float
) -> np.ndarray:
    """Return the log odds of points to be static after a frame.

    Args:
        log_odds: (h, w) before the frame.
        ratio: (h, w) log of how much likelier the frame is if a point is static, given that the
            motion is the camera's.
        probability: that it is. If it is not, the frame says nothing.

    >>> before = np.array([[0.0, 2.0, -2.0]])
    >>> after = updated_log_odds(before, np.array([[1.0, 1.0, 0.0]]), 0.5)
    >>> after.astype(float).round(2).tolist()
    [[0.62, 2.52, -1.9]]
    """
    p = min(probability, BELIEF_SURE)
    before = BELIEF_DECAY * log_odds.astype(np.float32)
    after = before + np.log(p * np.exp(ratio) + 1 - p)
    return np.clip(after, -BELIEF_LIMIT, BELIEF_LIMIT).astype(np.float16)


def likelihood_ratios(
    points: Points, key: Frame, frame: Frame, motion: RelativePose
) -> np.ndarray:
    """Return how much likelier a frame is if points are static than if they move.

    Args:
        points: N of them, of ``key``.
        key: the frame in which the points are known.
        frame: the current one.
        motion: from ``key`` to ``frame``.

    Returns:
        (N,) log ratios of grey and depth, averaged over neighbours; 0 for points that are out of
        view, hidden, or where no depth was measured.
    """
    moved = transform_points(motion.T_curr_prev, points.xyz)
    there = visibility(moved, frame, motion.depth_noise)
    shows = there.inside & ~there.is_hidden
    # what measures no depth may stand before everything
    if frame.depth is not None:
        shows &= there.is_measured
    low, high = DEPTH_RATIO
    by_depth = np.clip(high - there.distance**2 / 2, low, high)
    by_depth[~there.is_measured] = 0.0
    by_grey = _grey_ratios(points, key, frame, motion, there.uv, shows)
    around = points.averaged(by_depth + by_grey, AVERAGED_SIDE, shows)
    return np.where(shows, around, 0.0)


def _grey_ratios(
    points: Points,
    key: Frame,
    frame: Frame,
    motion: RelativePose,
    uv: np.ndarray,
    shows: np.ndarray,
) -> np.ndarray:
    """Log ratios (N,) by grey levels alone, where points fall on pixels ``uv`` (N, 2).

    What is not static shows any grey level that its surroundings show: a blank wall that moves
    looks as if it stood, and is no evidence.
    """
    if key.rgb is None or frame.rgb is None or not shows.any():
        return np.zeros(len(uv))
    before = blurred(key)
    v, u = points.pixels.T
    grey = before[v, u]
    now = cv2.remap(blurred(frame), uv[:, 0], uv[:, 1], cv2.INTER_LINEAR)
    gain = 1.0 if motion.photometric is None else motion.photometric.gain
    residual = now.reshape(-1) - gain * grey
    residual -= np.median(residual[shows])
    # light may change over the image
    residual -= points.averaged(residual, LIGHT_CHANGE_SIDE, shows)
    gradient2 = np.sum(gradient_at(before, v, u) ** 2, axis=0)
    mean = points.averaged(grey, CONTRAST_SIDE)
    contrast2 = points.averaged((grey - mean) ** 2, CONTRAST_SIDE)
    variance = GREY_STD**2 + GREY_STD_OF_GRADIENT**2 * gradient2
    other = variance + contrast2 + OTHER_STD_OF_GRADIENT**2 * gradient2
    ratio = 0.5 * np.log(other / variance)
    ratio -= residual**2 / 2 * (1 / variance - 1 / other)
    return np.clip(ratio, *GREY_RATIO)


def log_odds_of(probability: float) -> float:
    """Return the log odds of a probability; finite."""
    floor = np.finfo(float).eps
    return float(logit(np.clip(probability, floor, 1 - floor)))


def _certainty_after(
    belief: Belief, motion: RelativePose, ratio: np.ndarray
) -> float:
    """The certainty in a belief after a motion, given the likelihood ratios (h, w) under it."""
    certainty = BELIEF_DECAY * belief.certainty
    if Term.FLOW not in motion.terms:
        # that a belief agrees with itself is no evidence
        gained = 0.0 if Term.MEMORY in motion.terms else CERTAINTY_BY_IMAGES
        return min(certainty + gained, MAX_CERTAINTY)
    agrees = float(np.sum(belief.log_odds.astype(np.float32) * ratio)) >= 0
    change = log_odds_of(motion.probability)
    return min(certainty + (change if agrees else -abs(change)), MAX_CERTAINTY)
