"""Frames as they come: a camera in, steps out, each with the age of its pose.

A thread takes frames from the camera and keeps the newest one; nothing queues up. The frame is
tracked in the thread that takes steps, and what comes meanwhile is dropped and counted. A
camera that is lost is opened again.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.gravity import Gravity
from hybridvo.core.imu import MAX_CLOCK_JUMP_S, ImuSamples, with_earlier
from hybridvo.core.options import Options
from hybridvo.core.results import Step
from hybridvo.core.stages import stage_summary, stage_times
from hybridvo.core.types import Frame
from hybridvo.io.cameras.base import (
    CameraLost,
    EndOfFrames,
    LiveCamera,
    Reading,
    rate_of,
)
from hybridvo.io.data.resize import resize_frame
from hybridvo.io.live_rate import MIN_POSES_HZ, AutoRate, RateKeeper
from hybridvo.io.viewer.scene import Seen
from hybridvo.io.viewer.viewer import Viewer
from hybridvo.odometry import Odometry
from hybridvo.tracking.keyframes import has_enough_depth
from hybridvo.tracking.tracker_state import TrackerState

# s, from which a frame is dropped: sensors hand one out after 0.02 to 0.1 s, above
# half a second something has held it up
MAX_FRAME_AGE_S = 0.5
# frames in a row that are dropped for their age; then the camera itself is slow, or
# its clock is wrong
MAX_OLD_FRAMES = 10
# frames in a row whose stamps do not rise, from which on the camera has no clock:
# drivers hand a frame out two or three times
MAX_STANDING_STAMPS = 5
# s, until a request to stop is looked for: for a person, at once
LIVE_WAIT_S = 0.1
# s without a frame after which a camera is opened again: RealSense and OAK need up
# to two seconds for their first frame
MAX_SILENCE_S = 3.0
# s until a lost camera is opened again; doubled with every attempt that fails
FIRST_RETRY_S = 1.0
# s between two such attempts: a plug that is put back in is noticed soon enough
MAX_RETRY_S = 8.0
# s without a frame after which a run ends: long enough to plug a camera in again
MAX_ABSENCE_S = 60.0
# s that a camera has to stop; one that hangs is left alone
MAX_CLOSING_S = 5.0
# steps over which the figures on the screen are counted: one second
RATE_STEPS = 30
# steps over which the times of the stages are stated: half a minute
STAGE_STEPS = 1000
# share of dropped frames up to which nothing needs to be done about them
MAX_DROPPED = 0.05

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Patience:
    """How long a stream waits for what, seconds.

    Attributes:
        max_age_s: frames that are older are dropped.
        silence_s: without a frame for so long, the camera is opened again.
        first_retry_s: time until a lost camera is opened again; it doubles with every failure.
        max_retry_s: the longest such time.
        absence_s: without a frame for so long, the stream ends.
        closing_s: time that the camera has to stop.

    Example:
        >>> Patience(absence_s=float("inf")).max_age_s
        0.5
    """

    max_age_s: float = MAX_FRAME_AGE_S
    silence_s: float = MAX_SILENCE_S
    first_retry_s: float = FIRST_RETRY_S
    max_retry_s: float = MAX_RETRY_S
    absence_s: float = MAX_ABSENCE_S
    closing_s: float = MAX_CLOSING_S


@dataclass
class LiveCounts:
    """What has happened to the frames of a stream.

    Attributes:
        tracked: frames that became a step.
        tried: frames at the start that only showed how fast this machine is, with those that came
            meanwhile.
        degraded: steps among them whose motion is degraded.
        failed: steps whose motion failed.
        replaced: frames that a newer one replaced while another was tracked.
        missed: frames that never came, by gaps in the camera's own count.
        old: frames that were too old when their turn came.
        repeated: frames with the stamp of the one before, or an earlier one.
        unusable: frames that could not be read, or had no image.
        without_depth: frames with hardly any depth.
        lost: times that the camera was lost.
        clock_jumps: times that the camera's clock jumped.
    """

    tracked: int = 0
    tried: int = 0
    degraded: int = 0
    failed: int = 0
    replaced: int = 0
    missed: int = 0
    old: int = 0
    repeated: int = 0
    unusable: int = 0
    without_depth: int = 0
    lost: int = 0
    clock_jumps: int = 0

    @property
    def dropped(self) -> int:
        """Frames that were not tracked for lack of time."""
        return self.replaced + self.missed + self.old


class LiveStep(NamedTuple):
    """A step, as it comes from a camera.

    Attributes:
        step: what the tracker returned.
        frame: the frame, with the stamp that the step has.
        age_s: age of the pose, seconds: from the exposure of the frame until the pose was there.
            Where the camera's clock is unknown, from the arrival of the frame.
        frames_per_second: steps a second lately.
        dropped: frames dropped so far.
        start: the frame from which the motion starts; None of the first step.
    """

    step: Step
    frame: Frame
    age_s: float
    frames_per_second: float
    dropped: int
    start: Frame | None = None

    def seen(self, flow: np.ndarray | None = None) -> Seen:
        """Return what a viewer shows of it, with a flow (H, W, 2), pixels, if there is one."""
        return Seen(self.frame, self.step, self.start, flow, self.frames_per_second)


def stream(
    camera: LiveCamera,
    odometry: Odometry | None = None,
    *,
    seconds: float | None = None,
    max_frames: int | None = None,
    stop: Callable[[], bool] | None = None,
    say: Callable[[str], None] | None = None,
    patience: Patience | None = None,
    view: str | Viewer | None = None,
    size: tuple[int, int] | None = None,
    rate: Literal["camera", "auto"] | AutoRate = "camera",
) -> LiveStream:
    """Track the frames of a camera as they come.

    Args:
        camera: one of :mod:`hybridvo.io.cameras`, or one's own. The samples of its IMU, if it
            hands some out, go to the tracker.
        odometry: the tracker; by default a new one. Call ``warm_up()`` before, or the first
            frames are dropped while it compiles. Where its options state no ``track.budget_ms``,
            that is the period of the camera, if it states its frames a second as ``fps``.
        seconds: how long to track, from the first frame on.
        max_frames: how many frames to track.
        stop: is called ten times a second; True ends the run.
        say: gets a sentence whenever something happens: the camera is lost or back, frames have
            no depth, the clock jumps. By default these go to the logger ``hybridvo.io.live``.
        patience: how long to wait for what.
        view: ``spawn`` opens a viewer that shows every step as it comes, ``connect:HOST:PORT``
            takes one that runs already, ``serve`` makes a page for a browser, which is there as
            long as the program runs (extra ``viz``). A viewer never slows or ends the stream.
        size: columns and rows to which images and depth are made smaller; None: as they are.
        rate: ``camera``: the tracker is as it is given, and what it cannot keep up with is dropped;
            ``auto``: the first frames show how fast this machine is, and size, flow and budget are
            chosen so that the camera's rate is held, or at least ten poses a second. It makes its
            trackers itself, of options that an :class:`~hybridvo.io.live_rate.AutoRate` states.

    Returns:
        The stream. Iterate over it once; leaving the loop closes the camera.

    Raises:
        InputError: ``view`` names no place of a viewer, ``size`` is of no use, or ``rate`` is
            to choose the tracker and one is given; while iterating, where the camera cannot be
            used at all.

    Example:
        >>> from hybridvo.io.cameras.realsense import RealSenseCamera
        >>> for live in stream(RealSenseCamera()):  # doctest: +SKIP
        ...     print(live.step.status, live.step.T_world_cam[:3, 3], live.age_s)
    """
    say = say or _logger.warning
    if isinstance(view, str):
        view = Viewer(view, camera.name, say=say)
    auto = _checked_rate(rate, odometry)
    _check_size(size)
    return LiveStream(
        camera,
        odometry or (None if auto else Odometry()),
        seconds=seconds,
        max_frames=max_frames,
        stop=stop or _never,
        say=say,
        patience=patience or Patience(),
        viewer=view,
        size=size,
        auto=auto,
    )


def _checked_rate(rate: Any, odometry: Any) -> AutoRate | None:
    """What chooses size, flow and budget; None: nothing does."""
    if rate == "camera":
        return None
    auto = AutoRate() if rate == "auto" else rate
    if not isinstance(auto, AutoRate):
        raise InputError(
            f"stream: rate: expected 'camera', 'auto' or an AutoRate, got {rate!r}."
        )
    if odometry is not None:
        raise InputError(
            "stream: rate='auto' makes its own tracker, and one is given: leave it out, and state "
            "its options by AutoRate(options)."
        )
    return auto


def _check_size(size: tuple[int, int] | None) -> None:
    """Refuse a size that no image has."""
    if size is not None and (len(size) != 2 or min(size) < 1):
        raise InputError(
            f"stream: size: expected columns and rows, as (320, 240), got {size!r}."
        )


def _never() -> bool:
    return False


class LiveStream:
    """What :func:`stream` returns: an iterator over steps that counts what it drops.

    Attributes:
        counts: what has happened to the frames so far.
        ended: why it ended; empty before.
    """

    def __init__(
        self,
        camera: LiveCamera,
        odometry: Any,
        *,
        seconds: float | None,
        max_frames: int | None,
        stop: Callable[[], bool],
        say: Callable[[str], None],
        patience: Patience,
        viewer: Viewer | None = None,
        clock: Callable[[], float] = time.monotonic,
        size: tuple[int, int] | None = None,
        auto: AutoRate | None = None,
    ) -> None:
        self.counts = LiveCounts()
        self.ended = ""
        self._camera = camera
        self._odometry = odometry
        self._rate_hz = rate_of(camera)
        self._size = size
        self._keeper: RateKeeper | None = None
        if auto is not None:
            self._keeper = RateKeeper(auto, self._rate_hz, clock)
        self._seconds = seconds
        self._max_frames = max_frames
        self._stop = stop
        self._say = say
        self._patience = patience
        self._viewer = viewer
        self._clock = clock
        self._reader = _Reader(camera, self.counts, patience, clock)
        self._stamps = _OneClock()
        self._ages: list[float] = []
        self._stages: deque[dict[str, float]] = deque(maxlen=STAGE_STEPS)
        self._track_ms: deque[float] = deque(maxlen=STAGE_STEPS)
        self._last_size = (0, 0)
        self._outcomes: Counter[tuple[str, str]] = Counter()
        self._done: deque[float] = deque(maxlen=RATE_STEPS)
        self._first_done: float | None = None
        self._last_frame = 0.0
        self._old_in_a_row = 0
        self._blind = 0
        self._imu: ImuSamples | None = None  # by the camera's clock
        self._gravity: Gravity | None = None

    def __iter__(self) -> Iterator[LiveStep]:
        self._last_frame = self._clock()
        self._reader.start()
        given = self._set_budget()
        try:
            while not self._is_over():
                arrival = self._reader.take(LIVE_WAIT_S)
                for note in self._reader.notes():
                    self._say(note)
                if arrival is None:
                    continue
                live = self._follow(arrival)
                if live is not None:
                    if self._viewer is not None:
                        self._viewer.add(live.seen())
                    yield live
                # what tracking takes is no absence of the camera
                self._last_frame = self._clock()
        finally:
            self.close()
            if given is not None:
                self._odometry.options = given

    def _set_budget(self) -> Options | None:
        """Give a tracker whose options state no budget the camera's period, where it is known.

        Returns:
            The options that it had; None where it keeps them.
        """
        options = getattr(self._odometry, "options", None)
        if not isinstance(options, Options) or self._rate_hz is None:
            return None
        if options.track.budget_ms is not None:
            return None
        track = replace(options.track, budget_ms=1e3 / self._rate_hz)
        self._odometry.options = replace(options, track=track)
        return options

    @property
    def is_gone(self) -> bool:
        """Whether the camera, or the files of a recording, were gone at the end."""
        return self._reader.is_gone or self.ended.startswith("no frames")

    def close(self) -> None:
        """Stop the camera; a camera that hangs is left to itself, with a sentence about it."""
        if not self._reader.stop(self._patience.closing_s):
            self._say(f"{self._camera.name}: does not stop; left to itself")
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def age_ms(self, percentile: float, steps: int | None = None) -> float | None:
        """Return a percentile of the ages of the poses.

        Args:
            percentile: from 0 to 100; 50 is the median.
            steps: of how many steps, counted from the last one; by default all.

        Returns:
            Milliseconds; None before the first step.
        """
        ages = self._ages[-steps:] if steps else self._ages
        if not ages:
            return None
        return float(1000 * np.percentile(ages, percentile))

    def summary(self) -> dict[str, Any]:
        """Return the counts, the rate and the ages so far, JSON-ready."""
        rate = None
        if self._first_done is not None and self.counts.tracked > 1:
            passed = self._done[-1] - self._first_done
            rate = (self.counts.tracked - 1) / passed if passed > 0 else None
        options = getattr(self._odometry, "options", None)
        budget_ms = (
            options.track.budget_ms if isinstance(options, Options) else None
        )
        gravity = {}
        if self._gravity is not None:
            gravity["gravity"] = self._gravity.summary()
        readout = {}
        found_ms = getattr(self._odometry, "readout_ms", 0.0)
        if found_ms:
            readout["readout_ms"] = found_ms
            readout["readout_std_ms"] = self._odometry.readout.std
        return {
            "camera": self._camera.name,
            "camera_frames_per_second": self._rate_hz,
            "method": getattr(self._odometry, "method", ""),
            "size": list(self._last_size),
            "budget_ms": budget_ms,
            "chosen": "" if self._keeper is None else self._keeper.chosen,
            "ended": self.ended,
            **vars(self.counts),
            "dropped": self.counts.dropped,
            "help": self.help(),
            "outcomes": [
                {"state": state, "reason": reason, "steps": count}
                for (state, reason), count in self._outcomes.items()
            ],
            "frames_per_second": rate,
            "age_ms_p50": self.age_ms(50),
            "age_ms_p95": self.age_ms(95),
            "stages": stage_summary(self._stages),
            **gravity,
            **readout,
        }

    def help(self) -> str:
        """Return what would help against dropped frames, in a sentence; empty where few were."""
        counts = self.counts
        share = counts.dropped / max(counts.dropped + counts.tracked, 1)
        if share <= MAX_DROPPED or not self._track_ms:
            return ""
        if counts.missed > counts.replaced + counts.old:
            return (
                "most of the dropped frames never came: USB 3, fewer programs beside, a smaller "
                "image in the camera's preset, or a faster disk of a recording"
            )
        return (
            f"tracking a frame takes {np.median(self._track_ms):.0f} ms, in one of twenty "
            f"{np.percentile(self._track_ms, 95):.0f} or more: {self._remedy()}"
        )

    def _remedy(self) -> str:
        """What the user can do where tracking is too slow."""
        if self._keeper is None:
            return (
                "--rate auto chooses size, flow and budget so that at least "
                f"{MIN_POSES_HZ:.0f} poses a second come"
            )
        if self._keeper.has_lower_level:
            width, height = self._last_size
            return f"more poses, less accurate ones, by --size {width // 2}x{height // 2}"
        return "fewer programs beside; 'hybridvo doctor --speed' shows what the time goes to"

    def _is_over(self) -> bool:
        """Whether no more frames are wanted, or none will come; ``ended`` states why."""
        now = self._clock()
        if self._stop():
            self.ended = "stopped"
        elif self._max_frames and self.counts.tracked >= self._max_frames:
            self.ended = f"{self._max_frames} frames"
        elif self._seconds is not None and self._passed(now) >= self._seconds:
            self.ended = f"{self._seconds:g} s"
        elif self._reader.has_ended():
            if self._reader.error is not None:
                raise self._reader.error
            self.ended = "end of the recording"
            if self._reader.is_gone:
                self.ended += ", whose files are gone"
        elif now - self._last_frame > self._patience.absence_s:
            self.ended = f"no frames for {self._patience.absence_s:g} s"
        return bool(self.ended)

    def _passed(self, now: float) -> float:
        """Seconds since the first step."""
        return 0.0 if self._first_done is None else now - self._first_done

    def _follow(self, arrival: _Arrival) -> LiveStep | None:
        """Track a frame; None where it is dropped."""
        # also of frames that are dropped: the next motion spans them
        self._imu = with_earlier(self._imu, arrival.imu)
        age = arrival.age_s + self._clock() - arrival.time
        if self._is_too_old(age):
            return None
        frame = self._on_one_clock(arrival)
        if frame is None:
            return None
        if not self._has_depth(frame) and self._first_done is None:
            # a camera that has just been switched on; nothing can start from such a frame
            return None
        if frame.index is None:
            frame = replace(frame, index=self.counts.tracked)
        whole = self._in_size(frame)
        if self._odometry is None:
            self._choose_by(whole)
            return None
        frame = whole if self._keeper is None else self._keeper.level.frame(whole)
        self._start_again_where_needed(frame)
        starts = self._odometry.state.starts
        began = self._clock()
        imu = self._samples(frame.timestamp - arrival.frame.timestamp)
        with stage_times() as times:
            if imu is None:
                step = self._odometry.track(frame)
            else:
                step = self._odometry.track(frame, imu=imu)
        start = None if step.prev_index is None else starts.get(step.prev_index)
        now = self._clock()
        age = arrival.age_s + now - arrival.time
        self._last_size = (frame.camera.width, frame.camera.height)
        self._stages.append(times.ms)
        self._count(step, age, now)
        self._guard(whole, 1e3 * (now - began))
        passed = self._done[-1] - self._done[0]
        rate = (len(self._done) - 1) / passed if passed > 0 else 0.0
        return LiveStep(step, frame, age, rate, self.counts.dropped, start)

    def _samples(self, clock_offset_s: float) -> ImuSamples | None:
        """What the camera's IMU measured since the last tracked frame, by the tracker's clock."""
        samples = self._imu
        self._imu = None
        if samples is None or clock_offset_s == 0:
            return samples
        return samples.shifted(clock_offset_s)

    def _in_size(self, frame: Frame) -> Frame:
        """A frame in the size that is wanted."""
        if self._size is None:
            return frame
        width, height = self._size
        camera = frame.camera
        if width > camera.width or height > camera.height:
            raise InputError(
                f"{self._camera.name}: size {width}x{height}: its images have "
                f"{camera.width}x{camera.height}; expected that or less."
            )
        return resize_frame(frame, height, width)

    def _choose_by(self, frame: Frame) -> None:
        """Take one of the first frames to choose how the others are tracked."""
        assert self._keeper is not None
        self.counts.tried += 1
        chosen = self._keeper.choose_by(frame)
        if not chosen:
            return
        self._say(chosen)
        self._odometry = self._keeper.tracker
        # nobody could track what came meanwhile
        self.counts.tried += self._reader.forget_dropped()

    def _guard(self, frame: Frame, ms: float) -> None:
        """Go on in smaller images where frames take too long for the least rate.

        The new tracker starts at the last frame and its pose, so that no motion is missing.
        """
        self._track_ms.append(ms)
        if self._keeper is None or not self._keeper.fell_behind(ms):
            return
        state = self._odometry.state
        self._odometry = self._keeper.tracker
        self._start_at(state)
        small = self._keeper.level.frame(frame)
        self._odometry.track(small)
        width, height = small.camera.width, small.camera.height
        self._say(
            f"{self._camera.name}: fewer than {self._keeper.least_hz:.3g} poses a second; images "
            f"of {width}x{height} from now on"
        )

    def _count(self, step: Step, age: float, now: float) -> None:
        """Count a step."""
        if step.prev_index is not None:
            self._outcomes[step.status.state.value, step.status.reason.value] += 1
        self._ages.append(age)
        self._done.append(now)
        if self._first_done is None:
            self._first_done = now
        self._gravity = step.gravity
        self.counts.tracked += 1
        self.counts.failed += not step.usable
        self.counts.degraded += step.usable and not step.ok

    def _is_too_old(self, age: float) -> bool:
        """Whether a frame is dropped for its age."""
        is_old = age > self._patience.max_age_s
        if not is_old:
            self._old_in_a_row = 0
            return False
        self._old_in_a_row += 1
        if self._old_in_a_row > MAX_OLD_FRAMES:
            if self._old_in_a_row == MAX_OLD_FRAMES + 1:
                self._say(
                    f"{self._camera.name}: every frame is old, the last one {age:.1f} s; they "
                    "are tracked all the same"
                )
            return False
        self.counts.old += 1
        return True

    def _on_one_clock(self, arrival: _Arrival) -> Frame | None:
        """The frame with a stamp after that of the one before; None where it has none."""
        frame = arrival.frame
        placed = self._stamps.next(frame.timestamp, arrival)
        if placed.note:
            self._say(f"{self._camera.name}: {placed.note}")
        self.counts.clock_jumps += placed.jumps
        if placed.stamp is None:
            self.counts.repeated += 1
            return None
        return replace(frame, timestamp=placed.stamp)

    def _has_depth(self, frame: Frame) -> bool:
        """Whether a frame has depth; states when this changes."""
        if has_enough_depth(frame):
            if self._blind:
                self._say(
                    f"{self._camera.name}: depth is back after {self._blind} frames"
                )
            self._blind = 0
            return True
        if not self._blind:
            self._say(f"{self._camera.name}: frames without depth")
        self._blind += 1
        self.counts.without_depth += 1
        return False

    def _start_again_where_needed(self, frame: Frame) -> None:
        """Begin anew at the last pose where the images have another size than before."""
        state = self._odometry.state
        if state.frame is None or state.frame.camera.shape == frame.camera.shape:
            return
        self._say(
            f"{self._camera.name}: images of another size; tracking starts anew"
        )
        self._odometry.reset()
        self._start_at(state)

    def _start_at(self, state: TrackerState) -> None:
        """Begin at the last pose of a tracker, with what it knows of the IMU."""
        self._odometry.set_pose(state.T_world_last)
        known = replace(
            self._odometry.state.sensors,
            gyroscope=state.sensors.gyroscope,
            accelerometer=state.sensors.accelerometer,
        )
        self._odometry.state = replace(self._odometry.state, sensors=known)


class _Placed(NamedTuple):
    """A frame's place in time."""

    stamp: float | None  # None: it does not come after the frame before
    jumps: bool = False  # whether the camera's clock jumped
    note: str = ""  # what the user should know


