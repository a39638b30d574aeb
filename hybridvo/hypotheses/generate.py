"""The stage *search*: a pair in, every strong motion of it out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.calibration import (
    CHANCE_COHERENCE,
    FLOW_NOISE_FLOOR_PX,
    UNAMBIGUOUS_BEND_PX,
    UNAMBIGUOUS_COHERENCE,
)
from hybridvo.depth_units import nearer_than_sky
from hybridvo.hypotheses.search import REFERENCE_WIDTH, find_motions
from hybridvo.hypotheses.types import HypothesisSet, Motion
from hybridvo.options import Options, RefineOptions
from hybridvo.refinement.noise_estimation import residual_coherence
from hybridvo.refinement.pixels import PixelGrid, coarse_grid
from hybridvo.results import Reason, StageFailed
from hybridvo.types import Frame, FramePair


def generate(
    pair: FramePair,
    starts: np.ndarray,
    options: Options,
    seed: int = 0,
    weights: np.ndarray | None = None,
) -> HypothesisSet:
    """Find every strong motion of a pair.

    Args:
        pair: frames with flow, and depth of the previous one. Depth of a sky is left out.
        starts: (S, 4, 4) ``T_curr_prev`` that the search tries beside those it finds; the
            first one is the identity.
        options: the option tree.
        seed: of the search.
        weights: (H, W) factors on the information of each pixel, or None.

    Returns:
        The motions, and the pixels on which they were searched.

    Raises:
        StageFailed: if flow, depth or usable pixels are missing, or if the pixels do not
            determine any motion.
    """
    below_sky = without_sky(pair)
    grid = coarse_grid(below_sky, weights, options.refine)
    start_poses = np.ascontiguousarray(starts[:, :3])
    motions = find_motions(grid, start_poses, options, seed)
    if not motions:
        raise StageFailed(
            Reason.DEGENERATE_GEOMETRY, "the pixels do not determine any motion"
        )
    is_unambiguous = (
        len(motions) == 1
        and motions[0].stats.inlier_ratio >= options.search.unambiguous_ratio
        and _leaves_noise_only(grid, motions[0], pair.prev.camera.width)
    )
    return HypothesisSet(
        pair=below_sky,
        grid=grid,
        motions=motions,
        is_ambiguous=not is_unambiguous,
        cutoff=options.refine.cutoff,
        lacks_sky=below_sky.prev is not pair.prev,
    )


def without_sky(pair: FramePair) -> FramePair:
    """Return the pair without the depth that renderers give the sky, and no sensor does."""

    def sensed(frame: Frame) -> Frame:
        if frame.depth is None:
            return frame
        depth = nearer_than_sky(frame.depth)
        return frame if depth is frame.depth else replace(frame, depth=depth)

    return replace(pair, prev=sensed(pair.prev), curr=sensed(pair.curr))


def static_grid(
    found: HypothesisSet,
    pair: FramePair,
    mask: np.ndarray | None,
    weights: np.ndarray | None,
    options: RefineOptions,
) -> PixelGrid:
    """Return the pixels of a pair inside a static mask, the sky included.

    Args:
        found: the motions of the pair.
        pair: the pair with its sky.
        mask: (h, w) probability of each pixel of the search's grid to be static, or None.
        weights: (H, W) factors on the information of each pixel, or None.
        options: size of the grid.
    """
    grid = found.grid
    # the sky stands still, and its flow determines the rotation
    if found.lacks_sky:
        with_sky = PixelGrid(pair, weights, options.coarse_pixels)
        if with_sky.shape == grid.shape:
            is_below = grid.weight.reshape(grid.shape[:2]) > 0
            grid = with_sky
            mask = None if mask is None else np.where(is_below, mask, 1.0)
    return grid if mask is None else grid.within(mask)


def _leaves_noise_only(grid: PixelGrid, motion: Motion, width: int) -> bool:
    """Whether the residuals of a motion look like independent noise.

    Where they are alike over neighbouring pixels, the motion is a compromise between two.
    """
    h, w, _ = grid.shape
    flow_noise_px = motion.stats.flow_noise_px
    if flow_noise_px <= FLOW_NOISE_FLOOR_PX:
        return True  # what is left is rounding
    coherence = residual_coherence(
        grid.samples,
        h,
        w,
        motion.pose,
        grid.K,
        flow_noise_px,
        motion.stats.depth_noise,
    )
    if not coherence < UNAMBIGUOUS_COHERENCE:
        return False
    # the part of the noise that neighbours have in common, at the reference width
    excess = max(coherence - CHANCE_COHERENCE, 0.0)
    typical_std_px = flow_noise_px * np.sqrt(grid.scale[0])
    bend_px = np.sqrt(excess) * typical_std_px * REFERENCE_WIDTH / width
    return bool(bend_px < UNAMBIGUOUS_BEND_PX)
