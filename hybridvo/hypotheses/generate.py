"""Every strong motion of a pair, on a grid of a few thousand pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from hybridvo.calibration import UNAMBIGUOUS_BEND_PX, UNAMBIGUOUS_COHERENCE
from hybridvo.hypotheses import search
from hybridvo.numba_tools import as_contiguous
from hybridvo.options import Options
from hybridvo.refinement import kernels
from hybridvo.refinement.depth import look_up
from hybridvo.refinement.noise_estimation import residual_coherence
from hybridvo.refinement.pixels import PixelGrid, coarse_grid
from hybridvo.refinement.robust_fit import fit_coarse
from hybridvo.results import Reason, RelativePose
from hybridvo.types import Frame, FramePair

# correlation of neighbours that independent noise reaches by chance
CHANCE_COHERENCE = 0.05


@dataclass(frozen=True, eq=False)
class GridMaps:
    """What is known about each pixel (h, w) of the grid; as arrays, or as tensors of a batch."""

    ray: Any  # (2, h, w) K^-1 x without the one
    depth: Any  # metres, previous frame
    target: Any  # (2, h, w) px, x + flow in the current image
    flow_variance: Any  # relative to the typical one
    depth_variance: Any
    usable: Any  # bool, flow and depth are there
    # log metres of the current frame at the target; NaN if unknown, at an edge
    log_depth_curr: Any
    K: Any  # (4,) fx, fy, cx, cy of the current camera
    width: Any  # px, of the whole image
    stride: Any  # px between the grid's pixels
    seen: Any  # bool, depth is there, with or without flow
    image_prev: Any  # grey levels, each frame on its own grid; 0 without
    image_curr: Any
    log_depth_seen: Any  # log metres of the current frame on its own grid


@dataclass(frozen=True, eq=False)
class HypothesisSet:
    """The motions found, in the order found, and the pixels they were found on."""

    pair: FramePair
    grid: PixelGrid
    poses: np.ndarray  # (M, 3, 4) T_curr_prev
    facts: np.ndarray  # (M, hybridvo.hypotheses.search.FACTS)
    # False where the first explains the image beyond doubt: it is the only one
    is_ambiguous: bool

    def maps(self) -> GridMaps:
        """The pixels of the grid as images."""
        grid = self.grid
        pair = self.pair
        n = self.grid.count
        h, w, stride = grid.shape
        maps = grid.samples[:, :n].reshape(-1, h, w)
        log_depth = np.full(n, np.nan, np.float32)
        if pair.curr.depth is not None:
            log_depth = look_up(grid.samples, n, as_contiguous(pair.curr.depth))
        return GridMaps(
            ray=maps[[kernels.XN, kernels.YN]],
            depth=maps[kernels.Z],
            target=maps[[kernels.MU, kernels.MV]],
            flow_variance=1.0 / np.maximum(maps[kernels.PF], np.float32(1e-6)),
            depth_variance=maps[kernels.PD],
            usable=maps[kernels.W] > 0,
            log_depth_curr=log_depth.reshape(h, w),
            K=grid.K,
            width=pair.prev.camera.width,
            stride=stride,
            seen=np.isfinite(_log_depth(pair.prev, grid)),
            image_prev=_grey(pair.prev, grid),
            image_curr=_grey(pair.curr, grid),
            log_depth_seen=_log_depth(pair.curr, grid),
        )


def _grey(frame: Frame, grid: PixelGrid) -> np.ndarray:
    """(h, w) float32 grey levels, each the mean of what it stands for; 0 without an image."""
    if frame.rgb is None:
        return np.zeros(grid.shape[:2], np.float32)
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    return cv2.blur(grey, (grid.shape[2],) * 2)[grid.places].astype(np.float32)


def _log_depth(frame: Frame, grid: PixelGrid) -> np.ndarray:
    """(h, w) float32 log metres; NaN where unknown."""
    if frame.depth is None:
        return np.full(grid.shape[:2], np.nan, np.float32)
    depth = frame.depth[grid.places]
    known = (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
    return np.log(np.where(known, depth, np.float32(np.nan)))


def generate(
    pair: FramePair,
    starts: np.ndarray,
    options: Options,
    seed: int = 0,
    weights: np.ndarray | None = None,
) -> HypothesisSet | RelativePose:
    """Every strong motion of a pair with flow, or the failure that says why there is none.

    ``starts``: (S, 4, 4); ``weights`` (H, W): factors on the information of each pixel.
    """
    grid = coarse_grid(pair, weights, options.refine)
    poses, facts = search.find_motions(
        grid, np.ascontiguousarray(starts[:, :3]), options, seed
    )
    if len(poses) == 0:
        what = "the pixels do not determine any motion"
        return RelativePose.failed(Reason.DEGENERATE_GEOMETRY, what, "classical")
    clear = (
        len(poses) == 1
        and facts[0, search.SHARE] >= options.search.unambiguous_ratio
    )
    clear = clear and _is_rigid(grid, poses[0], facts[0], pair.prev.camera.width)
    return HypothesisSet(pair, grid, poses, facts, not clear)


def _is_rigid(
    grid: PixelGrid, pose: np.ndarray, fact: np.ndarray, width: int
) -> bool:
    """Whether the residuals of a motion look like noise, not like a bent compromise of two."""
    h, w, _ = grid.shape
    noise = fact[search.FLOW_NOISE], fact[search.DEPTH_NOISE]
    coherence = residual_coherence(grid.samples, h, w, pose, grid.K, *noise)
    excess = max(coherence - CHANCE_COHERENCE, 0.0)
    bend_px = (
        np.sqrt(excess * grid.scale[0]) * noise[0] * search.REFERENCE_WIDTH / width
    )
    return bool(coherence < UNAMBIGUOUS_COHERENCE and bend_px < UNAMBIGUOUS_BEND_PX)


def fit_in_mask(
    samples: np.ndarray,
    mask: np.ndarray,
    K: np.ndarray,
    pose: np.ndarray,
    cutoff: float,
) -> tuple[np.ndarray, np.ndarray]:
    """A pose (3, 4) fitted to a pixel buffer inside a mask (h, w), and its facts."""
    masked = samples.copy()
    masked[kernels.W, : mask.size] *= mask.reshape(-1)
    pose, (sf, sd), share, iterations = fit_coarse(
        masked, mask.size, K, pose, cutoff
    )
    return pose, np.array([share, sf, sd, search.SOURCE_REFIT, iterations], float)
