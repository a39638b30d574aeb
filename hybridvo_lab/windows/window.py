"""The poses of several frames from all flow between them: one problem with shared poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from hybridvo.core.checks import check_kind
from hybridvo.core.options import Options
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch.tools import checked_batch, uncompiled

if TYPE_CHECKING:
    from hybridvo_lab.windows.window_poses import WindowPoses


@uncompiled
def refine_window(
    batch: PairBatch,
    edges: Any,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    focal_std: float | None = None,
    depth_scale_std: Any = None,
    shared_depth: bool = False,
    options: Options | None = None,
) -> WindowPoses:
    """Estimate the poses of several frames jointly, from the flow between pairs of them.

    The cost is the sum of the costs of all pairs, with poses shared between the pairs, so flow over
    several frames corrects the drift of chained motions. As with :func:`hybridvo.refine`, gradients
    reach flow, depth, intrinsics, variances, weights and ``noise`` if it is given; there is no
    search.

    Focal length, depth scales and depths are known, unless a standard deviation of their prior
    makes them unknowns. A factor on all depths and translations changes no flow: only the priors
    of ``depth_scale_std`` hold it.

    Args:
        batch: K pairs of frames with flow.
        edges: (K, 2) previous and current frame of each pair, numbered from 0 without gaps.
        T_init: (K, 4, 4) starting point T_curr_prev of each pair, metres; None: the identity.
        weights: (K, H, W) factors on the information of each pixel.
        noise: (2,) or (K, 2), standard deviations of the flow, px, and of log depth; None:
            estimated for each pair.
        kernel: ``geman-mcclure``, ``cauchy``, ``huber`` or ``l2``.
        focal_std: standard deviation of the log of one factor on the focal lengths of all
            frames; None: those of the batch are right.
        depth_scale_std: standard deviation of the log of a factor on the depth of each frame,
            one number or (F,), 0 for a frame with metric depth; None: all depths are metric.
        shared_depth: True: the depth of each pixel is an unknown, with the measured depth and
            its noise as its prior, and the pairs of one previous frame share it. False: each
            pair has errors of depth of its own.
        options: the option tree.

    Returns:
        The poses of F frames relative to frame 0, the other unknowns, the joint covariance of
        all, which treats the pairs as independent but for shared depths, and how much each pair
        disagrees with the poses.

    Raises:
        InputError: a value has the wrong shape or type, or the edges do not connect all frames.

    Example:
        >>> import hybridvo as hvo
        >>> from hybridvo_lab.synthetic.noise_scenarios import make_pair
        >>> pair, truth = make_pair("moving00", 0, 108, 256)
        >>> batch = hvo.PairBatch.from_pairs([pair, pair])
        >>> window = refine_window(batch, [[0, 1], [1, 2]], noise=(0.5, 0.02))
        >>> window.T_frame_first.shape, window.covariance.shape
        (torch.Size([3, 4, 4]), torch.Size([12, 12]))
    """
    options = Options() if options is None else options
    check_kind("refine_window.options", options, Options)
    check_kind("refine_window.batch", batch, PairBatch)
    # not before: they need the extra ``train``
    from hybridvo.batches import refine_batch
    from hybridvo.solver.torch import factors
    from hybridvo.solver.torch.backend import given_noise, kernel_model
    from hybridvo_lab.windows.window_solver import Window, checked_edges
    from hybridvo_lab.windows.window_unknowns import checked_unknowns

    numbers = checked_edges(edges, len(batch.flow))
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
        options=options.refine,
        min_probability=options.select.min_probability,
    )
    with torch.autocast(batch.flow.device.type, enabled=False):
        pixels = factors.gather_pixels(batch, weights)
        stated = given_noise(noise, batch.flow)
        if stated is None:
            stated = alone.noise
        model = kernel_model(kernel, options.refine)._replace(noise=stated)
        window = Window(pixels, numbers, alone, model, unknowns, batch.depth_prev)
        start = window.starts()
        if start is None:
            return window.failed("the flow that is usable does not join all frames")
        return window.solve(start)
