"""Which of the motions found is the camera's, and which pixels are static.

Two selectors: :class:`CueSelector` by hand-made cues, and :class:`MaskSelector` by a scorer, which
is handed in (a network; this package knows none): the motions are scored, the best are fitted again
inside the static masks that the scorer draws about them, and all are scored once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from hybridvo.calibration import CLEAR_RIGHT, CUE_WEIGHTS, CUES_RIGHT, SELECTOR_RIGHT, right
from hybridvo.geometry import invert, pose_matrix, se3_log
from hybridvo.hypotheses import search
from hybridvo.hypotheses.cues import agreement, cue_scores
from hybridvo.hypotheses.generate import (
    SOURCE_REFIT,
    GridMaps,
    HypothesisSet,
    fit_in_mask,
)
from hybridvo.options import Options
from hybridvo.refinement import coarse_fit, kernels
from hybridvo.results import Hypothesis, MotionPrediction, MotionPrior

SUPPORT_CUTOFF = 3.0
"""Cutoff of the robust kernel by which the inliers of a motion are told, standard deviations."""
MIN_NOISE_PX = 0.05
"""The same, least noise of the flow."""
MASK_RAMP = (0.4, 0.9)
"""Probabilities of being static between which the weights of a fit grow from 0 to 1."""
ROUNDS = 3
"""Most rounds of refits; only a refit that is the best goes into another one, inside its own mask.
On 120 development pairs with DIS flow one round leaves a median error of 0.075 px, three 0.072."""
NO_RIVAL = 8.0
"""Gap of the scores where there is no other motion, and the largest that counts."""
MIN_COVERAGE = 0.02
"""Share of the usable pixels' weight that a mask must leave for a fit inside it."""
SOURCES = {
    search.SOURCE_WINDOW: "window",
    search.SOURCE_MINIMAL: "minimal",
    search.RUNNER_UP: "runner-up",
    SOURCE_REFIT: "refit",
}


@dataclass(frozen=True, eq=False)
class Candidates:
    """Motions to be scored: those of the search, then those fitted inside masks.

    Args:
        poses: (N, 3, 4) T_curr_prev. facts: (N, :data:`hybridvo.hypotheses.search.FACTS`).
        parents: (N,) int64, for a refit the motion of the search that it goes back to, else itself.
        searched: how many are of the search.
    """

    poses: np.ndarray
    facts: np.ndarray
    parents: np.ndarray
    searched: int


@dataclass(frozen=True, eq=False)
class Scores:
    """A scorer's answer.

    Args:
        score: (N,) of the candidates; larger is more likely the camera's motion.
        best: (R,) int64, the candidates worth a fit inside their mask.
        masks: (R, h, w) for each of them the probability of every pixel of being static.
        confidence: probability, 0 to 1, that the candidate with the largest score is right.
    """

    score: np.ndarray
    best: np.ndarray
    masks: np.ndarray
    confidence: float


class Scorer(Protocol):
    """Scores the motions of a pair by what they leave unexplained, pixel by pixel."""

    def look(self, maps: GridMaps, prior: MotionPrior | None, static: np.ndarray | None) -> Look:
        """The pair to be judged.

        Args:
            maps: the pixels.
            prior: what is known of the motion, or None.
            static: (h, w) probability of being static that a network predicts, or None.
        """


class Look(Protocol):
    """One pair as a scorer sees it."""

    def score(self, candidates: Candidates, masks: int) -> Scores:
        """Scores of all candidates, and masks for the best of them.

        Args:
            candidates: the motions; those of an earlier call come first, in the same order.
            masks: how many masks are wanted at most.
        """


@dataclass(frozen=True, eq=False)
class Selection:
    """The motion selected.

    Args:
        T_curr_prev: (4, 4).
        noise: (flow px, log depth) standard deviations found with it.
        mask: (h, w) weights on the coarse grid that it was fitted with, or None for all.
        coverage: share of the usable pixels' weight that the mask leaves.
        confidence: the scorer's own, 0 to 1, that it is right; low where no motion may be.
        gap: by how much its score exceeds that of any other motion.
        probability: that the motion is right, calibrated in the gap.
        hypotheses: all candidates, the one selected first.
        iterations: Gauss-Newton steps spent on it.
    """

    T_curr_prev: np.ndarray
    noise: tuple[float, float]
    mask: np.ndarray | None
    coverage: float
    confidence: float
    gap: float
    probability: float
    hypotheses: tuple[Hypothesis, ...]
    iterations: int


