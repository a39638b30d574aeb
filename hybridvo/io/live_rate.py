"""Keeping up with a camera: the size of the images, the flow, and the time that a frame may take.

The first frames of the camera are tracked at one level after the other, and the first level that
holds the camera's rate is taken. Where the machine becomes slower later, the next level is.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.options import Options
from hybridvo.core.types import Camera, Frame
from hybridvo.io.calibration import (
    MIN_LIVE_COLUMNS,
    SMALL_FLOW,
)
from hybridvo.io.cameras.settings import LIVE_RATE_HZ
from hybridvo.io.data.resize import resize_frame
from hybridvo.odometry import Odometry
from hybridvo.pipeline import DEFAULT_METHOD

# poses a second that are kept where the camera's rate cannot be: a hand moves by a
# few centimetres meanwhile, which the search still finds
MIN_POSES_HZ = 10.0
# first frames of a camera by which a level is chosen: a sixth of a second
RATE_FRAMES = 5
# steps in a row whose mean time decides whether a level is too slow
GUARDED_STEPS = 15

DIVISORS = (1, 2, 3)
"""By which the size of the images is divided, the most accurate first."""


def default_tracker(options: Options) -> Odometry:
    """A tracker with some options, which has compiled everything."""
    tracker = Odometry(
        options=options, method=options.run.method, seed=options.run.seed
    )
    tracker.warm_up()
    return tracker


@dataclass(frozen=True)
class AutoRate:
    """What ``rate="auto"`` of a stream starts from.

    Attributes:
        options: the options; a ``track.budget_ms`` that they state is kept.
        make: makes a tracker of options, warmed up.

    Example:
        >>> AutoRate().options.run.method
        'hybrid'
    """

    options: Options = field(default_factory=Options)
    make: Callable[[Options], Any] = default_tracker


class Level(NamedTuple):
    """How the frames of a camera are tracked.

    Attributes:
        divisor: of the size of the images.
        flow: preset of DIS; None: that of the options.
    """

    divisor: int
    flow: str | None

    def frame(self, frame: Frame) -> Frame:
        """A frame of the camera in this size."""
        if self.divisor == 1:
            return frame
        size = self.size(frame.camera)
        return resize_frame(frame, size[1], size[0])

    def size(self, camera: Camera) -> tuple[int, int]:
        """Columns and rows of the images of a camera."""
        return camera.width // self.divisor, camera.height // self.divisor

    def options(self, options: Options) -> Options:
        """The options with this level's flow."""
        if self.flow is None:
            return options
        flow = replace(options.flow, dis_preset=self.flow)  # type: ignore[arg-type]
        return replace(options, flow=flow)


class Cost(NamedTuple):
    """What a frame costs at a level, milliseconds.

    Attributes:
        usual_ms: as the camera moves now.
        hard_ms: where images and depth alone do not show the motion, and flow is needed; infinite
            where that was not measured, because a usual frame is too slow already.
    """

    usual_ms: float
    hard_ms: float


class Tried(NamedTuple):
    """A level, and what a frame costs there."""

    level: Level
    cost: Cost


def levels_of(camera: Camera) -> tuple[Level, ...]:
    """The levels of a camera, the most accurate first.

    Example:
        >>> camera = Camera(500, 500, 319, 239, height=480, width=640)
        >>> [level.divisor for level in levels_of(camera)]
        [1, 2, 3]
    """
    divisors = [
        each for each in DIVISORS if camera.width >= each * MIN_LIVE_COLUMNS
    ]
    small = [Level(each, SMALL_FLOW) for each in divisors[1:]]
    # images that are small already keep their size
    return (Level(1, None), *(small or [Level(1, SMALL_FLOW)]))


def longest_ms(period_ms: float) -> float:
    """Longest time of a frame, milliseconds: of ten poses a second, or of a slower camera's rate.

    Example:
        >>> longest_ms(33.0), longest_ms(200.0)
        (100.0, 200.0)
    """
    return max(period_ms, 1e3 / MIN_POSES_HZ)


