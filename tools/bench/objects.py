"""What else moves: objects found, numbers kept, motions within three sigma.

    python tools/benchmark.py objects --out docs/results/objects.json

Rendered scenes, as a depth camera measures them, whose objects and motions are known: at video rate
(``slow``), and with steps five times as long (``fast``). And clips of one rigid thing that moves in
a recording of a static scene (``--clips``), of which its pixels are known. Counted is every
object on more than 3 % of the view that moves by half a pixel or 2 cm beside the camera.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from measuring import OUTSIDE, digits, parser_of, provenance, store

from bench.memory import CLIPS as RECORDINGS
from bench.memory import LEAST_WRONG_PX, clip_folders
from hybridvo import (
    Frame,
    MovingObject,
    Odometry,
    Options,
    Step,
    open_sequence,
)
from hybridvo.core.geometry import (
    backproject,
    invert,
    make_transform,
    project,
    se3_log,
    transform_points,
)
from hybridvo.core.options import TrackOptions
from hybridvo.io.masks import object_colour
from hybridvo_lab.synthetic.render import Scene, Solid
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.synthetic.slow_scenes import (
    noisy_image,
    slow_scene,
    structured_light,
)

FAMILIES = ("light", "heavy_two", "heavy_ten", "heavy_rigid", "static")
KINDS = "lateral approach big room rotate tracking bonnet start stop behind".split()
"""Last words of the names of clips: those with one rigid thing."""
WITH_OBJECTS = Options(track=TrackOptions(objects="auto"))
SIZE = (240, 320)
DRAWN_EVERY = 3
MIN_FRACTION = 0.03
MIN_OVERLAP = 0.5
MIN_PX = 0.5
MIN_M = 0.02
RIGHT_CAMERA_PX = 0.25
"""Mean error of the camera's flow up to which its motion is right: else the tracker follows a thing
that moves, and what moves beside it is the scene."""
RIGHT_RECORDED_PX = LEAST_WRONG_PX
"""The same in a recording: a fit inside the true mask errs by more than a quarter of a pixel."""


class Known(NamedTuple):
    """An object of a frame, as it truly is."""

    mask: np.ndarray  # (H, W) bool
    T_curr_prev: np.ndarray | None  # (4, 4), from the frame before; None: not known


class Seen(NamedTuple):
    """A frame and its true objects by their numbers; whether the camera's motion was right."""

    frame: Frame
    known: dict[int, Known]
    T_curr_prev: np.ndarray | None


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--families", default=",".join(FAMILIES))
    add("--seed0", type=int, default=9001, help="first seed of the scenes")
    add("--seeds", type=int, default=2, help="scenes of each family")
    add("--frames", type=int, default=14, help="of each scene")
    add("--clips", action="store_true", help="of recordings as well")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add(
        "--out",
        type=Path,
        metavar="FILE",
        help="its other families stay",
    )
    add(
        "--picture", type=Path, metavar="FILE", help="draw a scene, measure nothing"
    )
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.picture is not None:
        draw(args.picture, rendered("heavy_ten", "fast", args.seed0, args.frames))
        return 0
    origin = provenance("benchmark.py objects", argv)
    result = {}
    if args.out is not None and args.out.exists():
        result = json.loads(args.out.read_text(encoding="utf-8"))
    for family in filter(None, args.families.split(",")):
        rows = []
        for rate in ("slow", "fast"):
            counts = Counts()
            for seed in range(args.seed0, args.seed0 + args.seeds):
                frames = rendered(family, rate, seed, args.frames)
                counts.follow(frames)
            rows.append({"frames of": f"{family}, {rate}"} | counts.summary())
            print(rows[-1], flush=True)
        result[family] = origin | {"rows": rows}
    if args.clips:
        rows = []
        for recording in RECORDINGS:
            counts = Counts(RIGHT_RECORDED_PX)
            for folder in clip_folders(args.data, recording):
                if folder.name.partition("_")[2] in KINDS:
                    counts.follow(recorded(folder))
            rows.append({"frames of": f"clips, {recording}"} | counts.summary())
            print(rows[-1], flush=True)
        result["clips"] = origin | {"rows": rows}
    store(args.out, result)
    return 0


