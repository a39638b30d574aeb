r"""How often an answer on degenerate data is wrong and confident: status ok, error above 3 sigma.

    python tools/measure_degenerate.py --seed0 8000 --pairs 40 --out docs/results/degenerate.json

The weak cells of the benchmark (no motion, pure rotation, 1 cm, one plane, everything far away),
and pictures that do not determine the motion of the camera at all (a line of pixels, one small
patch, every pixel on its own, five motions and no world). Each with noise and without, and with a
random stream of its own: kinds that shared one failed together, and their sum said nothing new.

The error is taken as a whole: delta^T C^-1 delta of the six components against the quantile 0.9973
of chi-square with six degrees of freedom (20.06), the ellipsoid that a Gaussian with covariance C
leaves as often as one number leaves its 3 sigma. ``outside`` counts answers of which some single
component is beyond three of its own standard deviations: six of them are six chances, so a perfect
covariance has up to 1.6 % of these.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import zlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

HEIGHT, WIDTH = 436, 1024
METHODS = ("refine", "hybrid")
KINDS = ("line", "patch", "every_pixel_its_own", "five_motions")
FIVE = 5
COUNTS = ("pairs", "ok", "wrong", "outside", "not_finite")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="measure_degenerate.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--pairs", type=int, default=20, help="of each kind, with and without noise"
    )
    parser.add_argument(
        "--seed0", type=int, default=0, help="first seed; 0-999 development, 8000+ published"
    )
    parser.add_argument("--methods", default=",".join(METHODS), help="comma-separated names")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("runs/degenerate.json"))
    parser.add_argument("--overwrite", action="store_true")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import InputError
    from hybridvo.pipeline import check_method

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
        "limit": "status ok and delta^T C^-1 delta above 20.062, chi-square of 6 at 3 sigma; "
        "outside: status ok and a component beyond 3 of its standard deviations",
    } | measure(seeds, methods, args.jobs)
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


def measure(seeds: range, methods: list[str], jobs: int = 1) -> dict[str, Any]:
    """``rows`` (a kind, noise and method each), ``total`` by noise and method with the share of
    wrong answers among the pairs and among those that are ok, ``wrong`` pairs.
    """
    from benchmark_scores import proportion

    from hybridvo.synthetic.scenarios import DEGENERATE_SCENARIOS

    rows, wrong = [], []
    total: dict[str, dict[str, dict[str, Any]]] = {}
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as executor:
        running = [
            executor.submit(measure_kind, kind, noise, seeds, methods)
            for noise in (True, False)
            for kind in (*DEGENERATE_SCENARIOS, *KINDS)
        ]
        for future in running:
            some_rows, some_wrong = future.result()
            rows += some_rows
            wrong += some_wrong
    for row in rows:
        label = "noise" if row["noise"] else "exact"
        sums = total.setdefault(label, {}).setdefault(row["method"], dict.fromkeys(COUNTS, 0))
        for name in COUNTS:
            sums[name] += row[name]
    for sums in (s for by_method in total.values() for s in by_method.values()):
        sums["wrong_of_pairs"] = proportion(sums["wrong"], sums["pairs"])
        sums["wrong_of_ok"] = proportion(sums["wrong"], sums["ok"])
    return {"total": total, "rows": rows, "wrong": wrong}


def measure_kind(
    kind: str, noise: bool, seeds: range, methods: list[str]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """One row per method, and the pairs that are wrong and confident."""
    from benchmark_scores import CHI2_6_3SIGMA, normalised_error

    from hybridvo.pipeline import estimate

    wrong = []
    counts = {m: dict.fromkeys(COUNTS, 0) for m in methods}
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
            count["outside"] += bool(ok and not worst_component(found, T_true) < 3.0)
            count["not_finite"] += not (finite and np.isfinite(found.covariance).all())
            if confident:
                wrong.append({"kind": kind, "noise": noise, "seed": seed, "method": method,
                              "nees": error if np.isfinite(error) else None})  # fmt: skip
    facts = {"kind": kind, "noise": noise}
    return [facts | {"method": m} | count for m, count in counts.items()], wrong


def worst_component(found: Any, T_true: np.ndarray) -> float:
    """Largest of the six errors in units of its own standard deviation; inf where it has none."""
    from hybridvo.geometry import invert, se3_log

    delta = se3_log(found.T_curr_prev @ invert(T_true))
    variance = np.diag(found.covariance)
    if not ((variance > 0) & np.isfinite(delta)).all():
        return float("inf")
    return float(np.max(np.abs(delta) / np.sqrt(variance)))


def make(kind: str, seed: int, noise: bool) -> tuple[Any, np.ndarray]:
    """A pair and its true ``T_curr_prev``; for what has no world, that of a camera at rest."""
    from hybridvo.synthetic.scenarios import SCENARIOS, Scenario, make_pair
    from hybridvo.types import Frame, FramePair

    still = kind in KINDS
    cell = Scenario(moving=0.0) if still else SCENARIOS[kind]
    if not noise:
        cell = replace(cell, flow_noise_px=0.0, depth_noise=0.0, outliers=0.0)
    own_stream = np.random.SeedSequence([zlib.crc32(kind.encode()), seed])
    pair, truth = make_pair(cell, int(own_stream.generate_state(1)[0]), HEIGHT, WIDTH)
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
