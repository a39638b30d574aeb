"""Which motion is the camera's stays open until the frames that follow settle it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.belief import Belief, grid_index
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.options import Options
from hybridvo.core.results import Hypothesis, Reason, RelativePose, Status
from hybridvo.pipeline import Answer
from hybridvo.run.commands.run import restored, saved
from hybridvo.tracking import worlds
from hybridvo.tracking.calibration import MAX_RIVALS, WRONG_BELIEF
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import Memory
from hybridvo.tracking.tracker_state import TrackerState
from hybridvo.tracking.worlds import World, probability_followed, weighed

SIZE = (120, 160)
CAMERA = hvo.Camera(160.0, 160.0, 79.5, 59.5, *SIZE)
BORDER = 60
"""Column where a nearer board ends, and the wall begins."""
BOARD_M = 1.5
WALL_M = 2.0
GRID = (24, 32)


def texture(seed: int, shift: int) -> np.ndarray:
    """(H, W, 3) smooth noise, shifted to the right by whole pixels."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (SIZE[0] // 4, SIZE[1] // 4 + 20))
    fine = np.kron(coarse.astype(np.uint8), np.ones((4, 4), np.uint8))
    grey = fine[:, 40 - shift : 40 - shift + SIZE[1]]
    return grey[..., None].repeat(3, 2)


def view(index: int, board: int = 4, wall: int = -4) -> hvo.Frame:
    """A board and a wall, whose textures move by so many pixels a frame."""
    rgb = texture(3, wall * index)
    rgb[:, :BORDER] = texture(4, board * index)[:, :BORDER]
    depth = np.full(SIZE, WALL_M, np.float32)
    depth[:, :BORDER] = BOARD_M
    return hvo.Frame(rgb, depth, CAMERA, index=index)


def aside(x: float) -> np.ndarray:
    """(4, 4) that moves points ``x`` metres to the right."""
    return se3_exp(np.array([x, 0, 0, 0, 0, 0]))


def of_board(index: int) -> np.ndarray:
    """(4, 4) the camera's motion from the first frame, if the board is static."""
    return aside(4 * index * BOARD_M / CAMERA.fx)


def of_wall(index: int) -> np.ndarray:
    """The same, if the wall is."""
    return aside(-4 * index * WALL_M / CAMERA.fx)


def found(T: np.ndarray, score: float, follows: slice) -> Hypothesis:
    """A motion that some columns follow."""
    inliers = np.zeros(GRID, np.float32)
    inliers[:, follows] = 1
    return Hypothesis(T, "window", 0.5, 0.1, 0.01, inliers, score)


