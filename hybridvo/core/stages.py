"""What the time of a frame went to, stage by stage.

The code of a stage says so, by :class:`stage`; whoever wants the times opens :func:`stage_times`
around it. Where nobody does, a stage costs a look at one variable.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar, get_args

import numpy as np

Stage = Literal[
    "reading",
    "images alone",
    "flow",
    "search",
    "look",
    "solve",
    "judge",
    "memory",
    "objects",
    "other",
]
"""The stages of a frame: reading it; the motion by images and depth alone; optical flow; the search
of motions, sparse matches included; PWVO's look at them; the fit of the one selected; whether it
is right; what is remembered; what moves by itself; the rest of what the tracker does."""
STAGES: tuple[str, ...] = get_args(Stage)
"""Their names, in the order in which a frame meets them."""
LATE_PERCENTILE = 95
"""Percentile of the times that is stated beside the median."""

P = ParamSpec("P")
R = TypeVar("R")


class _Open(NamedTuple):
    """A stage that has begun."""

    name: str
    resumed: float  # when it began, or when a stage inside it ended


class StageTimes:
    """Milliseconds of each stage; those of a stage inside another one count for it alone.

    Attributes:
        ms: by the name of the stage.
    """

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}
        self._open: list[_Open] = []

    def rounded(self) -> dict[str, float]:
        """The milliseconds to a thousandth, JSON-ready."""
        return {name: round(ms, 3) for name, ms in self.ms.items()}

    def begin(self, name: str) -> None:
        """A stage begins; the one around it pauses."""
        now = time.perf_counter()
        self._count(now)
        self._open.append(_Open(name, now))

    def end(self) -> None:
        """The stage that began last ends; the one around it goes on."""
        now = time.perf_counter()
        self._count(now)
        self._open.pop()
        if self._open:
            self._open[-1] = self._open[-1]._replace(resumed=now)

    def _count(self, now: float) -> None:
        """Count the time of the innermost stage."""
        if not self._open:
            return
        name, resumed = self._open[-1]
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (now - resumed)


_times: ContextVar[StageTimes | None] = ContextVar("stage times", default=None)


@contextmanager
def stage_times() -> Iterator[StageTimes]:
    """Measure the stages of what happens inside, in this thread.

    Example:
        >>> with stage_times() as times:
        ...     with stage("flow"):
        ...         pass
        >>> list(times.ms)
        ['flow']
    """
    times = StageTimes()
    token = _times.set(times)
    try:
        yield times
    finally:
        _times.reset(token)


class stage:
    """A stage of the work on a frame: a context, or a decorator of a function.

    A generator must not hold one open where it yields.

    Args:
        name: of the stage.
    """

    def __init__(self, name: Stage) -> None:
        self._name = name

    def __enter__(self) -> None:
        self._times = _times.get()
        if self._times is not None:
            self._times.begin(self._name)

    def __exit__(self, *_: object) -> None:
        if self._times is not None:
            self._times.end()

    def __call__(self, function: Callable[P, R]) -> Callable[P, R]:
        """The function, whose time counts for the stage."""
        name: Any = self._name

        @functools.wraps(function)
        def timed(*args: P.args, **more: P.kwargs) -> R:
            with stage(name):
                return function(*args, **more)

        return timed


def stage_summary(frames: Iterable[Mapping[str, float]]) -> dict[str, Any]:
    """Median and 95th percentile of each stage over all frames.

    A frame that did without a stage counts as 0 ms there.

    Args:
        frames: milliseconds by stage, of each frame.

    Returns:
        ``median_ms``, ``p95_ms``, ``mean_ms`` and ``frames``, in how many it took place, for each
        stage that took place in any; JSON-ready.

    Example:
        >>> stage_summary([{"flow": 20.0}, {"flow": 10.0}])["flow"]["median_ms"]
        15.0
    """
    rows = list(frames)
    summary = {}
    for name in STAGES:
        spent = [row[name] for row in rows if name in row]
        if not spent:
            continue
        ms = np.array(spent + [0.0] * (len(rows) - len(spent)))
        summary[name] = {
            "median_ms": _short(np.median(ms)),
            "p95_ms": _short(np.percentile(ms, LATE_PERCENTILE)),
            "mean_ms": _short(np.mean(ms)),
            "frames": len(spent),
        }
    return summary


def _short(ms: Any) -> float:
    """Milliseconds to a thousandth."""
    return round(float(ms), 3)
