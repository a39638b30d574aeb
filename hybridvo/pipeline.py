"""A pair in, its camera motion out: every method, and the stages it is made of.

Read this file first. The stages: *predict* (a network), *search* (every strong motion of the pair),
*select* (which one is the camera's, and where the scene is static), *refine* (on flow and depth),
*refine photometrically* (on the images).
"""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from hybridvo.baselines import pnp, rgbd
from hybridvo.errors import CheckpointError, InputError
from hybridvo.flow import contradiction
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.hypotheses.generate import HypothesisSet, generate
from hybridvo.hypotheses.selector import CueSelector, MaskSelector, Selection, Selector
from hybridvo.network.models import Models, default_models, one_thread
from hybridvo.options import Options
from hybridvo.refinement import refine as stage
from hybridvo.refinement.photometric import refine_photometric
from hybridvo.results import MotionPrediction, MotionPrior, Reason, RelativePose
from hybridvo.types import Camera, Frame, FramePair, PairBatch, as_rigid, as_seed
from hybridvo.units import depth_advice, typical_depth

if TYPE_CHECKING:
    from hybridvo.refinement.batch import BatchedPose

DEFAULT_METHOD = "hybrid"
IDENTITY_STD = np.repeat([1.0, 0.3], 3)
"""Standard deviations of no motion, m and rad: those of a step of a hand-held camera at most."""
WARM_UP_SIZES = ((48, 64), (320, 400))
"""Height and width of the pairs of :func:`warm_up`; the second takes the parallel kernels."""


@dataclass(frozen=True, eq=False)
class Context:
    """What the methods need beside the pair.

    Args:
        options: the option tree.
        prior: what is known of the motion before the pair is seen, or None.
        seed: of everything drawn at random.
        weights: (H, W) factors on the information of each pixel, for the search, or None.
        models: the networks.
        check_flow: ask the images whether the flow can be theirs.
    """

    options: Options = field(default_factory=Options)
    prior: MotionPrior | None = None
    seed: int = 0
    weights: np.ndarray | None = None
    models: Models = field(default_factory=default_models)
    check_flow: bool = True

    def search(self, pair: FramePair) -> HypothesisSet | RelativePose:
        """Every strong motion of a pair, from the identity and the prior; or the failure."""
        starts = [np.eye(4)] + ([] if self.prior is None else [self.prior.T_curr_prev])
        return generate(pair, np.stack(starts), self.options, self.seed, self.weights)

    def selector(self) -> Selector:
        """The learned selector."""
        from hybridvo.network.selector_net import NetworkScorer

        scorer = NetworkScorer(self.models.network("selector"), self.models.device)
        return MaskSelector(scorer, self.options)

    def predict(self, pair: FramePair) -> MotionPrediction | None:
        """PWVO's motion and static probability; None where it has too little to see."""
        from hybridvo.network.prediction import propose_motion

        return propose_motion(self.models.network("pwvo"), pair)


def refine_selection(
    pair: FramePair, found: HypothesisSet, chosen: Selection, ctx: Context
) -> RelativePose:
    """The motion selected, refined inside its static mask, with covariance and status."""
    grid = found.grid
    if chosen.mask is not None:
        grid = grid.within(pair, ctx.weights, chosen.mask)
    context = stage.Context(
        noise=chosen.noise,
        coverage=chosen.coverage,
        probability=chosen.probability,
        min_probability=ctx.options.select.min_confidence,
        hypotheses=chosen.hypotheses,
        iterations=chosen.iterations,
    )
    return stage.refine_pair(
        pair, chosen.T_curr_prev, grid, options=ctx.options.refine, context=context
    )


def classical(pair: FramePair, ctx: Context) -> RelativePose:
    """Search, select by hand-made cues, refine."""
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return found
    return refine_selection(pair, found, CueSelector().select(found, ctx.prior), ctx)


def hybrid_flow(pair: FramePair, ctx: Context) -> RelativePose:
    """Search, select by the network, ask PWVO where that is in doubt, refine."""
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return found
    selector = ctx.selector()
    chosen = selector.select(found, ctx.prior)
    if found.is_ambiguous and chosen.confidence < ctx.options.select.consult_below:
        prediction = ctx.predict(pair)
        if prediction is not None:
            chosen = selector.select(found, ctx.prior, prediction)
    return refine_selection(pair, found, chosen, ctx)


def hybrid(pair: FramePair, ctx: Context) -> RelativePose:
    """The same, and then refined photometrically where the images allow it."""
    wrong = contradiction(pair) if ctx.check_flow else None
    if wrong is not None:
        return RelativePose.failed(Reason.NO_FLOW, wrong)
    return hybrid_flow(pair, ctx)


