"""Keeping up with a camera: clock, camera and tracker follow a script, and no real time passes."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.options import load_options
from hybridvo.io import live_rate
from hybridvo.io.cameras.base import EndOfFrames, Reading, rate_of
from hybridvo.io.live import LiveStep, LiveStream, stream
from hybridvo.io.live_rate import (
    MIN_POSES_HZ,
    RATE_FRAMES,
    AutoRate,
    RateKeeper,
    rate_by_stamps,
)
from hybridvo_lab.synthetic.scenes import make_scene
from tests.io.live.scripted import (
    LONG_S,
    QUICK,
    ScriptedCamera,
    Tracker,
    frame,
    reading,
)

VGA = hvo.Camera(fx=500, fy=500, cx=319.5, cy=239.5, height=480, width=640)
PERIOD_S = 1 / 30
MAX_AGE_MS = 150.0


class World:
    """A clock that only the script moves, and the camera whose frames come by it.

    The thread that reads the camera goes on when it is given a frame, and whoever gives one waits
    until it was taken: nothing depends on how fast the threads are.

    Args:
        frames: how many come.
        slower: how much slower the machine is, by the time in seconds.
    """

    name = "scripted"
    fps = 30.0

    def __init__(
        self, frames: int, slower: Callable[[float], float] = lambda now: 1.0
    ) -> None:
        self.now = 0.0
        self.slower = slower
        self.frames = frames
        self.stream: LiveStream | None = None
        self._next = 0
        self._is_over = False
        self._given = threading.Semaphore(0)
        self._waits = threading.Semaphore(0)
        image = np.zeros((*VGA.shape, 3), np.uint8)
        depth = np.full(VGA.shape, 2.0, np.float32)
        self._frame = hvo.Frame(image, depth, VGA)

    def clock(self) -> float:
        return self.now

    # the camera, in the thread that reads it

    def open(self) -> None:
        """It is there."""

    def read(self, timeout_s: float) -> Reading:
        self._waits.release()
        assert self._given.acquire(timeout=LONG_S)
        if self._is_over:
            raise EndOfFrames
        number = self._next
        self._next += 1
        stamp = 1000 + number * PERIOD_S
        one = hvo.Frame(self._frame.rgb, self._frame.depth, VGA, stamp)
        return Reading(one, number=number)

    def close(self) -> None:
        """Nothing is held open."""

    # the script, in the thread that tracks

    def give(self) -> None:
        """The next frame comes, at its time."""
        if self._is_over:
            return
        assert self._waits.acquire(timeout=LONG_S)
        self.now = max(self.now, self._next * PERIOD_S)
        self._is_over = self._next == self.frames
        self._given.release()
        if not self._is_over:
            # until it was taken
            assert self._waits.acquire(timeout=LONG_S)
            self._waits.release()

    def pass_time(self, ms: float) -> None:
        """Time passes while the tracker works; frames come meanwhile."""
        end = self.now + 1e-3 * ms * self.slower(self.now)
        while not self._is_over and self._next * PERIOD_S <= end:
            self.give()
        self.now = end

    def idle(self) -> bool:
        """Nobody works: the next frame is waited for. Never asks to stop."""
        if self.stream._reader._newest is None:
            self.give()
        return False


class CostlyTracker(Tracker):
    """A tracker whose frames cost what those of the real one do, about.

    Images and depth alone show the motion where few frames were dropped; else flow is needed, and
    without a budget matches are sought as well, the longer the more frames were dropped.
    """

    def __init__(self, world: World, options: hvo.Options) -> None:
        super().__init__()
        self.world = world
        self.options = options

    def track(self, one: hvo.Frame) -> hvo.Step:
        before = self.frames[-1].timestamp if self.frames else one.timestamp
        spanned = round((one.timestamp - before) / PERIOD_S)
        self.world.pass_time(self.cost_ms(one.camera, spanned))
        return super().track(one)

    def cost_ms(self, camera: hvo.Camera, spanned: int) -> float:
        """Milliseconds of a frame that is so many frames after the one before."""
        if not spanned:
            return 1.0
        area = camera.height * camera.width / (VGA.height * VGA.width)
        ms = 15 + 30 * area
        if spanned <= 2 and self.options.direct.mode != "off":
            return ms
        ms += 60 if self.options.flow.dis_preset == "medium" else 40 * area
        ms += 10
        return ms if self.options.track.budget_ms else ms + 100 * spanned


def play(
    world: World,
    auto: bool = True,
    *options: str,
    seen: list[float] | None = None,
) -> tuple[LiveStream, list[LiveStep], list[str]]:
    """Follow a camera to its end; returns the stream, its steps and what it said."""
    said: list[str] = []

    def make(options: hvo.Options) -> CostlyTracker:
        tracker = CostlyTracker(world, options)
        if seen is not None:
            tracker.on_track = lambda _: seen.append(
                tracker.options.track.budget_ms
            )
        return tracker

    given = load_options(None, options)
    world.stream = steps = LiveStream(
        world,
        None if auto else make(given),
        seconds=None,
        max_frames=None,
        stop=world.idle,
        say=said.append,
        patience=QUICK,
        clock=world.clock,
        auto=AutoRate(given, make) if auto else None,
    )
    return steps, list(steps), said


def poses_a_second(found: list[LiveStep]) -> float:
    """By the stamps of the frames that were tracked."""
    stamps = [live.frame.timestamp for live in found]
    return (len(stamps) - 1) / (stamps[-1] - stamps[0])


def test_thirty_frames_a_second_are_kept_up_with() -> None:
    steps, found, said = play(World(300))
    assert poses_a_second(found) >= MIN_POSES_HZ
    assert steps.age_ms(95) < MAX_AGE_MS
    assert found[-1].frame.camera.shape == (240, 320)
    assert len(said) == 1
    assert said[0].startswith(
        "rate auto: images of 320x240, flow 'fast', budget 33 ms"
    )
    assert "30 frames a second" in said[0] and "at 640x480" in said[0]
    summary = steps.summary()
    assert summary["chosen"] == said[0]
    assert summary["size"] == [320, 240]
    assert summary["tracked"] + summary["dropped"] + summary["tried"] == 300


def test_a_fast_machine_keeps_every_pixel_and_every_frame() -> None:
    steps, found, said = play(World(100, slower=lambda now: 0.3))
    assert found[-1].frame.camera == VGA
    assert "images of 640x480, budget 33 ms" in said[0] and "its rate" in said[0]
    assert steps.counts.dropped == 0
    assert steps.help() == ""


def test_a_machine_that_becomes_slower_goes_on_in_smaller_images() -> None:
    """No motion is missing: the new tracker starts at the last frame and its pose."""
    world = World(600, slower=lambda now: 0.3 if now < 5 else 3.0)
    steps, found, said = play(world)
    sizes = [live.frame.camera.width for live in found]
    changes = [k for k in range(1, len(sizes)) if sizes[k] != sizes[k - 1]]
    assert [sizes[0], *(sizes[k] for k in changes)] == [640, 320, 213]
    assert "fewer than 10 poses a second; images of 320x240 from now on" in said[1]
    after = steps._odometry
    first = after.frames[0]
    assert first.timestamp == found[changes[-1] - 1].frame.timestamp
    assert after.set_poses[0] == pytest.approx(
        found[changes[-1] - 1].step.T_world_cam
    )
    late = found[changes[-1] :]
    assert poses_a_second(late) >= MIN_POSES_HZ
    assert np.percentile([1000 * live.age_s for live in late], 95) < MAX_AGE_MS


def test_the_budget_is_the_cameras_period_unless_one_is_stated() -> None:
    steps, _, _ = play(World(5), False)
    # as it was, after the stream
    assert steps._odometry.options.track.budget_ms is None
    for stated, expected in (("null", 1000 / 30), ("0", 0.0), ("50", 50.0)):
        seen: list[float] = []
        play(World(3), False, f"track.budget_ms={stated}", seen=seen)
        assert seen == pytest.approx([expected] * len(seen)) and seen


def test_few_frames_are_tried_not_lost() -> None:
    steps, found, _ = play(World(RATE_FRAMES - 1))
    assert found == []
    assert steps.counts.tried == RATE_FRAMES - 1
    assert steps.counts.dropped == 0


def test_the_rate_is_read_off_stamps_where_the_camera_states_none() -> None:
    assert rate_of(ScriptedCamera()) is None
    assert rate_of(World(1)) == 30.0
    frames = [frame(0.04 * k) for k in range(4)]
    assert rate_by_stamps(frames) == pytest.approx(25.0)
    assert rate_by_stamps([frame(1.0)] * 3) == 30.0


def test_images_come_in_the_size_that_is_wanted() -> None:
    camera = ScriptedCamera(reading(0.0), reading(0.1))
    steps = stream(camera, Tracker(), patience=QUICK, size=(8, 6))
    camera.stream = steps
    assert {live.frame.camera.shape for live in steps} == {(6, 8)}
    assert steps.summary()["size"] == [8, 6]
    camera = ScriptedCamera(reading(0.0))
    steps = stream(camera, Tracker(), patience=QUICK, size=(32, 24))
    camera.stream = steps
    with pytest.raises(hvo.InputError, match="size 32x24: its images have 16x12"):
        list(steps)


def test_a_real_tracker_loses_no_motion_where_images_become_smaller(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The path in the world goes on over the change of size, as the camera really moved."""
    monkeypatch.setattr(live_rate, "MIN_LIVE_COLUMNS", 80)
    steps_until_slow = iter([False, False, True, False, False, False])

    def fell_behind(keeper: RateKeeper, ms: float) -> bool:
        is_slow = next(steps_until_slow)
        if is_slow:
            keeper._use(keeper._lower.pop(0))
        return is_slow

    monkeypatch.setattr(RateKeeper, "fell_behind", fell_behind)
    scene = make_scene("static", 0, height=120, width=160, frames=RATE_FRAMES + 6)
    frames = [scene.render(k) for k in range(scene.frames)]
    camera = ScriptedCamera(*(Reading(one) for one in frames))
    options = load_options(None, ["track.budget_ms=0", "run.method=classical"])
    camera.stream = steps = LiveStream(
        camera,
        None,
        seconds=None,
        max_frames=None,
        stop=lambda: False,
        say=lambda _: None,
        patience=QUICK,
        clock=lambda: 0.0,
        auto=AutoRate(options, lambda given: hvo.Odometry(None, options=given)),
    )
    found = list(steps)
    assert [live.frame.camera.width for live in found] == [160] * 3 + [80] * 3
    indices = [live.step.index for live in found]
    assert [live.step.prev_index for live in found] == [None, *indices[:-1]]
    assert found[3].start.camera.width == 80
    first = np.linalg.inv(scene.T_world_cam[indices[0]])
    for live in found:
        assert live.step.ok
        T_true = first @ scene.T_world_cam[live.step.index]
        # measured: 0.012 at the end; a missing motion would be 0.05 to 0.07
        np.testing.assert_allclose(live.step.T_world_cam, T_true, atol=0.02)
