"""The stage *select*: which motion of a pair is the camera's, and where the scene is static.

Either hand-made cues decide, or a scorer, which is PWVO. The scorer scores the motions of
the search; for the best of them it selects a pose from the poses of all pixels, and draws
a static mask. From this pose each of these is fitted again inside its mask, and then all
motions are scored once more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hybridvo.core.belief import Belief
from hybridvo.core.geometry import pose_matrix
from hybridvo.core.options import Options
from hybridvo.core.results import (
    Hypothesis,
    MotionPrior,
)
from hybridvo.hypotheses.calibration import (
    DISTINCT_MOTION_PX,
    MIN_COVERAGE,
    NO_MOTION,
)
from hybridvo.hypotheses.cues import (
    CUE_MIN_INLIER_RATIO,
    MIN_INLIER_NOISE_PX,
    compute_cues,
    cue_scores,
    prior_scores,
)
from hybridvo.hypotheses.refit import (
    fit_in_mask,
    mask_coverage,
    mask_weights,
)
from hybridvo.hypotheses.remembered import memory_scores
from hybridvo.hypotheses.search import distances
from hybridvo.hypotheses.types import Candidate, HypothesisSet, MotionSource
from hybridvo.solver import kernels
from hybridvo.solver.noise_estimation import Noise
from hybridvo.solver.refine_flow import Selection

# Margin of the best score where there is no other motion, and the largest that counts, nats.
MAX_SCORE_MARGIN = 8.0
# Fraction of the view that is added to a share before its logarithm is evidence.
LEAST_SHARE = 0.01


class ChoiceEvidence(NamedTuple):
    """What speaks for a motion that PWVO chose among others.

    Attributes:
        margin: by how much its score exceeds that of any other motion of any flow.
        first_margin: the same in the first flow alone, of the motion that was best there.
        log_share: log of the fraction of the view that follows it.
        log_rival_share: the same of the best other motion; that of nothing where there is none.
    """

    margin: float
    first_margin: float
    log_share: float
    log_rival_share: float


class CueEvidence(NamedTuple):
    """What speaks for a motion that hand-made cues chose among others.

    Attributes:
        margin: of its score to that of the next motion; 0 where there is none.
        is_alone: 1 where there is no other motion, else 0.
        log_ratio_beside: log of its inlier ratio where there is another motion, else 0.
        log_ratio_alone: the same where there is none, else 0.
    """

    margin: float
    is_alone: float
    log_ratio_beside: float
    log_ratio_alone: float


class RefitStart(NamedTuple):
    """Where a candidate is fitted again.

    Attributes:
        pose: (3, 4) ``T_curr_prev`` from which the fit starts, metres.
        static: (h, w) probability of each pixel to be static if that candidate is the
            camera's motion.
    """

    pose: np.ndarray
    static: np.ndarray


class Scores(NamedTuple):
    """A scorer's answer about N candidates.

    Attributes:
        score: (N,); the candidate with the largest one is the camera's motion. ``NO_MOTION``
            is the score of "none of them".
        refits: for some of the candidates, the best first: where to fit them again.
    """

    score: np.ndarray
    refits: dict[int, RefitStart]


Scorer = Callable[[Sequence[Candidate], int], Scores]
"""Scores candidates; of as many as the second argument states it returns where to fit them again.