def pwvo_refine(pair: FramePair, ctx: Context) -> RelativePose:
    """PWVO's selected motion and uncertainty seed and weigh the refinement in torch, on its device.

    The same lines serve batches, with gradients to flow, depth, weights and maps.
    """
    from hybridvo.network.layers import plain_torch
    from hybridvo.network.selection import select
    from hybridvo.refinement.torch_backend import refine_batch

    network = ctx.models.network("pwvo")
    with plain_torch():
        batch = PairBatch.from_pairs([pair], device=ctx.models.device)
        seed = select(network(batch))
        return refine_batch(batch, seed.T_curr_prev, seed.weights, options=ctx.options.refine).one(
            0
        )


def network_alone(name: str) -> Callable[[FramePair, Context], RelativePose]:
    """A network alone, by the paper's selection."""

    def run(pair: FramePair, ctx: Context) -> RelativePose:
        from hybridvo.network.prediction import estimate_by_network

        return estimate_by_network(pair, name, ctx.models.network(name))

    return run


def points_alone(name: str) -> Callable[[FramePair, Context], RelativePose]:
    """A point solver of another library."""
    return lambda pair, ctx: pnp.estimate_by_points(name, pair, ctx.seed)


def images_alone(name: str) -> Callable[[FramePair, Context], RelativePose]:
    """RGB-D odometry of another library."""
    return lambda pair, ctx: rgbd.estimate_by_images(name, pair, ctx.seed)


def identity(pair: FramePair, ctx: Context) -> RelativePose:
    """No motion, with a fixed covariance: the floor that every method must beat."""
    return RelativePose(covariance=np.diag(IDENTITY_STD**2))


NETWORKS = ("pwvo", "pwvo-naive", "pixelwise", "vonet", "vonet-attention")
BASELINES = (*pnp.SOLVERS, *rgbd.ALIGNERS, "identity")
METHODS: dict[str, Callable[[FramePair, Context], RelativePose]] = {
    "hybrid": hybrid,
    "hybrid-flow": hybrid_flow,
    "refine": classical,
    "pwvo-refine": pwvo_refine,
    **{name: network_alone(name) for name in NETWORKS},
    **{name: points_alone(name) for name in pnp.SOLVERS},
    **{name: images_alone(name) for name in rgbd.ALIGNERS},
    "identity": identity,
}
"""Every method, in the order of the results' tables."""
SELECTING = ("hybrid", "hybrid-flow")
"""Methods that ask the selector network."""


def networks_of(method: str) -> tuple[str, ...]:
    """Names of the weights that a method uses."""
    if method in SELECTING:
        return ("selector", "pwvo")
    if method == "pwvo-refine":
        return ("pwvo",)
    return (method,) if method in NETWORKS else ()


