"""How far a tracked frame walks through the package.

    python tools/walk.py             # three frames, a line each
    python tools/walk.py --list      # and the functions, in the order of their first calls

A room is a folder of the package, or a file beside the folders. ``returns`` counts how often the
walk comes back to a room, or a file, that it had left, each function taken where it is called
first: merging files cannot lower the returns between rooms. ``without core``: the same between
the rooms that do something, and do not only say what a pose or a status is. ``types`` are the
record types (named tuples and dataclasses) that are made for the frame, ``records`` how many. The
frames: one in which nothing moves, one with movers that images and memory answer, one with movers
that needs flow and the network. Kernels that numba compiles are not seen.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from measuring import parser_of

import hybridvo
from hybridvo import Frame, Odometry
from hybridvo.tracking.tracker_state import TrackerState
from hybridvo_lab.synthetic.scenes import make_scene

PACKAGE = Path(hybridvo.__file__).parent
FAMILIES = ("static", "heavy_two", "heavy_rigid")
"""Of rendered scenes."""
FRAMES = 5
VOCABULARY = ("core", "compiled")
"""Rooms of what every other one is written in: a walk may be counted without them."""


class Found(NamedTuple):
    """A frame that shows one kind of walk."""

    kind: str
    tracker: Odometry
    state: TrackerState  # before the frame
    frame: Frame


def main(argv: list[str] | None = None) -> int:
    """Print the walks."""
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--list", action="store_true", help="name the functions")
    args = parser.parse_args(argv)
    made: Counter[str] = Counter()
    for found in frames_of_each_kind():
        calls = calls_of(track_again(found))
        walk = list(dict.fromkeys(calls))
        count_records(made)
        again = track_again(found)
        made.clear()
        again()
        print(line(found.kind, walk, len(calls), made))
        if args.list:
            print("\n".join(walk))
    return 0


def frames_of_each_kind() -> Iterator[Found]:
    """The first frame of each kind, whose tracker has a motion model and a keyframe."""
    shown = set()
    for family in FAMILIES:
        scene = make_scene(family, 6, height=180, width=240, frames=12)
        frames = [scene.render(index) for index in range(FRAMES)]
        tracker = Odometry()
        tracker.track(frames[0])
        for index in range(1, FRAMES):
            state = tracker.state
            step = tracker.track(replace(frames[index]))
            after = tracker.state
            kind = "nothing moves"
            if family != "static":
                needs_flow = "flow" in step.motion.terms
                kind = "movers, flow" if needs_flow else "movers, images"
            # the second motion is the first one with an expected velocity
            is_early = family == "static" and index < 3
            if kind not in shown and not is_early:
                shown.add(kind)
                tracker.resume(state)
                yield Found(kind, tracker, state, frames[index])
            tracker.resume(after)


def track_again(found: Found) -> Callable[[], None]:
    """Return what tracks the frame, after the tracker was set back to before it."""
    found.tracker.resume(found.state)
    # a copy: what is kept with a frame must be worked out again
    frame = replace(found.frame)

    def work() -> None:
        found.tracker.track(frame)

    return work


def calls_of(work: Callable[[], None]) -> list[str]:
    """``file:function`` of each call in the package."""
    calls = []

    def note(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(PACKAGE):
            place = path.relative_to(PACKAGE).as_posix()
            calls.append(f"{place}:{frame.f_code.co_qualname}")

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return calls


def line(kind: str, walk: list[str], calls: int, made: Counter[str]) -> str:
    """What is counted of a walk."""
    files = [place.split(":")[0] for place in walk]
    rooms = [file.split("/")[0] for file in files]
    others = [room for room in rooms if room not in VOCABULARY]
    return (
        f"{kind:14s} rooms {len(set(rooms)):2d}, returns {returns(rooms):3d}, "
        f"{returns(others):2d} without core | "
        f"files {len(set(files)):2d}, returns {returns(files):3d} | "
        f"functions {len(walk)}, calls {calls} | "
        f"types {len(made)}, records {sum(made.values())}"
    )


def returns(stays: list[str]) -> int:
    """How often a place is entered again.

    >>> returns(["solver", "solver", "judge", "solver"])
    1
    """
    entered = [
        place
        for index, place in enumerate(stays)
        if index == 0 or place != stays[index - 1]
    ]
    return len(entered) - len(set(entered))


def count_records(made: Counter[str]) -> None:
    """Let every record type of the package count its instances from now on."""
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] != "hybridvo":
            continue
        for kind in list(vars(module).values()):
            is_ours = isinstance(kind, type) and kind.__module__ == name
            if is_ours and "_counted" not in vars(kind):
                count_instances(kind, made)


def count_instances(kind: Any, made: Counter[str]) -> None:
    """Let a type count its instances, if it is a named tuple or a dataclass."""
    method = "__new__" if hasattr(kind, "_fields") else "__init__"
    if method == "__init__" and not is_dataclass(kind):
        return
    original = getattr(kind, method)
    name = f"{kind.__module__}.{kind.__qualname__}"

    def counting(*args: Any, **kwargs: Any) -> Any:
        made[name] += 1
        return original(*args, **kwargs)

    setattr(kind, method, counting)
    kind._counted = True


if __name__ == "__main__":
    sys.exit(main())
