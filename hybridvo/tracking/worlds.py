"""Two worlds, while it is open which motion is the camera's.

Where two motions of a step are both plausible, a tracker follows the likelier one, and keeps what
follows from the other: where the camera is then, and what is static then. Each world is a belief of
its own, and the frames that come settle which one is right: PWVO's look at the motion that is the
camera's in each world, and how well that motion keeps what the world takes for static from what
it takes for moving. A belief that PWVO contradicts frame after frame is challenged in the same
way. Where the odds turn, the tracker goes on in the other world.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from hybridvo.core.belief import Belief, resized
from hybridvo.core.calibration import KNOWN_LOG_ODDS, MIN_PROBABILITY, MIN_STATIC
from hybridvo.core.geometry import invert, project, transform_points
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Hypothesis, Reason, RelativePose, Status
from hybridvo.core.stages import stage
from hybridvo.core.types import Frame, FramePair
from hybridvo.hypotheses.calibration import (
    DISTINCT_MOTION_PX,
    FRACTION_EVIDENCE,
    FRACTION_FLOOR,
    NO_MOTION,
)
from hybridvo.hypotheses.direct import direct_start
from hybridvo.hypotheses.search import REFERENCE_WIDTH
from hybridvo.judge.calibration import DIRECT_PROBABILITY
from hybridvo.judge.findings import Finding, covering, towards
from hybridvo.judge.verdict import with_finding
from hybridvo.solver.points import points_of
from hybridvo.tracking.calibration import (
    LEAST_OPEN,
    LOOK_EVIDENCE,
    MAX_RIVALS,
    TURNING_LOG_ODDS,
    WRONG_BELIEF,
)
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import (
    Memory,
    carried_to,
    log_odds_of,
    memory_after,
    nothing_known,
)

# px at the width of reference; what a point counts at most that leaves the view
FARTHEST_PX = 1000.0


@dataclass(frozen=True, eq=False)
class World:
    """What follows if another motion than the one that is followed is the camera's.

    Attributes:
        memory: what is static then.
        T_world_cam: (4, 4) pose of the reference then.
        keyframes: those of the tracker, where they are then.
        log_odds: that this world is right rather than the one that is followed.
        since: number of the first frame whose pose is another one then.
        start: number of the frame from which it was seen last.
        before: its log odds before it was seen from there: what is seen from one frame is no
            news the second time.
    """

    memory: Memory
    T_world_cam: np.ndarray
    keyframes: tuple[Keyframe, ...]
    log_odds: float
    since: int
    start: int
    before: float

    def moved(self, T_new_old: np.ndarray) -> World:
        """Return the world in another frame of reference."""
        return replace(
            self,
            memory=self.memory.moved(T_new_old),
            T_world_cam=T_new_old @ self.T_world_cam,
            keyframes=tuple(each.moved(T_new_old) for each in self.keyframes),
        )

    def after_evidence(self, change: float, start: int) -> World:
        """Return the world with other odds.

        Args:
            change: of the log odds, by what is seen now.
            start: number of the frame from which it is seen.
        """
        before = self.before if start == self.start else self.log_odds
        return replace(self, log_odds=before + change, start=start, before=before)

    def at_least(self, log_odds: float) -> World:
        """Return the world with log odds that are not smaller."""
        return replace(self, log_odds=max(self.log_odds, log_odds))

    def against(self, log_odds: float) -> World:
        """Return the world as a rival of another one, whose log odds are given."""
        return replace(
            self, log_odds=self.log_odds - log_odds, before=self.before - log_odds
        )

    def with_keyframe(self, keyframe: Keyframe) -> World:
        """Return the world with a new keyframe, which is the reference."""
        new = replace(keyframe, T_world_cam=self.T_world_cam)
        return replace(self, keyframes=(*self.keyframes, new))

    def placed(self, keyframe: Keyframe, reference: Keyframe) -> Keyframe | None:
        """Return a keyframe where it is in this world; None where that is not known."""
        if keyframe.count < self.since:
            return keyframe
        if keyframe.count == reference.count:
            return replace(keyframe, T_world_cam=self.T_world_cam)
        known = [each for each in self.keyframes if each.count == keyframe.count]
        return known[0] if known else None

    def estimate(
        self, followed: Estimate, start: Keyframe, motion: RelativePose
    ) -> Estimate:
        """Return the estimate of a frame in this world.

        Args:
            followed: that in the world that is followed.
            start: where it starts, as it is in this world.
            motion: of the camera in this world.
        """
        reference = followed.reference
        placed = [self.placed(each, reference) for each in followed.keyframes]
        return followed._replace(
            start=start,
            motion=motion,
            reference=replace(reference, T_world_cam=self.T_world_cam),
            keyframes=tuple(each for each in placed if each is not None),
        )


class Weighed(NamedTuple):
    """What a frame leaves of an open question.

    Attributes:
        estimate: of the world that is followed from here on.
        rivals: the other worlds, as they are after this frame.
        entered: the world that is followed from here on, as it was before the frame; None where
            it is the one that was followed.
    """

    estimate: Estimate
    rivals: tuple[World, ...] = ()
    entered: World | None = None


class Sighting(NamedTuple):
    """A world, and the motion to a frame in it.

    Attributes:
        world: before the frame, but for its log odds, which are those after it.
        estimate: of the frame in this world.
    """

    world: World
    estimate: Estimate


@stage("memory")
def weighed(
    rivals: Sequence[World],
    memory: Memory | None,
    frame: Frame,
    count: int,
    followed: Estimate,
    leads: bool,
) -> Weighed:
    """Weigh the worlds by a frame.

    Args:
        rivals: the worlds beside the one that is followed, before the frame.
        memory: what is static in the one that is followed.
        frame: the current one.
        count: its number since the tracker began.
        followed: its motion in the world that is followed.
        leads: whether the next motion starts from it.

    Returns:
        The world to be followed, and what is left of the others. Where nothing was open and the
        frame opens nothing, nothing is computed. The images alone, where they are sure, leave
        nothing open.
    """
    if not followed.motion.hypotheses:
        return Weighed(followed)
    seen = [*_seen_by(rivals, memory, followed)]
    opened = _opened(seen, memory, count, followed)
    if opened is not None:
        seen.append(opened)
    if not seen:
        return Weighed(followed)
    seen = sorted(seen, key=lambda each: -each.world.log_odds)[:MAX_RIVALS]
    entered = None
    answer = followed._replace(motion=while_open(followed, seen, count))
    if seen[0].world.log_odds > TURNING_LOG_ODDS:
        entered = seen[0].world
        left = _as_believed(memory, followed)
        answer = _in_another_world(left, seen[0], count)
        seen = _seen_from(seen[0], seen[1:], memory, left)
    rivals = tuple(_after_frame(each, frame, leads) for each in seen)
    return Weighed(answer, rivals, entered)


# -- the odds ------------------------------------------------------------------------


def look(motion: Hypothesis) -> float:
    """PWVO's score of a motion, without what is remembered."""
    return motion.score - motion.remembered


