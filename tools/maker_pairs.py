"""Pairs with known motion, by who made them: the project's generators, and others.

What PWVO is trained on must not be what it is judged on, so each maker states what it may be
used for. ``tripod`` and ``clips`` are recordings below the data folder, see its README.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from bench.objects import SIZE, Seen, rendered
from bench.semi_real import draw

from hybridvo import dis_flow, open_sequence
from hybridvo.core.geometry import backproject, invert
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import with_flow
from hybridvo.io.data.sequence import Sequence
from hybridvo_lab.synthetic.blurred_turns import Recorded, draw_blurred_turn
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.scenes import HEAVY, make_scene
from hybridvo_lab.synthetic.semi_real import load_split
from hybridvo_lab.synthetic.turned_windows import (
    TripodRecording,
    draw_turned_window,
    load_tripod,
)
from hybridvo_lab.synthetic.two_recordings import (
    compose,
    draw_two_recordings,
    load_places,
)


class Film(NamedTuple):
    """Frames in their order, and the camera's true pose T_world_cam at each."""

    frames: list[Frame]
    T_world_cam: list[np.ndarray]


Maker = Callable[[Path, int], Iterator[KnownPair]]
"""The pairs of a maker, from the data folder and about how many are wanted."""
TILE_M = 0.8
"""Side of the tiles of a bare wall, metres."""
TILE_OFFSET_M = np.array([0.31, 0.17, 0.23])
"""Where the tiles begin, so that no wall lies in a line."""
LINE_M = 0.01
"""Width of the lines between them, metres."""
WALL_GREY = 225.0
LINE_GREY = 120.0
LENS_BLUR_PX = 0.7
IMAGE_NOISE = 1.5
"""Standard deviation of the noise of a bare wall's image, grey levels."""
SCENE_FRAMES = 20
"""Frames of a rendered scene."""
PAIRS_OF_SCENE = 5
"""Pairs of a rendered scene, evenly distributed."""
MIN_MOVING = 0.15
"""Fraction of a turned window that moves; three of four have at least that."""
VIDEO_FRAMES = 8
"""Frames of a scene at video rate."""
SMALL = (120, 160)
"""Size of the small ones, rows and columns: a thing that moves as slowly is then seen less."""
VIDEO_STRIDES = (1, 3)
"""Frames between the two of a pair, at video rate."""
FILM_FRAMES = 30
"""Frames of a scene at video rate that is tracked."""
FILM_SEEDS = range(740, 748)
"""Seeds of these scenes."""
STANDING_PAIRS = 14
"""Pairs of a recording from a tripod, for each stride, evenly distributed."""
MAX_BLURRED_STRIDE = 2
"""Most frames between the two of a blurred pair."""
CALIBRATION_SEED = 11
TEST_SEED = 12


def clips(data: Path, prefix: str) -> Iterator[KnownPair]:
    """The pairs of the semi-real clips of another generator whose names begin so."""
    for folder in clip_folders(data, prefix):
        yield from clip_pairs(folder)


def clip_folders(data: Path, prefix: str) -> list[Path]:
    """The folders of the clips whose names begin so."""
    return sorted((data / "semi_real_clips").glob(f"{prefix}_*"))


def clip_pairs(folder: Path) -> Iterator[KnownPair]:
    """The pairs of one clip."""
    sequence = open_sequence(folder)
    masks = sorted((folder / "dynamic").iterdir())
    for k in range(len(sequence) - 1):
        T = invert(sequence.poses[k + 1]) @ sequence.poses[k]
        moving = cv2.imread(str(masks[k]), cv2.IMREAD_GRAYSCALE) > 0
        drawn = recorded_pair(sequence, k, k + 1, T, folder.name)
        yield replace(drawn, moving=moving)


def static_rooms(data: Path) -> Iterator[KnownPair]:
    """Every second pair of neighbours of a recording of rooms, in which nothing moves."""
    folder = data / "real_static" / "rooms_110"
    if not folder.is_dir():
        return
    sequence = open_sequence(folder)
    for k in range(0, len(sequence) - 1, 2):
        T = invert(sequence.poses[k + 1]) @ sequence.poses[k]
        yield recorded_pair(sequence, k, k + 1, T, folder.name)


def recorded_pair(
    sequence: Sequence, first: int, second: int, T_curr_prev: np.ndarray, name: str
) -> KnownPair:
    """Two frames of a recording with DIS flow and known motion, in which nothing moves."""
    prev = sequence.frame(first)
    curr = sequence.frame(second)
    pair = with_flow(FramePair(prev, curr, None), dis_flow())
    depth = np.where(prev.depth > 0, prev.depth, 0).astype(np.float32)
    return KnownPair(pair, T_curr_prev, depth, np.zeros(depth.shape, bool), name)


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
        for k in scene_starts():
            yield known_pair(scene, k, k + 1, flow)


