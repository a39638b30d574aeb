"""The right motion on real surfaces, and whether the stated probability can be believed.

    python tools/benchmark_semi_real.py --pairs 160 --out docs/results/semi_real.json
    python tools/benchmark_semi_real.py --split development --methods hybrid-flow --ablation
    python tools/benchmark_semi_real.py --pairs 0 --clips 120 --methods hybrid,hybrid-flow

Pairs of :mod:`hybridvo.synthetic.semi_real` on DIS flow, drawn from fixed seeds. An answer is wrong
when its ego flow over the static pixels errs by more than 3 px; or by more than 1 px and more than
three times as much as ``refine`` does inside the true static mask. Clips are tracked from their
first frame to the last, and each of their pairs is asked about alone.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from measuring import (
    digits,
    ego_flow_error,
    parser_of,
    proportion,
    provenance,
    timed,
)

from hybridvo import Odometry, Options, estimate, refine
from hybridvo.files import write_json
from hybridvo.network.models import Models
from hybridvo.options import TrackOptions
from hybridvo.synthetic.semi_real import draw_clip, load_split
from hybridvo.training.validation import area_under_curve

METHODS = ("classical", "hybrid-flow", "poselib")
ABLATION = ("images", "second depth", "PWVO", "fits in its masks")
"""What ``hybrid-flow`` has to do without, one at a time."""
WRONG_PX = 1.0
WRONG_FACTOR = 3.0
MOST_PX = 3.0
LEAST_MOVING = 0.2
"""Share of the image that moves at least where anything does."""
CLIP = 10
"""Frames of a clip."""
BINS = 10
"""Bins of the stated probability for its calibration error."""
SEEDS = {"train": 1, "development": 2, "test": 3}
"""First word of the seed of every pair."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--pairs", type=int, default=160)
    add("--clips", type=int, default=0, help=f"of {CLIP} frames, to be tracked")
    add("--split", default="test", choices=SEEDS)
    add("--methods", default=",".join(METHODS))
    add(
        "--selector",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="a row of other weights",
    )
    add("--ablation", action="store_true", help="rows without parts of the method")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    recordings = load_split(args.data, args.split)
    methods = competitors(args)
    rows = measure(
        (draw(args.split, k, recordings) for k in range(args.pairs)), methods
    )
    names = args.methods.split(",")
    both = {name: methods[name] for name in names}
    both |= {f"{name} tracked": tracker(name) for name in names}
    if args.ablation:
        both |= {
            f"{name} tracked without prior": tracker(name, False) for name in names
        }
    steps = measure(chain.from_iterable(clips(args, recordings)), both)
    result = provenance("benchmark_semi_real.py", argv) | {
        "split": args.split,
        "recordings": {r.source.path: len(r.frames) for r in recordings},
        "pairs": len(rows),
        "with_movers": sum(row["moving"] > 0 for row in rows),
        "summary": {method: summarise(rows, method) for method in methods if rows},
        "clips": args.clips,
        "steps": {method: summarise(steps, method) for method in both if steps},
    }
    for method, row in (result["summary"] | result["steps"]).items():
        print(method, {k: v for k, v in row.items() if k != "reliability"})
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(args.out, result)
    return 0


def competitors(args: argparse.Namespace) -> dict[str, Callable[[Any], Any]]:
    """What is measured, by name: from a pair to its motion."""

    def without(part: str, pair: Any) -> Any:
        select = Options().select
        if part == "images":
            prev, curr = (
                replace(frame, rgb=None) for frame in (pair.prev, pair.curr)
            )
            pair = replace(pair, prev=prev, curr=curr)
        elif part == "second depth":
            pair = replace(pair, curr=replace(pair.curr, depth=None))
        elif part == "PWVO":
            select = replace(select, min_probability=0)
        else:
            select = replace(select, refits=0)
        return estimate(pair, method="hybrid-flow", options=Options(select=select))

    found = {
        name: partial(estimate, method=name) for name in args.methods.split(",")
    }
    for text in args.selector:
        name, _, file = text.partition("=")
        models = Models(weights={"selector": file})
        found[f"selector {name}"] = partial(
            estimate, method="hybrid-flow", models=models
        )
    if args.ablation:
        found |= {f"without {part}": partial(without, part) for part in ABLATION}
    return found


def tracker(method: str, motion_prior: bool = True) -> Callable[[Any], Any]:
    """A tracker that is handed a clip pair by pair, and begins anew where another clip does."""
    options = Options(track=TrackOptions(motion_prior=motion_prior))
    odometry = Odometry(method=method, options=options)
    frame = None
    pose = np.eye(4)

    def solve(pair: Any) -> Any:
        nonlocal frame, pose
        if pair.prev is not frame:
            odometry.reset()
            pose = odometry.track(pair.prev).T_world_cam
        step = odometry.track(pair.curr)
        last = pose
        frame = pair.curr
        pose = step.T_world_cam
        return step.motion.replace(T_curr_prev=np.linalg.inv(pose) @ last)

    return solve


