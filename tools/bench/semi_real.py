"""The right motion on real surfaces, and whether the stated
probability can be believed.

    python tools/benchmark.py semi_real --pairs 160 --out docs/results/semi_real.json
    python tools/benchmark.py semi_real --split development --methods hybrid-flow

Pairs of :mod:`hybridvo_lab.synthetic.semi_real` on DIS flow, drawn from fixed seeds. An
answer is wrong when its ego flow over the static pixels errs by more than 3 px; or
by more than 1 px and more than three times as much as ``classical`` does inside the
true static mask.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measuring import (
    add_workers,
    digits,
    ego_flow_error,
    measured,
    parser_of,
    proportion,
    provenance,
    store,
    timed,
)

from hybridvo import estimate, refine
from hybridvo.network.models import Models
from hybridvo_lab.synthetic.semi_real import draw_clip, load_split
from hybridvo_lab.training.validation import allowed_error_px, area_under_curve

METHODS = ("classical", "hybrid-flow", "poselib")
"""Methods by default."""
MIN_MOVING = 0.2
"""Smallest moving fraction of the image where anything moves."""
STATIC_EVERY = 8
"""Every so many-th pair is static."""
BINS = 10
"""Bins of the stated probability for its calibration error."""
SEEDS = {"train": 1, "development": 2, "test": 3}
"""First word of the seed of every pair."""

Estimator = Callable[[Any], Any]
"""From a pair to its motion."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--pairs", type=int, default=160)
    add("--split", default="test", choices=SEEDS)
    add("--methods", default=",".join(METHODS))
    add("--weights", metavar="FILE", help="of PWVO, in place of the shipped ones")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.data = args.data.absolute()
    recordings = recordings_of(args.data, args.split)
    methods = list(competitors(args))
    numbers = {f"pair {k}": k for k in range(args.pairs)}
    rows = list(measured(args, "pairs", partial(pair_row, args), numbers).values())

    result = provenance("benchmark.py semi_real", argv) | {
        "split": args.split,
        "recordings": {r.source.path: len(r.frames) for r in recordings},
        "pairs": len(rows),
        "with_moving_objects": sum(row["moving"] > 0 for row in rows),
        "summary": {name: summarise(rows, name) for name in methods if rows},
    }
    for method, row in result["summary"].items():
        print(method, {k: v for k, v in row.items() if k != "reliability"})
    store(args.out, result)
    return 0


# --- items ------------------------------------------------------------------------


@functools.cache
def recordings_of(data: Path, split: str) -> Any:
    """The recordings of a part, which a process reads once."""
    return load_split(data, split)


def pair_row(args: argparse.Namespace, number: int) -> dict[str, Any]:
    """Answers to one pair."""
    recordings = recordings_of(args.data, args.split)
    drawn = draw(args.split, number, recordings)
    (row,) = measure([drawn], competitors(args))
    return row


# --- methods ----------------------------------------------------------------------


def competitors(args: argparse.Namespace) -> dict[str, Estimator]:
    """The methods that are measured on pairs, by the name of their row."""
    models = models_of(args.weights)
    methods: dict[str, Estimator] = {}
    for name in args.methods.split(","):
        methods[name] = partial(estimate, method=name, models=models)
    return methods


@functools.cache
def models_of(weights: str | None) -> Models:
    """The networks, with other weights of PWVO where a file is given; read once."""
    return Models(weights={} if weights is None else {"pwvo": weights})


# --- pairs ------------------------------------------------------------------------


def draw(split: str, number: int, recordings: Any, **fractions: float) -> Any:
    """Draw a pair in which nothing moves, or at least
    :data:`MIN_MOVING` of the image does.
    """
    is_static = number % STATIC_EVERY == 0
    for attempt in itertools.count():
        rng = np.random.default_rng([SEEDS[split], number, attempt])
        objects = 0 if is_static else int(rng.integers(1, 5))
        (drawn,) = draw_clip(rng, recordings, objects, **fractions)
        if is_static or drawn.moving.mean() > MIN_MOVING:
            return drawn


