"""A pair in, its camera motion out: every method, as a composition of stages.

Read this file first. The stages are *direct* (on images and depth, without flow), *search* (every
strong motion of the pair), *select* (PWVO looks at each: which one is the camera's, from which pose
to start, and where the scene is static), *refine* (on flow and depth) and *refine photometrically*
(on the images).
"""

from __future__ import annotations

import contextlib
import difflib
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np

from hybridvo import baselines
from hybridvo.calibration import (
    DIRECT_PROBABILITY,
    IDENTITY_STD,
    MIN_FLOW_COVERAGE,
    NO_MOTION_PROBABILITY,
)
from hybridvo.depth_units import depth_unit_warning
from hybridvo.errors import InputError
from hybridvo.flow import (
    FlowAhead,
    FlowProvider,
    contradiction,
    dis_flow,
    with_flow,
)
from hybridvo.hypotheses.generate import generate, static_grid
from hybridvo.hypotheses.matches import GuidedFlow, matched_motions
from hybridvo.hypotheses.select import select_by_cues, select_by_scorer
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.models import SELECTION, Models, default_models
from hybridvo.options import Options
from hybridvo.photometric.consistency import verified
from hybridvo.photometric.direct import direct_start
from hybridvo.photometric.refine import refine_photometric
from hybridvo.refinement import refine as refinement
from hybridvo.refinement.depth import compare_depths
from hybridvo.refinement.status import inflate_ambiguous_covariance
from hybridvo.results import (
    MotionPrior,
    Reason,
    RelativePose,
    StageFailed,
    Status,
)
from hybridvo.shutter import at_one_time, readout_per_row
from hybridvo.types import FramePair, PairBatch

DEFAULT_METHOD = "hybrid"
_logger = logging.getLogger(__name__)


class Effort(Enum):
    """Which of the ways to a motion are tried."""

    ALL = "all"
    ONLY_NEAR = "near"  # not those for steps that are too wide for flow
    ONLY_WIDE = "wide"


class Attempt(NamedTuple):
    """A pair with its flow, and the motion from which that was found, if from one."""

    pair: FramePair
    guide: np.ndarray | None = None  # T_curr_prev


@dataclass(frozen=True, eq=False)
class Context:
    """What the methods need beside the pair, and the stages."""

    options: Options = field(default_factory=Options)
    prior: MotionPrior | None = None  # what is known without the pair
    seed: int = 0
    # (H, W) factors on the information of each pixel
    weights: np.ndarray | None = None
    models: Models = field(default_factory=default_models)
    flow: FlowProvider | None = None  # where a pair comes without
    # T_curr_prev near which the motion is, where that is known
    start: np.ndarray | None = None
    # on the clock of time.perf_counter; None: there is time
    deadline: float | None = None
    # whether images and depth alone did not explain the pair before this one
    expects_flow: bool = False
    effort: Effort = Effort.ALL
    # the flow of this pair, already being computed
    ahead: FlowProvider | None = None

    def flow_source(self, pair: FramePair, found: RelativePose) -> str:
        """What an answer's flow comes from; ``dis`` where that is its images themselves."""
        if "flow" not in found.terms and "images" in found.terms:
            return "dis"
        return self._stated_source(pair) or "callable"

    def _stated_source(self, pair: FramePair) -> str:
        """The source of a pair's flow, which may not be computed yet; empty if unknown."""
        if pair.flow is not None:
            return pair.flow_source
        return getattr(self.flow, "source", "")

    def direct(self, pair: FramePair) -> RelativePose | None:
        """The motion by images and depth maps alone, where that is sure; else None."""
        if self.effort is Effort.ONLY_WIDE:
            return None
        mode = self.options.direct.mode
        source = self._stated_source(pair)
        # flow that is not computed from the same images knows more than they
        if mode == "off" or (mode == "auto" and source != "dis"):
            return None
        start = None if self.prior is None else self.prior.T_curr_prev
        found = direct_start(pair, start, DIRECT_PROBABILITY)
        if found is None:
            return None
        depths = compare_depths(pair, found.T_curr_prev, found.weights)
        return found if depths is None or depths.status.ok else None

    def wide_starts(self, pair: FramePair) -> Iterator[Attempt]:
        """Motions from sparse matches, and the flow that is found from them."""
        if (
            self.options.search.matches == "off"
            or self._stated_source(pair) != "dis"
        ):
            return
        provider = self.flow if pair.flow is None else dis_flow()
        if provider is None:
            return
        without_flow = replace(pair, flow=None)
        for T in matched_motions(pair, self.seed):
            guided = with_flow(without_flow, GuidedFlow(provider, T))
            if guided.flow is not None:
                yield Attempt(guided, T)

    def search(
        self, pair: FramePair, start: np.ndarray | None = None
    ) -> HypothesisSet:
        """Every strong motion below the sky, from the identity, the prior and a start."""
        starts = [np.eye(4)]
        if self.prior is not None:
            starts.append(self.prior.T_curr_prev)
        if start is not None:
            starts.append(start)
        return generate(
            pair, np.stack(starts), self.options, self.seed, self.weights
        )

    def select(self, found: HypothesisSet) -> refinement.Selection:
        """The camera's motion: PWVO looks at every hypothesis, and seeds the best."""
        from hybridvo.network.scorer import PWVOScorer
        from hybridvo.network.threads import single_threaded_inference

        with single_threaded_inference():
            scorer = PWVOScorer(self.models.network("pwvo"), found, self.prior)
            return select_by_scorer(found, scorer, self.options)

    def refine(
        self, pair: FramePair, found: HypothesisSet, chosen: refinement.Selection
    ) -> RelativePose:
        """The motion selected, refined inside its static mask, with covariance and status."""
        options = self.options.refine
        grid = static_grid(found, pair, chosen.mask, self.weights, options)
        return refinement.refine_pair(
            pair, chosen, grid, None, options, self.options.select.min_probability
        )