def measure(
    drawn_pairs: Iterable[Any], methods: dict[str, Callable[[Any], Any]]
) -> list[Any]:
    """Errors, statuses and probabilities of every method on every pair."""
    rows = []
    for drawn in drawn_pairs:
        pair = drawn.pair
        T = drawn.T_curr_prev
        depth, limit = static_part(drawn)
        usable = pair.flow_valid & (pair.prev.depth > 0)
        row: dict[str, Any] = {
            "world": drawn.world,
            "moving": digits(drawn.moving.mean()),
            "static_usable": digits(
                (usable & ~drawn.moving).sum() / max(usable.sum(), 1)
            ),
            "oracle_px": digits(limit),
        }
        for method, solve in methods.items():
            motion, ms = timed(partial(solve, pair))
            error = ego_flow_error(motion.T_curr_prev, T, depth, pair)
            others = [
                ego_flow_error(h.T_curr_prev, T, depth, pair)
                for h in motion.hypotheses
            ]
            row[method] = {
                "px": digits(error),
                "best_px": digits(min([error, *others])),
                "wrong": bool(error > allowed(limit)),
                "status": motion.status.state.value,
                "reason": motion.status.reason.value,
                "probability": digits(motion.probability),
                "ms": digits(ms),
            }
        rows.append(row)
    return rows


def allowed(oracle_px: float) -> float:
    """Error in px up to which an answer is right."""
    return max(WRONG_PX, min(WRONG_FACTOR * oracle_px, MOST_PX))


def static_part(drawn: Any) -> tuple[np.ndarray, float]:
    """Depth (H, W) of the static pixels, and the error in px of ``refine`` on them alone."""
    depth = np.where(drawn.moving, 0, drawn.depth)
    told = refine(drawn.pair, weights=(~drawn.moving).astype(np.float32))
    return depth, ego_flow_error(
        told.T_curr_prev, drawn.T_curr_prev, depth, drawn.pair
    )


def draw(split: str, number: int, recordings: Any, **shares: float) -> Any:
    """A pair in which nothing moves, every eighth, or :data:`LEAST_MOVING` of the image does."""
    for attempt in count():
        rng = np.random.default_rng([SEEDS[split], number, attempt])
        movers = 0 if number % 8 == 0 else int(rng.integers(1, 5))
        (drawn,) = draw_clip(rng, recordings, movers, **shares)
        if movers == 0 or drawn.moving.mean() > LEAST_MOVING:
            return drawn


def clips(args: argparse.Namespace, recordings: Any) -> Iterator[list[Any]]:
    """The pairs of each clip."""
    for k in range(args.clips):
        rng = np.random.default_rng([SEEDS[args.split], k, 0, CLIP])
        yield draw_clip(rng, recordings, 1 + k % 4, frames=CLIP)


def summarise(rows: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """Shares of wrong answers, and how far the probability and the status tell them."""
    of = [row[method] for row in rows]
    wrong = np.array([row["wrong"] for row in of])
    moving = np.array([row["moving"] > 0 for row in rows])
    world = np.array([row["static_usable"] > 0.5 for row in rows])
    ok = np.array([row["status"] == "ok" for row in of])
    best = [
        row["best_px"] > allowed(r["oracle_px"])
        for row, r in zip(of, rows, strict=True)
    ]
    probability = np.array([row["probability"] for row in of])

    def share(what: np.ndarray, among: np.ndarray) -> dict[str, Any]:
        return proportion(int((what & among).sum()), int(among.sum()))

    return {
        "wrong": share(wrong, moving),
        "wrong_world_majority": share(wrong, moving & world),
        "wrong_static": share(wrong, ~moving),
        "wrong_best_hypothesis": share(np.array(best), moving),
        "right_not_ok": share(~ok, ~wrong & moving),
        "right_not_ok_static": share(~ok, ~wrong & ~moving),
        "wrong_ok": share(ok, wrong),
        "median_px_right": digits(
            np.median([r["px"] for r in of if not r["wrong"]] or [0])
        ),
        "auroc": area_under_curve(probability, ~wrong),
        "ece": calibration_error(probability, ~wrong),
        "ms": digits(np.median([row["ms"] for row in of])),
        "reliability": reliability(probability, ~wrong),
    }


def reliability(probability: np.ndarray, right: np.ndarray) -> list[dict[str, Any]]:
    """Mean probability and share of right answers in each bin."""
    number = np.minimum((probability * BINS).astype(int), BINS - 1)
    rows = []
    for k in range(BINS):
        mine = number == k
        if mine.any():
            stated = digits(probability[mine].mean())
            true = digits(right[mine].mean())
            rows.append({"count": int(mine.sum()), "stated": stated, "right": true})
    return rows


def calibration_error(probability: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error: mean gap of the bins, by their counts."""
    rows = reliability(probability, right)
    return digits(
        sum(r["count"] * abs(r["stated"] - r["right"]) for r in rows) / len(right)
    )


if __name__ == "__main__":
    sys.exit(main())