class Selector(Protocol):
    """Chooses the camera's motion."""

    def select(
        self,
        found: HypothesisSet,
        prior: MotionPrior | None = None,
        prediction: MotionPrediction | None = None,
    ) -> Selection:
        """The motion selected.

        Args:
            found: the motions of the search.
            prior: what is known of the motion, or None.
            prediction: of a network: one candidate more, and where it sees the static scene.
        """


class CueSelector:
    """By hand-made cues, see :mod:`hybridvo.hypotheses.cues`."""

    def select(
        self,
        found: HypothesisSet,
        prior: MotionPrior | None = None,
        prediction: MotionPrediction | None = None,
    ) -> Selection:
        """See :class:`Selector`; a prediction is not looked at."""
        # the cues compare motions that share no pixels
        kept = found.facts[:, search.SOURCE] != search.RUNNER_UP
        found = replace(found, poses=found.poses[kept], facts=found.facts[kept])
        candidates = _searched(found)
        motions = hypotheses(found, candidates)
        seen = cue_scores(found, motions)
        expected = np.array([agreement(motion.T_curr_prev, prior) for motion in motions])
        scores = seen + CUE_WEIGHTS["prior"] * expected
        # a prior may say which motion; that it is right the image has to say
        best = int(np.argmax(scores))
        gap = min(seen[best] - np.delete(seen, best).max(initial=-np.inf), NO_RIVAL)
        probability = right((gap,), CUES_RIGHT) if found.is_ambiguous else CLEAR_RIGHT
        masks = [None] * len(scores)
        return _selection(found, candidates, scores, masks, probability, gap, probability)


class MaskSelector:
    """By a scorer and its masks: score, fit again inside masks, score again.

    Args:
        scorer: of the candidates.
        options: ``select`` and ``refine`` are read.
    """

    def __init__(self, scorer: Scorer, options: Options | None = None) -> None:
        self.scorer, self.options = scorer, options or Options()

    def select(
        self,
        found: HypothesisSet,
        prior: MotionPrior | None = None,
        prediction: MotionPrediction | None = None,
    ) -> Selection:
        """See :class:`Selector`."""
        candidates = _searched(found)
        if not found.is_ambiguous:
            sure = CLEAR_RIGHT, NO_RIVAL, CLEAR_RIGHT
            return _selection(found, candidates, np.zeros(1), [None], *sure)
        maps, limits = found.maps(), self.options.select
        masks: list[np.ndarray | None] = [None] * candidates.searched
        static = None
        if prediction is not None:
            static = found.grid.resample(prediction.static_probability)
            candidates = self._refit(
                found, candidates, masks, [(prediction.T_curr_prev[:3], mask_weights(static), None)]
            )
        look = self.scorer.look(maps, prior, static)
        scores = look.score(candidates, limits.refits)
        for _ in range(ROUNDS):
            known = len(candidates.poses)
            entries = [
                (candidates.poses[k], mask_weights(mask), int(candidates.parents[k]))
                for k, mask in zip(scores.best, scores.masks, strict=True)
            ]
            candidates = self._refit(found, candidates, masks, entries)
            if len(candidates.poses) == known:
                break
            scores = look.score(candidates, 1)
            if int(np.argmax(scores.score)) < known:
                break
        gap = gap_of(found, candidates, scores.score)
        trust = scores.confidence, gap, right((gap,), SELECTOR_RIGHT)
        return _selection(found, candidates, scores.score, masks, *trust)

    def _refit(
        self,
        found: HypothesisSet,
        candidates: Candidates,
        masks: list[np.ndarray | None],
        entries: Sequence[tuple[np.ndarray, np.ndarray, int | None]],
    ) -> Candidates:
        """The candidates with one fit more for each (start, weights, parent); extends ``masks``."""
        poses, facts, parents = (
            [*x] for x in (candidates.poses, candidates.facts, candidates.parents)
        )
        cutoff = self.options.refine.cutoff
        for start, weights, parent in entries:
            if _coverage(found, weights) < MIN_COVERAGE:
                continue
            pose, fact = fit_in_mask(
                found.grid.samples, weights, found.grid.pixels.K, start, cutoff
            )
            if np.isfinite(pose).all() and fact[search.SHARE] > 0:
                if parent is None:
                    parent = nearest_motion(found.poses, start, found.depth_scale)
                poses.append(pose)
                facts.append(fact)
                parents.append(parent)
                masks.append(weights)
        return replace(
            candidates,
            poses=np.stack(poses),
            facts=np.stack(facts),
            parents=np.array(parents, np.int64),
        )