def draw(path: Path, frames: Iterator[Seen]) -> None:
    """Draw some frames of a scene: the image, and each object in its colour with its number."""
    odometry = Odometry(options=WITH_OBJECTS)
    columns = []
    for k, seen in enumerate(frames):
        step = odometry.track(seen.frame)
        if k % DRAWN_EVERY or not step.objects:
            continue
        assert seen.frame.rgb is not None
        shown = seen.frame.rgb.copy()
        for thing in step.objects:
            if not thing.is_seen:
                continue
            colour = np.array(object_colour(thing.id))
            shown[thing.mask] = 0.4 * shown[thing.mask] + 0.6 * colour
            rows, cols = np.nonzero(thing.mask)
            place = (int(np.median(cols)) - 6, int(np.median(rows)) + 6)
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(shown, str(thing.id), place, font, 0.6, (0, 0, 0), 2)
        columns.append(np.vstack([seen.frame.rgb, shown]))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.hstack(columns)[..., ::-1])


class Counts:
    """What was found of the objects of some sequences.

    Args:
        right_px: mean error of the camera's flow up to which its motion is right.
    """

    def __init__(self, right_px: float = RIGHT_CAMERA_PX) -> None:
        self.right_px = right_px
        self.objects = 0
        self.found = 0
        self.again = 0
        self.kept = 0
        self.sure = 0
        self.within = 0
        self.false = 0
        self.frames = 0
        self.wrong_camera = 0
        self.wrong_and_ok = 0

    def follow(self, frames: Iterator[Seen]) -> None:
        """Track a sequence."""
        odometry = Odometry(options=WITH_OBJECTS)
        last: dict[int, int] = {}
        for k, seen in enumerate(frames):
            step = odometry.track(seen.frame)
            if k == 0:
                continue
            self.frames += 1
            if _is_wrong(step, seen, self.right_px):
                self.wrong_camera += 1
                self.wrong_and_ok += step.motion.ok
                continue
            self.count(step, seen, last)

    def count(self, step: Step, seen: Seen, last: dict[int, int]) -> None:
        """Compare the objects of a step with the true ones; ``last``: numbers given before."""
        taken = set()
        for number, known in seen.known.items():
            best = _best(step, known)
            if best is not None:
                taken.add(best.id)
            if not _counts(known, seen):
                continue
            self.objects += 1
            if best is None:
                continue
            self.found += 1
            if number in last:
                self.again += 1
                self.kept += last[number] == best.id
            last[number] = best.id
            if known.T_curr_prev is not None and best.status.usable:
                self.sure += 1
                self.within += _squared_error(best, known.T_curr_prev) < OUTSIDE
        moving = np.zeros(seen.frame.camera.shape, bool)
        for known in seen.known.values():
            moving |= known.mask
        for thing in step.objects:
            is_large = thing.is_seen and thing.fraction > MIN_FRACTION
            if is_large and thing.id not in taken:
                self.false += np.mean(moving[thing.mask]) < MIN_OVERLAP

    def summary(self) -> dict[str, Any]:
        """Fractions, and times."""
        return {
            "frames": self.frames,
            "camera_wrong": self.wrong_camera,
            "camera_wrong_ok": self.wrong_and_ok,
            "objects": self.objects,
            "found": _fraction(self.found, self.objects),
            "id_kept": _fraction(self.kept, self.again),
            "within_3_sigma": _fraction(self.within, self.sure),
            "motions": self.sure,
            "false": int(self.false),
        }


def _fraction(part: int, of: int) -> float | None:
    return digits(part / of) if of else None


def _is_wrong(step: Step, seen: Seen, right_px: float) -> bool:
    """Whether the camera's own motion is wrong: what moves beside it is then another thing."""
    if seen.T_curr_prev is None:
        return False
    if step.prev_index != seen.frame.index - 1:
        return True
    depth = seen.frame.depth
    assert depth is not None
    points = backproject(depth, seen.frame.camera)[(depth > 0) & np.isfinite(depth)]
    error = step.T_curr_prev @ invert(seen.T_curr_prev)
    return _moved_px(points, error, seen) > right_px


def _moved_px(points: np.ndarray, T: np.ndarray, seen: Seen) -> float:
    """Mean distance, px, by which a motion (4, 4) moves points (N, 3) in the image."""
    camera = seen.frame.camera
    apart = project(transform_points(T, points), camera) - project(points, camera)
    return float(np.nanmean(np.linalg.norm(apart, axis=1)))