def is_late(deadline: float | None) -> bool:
    """Whether the time of a frame is over: what only improves an answer is then left out."""
    return deadline is not None and time.perf_counter() > deadline


def flow_of(pair: FramePair, ctx: Context) -> FramePair:
    """The pair with its flow; fails where the flow cannot be that of the images."""
    pair = with_flow(pair, ctx.flow)
    check_images(pair)
    return pair


def check_images(pair: FramePair) -> None:
    """Fail where the flow cannot be that of the images."""
    if wrong := contradiction(pair):
        raise StageFailed(Reason.NO_FLOW, wrong)


def check_flow(pair: FramePair) -> None:
    """Fail where flow cannot be that of the images, or where the step is too wide for it."""
    check_images(pair)
    if pair.flow_source != "dis" or pair.flow_valid is None:
        return
    # hardly any of it is the same both ways
    covered = float(np.mean(pair.flow_valid))
    if covered < MIN_FLOW_COVERAGE:
        text = f"{100 * covered:.0f} % of the flow is the same in both directions"
        raise StageFailed(Reason.NO_FLOW, text)


def classical(pair: FramePair, ctx: Context) -> RelativePose:
    """Search, select by hand-made cues, refine; from a known start refine at once."""
    pair = flow_of(pair, ctx)
    if ctx.start is not None:
        known = refinement.Selection(ctx.start)
        return refinement.refine_pair(
            pair, known, None, ctx.weights, ctx.options.refine
        )
    found = ctx.search(pair)
    return ctx.refine(pair, found, select_by_cues(found, ctx.prior))


def hybrid_flow(pair: FramePair, ctx: Context) -> RelativePose:
    """Search, let PWVO look at every hypothesis, select, refine."""
    return on_flow(pair, ctx)[1]


class OnFlow(NamedTuple):
    """A pair with its flow, and the motion found on it."""

    pair: FramePair
    found: RelativePose


def on_flow(pair: FramePair, ctx: Context) -> OnFlow:
    """The same; where the answer is not sure, once more from other flow of the images.

    A failure of the first try is that of the answer where no other one knows better.
    """
    failure: StageFailed | None = None
    best: OnFlow | None = None
    for attempt in attempts(pair, ctx):
        try:
            if attempt.guide is None:
                check_flow(attempt.pair)
            found = _searched(attempt.pair, ctx, attempt.guide)
        except StageFailed as error:
            failure = failure or error
            continue
        if best is None or found.rank > best.found.rank:
            best = OnFlow(attempt.pair, found)
        if best.found.ok or (best.found.usable and is_late(ctx.deadline)):
            break
    if best is None:
        nothing = StageFailed(Reason.NO_FLOW, "no motion by sparse matches")
        raise failure or nothing
    return best


