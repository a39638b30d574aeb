"""A pair in, its camera motion out: every method, as a composition of stages.

Read this file first. What is measured of a pair is its evidence; sources find motions in it, the
cheapest source first: the images and depth maps alone, then flow, then flow found from sparse
matches. PWVO scores all motions of all flows so far (*select*); the best one is fitted to flow
and depth inside its static mask (*refine*), and at the end to the images. A method yields an answer
after each source; the first one that is sure is taken, or the last.
"""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridvo.core import laboratory
from hybridvo.core.belief import resized
from hybridvo.core.errors import InputError, did_you_mean
from hybridvo.core.options import Options
from hybridvo.core.results import (
    Motion,
    MotionPrior,
    Reason,
    RelativePose,
    Rival,
    StageFailed,
    Status,
    Term,
    identity_covariance,
)
from hybridvo.core.stages import stage
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.evidence.one_time import (
    is_of_one_time,
    pair_at_image_times,
    rough_motion,
)
from hybridvo.evidence.pair import FlowEvidence, PairEvidence, check_images
from hybridvo.evidence.remembered import Remembered
from hybridvo.flow.providers import FlowProvider, have_texture, with_flow
from hybridvo.hypotheses.generate import static_grid
from hybridvo.hypotheses.select import (
    Ranking,
    rank_by_scorer,
    select_by_cues,
    select_from,
    select_rival,
)
from hybridvo.judge.calibration import DIRECT_PROBABILITY
from hybridvo.judge.probability import probability_of, surest_evidence
from hybridvo.judge.verdict import believed, judge
from hybridvo.network.models import Models, default_models
from hybridvo.solver import refine_flow as refinement
from hybridvo.solver.align import PRIOR_COVARIANCE, Aligned, align_images
from hybridvo.solver.depth_alone import follow_depth
from hybridvo.solver.depths import compare_depths
from hybridvo.solver.refine_images import refine_photometric

if TYPE_CHECKING:
    from hybridvo.network.scorer import PWVOScorer

DEFAULT_METHOD = "hybrid"
# where nothing is expected of a motion
UNKNOWN_MOTION = MotionPrior(np.eye(4), PRIOR_COVARIANCE)
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Context:
    """What is the same for every pair of a program.

    Attributes:
        options: the option tree.
        models: the networks.
        flow: computes flow where a pair comes without.
        seed: of the random samples.
    """

    options: Options = field(default_factory=Options)
    models: Models = field(default_factory=default_models)
    flow: FlowProvider | None = None
    seed: int = 0

    @property
    def looking(self) -> Context:
        """The same where images alone are not asked: they are sure of what fills the view."""
        direct = replace(self.options.direct, mode="off")
        return replace(self, options=replace(self.options, direct=direct))

    def evidence(
        self,
        pair: FramePair,
        expected: MotionPrior | None = None,
        weights: np.ndarray | None = None,
        start: np.ndarray | None = None,
        remembered: Remembered | None = None,
        near: np.ndarray | None = None,
    ) -> PairEvidence:
        """What can be measured of a pair."""
        return PairEvidence(
            pair,
            self.options,
            expected,
            self.flow,
            weights,
            start,
            self.seed,
            remembered,
            near,
        )


# -- the sources ---------------------------------------------------------------------


@stage("images alone")
def by_images(evidence: PairEvidence) -> Motion | None:
    """The motion by images and depth maps alone, where that is sure; else None."""
    mode = evidence.options.direct.mode
    # flow that is not computed from the same images knows more than they
    is_left_out = mode == "auto" and not evidence.flow_is_of_the_images
    if mode == "off" or is_left_out:
        return None
    expected = evidence.expected
    start = None if expected is None else expected.T_curr_prev
    is_near = evidence.near is not None
    if is_near:
        start = evidence.near
    pair = evidence.pair
    refine = evidence.options.refine
    rough = align_images(pair, start, refine, evidence.ready_belief, is_near)
    motion = sure_alignment(rough, DIRECT_PROBABILITY)
    if motion is None:
        return None
    depths = compare_depths(pair, motion.T_curr_prev, motion.weights)
    agree = depths is None or depths.status.ok
    return motion if agree else None


def sure_alignment(rough: Aligned | None, least: float) -> Motion | None:
    """The refined motion of images that were roughly aligned; None where it is less probable."""
    # rejected early where it would not be right even if it were precise
    if rough is None or probability_of(surest_evidence(rough).evidence) < least:
        return None
    aligned = rough.refined()
    if aligned is None:
        return None
    motion = surest_evidence(aligned)
    return motion if probability_of(motion.evidence) >= least else None