def _best(step: Step, known: Known) -> MovingObject | None:
    """The object of a step that overlaps a true one by half."""
    overlaps = [
        (np.sum(thing.mask & known.mask) / np.sum(thing.mask | known.mask), thing)
        for thing in step.objects
        if thing.is_seen
    ]
    overlap, best = max(overlaps, key=lambda each: each[0], default=(0.0, None))
    return best if overlap >= MIN_OVERLAP else None


def _counts(known: Known, seen: Seen) -> bool:
    """Whether an object is large enough, and moves beside the camera."""
    if np.mean(known.mask) <= MIN_FRACTION:
        return False
    depth = seen.frame.depth
    if known.T_curr_prev is None or seen.T_curr_prev is None or depth is None:
        return True
    camera = seen.frame.camera
    inside = known.mask & (depth > 0) & np.isfinite(depth)
    points = backproject(depth, camera)[inside]
    T = seen.T_curr_prev @ invert(known.T_curr_prev)
    nearer = transform_points(T, points)[:, 2] - points[:, 2]
    metres = float(np.mean(np.abs(nearer)))
    return _moved_px(points, T, seen) >= MIN_PX or metres >= MIN_M


def _squared_error(thing: MovingObject, T_curr_prev: np.ndarray) -> float:
    """Error of an object's motion in units of its covariance, squared."""
    error = se3_log(T_curr_prev @ invert(thing.T_curr_prev))
    return float(error @ np.linalg.solve(thing.covariance, error))


# -- where frames come from ---------------------------------------------------------------


def rendered(
    family: str, rate: str, seed: int, frames: int, size: tuple[int, int] = SIZE
) -> Iterator[Seen]:
    """A rendered scene of a size (rows, columns), as a camera of structured light measures it."""
    height, width = size
    if rate == "slow":
        scene = slow_scene(family, seed, frames, size)
    else:
        scene = make_scene(family, seed, height=height, width=width, frames=frames)
    rng = np.random.default_rng(seed)
    for index in range(scene.frames):
        exact = scene.render(index)
        assert exact.rgb is not None
        frame = Frame(
            noisy_image(exact.rgb, rng),
            structured_light(scene.depth(index), rng),
            exact.camera,
            exact.timestamp,
            index,
        )
        T = None
        if index > 0:
            T = invert(scene.T_world_cam[index]) @ scene.T_world_cam[index - 1]
        yield Seen(frame, _known(scene, index), T)


def _known(scene: Scene, index: int) -> dict[int, Known]:
    """The objects of a rendered frame."""
    numbers = scene.object_id(index)
    known = {}
    for solid in scene.solids:
        if solid.object_id > 0 and solid.object_id not in known:
            T = _true_motion(scene, solid, index) if index > 0 else None
            mask = numbers == solid.object_id
            if mask.any():
                known[solid.object_id] = Known(mask, T)
    return known


def _true_motion(scene: Scene, solid: Solid, index: int) -> np.ndarray:
    """(4, 4) motion of a solid in the camera, from the frame before."""
    maps = solid.A_world_body
    before, after = (
        maps if maps.ndim == 2 else maps[k] for k in (index - 1, index)
    )
    # of three numbers, of the axes and of the centre
    change = after[:, :3] @ np.linalg.inv(before[:, :3])
    U, _, Vt = np.linalg.svd(change)
    R = U @ Vt
    moved = make_transform(R, after[:, 3] - R @ before[:, 3])
    T_cam_world = invert(scene.T_world_cam[index])
    return T_cam_world @ moved @ scene.T_world_cam[index - 1]


def recorded(folder: Path) -> Iterator[Seen]:
    """A clip with one thing that moves: which pixels do so between a frame and the next."""
    sequence = open_sequence(folder)
    masks = [
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0
        for path in sorted((folder / "dynamic").glob("*.png"))
    ]
    poses = sequence.poses
    for index in range(len(sequence)):
        known = {}
        moved = index > 0 and np.mean(masks[index - 1]) > MIN_FRACTION
        if moved and index < len(masks) and masks[index].any():
            T = np.eye(4) if folder.name.endswith("bonnet") else None
            known = {1: Known(masks[index], T)}
        T_camera = None
        if index > 0 and poses is not None:
            T_camera = invert(poses[index]) @ poses[index - 1]
        yield Seen(sequence.frame(index), known, T_camera)
