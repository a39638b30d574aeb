"""What was static stays static until it is found to move."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import hybridvo as hvo
from hybridvo.core.belief import Belief
from hybridvo.core.calibration import MIN_CERTAINTY, MIN_PROBABILITY
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.options import Options, TrackOptions
from hybridvo.core.results import RelativePose, Status
from hybridvo.core.types import FramePair
from hybridvo.evidence.calibration import HANDED_OVER, SEEN_THROUGH_LOG_ODDS
from hybridvo.judge.calibration import DIRECT_PROBABILITY
from hybridvo.judge.probability import probability_of
from hybridvo.pipeline import sure_alignment
from hybridvo.run.commands.stored_state import restored, saved
from hybridvo.solver.align import align_images
from hybridvo.solver.points import grid_index
from hybridvo.solver.visibility import visibility
from hybridvo.tracking.calibration import (
    BELIEF_DECAY,
    BELIEF_LIMIT,
)
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import (
    Memory,
    after_step,
    carried_to,
    faded,
    nothing_known,
    updated_log_odds,
)
from hybridvo_lab.synthetic.slow_scenes import slow_scene
from tests import slow_walk

SIZE = (120, 160)
CAMERA = hvo.Camera(160.0, 160.0, 79.5, 59.5, height=SIZE[0], width=SIZE[1])
WALL = 2.0
BOX = np.s_[30:90, 60:100]
LARGE_BOX = np.s_[10:110, 40:130]
Region = tuple[slice, slice]
"""Rows and columns of a box before the wall, at one metre."""


def texture(seed: int, shift: int = 0) -> np.ndarray:
    """(H, W, 3) smooth noise, shifted to the right by whole pixels."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (SIZE[0] // 4, SIZE[1] // 4 + 20)).astype(
        np.uint8
    )
    fine = np.kron(coarse, np.ones((4, 4), np.uint8))
    grey = fine[:, 40 - shift : 40 - shift + SIZE[1]]
    return grey[..., None].repeat(3, 2)


def view(
    box: int | None = None, seed: int = 0, index: int = 0, region: Region = BOX
) -> hvo.Frame:
    """A wall, and a box that went ``box`` px to the right from its region."""
    rgb = texture(seed)
    depth = np.full(SIZE, WALL, np.float32)
    if box is not None:
        rows, columns = region
        place = rows, slice(columns.start + box, columns.stop + box)
        rgb[place] = texture(seed + 1)[region]
        depth[place] = 1.0
    return hvo.Frame(rgb, depth, CAMERA, index=index)


def keyframe(frame: hvo.Frame, x: float = 0.0, count: int = 0) -> Keyframe:
    """A keyframe ``x`` metres to the right of the origin."""
    T_world_cam = se3_exp(np.array([x, 0, 0, 0, 0, 0]))
    return Keyframe(frame, T_world_cam, count, count, np.zeros((6, 6)))


def at(memory: Memory, row: int, column: int) -> float:
    """The log odds of the point nearest to a pixel."""
    index = grid_index(SIZE)
    distance = np.abs(index - [row, column]).sum(axis=2)
    return float(memory.belief.log_odds.flat[np.argmin(distance)])


def stands(probability: float = 0.95, **fields: object) -> RelativePose:
    """No motion, as the images alone give it."""
    terms = ("images", "depth")
    return RelativePose(probability=probability, terms=terms).replace(**fields)


LOG_ODDS = arrays(
    np.float16, (4, 5), elements=st.floats(-BELIEF_LIMIT, BELIEF_LIMIT, width=16)
)
RATIOS = arrays(np.float32, (4, 5), elements=st.floats(-10, 10, width=32))
PROBABILITIES = st.floats(0, 1)