def attempts(pair: FramePair, ctx: Context) -> Iterator[Attempt]:
    """The pair with flow that was found in different ways, the likeliest first."""
    if ctx.effort is not Effort.ONLY_WIDE:
        yield Attempt(with_flow(pair, ctx.ahead or ctx.flow))
    if ctx.effort is not Effort.ONLY_NEAR:
        yield from ctx.wide_starts(pair)


def _searched(
    pair: FramePair, ctx: Context, start: np.ndarray | None = None
) -> RelativePose:
    """Search from the usual starts and one more, select, refine."""
    found = ctx.search(pair, start)
    return ctx.refine(pair, found, ctx.select(found))


def hybrid(pair: FramePair, ctx: Context) -> RelativePose:
    """By images and depth alone where that explains them; else on flow, then on the images."""
    with flow_ahead(pair, ctx) as ctx:
        direct = ctx.direct(pair)
        if direct is not None:
            return direct
        pair, found = on_flow(pair, ctx)
    return on_images(pair, found, ctx)


@contextlib.contextmanager
def flow_ahead(pair: FramePair, ctx: Context) -> Iterator[Context]:
    """Compute a pair's flow on a second core meanwhile, where it will be needed."""
    # a callable of the user's may not be called from another thread
    is_ours = getattr(ctx.flow, "source", "") == "dis"
    is_needed = ctx.expects_flow and ctx.effort is not Effort.ONLY_WIDE
    if ctx.flow is None or not (is_ours and is_needed) or pair.flow is not None:
        yield ctx
        return
    with FlowAhead(ctx.flow, pair.prev, pair.curr) as ahead:
        yield replace(ctx, ahead=ahead)


def on_images(pair: FramePair, found: RelativePose, ctx: Context) -> RelativePose:
    """A motion, refined on the two images where that is wanted and possible."""
    # images know no better which of two depths that differ is right
    contradicted = found.status.reason is Reason.NO_VALID_DEPTH
    is_off = ctx.options.photometric.mode == "off" or is_late(ctx.deadline)
    if is_off or contradicted:
        return found
    return refine_photometric(pair, found)


def pwvo_refine(pair: FramePair, ctx: Context) -> RelativePose:
    """The same look and selection, refined in torch, on its device; then on the images.

    The same lines serve batches, with gradients to flow, depth, weights and maps.
    """
    from hybridvo.network.pair_maps import predict_pairs
    from hybridvo.network.selection import select
    from hybridvo.network.threads import single_threaded_inference
    from hybridvo.refinement.torch_backend import refine_batch

    network = ctx.models.network("pwvo")
    pair = flow_of(pair, ctx)
    with single_threaded_inference():
        maps = predict_pairs(network, [pair], [ctx.prior], ctx.options, ctx.seed)
        seed = select(maps)
        found = refine_batch(
            PairBatch.from_pairs([pair], device=ctx.models.device),
            seed.T_curr_prev,
            seed.weights,
            options=ctx.options.refine,
            min_probability=ctx.options.select.min_probability,
        )
    return on_images(pair, found.one(0), ctx)


def pwvo(pair: FramePair, ctx: Context) -> RelativePose:
    """PWVO alone: the pose that is selected from those of all pixels."""
    from hybridvo.network.prediction import estimate_by_pwvo

    pair = with_flow(pair, ctx.flow)
    network = ctx.models.network("pwvo")
    return estimate_by_pwvo(pair, network, ctx.prior, ctx.options, ctx.seed)


def network_alone(name: str, pair: FramePair, ctx: Context) -> RelativePose:
    """A network of the paper alone, by the paper's selection."""
    from hybridvo.network.prediction import estimate_by_network

    return estimate_by_network(
        with_flow(pair, ctx.flow), SELECTION[name], ctx.models.network(name)
    )


def baseline(name: str, pair: FramePair, ctx: Context) -> RelativePose:
    """An estimator of another library, from the expected motion where it takes a start."""
    if name not in baselines.WITHOUT_FLOW:
        pair = with_flow(pair, ctx.flow)
    start = ctx.start
    if start is None and ctx.prior is not None:
        start = ctx.prior.T_curr_prev
    return baselines.estimate(name, pair, ctx.seed, start=start)


def identity(pair: FramePair, ctx: Context) -> RelativePose:
    """No motion: the floor that every method must beat."""
    return RelativePose(covariance=identity_covariance())


def identity_covariance() -> np.ndarray:
    """(6, 6) covariance, m^2 and rad^2, of no motion as an estimate of a step."""
    return np.diag(np.repeat(IDENTITY_STD, 3) ** 2)