class _OneClock:
    """Stamps that only grow, from a clock that may jump or stand still.

    A clock that stands for some frames is not looked at again: the frames are placed by
    their arrival.
    """

    def __init__(self) -> None:
        self._offset = 0.0
        self._stamp = 0.0  # of the last frame, by the camera's clock
        self._before: _Arrival | None = None
        self._standing = 0  # frames in a row whose stamps did not rise
        self._is_dead = False

    def next(self, stamp: float, arrival: _Arrival) -> _Placed:
        """Place a frame in time.

        Args:
            stamp: of the frame, by the camera's clock, seconds.
            arrival: when it came, by our clock.
        """
        before = self._before
        if before is None:
            return self._placed(stamp, arrival)
        if self._is_dead:
            return self._by_arrival(stamp, arrival, before)
        passed = arrival.exposed - before.exposed
        if passed <= 0:
            # an age that cannot be right
            passed = arrival.time - before.time
        step = stamp - self._stamp
        if step <= 0:
            self._standing += 1
            if self._standing >= MAX_STANDING_STAMPS:
                self._is_dead = True
                note = (
                    f"the stamps of {self._standing} frames in a row do not rise; "
                    "from now on a frame's stamp is when it came"
                )
                return self._by_arrival(stamp, arrival, before)._replace(note=note)
        else:
            self._standing = 0
        jump = step - passed
        if abs(jump) > MAX_CLOCK_JUMP_S:
            self._offset -= jump
            note = f"its clock jumped by {jump:+.3f} s; stamps go on evenly"
            return self._placed(stamp, arrival)._replace(jumps=True, note=note)
        if step <= 0:
            return _Placed(None)
        return self._placed(stamp, arrival)

    def _by_arrival(
        self, stamp: float, arrival: _Arrival, before: _Arrival
    ) -> _Placed:
        """Place a frame as long after the one before as it came."""
        passed = arrival.time - before.time
        if passed <= 0:
            return _Placed(None)
        self._offset += passed - (stamp - self._stamp)
        return self._placed(stamp, arrival)

    def _placed(self, stamp: float, arrival: _Arrival) -> _Placed:
        """Place a frame by the camera's clock and what that is off."""
        self._stamp = stamp
        self._before = arrival
        return _Placed(stamp + self._offset)


