"""The public calls on one pair: what users hand in is checked here, once."""

from __future__ import annotations

import functools
import time
from dataclasses import replace
from typing import Any

import numpy as np

from hybridvo.errors import InputError
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.pipeline import (
    DEFAULT_METHOD,
    NETWORKS,
    Context,
    check_method,
    classical,
    run_method,
)
from hybridvo.refinement import refine as refinement
from hybridvo.results import MotionPrior, RelativePose
from hybridvo.types import Camera, Frame, FramePair, PairBatch, as_rigid, as_seed, check_kind


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
        two: dict[str, Any] = {"prev": pair, "curr": curr}
        pair, flow = FramePair(**two, flow=None), dis_flow(options.flow.dis_preset)
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
    T_curr_prev is the only start; without one every strong motion is searched, and hand-made cues
    say which is the camera's. ``weights`` (H, W) are factors on the information of each pixel; 0
    and NaN switch one off. Bad data give a failed status.
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
    started = time.perf_counter()
    if T_init is None:
        motion = classical(pair, Context(options, None, seed, weights))
    else:
        start = refinement.Selection(as_rigid(T_init, "refine.T_init"))
        motion = refinement.refine_pair(pair, start, weights=weights, options=options.refine)
    return motion.replace(ms=1e3 * (time.perf_counter() - started))


@functools.cache
def warm_up(method: str = DEFAULT_METHOD, models: Models | None = None) -> float:
    """Compile and load everything before a first pair; seconds spent.

    A minute on the first call after an installation, a second after that.
    """
    started = time.perf_counter()
    context = Context(models=models or default_models(), check_flow=False)
    for height, width in ((48, 64), (320, 400)):  # the second takes the parallel kernels
        camera = Camera(width, width, (width - 1) / 2, (height - 1) / 2, height, width)
        u, v = np.arange(width), np.arange(height)[:, None]
        depth = (4.0 + np.sin(u / 7.0) + np.cos(v / 5.0)).astype(np.float32)
        motion = se3_exp(np.array([0.02, -0.01, 0.05, 0.002, 0.004, -0.003]))
        flow = ego_flow(depth, motion, camera, camera).astype(np.float32)
        # a mask, a variance and a second motion: every branch is compiled
        flow[: height // 3, : width // 3] += 3.0
        rgb = (40 * (2 + np.sin(u / 3.0) + np.cos(v / 2.0)))[..., None].repeat(3, 2)
        frame = Frame(rgb.astype(np.uint8), depth, camera)
        variance, valid = np.full((height, width), 0.01, np.float32), flow[..., 0] < 1e3
        pair = FramePair(frame, frame, flow)
        run_method(replace(pair, flow_variance=variance, flow_valid=valid), method, context)
        run_method(pair, method, context)
        if method.startswith("hybrid"):  # what few pairs ask for
            context.predict(pair)
            context.direct(replace(pair, flow_source="dis"))
    return time.perf_counter() - started