def keeps_apart(motion: Hypothesis, belief: Belief) -> float:
    """Return how well a motion keeps what is believed static from what is believed to move.

    Returns:
        Nats: 0 where all of the one follows it and nothing of the other, and where too little
        is known; else less.
    """
    if belief.static_fraction < MIN_STATIC:
        return 0.0
    log_odds = resized(belief.log_odds, motion.inliers.shape)
    static = _followed_fraction(motion, log_odds > KNOWN_LOG_ODDS)
    behind = np.log((static + FRACTION_FLOOR) / (1 + FRACTION_FLOOR))
    if belief.something_moves:
        moving = _followed_fraction(motion, log_odds < -KNOWN_LOG_ODDS)
        behind -= np.log((moving + FRACTION_FLOOR) / FRACTION_FLOOR)
    return float(FRACTION_EVIDENCE * behind)


def _followed_fraction(motion: Hypothesis, is_counted: np.ndarray) -> float:
    """Fraction of some pixels that follows a motion."""
    count = max(int(np.count_nonzero(is_counted)), 1)
    return float(np.sum(motion.inliers[is_counted]) / count)


def evidence_for(motion: Hypothesis, belief: Belief) -> float:
    """Return what speaks for a motion in a world with a belief, nats."""
    return look(motion) + keeps_apart(motion, belief)


