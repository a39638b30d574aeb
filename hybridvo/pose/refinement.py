"""The refinement: metric camera motion with covariance from flow, depth and intrinsics.

Finds every strong motion on a coarse grid (:mod:`hybridvo.pose.search`), lets a judge say which one
is the world (:mod:`hybridvo.pose.judgement`), and fits that one on the full grid with noise scales
estimated from the data. It minimises the ego-flow reprojection error (paper, equations 6 and 8)
under a Geman-McClure kernel of the Mahalanobis distance, with the depth noise propagated into each
pixel's covariance.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import pose_matrix
from hybridvo.pose import kernels, search, solver
from hybridvo.pose.judgement import Judge, cues, default_judge
from hybridvo.types import Camera, FramePair, Hypothesis, PairBatch, Reason, RelativePose, Status

__all__ = ["RefinementOptions", "refine"]

PARALLEL_PIXELS = 100_000
"""Below this many pixels the serial kernel is as fast and steadier under load."""
SUPPORT_CUTOFF = 3.0


@dataclass(frozen=True)
class RefinementOptions:
    """Options of :func:`refine`.

    Args:
        cutoff: c of the Geman-McClure kernel, in standard deviations. 3 keeps 93 % of the efficiency
            under Gaussian noise; the influence of a pixel falls from 1.7 standard deviations on.
        search_pixels: pixels of the grid on which starts are made and scored.
        coarse_pixels: pixels of the grid on which motions are fitted before the full one.
        full_steps: Gauss-Newton steps on the full grid (0: the coarse result stands).
        decisive_share: share of the usable pixels above which the first motion stands alone.
        least_share: smallest share of a further motion.
        hypotheses: largest number of motions.
        minimum_pixels: fewer usable pixels are a failure.
        tile: side of the tiles, px, within which errors may be correlated (sandwich covariance).
    """

    cutoff: float = 3.0
    search_pixels: int = 1800
    coarse_pixels: int = 7500
    full_steps: int = 2
    decisive_share: float = 0.85
    least_share: float = 0.06
    hypotheses: int = 5
    minimum_pixels: int = 24
    tile: int = 32

    def __post_init__(self) -> None:
        for name in ("cutoff", "search_pixels", "coarse_pixels", "minimum_pixels", "tile"):
            if not getattr(self, name) > 0:
                raise InputError(
                    f"RefinementOptions.{name}: expected a positive number, "
                    f"got {getattr(self, name)!r}."
                )
        if not 1 <= self.hypotheses <= 16:
            raise InputError(
                f"RefinementOptions.hypotheses: expected 1 to 16, got {self.hypotheses}."
            )


class _Picture:
    """The arrays of a pair as the kernels take them, cropped to the usable pixels if these are few."""

    def __init__(self, pair: FramePair, weights: np.ndarray | None) -> None:
        prev, curr = pair.prev, pair.curr
        assert pair.flow is not None and prev.depth is not None
        flags = 0
        dummy = np.ones((1, 1), np.float32)
        depth = np.ascontiguousarray(prev.depth)
        flow = np.ascontiguousarray(pair.flow)
        flow_variance = depth_variance = external = dummy
        scale = np.ones(2, np.float32)
        if pair.flow_variance is not None:
            flow_variance = np.ascontiguousarray(pair.flow_variance)
            flags |= kernels.HAS_FLOW_VARIANCE
            scale[0] = _typical(flow_variance)
        if prev.depth_variance is not None:
            depth_variance = np.ascontiguousarray(prev.depth_variance)
            flags |= kernels.HAS_DEPTH_VARIANCE
            scale[1] = _typical(depth_variance)
        if weights is not None:
            external = np.ascontiguousarray(weights, dtype=np.float32)
            flags |= kernels.HAS_WEIGHTS
        valid = np.ones((1, 1), np.bool_)
        masks = [m for m in (prev.mask, pair.flow_valid) if m is not None]
        if masks:
            valid = np.ascontiguousarray(masks[0] if len(masks) == 1 else masks[0] & masks[1])
            flags |= kernels.HAS_VALID
        self.data = (depth, flow, flow_variance, depth_variance, external, valid)
        self.flags, self.scale = flags, scale
        self.set_cameras(prev.camera, curr.camera, 0, 0)

    def set_cameras(self, prev: Camera, curr: Camera, u0: int, v0: int) -> None:
        """Intrinsics for a crop whose top-left pixel is (u0, v0)."""
        self.camera = np.array([1 / prev.fx, 1 / prev.fy, prev.cx - u0, prev.cy - v0], np.float32)
        self.K = np.array([curr.fx, curr.fy, curr.cx - u0, curr.cy - v0], np.float32)

    def crop(self, prev: Camera, curr: Camera, box: tuple[int, int, int, int]) -> None:
        """Restrict to rows v0..v1-1 and columns u0..u1-1."""
        v0, v1, u0, u1 = box
        self.data = tuple(
            np.ascontiguousarray(a[v0:v1, u0:u1]) if a.shape[:2] != (1, 1) else a for a in self.data
        )
        self.set_cameras(prev, curr, u0, v0)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.data[0].shape

    def samples(self, pixels: int) -> tuple[np.ndarray, int, int, int]:
        """(buffer, h, w, stride) of a regular grid of about ``pixels`` pixels."""
        height, width = self.shape
        stride = max(1, round(np.sqrt(height * width / pixels)))
        h = (height - stride // 2 + stride - 1) // stride
        w = (width - stride // 2 + stride - 1) // stride
        n = h * w
        # an odd number of cache lines keeps the rows out of each other's cache sets
        buffer = np.empty((kernels.BUFFER_ROWS, ((n + 15) // 16 | 1) * 16), np.float32)
        kernels.gather_grid(stride, self.data, self.camera, self.flags, self.scale, buffer)
        return buffer, h, w, stride

    def usable_box(self) -> tuple[int, tuple[int, int, int, int]]:
        """(number of usable pixels, their bounding box) of the full grid."""
        depth, flow, flow_variance, depth_variance, weights, valid = self.data
        with np.errstate(invalid="ignore"):
            usable = (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
            usable &= (np.abs(flow) < kernels.MAX_VALUE).all(axis=2)
            if self.flags & kernels.HAS_FLOW_VARIANCE:
                usable &= (flow_variance > 0) & (flow_variance < kernels.MAX_VALUE)
            if self.flags & kernels.HAS_DEPTH_VARIANCE:
                usable &= (depth_variance >= 0) & (depth_variance < kernels.MAX_VALUE)
            if self.flags & kernels.HAS_WEIGHTS:
                usable &= (weights > 0) & (weights < kernels.MAX_VALUE)
        if self.flags & kernels.HAS_VALID:
            usable &= valid
        count = int(np.count_nonzero(usable))
        if count == 0:
            return 0, (0, 0, 0, 0)
        rows = np.flatnonzero(usable.any(axis=1))
        columns = np.flatnonzero(usable.any(axis=0))
        return count, (rows[0], rows[-1] + 1, columns[0], columns[-1] + 1)


def _typical(variance: np.ndarray) -> float:
    """Median of the positive finite values on a sparse grid; 1 where there are none."""
    sparse = variance[::7, ::7]
    good = sparse[(sparse > 0) & (sparse < kernels.MAX_VALUE)]
    return float(np.median(good)) if good.size else 1.0


def refine(
    pair: FramePair | PairBatch,
    T_init: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    *,
    T_last: np.ndarray | None = None,
    options: RefinementOptions | None = None,
    judge: Judge = default_judge,
    seed: int = 0,
) -> RelativePose:
    """Camera motion of a pair by robust dense reprojection, without any network.

    Args:
        pair: a :class:`FramePair` (numpy), or a :class:`PairBatch` (torch) for the batched,
            differentiable path, see :func:`hybridvo.pose.batched.refine_batch`.
        T_init: (4, 4) or (S, 4, 4) T_curr_prev, starts beside the identity (a network's seeds).
        weights: (H, W) factors on the information of each pixel; 0 and NaN switch a pixel off.
        T_last: (4, 4) the last camera motion: one more start, and a cue for the judge.
        options: see :class:`RefinementOptions`.
        judge: chooses the world among the motions found; larger score wins.
        seed: of the minimal samples; the same seed gives the same bytes.

    Returns:
        The motion with covariance, status, per-pixel weights and every motion found. Bad data give
        a failed status, never an exception and never a value that is not finite.

    Raises:
        InputError: a start or weights of the wrong shape, or starts that are not finite.
    """
    if isinstance(pair, PairBatch):
        from hybridvo.pose.batched import refine_batch

        return refine_batch(pair, T_init=T_init, weights=weights)
    started = time.perf_counter()
    options = options or RefinementOptions()
    starts = _starts(T_init, T_last)
    if weights is not None and np.shape(weights) != pair.prev.camera.shape:
        raise InputError(
            f"refine: expected weights of shape {pair.prev.camera.shape}, got {np.shape(weights)}."
        )
    result = _refine(pair, starts, weights, T_last, options, judge, seed)
    return result.replace(ms=1e3 * (time.perf_counter() - started))


def _starts(T_init: np.ndarray | None, T_last: np.ndarray | None) -> np.ndarray:
    """(S, 3, 4) starts: identity, the last motion, the handed-in ones."""
    poses = [np.eye(4)[None]]
    for name, value in (("T_last", T_last), ("T_init", T_init)):
        if value is None:
            continue
        value = np.asarray(value, dtype=np.float64)
        if value.shape[-2:] != (4, 4) or value.ndim not in (2, 3) or not np.isfinite(value).all():
            raise InputError(
                f"refine: expected {name} as finite (4, 4) or (S, 4, 4) transforms, "
                f"got shape {value.shape}."
            )
        poses.append(value.reshape(-1, 4, 4))
    return np.ascontiguousarray(np.concatenate(poses)[:, :3, :])


def _refine(
    pair: FramePair,
    starts: np.ndarray,
    weights: np.ndarray | None,
    T_last: np.ndarray | None,
    options: RefinementOptions,
    judge: Judge,
    seed: int,
) -> RelativePose:
    if pair.flow is None:
        return RelativePose.failed(Reason.NO_FLOW, "no optical flow for this pair", "refine")
    if pair.prev.depth is None:
        return RelativePose.failed(Reason.NO_VALID_DEPTH, "no depth for this frame", "refine")
    picture = _Picture(pair, weights)
    coarse, h, w, stride = picture.samples(options.coarse_pixels)
    usable = np.count_nonzero(coarse[kernels.W, : h * w] > 0)
    box = (0, picture.shape[0], 0, picture.shape[1])
    if usable < 0.1 * h * w or usable < 400:
        # few usable pixels: look at all of them, and at a finer grid where they are
        count, box = picture.usable_box()
        if count < options.minimum_pixels:
            return _too_few(pair, count, options.minimum_pixels)
        picture.crop(pair.prev.camera, pair.curr.camera, box)
        coarse, h, w, stride = picture.samples(options.coarse_pixels)
    n = h * w
    small, sh, sw, _ = picture.samples(options.search_pixels)
    coarse_weight = coarse[kernels.W].copy()
    depth_scale = search.translation_scale(coarse, n, picture.K)
    poses = np.zeros((options.hypotheses, 3, 4))
    facts = np.zeros((options.hypotheses, search.FACTS))
    found = search.find_motions(
        small,
        sh,
        sw,
        coarse,
        n,
        picture.K,
        starts,
        options.cutoff,
        options.decisive_share,
        options.least_share,
        options.hypotheses,
        depth_scale,
        seed,
        poses,
        facts,
    )
    coarse[kernels.W] = coarse_weight
    if found == 0:
        return RelativePose.failed(
            Reason.DEGENERATE_GEOMETRY, "the pixels do not determine any motion", "refine"
        )
    hypotheses = _hypotheses(
        picture, coarse, h, w, stride, poses[:found], facts[:found], T_last, judge, len(starts)
    )
    order = sorted(range(found), key=lambda k: -hypotheses[k].score)
    hypotheses = [hypotheses[k] for k in order]
    best = order[0]
    return _finish(
        pair, picture, coarse, n, poses[best], facts[best], hypotheses, options, depth_scale, box
    )


def _too_few(pair: FramePair, count: int, minimum: int) -> RelativePose:
    """The failure that names what is missing."""
    depth, flow = pair.prev.depth, pair.flow
    assert depth is not None and flow is not None
    with np.errstate(invalid="ignore"):
        depths = int(np.count_nonzero((depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)))
        flows = int(np.count_nonzero((np.abs(flow) < kernels.MAX_VALUE).all(axis=2)))
    if depths < minimum:
        return RelativePose.failed(
            Reason.NO_VALID_DEPTH, f"{depths} pixels with valid depth, {minimum} needed", "refine"
        )
    if flows < minimum:
        return RelativePose.failed(
            Reason.NO_FLOW, f"{flows} pixels with valid flow, {minimum} needed", "refine"
        )
    return RelativePose.failed(
        Reason.LOW_INLIERS, f"{count} usable pixels, {minimum} needed", "refine"
    )


def _hypotheses(
    picture: _Picture,
    coarse: np.ndarray,
    h: int,
    w: int,
    stride: int,
    poses: np.ndarray,
    facts: np.ndarray,
    T_last: np.ndarray | None,
    judge: Judge,
    starts: int,
) -> list[Hypothesis]:
    """Support, cues and scores of the motions found, in the order found."""
    n = h * w
    work = solver.new_work()
    noise = np.empty(3, np.float32)
    usable = (coarse[kernels.W, :n] > 0).reshape(h, w)
    depth = coarse[kernels.Z, :n].reshape(h, w)
    found = []
    for pose, fact in zip(poses, facts, strict=True):
        support = np.empty(n, np.float32)
        sf, sd = fact[search.FLOW_NOISE], fact[search.DEPTH_NOISE]
        solver.set_noise(max(sf, 0.05), sd, SUPPORT_CUTOFF, noise)
        solver.robust_weights(coarse, n, pose, picture.K, noise, work, support)
        support = support.reshape(h, w)
        T = pose_matrix(pose)
        source = int(fact[search.SOURCE])
        if source == search.SOURCE_WINDOW:
            name = "window"
        elif source == search.SOURCE_MINIMAL:
            name = "minimal"
        else:
            name = "identity" if source == 0 else "handed-in"
        found.append((T, support, name, cues(support, usable, depth, T, T_last)))
    scores = np.asarray(judge([f[3] for f in found]), dtype=np.float64)
    return [
        Hypothesis(T, support, stride, cue["share"], float(score), name, cue)
        for (T, support, name, cue), score in zip(found, scores, strict=True)
    ]


def _finish(
    pair: FramePair,
    picture: _Picture,
    coarse: np.ndarray,
    n: int,
    pose: np.ndarray,
    facts: np.ndarray,
    hypotheses: list[Hypothesis],
    options: RefinementOptions,
    depth_scale: float,
    box: tuple[int, int, int, int],
) -> RelativePose:
    """Fit the chosen motion on the full grid; covariance, status and weights."""
    work = solver.new_work()
    sf, sd, share, more, _ = solver.polish(
        coarse, n, picture.K, facts[search.FLOW_NOISE], facts[search.DEPTH_NOISE],
        options.cutoff, 1, 4, pose, work,
    )  # fmt: skip
    iterations = int(facts[search.ITERATIONS] + more)
    noise = np.empty(3, np.float32)
    solver.set_noise(sf, sd, options.cutoff, noise)
    height, width = picture.shape
    chunks = 2 if height * width >= PARALLEL_PIXELS else 1
    delta = np.zeros(6)
    arguments = (picture.data, picture.camera, picture.flags, picture.scale)
    for _ in range(options.full_steps):
        sums = np.zeros((chunks, kernels.SUMS))
        R, t = pose[:, :3].astype(np.float32), pose[:, 3].astype(np.float32)
        if chunks > 1:
            kernels.sum_grid(*arguments, R, t, picture.K, noise, sums)
        else:
            kernels.sum_rows(*arguments, R, t, picture.K, noise, 0, height, sums[0])
        total = sums.sum(axis=0)
        if not solver.solve6(total, solver.DAMPING, delta):
            break
        iterations += 1
        solver.left_update(delta, pose.copy(), pose)
        moved = np.sqrt(max(delta @ total[21:27], 0) / max(total[28], 1e-12)) * sf
        if moved < 1e-3 * sf:
            break
    tiles = (-(-height // options.tile), -(-width // options.tile))
    weights = np.empty((height, width), np.float32)
    scores = np.zeros((*tiles, 6))
    sums = np.zeros((chunks, kernels.SUMS))
    R, t = pose[:, :3].astype(np.float32), pose[:, 3].astype(np.float32)
    last = (*arguments, R, t, picture.K, noise)
    if chunks > 1:
        kernels.score_grid(*last, options.tile, weights, scores, sums)
    else:
        kernels.score_rows(*last, 0, tiles[0], options.tile, weights, scores, sums[0])
    total = sums.sum(axis=0)
    curvature = np.zeros(21)
    acc = np.zeros(kernels.SUMS)
    for o in range(0, n, kernels.BLOCK):
        m = min(kernels.BLOCK, n - o)
        kernels.project_block(coarse, o, m, R, t, picture.K, noise, work, acc)
        kernels.sum_curvature(m, coarse[kernels.W, o : o + m], work, float(noise[2]), curvature)
    curvature *= total[29] / max(acc[29], 1e-12)
    covariance, eigenvalues, definite = _covariance(total, curvature, scores, depth_scale)
    if box != (0, *pair.prev.camera.shape[:1], 0, *pair.prev.camera.shape[1:]):
        whole = np.zeros(pair.prev.camera.shape, np.float32)
        whole[box[0] : box[1], box[2] : box[3]] = weights
        weights = whole
    T = pose_matrix(pose)
    common = {
        "method": "refine",
        "inlier_ratio": float(min(1.0, share)),
        "iterations": iterations,
        "cost": float(total[27] / max(total[29], 1e-12)),
        "residual_scale_px": float(sf * np.sqrt(picture.scale[0])),
        "depth_noise": float(sd),
        "weights": weights,
        "information_eigenvalues": eigenvalues,
        "hypotheses": tuple(hypotheses),
    }
    if not definite or not np.isfinite(T).all():
        return RelativePose.failed(
            Reason.DEGENERATE_GEOMETRY,
            "the pixels leave a direction of the motion undetermined",
            **common,
        )
    if total[28] * share < 6 or share < 0.02:
        return RelativePose.failed(
            Reason.LOW_INLIERS, f"{100 * share:.1f} % of the pixels follow one motion", **common
        )
    status = _status(share, hypotheses)
    spread = np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))
    return RelativePose(
        T_curr_prev=T,
        covariance=covariance,
        status=status,
        translation_direction_valid=bool(np.linalg.norm(T[:3, 3]) > 3 * spread),
        **common,
    )


def _status(share: float, hypotheses: list[Hypothesis]) -> Status:
    """Ok, or degraded with the reason."""
    if len(hypotheses) > 1:
        first, second = hypotheses[0], hypotheses[1]
        if first.score - second.score < 0.15 and second.share > 0.5 * first.share:
            return Status.degraded(
                Reason.AMBIGUOUS_MOTION,
                f"two motions could be the world ({100 * first.share:.0f} % and "
                f"{100 * second.share:.0f} % of the pixels)",
            )
    if share < 0.2:
        return Status.degraded(
            Reason.LOW_INLIERS, f"only {100 * share:.0f} % of the pixels follow the motion"
        )
    return Status()


def _symmetric(upper: np.ndarray) -> np.ndarray:
    """(6, 6) from its 21 upper-triangle values, row by row."""
    out = np.zeros((6, 6))
    out[np.triu_indices(6)] = upper
    return out + np.triu(out, 1).T


def _covariance(
    total: np.ndarray, curvature: np.ndarray, scores: np.ndarray, depth_scale: float
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Sandwich covariance, eigenvalues of the information in px, and whether it is definite.

    Bread: the derivative of the estimating equation (Gauss-Newton Hessian less the curvature of the
    robust weights). Meat: outer products of the scores summed over tiles, so that errors correlated
    within a tile count as such (cluster-robust, with its small-sample factor).
    """
    H = _symmetric(total[:21])
    scaling = np.array([1 / depth_scale] * 3 + [1.0] * 3)  # metres at the typical depth -> radians
    H_scaled = H * np.outer(scaling, scaling)
    eigenvalues = np.linalg.eigvalsh(H_scaled)
    floor = 1e-8 * eigenvalues[-1]
    nothing = np.diag([1e4] * 3 + [10.0] * 3)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= max(floor, 1e-12):
        return nothing, np.nan_to_num(eigenvalues), False
    bread = H_scaled - _symmetric(curvature) * np.outer(scaling, scaling)
    if np.linalg.eigvalsh(bread)[0] <= 0.2 * eigenvalues[0]:
        bread = H_scaled  # too few inliers for the curvature to be believed
    flat = scores.reshape(-1, 6) * scaling
    flat = flat[np.abs(flat).max(axis=1) > 0]
    clusters = len(flat)
    inverse = np.linalg.inv(bread)
    if clusters >= 12:
        meat = flat.T @ flat * (clusters / (clusters - 6))
        sandwich = inverse @ meat @ inverse
    else:
        sandwich = np.zeros((6, 6))
    # never below what independent noise of the estimated size would give
    model = np.linalg.inv(H_scaled)
    covariance = sandwich if clusters >= 24 else np.maximum(1.0, 24 / max(clusters, 1)) * (
        model + sandwich
    )
    covariance = covariance / np.outer(1 / scaling, 1 / scaling)
    covariance = 0.5 * (covariance + covariance.T)
    if not np.isfinite(covariance).all():
        return nothing, eigenvalues, False
    return covariance, eigenvalues, True
