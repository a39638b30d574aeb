"""The second look: a judge of pictures says which motion is the world and where the world is, the
best few motions are fitted again inside its masks, and it judges old and new ones together.

The judge is handed in (:class:`PictureJudge`); this room knows no network.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hybridvo.geometry import invert, pose_matrix, se3_log
from hybridvo.pose import kernels, search, solver
from hybridvo.pose.coarse import CoarseSearch, Grid, fit_in_mask
from hybridvo.pose.covariance import symmetric
from hybridvo.pose.options import RefinementOptions

__all__ = ["Decision", "Motions", "Opinion", "PictureJudge", "decide", "mask_weights"]

REFITS = 2
"""Motions that are fitted again inside their masks."""
LOOKS = 3
"""Most rounds of fitting and judging. Only a fit that differs from every motion of the search goes
into another round, inside the mask that is drawn about it."""
SAME_MOTION = 8.0
"""Squared difference, in standard deviations of the fit inside a mask, up to which a motion of the
search is taken for the same one (80 % quantile of chi-square with 6 degrees of freedom). Then the
mask removes no bias, only pixels, and the motion is fitted on all of them. On development pairs
with independent noise the difference stays below 5 and all pixels are better by a tenth; where
movers have bent the fit it is tens to thousands and the mask is better by half."""
LEAST_TRUST = 0.5
"""Probability of being right below which the classical choice stands: there the two err alike."""
LEAST_FLOW_NOISE = 0.02
"""px: what even true flow may differ by (rounding, edges of pixels)."""
LEAST_MASK = 0.02
"""Share of the usable pixels that a mask must keep for a fit inside it."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Candidate motions of one pair.

    Args:
        poses: (N, 3, 4) T_curr_prev. flow_noise: (N,) px. depth_noise: (N,) of log depth.
    """

    poses: np.ndarray
    flow_noise: np.ndarray
    depth_noise: np.ndarray


@dataclass(frozen=True, eq=False)
class Opinion:
    """What the judge says after a look.

    Args:
        score: (N,) of all candidates so far; larger is more likely the world.
        best: (R,) int64, the candidates in whose masks it is worth to fit.
        mask: (R, h, w) for each of them the probability of every pixel to be static world.
        trust: probability that the candidate with the largest score is right.
        memory: whatever the judge wants back for the next look.
    """

    score: np.ndarray
    best: np.ndarray
    mask: np.ndarray
    trust: float = 0.0
    memory: Any = None


@runtime_checkable
class PictureJudge(Protocol):
    """Judges the motions of a pair by what they leave unexplained, pixel by pixel."""

    def first_look(
        self, grid: Grid, motions: Motions, T_last: np.ndarray | None, masks: int
    ) -> Opinion:
        """Opinion of the motions of the search, with masks for the best of them.

        Args:
            grid: the pixels.
            motions: N of the search.
            T_last: (4, 4) the last motion, or None.
            masks: how many masks are wanted; R is the smaller of it and N.
        """

    def look_again(self, before: Opinion, refits: Motions, parents: np.ndarray) -> Opinion:
        """Opinion of all candidates, with the mask of the best one where it is a new one.

        Args:
            before: the opinion before.
            refits: R fits inside masks of that opinion; they follow its candidates.
            parents: (R,) int64, the motion of the search that each goes back to.
        """


@dataclass(frozen=True, eq=False)
class Decision:
    """Candidates, and which of them is the world.

    Args:
        poses: (N + R, 3, 4). facts: (N + R, :data:`hybridvo.pose.search.FACTS`).
        score: (N + R,).
        best: index of the world.
        mask: (h, w) weights that it was fitted with, or None for a motion of the search.
        kept: share of the usable pixels' weight that the mask leaves.
        trust: probability that it is right. abstained: the classical choice stands.
    """

    poses: np.ndarray
    facts: np.ndarray
    score: np.ndarray
    best: int
    mask: np.ndarray | None
    kept: float
    trust: float
    abstained: bool


def mask_weights(probability: np.ndarray) -> np.ndarray:
    """Weights of a fit from probabilities to be static: 0 below 0.4, 1 above 0.9."""
    return np.clip((probability - 0.4) / 0.5, 0.0, 1.0).astype(np.float32)


def decide(
    judge: PictureJudge,
    found: CoarseSearch,
    grid: Grid,
    classical: np.ndarray,
    T_last: np.ndarray | None,
    options: RefinementOptions,
) -> Decision:
    """Judge, fit the best again inside their masks, judge again.

    Args:
        judge: of pictures.
        found: motions of the search.
        grid: its pixels.
        classical: (N,) scores of the hand-made judge, for when the judge trusts nothing.
        T_last: (4, 4) the last motion of the camera, or None.
        options: of the refinement.
    """
    usable = found.samples[kernels.W, : found.count]
    total = float(usable.sum())
    count = len(found.poses)
    poses, facts = list(found.poses), list(found.facts)
    parents = list(range(count))
    masks: list[np.ndarray | None] = [None] * count
    opinion = judge.first_look(grid, _motions(found.poses, found.facts), T_last, REFITS)
    best, same = 0, None
    for _ in range(LOOKS):
        known = len(poses)
        for k, probability in zip(opinion.best, opinion.mask, strict=True):
            weights = mask_weights(probability)
            if float(usable @ weights.reshape(-1)) < LEAST_MASK * total:
                continue
            pose, fact = fit_in_mask(
                found.samples, weights, found.picture.K, poses[k], options.cutoff
            )
            if np.isfinite(pose).all() and fact[search.SHARE] > 0:
                poses.append(pose)
                facts.append(fact)
                parents.append(parents[k])
                masks.append(weights)
        refits = _motions(np.reshape(poses[known:], (-1, 3, 4)), np.array(facts[known:]))
        opinion = judge.look_again(opinion, refits, np.array(parents[known:], np.int64))
        best = int(np.argmax(np.nan_to_num(opinion.score, nan=-np.inf)))
        mask = masks[best]
        same = None if mask is None else _same(found, mask, poses[best], facts[best], options)
        if best < known or same is not None:
            break
    score = np.nan_to_num(opinion.score, nan=-np.inf)
    trust = float(np.nan_to_num(opinion.trust))
    abstained = trust < LEAST_TRUST
    if abstained:
        best = int(np.argmax(classical))
    elif same is not None:
        best = same
    mask = masks[best]
    kept = 1.0 if mask is None else float(usable @ mask.reshape(-1)) / total
    return Decision(np.stack(poses), np.stack(facts), score, best, mask, kept, trust, abstained)


def _same(
    found: CoarseSearch,
    mask: np.ndarray,
    pose: np.ndarray,
    fact: np.ndarray,
    options: RefinementOptions,
) -> int | None:
    """Index of the motion of the search that a fit inside a mask differs from by chance only.

    A fit on all pixels that differs by more has been bent by pixels outside of the mask (Hausman's
    test of an efficient estimate by a robust one).
    """
    n = found.count
    samples = found.samples.copy()
    samples[kernels.W, :n] *= mask.reshape(-1)
    noise = np.empty(3, np.float32)
    sf = max(float(fact[search.FLOW_NOISE]), LEAST_FLOW_NOISE)
    solver.set_noise(sf, float(fact[search.DEPTH_NOISE]), options.cutoff, noise)
    sums = np.zeros(kernels.SUMS)
    solver.evaluate(samples, n, pose, found.picture.K, noise, solver.new_work(), sums)
    information = symmetric(sums[:21])
    T = pose_matrix(pose)
    steps = np.array([se3_log(T @ invert(pose_matrix(P))) for P in found.poses])
    gaps = np.einsum("ni,ij,nj->n", steps, information, steps)
    return int(np.argmin(gaps)) if gaps.min() < SAME_MOTION else None


def _motions(poses: np.ndarray, facts: np.ndarray) -> Motions:
    facts = np.reshape(facts, (-1, search.FACTS))
    return Motions(poses, facts[:, search.FLOW_NOISE], facts[:, search.DEPTH_NOISE])