def by_flow(
    evidence: PairEvidence, ctx: Context, solve: Solver | None = None
) -> Iterator[Motion]:
    """The motion by PWVO's look at all motions, in one more flow of the images each time.

    Where a flow shows nothing the answer stays; a failure is that of the first flow.
    """
    solve = solve or solve_in_numba
    looks: list[Look] = []
    failure: Motion | None = None
    for flow in evidence.flows():
        try:
            looks.append(look_at(flow, ctx))
            yield solve(looks, ctx)
        except StageFailed as error:
            failure = failure or failed(error)
            if not looks:
                yield failure


@stage("images alone")
def by_depth(evidence: PairEvidence) -> Motion | None:
    """The motion by depth maps and what is expected of it, where an image shows nothing.

    It is degraded: what moves by itself cannot be told by depth from what stands.
    """
    pair = evidence.pair
    if have_texture(pair.prev, pair.curr) or not evidence.flow_is_of_the_images:
        return None
    expected = evidence.expected or UNKNOWN_MOTION
    belief = evidence.ready_belief
    shape = pair.prev.camera.shape
    weights = None if belief is None else resized(belief.weights, shape)
    depth = follow_depth(pair, expected, weights, evidence.options.refine)
    if depth is None:
        return None
    cause = (
        "an image is dark or covered" if pair.has_images else "an image is missing"
    )
    text = f"{cause}: the depth maps carry the motion"
    terms: tuple[Term, ...] = (Term.DEPTH,)
    if depth.rests_on(expected):
        text = f"{text}, and what was expected where they leave it open"
        terms = (Term.DEPTH, Term.EXPECTED)
    return Motion(
        depth.known.T_curr_prev,
        depth.known.covariance,
        Status.degraded(Reason.NO_FLOW, text),
        inlier_ratio=depth.evidence.inlier_ratio,
        weights=depth.weights,
        evidence=depth.evidence,
        terms=terms,
    )


class Look(NamedTuple):
    """PWVO's look at the motions of one flow."""

    flow: FlowEvidence
    ranking: Ranking
    scorer: PWVOScorer


Solver = Callable[[Sequence[Look], Context], Motion]
"""Selects the camera's motion from all looks at a pair so far, and refines it."""


@stage("look")
def look_at(flow: FlowEvidence, ctx: Context) -> Look:
    """Let PWVO look at every strong motion of a flow, and at "none of them"."""
    from hybridvo.network.scorer import PWVOScorer
    from hybridvo.network.threads import single_threaded_inference

    motions = flow.motions
    with single_threaded_inference():
        network = ctx.models.network("pwvo")
        scorer = PWVOScorer(network, motions, flow.of.expected)
        belief = flow.of.belief
        ranking = rank_by_scorer(motions, scorer, ctx.options, belief)
        return Look(flow, ranking, scorer)


def surest_look(looks: Sequence[Look]) -> Look:
    """The look in which the motion selected was found."""
    return max(looks, key=lambda look: look.ranking.best_score)


@stage("solve")
def solve_in_numba(looks: Sequence[Look], ctx: Context) -> Motion:
    """Select the camera's motion from all looks, and fit it inside its static mask."""
    rankings = [look.ranking for look in looks]
    motion = fit(surest_look(looks).flow, select_from(rankings), ctx)
    if probability_of(motion.evidence) >= ctx.options.select.min_probability:
        return motion
    return motion.replace(rivals=fitted_rival(looks, ctx))


def fitted_rival(looks: Sequence[Look], ctx: Context) -> tuple[Rival, ...]:
    """The motion that may be the camera's instead of the selected one; empty where none is."""
    rival = select_rival([look.ranking for look in looks])
    if rival is None:
        return ()
    ranking, selection = rival
    flow = next(look.flow for look in looks if look.ranking is ranking)
    other = fit(flow, selection, ctx)
    if not other.usable:
        return ()
    return (Rival(other.T_curr_prev, other.covariance, other.evidence),)