def change_of_odds(by_other: float, by_followed: float) -> float:
    """Return the change of a world's log odds, given the evidence for it and its rival, nats."""
    return LOOK_EVIDENCE * (by_other - by_followed)


def probability_followed(log_odds: Sequence[float]) -> float:
    """Return the probability of the world that is followed, given the log odds of all others.

    >>> round(probability_followed([0.0]), 2), round(probability_followed([0.0, 0.0]), 2)
    (0.5, 0.33)
    """
    return float(1 / (1 + np.sum(np.exp(log_odds))))


def first_log_odds(
    gain: float, certainty: float, motion: RelativePose
) -> float | None:
    """Return the log odds of a world that a look at a frame may open.

    Args:
        gain: by how much PWVO's look prefers the other motion, nats.
        certainty: log odds of what is remembered to be right; at most 0 where nothing is known.
        motion: the answer.

    Returns:
        Where nothing is known, those that the answer leaves. A belief is challenged only by a
        look that contradicts it. None: nothing is open.
    """
    if certainty > 0:
        return WRONG_BELIEF + change_of_odds(gain, 0.0) if gain > 0 else None
    is_doubted = motion.status.reason is Reason.AMBIGUOUS_MOTION
    if not is_doubted or motion.probability < LEAST_OPEN:
        return None
    return -log_odds_of(motion.probability)


# -- one frame -----------------------------------------------------------------------


def _seen_by(
    rivals: Sequence[World], memory: Memory | None, followed: Estimate
) -> Iterator[Sighting]:
    """The rivals that are not refuted, and still differ from the world that is followed."""
    if not rivals:
        return
    answer = followed.motion
    chosen = answer.hypotheses[0]
    frame = followed.start.frame
    own = expected_in(carried_to(memory, followed.start).belief, answer)
    contradicts = are_distinct(own.motion.T_curr_prev, chosen.T_curr_prev, frame)
    for world in rivals:
        start = world.placed(followed.start, followed.reference)
        if start is None:
            continue
        other = expected_in(carried_to(world.memory, start).belief, answer)
        change = change_of_odds(other.evidence, own.evidence)
        after = world.after_evidence(change, start.count)
        motion = _as_answer(other.motion, answer)
        if not are_distinct(motion.T_curr_prev, chosen.T_curr_prev, frame):
            if not contradicts:
                continue
            # the answer is what this world expects, and the one followed does not
            after = after.at_least(log_odds_of(answer.probability))
            motion = answer
        elif change < 0 and after.log_odds < WRONG_BELIEF:
            continue
        yield Sighting(after, world.estimate(followed, start, motion))


class Expected(NamedTuple):
    """The motion that a world takes for the camera's, and what speaks for it, nats."""

    motion: Hypothesis
    evidence: float


def expected_in(belief: Belief, answer: RelativePose) -> Expected:
    """Return which of the motions found is the camera's where a belief is right."""
    evidence = [evidence_for(each, belief) for each in answer.hypotheses]
    best = int(np.argmax(evidence))
    return Expected(answer.hypotheses[best], evidence[best])


