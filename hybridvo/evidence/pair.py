"""A pair of frames and what can be measured of it, each part once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hybridvo.core.belief import Belief
from hybridvo.core.options import Options
from hybridvo.core.results import MotionPrior, Reason, StageFailed
from hybridvo.core.types import FramePair
from hybridvo.evidence.calibration import MIN_FLOW_COVERAGE
from hybridvo.evidence.remembered import Remembered, carried_belief
from hybridvo.flow.providers import FlowProvider, contradiction, dis_flow, with_flow
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.matches import GuidedFlow, matched_motions
from hybridvo.hypotheses.types import HypothesisSet


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """What can be measured of a pair; each part is worked out when it is first read.

    Attributes:
        pair: two frames, with flow where the caller gave one.
        options: the option tree.
        expected: what is known of the motion without the pair, or None.
        provider: computes flow where the pair has none; None: there is none to be had.
        weights: (H, W) factors on the information of each pixel, or None.
        start: (4, 4) ``T_curr_prev`` near which the motion is, where that is known.
        seed: of the random samples.
        near: (4, 4) the motion as the most reduced images show it, where they were followed.
        remembered: what earlier frames have shown; None: nothing.
    """

    pair: FramePair
    options: Options = field(default_factory=Options)
    expected: MotionPrior | None = None
    provider: FlowProvider | None = None
    weights: np.ndarray | None = None
    start: np.ndarray | None = None
    seed: int = 0
    remembered: Remembered | None = None
    near: np.ndarray | None = None

    @cached_property
    def belief(self) -> Belief | None:
        """Which pixels of the first frame are static; None where nothing is remembered."""
        known = self.remembered
        return None if known is None else carried_belief(known, self.pair.prev)

    @property
    def ready_belief(self) -> Belief | None:
        """The belief where so much is known, and so surely, that no flow may be needed."""
        belief = self.belief
        return belief if belief is not None and belief.is_ready else None

    @property
    def flow_source(self) -> str:
        """Where the flow comes from, computed or not; empty where nobody states it."""
        if self.pair.flow is not None:
            return self.pair.flow_source
        return getattr(self.provider, "source", "")

    @property
    def flow_is_of_the_images(self) -> bool:
        """Whether the flow is DIS flow of these images, and knows no more than they do."""
        return self.flow_source == "dis"

    @cached_property
    def with_flow(self) -> FramePair:
        """The pair with its flow; without any where none is."""
        return with_flow(self.pair, self.provider)

    @cached_property
    def matched_motions(self) -> tuple[np.ndarray, ...]:
        """Motions (4, 4) that many sparse matches of the two images follow."""
        return tuple(matched_motions(self.pair, self.seed))

    def flows(self) -> Iterator[FlowEvidence]:
        """The flow of the pair; then flow that is found from what matched motions leave.

        Flow that is not computed from these images cannot be computed from another start.
        """
        yield FlowEvidence(self.with_flow, self)
        provider = self.provider if self.pair.flow is None else dis_flow()
        is_off = self.options.search.matches == "off"
        if is_off or not self.flow_is_of_the_images or provider is None:
            return
        without_flow = replace(self.pair, flow=None)
        for T in self.matched_motions:
            guided = with_flow(without_flow, GuidedFlow(provider, T))
            if guided.flow is not None:
                yield FlowEvidence(guided, self, T)


@dataclass(frozen=True, eq=False)
class FlowEvidence:
    """One field of flow of a pair, and what can be read off it.

    Attributes:
        pair: the frames with this flow.
        of: the pair that it belongs to.
        guide: (4, 4) motion from which the flow was found; None where it was found without.
    """

    pair: FramePair
    of: PairEvidence
    guide: np.ndarray | None = None

    @cached_property
    def motions(self) -> HypothesisSet:
        """Every strong motion in this flow.

        Raises:
            StageFailed: the flow cannot be that of the images, the step is too wide for it, or
                flow, depth or usable pixels are missing.
        """
        if self.guide is None:
            check_flow(self.pair)
        return generate(
            self.pair, self._starts, self.of.options, self.of.seed, self.of.weights
        )

    @property
    def _starts(self) -> np.ndarray:
        """(S, 4, 4) motions that the search tries beside its own, the identity first."""
        starts = [np.eye(4)]
        if self.of.expected is not None:
            starts.append(self.of.expected.T_curr_prev)
        if self.guide is not None:
            starts.append(self.guide)
        return np.stack(starts)


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


def check_images(pair: FramePair) -> None:
    """Fail where the flow cannot be that of the images."""
    if wrong := contradiction(pair):
        raise StageFailed(Reason.NO_FLOW, wrong)