@given(LOG_ODDS, RATIOS, PROBABILITIES)
def test_a_belief_is_bounded_and_grows_with_the_evidence(
    log_odds: np.ndarray, ratio: np.ndarray, probability: float
) -> None:
    after = updated_log_odds(log_odds, ratio, probability)
    assert np.isfinite(after).all()
    assert np.abs(after).max() <= BELIEF_LIMIT
    more = updated_log_odds(log_odds, ratio + 0.5, probability)
    rounding = 1e-5
    assert (more >= after - rounding).all()
    likelier = np.abs(ratio)
    surer = updated_log_odds(log_odds, likelier, min(1.0, probability + 0.1))
    before = updated_log_odds(log_odds, likelier, probability)
    assert (surer >= before - rounding).all()


@given(LOG_ODDS, RATIOS)
def test_a_motion_that_is_not_the_cameras_is_no_evidence(
    log_odds: np.ndarray, ratio: np.ndarray
) -> None:
    after = updated_log_odds(log_odds, ratio, 0.0)
    np.testing.assert_allclose(after, BELIEF_DECAY * log_odds, atol=0.01)
    unknown = updated_log_odds(log_odds, np.zeros_like(ratio), 0.9)
    np.testing.assert_allclose(unknown, BELIEF_DECAY * log_odds, atol=0.01)


@given(LOG_ODDS, st.floats(-3, 7))
def test_a_belief_without_evidence_dies(
    log_odds: np.ndarray, certainty: float
) -> None:
    memory = Memory(keyframe(view()), Belief(log_odds, certainty))
    for _ in range(200):
        memory = faded(memory)
    assert np.abs(memory.belief.log_odds).max() < 0.01
    assert not memory.belief.is_ready


def test_how_far_a_point_lies_behind_what_is_measured() -> None:
    """At 2 m two depths of one surface differ by 1.4 cm, the standard deviation."""
    sigma = 0.003 * 2 + 0.002 * 4
    z = 2.0 + sigma * np.array([-2.0, 0.0, 1.0, 5.0])
    points = np.stack([np.zeros(4), np.zeros(4), z], axis=1)
    there = visibility(points, view(), 0.0)
    np.testing.assert_allclose(there.distance, [-2, 0, 1, 5], rtol=0.1, atol=1e-6)
    assert there.is_hidden.tolist() == [False, False, False, True]
    outside = visibility(np.array([[9.0, 0.0, 2.0], [0.0, 0.0, -1.0]]), view(), 0.0)
    assert not outside.inside.any() and not outside.distance.any()
    holes = replace(view(), depth=np.zeros(SIZE, np.float32))
    assert not visibility(points, holes, 0.0).is_measured.any()


def test_what_keeps_its_look_and_depth_is_static_and_what_leaves_moves() -> None:
    memory = nothing_known(keyframe(view(box=0)))
    for box in (6, 12, 18):
        memory = after_step(memory, view(box=box), stands())
    # the wall above the box, and the left part of the box, which shows the wall now
    assert at(memory, 10, 80) > 1
    assert at(memory, 60, 64) < -1
    assert memory.belief.something_moves


def test_what_is_hidden_is_no_evidence() -> None:
    memory = nothing_known(keyframe(view(box=0)))
    memory = after_step(memory, view(box=20), stands())
    hidden = at(memory, 60, 112)
    assert hidden == 0
    # nor is what no depth is measured of any more: something may stand before it
    blind = view(box=0)
    blind.depth[:, :40] = 0
    memory = after_step(nothing_known(keyframe(view(box=0))), blind, stands())
    assert at(memory, 60, 16) == 0 and at(memory, 10, 80) > 0


def test_a_blank_wall_looks_the_same_wherever_it_went() -> None:
    blank = view()
    blank.rgb[:] = 128
    memory = after_step(nothing_known(keyframe(blank)), blank, stands())
    textured = after_step(nothing_known(keyframe(view())), view(), stands())
    assert at(memory, 60, 80) < at(textured, 60, 80)


def test_an_unsure_motion_says_nothing() -> None:
    unsure = stands(status=Status.degraded(hvo.Reason.AMBIGUOUS_MOTION, ""))
    memory = nothing_known(keyframe(view(box=0)))
    memory = after_step(memory, view(box=20), unsure)
    assert not memory.belief.log_odds.any()


