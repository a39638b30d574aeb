"""Prints which files of the package one estimate walks through, and how often it goes back.

    python tools/trace_calls.py [--method hybrid]

Each function counts once, where it is called first. Kernels that numba compiles are not traced.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

from measuring import parser_of

import hybridvo
from hybridvo.synthetic.scenes import make_scene

PACKAGE = Path(hybridvo.__file__).parent


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--method", default="hybrid", metavar="NAME")
    args = parser.parse_args(argv)
    pair = moving_pair()
    hybridvo.estimate(pair, method=args.method)  # imports and compiles
    walk = trace(lambda: hybridvo.estimate(pair, method=args.method))
    for place in walk:
        print(place)
    files = [place.split(":")[0] for place in walk]
    stays = [file for k, file in enumerate(files) if k == 0 or file != files[k - 1]]
    back = len(stays) - len(set(stays))
    print(f"{len(set(stays))} files, {back} returns to a file already left")
    return 0


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


def trace(call: Any) -> list[str]:
    """``file:function`` of the package, in the order of their first calls."""
    places: dict[str, None] = {}

    def note(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(PACKAGE):
            place = path.relative_to(PACKAGE).as_posix()
            places.setdefault(f"{place}:{frame.f_code.co_qualname}")

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return list(places)


if __name__ == "__main__":
    sys.exit(main())
