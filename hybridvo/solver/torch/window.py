"""The poses of several frames from all flow between them: one problem with shared poses."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.checks import brief, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.options import RefineOptions
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.backend import given_noise, kernel_model, refine_batch
from hybridvo.solver.torch.tools import checked_batch, uncompiled
from hybridvo.solver.torch.window_poses import WindowPoses as WindowPoses
from hybridvo.solver.torch.window_solver import Window, outwards
from hybridvo.solver.torch.window_unknowns import checked_unknowns


@uncompiled
def refine_window(
    batch: PairBatch,
    edges: Any,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    focal_std: Any = None,
    depth_scale_std: Any = None,
    shared_depth: bool = False,
    options: RefineOptions | None = None,
    min_probability: float = MIN_PROBABILITY,
) -> WindowPoses:
    """Estimate the poses of several frames from the flow of all pairs of them.

    Args:
        batch: K pairs of frames with flow.
        edges: (K, 2) numbers of the previous and the current frame of each pair, from 0.
        T_init: (K, 4, 4) T_curr_prev from which each edge starts, metres; None: the identity.
        weights: (K, H, W) factors on the information of each pixel.
        noise: standard deviations of flow, px, and of log depth, as (2,) or (K, 2); None:
            estimated for each edge, and held constant for the gradient.
        kernel: the robust kernel, see :func:`hybridvo.refine`.
        focal_std: standard deviation of the log of one factor on all focal lengths, which is
            an unknown then; None: the focal lengths are known.
        depth_scale_std: standard deviation of the log of a factor on the depth of each frame,
            one or (F,), which are unknowns then; None: the scales are known.
        shared_depth: whether the depth of each pixel is an unknown that all edges from its
            frame share, instead of a noise that each edge has for itself.
        options: of the refinement.
        min_probability: the probability below which the motion of an edge is degraded.

    Returns:
        The poses, relative to frame 0.

    Raises:
        InputError: A value has another shape or type, or the edges do not join all frames.
    """
    options = RefineOptions() if options is None else options
    check_kind("refine_window.batch", batch, PairBatch)
    numbers = _checked_edges(edges, len(batch.flow))
    batch, weights = checked_batch(batch, weights)
    unknowns = checked_unknowns(
        batch, numbers, focal_std, depth_scale_std, shared_depth
    )
    alone = refine_batch(
        batch,
        T_init,
        weights,
        noise=noise,
        kernel=kernel,
        options=options,
        min_probability=min_probability,
    )
    with torch.autocast(batch.flow.device.type, enabled=False):
        pixels = factors.gather_pixels(batch, weights)
        stated = given_noise(noise, batch.flow)
        if stated is None:
            stated = alone.noise
        model = kernel_model(kernel, options)._replace(noise=stated)
        window = Window(pixels, numbers, alone, model, unknowns, batch.depth_prev)
        start = window.starts()
        if start is None:
            return window.failed("the flow that is usable does not join all frames")
        return window.solve(start)


def _checked_edges(edges: Any, count: int) -> np.ndarray:
    """The edges (K, 2), which join all frames."""
    try:
        numbers = np.asarray(edges)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    is_valid = (
        numbers.shape == (count, 2)
        and np.issubdtype(numbers.dtype, np.integer)
        and bool((numbers >= 0).all())
        and bool((numbers[:, 0] != numbers[:, 1]).all())
    )
    if not is_valid:
        raise InputError(
            f"refine_window.edges: expected ({count}, 2) numbers of two different frames, from 0, "
            f"got {brief(edges)}."
        )
    frames = int(numbers.max()) + 1
    reached = {frame for frame, *_ in outwards(numbers, np.ones(count, bool))}
    missing = sorted(set(range(1, frames)) - reached)
    if missing:
        raise InputError(
            f"refine_window.edges: expected edges that join all of {frames} frames to frame 0, got "
            f"none that lead to {missing}. Number the frames without gaps, or add an edge."
        )
    return numbers
