"""What moves by itself: told apart, kept under its number, and never in the camera's way."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.options import Options, TrackOptions
from hybridvo.core.results import Status, Step
from hybridvo.objects.followed import MAX_OBJECTS, Things, _velocity, after_step
from hybridvo.objects.motions import (
    Earlier,
    Fit,
    GridView,
)
from hybridvo.run.commands.stored_state import restored, saved
from hybridvo_lab.synthetic.scenes import make_scene
from tests.worlds import CHI2_3SIGMA

SIZE = (120, 160)
CAMERA = hvo.Camera(160.0, 160.0, 79.5, 59.5, height=SIZE[0], width=SIZE[1])
WALL = 3.0
ON = Options(track=TrackOptions(objects="auto"))
OFF = Options(track=TrackOptions(objects="off"))


class Box(NamedTuple):
    """A board before the wall, parallel to it."""

    left: int  # px
    top: int = 40
    width: int = 44
    height: int = 40
    depth: float = 1.5  # m
    seed: int = 1  # of its texture


def texture(seed: int, height: int, width: int) -> np.ndarray:
    """(height, width) smooth noise, grey levels."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(30, 226, (height // 4 + 2, width // 4 + 2))
    fine = np.kron(coarse, np.ones((4, 4)))[:height, :width]
    kernel = np.ones(3) / 3
    for axis in (0, 1):
        fine = np.apply_along_axis(np.convolve, axis, fine, kernel, "same")
    return fine


def view(*boxes: Box, index: int = 0) -> hvo.Frame:
    """What a camera that stands sees of a wall, and of boards before it, the last in front."""
    grey = texture(0, *SIZE)
    depth = np.full(SIZE, WALL, np.float32)
    for box in boxes:
        left = max(box.left, 0)
        rows = slice(box.top, box.top + box.height)
        columns = slice(left, max(left, box.left + box.width))
        own = texture(box.seed, box.height, box.width)[:, left - box.left :]
        seen = grey[rows, columns].shape
        grey[rows, columns] = own[: seen[0], : seen[1]]
        depth[rows, columns] = box.depth
    rgb = np.rint(grey).astype(np.uint8)[..., None].repeat(3, 2)
    return hvo.Frame(rgb, depth, CAMERA, 0.1 * index, index)


def follow(frames: list[hvo.Frame]) -> list[tuple[hvo.MovingObject, ...]]:
    """The objects after each frame but the first, before a camera that stands."""
    things = Things()
    seen = []
    for k in range(1, len(frames)):
        before = Earlier(frames[k - 1], np.eye(4))
        far = Earlier(frames[0], np.eye(4)) if k > 1 else None
        views = GridView(frames[k], before, far)
        things, shown = after_step(things, views, 1, Options())
        seen.append(shown)
    return seen


def overlap(mask: np.ndarray, box: Box) -> float:
    """Intersection over union of a mask and a board."""
    own = np.zeros(SIZE, bool)
    own[box.top : box.top + box.height, max(box.left, 0) : box.left + box.width] = (
        True
    )
    return float((mask & own).sum() / (mask | own).sum())


def aside(px: float, depth: float = 1.5) -> np.ndarray:
    """(4, 4) motion of a board that moves to the right by so many pixels."""
    T = np.eye(4)
    T[0, 3] = px * depth / CAMERA.fx
    return T


def is_within_3_sigma(thing: hvo.MovingObject, T: np.ndarray) -> bool:
    """Whether the motion of an object agrees with its covariance."""
    error = se3_log(T @ invert(thing.T_curr_prev))
    return float(error @ np.linalg.solve(thing.covariance, error)) < CHI2_3SIGMA


def test_a_board_that_moves_is_one_object_with_its_motion() -> None:
    boxes = [Box(30 + 3 * k) for k in range(4)]
    seen = follow([view(box, index=k) for k, box in enumerate(boxes)])
    for k, things in enumerate(seen, 1):
        (thing,) = things
        assert thing.id == 1
        assert thing.age == k - 1
        assert overlap(thing.mask, boxes[k]) > 0.8
        assert thing.fraction == pytest.approx(thing.mask.mean())
        assert is_within_3_sigma(thing, aside(3))
        assert thing.centre[2] == pytest.approx(1.5)
        own = thing.T_own(np.eye(4))[0, 3]
        assert own == pytest.approx(3 * 1.5 / CAMERA.fx, abs=0.01)
    assert seen[-1][0].confidence > 0.9


