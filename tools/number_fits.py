"""What each number that decides is worth, and which value other makers would choose.

Every number is tried at three times and at a third of its odds or size. A maker's loss says how
many of its steps are wrong and ``ok``, wrong, or right and doubted, and how far the right ones are
off. The value of a number that a maker did not choose is the one with the least loss over all
other makers; what is printed is the loss of the maker itself with that value.

``python tools/calibrate.py --numbers ALL`` runs this.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import golden_mutations as changes
import numpy as np
from bench import objects
from bench.memory import (
    clip_folders,
    moving_pixels,
    static_error,
    wrong_limit,
)
from measuring import digits, measured, provenance, store

from hybridvo import Frame, FramePair, Odometry, open_sequence
from hybridvo.core.geometry import invert
from hybridvo.core.imu import ImuSamples
from hybridvo.core.trajectory import COLUMNS, read_poses

FACTORS = (1 / 3, 3.0)
AS_IT_IS = "as it is"
HALF = 0.5
"""A fraction from which the odds change instead of the number."""
WRONG_OK, WRONG, DOUBTED, TWICE_AS_FAR = 1.0, 0.5, 0.25, 0.1
"""Losses of a step that is wrong and ``ok``, wrong and not, right and not, and for each time that
the errors, up to that of a wrong step, double."""
NO_ERROR_PX = 0.02
"""Added to errors: less cannot be seen."""
EQUAL = 0.005
"""Losses that differ by less are equal: the number as it is then stays."""
FITTED = (
    "CHOICE_RIGHT",
    "CUES_RIGHT",
    "DIRECT_EXACT",
    "DIRECT_OF_SCENE",
    "CUE_WEIGHTS",
)
"""Weights that the other parts of ``tools/calibrate.py`` fit."""
ROOMS = changes.ROOMS[:7]
"""Rooms that find a motion."""
CLIPS = {
    "kitchen": ("crowd", "rotate", "stop"),
    "box": ("wave", "big"),
    "lens": ("big", "tracking"),
}
CLIP_FRAMES = 7
DRONE = "euroc_v1_01"
OBJECT_SEED = 9001
OBJECT_FRAMES = 8


class Recording(NamedTuple):
    """Frames of a maker, with the true poses and which pixels move.

    Attributes:
        maker: who made it.
        frames: in their order.
        poses: (N, 4, 4) true T_world_cam.
        limits: error from which a step is wrong, px, by its two frames.
        moving: which pixels (H, W) of a frame move, by its number; None: none.
        imu: samples since the frame before, for each frame.
    """

    maker: str
    frames: list[Frame]
    poses: np.ndarray
    limits: dict[tuple[int, int], float]
    moving: Callable[[int], np.ndarray] | None = None
    imu: list[ImuSamples | None] | None = None

    def steps(self) -> Iterator[tuple[float, float, bool]]:
        """Error of each step, px, that from which it is wrong, and whether it is ok."""
        tracker = Odometry()
        for index, frame in enumerate(self.frames):
            imu = None if self.imu is None else self.imu[index]
            # a copy: what is kept with a frame is worked out again
            step = tracker.track(replace(frame), imu=imu)
            start = step.prev_index
            if start is None:
                continue
            pair = FramePair(self.frames[start], frame, None)
            T_true = invert(self.poses[index]) @ self.poses[start]
            moving = np.zeros(frame.camera.shape, bool)
            if self.moving is not None:
                moving = self.moving(start)
            if (start, index) not in self.limits:
                self.limits[start, index] = wrong_limit(pair, moving, T_true)
            error = static_error(pair, moving, invert(step.T_prev_curr), T_true)
            yield error, self.limits[start, index], step.ok


class Row(NamedTuple):
    """The steps of a maker."""

    steps: int
    wrong_ok: int
    wrong: int
    doubted: int
    error_px: float

    def loss(self, of_error_px: float) -> float:
        """By how much it is worse than no fault at all, beside an error that is usual."""
        bad = self.wrong_ok * WRONG_OK + self.wrong * WRONG + self.doubted * DOUBTED
        far = TWICE_AS_FAR * np.log2(self.error_px / of_error_px)
        return bad / self.steps + far


# -- the makers ------------------------------------------------------------------------


def recordings(data: Path) -> Iterator[Recording]:
    """Some frames of each maker."""
    for maker, kinds in CLIPS.items():
        for folder in clip_folders(data, maker):
            if folder.name.partition("_")[2] in kinds:
                moving = functools.cache(functools.partial(moving_pixels, folder))
                yield recorded(data, maker, folder.name, 0, CLIP_FRAMES, moving)
    yield recorded(data, "Kinect", "rgbd_dataset_freiburg1_rpy_100", 20, 8)
    yield recorded(data, "rooms", "rooms_110", 40, 6)
    yield recorded(data, "KITTI", "kitti02_stereo", 0, 4)
    yield recorded(data, "TartanAir", "P000", 0, 5)
    yield recorded(data, "network depth", "kitti00_network_depth", 0, 6)
    yield recorded(data, "drone", DRONE, 0, 8)
    for name in ("corridor", "fruit"):
        yield standing(data, name)
    for family, rate in (("heavy_ten", "fast"), ("heavy_two", "slow")):
        yield rendered(family, rate)


def recorded(
    data: Path,
    maker: str,
    name: str,
    first: int,
    count: int,
    moving: Callable[[int], np.ndarray] | None = None,
) -> Recording:
    """Some frames of a recording below the data folder."""
    folder = next(path for path in data.glob(f"**/{name}") if path.is_dir())
    sequence = open_sequence(folder)
    all_poses = sequence.poses
    if name == DRONE:
        rows, known = read_poses(folder / "cam0_poses.txt", COLUMNS["tum"])
        times = [sequence.frame(k).timestamp for k in range(len(sequence))]
        all_poses = known[
            [np.argmin(np.abs(rows.numbers[:, 0] - time)) for time in times]
        ]
    assert all_poses is not None
    chosen = range(first, min(first + count, len(sequence)))
    frames = [
        replace(sequence.frame(k), index=index) for index, k in enumerate(chosen)
    ]
    poses = np.array([all_poses[k] for k in chosen])
    imu = None
    if sequence.imu_samples is not None:
        times = [sequence.frame(k).timestamp for k in chosen]
        between = itertools.pairwise(times)
        imu = [None, *(sequence.imu(*both) for both in between)]
    return Recording(maker, frames, poses, {}, moving, imu)


def standing(data: Path, name: str) -> Recording:
    """People before a camera that stands."""
    sequence = open_sequence(data / "tripod" / name)
    frames = [sequence.frame(k) for k in range(min(8, len(sequence)))]
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    return Recording("tripods", frames, poses, {})


def rendered(family: str, rate: str) -> Recording:
    """A rendered scene with movers."""
    seen = list(objects.rendered(family, rate, OBJECT_SEED, 6))
    poses = [np.eye(4)]
    for each in seen[1:]:
        assert each.T_curr_prev is not None
        poses.append(poses[-1] @ invert(each.T_curr_prev))

    def moving(start: int) -> np.ndarray:
        masks = [known.mask for known in seen[start].known.values()]
        return np.logical_or.reduce([np.zeros(objects.SIZE, bool), *masks])

    return Recording(
        "rendered", [each.frame for each in seen], np.array(poses), {}, moving
    )


# -- a number --------------------------------------------------------------------------


def names_of(words: str) -> list[str]:
    """Numbers whose names have one of some words in them; ``ALL``: every number."""
    return [
        name
        for name in changes.fitted_numbers(ROOMS)
        if name.split("[")[0] not in FITTED
        and (words == "ALL" or any(word in name for word in words.split(",")))
    ]


def rows_of_poses(kept: list[Recording]) -> dict[str, Row]:
    """How each maker's steps end."""
    found: dict[str, list[tuple[float, float, bool]]] = {}
    for each in kept:
        found.setdefault(each.maker, []).extend(each.steps())
    return {maker: row_of(steps) for maker, steps in found.items()}


