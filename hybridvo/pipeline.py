"""A pair in, its camera motion out: every method, and the stages it is made of.

Read this file first. The stages: *predict* (a network), *search* (every strong motion of the pair),
*select* (which one is the camera's, and where the scene is static), *refine* (on flow and depth),
*refine photometrically* (on the images). The public calls, :func:`estimate` and :func:`refine`,
check their arguments and stand at the end.
"""

from __future__ import annotations

import difflib
import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import numpy as np
from scipy.special import logit

from hybridvo.baselines import pnp, rgbd
from hybridvo.calibration import PWVO_RIGHT
from hybridvo.errors import InputError
from hybridvo.flow import FlowProvider, contradiction, dis_flow, with_flow
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.hypotheses.generate import HypothesisSet, generate
from hybridvo.hypotheses.selector import select_by_cues, select_by_scorer
from hybridvo.images.photometric import direct_start, refine_photometric
from hybridvo.network.models import SELECTION, Models, default_models, one_thread
from hybridvo.options import Options
from hybridvo.refinement import refine as refinement
from hybridvo.results import MotionPrediction, MotionPrior, Reason, RelativePose, right
from hybridvo.types import (
    Camera,
    Frame,
    FramePair,
    PairBatch,
    as_rigid,
    as_seed,
    check_kind,
    depth_advice,
    typical_depth,
)

DEFAULT_METHOD = "hybrid"
NETWORKS = tuple(SELECTION)
BASELINES = (*pnp.SOLVERS, *rgbd.ALIGNERS, "identity")
SELECTING = ("hybrid", "hybrid-flow")
"""Methods that ask the selector network."""
SEARCHING = (*SELECTING, "refine")
"""Methods that search every motion; their weights and covariance serve later stages."""
IDENTITY_STD = np.repeat([1.0, 0.3], 3)
"""Standard deviations of no motion, m and rad: those of a step of a hand-held camera at most."""
WARM_UP_SIZES = ((48, 64), (320, 400))
"""Height and width of the pairs of :func:`warm_up`; the second takes the parallel kernels."""


@dataclass(frozen=True, eq=False)
class Context:
    """What the methods need beside the pair, and the stages that come before the refinement.

    Args:
        options: the option tree.
        prior: what is known of the motion before the pair is seen, or None.
        seed: of everything drawn at random.
        weights: (H, W) factors on the information of each pixel, for the search, or None.
        models: the networks.
        check_flow: ask the images whether the flow can be theirs.
        flow: provider of the flow where a pair comes without, or None.
    """

    options: Options = field(default_factory=Options)
    prior: MotionPrior | None = None
    seed: int = 0
    weights: np.ndarray | None = None
    models: Models = field(default_factory=default_models)
    check_flow: bool = True
    flow: FlowProvider | None = None

    def with_flow(self, pair: FramePair) -> FramePair:
        """The pair with its flow, computed where it is not there."""
        return pair if pair.flow is not None or self.flow is None else with_flow(pair, self.flow)

    def direct(self, pair: FramePair) -> RelativePose | None:
        """The motion by images and depth maps alone, or None; surest where they explain all.

        Asked where the flow is computed from the same images: another one knows more than they.
        """
        mode, source = self.options.direct.mode, getattr(self.flow, "source", "")
        if pair.flow is not None:
            source = pair.flow_source
        if mode == "off" or (mode == "auto" and source != "dis"):
            return None
        T_start = None if self.prior is None else self.prior.T_curr_prev
        return direct_start(pair, T_start)

    def is_sure(self, motion: RelativePose) -> bool:
        """Whether its probability is high enough for a motion that is not degraded."""
        return motion.probability >= self.options.select.min_confidence

    def predict(self, pair: FramePair) -> MotionPrediction | None:
        """PWVO's motion and static probability; None where it has too little to see."""
        from hybridvo.network.prediction import propose_motion

        return propose_motion(self.models.network("pwvo"), pair)

    def search(self, pair: FramePair) -> HypothesisSet | RelativePose:
        """Every strong motion of a pair, from the identity and the prior; or the failure."""
        starts = [np.eye(4)] + ([] if self.prior is None else [self.prior.T_curr_prev])
        return generate(pair, np.stack(starts), self.options, self.seed, self.weights)

    def select(self, pair: FramePair, found: HypothesisSet) -> refinement.Selection:
        """The camera's motion by the learned selector, which asks PWVO where it is in doubt."""
        from hybridvo.network.selector_net import NetworkScorer

        look = partial(NetworkScorer, self.models.network("selector"))
        chosen = select_by_scorer(found, look, self.options, self.prior)
        if found.is_ambiguous and chosen.confidence < self.options.select.consult_below:
            prediction = self.predict(pair)
            if prediction is not None:
                chosen = select_by_scorer(found, look, self.options, self.prior, prediction)
        return chosen

    def refine(
        self, pair: FramePair, found: HypothesisSet, chosen: refinement.Selection
    ) -> RelativePose:
        """The motion selected, refined inside its static mask, with covariance and status."""
        grid = found.grid
        if chosen.mask is not None:
            grid = grid.within(pair, self.weights, chosen.mask)
        sure = self.options.select.min_confidence
        return refinement.refine_pair(
            pair, chosen, grid, options=self.options.refine, min_probability=sure
        )


def classical(pair: FramePair, ctx: Context) -> RelativePose:
    """Search, select by hand-made cues, refine."""
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return found
    return ctx.refine(pair, found, select_by_cues(found, ctx.prior))