@stage("solve")
def solve_in_torch(looks: Sequence[Look], ctx: Context) -> Motion:
    """Select seed and weights from the maps of the surest motion, and refine in torch."""
    from hybridvo.batches import refine_batch
    from hybridvo.network.pair_maps import maps_of_best, with_patches
    from hybridvo.network.selection import select
    from hybridvo.network.threads import single_threaded_inference

    best = surest_look(looks)
    rankings = [look.ranking for look in looks]
    hypothesis = best.ranking.candidates[best.ranking.best]
    with single_threaded_inference():
        batch = PairBatch.from_pairs([best.flow.pair], device=ctx.models.device)
        maps = maps_of_best(best.scorer, rankings)
        seed = select(with_patches(maps, batch, [hypothesis]))
        motion = refine_batch(
            batch,
            seed,
            options=ctx.options.refine,
            min_probability=ctx.options.select.min_probability,
        )
    return motion.one(0)


@stage("solve")
def fit(flow: FlowEvidence, chosen: refinement.Selection, ctx: Context) -> Motion:
    """A motion fitted to flow and depth inside its mask, with covariance."""
    refine = ctx.options.refine
    grid = static_grid(
        flow.motions, flow.pair, chosen.mask, flow.of.weights, refine
    )
    return refinement.refine_pair(flow.pair, chosen, grid, options=refine)


# -- the methods ---------------------------------------------------------------------


def hybrid(evidence: PairEvidence, ctx: Context) -> Iterator[Motion | None]:
    """By images and depth alone; then by flow, and at the end on the images again.

    Where an image shows nothing there is no flow: then depth is asked.
    """
    yield by_images(evidence)
    depth_alone = by_depth(evidence)
    if depth_alone is None:
        yield from by_flow(evidence, ctx)
    else:
        yield depth_alone


def classical(evidence: PairEvidence, ctx: Context) -> Iterator[Motion]:
    """Search, select by hand-made cues, refine; from a known start refine at once."""
    pair = evidence.with_flow
    if evidence.start is not None:
        check_images(pair)
        known = refinement.Selection(evidence.start)
        refine = ctx.options.refine
        yield refinement.refine_pair(pair, known, None, evidence.weights, refine)
        return
    flow = next(evidence.flows())
    chosen = select_by_cues(flow.motions, evidence.expected)
    yield fit(flow, chosen, ctx)


def pwvo_refine(evidence: PairEvidence, ctx: Context) -> Iterator[Motion]:
    """The same looks and selection, refined in torch, on its device; then on the images.

    The same lines serve batches, with gradients to flow, depth, weights and maps.
    """
    return by_flow(evidence, ctx, solve_in_torch)


def pwvo(evidence: PairEvidence, ctx: Context) -> Iterator[Motion]:
    """PWVO alone: the hypothesis with the best score, as its pixels repeat it."""
    from hybridvo.network.prediction import estimate_by_pwvo

    pair = evidence.with_flow
    network = ctx.models.network("pwvo")
    yield estimate_by_pwvo(pair, network, evidence.expected, ctx.options, ctx.seed)


def identity(evidence: PairEvidence, ctx: Context) -> Iterator[Motion]:
    """No motion: the floor that every method must beat."""
    yield Motion(covariance=identity_covariance())


def _nothing_is_missing() -> str:
    """Why a method cannot run here: it can."""
    return ""


def _torch_geometry_is_missing() -> str:
    """Why a method that is refined in torch cannot run here; empty where it can."""
    absent = [name for name in TORCH_GEOMETRY if find_spec(name) is None]
    if not absent:
        return ""
    return f"{absent[0]} is not installed; pip install 'hybridvo[train]'"


@dataclass(frozen=True)
class Method:
    """How a motion is found, by name in :data:`METHODS`.

    Attributes:
        answers: yields an answer after each source of motions, which rests on all sources so far;
            None where there is none yet.
        networks: names of the weights that it uses.
        on_images: whether its answer is fitted to the two images at the end.
        is_verified: whether its answers, where they have weights, are held against images and
            depth maps: those of other libraries and of the paper's rows are shown as they are.
        cheap_rounds: sources whose cost is known beforehand: of ``hybrid`` the images alone, and
            one flow of theirs or depth alone. Further flow, from sparse matches, may take a second.
        missing: returns why it cannot run here, and the remedy; empty where it can.
    """

    answers: Callable[[PairEvidence, Context], Iterator[Motion | None]]
    networks: tuple[str, ...] = ()
    on_images: bool = False
    is_verified: bool = True
    cheap_rounds: int = 1
    missing: Callable[[], str] = _nothing_is_missing