def test_certainty_comes_from_what_does_not_rest_on_memory() -> None:
    memory = nothing_known(keyframe(view()))
    by_images = after_step(memory, view(), stands())
    assert by_images.belief.certainty > MIN_CERTAINTY
    by_itself = after_step(
        by_images, view(), stands(terms=("images", "depth", "memory"))
    )
    assert by_itself.belief.certainty < by_images.belief.certainty
    by_flow = after_step(by_images, view(), stands(terms=("flow", "images")))
    assert by_flow.belief.certainty > by_itself.belief.certainty


def test_flow_that_contradicts_a_belief_ends_it() -> None:
    frame = view(box=0)
    wrong = Belief(np.full(grid_index(SIZE).shape[:2], 3.0, np.float16), 1.0)
    memory = Memory(keyframe(frame), wrong)
    turned = se3_exp(np.array([0, 0, 0, 0, 0.1, 0]))
    by_flow = stands(T_curr_prev=turned, terms=("flow", "images"))
    for _ in range(5):
        memory = after_step(memory, frame, by_flow)
    assert not memory.belief.is_ready


def test_the_next_keyframe_gets_what_both_see() -> None:
    """The camera goes 10 cm to the right: the wall, at 2 m, moves by 8 px."""
    old = keyframe(view(), 0.0, 0)
    log_odds = np.full(grid_index(SIZE).shape[:2], 2.0, np.float16)
    log_odds[grid_index(SIZE)[..., 1] >= 80] = -2.0
    memory = Memory(old, Belief(log_odds, 4.0))
    new = keyframe(view(), 0.1, 1)
    handed = carried_to(memory, new)
    assert handed.keyframe is new and handed.belief.certainty == 4.0
    assert at(handed, 60, 64) == pytest.approx(HANDED_OVER * 2.0, abs=0.01)
    # column 76 shows what column 84 showed
    assert at(handed, 60, 76) == pytest.approx(-HANDED_OVER * 2.0, abs=0.01)
    # out of view before
    assert at(handed, 60, 157) == 0
    assert carried_to(memory, old).belief is memory.belief


def test_what_came_before_the_wall_moves_and_what_it_left_is_unknown() -> None:
    log_odds = np.full(grid_index(SIZE).shape[:2], 2.0, np.float16)
    memory = Memory(keyframe(view(box=0), 0.0, 0), Belief(log_odds, 4.0))
    handed = carried_to(memory, keyframe(view(box=30), 0.0, 1))
    assert at(handed, 60, 124) == pytest.approx(SEEN_THROUGH_LOG_ODDS, abs=0.01)
    assert at(handed, 60, 64) == 0
    assert at(handed, 60, 30) > 1


def test_the_images_alone_are_enough_on_what_is_static() -> None:
    """A box on half of the view moves: not sure alone, sure with a memory."""
    before = view(box=0, index=0, region=LARGE_BOX)
    pair = FramePair(before, view(box=8, index=1, region=LARGE_BOX), None)
    alone = sure_alignment(align_images(pair), 0.0)
    assert alone is not None
    log_odds = np.full(grid_index(SIZE).shape[:2], 3.0, np.float16)
    moves = np.zeros(SIZE, bool)
    moves[LARGE_BOX] = True
    index = grid_index(SIZE)
    log_odds[moves[index[..., 0], index[..., 1]]] = -3.0
    belief = Belief(log_odds, 7.0)
    known = sure_alignment(align_images(pair, belief=belief), DIRECT_PROBABILITY)
    assert probability_of(alone.evidence) < MIN_PROBABILITY
    assert known is not None and "memory" in known.terms
    # what is believed to move has no weight
    assert known.weights[60, 80] == 0 and known.weights[5, 20] == 1


