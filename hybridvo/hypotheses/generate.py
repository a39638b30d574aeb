"""The stage *search*: a pair in, every strong motion of it out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.depth_units import nearer_than_sky
from hybridvo.core.options import Options, RefineOptions
from hybridvo.core.results import Reason, StageFailed
from hybridvo.core.stages import stage
from hybridvo.core.types import Frame, FramePair
from hybridvo.hypotheses.search import find_motions
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.solver.pixels import PixelGrid, coarse_grid


@stage("search")
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
    return HypothesisSet(
        pair=below_sky,
        grid=grid,
        motions=motions,
        cutoff=options.refine.cutoff,
        lacks_sky=below_sky.prev is not pair.prev,
        is_complete=(
            len(motions) == 1
            and motions[0].inlier_ratio >= options.search.unambiguous_ratio
        ),
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
