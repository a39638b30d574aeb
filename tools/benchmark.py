r"""Pose solvers beside each other on the synthetic cells: same pairs, same process, same clock.

    python tools/benchmark.py --out runs/benchmark --seed0 1000 \
        --heavy 4 --nees 1000 --kernel --batch

What is timed is the whole call from a ``FramePair`` on, preparation included. Writes
``benchmark.json`` (everything, every pair), ``benchmark.md`` (the tables, with the goals first) and
``benchmark.png``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

HYBRID = "hybrid-flow"
"""Named on its own only (``--methods refine,hybrid-flow``): threads that torch has started once
stay, and the other methods' times would not be what they are without it."""

PACKAGES = ("numpy", "scipy", "opencv-python-headless", "torch", "numba", "poselib", "open3d")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmark.py", description=__doc__.splitlines()[0])
    parser.add_argument("--cells", default="all", help="comma-separated names, 'main' or 'all'")
    parser.add_argument("--methods", default="all", help="comma-separated names, or 'all'")
    parser.add_argument("--pairs", type=int, default=20, help="pairs per cell")
    parser.add_argument(
        "--seed0", type=int, default=0, help="first seed; 0-999 development, 1000+ published"
    )
    parser.add_argument(
        "--heavy", type=int, default=0, metavar="N", help="heavy sequences: N seeds of each kind"
    )
    parser.add_argument(
        "--nees", type=int, default=0, metavar="N", help="normalised error over N pairs"
    )
    parser.add_argument("--kernel", action="store_true", help="one iteration, and the first call")
    parser.add_argument("--batch", action="store_true", help="throughput of refine_batch")
    parser.add_argument("--network", action="store_true", help="inference time of PWVO")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    parser.add_argument("--overwrite", action="store_true", help="replace results in --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from benchmark_report import MID_CELL, markdown

    from hybridvo.evaluation.plots import plot_benchmark
    from hybridvo.synthetic.scenarios import MAIN_SCENARIOS, SCENARIOS

    methods, absent = available_methods()
    groups = {"all": list(SCENARIOS), "main": list(MAIN_SCENARIOS)}
    cells = groups.get(args.cells) or args.cells.split(",")
    chosen = args.methods.split(",")
    if args.methods == "all":
        chosen = [name for name in methods if name != HYBRID]
    for what, given, known in (("cell", cells, SCENARIOS), ("method", chosen, methods)):
        for name in given:
            if name not in known:
                reason = absent.get(name, f"known: {', '.join(known)}")
                return _bad_usage(f"unknown or missing {what} {name!r}: {reason}.")
    for option, value, least in (("--pairs", args.pairs, 1), ("--seed0", args.seed0, 0),
                                 ("--heavy", args.heavy, 0), ("--nees", args.nees, 0)):  # fmt: skip
        if value < least:
            return _bad_usage(f"expected {option} >= {least}, got {value}.")
    if "refine" in absent and (args.heavy or args.nees or args.kernel or args.batch):
        return _bad_usage(f"--heavy, --nees, --kernel and --batch: {absent['refine']}.")
    target = args.out / "benchmark.json"
    if target.exists() and not args.overwrite:
        return _bad_usage(f"{target} exists; pass --overwrite to replace it.")
    for name, reason in absent.items():
        print(f"not run: {name}: {reason}", file=sys.stderr)

    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"benchmark.py: {args.out} cannot be written: {error}", file=sys.stderr)
        return 5
    result = measure(args, {name: methods[name] for name in chosen}, cells)
    result["command"] = ["benchmark.py", *(sys.argv[1:] if argv is None else argv)]
    result["missing"] = absent
    picture = args.out / "benchmark.png"
    try:
        _write(target, json.dumps(result, indent=1, allow_nan=False) + "\n")
        _write(args.out / "benchmark.md", markdown(result, cells, chosen))
        plot_benchmark(result["summary"], picture, time_cell=MID_CELL)
    except OSError as error:
        print(f"benchmark.py: {args.out} cannot be written: {error}", file=sys.stderr)
        return 5
    for path in (target, args.out / "benchmark.md", picture):
        print(path)
    return 0


def measure(
    args: argparse.Namespace, methods: dict[str, Callable[..., Any]], cells: list[str]
) -> dict[str, Any]:
    """Everything that was asked for, each part under its own key; None for what was not."""
    from benchmark_consistency import correlated_nees, run_nees
    from benchmark_costs import peak_memory, run_batch, run_kernel, run_network
    from benchmark_goals import goals
    from benchmark_heavy import run_heavy
    from benchmark_report import MID_CELL

    started = time.perf_counter()

    def progress(line: str) -> None:
        print(f"[{time.perf_counter() - started:4.0f} s] {line}", file=sys.stderr, flush=True)

    # first of all: it has the machine to itself before anything else has started threads
    kernel = run_kernel(MID_CELL, args.seed0) if args.kernel else None
    if kernel is not None:
        progress(f"kernel: {kernel['shipped']['median_ms']:.2f} ms an iteration")
    records = []
    for cell in cells:
        records += run_cell(cell, methods, args.pairs, args.seed0)
        progress(f"{cell}: {args.pairs} pairs, {len(methods)} methods")
    chosen = list(methods)
    summary = summarise(records, cells, chosen)
    memory = peak_memory(methods, MID_CELL, args.seed0)
    progress("memory")
    heavy = run_heavy(args.heavy, args.seed0, progress, HYBRID in methods) if args.heavy else None
    nees = {
        "model": run_nees(args.nees, args.seed0) if args.nees else None,
        "correlated noise": correlated_nees(summary),
    }
    if args.nees:
        progress(f"nees: {args.nees} pairs")
    # last: torch keeps its threads once it has started them
    batch = run_batch(MID_CELL, args.seed0) if args.batch else None
    if batch is not None:
        progress("batch")
    network = run_network() if args.network else None
    if network is not None:
        progress("network")
    result = {
        "seeds": [args.seed0, args.seed0 + args.pairs - 1],
        "machine": machine(),
        "versions": versions(),
        "summary": summary,
        "ratios": ratios(summary, cells, chosen),
        "memory": memory,
        "heavy": heavy,
        "kernel": kernel,
        "batch": batch,
        "network": network,
        "nees": nees,
        "seconds": time.perf_counter() - started,
        "pairs": records,
    }
    return {"goals": goals(result) if "refine" in methods else []} | result


