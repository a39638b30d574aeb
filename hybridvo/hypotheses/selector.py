"""The stage *select*: which motion of a pair is the camera's, and where the scene is static.

Either hand-made cues decide, or a scorer, such as a network. The scorer scores the
motions of the search and draws a static mask for the best of them. Each of these is
fitted again inside its mask, and then all motions are scored once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import (
    CUE_MIN_INLIER_RATIO,
    CUES_RIGHT,
    DISTINCT_MOTION_PX,
    MAX_SCORE_MARGIN,
    MIN_COVERAGE,
    MIN_INLIER_NOISE_PX,
    NO_MOTION,
    SELECTOR_RIGHT,
    UNAMBIGUOUS_RIGHT,
)
from hybridvo.geometry import pose_matrix
from hybridvo.hypotheses.cues import compute_cues, cue_scores, prior_scores
from hybridvo.hypotheses.refit import (
    fit_in_mask,
    mask_coverage,
    mask_weights,
    nearest_motion,
)
from hybridvo.hypotheses.search import distances
from hybridvo.hypotheses.types import HypothesisSet, HypothesisStats, MotionSource
from hybridvo.options import Options
from hybridvo.refinement import kernels, robust_fit
from hybridvo.refinement.noise_estimation import Noise
from hybridvo.refinement.refine import Selection
from hybridvo.results import (
    Hypothesis,
    MotionPrediction,
    MotionPrior,
    probability_right,
)


class Candidate(NamedTuple):
    """A motion to be scored.

    Attributes:
        pose: (3, 4) ``T_curr_prev``, metres.
        stats: how well the pixels agree with it.
        parent: number of the motion of the search that it goes back to, or its own.
        mask: (h, w) weights with which a refit was made; None for motions of the search.
    """

    pose: np.ndarray
    stats: HypothesisStats
    parent: int
    mask: np.ndarray | None = None


class Scores(NamedTuple):
    """A scorer's answer about N candidates.

    Attributes:
        score: (N,); the candidate with the largest one is the camera's motion. ``NO_MOTION``
            is the score of "none of them".
        static: for some of the candidates, the best first: their number, and the
            probability (h, w) of each pixel to be static if that motion is the camera's.
    """

    score: np.ndarray
    static: dict[int, np.ndarray]


Scorer = Callable[[Sequence[Candidate], int], Scores]
"""Scores candidates, and draws as many masks as the second argument says.

A later call repeats the candidates of an earlier one, and appends others.
"""
ScorerFactory = Callable[
    [HypothesisSet, MotionPrior | None, np.ndarray | None], Scorer
]
"""Makes a scorer for one pair from its motions, the expected motion, and the probability
(h, w) of being static that another network predicts."""


class _RefitStart(NamedTuple):
    """Where a refit starts, the motion it goes back to, and its static probability."""

    pose: np.ndarray
    parent: int
    static: np.ndarray


def select_by_cues(
    found: HypothesisSet, prior: MotionPrior | None = None
) -> Selection:
    """Select the camera's motion by hand-made cues.

    Args:
        found: the motions of the search.
        prior: the expected motion, if there is one; it takes part as a cue.

    Returns:
        The motion, with its probability of being right.
    """
    candidates = cue_candidates(found)
    if not found.is_ambiguous:
        return _select_only(found, candidates)
    motions = to_hypotheses(found, candidates)
    image_scores = cue_scores(compute_cues(found.grid, motions))
    scores = image_scores
    if prior is not None:
        scores = image_scores + prior_scores(motions, prior)
    # a prior may choose the motion, but only the image is evidence that it is right
    best = int(np.argmax(scores))
    evidence = cue_evidence(image_scores, best, motions[best].inlier_ratio)
    probability = probability_right(evidence, CUES_RIGHT)
    return _select_best(found, candidates, scores, evidence, probability)


def cue_evidence(
    scores: np.ndarray, best: int, inlier_ratio: float
) -> tuple[float, ...]:
    """Return what tells whether the motion with the best cue scores is right.

    Args:
        scores: (N,) of the motions, by the image alone.
        best: number of the motion.
        inlier_ratio: share of the usable pixels that follow it.

    Returns:
        The margin to the next motion (0 where there is none), whether there is none, and the log
        of the inlier ratio, once where there is another motion and once where there is none.
    """
    others = np.delete(scores, best)
    explained = float(np.log(inlier_ratio + CUE_MIN_INLIER_RATIO))
    if not len(others):
        return 0.0, 1.0, 0.0, explained
    margin = min(float(scores[best] - others.max()), MAX_SCORE_MARGIN)
    return margin, 0.0, explained, 0.0


def select_by_scorer(
    found: HypothesisSet,
    make_scorer: ScorerFactory,
    options: Options,
    prior: MotionPrior | None = None,
    prediction: MotionPrediction | None = None,
) -> Selection:
    """Select the camera's motion by a scorer and the masks that it draws.

    Args:
        found: the motions of the search.
        make_scorer: makes the scorer for this pair.
        options: the option tree, of which ``select.refits`` matters.
        prior: the expected motion, if there is one.
        prediction: another network's motion and static probability. The motion becomes one
            more candidate, and the scorer gets the probability.

    Returns:
        The motion, with the mask it was fitted in and its probability of being right.
    """
    candidates = search_candidates(found)
    if not found.is_ambiguous:
        return _select_only(found, candidates)
    static = None
    if prediction is not None:
        static = found.grid.resample(prediction.static_probability)
        start = _start_of_prediction(found, prediction, static)
        candidates += _refit(found, [start])
    scorer = make_scorer(found, prior, static)
    scores = scorer(candidates, options.select.refits)
    starts = [
        _RefitStart(candidates[k].pose, candidates[k].parent, probability)
        for k, probability in scores.static.items()
    ]
    refits = _refit(found, starts)
    if refits:
        candidates += refits
        scores = scorer(candidates, 0)
    poses = [candidate.pose for candidate in candidates]
    margin = score_margin(found, poses, scores.score)
    probability = probability_right((margin,), SELECTOR_RIGHT)
    return _select_best(found, candidates, scores.score, (margin,), probability)


def search_candidates(found: HypothesisSet) -> list[Candidate]:
    """The motions of the search as candidates, each its own parent."""
    return [
        Candidate(motion.pose, motion.stats, number)
        for number, motion in enumerate(found.motions)
    ]


def cue_candidates(found: HypothesisSet) -> list[Candidate]:
    """The winners of the search's rounds: the cues compare motions without common pixels."""
    return [
        candidate
        for candidate in search_candidates(found)
        if candidate.stats.source is not MotionSource.RUNNER_UP
    ]


