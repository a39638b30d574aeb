"""Whether the stated covariance is true, on sensors and generators of many makers.

    python tools/benchmark.py sigmas --pairs 60 --out docs/results/sigmas.json

The normalised error squared (NEES) of a right answer is its squared distance to the true motion in
units of the stated covariance, to which that of the true motion is added. With honest sigmas its
median is 5.35, and .3 % are beyond 3 sigma; where only the rotation is known, 2.37.
An answer is right when its ego flow over static pixels errs by less than a pixel.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from maker_pairs import (
    Maker,
    bare_walls,
    clips,
    heavy,
    recorded_pair,
    scene_pairs,
    turned_windows,
)
from measuring import (
    digits,
    ego_flow_error,
    motion_error,
    parser_of,
    proportion,
    provenance,
    store,
)
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from hybridvo import estimate, open_sequence
from hybridvo.core.geometry import invert, make_transform
from hybridvo_lab.calibration import WRONG_PX
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.semi_real import draw_clip, load_split

METHODS = ("hybrid", "hybrid-flow", "classical", "pwvo-refine")
SEED = 21
BEYOND = 0.9973
"""Probability inside 3 sigma."""
KITTI = "real_dynamic/kitti06_stereo"
TARTANAIR = "tartanair_v2/P000"


class Set(NamedTuple):
    """Pairs of one origin, and how well their true motion is known."""

    pairs: Maker
    translation_m: float  # standard deviation of the true pose, each axis
    rotation_deg: float
    rotation_only: bool = False


def tripod(name: str) -> Maker:
    """Neighbouring frames of a recording from a tripod, with the floor's vibration."""

    def draw(data: Path, count: int) -> Iterator[KnownPair]:
        sequence = open_sequence(data / "tripod" / name)
        turned = background_rotations(data / "tripod" / name)
        chosen = sorted(turned)
        step = max(1, len(chosen) // count)
        for index in chosen[::step]:
            yield recorded_pair(sequence, index - 1, index, turned[index], name)

    return draw


def background_rotations(folder: Path) -> dict[int, np.ndarray]:
    """Motion (4, 4) to each frame, by the corners of the background alone."""
    lines = (folder / "background_rotation.csv").read_text("utf-8").splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    motions = {}
    for row in rows:
        degrees = [float(row[key]) for key in ("rx", "ry", "rz")]
        R = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
        motions[int(row["index"])] = make_transform(R, np.zeros(3))
    return motions


def recorded(path: str, stride: int = 1) -> Maker:
    """Pairs of a static recording with exact or nearly exact poses."""

    def draw(data: Path, count: int) -> Iterator[KnownPair]:
        sequence = open_sequence(data / path)
        starts = range(len(sequence) - stride)
        for k in starts[:: max(1, len(starts) // count)]:
            T = invert(sequence.poses[k + stride]) @ sequence.poses[k]
            yield recorded_pair(sequence, k, k + stride, T, path)

    return draw


def pasted(path: str) -> Maker:
    """Pairs of a static recording with moving objects of other recordings in it."""

    def draw(data: Path, count: int) -> Iterator[KnownPair]:
        recordings = load_split(data, "test")
        stage = [r for r in recordings if r.source.path == path]
        others = [replace(r, pairs=()) for r in recordings if r.source.path != path]
        for number in range(count):
            rng = np.random.default_rng([SEED, number])
            (drawn,) = draw_clip(rng, (*stage, *others), int(rng.integers(1, 5)))
            yield drawn

    return draw


SETS: dict[str, Set] = {
    "heavy, rendered": Set(
        lambda _, n: heavy(range(9300, 9300 + max(1, n // 20)), "dis"), 0.0, 0.0
    ),
    "TartanAir": Set(recorded(TARTANAIR), 0.0, 0.0),
    "TartanAir, moving objects": Set(pasted(TARTANAIR), 0.0, 0.0),
    "tripod, books": Set(tripod("books"), 0.0, 0.001, rotation_only=True),
    "tripod, boxes": Set(tripod("boxes"), 0.0, 0.001, rotation_only=True),
    "tripod, corridor": Set(tripod("corridor"), 0.0, 0.001, rotation_only=True),
    "tripod, fruit": Set(tripod("fruit"), 0.0, 0.001, rotation_only=True),
    "tripod, lab_close": Set(tripod("lab_close"), 0.0, 0.001, rotation_only=True),
    "tripod, turned": Set(
        lambda data, n: turned_windows(data, ("fruit", "lab_close"), n, SEED),
        0.0,
        0.015,
        rotation_only=True,
    ),
    "clips, kitchen": Set(lambda data, _: clips(data, "kitchen"), 0.002, 0.03),
    "KITTI": Set(recorded(KITTI), 0.017, 0.05),
    "KITTI, moving objects": Set(pasted(KITTI), 0.017, 0.05),
}
"""The sets by the name of their row."""
DEVELOPMENT: dict[str, Set] = {
    "static, development": Set(
        lambda _, __: scene_pairs("static", range(900, 906), "dis"), 0.0, 0.0
    ),
    "light, development": Set(
        lambda _, __: scene_pairs("light", range(900, 906), "dis"), 0.0, 0.0
    ),
    "heavy, development": Set(
        lambda _, __: heavy(range(900, 904), "dis"), 0.0, 0.0
    ),
    "bare walls, development": Set(
        lambda _, __: bare_walls(range(900, 904)), 0.0, 0.0
    ),
}
"""Sets on which numbers are chosen; they are measured where they are named."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--pairs", type=int, default=60, help="of sets without a fixed number")
    add("--methods", default=",".join(METHODS))
    add(
        "--sets",
        help="some of them, separated by a semicolon, also those for development; "
        "default: all others",
    )
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    names = args.sets.split(";") if args.sets else list(SETS)
    methods = {
        name: partial(estimate, method=name) for name in args.methods.split(",")
    }
    summary = {}
    for name in names:
        rows = measure((SETS | DEVELOPMENT)[name], args, methods)
        summary[name] = {method: summarise(rows[method]) for method in methods}
        for method, row in summary[name].items():
            print(name, method, row, flush=True)
    result = provenance("benchmark.py sigmas", argv) | {"sets": summary}
    store(args.out, result)
    return 0


def measure(
    some: Set, args: argparse.Namespace, methods: dict[str, Callable[..., Any]]
) -> dict[str, list[dict[str, Any]]]:
    """One record for each pair of a set and method."""
    rows: dict[str, list[dict[str, Any]]] = {method: [] for method in methods}
    for known in some.pairs(args.data, args.pairs):
        if known.pair.flow is None:
            continue
        for method, solve in methods.items():
            rows[method].append(record(some, known, solve(known.pair)))
    return rows


def record(some: Set, known: KnownPair, found: Any) -> dict[str, Any]:
    """Error and stated covariance of one answer."""
    static_depth = np.where(known.moving, 0, known.depth)
    error_px = ego_flow_error(
        found.T_curr_prev, known.T_curr_prev, static_depth, known.pair
    )
    used = slice(3, 6) if some.rotation_only else slice(0, 6)
    deviations = np.array(
        [some.translation_m] * 3 + [np.deg2rad(some.rotation_deg)] * 3
    )
    delta = motion_error(found.T_curr_prev, known.T_curr_prev)[used]
    covariance = (found.covariance + np.diag(deviations**2))[used, used]
    nees = float(delta @ np.linalg.solve(covariance, delta))
    return {
        "right": found.usable and error_px < WRONG_PX,
        "ok": found.ok,
        "nees": nees,
        "dof": len(delta),
        "error_px": error_px,
    }


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the right answers of a method on a set."""
    right = [row for row in records if row["right"]]
    if not right:
        return {"pairs": len(records), "right": 0}
    dof = right[0]["dof"]
    nees = np.array([row["nees"] for row in right])
    beyond = int((nees > chi2.ppf(BEYOND, dof)).sum())
    return {
        "pairs": len(records),
        "right": len(right),
        "wrong_ok": sum(row["ok"] and not row["right"] for row in records),
        "dof": dof,
        "nees_expected": digits(chi2.median(dof)),
        "nees_median": digits(np.median(nees)),
        "beyond_3_sigma": proportion(beyond, len(nees)),
    }
