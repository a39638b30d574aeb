"""The public calls on one pair: what users hand in is checked here, once."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.flow import dis_flow
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.pipeline import DEFAULT_METHOD, NETWORKS, Context, check_method, run_method
from hybridvo.results import MotionPrior, RelativePose
from hybridvo.types import Frame, FramePair, PairBatch, as_rigid, as_seed, check_kind


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
    """Camera motion ``T_curr_prev`` of one pair, with covariance and status.

    ``pair`` has its flow; or it is the previous frame, ``curr`` the current one, and the flow is
    OpenCV's DIS. A ``prior`` is one more start, and a cue for the selection. Bad data give a failed
    status, never an exception and never a value that is not finite.
    """
    options, flow = Options() if options is None else options, None
    check_kind("estimate.options", options, Options)
    check_kind("estimate.prior", prior, MotionPrior, type(None))
    seed = as_seed(seed, "estimate.seed")
    if curr is not None or isinstance(pair, Frame):
        pair = FramePair(pair, curr, None)  # type: ignore[arg-type]  # which refuses what is no frame
        flow = dis_flow(options.flow.dis_preset)
    check_kind("estimate, a pair", pair, FramePair)
    check_method(method)
    models = models or default_models(options.run.device if method in NETWORKS else "cpu")
    return run_method(pair, method, Context(options, prior, seed, None, models, flow=flow))


def refine(
    pair: FramePair | PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    options: Options | None = None,
    seed: int = 0,
) -> Any:
    """Camera motion by robust dense reprojection, without any network.

    Of a :class:`FramePair` a ``RelativePose``; of a :class:`PairBatch` (torch) a ``BatchedPose``,
    differentiable: see :func:`hybridvo.refinement.torch_backend.refine_batch`. ``T_init`` (4, 4)
    T_curr_prev is the only start of a pair, and of a batch with weights; without one every strong
    motion of a pair is searched, and cues say which is the camera's. ``weights`` (H, W) are factors
    on the information of each pixel; 0 and NaN switch one off.
    """
    options = Options() if options is None else options
    check_kind("refine.options", options, Options)
    if isinstance(pair, PairBatch):
        from hybridvo.refinement.torch_backend import refine_batch

        return refine_batch(pair, T_init, weights, options=options.refine)
    check_kind("refine, a pair", pair, FramePair)
    seed, shape = as_seed(seed, "refine.seed"), pair.prev.camera.shape
    if weights is not None and np.shape(weights) != shape:
        raise InputError(f"refine: expected weights of shape {shape}, got {np.shape(weights)}.")
    start = None if T_init is None else as_rigid(T_init, "refine.T_init")
    return run_method(pair, "refine", Context(options, None, seed, weights, start=start))