def available_methods() -> tuple[dict[str, Callable[..., Any]], dict[str, str]]:
    """Methods that can run here by name (ours first), and reason and remedy for the others."""
    from functools import partial

    from hybridvo.baselines import pnp as baselines

    methods: dict[str, Callable[..., Any]] = {}
    absent = baselines.missing()
    if importlib.util.find_spec("hybridvo.refinement.refine") is None:
        absent["refine"] = "hybridvo.refinement.refine is not part of this version"
    else:
        from hybridvo.pipeline import refine

        methods["refine"] = refine
        from hybridvo.pipeline import estimate

        methods[HYBRID] = partial(estimate, method=HYBRID)
    for name, estimator in baselines.baselines().items():
        if name == "poselib":
            methods["poselib-2k"] = partial(estimator, points=2000)
        methods[name] = estimator
    for name in ("opencv-rgbd", "open3d-rgbd"):
        if methods.pop(name, None) is not None:
            absent[name] = "aligns images; the benchmark's pairs have none"
    return methods, absent


def run_cell(
    cell: str, methods: dict[str, Callable[..., Any]], pairs: int, seed0: int
) -> list[dict[str, Any]]:
    """One record per pair and method; methods take turns on each pair, in rotating order."""
    from benchmark_scores import score

    from hybridvo.synthetic.scenarios import make_pair

    warm_up, _ = make_pair(cell, seed0 + pairs)
    for method in methods.values():
        method(warm_up)
    records = []
    names = list(methods)
    for k in range(pairs):
        pair, truth = make_pair(cell, seed0 + k)
        for name in names[k % len(names) :] + names[: k % len(names)]:
            start = time.perf_counter()
            result = methods[name](pair)
            ms = 1e3 * (time.perf_counter() - start)
            record = {"cell": cell, "seed": seed0 + k, "method": name, "ms": ms}
            records.append(record | score(result, pair, truth))
    return records


def summarise(
    records: list[dict[str, Any]], cells: list[str], methods: list[str]
) -> dict[str, dict[str, dict[str, Any]]]:
    """summary[cell][method]: quartiles of error and time, failures, containment, hypotheses."""
    from benchmark_scores import is_failure, quartiles

    summary: dict[str, dict[str, dict[str, Any]]] = {}
    for cell in cells:
        summary[cell] = {}
        for method in methods:
            rows = [r for r in records if r["cell"] == cell and r["method"] == method]
            nees = [r["nees"] for r in rows if r["nees"] is not None and r["estimated"]]
            hits = [r["hypothesis_hit"] for r in rows if r["hypothesis_hit"] is not None]
            summary[cell][method] = {
                "pairs": len(rows),
                "epe_px": quartiles([r["epe_px"] for r in rows]),
                "rotation_error_deg": quartiles([r["rotation_error_deg"] for r in rows]),
                "translation_error_m": quartiles([r["translation_error_m"] for r in rows]),
                "ms": quartiles([r["ms"] for r in rows]),
                "failures": sum(is_failure(r) for r in rows),
                "not_estimated": sum(not r["estimated"] for r in rows),
                "contained": sum(r["contained"] for r in rows),
                "nees_mean": float(np.mean(nees)) if nees else None,
                "nees_median": float(np.median(nees)) if nees else None,
                "hypothesis_hits": sum(hits) if hits else None,
            }
    return summary


def ratios(
    summary: dict[str, dict[str, dict[str, Any]]], cells: list[str], methods: list[str]
) -> dict[str, Any]:
    """``refine`` over each other method: error (geometric mean over the main cells) and time."""
    from benchmark_report import MID_CELL

    from hybridvo.synthetic.scenarios import MAIN_SCENARIOS

    shared = [cell for cell in cells if cell in MAIN_SCENARIOS]
    means = {m: _geometric([summary[c][m]["epe_px"]["median"] for c in shared]) for m in methods}
    table: dict[str, Any] = {"cells": shared, "geometric_mean_epe_px": means, "refine_over": {}}
    ours = means.get("refine")
    if ours is not None:
        for method, mean in means.items():
            if method == "refine" or mean is None:
                continue
            row: dict[str, Any] = {"error": ours / mean, "time": None}
            # the zero-motion predictor spends nothing: a time ratio says nothing
            if MID_CELL in cells and method != "identity":
                mid = summary[MID_CELL]
                row["time"] = mid["refine"]["ms"]["median"] / mid[method]["ms"]["median"]
            table["refine_over"][method] = row
    return table


def machine() -> dict[str, Any]:
    """Processor, cores and load: times of a shared machine are to be read as ratios."""
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "load_average": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
    }


def versions() -> dict[str, str | None]:
    """Versions of everything that is compared; None where it is not installed."""
    from hybridvo import __version__

    found: dict[str, str | None] = {"hybridvo": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    return found


def _geometric(values: list[float]) -> float | None:
    return float(np.exp(np.mean(np.log(np.maximum(values, 1e-12))))) if values else None


def _write(path: Path, text: str) -> None:
    """Whole file or none: a reader never sees half a result."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def _bad_usage(message: str) -> int:
    print(f"benchmark.py: {message}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