@one_thread()
def hybrid_flow(pair: FramePair, ctx: Context) -> RelativePose:
    """Search, select by the network, ask PWVO where that is in doubt, refine."""
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return found
    return ctx.refine(pair, found, ctx.select(pair, found))


def hybrid(pair: FramePair, ctx: Context) -> RelativePose:
    """By images and depth alone where that explains them; else on flow, if that can be theirs.

    :func:`run_method` then refines on the images.
    """
    direct = ctx.direct(pair)
    if direct is not None and ctx.is_sure(direct):
        return direct
    pair = ctx.with_flow(pair)
    wrong = contradiction(pair) if ctx.check_flow else None
    if wrong:
        return RelativePose.failed(Reason.NO_FLOW, wrong)
    return hybrid_flow(pair, ctx)


@one_thread()
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
        batched = refine_batch(batch, seed.T_curr_prev, seed.weights, options=ctx.options.refine)
    found = batched.one(0)
    odds = float(logit(np.clip(found.probability, 1e-5, 1 - 1e-5)))
    found = found.replace(probability=right((odds,), PWVO_RIGHT) if found.usable else 0.0)
    if found.ok and not ctx.is_sure(found):
        found = found.replace(status=refinement.ambiguous(found.probability))
    return found


@one_thread()
def network_alone(name: str, pair: FramePair, ctx: Context) -> RelativePose:
    """A network alone, by the paper's selection."""
    from hybridvo.network.prediction import estimate_by_network

    return estimate_by_network(pair, name, ctx.models.network(name))


def baseline(name: str, pair: FramePair, ctx: Context) -> RelativePose:
    """An estimator of another library, or no motion: the floor that every method must beat."""
    if name == "identity":
        return RelativePose(covariance=np.diag(IDENTITY_STD**2))
    by = pnp.estimate_by_points if name in pnp.SOLVERS else rgbd.estimate_by_images
    return by(name, pair, ctx.seed)


METHODS: dict[str, Callable[[FramePair, Context], RelativePose]] = {
    "hybrid": hybrid,
    "hybrid-flow": hybrid_flow,
    "refine": classical,
    "pwvo-refine": pwvo_refine,
    **{name: partial(network_alone, name) for name in NETWORKS},
    **{name: partial(baseline, name) for name in BASELINES},
}
"""Every method, in the order of the results' tables."""


def run_method(pair: FramePair, method: str, ctx: Context) -> RelativePose:
    """:func:`estimate` for arguments that were checked."""
    check_method(method)
    started = time.perf_counter()
    if method != "hybrid":
        pair = ctx.with_flow(pair)
    found = METHODS[method](pair, ctx)
    if refines_images(method, ctx.options) and found.photometric is None:
        found = refine_photometric(pair, found)
    if found.status.ok and not found.status.message and pair.prev.depth is not None:
        median = typical_depth(pair.prev.depth[::8, ::8])
        if advice := "" if median is None else depth_advice(median):
            doubt = f"the median depth is {median:.4g}; Frame.depth expects metres: {advice}"
            found = found.replace(status=replace(found.status, message=doubt))
    if found.status.reason is Reason.AMBIGUOUS_MOTION and found.usable:
        found = refinement.widened(found)
    return found.replace(method=method, ms=1e3 * (time.perf_counter() - started))


def refines_images(method: str, options: Options) -> bool:
    """Whether a method ends with the photometric refinement."""
    mode = options.photometric.mode
    return method == "hybrid" if mode == "auto" else mode == "on" and method in SEARCHING


def networks_of(method: str) -> tuple[str, ...]:
    """Names of the weights that a method uses."""
    if method in SELECTING:
        return ("selector", "pwvo")
    if method == "pwvo-refine":
        return ("pwvo",)
    return (method,) if method in NETWORKS else ()


def weights_hash(method: str, models: Models | None = None) -> str | None:
    """SHA-256 over the weights that a method uses; None for a method without a network."""
    digest = hashlib.sha256()
    for name in networks_of(method):
        digest.update((models or default_models()).path(name).read_bytes())
    return digest.hexdigest() if networks_of(method) else None


def check_method(method: str) -> None:
    """Refuse a method that cannot run here.

    Raises:
        InputError: an unknown name (the nearest known one is named), or a baseline whose package is
            missing (with the command that installs it).
    """
    if method not in METHODS:
        near = difflib.get_close_matches(str(method), METHODS, n=1, cutoff=0.4)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(f"method: '{method}' is unknown{hint}; known: {', '.join(METHODS)}.")
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
        start = refinement.Selection(as_rigid(T_init, "refine.T_init"))
        motion = refinement.refine_pair(pair, start, weights=weights, options=options.refine)
    return motion.replace(ms=1e3 * (time.perf_counter() - started))


def warm_up(method: str = DEFAULT_METHOD, models: Models | None = None) -> float:
    """Compile and load everything before a first pair; seconds spent.

    A minute on the first call after an installation, a second after that.
    """
    started = time.perf_counter()
    context = Context(models=models or default_models(), check_flow=False)
    for height, width in () if method in BASELINES else WARM_UP_SIZES:
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
        pair = FramePair(frame, frame, flow)
        run_method(
            replace(pair, flow_variance=variance, flow_valid=flow[..., 0] < 1e3), method, context
        )
        run_method(pair, method, context)
        if method in SELECTING:  # what few pairs ask for
            context.predict(pair)
            context.direct(replace(pair, flow_source="dis"))
    return time.perf_counter() - started