# -- the thread that takes frames --------------------------------------------------------


class _Arrival(NamedTuple):
    """A frame that has come."""

    frame: Frame
    age_s: float  # when it came
    time: float  # when it came, by our clock
    imu: ImuSamples | None = None  # since the frame that was taken before

    @property
    def exposed(self) -> float:
        """When it was exposed, by our clock, as far as is known."""
        return self.time - self.age_s


class _Unread:
    """Frames in a row that cannot be used, of which the first one is reported.

    Where such rows come again and again, fewer and fewer of them are: the first, the second, the
    fourth, the eighth.

    Attributes:
        is_gone: whether what the frames come from is no longer there.
    """

    def __init__(self) -> None:
        self.is_gone = False
        self._frames = 0
        self._rows = 0
        self._is_reported = False

    def add(self, reading: Reading) -> str:
        """Count a frame that cannot be used; returns what is reported of it."""
        is_first = not self._frames
        self._frames += 1
        if is_first:
            self._rows += 1
            self._is_reported = self._rows.bit_count() == 1
        is_news = is_first or reading.is_gone > self.is_gone
        self.is_gone = reading.is_gone
        return reading.note if is_news and self._is_reported else ""

    def end(self) -> str:
        """Count a frame that can be used; returns what is reported of those before."""
        count = self._frames
        self._frames = 0
        self.is_gone = False
        if not count or not self._is_reported:
            return ""
        return f"frames again after {count} that could not be used"