def test_a_motion_that_hides_most_of_what_is_known_is_refused() -> None:
    """Everything but a border shows something nearer now."""
    covered = view()
    covered.depth[10:-10, 10:-10] = 0.5
    covered.rgb[10:-10, 10:-10] = texture(7)[10:-10, 10:-10]
    known = np.full(grid_index(SIZE).shape[:2], 3.0, np.float16)
    pair = FramePair(view(), covered, None)
    rough = align_images(pair, belief=Belief(known, 7.0))
    assert sure_alignment(rough, DIRECT_PROBABILITY) is None


@pytest.mark.parametrize("mode", ["auto", "off"])
def test_a_tracker_remembers_and_forgets(mode: str) -> None:
    options = Options(track=TrackOptions(memory=mode))
    tracker = hvo.Odometry(options=options)
    for index in range(3):
        tracker.track(view(index=index, seed=3))
    memory = tracker.state.memory
    assert (memory is not None) == (mode == "auto")
    if memory is not None:
        assert memory.belief.static_fraction > 0.8
        # of a keyframe that is kept anyway, and constant in size
        assert memory.keyframe.frame is tracker.state.keyframes[0].frame
        assert memory.belief.log_odds.shape == grid_index(SIZE).shape[:2]
        tracker.set_pose(se3_exp(np.array([1.0, 0, 0, 0, 0, 0])))
        np.testing.assert_allclose(
            tracker.state.memory.keyframe.T_world_cam,
            tracker.state.keyframes[0].T_world_cam,
        )
    tracker.reset()
    assert tracker.state.memory is None


def test_a_belief_that_is_wrong_is_unlearned() -> None:
    """What is believed static and what is believed to move change places after two steps."""
    scene = slow_scene("light", 9000, 24, (120, 160))
    poses = scene.T_world_cam
    tracker = hvo.Odometry()
    for step, number in enumerate(range(0, 24, 3)):
        answer = tracker.track(replace(scene.render(number), index=step))
        memory = tracker.state.memory
        if step == 2:
            inverted = Belief((-memory.belief.log_odds).astype(np.float16), 7.0)
            wrong = replace(memory, belief=inverted)
            tracker.state = replace(tracker.state, memory=wrong)
    T = invert(poses[0]) @ poses[21]
    off = np.linalg.norm(answer.T_world_cam[:3, 3] - T[:3, 3])
    assert answer.ok and off < 0.01
    # the box near the camera moves again
    assert memory.belief.static_fraction > memory.belief.moving_fraction


@pytest.mark.slow
def test_little_that_is_static_in_a_small_image_is_not_sure() -> None:
    """Most of 160 columns moves slowly: what is static shows the motion to some millimetres only.

    Its error as a fraction of the ego flow was small, and 19 motions were sure and wrong.
    """
    frames, poses = slow_walk.frames("heavy_two", seed=5, count=40)
    tracker = hvo.Odometry()
    wrong = 0
    for k, frame in enumerate(frames):
        step = tracker.track(frame)
        if k == 0 or not step.ok:
            continue
        T_true = invert(poses[k]) @ poses[step.prev_index]
        difference = se3_log(step.T_curr_prev @ invert(T_true))
        wrong += bool(np.linalg.norm(difference[:3]) > 0.005)
    assert wrong <= 8


def test_a_memory_is_saved_and_restored_bit_for_bit() -> None:
    class Frames:
        def frame(self, index: int) -> hvo.Frame:
            return view(index=index)

    rng = np.random.default_rng(0)
    log_odds = rng.normal(size=grid_index(SIZE).shape[:2]).astype(np.float16)
    memory = Memory(keyframe(view(), count=0), Belief(log_odds, 1.25))
    text = json.dumps(saved(memory))
    again = restored(json.loads(text), Frames())
    np.testing.assert_array_equal(again.belief.log_odds, log_odds)
    assert again.belief.log_odds.dtype == np.float16
    assert again.belief.certainty == 1.25 and again.keyframe.count == 0
    # a memory is written after every frame
    assert len(text) < 1.5 * 4 / 3 * log_odds.nbytes + 2000
