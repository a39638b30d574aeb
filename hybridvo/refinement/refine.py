"""The refinement: metric camera motion with covariance from flow, depth and intrinsics.

Finds every strong motion on a coarse grid (:mod:`hybridvo.hypotheses.search`), lets a judge say
which one
is the world (:mod:`hybridvo.hypotheses.cues`), and fits that one on the full grid with noise scales
estimated from the data. It minimises the ego-flow reprojection error (paper, equations 6 and 8)
under a Geman-McClure kernel of the Mahalanobis distance, with the depth noise propagated into each
pixel's covariance.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from hybridvo.baselines.correspondences import DOUBTFUL_INLIER_RATIO
from hybridvo.checks import as_rigid, as_seed, to_numpy
from hybridvo.errors import InputError
from hybridvo.geometry import pose_matrix
from hybridvo.hypotheses import search
from hybridvo.hypotheses.confidence import REFERENCE_WIDTH, probability_right
from hybridvo.hypotheses.cues import CueGrid, Judge, default_judge
from hybridvo.hypotheses.generate import SOURCE_MASK, CoarseSearch, search_motions
from hybridvo.hypotheses.selector import Decision, Expected, PictureJudge, decide
from hybridvo.refinement import kernels, solver
from hybridvo.refinement.full_fit import FullFit, fit_full_grid
from hybridvo.refinement.options import RefinementOptions
from hybridvo.refinement.readiness import compile_refinement
from hybridvo.types import FramePair, Hypothesis, PairBatch, Reason, RelativePose, Status

if TYPE_CHECKING:
    from hybridvo.pose.batched import BatchedPose

__all__ = ["RefinementOptions", "refine"]

WEAK_RATIO = 2e-5
"""Ratio of the information's extreme eigenvalues below which errors that neighbours share, and that
the covariance of one small patch cannot know of, decide a direction: degraded. A frontal plane over
a field of view of 20 degrees has 1e-4, a patch of 20 px at fx = 1120 has 1e-5."""
SUPPORT_CUTOFF = 3.0
TRUSTED = 0.85
"""Probability of being right below which an answer is degraded: on development seeds 9 of the 17
wrong answers that were judged and 12 of 870 right ones."""

SOURCES = {
    0: "identity",
    search.SOURCE_WINDOW: "window",
    search.SOURCE_MINIMAL: "minimal",
    SOURCE_MASK: "second-look",
}
"""Names of the starts; the others were handed in."""


@overload
def refine(
    pair: FramePair,
    T_init: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    *,
    T_last: np.ndarray | None = None,
    T_last_covariance: np.ndarray | None = None,
    options: RefinementOptions | None = None,
    judge: Judge | PictureJudge = default_judge,
    seed: int = 0,
) -> RelativePose: ...


@overload
def refine(pair: PairBatch, T_init: Any = None, weights: Any = None) -> BatchedPose: ...


def refine(
    pair: FramePair | PairBatch,
    T_init: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    *,
    T_last: np.ndarray | None = None,
    T_last_covariance: np.ndarray | None = None,
    options: RefinementOptions | None = None,
    judge: Judge | PictureJudge = default_judge,
    seed: int = 0,
) -> RelativePose | BatchedPose:
    """Camera motion of a pair by robust dense reprojection, without any network.

    Args:
        pair: a :class:`FramePair` (numpy), or a :class:`PairBatch` (torch) for the batched,
            differentiable path, see :func:`hybridvo.pose.batched.refine_batch`.
        T_init: (4, 4) or (S, 4, 4) T_curr_prev, starts beside the identity (a network's seeds).
        weights: (H, W) factors on the information of each pixel; 0 and NaN switch a pixel off.
        T_last: (4, 4) the last camera motion, or the one expected: one more start, and a cue for
            the judge.
        T_last_covariance: (6, 6) of ``Exp(delta) T_last``, translation first, m^2 and rad^2: how
            far the motion may be from it; a judge of pixels weighs it.
        options: see :class:`RefinementOptions`.
        judge: chooses the world among the motions found, by their cues (larger score wins) or, a
            :class:`hybridvo.hypotheses.selector.PictureJudge`, by looking at each pixel.
        seed: of the minimal samples; the same seed gives the same bytes.

    Returns:
        The motion with covariance, status, per-pixel weights and every motion found (for a
        :class:`PairBatch` a :class:`hybridvo.pose.batched.BatchedPose`). Bad data give
        a failed status, never an exception and never a value that is not finite.

    Raises:
        InputError: an argument of another kind or shape, a start that is no rigid transform, a
            seed that no generator takes.
    """
    if isinstance(pair, PairBatch):
        from hybridvo.pose.batched import refine_batch

        return refine_batch(pair, T_init=T_init, weights=weights)
    started = time.perf_counter()
    if not isinstance(pair, FramePair):
        raise InputError(f"refine: expected a FramePair or a PairBatch, got {type(pair).__name__}.")
    if not (callable(judge) or isinstance(judge, PictureJudge)):
        raise InputError(f"refine.judge: expected a callable or a PictureJudge, got {judge!r}.")
    seed = as_seed(seed, "refine.seed")
    options = options or RefinementOptions()
    T_last = None if T_last is None else as_rigid(T_last, "refine.T_last")
    starts = _starts(T_init, T_last)
    if weights is not None and np.shape(weights) != pair.prev.camera.shape:
        raise InputError(
            f"refine: expected weights of shape {pair.prev.camera.shape}, got {np.shape(weights)}."
        )
    if T_last_covariance is not None:
        T_last_covariance = to_numpy(T_last_covariance, "refine.T_last_covariance")
        if T_last_covariance.shape != (6, 6) or T_last_covariance.dtype.kind not in "fiu":
            raise InputError(
                f"refine.T_last_covariance: expected numbers of shape (6, 6), got "
                f"{T_last_covariance.dtype} of shape {T_last_covariance.shape}."
            )
    expected = None if T_last is None else Expected(T_last, T_last_covariance)
    result = _refine(pair, starts, weights, expected, options, judge, seed)
    return result.replace(ms=1e3 * (time.perf_counter() - started))


def _starts(T_init: np.ndarray | None, T_last: np.ndarray | None) -> np.ndarray:
    """(S, 3, 4) starts: identity, the last motion, the handed-in ones."""
    poses = [np.eye(4)]
    if T_last is not None:
        poses.append(T_last)
    if T_init is not None:
        stack = to_numpy(T_init, "refine.T_init")
        if stack.ndim not in (2, 3) or stack.shape[-2:] != (4, 4):
            raise InputError(
                f"refine.T_init: expected (4, 4) or (S, 4, 4) transforms, got shape {stack.shape}."
            )
        poses += [as_rigid(T, "refine.T_init") for T in stack.reshape(-1, 4, 4)]
    return np.ascontiguousarray(np.stack(poses)[:, :3, :])


def _refine(
    pair: FramePair,
    starts: np.ndarray,
    weights: np.ndarray | None,
    expected: Expected | None,
    options: RefinementOptions,
    judge: Judge | PictureJudge,
    seed: int,
) -> RelativePose:
    if pair.flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "no optical flow for this pair", "refine")
    if pair.prev.depth is None:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, "no depth for this frame", "refine")
    compile_refinement()
    found = search_motions(pair, starts, weights, options, seed)
    if isinstance(found, RelativePose):
        return found
    poses, facts = found.poses, found.facts
    by_cues = default_judge if isinstance(judge, PictureJudge) else judge
    T_last = None if expected is None else expected.T_curr_prev
    hypotheses = _hypotheses(found, poses, facts, T_last, by_cues)
    scores = np.array([h.score for h in hypotheses])
    best = int(np.argmax(scores))
    decision, picture, samples = None, found.picture, found.samples
    if isinstance(judge, PictureJudge) and not found.clear:
        decision = decide(judge, found, pair, scores, expected, options)
        poses, facts, best = decision.poses, decision.facts, decision.best
        hypotheses += _hypotheses(found, poses[len(scores) :], facts[len(scores) :], T_last)
        scores = decision.score
        hypotheses = [replace(h, score=float(s)) for h, s in zip(hypotheses, scores, strict=True)]
        if decision.mask is not None:
            picture, samples = found.masked(pair, weights, decision.mask)
    fit = fit_full_grid(
        pair,
        picture,
        samples,
        found.shape,
        poses[best],
        (facts[best, search.FLOW_NOISE], facts[best, search.DEPTH_NOISE]),
        found.depth_scale,
        options,
    )
    if decision is not None and decision.mask is not None:
        # the share of all pixels, not of those that the mask left
        fit = replace(fit, share=fit.share * decision.kept)
    order = [best, *(int(k) for k in np.argsort(-scores, kind="stable") if k != best)]
    hypotheses = [hypotheses[k] for k in order]
    return _result(pair, found, fit, int(facts[best, search.ITERATIONS]), hypotheses, decision)


def _hypotheses(
    found: CoarseSearch,
    poses: np.ndarray,
    facts: np.ndarray,
    T_last: np.ndarray | None,
    judge: Judge | None = None,
) -> list[Hypothesis]:
    """Support, cues and scores (0 without a judge) of motions, in their order."""
    h, w, stride = found.shape
    n = found.count
    work = solver.new_work()
    noise = np.empty(3, np.float32)
    usable = (found.samples[kernels.W, :n] > 0).reshape(h, w)
    grid = CueGrid(usable, found.samples[kernels.Z, :n].reshape(h, w))
    motions = []
    for pose, fact in zip(poses, facts, strict=True):
        weights = np.empty(n, np.float32)
        sf, sd = fact[search.FLOW_NOISE], fact[search.DEPTH_NOISE]
        solver.set_noise(max(sf, 0.05), sd, SUPPORT_CUTOFF, noise)
        solver.robust_weights(found.samples, n, pose, found.picture.K, noise, work, weights)
        support = weights.reshape(h, w)
        T = pose_matrix(pose)
        name = SOURCES.get(int(fact[search.SOURCE]), "handed-in")
        motions.append((T, support, name, grid.cues(support, T, T_last, sf)))
    scores = np.zeros(len(motions))
    if judge is not None:
        scores = np.asarray(judge([m[3] for m in motions]), dtype=np.float64)
    return [
        Hypothesis(T, support, stride, cue["share"], float(score), name, cue)
        for (T, support, name, cue), score in zip(motions, scores, strict=True)
    ]


def _result(
    pair: FramePair,
    found: CoarseSearch,
    fit: FullFit,
    iterations: int,
    hypotheses: list[Hypothesis],
    decision: Decision | None,
) -> RelativePose:
    """Status, and everything in the units and on the grid of the caller."""
    height, width = pair.prev.camera.shape
    box = found.box
    weights = fit.weights
    if box != (0, height, 0, width):
        weights = np.zeros((height, width), np.float32)
        weights[box[0] : box[1], box[2] : box[3]] = fit.weights
    T = pose_matrix(fit.pose) if np.isfinite(fit.pose).all() else np.eye(4)
    common: dict[str, Any] = {
        "method": "refine",
        "terms": ("flow", "depth") if fit.uses_second_depth else ("flow",),
        "inlier_ratio": float(min(1.0, fit.share)),
        "iterations": iterations + fit.iterations,
        "cost": fit.cost,
        "residual_scale_px": fit.flow_noise,
        "depth_noise": fit.depth_noise,
        "weights": weights,
        "information_eigenvalues": fit.eigenvalues,
        "hypotheses": tuple(hypotheses),
    }
    if not fit.definite or not np.isfinite(fit.pose).all():
        return RelativePose.failed(
            Reason.DEGENERATE_GEOMETRY,
            "the pixels leave a direction of the motion undetermined",
            **common,
        )
    if fit.weight < 6 or fit.share < 0.02:
        return RelativePose.failed(
            Reason.LOW_INLIERS, f"{100 * fit.share:.1f} % of the pixels follow one motion", **common
        )
    if fit.depths is not None and fit.depths.is_none:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, fit.depths.doubt, **common)
    noise_px = common["residual_scale_px"] * REFERENCE_WIDTH / width
    spread = np.sqrt(max(np.linalg.eigvalsh(fit.covariance[:3, :3])[-1], 0.0))
    return RelativePose(
        T_curr_prev=T,
        covariance=fit.covariance,
        status=_status(fit, hypotheses, decision, noise_px),
        translation_direction_valid=bool(np.linalg.norm(T[:3, 3]) > 3 * spread),
        **common,
    )


def _status(
    fit: FullFit, hypotheses: list[Hypothesis], decision: Decision | None, noise_px: float
) -> Status:
    """Ok, or degraded with the reason."""
    share = fit.share
    if fit.depths is not None and fit.depths.doubt:
        return Status.degraded(Reason.NO_VALID_DEPTH, fit.depths.doubt)
    if decision is not None:
        probability = probability_right(decision.trust, noise_px, share)
        if probability < TRUSTED:
            return Status.degraded(
                Reason.AMBIGUOUS_MOTION,
                f"which motion is the world is uncertain (probability of being right "
                f"{100 * probability:.0f} %)",
            )
    elif len(hypotheses) > 1:
        first, second = hypotheses[0], hypotheses[1]
        if first.score - second.score < 0.15 and second.share > 0.5 * first.share:
            return Status.degraded(
                Reason.AMBIGUOUS_MOTION,
                f"two motions could be the world ({100 * first.share:.0f} % and "
                f"{100 * second.share:.0f} % of the pixels)",
            )
    if fit.eigenvalues[0] < WEAK_RATIO * fit.eigenvalues[-1]:
        return Status.degraded(
            Reason.DEGENERATE_GEOMETRY, "a direction of the motion is barely determined"
        )
    if fit.is_narrow:
        return Status.degraded(
            Reason.DEGENERATE_GEOMETRY,
            "the pixels cover too little of the picture to tell how far their errors agree",
        )
    if share < DOUBTFUL_INLIER_RATIO:
        return Status.degraded(
            Reason.LOW_INLIERS, f"only {100 * share:.0f} % of the pixels follow the motion"
        )
    return Status()