def _opened(
    seen: Sequence[Sighting], memory: Memory | None, count: int, followed: Estimate
) -> Sighting | None:
    """The world of the strongest motion that no world has yet; None where it is not plausible."""
    motion = followed.motion
    chosen = motion.hypotheses[0]
    certainty = 0.0 if memory is None else memory.belief.certainty
    # what PWVO takes for less likely than none of them is no world
    likely = [each for each in motion.hypotheses[1:] if look(each) > NO_MOTION]
    known = [chosen.T_curr_prev, *(e.estimate.motion.T_curr_prev for e in seen)]
    frame = followed.start.frame
    for rival in sorted(likely, key=look, reverse=True):
        log_odds = first_log_odds(look(rival) - look(chosen), certainty, motion)
        # a weaker one opens nothing either
        if log_odds is None:
            return None
        if all(are_distinct(rival.T_curr_prev, T, frame) for T in known):
            return _new_world(followed, _as_answer(rival, motion), log_odds, count)
    return None


def opened_by_images(
    memory: Memory,
    frame: Frame,
    count: int,
    followed: Estimate,
    leads: bool,
    T_expected: np.ndarray | None,
    options: RefineOptions,
) -> Weighed:
    """Ask whether what is believed to move follows one motion as surely as what is static.

    The images alone cannot tell the world from a thing that moves: each confirms a belief that
    takes it for static. Then the question is open, and it takes a look to settle it.

    Args:
        memory: what is static in the world that is followed.
        frame: the current one.
        count: its number since the tracker began.
        followed: its motion in that world, which what is believed static alone confirms.
        leads: whether the next motion starts from the frame.
        T_expected: (4, 4) the motion expected beforehand from where that one starts; None:
            nothing is.
        options: of the refinement.

    Returns:
        The world that is followed, and the opposite one where it is possible.
    """
    belief = carried_to(memory, followed.start).belief
    opposite = replace(belief, log_odds=-belief.log_odds)
    if not opposite.is_ready:
        return Weighed(followed)
    start = followed.start.frame
    pair = FramePair(start, frame, None)
    found = direct_start(pair, T_expected, DIRECT_PROBABILITY, options, opposite)
    if found is None:
        return Weighed(followed)
    if not are_distinct(found.T_curr_prev, followed.motion.T_curr_prev, start):
        return Weighed(followed)
    seen = _new_world(followed, found, WRONG_BELIEF, count)
    return Weighed(followed, (_after_frame(seen, frame, leads),))


def _new_world(
    followed: Estimate, motion: RelativePose, log_odds: float, count: int
) -> Sighting:
    """A world that differs from the one that is followed from this frame on."""
    world = World(
        memory=nothing_known(followed.home),
        T_world_cam=followed.reference.T_world_cam,
        keyframes=followed.keyframes,
        log_odds=log_odds,
        since=count,
        start=followed.start.count,
        before=log_odds,
    )
    return Sighting(world, followed._replace(motion=motion))


def _as_answer(hypothesis: Hypothesis, answer: RelativePose) -> RelativePose:
    """A motion of the search as an answer, as precise as the one that was chosen."""
    return answer.replace(
        T_curr_prev=hypothesis.T_curr_prev,
        inlier_ratio=hypothesis.inlier_ratio,
        weights=None,
        photometric=None,
    )


def _after_frame(seen: Sighting, frame: Frame, leads: bool) -> World:
    """A world after a frame, from which the next motion starts if it ``leads``."""
    world, estimate = seen
    return replace(
        world,
        T_world_cam=estimate.T_world_cam if leads else world.T_world_cam,
        keyframes=estimate.keyframes,
        memory=memory_after(world.memory, frame, estimate, is_open=True),
    )


def are_distinct(A: np.ndarray, B: np.ndarray, frame: Frame) -> bool:
    """Whether two motions (4, 4) from a frame are distinct: their ego flows are pixels apart."""
    points = points_of(frame).xyz
    if not len(points):
        return False
    apart = project(transform_points(A, points), frame.camera)
    apart = apart - project(transform_points(B, points), frame.camera)
    lengths = np.linalg.norm(apart, axis=1) * (REFERENCE_WIDTH / frame.camera.width)
    lengths = np.nan_to_num(lengths, nan=FARTHEST_PX, posinf=FARTHEST_PX)
    return bool(np.mean(np.minimum(lengths, FARTHEST_PX)) > DISTINCT_MOTION_PX)