def gap_of(found: HypothesisSet, candidates: Candidates, score: np.ndarray) -> float:
    """By how much the best score exceeds that of any other motion."""
    best = int(np.argmax(score))
    apart = search.distances(found.grid, candidates.poses, best) > search.OTHER_PX
    return min(NO_RIVAL, float(score[best] - score[apart].max(initial=-np.inf)))


def mask_weights(probability: np.ndarray, ramp: tuple[float, float] = MASK_RAMP) -> np.ndarray:
    """Weights of a fit from probabilities of being static: 0 below the ramp, 1 above it."""
    low, high = ramp
    return np.clip((probability - low) / (high - low), 0.0, 1.0).astype(np.float32)


def nearest_motion(poses: np.ndarray, pose: np.ndarray, depth_scale: float) -> int:
    """Index of the motion (N, 3, 4) nearest to another (3, 4); metres count 1 / depth radians."""
    T = pose_matrix(pose)
    steps = np.array([se3_log(T @ invert(pose_matrix(P))) for P in poses])
    length = (steps * np.array([depth_scale] * 3 + [1.0] * 3)) ** 2
    return int(np.argmin(length.sum(axis=1)))


def hypotheses(found: HypothesisSet, candidates: Candidates) -> list[Hypothesis]:
    """The candidates with their inliers, in their order."""
    grid = found.grid
    h, w, stride = grid.shape
    work, noise = kernels.new_work(), np.empty(3, np.float32)
    total = max(float(grid.weight.sum()), 1e-9)
    made = []
    for pose, fact in zip(candidates.poses, candidates.facts, strict=True):
        inliers = np.empty(grid.count, np.float32)
        flow_noise, depth_noise = float(fact[search.FLOW_NOISE]), float(fact[search.DEPTH_NOISE])
        coarse_fit.set_noise(max(flow_noise, MIN_NOISE_PX), depth_noise, SUPPORT_CUTOFF, noise)
        coarse_fit.robust_weights(
            grid.samples, grid.count, pose, grid.pixels.K, noise, work, inliers
        )
        name = SOURCES.get(int(fact[search.SOURCE]), "start")
        share = float(np.where(grid.weight > 0, inliers, 0) @ grid.weight) / total
        T, shape = pose_matrix(pose), inliers.reshape(h, w)
        made.append(Hypothesis(T, name, share, flow_noise, depth_noise, shape, stride))
    return made


def _searched(found: HypothesisSet) -> Candidates:
    return Candidates(found.poses, found.facts, np.arange(len(found.poses)), len(found.poses))


def _coverage(found: HypothesisSet, weights: np.ndarray) -> float:
    """Share of the usable pixels' weight that a mask leaves."""
    return float(found.grid.weight @ weights.reshape(-1)) / max(
        float(found.grid.weight.sum()), 1e-9
    )


def _selection(
    found: HypothesisSet,
    candidates: Candidates,
    scores: np.ndarray,
    masks: Sequence[np.ndarray | None],
    confidence: float,
    gap: float,
    probability: float,
) -> Selection:
    """The candidate with the largest score."""
    scores = np.nan_to_num(scores, nan=-np.inf)
    order = np.argsort(-scores, kind="stable")
    best = int(order[0])
    motions = hypotheses(found, candidates)
    fact, mask = candidates.facts[best], masks[best]
    return Selection(
        T_curr_prev=pose_matrix(candidates.poses[best]),
        noise=(float(fact[search.FLOW_NOISE]), float(fact[search.DEPTH_NOISE])),
        mask=mask,
        coverage=1.0 if mask is None else _coverage(found, mask),
        confidence=float(np.nan_to_num(confidence)),
        gap=gap,
        probability=float(np.nan_to_num(probability)),
        hypotheses=tuple(replace(motions[k], score=float(scores[k])) for k in order),
        iterations=int(fact[search.ITERATIONS]),
    )
