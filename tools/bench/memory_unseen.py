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

from bench.memory import MODES, Judged, counted, judged
from hybridvo import Frame
from hybridvo.core.geometry import invert
from hybridvo.lab.synthetic.scenes import Scene, make_scene
from hybridvo.lab.synthetic.semi_real import draw_clip, load_split
from hybridvo.lab.synthetic.slow_scenes import (
    noisy_image,
    slow_scene,
    structured_light,
)

SIZE = (240, 320)
"""Rows and columns of the rendered images."""
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
    is_slow: bool  # at the rate of a video; else in steps of some centimetres
    first_seed: int

    @property
    def name(self) -> str:
        """As in the table."""
        return f"{self.family}, {'slow' if self.is_slow else 'fast'}"

    def scene(self, seed: int) -> Scene:
        """One of them."""
        if self.is_slow:
            return slow_scene(self.family, seed, SCENE_FRAMES, SIZE)
        height, width = SIZE
        return make_scene(
            self.family, seed, height=height, width=width, frames=SCENE_FRAMES
        )


RENDERED = (
    Rendered("escalator", False, 770_001),
    Rendered("escalator", True, 770_101),
    Rendered("heavy_rigid", True, 770_201),
    Rendered("heavy_deforming", True, 770_301),
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
        result["rows"] += rows(family.name, map(partial(rendered, family), seeds))
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
    scene = family.scene(seed)
    rng = np.random.default_rng(seed)
    frames = []
    for index in range(scene.frames):
        exact = scene.render(index)
        rgb = noisy_image(exact.rgb, rng)
        depth = structured_light(scene.depth(index), rng)
        frames.append(Frame(rgb, depth, exact.camera, exact.timestamp, index))
    return Recorded(
        frames, scene.T_world_cam, lambda start, _: scene.object_id(start) > 0
    )


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