class _Reader(threading.Thread):
    """Takes frames from a camera, opens it again where it is lost, and keeps the newest frame.

    Attributes:
        error: what makes the camera unusable; None if nothing does.
    """

    def __init__(
        self,
        camera: LiveCamera,
        counts: LiveCounts,
        patience: Patience,
        clock: Callable[[], float],
    ) -> None:
        # a driver that hangs must not keep the program from ending
        super().__init__(name=f"camera {camera.name}", daemon=True)
        self.error: InputError | None = None
        self._camera = camera
        self._counts = counts
        self._patience = patience
        self._clock = clock
        self._halt = threading.Event()
        self._changed = threading.Condition()
        self._newest: _Arrival | None = None
        self._notes: list[str] = []
        self._is_done = False
        self._has_frames = False
        self._is_lost = False
        self._retry_s = patience.first_retry_s
        self._number: int | None = None
        self._unread = _Unread()

    @property
    def is_gone(self) -> bool:
        """Whether what frames come from was no longer there at the last one."""
        return self._unread.is_gone

    # what the other thread calls

    def take(self, timeout_s: float) -> _Arrival | None:
        """Wait for a frame, and take it; None where none came in time."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._newest or self._notes or self._is_done, timeout_s
            )
            arrival = self._newest
            self._newest = None
            return arrival

    def notes(self) -> list[str]:
        """Take the sentences about what has happened."""
        with self._changed:
            notes = self._notes
            self._notes = []
            return notes

    def forget_dropped(self) -> int:
        """Count no frame as dropped so far; returns how many were."""
        with self._changed:
            dropped = self._counts.replaced + self._counts.missed
            self._counts.replaced = 0
            self._counts.missed = 0
            return dropped

    def has_ended(self) -> bool:
        """Whether there is no frame, and none will come."""
        with self._changed:
            return self._is_done and self._newest is None and not self._notes

    def stop(self, timeout_s: float) -> bool:
        """Request the thread to end; whether it did."""
        self._halt.set()
        if self.ident is not None:
            self.join(timeout_s)
        return not self.is_alive()

    # what the thread does

    def run(self) -> None:
        """Take frames until it is stopped, or until there are none left."""
        while not self._halt.is_set():
            try:
                self._number = None
                self._camera.open()
                self._take_frames()
            except EndOfFrames:
                break
            except Exception as error:
                # an SDK raises what it likes
                if isinstance(error, InputError) and not self._has_frames:
                    self.error = error
                    break
                self._lose(error)
            finally:
                with contextlib.suppress(Exception):
                    self._camera.close()
            self._halt.wait(self._retry_s)
            self._retry_s = min(2 * self._retry_s, self._patience.max_retry_s)
        with self._changed:
            self._is_done = True
            self._changed.notify_all()

    def _take_frames(self) -> None:
        """Take frames until it is stopped; raises where the camera is lost."""
        heard = self._clock()
        while not self._halt.is_set():
            reading = self._camera.read(LIVE_WAIT_S)
            now = self._clock()
            if reading is None:
                if now - heard > self._patience.silence_s:
                    raise CameraLost(
                        f"no frames for {self._patience.silence_s:g} s"
                    )
                continue
            heard = now
            self._find(reading.number)
            if reading.frame is None:
                self._counts.unusable += 1
                self._report(self._unread.add(reading))
                continue
            self._report(self._unread.end())
            self._report(reading.note)
            # a clock that is ahead of ours
            age = max(reading.age_s, 0.0)
            with self._changed:
                imu = reading.imu
                if self._newest is not None:
                    self._counts.replaced += 1
                    imu = with_earlier(self._newest.imu, imu)
                self._newest = _Arrival(reading.frame, age, now, imu)
                self._has_frames = True
                self._changed.notify_all()

    def _find(self, number: int | None) -> None:
        """Note that the camera gives something, and what it has left out."""
        self._retry_s = self._patience.first_retry_s
        if self._is_lost:
            self._is_lost = False
            self._report("frames again")
        if number is not None and self._number is not None:
            gap = number - self._number - 1
            with self._changed:
                self._counts.missed += max(gap, 0)
        self._number = number

    def _lose(self, error: Exception) -> None:
        """State that the camera is lost."""
        if not self._is_lost:
            self._counts.lost += 1
        self._is_lost = True
        reason = " ".join(str(error).split()) or type(error).__name__
        self._report(f"{reason}; next attempt in {self._retry_s:g} s")

    def _report(self, note: str) -> None:
        """Leave a sentence for the other thread; nothing where it is empty."""
        if not note:
            return
        with self._changed:
            self._notes.append(f"{self._camera.name}: {note}")
            self._changed.notify_all()
