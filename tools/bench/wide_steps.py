"""Steps that are too wide for flow: frames of recordings that are far apart.

    python tools/benchmark.py wide_steps --out docs/results/wide_steps.json

Each pair alone, without a prior. A motion is right within 2 degrees and 5 cm: the ground truth of
recordings is no better over such steps. Beside the default stand the default without sparse
matches, and the motion of the most SIFT matches by PnP-RANSAC, which has no status.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import (
    add_workers,
    digits,
    measured,
    parser_of,
    proportion,
    provenance,
    store,
)

from hybridvo import FramePair, Options, RelativePose, estimate, open_sequence
from hybridvo.core.geometry import invert, rotation_angle
from hybridvo.core.options import SearchOptions
from hybridvo.hypotheses.matches import matched_motions
from hybridvo.io.data.truth import true_motion

RECORDINGS: dict[str, tuple[int, ...]] = {
    "tum/rgbd_dataset_freiburg1_rpy_100": (3, 6, 9, 12),
    "real_static/rooms_110": (2, 4, 6),
    "tartanair_v2/P000": (1, 2, 3),
    "semi_real_clips/kitchen_static": (2, 4),
    "semi_real_clips/box_static": (2, 4),
}
"""Recordings below the data folder, and how many frames the pairs are apart."""
RIGHT_DEG = 2.0
RIGHT_M = 0.05


class Answer(NamedTuple):
    """An answer about one pair."""

    is_right: bool
    is_ok: bool


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--pairs", type=int, default=16, help="of each recording and step")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    items = {}
    for name, strides in RECORDINGS.items():
        folder = (args.data / name).absolute()
        if not folder.is_dir():
            print(f"{name}: not there")
            continue
        for stride in strides:
            items[f"{name} {stride}"] = Steps(name, folder, stride, args.pairs)
    rows = list(measured(args, "wide_steps", row_of, items).values())
    for row in rows:
        print(row)
    result = provenance("benchmark.py wide_steps", argv) | {
        "right_deg": RIGHT_DEG,
        "right_m": RIGHT_M,
        "rows": rows,
    }
    store(args.out, result)
    return 0


class Steps(NamedTuple):
    """Pairs of a recording that are some frames apart."""

    name: str
    folder: Path
    stride: int
    pairs: int


def row_of(steps: Steps) -> dict[str, Any]:
    """Every method on some steps."""
    row = measure(steps.folder, steps.stride, steps.pairs, competitors())
    return {"recording": steps.name, "stride": steps.stride} | row


def competitors() -> dict[str, Callable[[FramePair], RelativePose]]:
    """The methods by the name of their row."""
    without = Options(search=SearchOptions(matches="off"))
    return {
        "hybrid": lambda pair: estimate(pair.prev, pair.curr),
        "without matches": lambda pair: estimate(
            pair.prev, pair.curr, options=without
        ),
        "SIFT, PnP-RANSAC": by_matches,
    }


def by_matches(pair: FramePair) -> RelativePose:
    """The motion of most matches; no motion where there are too few."""
    motions = matched_motions(pair)
    return RelativePose(T_curr_prev=motions[0] if motions else np.eye(4))


def measure(
    path: Path,
    stride: int,
    count: int,
    methods: dict[str, Callable[[FramePair], RelativePose]],
) -> dict[str, Any]:
    """Every method on the pairs of a recording that are ``stride`` frames apart."""
    answers: dict[str, list[Answer]] = {name: [] for name in methods}
    lengths = []
    angles = []
    for pair, T in pairs_of(path, stride, count):
        lengths.append(float(np.linalg.norm(T[:3, 3])))
        angles.append(float(np.degrees(rotation_angle(T[:3, :3]))))
        for name, solve in methods.items():
            motion = solve(pair)
            error = motion.T_curr_prev @ invert(T)
            is_near = float(np.linalg.norm(error[:3, 3])) <= RIGHT_M
            is_aligned = np.degrees(rotation_angle(error[:3, :3])) <= RIGHT_DEG
            is_right = bool(is_near and is_aligned and motion.usable)
            answers[name].append(Answer(is_right, motion.ok))
    return {
        "step_cm": digits(100 * np.median(lengths)),
        "step_deg": digits(np.median(angles)),
        "methods": {name: figures(given) for name, given in answers.items()},
    }


def pairs_of(
    path: Path, stride: int, count: int
) -> Iterator[tuple[FramePair, np.ndarray]]:
    """Pairs of a recording, evenly distributed, with their true motion."""
    sequence = open_sequence(path)
    last = len(sequence) - stride
    for first in np.unique(np.linspace(0, last - 1, count).round().astype(int)):
        T = true_motion(sequence, int(first), int(first) + stride)
        if T is not None:
            prev = sequence.frame(int(first))
            curr = sequence.frame(int(first) + stride)
            yield FramePair(prev, curr, None), T


def figures(answers: list[Answer]) -> dict[str, Any]:
    """Right answers, and wrong ones that are ok."""
    right = sum(answer.is_right for answer in answers)
    believed = sum(answer.is_ok and not answer.is_right for answer in answers)
    return {
        "right": proportion(right, len(answers)),
        "wrong_ok": believed,
    }
