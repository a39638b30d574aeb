"""Which of the motions found is the camera's, and which pixels are static: by hand-made cues; or by
a scorer that is handed in (a network): the motions are scored, the best are fitted again inside the
static masks that the scorer draws about them, and all are scored once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import (
    CUE_WEIGHTS,
    CUES_RIGHT,
    NO_MOTION,
    SELECTOR_RIGHT,
    UNAMBIGUOUS_RIGHT,
)
from hybridvo.geometry import agreement, pose_matrix
from hybridvo.hypotheses import search
from hybridvo.hypotheses.generate import GridMaps, HypothesisSet, fit_in_mask
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

# of the robust kernel by which inliers are told, standard deviations
SUPPORT_CUTOFF = 3.0
# least noise of the flow there; below it motions are equally sharp
MIN_NOISE_PX = 0.05
# probabilities of being static between which weights grow from 0 to 1
MASK_RAMP = (0.4, 0.9)
MAX_SCORE_MARGIN = (
    # gap of the scores where there is no other motion, and the largest that counts
    8.0
)
# share of the usable weight that a mask must leave for a fit inside it
MIN_COVERAGE = 0.02
# width of the border band, as a share of the image's shorter side; at least a cell
BORDER = 0.06
# inlier ratio, spread of log depth: below, a motion has as good as none
MIN_INLIER_RATIO_LOG = 0.01
FLAT = 0.03
SOURCES = {
    search.SOURCE_WINDOW: "window",
    search.SOURCE_MINIMAL: "minimal",
    search.RUNNER_UP: "runner-up",
    search.SOURCE_REFIT: "refit",
}


class Candidate(NamedTuple):
    """A motion to be scored: of the search, or a refit made inside a mask (h, w)."""

    pose: np.ndarray  # (3, 4) T_curr_prev
    facts: np.ndarray  # see hybridvo.hypotheses.search
    parent: int  # number of the motion of the search that it goes back to
    mask: np.ndarray | None = None


class Scores(NamedTuple):
    """A scorer's answer."""

    # (N,) larger is more likely the camera's motion, NO_MOTION: as none of them
    score: np.ndarray
    # of candidates, best first: probability (h, w) of being static
    static: dict[int, np.ndarray]


Scorer = Callable[[Sequence[Candidate], int], Scores]
"""(candidates, how many masks at most) -> scores; those of an earlier call come first again."""
ScorerFactory = Callable[[GridMaps, MotionPrior | None, np.ndarray | None], Scorer]
"""(pixels, prior, (h, w) probability of being static that another network states) -> scorer."""


def select_by_cues(
    found: HypothesisSet, prior: MotionPrior | None = None
) -> Selection:
    """The motion selected by hand-made cues and what is known of the motion."""
    # the cues compare motions that share no pixels
    apart = [
        c for c in searched(found) if c.facts[search.SOURCE] != search.RUNNER_UP
    ]
    if not found.is_ambiguous:
        return _selection(
            found, apart, np.zeros(1), MAX_SCORE_MARGIN, UNAMBIGUOUS_RIGHT
        )
    motions = hypotheses(found, apart)
    seen = np.sum(
        [CUE_WEIGHTS[k] * value for k, value in cues(found, motions).items()],
        axis=0,
    )
    scores = seen
    if prior is not None:
        near = [
            agreement(m.T_curr_prev, prior.T_curr_prev, prior.covariance)
            for m in motions
        ]
        scores = seen + CUE_WEIGHTS["prior"] * np.array(near)
    # a prior may say which motion; that it is right the image has to say
    best = int(np.argmax(scores))
    gap = min(
        seen[best] - np.delete(seen, best).max(initial=-np.inf), MAX_SCORE_MARGIN
    )
    return _selection(
        found, apart, scores, gap, probability_right((gap,), CUES_RIGHT)
    )


def select_by_scorer(
    found: HypothesisSet,
    look: ScorerFactory,
    options: Options,
    prior: MotionPrior | None = None,
    prediction: MotionPrediction | None = None,
) -> Selection:
    """The motion selected by a scorer and its masks: score, fit again inside masks, score again.

    ``prediction``, of another network: one candidate more, and where it sees the static scene.
    """
    candidates = searched(found)
    static = None
    if not found.is_ambiguous:
        return _selection(
            found, candidates, np.zeros(1), MAX_SCORE_MARGIN, UNAMBIGUOUS_RIGHT
        )
    cutoff = options.refine.cutoff
    if prediction is not None:
        static = found.grid.resample(prediction.static_probability)
        start = prediction.T_curr_prev[:3]
        unit = robust_fit.translation_scale(found.grid.samples, found.grid.count)
        parent = nearest_motion(found.poses, start, unit)
        candidates += _refits(found, [(start, parent, static)], cutoff)
    scorer = look(found.maps(), prior, static)
    scores = scorer(candidates, options.select.refits)
    best = [
        (candidates[k].pose, candidates[k].parent, p)
        for k, p in scores.static.items()
    ]
    if refits := _refits(found, best, cutoff):
        candidates += refits
        scores = scorer(candidates, 0)
    gap = score_margin(found, [c.pose for c in candidates], scores.score)
    return _selection(
        found,
        candidates,
        scores.score,
        gap,
        probability_right((gap,), SELECTOR_RIGHT),
    )


def searched(found: HypothesisSet) -> list[Candidate]:
    """The motions of the search as candidates."""
    return [
        Candidate(found.poses[k], found.facts[k], k)
        for k in range(len(found.poses))
    ]