A later call repeats the candidates of an earlier one, and appends others.
"""


def select_by_cues(
    found: HypothesisSet, prior: MotionPrior | None = None
) -> Selection:
    """Select the camera's motion by hand-made cues.

    Args:
        found: the motions of the search.
        prior: the expected motion, if there is one; it takes part as a cue.

    Returns:
        The motion, with what speaks for it.
    """
    candidates = cue_candidates(found)
    motions = to_hypotheses(found, candidates)
    image_scores = cue_scores(compute_cues(found.grid, motions))
    scores = image_scores
    if prior is not None:
        scores = image_scores + prior_scores(motions, prior)
    # a prior may choose the motion, but only the image is evidence that it is right
    best = int(np.argmax(scores))
    evidence = cue_evidence(image_scores, best, motions[best].inlier_ratio)
    return _select_best(found, candidates, scores, evidence)


def cue_evidence(scores: np.ndarray, best: int, inlier_ratio: float) -> CueEvidence:
    """Return the evidence on whether the motion with the best cue scores is right.

    Args:
        scores: (N,) of the motions, by the image alone.
        best: number of the motion.
        inlier_ratio: fraction of the usable pixels that follow it.
    """
    others = np.delete(scores, best)
    explained = float(np.log(inlier_ratio + CUE_MIN_INLIER_RATIO))
    if not len(others):
        return CueEvidence(0.0, 1.0, 0.0, explained)
    margin = min(float(scores[best] - others.max()), MAX_SCORE_MARGIN)
    return CueEvidence(margin, 0.0, explained, 0.0)


@dataclass(frozen=True, eq=False)
class Ranking:
    """A scorer's look at the motions of one field of flow.

    Attributes:
        found: the motions of the search, and their pixels.
        candidates: these motions, and some of them fitted again.
        score: (N,) of the candidates, finite or minus infinity.
        static: (h, w) probability of each pixel to be static if a candidate is the camera's
            motion, for the candidates that were drawn.
        remembered: (N,) what earlier frames added to the scores; None where nothing was known.
    """

    found: HypothesisSet
    candidates: list[Candidate]
    score: np.ndarray
    static: Mapping[int, np.ndarray]
    remembered: np.ndarray | None = None

    @property
    def best(self) -> int:
        """Number of the candidate with the largest score."""
        return int(np.argmax(self.score))

    @property
    def best_score(self) -> float:
        """The largest score, by which looks at several flows are compared."""
        return float(self.score[self.best])

    @property
    def poses(self) -> list[np.ndarray]:
        """(3, 4) ``T_curr_prev`` of the candidates."""
        return [candidate.pose for candidate in self.candidates]

    @property
    def margin(self) -> float:
        """By how much the best score exceeds that of any other motion of this flow."""
        if is_alone_without_images(self.found):
            return MAX_SCORE_MARGIN
        return score_margin(self.found, self.poses, self.score)

    def mask_of(self, number: int) -> np.ndarray | None:
        """(h, w) weights of a candidate's static pixels, with which it is fitted to the end.

        A motion of the search gets the mask that was drawn for it; where that leaves too little,
        the pixels that follow it.
        """
        candidate = self.candidates[number]
        if candidate.mask is not None:
            return candidate.mask
        drawn = self.static.get(number)
        if drawn is not None:
            mask = mask_weights(drawn)
            if mask_coverage(self.found.grid, mask) >= MIN_COVERAGE:
                return mask
        return np.asarray(self.described(number).inliers, np.float32)

    def described(self, number: int) -> Hypothesis:
        """A candidate with its inliers."""
        return to_hypotheses(self.found, [self.candidates[number]])[0]


def surest(rankings: Sequence[Ranking]) -> Ranking:
    """Return the look that has the largest score of all."""
    return max(rankings, key=lambda ranking: ranking.best_score)


def margin_of(rankings: Sequence[Ranking]) -> float:
    """Return by how much the best score exceeds that of any other motion of any flow."""
    if len(rankings) == 1:
        return rankings[0].margin
    poses = [pose for ranking in rankings for pose in ranking.poses]
    scores = np.concatenate([ranking.score for ranking in rankings])
    return score_margin(surest(rankings).found, poses, scores)


def is_alone_without_images(found: HypothesisSet) -> bool:
    """Whether one motion explains nearly all flow of a pair without images.

    PWVO was trained on none of these, and scores them as "none of them".
    """
    return found.is_complete and not found.pair.has_images


def select_from(rankings: Sequence[Ranking]) -> Selection:
    """Select the camera's motion from the looks at all flows of a pair.

    What was found in one flow stays a rival of what is found in another one.

    Args:
        rankings: a look at each flow so far, in the order of the flows.

    Returns:
        The motion with the largest score, with the mask to fit it in, and the evidence on the
        choice.
    """
    chosen = surest(rankings)
    evidence = evidence_on_choice(rankings)
    return _select_best(
        chosen.found,
        chosen.candidates,
        chosen.score,
        evidence,
        chosen.mask_of(chosen.best),
        chosen.remembered,
    )


def evidence_on_choice(rankings: Sequence[Ranking]) -> ChoiceEvidence:
    """Return what speaks for the motion that is selected from looks at all flows so far."""
    look = surest(rankings)
    rival = best_rival(rankings)
    return ChoiceEvidence(
        margin=margin_of(rankings),
        first_margin=rankings[0].margin,
        log_share=_log_share(look, look.best),
        log_rival_share=_log_share(*rival) if rival else float(np.log(LEAST_SHARE)),
    )


def _log_share(look: Ranking, number: int) -> float:
    """Log of the fraction of the view that follows a candidate."""
    share = np.mean(look.described(number).inliers)
    return float(np.log(share + LEAST_SHARE))


def select_rival(
    rankings: Sequence[Ranking],
) -> tuple[Ranking, Selection] | None:
    """Select the best motion that differs from the one of :func:`select_from`.

    Its evidence is that on the choice with the parts of both exchanged.

    Args:
        rankings: a look at each flow so far.

    Returns:
        The look in which it was found, and the motion with the mask to fit it in; None where
        there is no other one.
    """
    rival = best_rival(rankings)
    if rival is None:
        return None
    look, number = rival
    on_choice = evidence_on_choice(rankings)
    evidence = ChoiceEvidence(
        -on_choice.margin,
        -on_choice.first_margin,
        on_choice.log_rival_share,
        on_choice.log_share,
    )
    candidate = look.candidates[number]
    mask = look.mask_of(number)
    return look, Selection(
        T_curr_prev=pose_matrix(candidate.pose),
        noise=Noise(*candidate.noise),
        mask=mask,
        coverage=mask_coverage(look.found.grid, mask),
        evidence=evidence,
        iterations=candidate.iterations,
    )


def best_rival(rankings: Sequence[Ranking]) -> tuple[Ranking, int] | None:
    """Return the best motion that differs from the one selected, by its look and number there;
    None where there is none.
    """
    chosen = surest(rankings)
    everyone = [
        (r, number) for r in rankings for number in range(len(r.candidates))
    ]
    poses = [ranking.poses[number] for ranking, number in everyone]
    scores = np.array([ranking.score[number] for ranking, number in everyone])
    away = distances(chosen.found.grid, poses, int(np.argmax(scores)))
    rivals = np.flatnonzero(away > DISTINCT_MOTION_PX)
    if not len(rivals):
        return None
    return everyone[rivals[np.argmax(scores[rivals])]]


def rank_by_scorer(
    found: HypothesisSet,
    scorer: Scorer,
    options: Options,
    belief: Belief | None = None,
) -> Ranking:
    """Score the motions of the search, fit the best again in their masks, and score these.

    Args:
        found: the motions of the search.
        scorer: of this pair.
        options: the option tree, of which ``select.refits`` matters.
        belief: what earlier frames have shown of the pixels; it adds to all scores.
    """
    candidates = search_candidates(found)
    first = scorer(candidates, options.select.refits)
    score = first.score
    refits = _refit(found, candidates, first.refits)
    if refits:
        candidates += refits
        score = scorer(candidates, 0).score
    remembered = None
    if belief is not None:
        inliers = [each.inliers for each in to_hypotheses(found, candidates)]
        remembered = memory_scores(found, inliers, belief)
        score = score + remembered
    static = {number: start.static for number, start in first.refits.items()}
    finite = np.nan_to_num(score, nan=-np.inf)
    return Ranking(found, candidates, finite, static, remembered)


def search_candidates(found: HypothesisSet) -> list[Candidate]:
    """The motions of the search as candidates, each its own parent."""
    return [
        motion._replace(parent=number)
        for number, motion in enumerate(found.motions)
    ]


def cue_candidates(found: HypothesisSet) -> list[Candidate]:
    """The winners of the search's rounds: the cues compare motions without common pixels."""
    return [
        candidate
        for candidate in search_candidates(found)
        if candidate.source is not MotionSource.RUNNER_UP
    ]