def scene_starts() -> range:
    """The first frames of a rendered scene's pairs."""
    step = (SCENE_FRAMES - 1) // PAIRS_OF_SCENE
    return range(0, step * PAIRS_OF_SCENE, step)


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


def video_scenes(
    kind: str, seeds: range, size: tuple[int, int] = SIZE
) -> Iterator[KnownPair]:
    """Pairs of rendered scenes at video rate, as a depth camera measures them."""
    for seed in seeds:
        frames = list(rendered(kind, "slow", seed, VIDEO_FRAMES, size))
        for stride in VIDEO_STRIDES:
            for first in range(0, VIDEO_FRAMES - stride, 2):
                yield video_pair(frames[first : first + stride + 1])


def video_pair(seen: list[Seen]) -> KnownPair:
    """The first and the last of some frames at video rate."""
    T = np.eye(4)
    for each in seen[1:]:
        T = np.asarray(each.T_curr_prev) @ T
    prev = seen[0].frame
    pair = with_flow(FramePair(prev, seen[-1].frame, None), dis_flow())
    moving = np.zeros(prev.camera.shape, bool)
    for known in seen[0].known.values():
        moving |= known.mask
    return KnownPair(pair, T, np.asarray(prev.depth), moving)


def filmed(kind: str, size: tuple[int, int]) -> Iterator[Film]:
    """Rendered scenes at video rate, whole."""
    for seed in FILM_SEEDS:
        poses = [np.eye(4)]
        frames = []
        for seen in rendered(kind, "slow", seed, FILM_FRAMES, size):
            frames.append(seen.frame)
            if seen.T_curr_prev is not None:
                poses.append(poses[-1] @ invert(seen.T_curr_prev))
        yield Film(frames, poses)


def standing_film(data: Path, name: str) -> Iterator[Film]:
    """People before a camera on a tripod, whole."""
    for recording in load_tripod(data / "tripod", (name,)):
        frames = list(recording.frames)
        yield Film(frames, [np.eye(4)] * len(frames))