class RateKeeper:
    """Chooses a level by the first frames of a camera, and the next one where it is too slow.

    Args:
        auto: options, and what makes trackers of them.
        rate_hz: of the camera; None: it is read off the stamps of its first frames.
        clock: seconds, from any start.

    Attributes:
        tracker: the tracker in use; None before the choice.
        level: the level in use.
        budget_ms: the budget of a frame, milliseconds.
        chosen: a sentence about what was chosen, and why; empty before.
    """

    def __init__(
        self,
        auto: AutoRate,
        rate_hz: float | None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.tracker: Any = None
        self.level = Level(1, None)
        self.budget_ms = 0.0
        self.chosen = ""
        self._auto = auto
        self._rate_hz = rate_hz
        self._clock = clock
        self._frames: list[Frame] = []
        self._lower: list[Level] = []
        self._ms: deque[float] = deque(maxlen=GUARDED_STEPS)
        self._longest_ms = np.inf

    def choose_by(self, frame: Frame) -> str:
        """Take one of the camera's first frames; with the last of them a level is chosen.

        Returns:
            What was chosen, and why; empty while more frames are needed.
        """
        self._frames.append(frame)
        if len(self._frames) < RATE_FRAMES:
            return ""
        rate_hz = self._rate_hz or rate_by_stamps(self._frames)
        period_ms = 1e3 / rate_hz
        self._longest_ms = longest_ms(period_ms)
        tried: list[Tried] = []
        levels = levels_of(frame.camera)
        for level in levels:
            tried.append(Tried(level, self._cost(level)))
            if holds(tried[-1].cost, period_ms):
                break
        found = chosen_of(tried, period_ms)
        budget_ms = self._auto.options.track.budget_ms
        if budget_ms is None:
            budget_ms = budget_of(found.cost, period_ms)
        self.budget_ms = budget_ms
        self._use(found.level)
        self._lower = list(levels[levels.index(found.level) + 1 :])
        self.chosen = sentence(tried, found, budget_ms, frame.camera, rate_hz)
        self._frames = []
        return self.chosen

    @property
    def least_hz(self) -> float:
        """Poses a second below which the next level is taken."""
        return 1e3 / self._longest_ms

    @property
    def has_lower_level(self) -> bool:
        """Whether frames could be tracked with less effort."""
        return bool(self._lower)

    def fell_behind(self, ms: float) -> bool:
        """Count the time of a step; whether the next level is in use from now on."""
        self._ms.append(ms)
        if len(self._ms) < GUARDED_STEPS or not self._lower:
            return False
        if np.mean(self._ms) <= self._longest_ms:
            return False
        self._ms.clear()
        self._use(self._lower.pop(0))
        return True

    def _use(self, level: Level) -> None:
        """Track at a level from now on."""
        self.level = level
        self.tracker = self._tracker(level, self.budget_ms)

    def _tracker(self, level: Level, budget_ms: float, direct: str = "") -> Any:
        """A tracker of a level; ``direct``: another mode of images and depth alone."""
        options = level.options(self._auto.options)
        options = replace(
            options, track=replace(options.track, budget_ms=budget_ms)
        )
        if direct:
            mode = replace(options.direct, mode=direct)  # type: ignore[arg-type]
            options = replace(options, direct=mode)
        return self._auto.make(options)

    def _cost(self, level: Level) -> Cost:
        """What a frame costs at a level: the first frames are tracked there."""
        frames = [level.frame(frame) for frame in self._frames]
        # the least that is done in any case: what comes after it is bounded by the budget
        least_ms = 1e-3
        usual = self._times(self._tracker(level, least_ms), frames)
        usual_ms = float(np.median(usual))
        if usual_ms > self._longest_ms:
            return Cost(usual_ms, np.inf)
        if self._auto.options.run.method != DEFAULT_METHOD:
            # others do the same for every frame
            return Cost(usual_ms, usual_ms)
        apart = frames[:: (len(frames) - 1) // 2]
        hard = self._times(self._tracker(level, least_ms, direct="off"), apart)
        # images and depth alone are tried first, in vain
        return Cost(usual_ms, usual_ms + float(np.median(hard)))

    def _times(self, tracker: Any, frames: Sequence[Frame]) -> list[float]:
        """Milliseconds of each motion, until two were too slow."""
        spent = []
        for frame in frames:
            started = self._clock()
            tracker.track(frame)
            spent.append(1e3 * (self._clock() - started))
            if sum(ms > self._longest_ms for ms in spent) > 1:
                break
        # the first frame has no motion
        return spent[1:]


def rate_by_stamps(frames: Sequence[Frame]) -> float:
    """Frames a second by the stamps of neighbours; the usual rate where they do not rise."""
    usual_s = float(np.median(np.diff([frame.timestamp for frame in frames])))
    return 1 / usual_s if usual_s > 0 else float(LIVE_RATE_HZ)


def holds(cost: Cost, period_ms: float) -> bool:
    """Whether the camera's rate is held, and the least one where flow is needed."""
    return cost.usual_ms <= period_ms and cost.hard_ms <= longest_ms(period_ms)


def chosen_of(tried: Sequence[Tried], period_ms: float) -> Tried:
    """The first level that holds the camera's rate, else the least one; else the cheapest."""
    for each in tried:
        if holds(each.cost, period_ms):
            return each
    for each in tried:
        if each.cost.hard_ms <= longest_ms(period_ms):
            return each
    return min(tried, key=lambda each: each.cost[::-1])


def budget_of(cost: Cost, period_ms: float) -> float:
    """The budget of a frame, milliseconds: the camera's period where the level holds its rate.

    Elsewhere it is what the flow, which may begin at the last moment, leaves of the longest time
    that a frame may take.
    """
    if holds(cost, period_ms):
        return period_ms
    flow_ms = cost.hard_ms - cost.usual_ms
    return max(period_ms, longest_ms(period_ms) - flow_ms)


def sentence(
    tried: Sequence[Tried],
    found: Tried,
    budget_ms: float,
    camera: Camera,
    rate_hz: float,
) -> str:
    """State what was chosen, and why, in one line."""
    width, height = found.level.size(camera)
    what = f"images of {width}x{height}"
    if found.level.flow is not None:
        what += f", flow '{found.level.flow}'"
    what += f", budget {budget_ms:.0f} ms"
    costs = "; ".join(_measured(each, camera) for each in tried)
    rate = f"the camera sends {rate_hz:.3g} frames a second"
    period_ms = 1e3 / rate_hz
    least_hz = 1e3 / longest_ms(period_ms)
    end = f"which is {least_hz:.3g} poses a second or more"
    if holds(found.cost, period_ms):
        end = "which is its rate"
    elif found.cost.hard_ms > longest_ms(period_ms):
        end = f"too slow for {least_hz:.3g} poses a second where flow is needed"
    return f"rate auto: {what}: {rate}, and a frame takes {costs}: {end}"


def _measured(tried: Tried, camera: Camera) -> str:
    """What a frame costs at a level."""
    width, height = tried.level.size(camera)
    usual_ms, hard_ms = tried.cost
    is_known = usual_ms < hard_ms < np.inf
    with_flow = f", with flow {hard_ms:.0f}," if is_known else ""
    return f"{usual_ms:.0f} ms{with_flow} at {width}x{height}"
