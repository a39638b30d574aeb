"""What fills the view is not taken for the static scene that it hides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.belief import Belief
from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import Reason, RelativePose, Status, Term
from hybridvo.solver.points import grid_index
from hybridvo.tracking.calibration import MAX_HIDDEN_FRAMES
from hybridvo.tracking.hidden_world import (
    hidden_by,
    hidden_fraction,
    hides_what_moves,
)
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import Memory
from hybridvo.tracking.search import Estimate
from hybridvo.tracking.tracker_state import TrackerState

SIZE = (120, 160)
CAMERA = hvo.Camera(160.0, 160.0, 79.5, 59.5, height=SIZE[0], width=SIZE[1])
WALL_M, LORRY_M = 4.0, 1.0
NOTHING_KNOWN = np.zeros((6, 6))


def texture(seed: int, width: int) -> np.ndarray:
    """(120, width, 3) smooth noise."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0, 255, (SIZE[0] // 4, width // 4))
    return np.repeat(np.kron(coarse, np.ones((4, 4)))[..., None], 3, axis=2)


def rock_face() -> np.ndarray:
    """(120, 160) depth, metres."""
    v, u = np.indices(SIZE)
    return WALL_M + 1.5 * np.sin(u / 23.0) + 0.8 * np.cos(v / 17.0)


def view(
    first: int,
    last: int,
    rng: np.random.Generator,
    wall: float | np.ndarray = WALL_M,
) -> hvo.Frame:
    """A wall, before which a lorry stands between two columns, with the noise of a camera.

    Its texture moves with its first column.
    """
    rgb = texture(1, SIZE[1])
    depth = np.full(SIZE, wall)
    left, right = max(first, 0), min(last, SIZE[1])
    if right > left:
        rgb[:, left:right] = texture(2, 400)[:, left - first : right - first]
        depth[:, left:right] = LORRY_M
    rgb = np.clip(rgb + rng.normal(0, 2, rgb.shape), 0, 255).astype(np.uint8)
    depth = depth + 0.001 * depth**2 * rng.standard_normal(SIZE)
    return hvo.Frame(rgb, depth.astype(np.float32), CAMERA)


def passing_lorry() -> list[hvo.Frame]:
    """A camera that stands sees a wall; a lorry passes, and for a second nothing else is seen."""
    rng = np.random.default_rng(0)
    ends = [0] * 8 + list(range(0, 400, 8)) + [400 + SIZE[1]] * 4
    return [view(end - 320, end, rng) for end in ends]


@pytest.mark.slow
def test_a_lorry_that_passes_moves_nothing() -> None:
    tracker = hvo.Odometry()
    steps = [tracker.track(frame) for frame in passing_lorry()]
    reasons = [step.status.reason for step in steps]
    hidden = [step for step in steps if step.status.reason is Reason.HIDDEN_WORLD]
    assert len(hidden) > 15
    assert all(step.motion.terms == (Term.EXPECTED,) for step in hidden)
    for step in steps:
        assert np.linalg.norm(step.T_world_cam[:3, 3]) < 0.01
    assert steps[-1].ok
    assert Reason.HIDDEN_WORLD not in reasons[:8] + reasons[-3:]


def leaving_lorry() -> list[hvo.Frame]:
    """A camera that stands sees nothing but a lorry, which then drives off."""
    rng = np.random.default_rng(0)
    starts = range(-16, 100, 3)
    return [view(start, start + 400, rng, rock_face()) for start in starts]


@pytest.mark.slow
def test_the_scene_that_a_lorry_leaves_is_found() -> None:
    tracker = hvo.Odometry()
    steps = [tracker.track(frame) for frame in leaving_lorry()]
    lengths = np.array([np.linalg.norm(each.T_curr_prev[:3, 3]) for each in steps])
    # nothing but the lorry is seen
    assert np.all(lengths[1:5] > 0.01)
    # half of the view is what it hid
    assert all(each.ok for each in steps[32:])
    assert np.all(lengths[32:] < 0.005)


def test_what_moves_was_hidden_at_first_or_was_not() -> None:
    rng = np.random.default_rng(0)
    memory = memory_of(view(-240, 80, rng))
    log_odds = memory.belief.log_odds.copy()
    middle = log_odds.shape[1] // 2
    log_odds[:, middle:] = -3.0
    wall_moves = replace(memory, belief=Belief(log_odds, certainty=7.0))
    log_odds = -log_odds
    lorry_moves = replace(memory, belief=Belief(log_odds, certainty=7.0))
    everywhere = [memory_of(view(-240, 160, rng)).keyframe]
    nowhere = [memory_of(view(0, 0, rng)).keyframe]
    assert hides_what_moves(wall_moves, everywhere)
    assert not hides_what_moves(lorry_moves, everywhere)
    assert not hides_what_moves(wall_moves, nowhere)
    assert not hides_what_moves(memory, everywhere)
    assert not hides_what_moves(None, everywhere)
    assert not hides_what_moves(wall_moves, [])


def memory_of(frame: hvo.Frame, log_odds: float = 3.0) -> Memory:
    """All of a frame's view is believed static."""
    shape = grid_index(SIZE).shape[:2]
    belief = Belief(np.full(shape, log_odds, np.float16), certainty=7.0)
    return Memory(Keyframe(frame, np.eye(4), 0, 0, NOTHING_KNOWN), belief)


@pytest.mark.parametrize(
    ("last", "expected"), [(0, 0.0), (40, 0.25), (80, 0.5), (160, 1)]
)
def test_the_hidden_fraction_by_hand(last: int, expected: float) -> None:
    rng = np.random.default_rng(0)
    world = memory_of(view(0, 0, rng))
    now = view(0, last, rng)
    assert hidden_fraction(world, now, np.eye(4)) == pytest.approx(
        expected, abs=0.04
    )


def test_what_is_out_of_view_is_not_hidden() -> None:
    rng = np.random.default_rng(0)
    world = memory_of(view(0, 0, rng))
    turned = se3_exp(np.array([0, 0, 0, 0, 1.2, 0]))
    assert hidden_fraction(world, view(0, 160, rng), turned) == 0
    # nothing was known to stand
    unknown = memory_of(view(0, 0, rng), 0.0)
    assert hidden_fraction(unknown, view(0, 160, rng), np.eye(4)) == 0


def test_a_hidden_scene_is_waited_for_until_a_motion_is_sure() -> None:
    rng = np.random.default_rng(0)
    frame = view(0, 0, rng)
    world = memory_of(frame)
    doubted = RelativePose(
        status=Status.degraded(Reason.AMBIGUOUS_MOTION, "two motions")
    )
    state = TrackerState(reference=world.keyframe, world=world, hidden=1)

    def hidden(motion: RelativePose, state: TrackerState) -> float:
        return hidden_by(state, frame, Estimate(world.keyframe, motion, ()))

    assert hidden(doubted, state) == 1
    assert hidden(RelativePose(), state) == 0
    # it may have been no scene
    assert hidden(doubted, replace(state, hidden=MAX_HIDDEN_FRAMES)) == 0
    assert hidden(doubted, replace(state, hidden=0)) == 0
    assert hidden(doubted, replace(state, world=None)) == 0