def standing(data: Path, name: str) -> Iterator[KnownPair]:
    """Pairs of people before a camera on a tripod, as it saw them."""
    for recording in load_tripod(data / "tripod", (name,)):
        count = len(recording.frames)
        for stride in VIDEO_STRIDES:
            for first in range(0, count - stride, max(1, count // STANDING_PAIRS)):
                prev = recording.frames[first]
                curr = recording.frames[first + stride]
                pair = with_flow(FramePair(prev, curr, None), dis_flow())
                moving = recording.foreground[first] > 0
                depth = np.where(moving, 0, prev.depth).astype(np.float32)
                yield KnownPair(pair, np.eye(4), depth, moving, name)


def blurred_rooms(data: Path, count: int) -> Iterator[KnownPair]:
    """Pairs of the recording of rooms, blurred by a turn."""
    folder = data / "real_static" / "rooms_110"
    if not folder.is_dir():
        return
    sequence = open_sequence(folder)
    nothing = np.zeros(sequence.frame(0).camera.shape, np.uint8)

    def recorded(first: int, second: int) -> Recorded:
        T = invert(sequence.poses[second]) @ sequence.poses[first]
        frames = (sequence.frame(first), sequence.frame(second))
        return Recorded(*frames, T, (nothing, nothing))

    yield from blurred_turns(recorded, len(sequence), count)


def blurred_people(data: Path, name: str, count: int) -> Iterator[KnownPair]:
    """Pairs of a recording from a tripod, blurred by a turn."""
    for recording in load_tripod(data / "tripod", (name,)):
        near = partial(standing_frames, recording)
        yield from blurred_turns(near, len(recording.frames), count)


def standing_frames(
    recording: TripodRecording, first: int, second: int
) -> Recorded:
    """Two frames of a recording from a tripod, whose camera stood."""
    return Recorded(
        recording.frames[first],
        recording.frames[second],
        np.eye(4),
        (recording.foreground[first], recording.foreground[second]),
    )


def blurred_turns(
    recorded: Callable[[int, int], Recorded], length: int, count: int
) -> Iterator[KnownPair]:
    """Near frames of a recording of some length, blurred by a turn."""
    rng = np.random.default_rng(CALIBRATION_SEED)
    for _ in range(count):
        first = int(rng.integers(length - MAX_BLURRED_STRIDE))
        second = first + int(rng.integers(1, MAX_BLURRED_STRIDE + 1))
        yield draw_blurred_turn(rng, recorded(first, second), dis_flow())


def bare_walls(seeds: range) -> Iterator[KnownPair]:
    """Static scenes whose surfaces are white tiles with thin lines between them."""
    for seed in seeds:
        scene = make_scene("static", seed, frames=SCENE_FRAMES)
        rng = np.random.default_rng(seed)
        for k in scene_starts():
            frames = []
            for index in (k, k + 1):
                rgb = tiled(scene, index, rng)
                frames.append(Frame(rgb, scene.depth(index), scene.camera))
            T = invert(scene.T_world_cam[k + 1]) @ scene.T_world_cam[k]
            pair = with_flow(FramePair(*frames, None), dis_flow())
            moving = np.zeros(scene.camera.shape, bool)
            yield KnownPair(pair, T, frames[0].depth, moving)


def tiled(scene: Scene, index: int, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) uint8 image of a scene in which every surface is tiled in white."""
    depth = scene.depth(index)
    rows, columns = np.indices(depth.shape)
    pixels = np.stack([rows.ravel(), columns.ravel()], axis=1)
    points = backproject(depth, scene.camera, pixels)
    T = scene.T_world_cam[index]
    points = points @ T[:3, :3].T + T[:3, 3]
    # distance to the nearest line in tiles; wide enough for a pixel
    away = np.abs((points + TILE_OFFSET_M) / TILE_M % 1.0 - 0.5)
    width = np.maximum(LINE_M, points_per_pixel(depth, scene.camera)) / TILE_M
    is_line = (away > 0.5 - 0.5 * width.reshape(-1, 1)).any(axis=1)
    grey = np.where(is_line, LINE_GREY, WALL_GREY).reshape(depth.shape)
    grey = cv2.GaussianBlur(grey, (0, 0), LENS_BLUR_PX)
    grey = grey + rng.normal(0, IMAGE_NOISE, depth.shape)
    grey = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def points_per_pixel(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """(H, W) size of a pixel on a surface, metres."""
    return np.where(np.isfinite(depth), depth, 0) / camera.fx


def heavy(seeds: range, flow: str) -> Iterator[KnownPair]:
    """Pairs of all heavy families."""
    for kind in HEAVY:
        yield from scene_pairs(kind, seeds, flow)


def semi_real(data: Path, split: str, count: int) -> Iterator[KnownPair]:
    """The project's own semi-real pairs."""
    recordings = load_split(data, split)
    for number in range(count):
        yield draw(split, number, recordings)


def two_recordings(data: Path, split: str, count: int) -> Iterator[KnownPair]:
    """Pairs of two recordings in one view, every second one with exchanged roles."""
    places = load_places(data, (split,))
    if len(places) < 2:
        return
    for number in range((count + 1) // 2):
        rng = np.random.default_rng([CALIBRATION_SEED, number])
        parts = draw_two_recordings(rng, places)
        for each in (parts, parts.exchanged()):
            yield compose(each).pairs[0]


CALIBRATION: dict[str, Maker] = {
    "two recordings, development": lambda data, n: two_recordings(
        data, "development", n
    ),
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
    "bare walls": lambda data, n: bare_walls(range(900, 900 + max(1, n // 20))),
    "rooms, static": lambda data, n: static_rooms(data),
}
"""Makers on whose pairs probabilities are fitted."""
WITHOUT_FLOW: dict[str, Maker] = {
    **{
        f"video rate, {kind}": lambda data, n, kind=kind: video_scenes(
            kind, range(700, 700 + max(1, n // 7))
        )
        for kind in ("light", "heavy_two", "heavy_ten", "heavy_rigid", "static")
    },
    **{
        f"small, {kind}": lambda data, n, kind=kind: video_scenes(
            kind, range(720, 720 + max(1, n // 7)), SMALL
        )
        for kind in ("light", "heavy_two", "heavy_ten", "static")
    },
    **{
        f"standing, {name}": lambda data, n, name=name: standing(data, name)
        for name in ("corridor", "boxes", "lab_far", "books")
    },
    "blurred rooms": blurred_rooms,
    "blurred people": lambda data, n: blurred_people(data, "books", n),
}
"""Makers of neighbouring frames of a camera in the hand or on a tripod. On their pairs the
probability of a motion found without flow is fitted as well."""
FILMS: dict[str, Callable[[Path], Iterator[Film]]] = {
    **{
        f"film, {kind}, {size[1]} px": lambda data, kind=kind, size=size: filmed(
            kind, size
        )
        for kind in ("light", "heavy_two", "heavy_ten", "static")
        for size in (SMALL, SIZE)
    },
    **{
        f"film, {name}": partial(standing_film, name=name)
        for name in ("corridor", "boxes", "lab_far", "books")
    },
}
"""Frames of a camera in the hand or on a tripod, in which a tracker remembers what is static. On
these the probability of a motion of what is believed static is fitted."""
TEST: dict[str, Maker] = {
    "two recordings": lambda data, n: two_recordings(data, "test", n),
    "semi-real": lambda data, n: semi_real(data, "test", n),
    "clips, kitchen": lambda data, n: clips(data, "kitchen"),
    "bare walls": lambda data, n: bare_walls(range(9300, 9300 + max(1, n // 5))),
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