def _start_of_prediction(
    found: HypothesisSet, prediction: MotionPrediction, static: np.ndarray
) -> _RefitStart:
    """The motion and static probability of another network as the start of a refit."""
    grid = found.grid
    pose = prediction.T_curr_prev[:3]
    inverse_depth = robust_fit.translation_scale(grid.samples, grid.count)
    parent = nearest_motion(found.poses, pose, inverse_depth)
    return _RefitStart(pose, parent, static)


def _refit(found: HypothesisSet, starts: Sequence[_RefitStart]) -> list[Candidate]:
    """Fit motions inside their masks; without those whose mask leaves too little."""
    grid = found.grid
    refits = []
    for start in starts:
        mask = mask_weights(start.static)
        if mask_coverage(grid, mask) < MIN_COVERAGE:
            continue
        pose, stats = fit_in_mask(
            grid.samples, mask, grid.K, start.pose, found.cutoff
        )
        if np.isfinite(pose).all() and stats.inlier_ratio > 0:
            refits.append(Candidate(pose, stats, start.parent, mask))
    return refits


def score_margin(
    found: HypothesisSet, poses: Sequence[np.ndarray], score: np.ndarray
) -> float:
    """Difference between the best score and that of the best other motion.

    A pose near the best one counts as the same motion. "None of them" is another motion.

    Args:
        found: the pixels on which motions are compared.
        poses: N motions (3, 4).
        score: (N,) their scores.

    Returns:
        The margin, at most ``MAX_SCORE_MARGIN``.
    """
    best = int(np.argmax(score))
    is_other = distances(found.grid, poses, best) > DISTINCT_MOTION_PX
    second = score[is_other].max(initial=NO_MOTION)
    return min(MAX_SCORE_MARGIN, float(score[best] - second))


def to_hypotheses(
    found: HypothesisSet, candidates: Sequence[Candidate]
) -> list[Hypothesis]:
    """Describe candidates for the result, with their inliers, in their order."""
    grid = found.grid
    described = []
    for candidate in candidates:
        stats = candidate.stats
        noise = kernels.residual_noise(
            max(stats.flow_noise_px, MIN_INLIER_NOISE_PX),
            stats.depth_noise,
            found.cutoff,
        )
        inliers = kernels.robust_weights(
            grid.samples, grid.count, candidate.pose, grid.K, noise
        )
        hypothesis = Hypothesis(
            T_curr_prev=pose_matrix(candidate.pose),
            source=stats.source.value,
            inlier_ratio=mask_coverage(grid, inliers),
            flow_noise_px=stats.flow_noise_px,
            depth_noise=stats.depth_noise,
            inliers=inliers.reshape(grid.shape[:2]),
        )
        described.append(hypothesis)
    return described


def _select_only(
    found: HypothesisSet, candidates: Sequence[Candidate]
) -> Selection:
    """Select the only motion of a pair that is not ambiguous."""
    score = np.zeros(1)
    return _select_best(
        found, candidates, score, (MAX_SCORE_MARGIN,), UNAMBIGUOUS_RIGHT
    )


def _select_best(
    found: HypothesisSet,
    candidates: Sequence[Candidate],
    scores: np.ndarray,
    evidence: tuple[float, ...],
    probability: float,
) -> Selection:
    """Select the candidate with the largest score; one without a finite score is last."""
    score = np.nan_to_num(scores, nan=-np.inf)
    order = np.argsort(-score, kind="stable")
    described = to_hypotheses(found, candidates)
    hypotheses = [replace(described[k], score=float(score[k])) for k in order]
    best = candidates[order[0]]
    return Selection(
        T_curr_prev=pose_matrix(best.pose),
        noise=Noise(*best.stats.noise),
        mask=best.mask,
        coverage=mask_coverage(found.grid, best.mask),
        evidence=evidence,
        probability=float(np.nan_to_num(probability)),
        hypotheses=tuple(hypotheses),
        iterations=best.stats.iterations,
    )