def check_method(method: str, models: Models | None = None) -> None:
    """Refuse a method that cannot run here.

    Raises:
        InputError: an unknown name (the nearest known one is named), a method whose network has no
            weights yet, or a baseline whose package is missing (with the command that installs it).
    """
    if method not in METHODS:
        near = difflib.get_close_matches(str(method), METHODS, n=1, cutoff=0.4)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(f"method: '{method}' is unknown{hint}; known: {', '.join(METHODS)}.")
    for name in networks_of(method):
        try:
            (models or default_models()).path(name)
        except CheckpointError:
            raise InputError(
                f"method '{method}' needs the weights '{name}', which this version does not have; "
                f"use --method refine (the classical refinement), or --weights {name}=FILE."
            ) from None
    if method in BASELINES and method in (absent := pnp.missing()):
        raise InputError(f"method '{method}' cannot run here: {absent[method]}.")


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
        method: one of :data:`METHODS` that can run here.
        prior: what is known of the motion: one more start, and a cue for the selection.
        options: the option tree; ``search``, ``select``, ``refine``, ``photometric``, and
            ``run.device`` and ``flow`` are read.
        models: networks of one's own; by default the pretrained ones.
        seed: of everything that is drawn at random.

    Returns:
        ``T_curr_prev`` with covariance and status. Bad data give a failed status, never an
        exception and never a value that is not finite.

    Raises:
        InputError: an unknown method, or one that cannot run here; an argument of another kind.

    Example:
        >>> import numpy as np
        >>> from hybridvo.types import Camera, Frame, FramePair
        >>> frame = Frame(None, np.ones((24, 32)), Camera(30, 30, 15.5, 11.5, 24, 32))
        >>> estimate(FramePair(frame, frame, None)).status.reason.value
        'no_flow'
    """
    options = Options() if options is None else options
    _check_kind("options", options, Options)
    if curr is not None or isinstance(pair, Frame):
        pair = _pair_of(pair, curr, options)
    if not isinstance(pair, FramePair):
        raise InputError(
            f"estimate: expected a FramePair or two Frames, got {type(pair).__name__}."
        )
    if prior is not None:
        _check_kind("prior", prior, MotionPrior)
    seed = as_seed(seed, "estimate.seed")
    models = models or default_models(options.run.device if networks_of(method) else "cpu")
    return run_method(pair, method, Context(options, prior, seed, None, models))


def run_method(pair: FramePair, method: str, ctx: Context) -> RelativePose:
    """:func:`estimate` for arguments that were checked."""
    check_method(method, ctx.models)
    started = time.perf_counter()
    with one_thread() if networks_of(method) else contextlib.nullcontext():
        found = METHODS[method](pair, ctx)
    mode = ctx.options.photometric.mode
    if (mode == "on" and method in (*SELECTING, "refine")) or (
        mode == "auto" and method == "hybrid"
    ):
        found = refine_photometric(pair, found, ctx.options.photometric)
    found = stage.widened(found)
    if found.status.ok and not found.status.message and (doubt := _depth_doubt(pair)):
        found = found.replace(status=replace(found.status, message=doubt))
    return found.replace(method=method, ms=1e3 * (time.perf_counter() - started))


def refines_images(method: str, options: Options) -> bool:
    """Whether a method ends with the photometric refinement."""
    if options.photometric.mode == "auto":
        return method == "hybrid"
    return options.photometric.mode == "on" and method in (*SELECTING, "refine")


def _check_kind(name: str, value: Any, kind: type) -> None:
    if not isinstance(value, kind):
        got = type(value).__name__
        raise InputError(f"estimate.{name}: expected {kind.__name__}, got {got}.")


def _pair_of(prev: Any, curr: Any, options: Options) -> FramePair:
    """A pair of two frames with DIS flow between them."""
    from hybridvo.flow import dis_flow

    for name, frame in (("first", prev), ("second", curr)):
        if not isinstance(frame, Frame):
            got = type(frame).__name__
            raise InputError(f"estimate: expected a Frame as the {name} of two, got {got}.")
    flow = dis_flow(options.flow.dis_preset, options.flow.forward_backward)(prev, curr)
    return FramePair(prev, curr, flow.flow, flow.variance, flow.valid, flow.source, flow.is_true)


def _depth_doubt(pair: FramePair) -> str:
    """A sentence where depth is hardly in metres; empty where it can be."""
    median = None if pair.prev.depth is None else typical_depth(pair.prev.depth[::8, ::8])
    advice = "" if median is None else depth_advice(median)
    if not advice:
        return ""
    return f"the median depth is {median:.4g}; Frame.depth expects metres: {advice}"


@overload
def refine(
    pair: FramePair,
    T_init: np.ndarray | None = None,
    weights: np.ndarray | None = None,
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
    options: Options | None = None,
    seed: int = 0,
) -> BatchedPose: ...


def refine(
    pair: FramePair | PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    options: Options | None = None,
    seed: int = 0,
) -> RelativePose | BatchedPose:
    """Camera motion by robust dense reprojection, without any network.

    Args:
        pair: a :class:`FramePair` (numpy), or a :class:`PairBatch` (torch) for the batched,
            differentiable path, see :func:`hybridvo.refinement.torch_backend.refine_batch`: that
            one draws nothing at random, and follows the largest motion where nothing is handed in.
        T_init: (4, 4) T_curr_prev, the only start, from which the fit may leave for a larger motion
            unless weights hold it; None: every strong motion is searched, and hand-made cues say
            which is the camera's.
        weights: (H, W) factors on the information of each pixel; 0 and NaN switch a pixel off.
        options: ``search`` and ``refine`` are read.
        seed: of the search.

    Returns:
        The motion with covariance and status (for a :class:`PairBatch` a ``BatchedPose``). Bad data
        give a failed status, never an exception and never a value that is not finite.

    Raises:
        InputError: an argument of another kind or shape, or a start that is no rigid transform.
    """
    options = Options() if options is None else options
    _check_kind("options", options, Options)
    if isinstance(pair, PairBatch):
        from hybridvo.refinement.torch_backend import refine_batch

        return refine_batch(pair, T_init, weights, options=options.refine)
    if not isinstance(pair, FramePair):
        raise InputError(f"refine: expected a FramePair or a PairBatch, got {type(pair).__name__}.")
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
        motion = stage.refine_pair(pair, T, weights=weights, options=options.refine)
    return motion.replace(ms=1e3 * (time.perf_counter() - started))


def weights_hash(method: str, models: Models | None = None) -> str | None:
    """SHA-256 over the weights that a method uses; None for a method without a network."""
    digest = hashlib.sha256()
    for name in networks_of(method):
        digest.update((models or default_models()).path(name).read_bytes())
    return digest.hexdigest() if networks_of(method) else None


def warm_up(method: str = DEFAULT_METHOD, models: Models | None = None) -> float:
    """Compile the kernels (or read them from numba's cache) and the networks before a first pair.

    Returns:
        Seconds spent: a minute on the first call after an installation, a second after that.
    """
    started = time.perf_counter()
    if method in BASELINES:
        return 0.0
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
        valid = np.ones((height, width), np.bool_)
        variance = np.full((height, width), 0.01, np.float32)
        context = Context(models=models or default_models(), check_flow=False)
        for pair in (
            FramePair(frame, frame, flow, variance, valid),
            FramePair(frame, frame, flow),
        ):
            run_method(pair, method, context)
    return time.perf_counter() - started