def row_of(steps: list[tuple[float, float, bool]]) -> Row:
    """The sums over some steps."""
    errors = np.log([min(error, limit) + NO_ERROR_PX for error, limit, _ in steps])
    return Row(
        len(steps),
        sum(bool(error > limit and ok) for error, limit, ok in steps),
        sum(bool(error > limit and not ok) for error, limit, ok in steps),
        sum(bool(error <= limit and not ok) for error, limit, ok in steps),
        float(np.exp(errors.mean())),
    )


def rows_of_objects(data: Path) -> dict[str, Row]:
    """How each maker's objects are found: lost ones count as wrong, false ones as wrong and ok."""
    made: dict[str, list[Any]] = {
        f"rendered, {rate}": [
            objects.rendered(family, rate, OBJECT_SEED, OBJECT_FRAMES)
            for family in ("heavy_ten", "light", "heavy_two")
        ]
        for rate in ("slow", "fast")
    }
    for maker, kinds in (
        ("kitchen", "lateral"),
        ("box", "lateral"),
        ("lens", "big"),
    ):
        folder = data / "semi_real_clips" / f"{maker}_{kinds}"
        made[maker] = [objects.recorded(folder)]
    rows = {}
    for maker, films in made.items():
        counts = objects.Counts(objects.RIGHT_RECORDED_PX)
        for film in films:
            counts.follow(film)
        lost = counts.objects - counts.found
        renamed = counts.again - counts.kept + counts.sure - counts.within
        rows[maker] = Row(
            max(counts.objects, 1), int(counts.false), lost, renamed, 1.0
        )
    return rows