TORCH_GEOMETRY = ("pypose", "kornia")
"""Libraries of the extra ``train``, which ``hybridvo.core.torch_geometry`` imports."""
METHODS: dict[str, Method] = {
    "hybrid": Method(hybrid, ("pwvo",), on_images=True, cheap_rounds=2),
    "hybrid-flow": Method(by_flow, ("pwvo",)),
    "classical": Method(classical),
    "pwvo-refine": Method(
        pwvo_refine, ("pwvo",), on_images=True, missing=_torch_geometry_is_missing
    ),
    "pwvo": Method(pwvo, ("pwvo",)),
    "identity": Method(identity, is_verified=False),
}
"""The methods of this package; hybridvo-lab adds others by entry points."""
FLOOR = "identity"
"""The method that every other must beat stands last in tables."""
EARLIER_NAMES = {"refine": "classical"}
"""Names of methods that still work, and what they are called now."""


def method_names() -> tuple[str, ...]:
    """The names of all methods, those of hybridvo-lab as well where it is installed."""
    ours = [name for name in METHODS if name != FLOOR]
    return (*ours, *laboratory.names_of(laboratory.METHODS), FLOOR)


def method_of(name: str) -> Method:
    """The method of a name of :func:`method_names`."""
    if name in METHODS:
        return METHODS[name]
    found: Method = laboratory.wanted(laboratory.METHODS, name, f"method '{name}'")
    return found


# -- from evidence to an answer ------------------------------------------------------


def run_method(
    evidence: PairEvidence, method: str, ctx: Context, deadline: float | None = None
) -> RelativePose:
    """Return the motion of a pair by a method, see :func:`first_sure`."""
    return first_sure([evidence], method, ctx, deadline)[1]


def by_first_source(
    evidence: PairEvidence, method: str, ctx: Context
) -> RelativePose:
    """Return the motion of a pair by the first source of a method, the cheapest, alone.

    It has the method's name, and the milliseconds since the call.
    """
    started = time.perf_counter()
    try:
        found = next(method_of(method).answers(evidence, ctx))
    except StageFailed as error:
        motion = failed(error)
    else:
        motion = RelativePose.failed(Reason.NO_FLOW, "the first source is not sure")
        if found is not None:
            motion = finished(evidence, found, method)
    return _signed(motion, method, started)


def _signed(motion: RelativePose, method: str, started: float) -> RelativePose:
    """A motion with the name of its method, and the milliseconds since it was begun."""
    ms = 1e3 * (time.perf_counter() - started)
    return motion.replace(method=method, ms=ms)


def first_sure(
    pairs: Sequence[PairEvidence],
    method: str,
    ctx: Context,
    deadline: float | None = None,
) -> tuple[int, RelativePose]:
    """Return the first sure motion of pairs that end at the same frame.

    Each source is tried on every pair before the next source is tried on any; sparse matches, the
    costliest, on the surest pair alone.

    Args:
        pairs: in the order of preference.
        method: one of :func:`method_names`.
        ctx: options, networks and flow.
        deadline: on the clock of ``time.perf_counter``. After it nothing more is tried once there
            is a motion, and no flow from sparse matches even where there is none. None: there is
            time.

    Returns:
        The number of the pair, and its motion: the first one that is ok; where none is, the surest,
        by all sources, of any pair. It has the method's name, and the milliseconds since the call.
    """
    started = time.perf_counter()
    pairs = [at_one_time(evidence, method, ctx, deadline) for evidence in pairs]
    rounds = _Rounds(pairs, method, ctx, deadline)
    for number in rounds:
        late = is_late(deadline)
        if _suffices(rounds.believed[number], late):
            motion = finished(pairs[number], rounds.last[number], method, late)
            if _suffices(motion, late):
                return number, _signed(motion, method, started)
    finals = {
        number: finished(pairs[number], found, method, is_late(deadline))
        for number, found in rounds.last.items()
    }
    number = max(finals, key=lambda each: finals[each].rank)
    return number, _signed(finals[number], method, started)


def _suffices(motion: RelativePose, late: bool) -> bool:
    """Whether nothing more is tried: the motion is ok, or usable when time is over."""
    return motion.ok or (motion.usable and late)