def _refit(
    found: HypothesisSet,
    candidates: Sequence[Candidate],
    starts: Mapping[int, RefitStart],
) -> list[Candidate]:
    """Fit candidates inside their masks; without those whose mask leaves too little."""
    grid = found.grid
    refits = []
    for number, start in starts.items():
        mask = mask_weights(start.static)
        if mask_coverage(grid, mask) < MIN_COVERAGE:
            continue
        refit = fit_in_mask(grid.samples, mask, grid.K, start.pose, found.cutoff)
        if np.isfinite(refit.pose).all() and refit.inlier_ratio > 0:
            parent = candidates[number].parent
            refits.append(refit._replace(parent=parent, mask=mask))
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
        noise = kernels.residual_noise(
            max(candidate.flow_noise_px, MIN_INLIER_NOISE_PX),
            candidate.depth_noise,
            found.cutoff,
        )
        inliers = kernels.robust_weights(
            grid.samples, grid.count, candidate.pose, grid.K, noise
        )
        hypothesis = Hypothesis(
            T_curr_prev=pose_matrix(candidate.pose),
            source=candidate.source.value,
            inlier_ratio=mask_coverage(grid, inliers),
            flow_noise_px=candidate.flow_noise_px,
            depth_noise=candidate.depth_noise,
            inliers=inliers.reshape(grid.shape[:2]),
        )
        described.append(hypothesis)
    return described


def _select_best(
    found: HypothesisSet,
    candidates: Sequence[Candidate],
    scores: np.ndarray,
    evidence: tuple[float, ...],
    mask: np.ndarray | None = None,
    remembered: np.ndarray | None = None,
) -> Selection:
    """Select the candidate with the largest score; one without a finite score is last."""
    score = np.nan_to_num(scores, nan=-np.inf)
    order = np.argsort(-score, kind="stable")
    described = to_hypotheses(found, candidates)
    known = np.zeros(len(score)) if remembered is None else remembered
    hypotheses = [
        replace(described[k], score=float(score[k]), remembered=float(known[k]))
        for k in order
    ]
    best = candidates[order[0]]
    return Selection(
        T_curr_prev=pose_matrix(best.pose),
        noise=Noise(*best.noise),
        mask=mask,
        coverage=mask_coverage(found.grid, mask),
        evidence=evidence,
        hypotheses=tuple(hypotheses),
        iterations=best.iterations,
    )
