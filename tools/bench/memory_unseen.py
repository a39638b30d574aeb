"""What a tracker's memory is worth on scenes at which nobody looked while its numbers were chosen.

    python tools/benchmark.py memory_unseen --out docs/results/memory_unseen.json

Rendered scenes of seeds that nothing else uses, with the noise of structured light, and clips of
things that move before recordings of the test split. A step is judged as those of
``benchmark.py memory``. Each with the memory and without.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import parser_of, provenance, store

from bench import objects
from bench.memory import MODES, Judged, counted, judged
from hybridvo import Frame
from hybridvo.core.geometry import invert
from hybridvo_lab.synthetic.semi_real import draw_clip, load_split

SCENE_FRAMES = 12
CLIP_FRAMES = 10
CLIP_SEED = 777
"""Beside the number of a clip."""
ROLLING = 0.3
OF_KIND = 0.7
"""Fractions of the clips with a rolling shutter, and with a thing of a named kind."""
CAMERA_HZ = 30.0


class Rendered(NamedTuple):
    """Rendered scenes of one family."""

    family: str
    rate: str  # "slow": that of a video; "fast": steps of some centimetres
    first_seed: int


RENDERED = (
    Rendered("escalator", "fast", 770_001),
    Rendered("escalator", "slow", 770_101),
    Rendered("heavy_rigid", "slow", 770_201),
    Rendered("heavy_deforming", "slow", 770_301),
)


class Recorded(NamedTuple):
    """Frames of a camera, with the truth."""

    frames: list[Frame]
    poses: np.ndarray  # (N, 4, 4)
    # which pixels of a frame move until another one; None where that is not known
    moving_in: Callable[[int, int], np.ndarray | None]

    def judged(self, mode: str) -> Iterator[Judged]:
        """The steps of a tracker, by the mode of its memory."""
        return judged(self.frames, self.poses, self.moving_in, mode)


def build_parser() -> argparse.ArgumentParser:
    """The arguments."""
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--scenes", type=int, default=4, help="rendered scenes of each family")
    add("--clips", type=int, default=16)
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    """Measure and write."""
    args = build_parser().parse_args(argv)
    result = provenance("benchmark.py memory_unseen", argv)
    result["rows"] = []
    for family in RENDERED:
        seeds = range(family.first_seed, family.first_seed + args.scenes)
        result["rows"] += rows(
            f"{family.family}, {family.rate}", map(partial(rendered, family), seeds)
        )
    if args.clips:
        recordings = load_split(args.data, "test")
        some = (clip(recordings, number) for number in range(1, args.clips + 1))
        result["rows"] += rows("clips of the test split", some)
    store(args.out, result)
    return 0


def rows(name: str, recorded: Iterator[Recorded]) -> Iterator[dict[str, Any]]:
    """A row for each mode, over some recordings."""
    steps: dict[str, list[Judged]] = {mode: [] for mode in MODES}
    for each in recorded:
        for mode in MODES:
            steps[mode] += each.judged(mode)
    for mode in MODES:
        row = {"recording": name, "memory": mode, **counted(steps[mode])}
        print(row, flush=True)
        yield row


def rendered(family: Rendered, seed: int) -> Recorded:
    """A rendered scene as a sensor gives it."""
    seen = list(objects.rendered(family.family, family.rate, seed, SCENE_FRAMES))
    poses = [np.eye(4)]
    for each in seen[1:]:
        poses.append(poses[-1] @ invert(each.T_curr_prev))

    def moving_in(start: int, _: int) -> np.ndarray:
        masks = [known.mask for known in seen[start].known.values()]
        return np.logical_or.reduce([np.zeros(objects.SIZE, bool), *masks])

    return Recorded([each.frame for each in seen], np.array(poses), moving_in)


def clip(recordings: Any, number: int) -> Recorded:
    """Things that move before a recording of the test split."""
    rng = np.random.default_rng([CLIP_SEED, number])
    steps = draw_clip(
        rng,
        recordings,
        objects=None,
        frames=CLIP_FRAMES,
        rolling=ROLLING,
        of_kind=OF_KIND,
    )
    views = [steps[0].pair.prev] + [step.pair.curr for step in steps]
    frames = [
        replace(view, index=index, timestamp=index / CAMERA_HZ)
        for index, view in enumerate(views)
    ]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ invert(step.T_curr_prev))

    def moving_in(start: int, index: int) -> np.ndarray | None:
        return steps[start].moving if index == start + 1 else None

    return Recorded(frames, np.array(poses), moving_in)