def at_one_time(
    evidence: PairEvidence, method: str, ctx: Context, deadline: float | None = None
) -> PairEvidence:
    """The evidence of a pair with each frame as if all of it were measured at one time.

    It is that already where the cameras state neither readout nor lag. The start says roughly how
    the camera moved, where there is one; else see :func:`hybridvo.evidence.one_time.rough_motion`.
    """
    pair = evidence.pair
    if is_of_one_time(pair):
        return evidence
    if not evidence.flow_is_of_the_images:
        # it knows the rows as they were exposed
        pair = with_flow(pair, evidence.provider)

    def found_in(as_they_are: FramePair) -> np.ndarray | None:
        found = run_method(
            replace(evidence, pair=as_they_are), method, ctx, deadline
        )
        return found.T_curr_prev if found.usable else None

    T_near = evidence.start
    if T_near is None:
        refine = evidence.options.refine
        T_near = rough_motion(pair, evidence.expected, refine, found_in)
    return replace(evidence, pair=pair_at_image_times(pair, T_near))


class _Rounds:
    """The answers of a method about some pairs: a round for each source.

    The cheap sources, images and their flow, are asked about every pair; the others about the pair
    of the surest motion alone, and not after the deadline.

    Attributes:
        last: the last motion so far of each pair, by its number.
        believed: the same with its probability by what speaks for it.
    """

    def __init__(
        self,
        pairs: Sequence[PairEvidence],
        method: str,
        ctx: Context,
        deadline: float | None,
    ) -> None:
        self.last: dict[int, Motion] = {}
        self.believed: dict[int, RelativePose] = {}
        asked = method_of(method)
        self._answers = [asked.answers(evidence, ctx) for evidence in pairs]
        self._cheap_rounds = asked.cheap_rounds
        self._deadline = deadline
        self._min_probability = ctx.options.select.min_probability

    def __iter__(self) -> Iterator[int]:
        """Yield the number of a pair whenever a source has found a motion of it."""
        numbers = list(range(len(self._answers)))
        for done in itertools.count():
            is_costly = done >= self._cheap_rounds
            if done == self._cheap_rounds and numbers:
                numbers = [max(numbers, key=self._rank)]
            if not numbers or (is_costly and is_late(self._deadline)):
                return
            for number in list(numbers):
                try:
                    found = next(self._answers[number])
                except StopIteration:
                    numbers.remove(number)
                    continue
                except StageFailed as error:
                    numbers.remove(number)
                    found = failed(error)
                if found is not None:
                    self.last[number] = found
                    self.believed[number] = believed(found, self._min_probability)
                    yield number

    def _rank(self, number: int) -> tuple[bool, bool, float]:
        """How sure the last motion of a pair is."""
        known = self.believed.get(number)
        return (False, False, 0.0) if known is None else known.rank


def failed(error: StageFailed) -> RelativePose:
    """The status of a stage that found no answer."""
    return RelativePose.failed(error.reason, str(error))


def finished(
    evidence: PairEvidence, found: Motion, method: str, late: bool = False
) -> RelativePose:
    """Fit a motion to the images where its method does so, and judge it.

    Args:
        evidence: of the pair.
        found: its motion.
        method: which found it.
        late: whether its time is over: what only improves it is left out.
    """
    asked = method_of(method)
    if asked.on_images and not late:
        found = on_images(evidence, found)
    return judge(evidence, found, is_compared=asked.is_verified)


@stage("solve")
def on_images(evidence: PairEvidence, motion: Motion) -> Motion:
    """A motion by flow, refined on the two images where that is wanted and possible."""
    options = evidence.options
    # images know no better which of two depths that differ is right
    contradicted = motion.status.reason is Reason.NO_VALID_DEPTH
    is_off = options.photometric.mode == "off" or Term.FLOW not in motion.terms
    if is_off or contradicted:
        return motion
    return refine_photometric(evidence.pair, motion, options=options.refine)


def is_late(deadline: float | None) -> bool:
    """Whether the time of a frame is over: what only improves an answer is then left out."""
    return deadline is not None and time.perf_counter() > deadline


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
    known = method_names()
    if method not in known:
        hint = did_you_mean(method, known, similarity=0.4)
        raise InputError(
            f"method: '{method}' is unknown{hint}; known: {', '.join(known)}"
            f"{laboratory.more_with_it()}."
        )
    asked = method_of(method)
    if asked.networks and find_spec("torch") is None:
        raise InputError(
            f"method '{method}' cannot run here: torch is not installed."
        )
    if reason := asked.missing():
        raise InputError(f"method '{method}' cannot run here: {reason}.")
    return method