# -- how it is tried -------------------------------------------------------------------


def is_of_objects(name: str) -> bool:
    """Whether a number is about what else moves, which changes no pose."""
    from hybridvo.tracking import object_motions
    from hybridvo.tracking import objects as followed

    constant = name.split("[")[0]
    return any(constant in vars(room) for room in (object_motions, followed))


@functools.cache
def kept_recordings(data: Path) -> list[Recording]:
    """The recordings of a process."""
    return list(recordings(data))


def rows_of(data: Path, of_objects: bool) -> dict[str, Row]:
    """How each maker fares with the numbers as they are now."""
    if of_objects:
        return rows_of_objects(data)
    return rows_of_poses(kept_recordings(data))


rows_as_they_are = functools.cache(rows_of)


def rows_with(data: Path, name: str) -> dict[str, dict[str, Row]]:
    """Rows of each maker with a number as it is, and with others in its place."""
    changes.load_all()
    of_objects = is_of_objects(name)
    found = {AS_IT_IS: rows_as_they_are(data, of_objects)}
    constant, keys = changes.fitted_numbers()[name]
    if constant in changes.compiled_constants():
        return found
    value = functools.reduce(
        lambda v, key: v[key], keys, changes.calibrated()[constant]
    )
    for factor in FACTORS:
        times = factor_of_odds(value, factor)
        with changes.number_changed(constant, keys, times):
            found[f"x {times:.2f}"] = rows_of(data, of_objects)
    return found


def factor_of_odds(value: float, factor: float) -> float:
    """By what a number changes: by a factor, a fraction near one by that of its odds."""
    if not HALF < value < 1:
        return factor
    odds = value / (1 - value) * factor
    return odds / (1 + odds) / value


# -- what comes out --------------------------------------------------------------------


def summary(rows: dict[str, dict[str, Row]]) -> dict[str, Any]:
    """What a number is worth, and what each maker would get that did not choose it."""
    if len(rows) == 1:
        return {"frozen": True}
    usual = {maker: row.error_px for maker, row in rows[AS_IT_IS].items()}
    losses = {
        how: {maker: row.loss(usual[maker]) for maker, row in each.items()}
        for how, each in rows.items()
    }
    changed = {
        how: [maker for maker in usual if each[maker] != rows[AS_IT_IS][maker]]
        for how, each in rows.items()
    }
    left_out = {}
    for maker in usual:
        chosen = best_of(losses, [other for other in usual if other != maker])
        if chosen != AS_IT_IS:
            cost = losses[chosen][maker] - losses[AS_IT_IS][maker]
            left_out[maker] = f"{chosen}: {cost:+.3f}"
    means = {
        how: digits(np.mean(list(each.values()))) for how, each in losses.items()
    }
    return {
        "loss": means,
        "best": best_of(losses, list(usual)),
        "moves": sorted(set().union(*changed.values())),
        "left out, another is chosen": left_out,
        "by how much": {
            how: by_how_much(each, losses[AS_IT_IS])
            for how, each in losses.items()
            if how != AS_IT_IS
        },
    }


def by_how_much(
    losses: dict[str, float], before: dict[str, float]
) -> dict[str, float]:
    """By how much the loss of each maker changes that it changes of."""
    changes_of = {m: round(loss - before[m], 3) for m, loss in losses.items()}
    return {maker: change for maker, change in changes_of.items() if change}


def best_of(losses: dict[str, dict[str, float]], makers: list[str]) -> str:
    """The value with the least mean loss over some makers; as it is where none is better."""
    means = {
        how: np.mean([each[m] for m in makers]) for how, each in losses.items()
    }
    best = min(means, key=lambda how: means[how])
    return best if means[best] < means[AS_IT_IS] - EQUAL else AS_IT_IS


def summarized(data: Path, name: str) -> dict[str, Any]:
    """What one number is worth, ready for JSON."""
    return summary(rows_with(data, name))


def fit_numbers(args: argparse.Namespace, argv: list[str] | None) -> int:
    """Try every number that is asked for, print and store what comes out."""
    names = names_of(args.numbers)
    work = functools.partial(summarized, args.data)
    found = measured(args, "numbers", work, {name: name for name in names})
    for name, row in found.items():
        print(name, row, flush=True)
    store(args.out, provenance("calibrate.py", argv) | {"numbers": found})
    return 0