class StaticPart(NamedTuple):
    """The static part of a pair."""

    depth: np.ndarray  # (H, W) metres, 0 on moving pixels
    oracle_px: float  # error of the fit to it


def static_part(drawn: Any) -> StaticPart:
    """The depth of a pair's static pixels, and the error of
    ``classical`` on them alone.
    """
    depth = np.where(drawn.moving, 0, drawn.depth)
    oracle = refine(drawn.pair, weights=(~drawn.moving).astype(np.float32))
    error = ego_flow_error(oracle.T_curr_prev, drawn.T_curr_prev, depth, drawn.pair)
    return StaticPart(depth, error)


# --- figures ----------------------------------------------------------------------


def measure(
    drawn_pairs: Iterable[Any], methods: dict[str, Estimator]
) -> list[dict[str, Any]]:
    """Errors, statuses and probabilities of every method on every pair."""
    rows = []
    for drawn in drawn_pairs:
        pair = drawn.pair
        static = static_part(drawn)
        usable = pair.prev.depth > 0
        if pair.flow_valid is not None:
            usable = usable & pair.flow_valid
        usable_static = usable & ~drawn.moving
        row: dict[str, Any] = {
            "moving": digits(drawn.moving.mean()),
            "static_usable": digits(usable_static.sum() / max(usable.sum(), 1)),
            "oracle_px": digits(static.oracle_px),
        }
        for method, solve in methods.items():
            motion, ms = timed(partial(solve, pair))
            row[method] = answer_row(motion, drawn, static) | {"ms": digits(ms)}
        rows.append(row)
    return rows


def answer_row(motion: Any, drawn: Any, static: StaticPart) -> dict[str, Any]:
    """The figures of one answer."""
    truth = (drawn.T_curr_prev, static.depth, drawn.pair)
    error = ego_flow_error(motion.T_curr_prev, *truth)
    return {
        "px": digits(error),
        "wrong": bool(error > allowed_error_px(static.oracle_px)),
        "status": motion.status.state.value,
        "reason": motion.status.reason.value,
        "probability": digits(motion.probability),
    }


def summarise(rows: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """Fractions of wrong answers, and how well the probability and
    the status separate them.
    """
    answers = [row[method] for row in rows]
    moving = np.array([row["moving"] > 0 for row in rows])
    static_majority = np.array([row["static_usable"] > 0.5 for row in rows])
    wrong = np.array([each["wrong"] for each in answers])
    right = ~wrong
    ok = np.array([each["status"] == "ok" for each in answers])
    probability = np.array([each["probability"] for each in answers])
    right_px = [each["px"] for each in answers if not each["wrong"]]

    def fraction(what: np.ndarray, among: np.ndarray) -> dict[str, Any]:
        return proportion(int((what & among).sum()), int(among.sum()))

    return {
        "wrong": fraction(wrong, moving),
        "wrong_static_majority": fraction(wrong, moving & static_majority),
        "wrong_static": fraction(wrong, ~moving),
        "right_not_ok": fraction(~ok, right & moving),
        "right_not_ok_static": fraction(~ok, right & ~moving),
        "wrong_ok": fraction(ok, wrong),
        "median_px_right": digits(np.median(right_px or [0])),
        "auroc": area_under_curve(probability, right),
        "ece": calibration_error(probability, right),
        "ms": digits(np.median([each["ms"] for each in answers])),
        "reliability": reliability(probability, right),
    }


def reliability(probability: np.ndarray, right: np.ndarray) -> list[dict[str, Any]]:
    """Mean probability and fraction of right answers in each bin."""
    bin_number = np.minimum((probability * BINS).astype(int), BINS - 1)
    rows = []
    for k in range(BINS):
        mine = bin_number == k
        if not mine.any():
            continue
        rows.append(
            {
                "count": int(mine.sum()),
                "stated": digits(probability[mine].mean()),
                "right": digits(right[mine].mean()),
            }
        )
    return rows


def calibration_error(probability: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error: mean of the bins' differences,
    weighted by their counts.
    """
    total = 0.0
    for row in reliability(probability, right):
        total += row["count"] * abs(row["stated"] - row["right"])
    return digits(total / len(right))