def test_it_keeps_its_number_while_something_stands_before_it() -> None:
    column = Box(70, 0, 40, 120, 1.0, 5)
    boxes = [Box(20 + 4 * k, width=28) for k in range(26)]
    frames = [view(box, column, index=k) for k, box in enumerate(boxes)]
    seen = follow(frames)
    ids = [{thing.id for thing in things if thing.is_seen} for things in seen]
    hidden = [k for k, own in enumerate(ids) if not own]
    assert hidden, "the column hides it for some frames"
    assert set().union(*ids) == {1}
    assert ids[0] == ids[-1] == {1}
    behind = seen[hidden[0]][0]
    assert behind.hidden == 1
    assert behind.status.state is hvo.State.FAILED
    assert not behind.mask.any()
    # it goes on as before, as far as that was known at the edge of the column
    assert is_within_3_sigma(behind, aside(4))


def test_one_that_stays_away_is_forgotten() -> None:
    frames = [view(Box(30 + 3 * k), index=k) for k in range(3)]
    frames += [view(index=k) for k in range(3, 24)]
    seen = follow(frames)
    assert [thing.id for thing in seen[1]] == [1]
    assert seen[-1] == ()


def test_two_that_touch_are_two() -> None:
    right = [Box(30 + 3 * k, seed=1) for k in range(4)]
    down = [Box(74 + 3 * k, 30 + 3 * k, seed=2) for k in range(4)]
    frames = [
        view(a, b, index=k)
        for k, (a, b) in enumerate(zip(right, down, strict=True))
    ]
    for k, things in enumerate(follow(frames), 1):
        assert {thing.id for thing in things} == {1, 2}
        best = [max(overlap(t.mask, b[k]) for t in things) for b in (right, down)]
        assert min(best) > 0.6


def test_a_camera_that_moves_past_a_standing_scene_sees_none() -> None:
    scene = make_scene("static", 0, height=120, width=160, frames=5)
    vo = hvo.Odometry(network=None, options=ON)
    assert all(not vo.track(scene.render(k)).objects for k in range(5))
    assert vo.things.known == ()


def steps_of(frames: list[hvo.Frame], options: Options) -> list[Step]:
    """The steps of a tracker."""
    vo = hvo.Odometry(network=None, options=options)
    return [vo.track(frame) for frame in frames]


def test_the_camera_is_the_same_with_objects_and_without() -> None:
    scene = make_scene("light", 1, height=120, width=160, frames=5)
    frames = [scene.render(k) for k in range(5)]
    on = steps_of(frames, ON)
    off = steps_of(frames, OFF)
    assert any(step.objects for step in on)
    assert not any(step.objects for step in off)
    for one, other in zip(on, off, strict=True):
        assert one.T_world_cam.tobytes() == other.T_world_cam.tobytes()
        assert one.covariance.tobytes() == other.covariance.tobytes()
        assert one.probability == other.probability
        assert one.status == other.status


class OfFrames:
    """A sequence of frames in memory."""

    def __init__(self, frames: list[hvo.Frame]) -> None:
        self.frame = frames.__getitem__


@pytest.mark.slow
def test_a_resumed_tracker_goes_on_with_the_same_objects() -> None:
    scene = make_scene("light", 1, height=120, width=160, frames=6)
    frames = [scene.render(k) for k in range(6)]
    vo = hvo.Odometry(network=None, options=ON)
    for frame in frames[:4]:
        vo.track(frame)
    text = json.dumps(saved((vo.state, vo.things)))
    other = hvo.Odometry(network=None, options=ON)
    state, things = restored(json.loads(text), OfFrames(frames))  # type: ignore[arg-type]
    other.resume(state, things)
    assert vo.things.known
    for frame in frames[4:]:
        one = vo.track(frame).objects
        two = other.track(frame).objects
        assert [thing.id for thing in one] == [thing.id for thing in two]
        for a, b in zip(one, two, strict=True):
            assert a.T_curr_prev.tobytes() == b.T_curr_prev.tobytes()
            assert (a.mask == b.mask).all()