LEFT = slice(0, GRID[1] * BORDER // SIZE[1])
RIGHT = slice(GRID[1] * BORDER // SIZE[1], None)


def answer(
    index: int, wall: float, board: float, probability: float
) -> RelativePose:
    """The wall's motion from the first frame, with PWVO's scores of both motions."""
    motions = (
        found(of_wall(index), wall, RIGHT),
        found(of_board(index), board, LEFT),
    )
    motion = RelativePose(
        of_wall(index),
        1e-6 * np.eye(6),
        probability=probability,
        hypotheses=motions,
        terms=("flow", "images"),
    )
    if probability >= 0.9:
        return motion
    unsure = Status.degraded(Reason.AMBIGUOUS_MOTION, "another one is possible")
    return motion.replace(status=unsure)


class Scripted:
    """A tracker whose pairs have the answers of a script."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, answers: dict[int, RelativePose]
    ) -> None:
        def first_sure(pairs, *args):
            return Answer(0, answers[pairs[0].pair.curr.index])

        monkeypatch.setattr("hybridvo.pipeline.first_sure", first_sure)
        self.tracker = hvo.Odometry()

    def steps(self, numbers: range) -> list[hvo.Step]:
        """The steps of some frames."""
        return [self.tracker.track(view(number)) for number in numbers]


UNDECIDED = answer(1, 2.0, 2.0, 0.55)
"""Of the first pair."""


def test_an_undecided_first_pair_is_settled_by_the_third_frame(monkeypatch) -> None:
    answers = {1: UNDECIDED, 2: answer(2, 4.0, -4.0, 0.97)}
    script = Scripted(monkeypatch, answers)
    first, second, third = script.steps(range(3))
    assert first.ok
    assert second.status.reason is Reason.AMBIGUOUS_MOTION
    assert second.probability == pytest.approx(0.55, abs=0.01)
    assert third.ok and not script.tracker.state.rivals
    # what was learned while it was open is known
    assert script.tracker.state.memory.belief.static_fraction > 0.3
    assert script.tracker.state.memory.belief.moving_fraction > 0.2


def test_while_it_is_open_each_world_has_a_belief_and_a_path(monkeypatch) -> None:
    script = Scripted(monkeypatch, {1: UNDECIDED, 2: answer(2, 2.0, 2.2, 0.95)})
    steps = script.steps(range(3))
    state = script.tracker.state
    (rival,) = state.rivals
    wall_static = state.memory.belief.log_odds.astype(float)
    board_static = rival.memory.belief.log_odds.astype(float)
    middle = wall_static.shape[1] * BORDER // SIZE[1]
    assert wall_static[:, middle + 8 : -8].mean() > 0.5
    assert wall_static[:, 8 : middle - 4].mean() < -0.5
    assert board_static[:, middle + 8 : -8].mean() < -0.5
    assert board_static[:, 8 : middle - 4].mean() > 0.5
    np.testing.assert_allclose(state.T_world_cam, invert(of_wall(2)), atol=1e-9)
    np.testing.assert_allclose(rival.T_world_cam, invert(of_board(2)), atol=1e-9)
    # the answer is as probable as its world, and says how far the other one is
    assert steps[2].status.reason is Reason.AMBIGUOUS_MOTION
    assert steps[2].probability == pytest.approx(
        probability_followed([rival.log_odds])
    )
    apart = np.linalg.norm(of_wall(2)[:3, 3] - of_board(2)[:3, 3])
    std = np.sqrt(steps[2].covariance[0, 0])
    assert 0.3 * apart < std < apart


def test_when_the_odds_turn_one_step_says_so(monkeypatch) -> None:
    answers = {1: UNDECIDED, 2: answer(2, 0.0, 6.0, 0.9)}
    # from then on the pipeline, which has the other belief now, answers by itself
    for index in (3, 4):
        by_board = answer(index, 0.0, 6.0, 0.97)
        T = by_board.hypotheses[1].T_curr_prev
        answers[index] = by_board.replace(
            T_curr_prev=T, hypotheses=by_board.hypotheses[::-1]
        )
    script = Scripted(monkeypatch, answers)
    steps = script.steps(range(5))
    reasons = [step.status.reason for step in steps]
    assert reasons.count(Reason.WORLD_CHANGED) == 1
    turn = steps[2]
    assert turn.status.reason is Reason.WORLD_CHANGED and turn.usable
    assert turn.probability > 0.5
    # each pose is that of the world followed; the other one's goes on without a jump
    expected = [np.eye(4), invert(of_wall(1))]
    expected += [invert(of_board(index)) for index in (2, 3, 4)]
    for step, T in zip(steps, expected, strict=True):
        np.testing.assert_allclose(step.T_world_cam, T, atol=1e-9)
    # the chain of the motions is the path, and this one's covariance holds the difference
    poses = {step.index: step.T_world_cam for step in steps}
    for step in steps[1:]:
        np.testing.assert_allclose(
            poses[step.prev_index] @ step.T_prev_curr, step.T_world_cam, atol=1e-9
        )
    difference = se3_log(of_wall(2) @ invert(of_board(2)))
    assert difference @ np.linalg.solve(turn.covariance, difference) < 1.1
    # the same start is no news
    assert reasons[3:] == [Reason.AMBIGUOUS_MOTION] * 2


def test_a_jump_leads_from_the_pose_that_was_given() -> None:
    motion = RelativePose(aside(0.1), 1e-6 * np.eye(6))
    given = worlds.with_jump(motion, aside(0.05))
    np.testing.assert_allclose(given.T_curr_prev, aside(0.15), atol=1e-12)
    assert np.sqrt(given.covariance[0, 0]) == pytest.approx(0.05, rel=0.01)
    unmoved = worlds.with_jump(motion, np.eye(4))
    np.testing.assert_allclose(unmoved.covariance, motion.covariance)


def test_what_is_seen_twice_from_one_frame_is_no_news(monkeypatch) -> None:
    answers = {k: answer(k, 2.0, 3.0, 0.95) for k in range(2, 6)}
    script = Scripted(monkeypatch, {1: UNDECIDED, **answers})
    script.steps(range(3))
    (once,) = script.tracker.state.rivals
    script.steps(range(3, 6))
    (often,) = script.tracker.state.rivals
    assert abs(often.log_odds - once.log_odds) < 0.7


def keyframe(index: int = 0) -> Keyframe:
    """A keyframe at the origin."""
    return Keyframe(view(index), np.eye(4), index, index, np.zeros((6, 6)))


def estimate(motion: RelativePose) -> Estimate:
    """A motion from the first frame."""
    start = keyframe()
    return Estimate(start, motion, start, (start,), None)


def believed(sign: float, certainty: float = 7.0) -> Memory:
    """The wall is static, and the board moves; -1: the other way round."""
    log_odds = np.full(grid_index(SIZE).shape[:2], 3.0, np.float16)
    log_odds[:, : log_odds.shape[1] * BORDER // SIZE[1]] = -3.0
    belief = Belief((sign * log_odds).astype(np.float16), certainty)
    return Memory(keyframe(), belief)


def test_nothing_is_computed_where_nothing_is_open(monkeypatch) -> None:
    def never(*args, **kwargs):
        raise AssertionError("computed")

    for name in ("carried_to", "are_distinct", "memory_after", "points_of"):
        monkeypatch.setattr(worlds, name, never)
    sure = estimate(answer(1, 4.0, 2.0, 0.97))
    by_images = estimate(RelativePose(terms=("images", "depth")))
    for memory in (None, believed(1)):
        for followed in (sure, by_images):
            outcome = weighed((), memory, view(1), 1, followed, leads=True)
            assert outcome.estimate is followed and not outcome.rivals


def test_an_answer_that_is_hardly_one_opens_nothing() -> None:
    doubtful = answer(1, 2.0, 2.0, 0.1)
    outcome = weighed((), None, view(1), 1, estimate(doubtful), leads=True)
    assert not outcome.rivals
    # the other motion is less likely than none of them
    alone = answer(1, 0.0, -3.0, 0.6)
    outcome = weighed((), None, view(1), 1, estimate(alone), leads=True)
    assert not outcome.rivals
    elsewhere = Status.degraded(Reason.CONTRADICTED, "the images lead elsewhere")
    contradicted = UNDECIDED.replace(status=elsewhere)
    outcome = weighed((), None, view(1), 1, estimate(contradicted), leads=True)
    assert not outcome.rivals


def test_a_look_that_contradicts_a_belief_challenges_it() -> None:
    """At first without a word: a single look may err."""
    memory = believed(1)
    dissent = estimate(answer(1, 1.0, 3.0, 0.97))
    outcome = weighed((), memory, view(1), 1, dissent, leads=True)
    (rival,) = outcome.rivals
    assert WRONG_BELIEF < rival.log_odds < WRONG_BELIEF / 2
    assert outcome.estimate.motion.ok
    agrees = estimate(answer(2, 3.0, 1.0, 0.97))
    outcome = weighed(outcome.rivals, memory, view(2), 2, agrees, leads=True)
    assert not outcome.rivals


def test_a_wrong_belief_that_every_look_contradicts_dies() -> None:
    memory = believed(1)
    rivals: tuple[World, ...] = ()
    reasons = []
    for index in range(1, 6):
        # each from another frame, as where the camera goes on
        start = keyframe(index)
        dissent = answer(1, -2.0, 4.0, 0.95)
        followed = Estimate(start, dissent, start, (start,), None)
        frame = view(index + 1)
        outcome = weighed(rivals, memory, frame, index + 1, followed, leads=True)
        rivals = outcome.rivals
        reasons.append(outcome.estimate.motion.status.reason)
        if outcome.entered is not None:
            break
    assert reasons[0] is Reason.AMBIGUOUS_MOTION
    assert reasons[-1] is Reason.WORLD_CHANGED and len(reasons) <= 3


def test_at_most_three_worlds_are_kept() -> None:
    undecided = UNDECIDED
    more = tuple(found(aside(x), 1.9, slice(0, 4)) for x in (0.1, 0.2, 0.3))
    undecided = undecided.replace(hypotheses=(*undecided.hypotheses, *more))
    outcome = weighed((), None, view(1), 1, estimate(undecided), leads=True)
    for index in (2, 3, 4):
        outcome = weighed(
            outcome.rivals, None, view(1), index, estimate(undecided), leads=True
        )
    assert 1 <= len(outcome.rivals) <= MAX_RIVALS


def test_a_pose_that_is_set_moves_every_world(monkeypatch) -> None:
    script = Scripted(monkeypatch, {1: UNDECIDED})
    script.steps(range(2))
    (before,) = script.tracker.state.rivals
    T_new = aside(3.0) @ script.tracker.state.T_world_cam
    script.tracker.set_pose(T_new)
    (after,) = script.tracker.state.rivals
    np.testing.assert_allclose(
        after.T_world_cam, aside(3.0) @ before.T_world_cam, atol=1e-9
    )
    assert script.tracker.state.rescaled(2.0).rivals == ()


class Frames:
    """Frames by their numbers, as a sequence reads them again."""

    def frame(self, index: int) -> hvo.Frame:
        return view(index)


def through_a_file(state: TrackerState) -> TrackerState:
    """A state that was saved and restored."""
    return restored(json.loads(json.dumps(saved(state))), Frames())


def test_a_run_that_is_resumed_in_the_middle_goes_on_bit_for_bit() -> None:
    """Two halves of a view move apart: PWVO cannot tell which one is the world."""
    whole = hvo.Odometry()
    steps = [whole.track(view(index)) for index in range(3)]
    assert steps[1].status.reason is Reason.AMBIGUOUS_MOTION
    (rival,) = whole.state.rivals
    other = hvo.Odometry()
    other.resume(through_a_file(whole.state))
    last = whole.track(view(3))
    again = other.track(view(3))
    np.testing.assert_array_equal(again.T_world_cam, last.T_world_cam)
    np.testing.assert_array_equal(again.covariance, last.covariance)
    assert again.probability == last.probability
    assert str(again.status) == str(last.status)
    for one, two in zip(whole.state.rivals, other.state.rivals, strict=True):
        assert one.log_odds == two.log_odds
        np.testing.assert_array_equal(
            one.memory.belief.log_odds, two.memory.belief.log_odds
        )
    # constant in size
    grid = grid_index(SIZE).shape[:2]
    assert rival.memory.belief.log_odds.shape == grid
    assert rival.memory.keyframe.frame is whole.state.keyframes[0].frame


def test_images_alone_cannot_tell_a_world_from_a_thing() -> None:
    """What moves follows one motion as surely as what stands: the next frame is looked at."""
    tracker = hvo.Odometry()
    steps = [tracker.track(view(index, wall=0)) for index in range(2)]
    assert "flow" in steps[1].motion.terms and not tracker.state.rivals
    second = tracker.track(view(2, wall=0))
    assert "memory" in second.motion.terms and second.ok
    (rival,) = tracker.state.rivals
    assert rival.log_odds == WRONG_BELIEF
    third = tracker.track(view(3, wall=0))
    assert "flow" in third.motion.terms and third.ok
    assert not tracker.state.rivals


def test_without_a_memory_there_is_one_world() -> None:
    options = Options(track=replace(Options().track, memory="off"))
    tracker = hvo.Odometry(options=options)
    for index in range(3):
        tracker.track(view(index))
    assert not tracker.state.rivals and tracker.state.memory is None