def _refits(
    found: HypothesisSet,
    entries: Sequence[tuple[np.ndarray, int, np.ndarray]],
    cutoff: float,
) -> list[Candidate]:
    """A fit for each (start, parent, static probability) that leaves enough pixels."""
    refits = []
    for start, parent, static in entries:
        mask = mask_weights(static)
        if _coverage(found, mask) >= MIN_COVERAGE:
            grid = found.grid
            pose, facts = fit_in_mask(grid.samples, mask, grid.K, start, cutoff)
            if np.isfinite(pose).all() and facts[search.SHARE] > 0:
                refits.append(Candidate(pose, facts, parent, mask))
    return refits


def score_margin(
    found: HypothesisSet, poses: Sequence[np.ndarray], score: np.ndarray
) -> float:
    """By how much the best score exceeds that of any other motion, and of none being right."""
    best = int(np.argmax(score))
    apart = search.distances(found.grid, poses, best) > search.OTHER_PX
    return min(
        MAX_SCORE_MARGIN, float(score[best] - score[apart].max(initial=NO_MOTION))
    )


def mask_weights(probability: np.ndarray) -> np.ndarray:
    """Weights of a fit from probabilities of being static."""
    low, high = MASK_RAMP
    return np.clip((probability - low) / (high - low), 0.0, 1.0).astype(np.float32)


def nearest_motion(poses: np.ndarray, pose: np.ndarray, depth_scale: float) -> int:
    """Index of the motion (N, 3, 4) nearest to another (3, 4); metres count 1 / depth radians."""
    # each angle stands twice in a small rotation
    unit = [0.5, 0.5, 0.5, depth_scale**2]
    return int(np.argmin(((poses - pose) ** 2 * unit).sum(axis=(1, 2))))


def hypotheses(
    found: HypothesisSet, candidates: Sequence[Candidate]
) -> list[Hypothesis]:
    """The candidates with their inliers, in their order."""
    grid = found.grid
    K = found.grid.K
    made = []
    for pose, facts, *_ in candidates:
        sf = float(facts[search.FLOW_NOISE])
        sd = float(facts[search.DEPTH_NOISE])
        noise = kernels.residual_noise(max(sf, MIN_NOISE_PX), sd, SUPPORT_CUTOFF)
        inliers = kernels.robust_weights(grid.samples, grid.count, pose, K, noise)
        source = SOURCES.get(int(facts[search.SOURCE]), "start")
        share = _coverage(found, inliers)
        T = pose_matrix(pose)
        maps = inliers.reshape(grid.shape[:2])
        made.append(Hypothesis(T, source, share, sf, sd, maps))
    return made


def _coverage(found: HypothesisSet, mask: np.ndarray | None) -> float:
    """Share of the usable pixels' weight that a mask leaves."""
    weight = found.grid.weight
    total = max(float(weight.sum()), 1e-9)
    return 1.0 if mask is None else float(weight @ mask.reshape(-1)) / total


def _selection(
    found: HypothesisSet,
    candidates: Sequence[Candidate],
    scores: np.ndarray,
    gap: float,
    probability: float,
) -> Selection:
    """The candidate with the largest score."""
    score = np.nan_to_num(scores, nan=-np.inf)
    order = np.argsort(-score, kind="stable")
    pose, facts, _, mask = candidates[order[0]]
    motions = hypotheses(found, candidates)
    return Selection(
        T_curr_prev=pose_matrix(pose),
        noise=Noise(
            float(facts[search.FLOW_NOISE]), float(facts[search.DEPTH_NOISE])
        ),
        mask=mask,
        coverage=_coverage(found, mask),
        evidence=(gap,),
        probability=float(np.nan_to_num(probability)),
        hypotheses=tuple(replace(motions[k], score=float(score[k])) for k in order),
        iterations=int(facts[search.ITERATIONS]),
    )


def cues(
    found: HypothesisSet, motions: Sequence[Hypothesis]
) -> dict[str, np.ndarray]:
    """(N,) of each hand-made cue; their weighted sum is the log odds to be the camera's motion.

    Objects are compact, in depth as well, and mostly inside the image. The static scene is behind,
    deep, reaches the border and is as sharply rigid as the flow allows (a compromise between two
    motions is not).
    """
    usable, (h, w, _) = np.flatnonzero(found.grid.weight > 0), found.grid.shape
    inliers = np.stack([m.inliers.ravel()[usable] for m in motions]).astype(
        np.float64
    )
    held = np.maximum(inliers.sum(axis=1), 1e-9)
    border = np.ones((h, w), np.bool_)
    band = max(1, round(BORDER * min(h, w)))
    border[band:-band, band:-band] = False
    border = border.ravel()[usable]
    log_depth = np.log(found.grid.samples[kernels.Z, usable])
    depth = inliers @ log_depth / held
    extent = [
        x @ (log_depth - z) ** 2 for x, z in zip(inliers, depth, strict=True)
    ] / held
    return {
        "share": np.log(held / max(len(usable), 1) + MIN_INLIER_RATIO_LOG),
        "border": np.log(
            inliers[:, border].sum(axis=1) / max(border.sum(), 1)
            + MIN_INLIER_RATIO_LOG
        ),
        "extent": 0.5 * np.log(extent + FLAT**2),
        "behind": depth,
        "noise": np.log([max(m.flow_noise_px, MIN_NOISE_PX) for m in motions]),
    }
