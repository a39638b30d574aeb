"""The public calls on one pair, which check their arguments: :func:`estimate`, :func:`refine`."""

from __future__ import annotations

import time
from typing import Any, cast

import numpy as np

from hybridvo.errors import InputError
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.network.models import Models, default_models
from hybridvo.options import Options
from hybridvo.pipeline import BASELINES, DEFAULT_METHOD, Context, classical, networks_of, run_method
from hybridvo.refinement.refine import refine_pair
from hybridvo.results import MotionPrior, RelativePose
from hybridvo.types import Camera, Frame, FramePair, PairBatch, as_rigid, as_seed, check_kind

WARM_UP_SIZES = ((48, 64), (320, 400))
"""Height and width of the pairs of :func:`warm_up`; the second takes the parallel kernels."""


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
    """Camera motion of one pair.

    Args:
        pair: two frames and the flow between them; or the previous frame.
        curr: then the current frame; the flow is OpenCV's DIS.
        method: one of :data:`hybridvo.pipeline.METHODS` that can run here.
        prior: what is known of the motion: one more start, and a cue for the selection.
        options: the option tree, of which ``track`` and ``run`` (but its device) are not read.
        models: networks of one's own; by default the pretrained ones.
        seed: of everything that is drawn at random.

    Returns:
        ``T_curr_prev`` with covariance and status. Bad data give a failed status, never an
        exception and never a value that is not finite.

    Raises:
        InputError: an unknown method, or one that cannot run here; an argument of another kind.
    """
    options = Options() if options is None else options
    check_kind("estimate.options", options, Options)
    check_kind("estimate.prior", prior, MotionPrior, type(None))
    seed = as_seed(seed, "estimate.seed")
    flow = None
    if curr is not None or isinstance(pair, Frame):
        check_kind("estimate, first of two", pair, Frame)
        check_kind("estimate, second of two", curr, Frame)
        pair = FramePair(cast(Frame, pair), cast(Frame, curr), None)
        flow = dis_flow(options.flow.dis_preset)
    check_kind("estimate, a pair", pair, FramePair)
    models = models or default_models(options.run.device if networks_of(method) else "cpu")
    context = Context(options, prior, seed, None, models, flow=flow)
    return run_method(pair, method, context)


def refine(
    pair: FramePair | PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    options: Options | None = None,
    seed: int = 0,
) -> Any:
    """Camera motion by robust dense reprojection, without any network.

    Args:
        pair: a :class:`FramePair` (numpy), or a :class:`PairBatch` (torch) for the batched,
            differentiable path, which follows the largest motion where nothing is handed in: see
            :func:`hybridvo.refinement.torch_backend.refine_batch`.
        T_init: (4, 4) T_curr_prev, the only start, from which the fit may leave for a larger motion
            unless weights hold it; None: every strong motion is searched, and hand-made cues say
            which is the camera's.
        weights: (H, W) factors on the information of each pixel; 0 and NaN switch a pixel off.
        options: ``search`` and ``refine`` are read.
        seed: of the search.

    Returns:
        A ``RelativePose``, for a :class:`PairBatch` a ``BatchedPose``. Bad data give a failed
        status, never an exception and never a value that is not finite.
    """
    options = Options() if options is None else options
    check_kind("refine.options", options, Options)
    if isinstance(pair, PairBatch):
        from hybridvo.refinement.torch_backend import refine_batch

        return refine_batch(pair, T_init, weights, options=options.refine)
    check_kind("refine, a pair", pair, FramePair)
    seed = as_seed(seed, "refine.seed")
    if weights is not None and np.shape(weights) != pair.prev.camera.shape:
        raise InputError(
            f"refine: expected weights of shape {pair.prev.camera.shape}, got {np.shape(weights)}."
        )
    started = time.perf_counter()
    if T_init is None:
        motion = classical(pair, Context(options, None, seed, weights))
    else:
        T = as_rigid(T_init, "refine.T_init")
        motion = refine_pair(pair, T, weights=weights, options=options.refine)
    return motion.replace(ms=1e3 * (time.perf_counter() - started))


def warm_up(method: str = DEFAULT_METHOD, models: Models | None = None) -> float:
    """Compile and load everything before a first pair; seconds spent.

    A minute on the first call after an installation, a second after that.
    """
    started = time.perf_counter()
    if method in BASELINES:
        return 0.0
    context = Context(models=models or default_models(), check_flow=False)
    for height, width in WARM_UP_SIZES:
        camera = Camera(width, width, (width - 1) / 2, (height - 1) / 2, height, width)
        u, v = np.arange(width), np.arange(height)[:, None]
        depth = (4.0 + np.sin(u / 7.0) + np.cos(v / 5.0)).astype(np.float32)
        motion = se3_exp(np.array([0.02, -0.01, 0.05, 0.002, 0.004, -0.003]))
        flow = ego_flow(depth, motion, camera, camera).astype(np.float32)
        # a mask, a variance and a second motion: every branch is compiled
        flow[: height // 3, : width // 3] += 3.0
        rgb = (40 * (2 + np.sin(u / 3.0) + np.cos(v / 2.0)))[..., None].repeat(3, 2)
        frame = Frame(rgb.astype(np.uint8), depth, camera)
        variance = np.full((height, width), 0.01, np.float32)
        run_method(FramePair(frame, frame, flow, variance, flow[..., 0] < 1e3), method, context)
        run_method(FramePair(frame, frame, flow), method, context)
    return time.perf_counter() - started