def test_all_lengths_of_objects_grow_with_the_scale() -> None:
    frames = [view(Box(30 + 3 * k), index=k) for k in range(3)]
    pair = GridView(frames[1], Earlier(frames[0], np.eye(4)))
    things, _ = after_step(Things(), pair, 1, Options())
    larger = things.rescaled(2.0)
    (one,), (two,) = things.known, larger.known
    np.testing.assert_allclose(two.points, 2 * one.points)
    np.testing.assert_allclose(two.T_own[:3, 3], 2 * one.T_own[:3, 3])
    np.testing.assert_array_equal(two.T_own[:3, :3], one.T_own[:3, :3])


@pytest.mark.parametrize(
    "spoilt",
    [{"depth": None}, {"rgb": None}, {"depth": np.zeros(SIZE, np.float32)}],
)
def test_a_frame_that_lacks_something_shows_no_objects(spoilt) -> None:  # type: ignore[no-untyped-def]
    vo = hvo.Odometry(network=None, options=ON)
    for k in range(3):
        vo.track(view(Box(30 + 3 * k), index=k))
    step = vo.track(replace(view(Box(39), index=3), **spoilt))
    assert step.objects == ()
    after = vo.track(view(Box(42), index=4))
    assert isinstance(after.objects, tuple)


def test_a_mask_of_a_few_points_is_no_object() -> None:
    boxes = [Box(60 + 3 * k, width=3, height=3) for k in range(3)]
    assert follow([view(box, index=k) for k, box in enumerate(boxes)]) == [(), ()]


def test_what_deforms_says_so() -> None:
    """Stripes of a board that move up and down against each other."""

    def folding(k: int) -> hvo.Frame:
        boxes = [
            Box(
                40 + 10 * n + 2 * k,
                30 + (3 * k if n % 2 else -3 * k),
                10,
                60,
                seed=n,
            )
            for n in range(8)
        ]
        return view(*boxes, index=k)

    things = follow([folding(k) for k in range(4)])[-1]
    rigid = [thing for thing in things if thing.is_seen and thing.status.ok]
    large = [thing for thing in rigid if thing.fraction > 0.1]
    assert not large


def test_so_many_are_kept_and_no_more() -> None:
    boxes = [
        Box(4 + 26 * c, 4 + 24 * r, 14, 14, seed=10 * c + r)
        for c in range(6)
        for r in range(5)
    ]
    frames = [
        view(*(b._replace(left=b.left + 2 * k) for b in boxes), index=k)
        for k in range(4)
    ]
    for things in follow(frames):
        assert len(things) <= MAX_OBJECTS


def test_one_in_the_corner_is_followed() -> None:
    boxes = [Box(-10 + 3 * k, 0) for k in range(4)]
    seen = follow([view(box, index=k) for k, box in enumerate(boxes)])
    assert [[thing.id for thing in things] for things in seen] == [[1]] * 3
    assert is_within_3_sigma(seen[-1][0], aside(3))


def test_two_measurements_of_a_motion_are_surer_than_one() -> None:
    """Equally sure ones meet in the middle, with half of the covariance of each."""
    covariance = np.diag([1e-4, 2e-4, 3e-4, 1e-5, 2e-5, 3e-5])
    ahead = SimpleNamespace(T_own=np.eye(4), covariance=covariance)
    view_of = SimpleNamespace(before=SimpleNamespace(T_curr_prev=np.eye(4)))
    step = np.array([0.02, 0, 0, 0, 0, 0])
    fit = Fit(se3_exp(step), covariance, Status(), 1.0)
    T_own, stated = _velocity(ahead, fit, view_of, 1)
    np.testing.assert_allclose(se3_log(T_own), step / 2, atol=1e-12)
    np.testing.assert_allclose(stated, covariance / 2, rtol=1e-9)
