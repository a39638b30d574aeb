r"""How often an answer on degenerate data is wrong and confident: status ok, error above 3 sigma.

    python tools/measure_degenerate.py --seed0 7000 --pairs 100 --out docs/results/degenerate.json

The weak cells of the benchmark (no motion, pure rotation, 1 cm, one plane, everything far away),
and pictures that do not determine the motion of the camera at all (a line of pixels, one small
patch, every pixel on its own, five motions and no world). Each with noise and without.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

HEIGHT, WIDTH = 436, 1024
METHODS = ("refine", "hybrid")
KINDS = ("line", "patch", "every_pixel_its_own", "five_motions")
FIVE = 5


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="measure_degenerate.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--pairs", type=int, default=20, help="of each kind, with and without noise"
    )
    parser.add_argument(
        "--seed0", type=int, default=0, help="first seed; 0-999 development, 7000+ published"
    )
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated names")
    parser.add_argument("--out", type=Path, default=Path("runs/degenerate.json"))
    parser.add_argument("--overwrite", action="store_true")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import InputError
    from hybridvo.hybrid import check_method

    methods = args.methods.split(",")
    try:
        for method in methods:
            check_method(method)
    except InputError as error:
        print(f"measure_degenerate.py: {error}", file=sys.stderr)
        return 2
    if args.pairs < 1 or args.seed0 < 0 or (args.out.exists() and not args.overwrite):
        problem = f"{args.out} exists; pass --overwrite" if args.out.exists() else "pairs, seed0"
        print(f"measure_degenerate.py: {problem}.", file=sys.stderr)
        return 2
    seeds = range(args.seed0, args.seed0 + args.pairs)
    result = {
        "command": ["measure_degenerate.py", *(sys.argv[1:] if argv is None else argv)],
        "seeds": [seeds[0], seeds[-1]],
        "size": [HEIGHT, WIDTH],
        "limit": "status ok and delta^T C^-1 delta above 20.062, chi-square of 6 at 3 sigma",
    } | measure(seeds, methods)
    try:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        partial = args.out.with_name(args.out.name + ".tmp")
        partial.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(partial, args.out)
    except OSError as error:
        print(f"measure_degenerate.py: {args.out}: {error}", file=sys.stderr)
        return 5
    print(json.dumps(result["total"]))
    return 0


def measure(seeds: range, methods: list[str]) -> dict[str, Any]:
    """``rows`` (a kind, noise and method each), ``total`` by noise and method, ``wrong`` pairs."""
    from benchmark_scores import CHI2_6_3SIGMA, normalised_error

    from hybridvo.data.benchmark_pairs import DEGENERATE_CELLS
    from hybridvo.hybrid import estimate

    rows, wrong = [], []
    total: dict[str, dict[str, dict[str, int]]] = {}
    for noise in (True, False):
        label = "noise" if noise else "exact"
        for kind in (*DEGENERATE_CELLS, *KINDS):
            counts = {m: {"pairs": 0, "ok": 0, "wrong": 0, "not_finite": 0} for m in methods}
            for seed in seeds:
                pair, T_true = make(kind, seed, noise)
                for method in methods:
                    found, count = estimate(pair, method=method, seed=seed), counts[method]
                    ok = found.status.state.value == "ok"
                    error = normalised_error(found, T_true)
                    finite = np.isfinite(found.T_curr_prev).all()
                    confident = bool(ok and not error < CHI2_6_3SIGMA)
                    count["pairs"] += 1
                    count["ok"] += ok
                    count["wrong"] += confident
                    count["not_finite"] += not (finite and np.isfinite(found.covariance).all())
                    if confident:
                        wrong.append({"kind": kind, "noise": noise, "seed": seed, "method": method,
                                      "nees": error if np.isfinite(error) else None})  # fmt: skip
            for method, count in counts.items():
                rows.append({"kind": kind, "noise": noise, "method": method} | count)
                sums = total.setdefault(label, {}).setdefault(method, dict.fromkeys(count, 0))
                for name, value in count.items():
                    sums[name] += value
    return {"total": total, "rows": rows, "wrong": wrong}


def make(kind: str, seed: int, noise: bool) -> tuple[Any, np.ndarray]:
    """A pair and its true ``T_curr_prev``; for what has no world, that of a camera at rest."""
    from hybridvo.data.benchmark_pairs import CELLS, Cell, make_pair
    from hybridvo.types import Frame, FramePair

    still = kind in KINDS
    cell = Cell(moving=0.0) if still else CELLS[kind]
    if not noise:
        cell = replace(cell, flow_noise_px=0.0, depth_noise=0.0, outliers=0.0)
    pair, truth = make_pair(cell, seed, HEIGHT, WIDTH)
    if not still:
        return pair, truth["T_curr_prev"]
    change: Callable[..., tuple[np.ndarray, np.ndarray]] = CHANGES[kind]
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    depth, flow = change(pair, truth, rng)
    prev = Frame(None, depth, pair.prev.camera, timestamp=0.0, index=0)
    curr = Frame(None, None, pair.curr.camera, timestamp=0.1, index=1)
    own = kind in ("every_pixel_its_own", "five_motions")
    T = np.eye(4) if own else truth["T_curr_prev"]
    return FramePair(prev, curr, flow, flow_source="synthetic", depth_source="synthetic"), T


def _line(pair: Any, truth: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Depth on one line across the picture, three pixels wide."""
    angle, v, u = rng.uniform(0, np.pi), *np.mgrid[0:HEIGHT, 0:WIDTH]
    off = (u - WIDTH / 2) * np.sin(angle) - (v - HEIGHT / 2) * np.cos(angle)
    return np.where(np.abs(off) <= 1.5, pair.prev.depth, np.nan), pair.flow


def _patch(pair: Any, truth: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Depth on 20x20 pixels."""
    top, left = rng.integers(0, HEIGHT - 20), rng.integers(0, WIDTH - 20)
    depth = np.full_like(pair.prev.depth, np.nan)
    inside = np.s_[top : top + 20, left : left + 20]
    depth[inside] = pair.prev.depth[inside]
    return depth, pair.flow


def _own(pair: Any, truth: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Flow of each pixel drawn within 30 px: nothing holds together."""
    return pair.prev.depth, rng.uniform(-30, 30, pair.flow.shape).astype(np.float32)


def _five(pair: Any, truth: Any, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Five upright stripes with a motion each, and a camera at rest: no pixel shows the world."""
    from hybridvo.geometry import ego_flow, se3_exp

    flow = np.empty_like(pair.flow)
    camera, noise = pair.prev.camera, pair.flow - truth["flow_true"]
    limit = np.array([0.3] * 3 + [0.03] * 3)
    for columns in np.array_split(np.arange(WIDTH), FIVE):
        # at least half of the limit, so that none of the five is the camera's rest
        T = se3_exp(rng.uniform(0.5, 1.0, 6) * rng.choice([-1.0, 1.0], 6) * limit)
        flow[:, columns] = ego_flow(truth["depth_true"], T, camera, camera)[:, columns]
    return pair.prev.depth, flow + noise


CHANGES: dict[str, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    "line": _line,
    "patch": _patch,
    "every_pixel_its_own": _own,
    "five_motions": _five,
}


if __name__ == "__main__":
    sys.exit(main())
