"""The coarse stage of the refinement: every strong motion of a pair, on a grid of a few thousand
pixels, and one motion fitted inside a mask of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.hypotheses import search
from hybridvo.hypotheses.confidence import REFERENCE_WIDTH
from hybridvo.refinement import depth as second_depth
from hybridvo.refinement import kernels, solver
from hybridvo.refinement.options import RefinementOptions
from hybridvo.refinement.pixels import Picture, as_given
from hybridvo.types import FramePair, Reason, RelativePose

__all__ = ["CoarseSearch", "Grid", "fit_in_mask", "search_motions"]

LEAST_USABLE = 0.1
"""Share of usable grid pixels below which the grid is drawn anew, finer, where they are."""
LEAST_USABLE_PIXELS = 400
SOURCE_MASK = 102
"""Source of a motion that was fitted inside a mask, see :mod:`hybridvo.hypotheses.search`."""
CLEAR_COHERENCE = 0.5
"""Coherence of the residuals above which even a motion that most of the picture follows may be a
compromise: 0.02 for independent noise, 0.25 to 0.4 for DIS flow of static scenes, above 0.6 where a
large mover bends the flow (development seeds)."""
CHANCE_COHERENCE = 0.05
"""Coherence that independent noise reaches by chance."""
CLEAR_BEND_PX = 0.15
"""Coherent part of the residuals, px at a width of 1024, above which it may be one as well: noise
hides slow movers, and they bend the motion."""
FIT_PIXELS = 4000
"""Pixels that the noise estimate of :func:`fit_in_mask` looks at."""


@dataclass(frozen=True, eq=False)
class Grid:
    """What the coarse grid knows about each of its pixels.

    Args:
        ray: (2, h, w) float32, K^-1 x without the one.
        depth: (h, w) float32 metres, previous frame.
        target: (2, h, w) float32 px, x + flow in the current picture.
        flow_variance, depth_variance: (h, w) float32 relative to the typical one.
        usable: (h, w) bool, flow and depth are there.
        log_depth_curr: (h, w) float32, log metres of the current frame at the target; NaN where
            unknown or at an edge.
        K: (4,) fx, fy, cx, cy of the current camera.
        width: px, of the whole picture.
        stride: px between the grid's pixels.
    """

    ray: np.ndarray
    depth: np.ndarray
    target: np.ndarray
    flow_variance: np.ndarray
    depth_variance: np.ndarray
    usable: np.ndarray
    log_depth_curr: np.ndarray
    K: np.ndarray
    width: int
    stride: int


@dataclass(frozen=True, eq=False)
class CoarseSearch:
    """The motions found, in the order found, and the pixels they were found on.

    Args:
        picture: arrays of the pair, cropped to ``box``.
        samples: pixel buffer of the grid, see :mod:`hybridvo.refinement.kernels`.
        shape: (rows, columns, stride) of the grid.
        whole: (height, width) of the picture, px.
        box: (v0, v1, u0, u1) of the picture that the grid covers.
        depth_scale: 1 / typical depth.
        poses: (M, 3, 4) T_curr_prev. facts: (M, :data:`hybridvo.hypotheses.search.FACTS`).
        clear: the first motion holds the picture beyond doubt; no other was looked for.
    """

    picture: Picture
    samples: np.ndarray
    shape: tuple[int, int, int]
    whole: tuple[int, int]
    box: tuple[int, int, int, int]
    depth_scale: float
    poses: np.ndarray
    facts: np.ndarray
    clear: bool

    @property
    def count(self) -> int:
        """Pixels of the grid."""
        return self.shape[0] * self.shape[1]

    def masked(
        self, pair: FramePair, weights: np.ndarray | None, mask: np.ndarray
    ) -> tuple[Picture, np.ndarray]:
        """Picture and samples with their weights times a mask (h, w) of the grid."""
        shape = pair.prev.camera.shape
        factors = whole_mask(np.ascontiguousarray(mask, np.float32), shape, self.box, self.shape[2])
        if weights is not None:
            factors = factors * np.asarray(weights, np.float32)
        picture = Picture(pair, factors)
        if self.box != (0, shape[0], 0, shape[1]):
            picture.crop(pair.prev.camera, pair.curr.camera, self.box)
        samples = self.samples.copy()
        samples[kernels.W, : self.count] *= mask.reshape(-1)
        return picture, samples

    def on_grid(self, whole: np.ndarray) -> np.ndarray:
        """(h, w) float32: a map over the whole picture, of any resolution, seen on the grid."""
        h, w, stride = self.shape
        height, width = self.whole
        first = stride // 2 + 0.5
        v = (self.box[0] + first + np.arange(h) * stride) * (whole.shape[0] / height) - 0.5
        u = (self.box[2] + first + np.arange(w) * stride) * (whole.shape[1] / width) - 0.5
        u, v = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
        map_of = np.ascontiguousarray(whole, np.float32)
        return cv2.remap(map_of, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def grid(self, pair: FramePair) -> Grid:
        """The pixels as pictures."""
        h, w, stride = self.shape
        n = self.count

        def map_of(*rows: int) -> np.ndarray:
            return self.samples[list(rows), :n].reshape(len(rows), h, w)

        log_depth = np.full(n, np.nan, np.float32)
        u0, v0 = self.picture.origin
        if pair.curr.depth is not None:
            depth = as_given(pair.curr.depth)
            second_depth.look_up(self.samples, n, 1, depth, u0, v0, log_depth)
        return Grid(
            ray=map_of(kernels.XN, kernels.YN),
            depth=map_of(kernels.Z)[0],
            target=map_of(kernels.MU, kernels.MV),
            flow_variance=1.0 / np.maximum(map_of(kernels.PF)[0], np.float32(1e-6)),
            depth_variance=map_of(kernels.PD)[0],
            usable=map_of(kernels.W)[0] > 0,
            log_depth_curr=log_depth.reshape(h, w),
            K=self.picture.K,
            width=pair.prev.camera.width,
            stride=stride,
        )


def whole_mask(
    mask: np.ndarray, shape: tuple[int, int], box: tuple[int, int, int, int], stride: int
) -> np.ndarray:
    """(H, W) float32 from a mask (h, w) on the coarse grid of ``box``; 0 outside of it."""
    h, w = mask.shape
    height, width = box[1] - box[0], box[3] - box[2]
    fine = cv2.resize(mask, (w * stride, h * stride), interpolation=cv2.INTER_LINEAR)
    missing = (0, max(0, height - h * stride)), (0, max(0, width - w * stride))
    fine = np.pad(fine, missing, mode="edge")[:height, :width]
    if fine.shape == shape:
        return np.ascontiguousarray(fine)
    whole = np.zeros(shape, np.float32)
    whole[box[0] : box[1], box[2] : box[3]] = fine
    return whole


def search_motions(
    pair: FramePair,
    starts: np.ndarray,
    weights: np.ndarray | None,
    options: RefinementOptions,
    seed: int,
) -> CoarseSearch | RelativePose:
    """Every strong motion of a pair, or the failure that says why there is none.

    Args:
        pair: the input; flow and previous depth are there.
        starts: (S, 3, 4) poses to start from beside those that the search makes.
        weights: (H, W) factors on the information of each pixel, or None.
        options: of the refinement.
        seed: of the minimal samples.
    """
    picture = Picture(pair, weights)
    coarse, h, w, stride = picture.samples(options.coarse_pixels)
    usable = np.count_nonzero(coarse[kernels.W, : h * w] > 0)
    box = (0, picture.shape[0], 0, picture.shape[1])
    if usable < LEAST_USABLE * h * w or usable < LEAST_USABLE_PIXELS:
        # few usable pixels: look at all of them, and at a finer grid where they are
        count, box = picture.usable_box()
        if count < options.minimum_pixels:
            return _too_few(pair, count, options.minimum_pixels)
        picture.crop(pair.prev.camera, pair.curr.camera, box)
        coarse, h, w, stride = picture.samples(options.coarse_pixels)
    small, sh, sw, _ = picture.samples(options.search_pixels)
    # the search uses the weights up
    coarse_weight = coarse[kernels.W].copy()
    depth_scale = search.translation_scale(coarse, h * w)
    poses = np.zeros((options.hypotheses, 3, 4))
    facts = np.zeros((options.hypotheses, search.FACTS))
    found = search.find_motions(
        small,
        sh,
        sw,
        coarse,
        h,
        w,
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
    clear = found == 1 and bool(facts[0, search.SHARE] >= options.decisive_share)
    if clear:
        noise = facts[0, search.FLOW_NOISE], facts[0, search.DEPTH_NOISE]
        coherence = search.residual_coherence(coarse, h, w, poses[0], picture.K, *noise)
        excess = max(coherence - CHANCE_COHERENCE, 0.0)
        bend_px = np.sqrt(excess * picture.scale[0]) * noise[0]
        bend_px *= REFERENCE_WIDTH / pair.prev.camera.width
        clear = bool(coherence < CLEAR_COHERENCE and bend_px < CLEAR_BEND_PX)
    shape = (h, w, stride)
    return CoarseSearch(
        picture,
        coarse,
        shape,
        pair.prev.camera.shape,
        box,
        depth_scale,
        poses[:found],
        facts[:found],
        clear,
    )


def fit_in_mask(
    samples: np.ndarray,
    mask: np.ndarray,
    K: np.ndarray,
    pose: np.ndarray,
    cutoff: float,
) -> tuple[np.ndarray, np.ndarray]:
    """One motion, fitted on the coarse grid inside a mask.

    Args:
        samples: pixel buffer of the grid; left as it is.
        mask: (h, w) factors in [0, 1] on the weights of its first h * w pixels.
        K: (4,) float32 fx, fy, cx, cy of the current camera.
        pose: (3, 4) start; left as it is.
        cutoff: of the robust kernel, see :class:`RefinementOptions`.

    Returns:
        The pose (3, 4) and its facts, the share being that of the masked weight.
    """
    n = mask.size
    samples = samples.copy()
    samples[kernels.W, :n] *= mask.reshape(-1)
    work = solver.new_work()
    pose = pose.copy()
    facts = np.zeros(search.FACTS)
    scale = min(64.0, max(1.0, 1.5 * solver.residual_scale(samples, n, pose, K)))
    steps = solver.graduate(samples, n, K, scale, 0.4, 0.5, 3, pose, work)
    sf, sd, share, more, _, _ = solver.polish(
        samples, n, K, 0.5, 0.01, solver.FLOW_NOISE_CAP, solver.DEPTH_NOISE_CAP, cutoff, 2, 4,
        FIT_PIXELS, pose, work,
    )  # fmt: skip
    facts[search.SHARE], facts[search.FLOW_NOISE], facts[search.DEPTH_NOISE] = share, sf, sd
    facts[search.ITERATIONS] = steps + more
    facts[search.SOURCE] = SOURCE_MASK
    return pose, facts


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