# -- what a user is told -------------------------------------------------------------


def while_open(
    followed: Estimate, seen: Sequence[Sighting], count: int
) -> RelativePose:
    """Return an answer with the probability of its world, and the distance to the others.

    It is degraded where that is smaller than that of an answer that is ok.
    """
    motion = followed.motion
    log_odds = [each.world.log_odds for each in seen]
    probability = probability_followed(log_odds)
    if probability >= MIN_PROBABILITY:
        return motion
    others = [
        probability * np.exp(world.log_odds) * _difference(followed, estimate)
        for world, estimate in seen
    ]
    frames = count - min(each.world.since for each in seen) + 1
    text = (
        f"for {frames} frames it has been open which motion is the camera's: this one "
        f"has a probability of {100 * probability:.0f} %"
    )
    status = Status.degraded(Reason.AMBIGUOUS_MOTION, text)
    doubt = Finding(
        np.sum(others, axis=0), probability, status if motion.ok else None
    )
    return with_finding(motion, doubt)


def with_jump(motion: RelativePose, T_jump: np.ndarray) -> RelativePose:
    """Return the first motion in another world, as an edge from where the path was before.

    Args:
        motion: of the camera, from the frame before.
        T_jump: (4, 4) pose of the frame before as it was given, in the camera where it is in the
            other world.

    Returns:
        The motion that leads from the pose given to the other world, whose covariance holds the
        difference.
    """
    T = motion.T_curr_prev @ T_jump
    doubt = Finding(towards(motion, T))
    return with_finding(motion.replace(T_curr_prev=T), doubt)


def _as_believed(memory: Memory | None, followed: Estimate) -> Estimate:
    """The estimate of the world that is left: an answer may have contradicted its belief."""
    answer = followed.motion
    own = expected_in(carried_to(memory, followed.start).belief, answer).motion
    T_answer = answer.hypotheses[0].T_curr_prev
    if not are_distinct(own.T_curr_prev, T_answer, followed.start.frame):
        return followed
    return followed._replace(motion=_as_answer(own, answer))


def _in_another_world(left: Estimate, entered: Sighting, count: int) -> Estimate:
    """The estimate of a world that takes the place of the one followed so far."""
    world, estimate = entered
    percent = 100 * float(expit(world.log_odds))
    frames = count - world.since
    text = (
        f"another motion than that of the last {frames} frames has become the likelier "
        f"one, with a probability of {percent:.0f} %; the path goes on from its pose"
    )
    # it is as probable as its world, however the answer was chosen in the one left
    motion = estimate.motion.replace(probability=percent / 100)
    status = Status.degraded(Reason.WORLD_CHANGED, text)
    turn = Finding(_difference(estimate, left), status=status)
    return estimate._replace(motion=with_finding(motion, turn))


def _seen_from(
    entered: Sighting,
    others: Sequence[Sighting],
    memory: Memory | None,
    left: Estimate,
) -> list[Sighting]:
    """The rivals of a world that takes the place of the one followed so far, which is one."""
    log_odds = entered.world.log_odds
    before = World(
        memory=carried_to(memory, left.home),
        T_world_cam=left.reference.T_world_cam,
        keyframes=left.keyframes,
        log_odds=-log_odds,
        since=entered.world.since,
        start=left.start.count,
        before=-entered.world.before,
    )
    beside = [each._replace(world=each.world.against(log_odds)) for each in others]
    return [Sighting(before, left), *beside]


def _difference(here: Estimate, there: Estimate) -> np.ndarray:
    """Covariance (6, 6) with which a motion covers the pose of a frame in another world."""
    return covering(invert(there.T_world_cam) @ here.T_world_cam)
