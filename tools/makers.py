"""Pairs with known motion, by who made them: the project's generators, and others.

What PWVO is trained on must not be what it is judged on, so each maker states what it may be
used for. ``tripod`` and ``clips`` are recordings below the data folder, see its README.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from benchmark_semi_real import draw

from hybridvo import dis_flow, open_sequence
from hybridvo.flow import with_flow
from hybridvo.geometry import invert
from hybridvo.synthetic.paper_samples import KnownPair
from hybridvo.synthetic.render import Scene
from hybridvo.synthetic.scenes import HEAVY, make_scene
from hybridvo.synthetic.semi_real import load_split
from hybridvo.synthetic.turned_windows import draw_turned_window, load_tripod
from hybridvo.types import Frame, FramePair

Maker = Callable[[Path, int], Iterator[KnownPair]]
"""The pairs of a maker, from the data folder and about how many are wanted."""
SCENE_FRAMES = 20
"""Frames of a rendered scene."""
PAIRS_OF_SCENE = 5
"""Pairs of a rendered scene, evenly distributed."""
MIN_MOVING = 0.15
"""Fraction of a turned window that moves; three of four have at least that."""
CALIBRATION_SEED = 11
TEST_SEED = 12


def clips(data: Path, prefix: str) -> Iterator[KnownPair]:
    """The pairs of the semi-real clips of another generator whose names begin so."""
    folders = sorted((data / "semi_real_clips").glob(f"{prefix}_*"))
    for folder in folders:
        sequence = open_sequence(folder)
        masks = sorted((folder / "dynamic").iterdir())
        for k in range(len(sequence) - 1):
            prev = sequence.frame(k)
            curr = sequence.frame(k + 1)
            T = invert(sequence.poses[k + 1]) @ sequence.poses[k]
            moving = cv2.imread(str(masks[k]), cv2.IMREAD_GRAYSCALE) > 0
            pair = with_flow(FramePair(prev, curr, None), dis_flow())
            depth = np.where(prev.depth > 0, prev.depth, 0).astype(np.float32)
            yield KnownPair(pair, T, depth, moving, folder.name)


def turned_windows(
    data: Path, names: tuple[str, ...], count: int, seed: int
) -> Iterator[KnownPair]:
    """Windows of tripod recordings through a virtual camera that turns."""
    recordings = load_tripod(data / "tripod", names)
    if not recordings:
        return
    rng = np.random.default_rng(seed)
    done = 0
    while done < count:
        drawn = draw_turned_window(rng, recordings, dis_flow())
        if drawn.moving.mean() > MIN_MOVING or done % 4 == 0:
            yield drawn
            done += 1


def scene_pairs(kind: str, seeds: range, flow: str) -> Iterator[KnownPair]:
    """Pairs of rendered scenes of one family, with DIS or with true flow."""
    for seed in seeds:
        scene = make_scene(kind, seed, frames=SCENE_FRAMES)
        step = (SCENE_FRAMES - 1) // PAIRS_OF_SCENE
        for k in range(0, step * PAIRS_OF_SCENE, step):
            yield known_pair(scene, k, k + 1, flow)


def known_pair(scene: Scene, first: int, second: int, flow: str) -> KnownPair:
    """Two frames of a scene; true flow is that of neighbours."""
    prev, curr = (
        Frame(scene.render(k).rgb, scene.depth(k), scene.camera)
        for k in (first, second)
    )
    T = invert(scene.T_world_cam[second]) @ scene.T_world_cam[first]
    true_flow, moving = scene.flow(first)
    pair = FramePair(prev, curr, None)
    if flow == "true":
        pair = replace(pair, flow=true_flow.astype(np.float32), flow_is_true=True)
    else:
        pair = with_flow(pair, dis_flow())
    return KnownPair(pair, T, prev.depth, moving)


def heavy(seeds: range, flow: str) -> Iterator[KnownPair]:
    """Pairs of all heavy families."""
    for kind in HEAVY:
        yield from scene_pairs(kind, seeds, flow)


def semi_real(data: Path, split: str, count: int) -> Iterator[KnownPair]:
    """The project's own semi-real pairs."""
    recordings = load_split(data, split)
    for number in range(count):
        yield draw(split, number, recordings)


CALIBRATION: dict[str, Maker] = {
    "semi-real, development": lambda data, n: semi_real(data, "development", n),
    "clips, box": lambda data, n: clips(data, "box"),
    "tripod, books": lambda data, n: turned_windows(
        data, ("books",), n, CALIBRATION_SEED
    ),
    "heavy": lambda data, n: heavy(range(900, 900 + max(1, n // 20)), "dis"),
    "heavy, true flow": lambda data, n: heavy(
        range(906, 906 + max(1, n // 20)), "true"
    ),
    "escalator, true flow": lambda data, n: scene_pairs(
        "escalator", range(900, 900 + max(1, n // 5)), "true"
    ),
}
"""Makers on whose pairs probabilities are fitted."""
TEST: dict[str, Maker] = {
    "semi-real": lambda data, n: semi_real(data, "test", n),
    "clips, kitchen": lambda data, n: clips(data, "kitchen"),
    "tripod, turned": lambda data, n: turned_windows(
        data, ("fruit", "lab_close"), n, TEST_SEED
    ),
    "heavy": lambda data, n: heavy(range(9300, 9300 + max(1, n // 20)), "dis"),
    "heavy, true flow": lambda data, n: heavy(
        range(9320, 9320 + max(1, n // 20)), "true"
    ),
    "escalator": lambda data, n: scene_pairs(
        "escalator", range(9300, 9300 + max(1, n // 5)), "dis"
    ),
    "escalator, true flow": lambda data, n: scene_pairs(
        "escalator", range(9320, 9320 + max(1, n // 5)), "true"
    ),
}
"""Makers on whose pairs methods are judged."""
