"""Prints which files of the package one answer walks through, and how often it goes back.

    python tools/trace_calls.py [--method hybrid]
    python tools/trace_calls.py --track heavy_two

The answer is that of `hvo.estimate`, or with `--track` that of a tracker to the third frame of a
rendered scene of a family. Each function counts once, where it is called first; the calls are all
calls. Kernels that numba compiles are not traced.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from measuring import parser_of

import hybridvo
from hybridvo.lab.synthetic.scenes import make_scene

PACKAGE = Path(hybridvo.__file__).parent


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--method", default="hybrid", metavar="NAME")
    parser.add_argument("--track", metavar="FAMILY", help="of a rendered scene")
    args = parser.parse_args(argv)
    call = (
        tracked(args.track, args.method) if args.track else estimated(args.method)
    )
    call()  # imports and compiles
    walk, calls = trace(call)
    for place in walk:
        print(place)
    files = [place.split(":")[0] for place in walk]
    stays = [file for k, file in enumerate(files) if k == 0 or file != files[k - 1]]
    back = len(stays) - len(set(stays))
    print(
        f"{len(set(stays))} files, {back} returns to a file already left, {calls} calls"
    )
    return 0


def estimated(method: str) -> Callable[[], Any]:
    """The motion of a pair in which objects move."""
    pair = moving_pair()
    return lambda: hybridvo.estimate(pair, method=method)


def tracked(family: str, method: str) -> Callable[[], Any]:
    """The third step of a tracker, which has a motion model and a keyframe by then."""
    scene = make_scene(family, 6, height=180, width=240, frames=12)
    frames = [scene.render(index) for index in range(3)]
    tracker = hybridvo.Odometry(method=method)
    tracker.track(frames[0])
    tracker.track(frames[1])
    state = tracker.state

    def third_step() -> None:
        tracker.resume(state)
        # a copy: what is kept with a frame must be worked out again
        tracker.track(replace(frames[2]))

    return third_step


def moving_pair() -> hybridvo.FramePair:
    """Two frames of a rendered scene in which objects move, with DIS flow."""
    scene = make_scene("light", 6, height=240, width=320, frames=12)
    frames = []
    for index in range(2):
        rendered = scene.render(index)
        frames.append(hybridvo.Frame(rendered.rgb, rendered.depth, scene.camera))
    field = hybridvo.dis_flow()(*frames)
    return hybridvo.FramePair(
        *frames, field.flow, field.variance, field.valid, field.source
    )


def trace(call: Callable[[], Any]) -> tuple[list[str], int]:
    """``file:function`` of the package, in the order of their first calls, and all calls."""
    places: dict[str, int] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(PACKAGE):
            place = path.relative_to(PACKAGE).as_posix()
            name = f"{place}:{frame.f_code.co_qualname}"
            places[name] = places.get(name, 0) + 1

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return list(places), sum(places.values())


if __name__ == "__main__":
    sys.exit(main())