def _missing_torch_geometry(method: str) -> str:
    """Return why a method that is refined in torch cannot run here; empty where it can."""
    if method not in REFINED_IN_TORCH:
        return ""
    absent = [name for name in TORCH_GEOMETRY if find_spec(name) is None]
    if not absent:
        return ""
    return f"{absent[0]} is not installed; pip install 'hybridvo[train]'"


METHODS: dict[str, Callable[[FramePair, Context], RelativePose]] = {
    "hybrid": hybrid,
    "hybrid-flow": hybrid_flow,
    "classical": classical,
    "pwvo-refine": pwvo_refine,
    "pwvo": pwvo,
    **{name: partial(network_alone, name) for name in SELECTION},
    **{name: partial(baseline, name) for name in baselines.METHODS},
    "identity": identity,
}
"""Every method, in the order of the results' tables."""
REFINED_IN_TORCH = ("pwvo-refine",)
"""Methods that need the libraries of the extra ``train``."""
TORCH_GEOMETRY = ("pypose", "kornia")
"""These libraries, which ``hybridvo.torch_geometry`` imports."""
WIDE_METHODS = ("hybrid", "hybrid-flow")
"""Methods that go on with sparse matches where the step is too wide for flow."""
EARLIER_NAMES = {"refine": "classical"}
"""Names of methods that still work, and what they are called now."""
VERIFIED = ("hybrid", "hybrid-flow", "classical", "pwvo-refine", "pwvo")
"""Methods whose answers are held against images and depth maps: those of other libraries and the
paper's rows are shown as they are."""
NETWORKS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("hybrid", "hybrid-flow", "pwvo-refine", "pwvo"), ("pwvo",)),
    **{name: (name,) for name in SELECTION},
}
"""Names of the weights that a method uses, where it uses any."""


def run_method(pair: FramePair, method: str, ctx: Context) -> RelativePose:
    """The motion of a pair by a method, with its name and the milliseconds it took."""
    started = time.perf_counter()
    if readout_per_row(pair) > 0:
        pair = at_one_time(with_flow(pair, ctx.flow))
    try:
        found = METHODS[method](pair, ctx)
    except StageFailed as failure:
        found = RelativePose.failed(failure.reason, str(failure))
    if found.usable and found.probability < NO_MOTION_PROBABILITY:
        text = (
            f"the motion found has a probability of {100 * found.probability:.0f} %"
        )
        found = RelativePose.failed(Reason.AMBIGUOUS_MOTION, text)
    if found.usable and found.status.reason is Reason.AMBIGUOUS_MOTION:
        found = inflate_ambiguous_covariance(found)
    if method in VERIFIED:
        found = verified(pair, found, ctx.flow_source(pair, found))
    if warning := depth_unit_warning(pair.prev.depth):
        found = found.replace(status=_in_another_unit(found.status, warning))
    return found.replace(method=method, ms=1e3 * (time.perf_counter() - started))


def _in_another_unit(status: Status, warning: str) -> Status:
    """The status of a motion whose depth cannot be in metres: much else may follow from that."""
    if status.ok:
        return Status.degraded(Reason.DEPTH_UNIT, warning)
    # found before the values of depth mattered
    is_independent = status.reason in (Reason.NO_FLOW, Reason.MISSING_FRAME)
    reason = status.reason if is_independent else Reason.DEPTH_UNIT
    return Status(status.state, reason, f"{warning}; besides, {status.message}")


def check_method(method: str) -> str:
    """Return the name of a method as it is today; an earlier name works, and the log states it.

    Raises:
        InputError: The method is unknown, or a package that it needs is missing.
    """
    if method in EARLIER_NAMES:
        _logger.warning(
            "the method %s is called %s now", method, EARLIER_NAMES[method]
        )
        method = EARLIER_NAMES[method]
    if method not in METHODS:
        near = difflib.get_close_matches(str(method), METHODS, n=1, cutoff=0.4)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise InputError(
            f"method: '{method}' is unknown{hint}; known: {', '.join(METHODS)}."
        )
    if NETWORKS.get(method) and find_spec("torch") is None:
        raise InputError(
            f"method '{method}' cannot run here: torch is not installed."
        )
    reason = baselines.missing(method) or _missing_torch_geometry(method)
    if reason:
        raise InputError(f"method '{method}' cannot run here: {reason}.")
    return method
