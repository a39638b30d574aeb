"""Public functions for a single pair, which check what users pass in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

import numpy as np

from hybridvo.core.checks import as_rigid, as_seed, check_kind, to_numpy
from hybridvo.core.errors import InputError
from hybridvo.core.options import Options
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.core.types import Frame, FramePair, PairBatch
from hybridvo.flow.providers import dis_flow
from hybridvo.network.models import Models, default_models
from hybridvo.pipeline import (
    DEFAULT_METHOD,
    Context,
    check_method,
    method_of,
    run_method,
)

if TYPE_CHECKING:
    from hybridvo.solver.torch.backend import BatchedPose


def estimate(
    pair: FramePair | Frame,
    curr: Frame | None = None,
    *,
    method: str = DEFAULT_METHOD,
    prior: MotionPrior | None = None,
    options: Options | None = None,
    models: Models | None = None,
    seed: int = 0,
) -> RelativePose:
    """Estimate the camera motion ``T_curr_prev`` of one pair, with covariance and status.

    Bad data give a failed status, never an exception, NaN or inf.

    Args:
        pair: a FramePair with its flow; or the previous frame, in which case OpenCV's DIS
            computes the flow.
        curr: the current frame, if ``pair`` is a frame.
        method: one of ``hybridvo.pipeline.METHODS``.
        prior: prior knowledge of the motion: an additional starting point for the search, and
            a cue for the selection.
        options: the option tree.
        models: networks to use instead of the pretrained ones.
        seed: seed for the search's random numbers.

    Returns:
        ``T_curr_prev`` (4, 4), metres, with its covariance (6, 6), status and probability.

    Raises:
        InputError: a value has the wrong type, or the method is unknown.

    Example:
        >>> import hybridvo as hvo
        >>> prev, curr, _ = hvo.example_frames()
        >>> motion = hvo.estimate(prev, curr)
        >>> print(motion.status)
        ok
        >>> motion.T_curr_prev.shape, motion.covariance.shape
        ((4, 4), (6, 6))
    """
    options = Options() if options is None else options
    flow = None
    check_kind("estimate.options", options, Options)
    check_kind("estimate.prior", prior, MotionPrior, type(None))
    seed = as_seed(seed, "estimate.seed")
    if curr is not None or isinstance(pair, Frame):
        pair = FramePair(pair, curr, None)  # type: ignore[arg-type]  # which refuses what is no frame
        flow = dis_flow(options.flow.dis_preset)
    check_kind("estimate.pair", pair, FramePair, Frame)
    check_kind("estimate.method", method, str)
    check_kind("estimate.models", models, Models, type(None))
    method = check_method(method)
    models = models or default_models(
        options.run.device if method_of(method).networks else "cpu"
    )
    context = Context(options, models, flow, seed)
    return run_method(context.evidence(pair, prior), method, context)


@overload
def refine(
    pair: FramePair,
    T_init: Any = None,
    weights: Any = None,
    *,
    options: Options | None = None,
    seed: int = 0,
) -> RelativePose: ...


@overload
def refine(
    pair: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str | None = None,
    options: Options | None = None,
    seed: int = 0,
) -> BatchedPose: ...


def refine(
    pair: FramePair | PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str | None = None,
    options: Options | None = None,
    seed: int = 0,
) -> RelativePose | BatchedPose:
    """Estimate the camera motion by robust dense reprojection, without a network.

    For a :class:`FramePair`, all strong motions are searched, and cues decide which one is the
    camera's. For a :class:`PairBatch` there is no search: without pixel weights, no sample is
    better than ``degraded``, and its probability is NaN.

    For a batch the motion is differentiable: gradients reach flow, depth, intrinsics, variances,
    weights and ``noise``, but not ``T_init``. If ``noise`` is given, this is the gradient of
    the solution; if it is estimated, the gradient treats it as constant. There are no second
    derivatives. From the seed of ``select`` the probability is that of the method ``pwvo-refine``.

    Args:
        pair: a FramePair, or a PairBatch of torch tensors.
        T_init: T_curr_prev, metres. For a pair, (4, 4): the only starting point; there is no
            search. For a batch, a :class:`PoseSeed`, (B, 4, 4), or (B, S, 4, 4) for several
            candidates: with weights, the only starting points. Without the covariance of a seed
            the search is confined to about a pixel, or more if hardly any pixel fits that well.
        weights: (H, W), for a batch (B, H, W): factors on the information of each pixel; 0 or
            NaN excludes a pixel.
        noise: for a batch, (2,) or (B, 2): standard deviations of the flow, px, and of log depth;
            None: estimated.
        kernel: for a batch: ``geman-mcclure`` (default), ``cauchy``, ``huber`` or ``l2``.
        options: the option tree.
        seed: seed for the search's random numbers.

    Returns:
        A ``RelativePose``; for a batch a ``BatchedPose``.

    Raises:
        InputError: a value has the wrong shape or type.

    Example:
        >>> import hybridvo as hvo
        >>> prev, curr, _ = hvo.example_frames()
        >>> motion = hvo.refine(hvo.FramePair(prev, curr, hvo.dis_flow()(prev, curr).flow))
        >>> print(motion.status)
        ok
    """
    options = Options() if options is None else options
    check_kind("refine.options", options, Options)
    if isinstance(pair, PairBatch):
        from hybridvo.batches import refine_batch

        return refine_batch(
            pair,
            T_init,
            weights,
            noise=noise,
            kernel="geman-mcclure" if kernel is None else kernel,
            options=options.refine,
            min_probability=options.select.min_probability,
        )
    check_kind("refine.pair", pair, FramePair, PairBatch)
    of_batches = {
        "noise": noise,
        "kernel": kernel,
    }
    for name, value in of_batches.items():
        if value is not None:
            remedy = "Make one with hybridvo.PairBatch.from_pairs([pair])"
            raise InputError(
                f"refine.{name}: expected with a PairBatch, got a FramePair. {remedy}."
            )
    seed = as_seed(seed, "refine.seed")
    if weights is not None:
        weights = _pixel_weights(weights, pair.prev.camera.shape)
    start = None if T_init is None else as_rigid(T_init, "refine.T_init")
    context = Context(options, seed=seed)
    evidence = context.evidence(pair, None, weights, start)
    return run_method(evidence, "classical", context)


def _pixel_weights(weights: Any, shape: tuple[int, int]) -> np.ndarray:
    """Return the given weights of a pair's pixels, checked."""
    values = to_numpy(weights, "refine.weights")
    if values.shape != shape or values.dtype.kind not in "fiub":
        got = f"{values.dtype} {values.shape}"
        raise InputError(
            f"refine.weights: expected numbers of shape {shape}, got {got}."
        )
    return values
