"""Pose solvers beside each other on the synthetic cells: same pairs, same process, same clock.

    python tools/benchmark.py --out runs/benchmark --seed0 1000

What is timed is the whole call from a ``FramePair`` on, preparation included. Writes
``benchmark.json`` (everything, every pair) and ``benchmark.md`` (the tables).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import resource
import sys
import time
import tracemalloc
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

CHI2_6_3SIGMA = 20.062
"""Quantile 0.9973 of chi-square with six degrees of freedom: the 3 sigma ellipsoid."""

MID_CELL = "moving30"
FAILURE_PX = 1.0
PACKAGES = ("numpy", "scipy", "opencv-python-headless", "torch", "numba", "poselib", "open3d")


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="benchmark.py", description=__doc__.splitlines()[0])
    parser.add_argument("--cells", default="all", help="comma-separated names, 'main' or 'all'")
    parser.add_argument("--methods", default="all", help="comma-separated names, or 'all'")
    parser.add_argument("--pairs", type=int, default=20, help="pairs per cell")
    parser.add_argument(
        "--seed0", type=int, default=0, help="first seed; 0-999 development, 1000+ published"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    parser.add_argument("--overwrite", action="store_true", help="replace results in --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.data.benchmark_pairs import CELLS, MAIN_CELLS

    methods, absent = available_methods()
    groups = {"all": list(CELLS), "main": list(MAIN_CELLS)}
    cells = groups.get(args.cells) or args.cells.split(",")
    chosen = list(methods) if args.methods == "all" else args.methods.split(",")
    for what, given, known in (("cell", cells, CELLS), ("method", chosen, methods)):
        for name in given:
            if name not in known:
                reason = absent.get(name, f"known: {', '.join(known)}")
                return _bad_usage(f"unknown or missing {what} {name!r}: {reason}.")
    if args.pairs < 1 or args.seed0 < 0:
        return _bad_usage(
            f"expected --pairs >= 1 and --seed0 >= 0, got {args.pairs} and {args.seed0}."
        )
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
    records = []
    for cell in cells:
        records += run_cell(cell, {name: methods[name] for name in chosen}, args.pairs, args.seed0)
        print(f"{cell}: {args.pairs} pairs, {len(chosen)} methods", file=sys.stderr)
    summary = summarise(records, cells, chosen)
    result = {
        "command": ["benchmark.py", *(sys.argv[1:] if argv is None else argv)],
        "seeds": [args.seed0, args.seed0 + args.pairs - 1],
        "machine": machine(),
        "versions": versions(),
        "missing": absent,
        "summary": summary,
        "ratios": ratios(summary, cells, chosen),
        "memory": peak_memory({name: methods[name] for name in chosen}, args.seed0),
        "pairs": records,
    }
    try:
        _write(target, json.dumps(result, indent=1, allow_nan=False) + "\n")
        _write(args.out / "benchmark.md", markdown(result, cells, chosen))
    except OSError as error:
        print(f"benchmark.py: {args.out} cannot be written: {error}", file=sys.stderr)
        return 5
    print(target)
    print(args.out / "benchmark.md")
    return 0


def available_methods() -> tuple[dict[str, Callable[..., Any]], dict[str, str]]:
    """Methods that can run here by name (ours first), and reason and remedy for the others."""
    from functools import partial

    from hybridvo.pose import baselines

    methods: dict[str, Callable[..., Any]] = {}
    absent = baselines.missing()
    if importlib.util.find_spec("hybridvo.pose.refinement") is None:
        absent["refine"] = "hybridvo.pose.refinement is not part of this version"
    else:
        from hybridvo.pose.refinement import refine

        methods["refine"] = refine
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
    from hybridvo.data.benchmark_pairs import make_pair

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


def score(result: Any, pair: Any, truth: dict[str, Any]) -> dict[str, Any]:
    """Errors of one answer against the truth; a failed one is the identity that it carries."""
    from hybridvo.geometry import invert, rotation_angle, se3_log

    T, T_true = result.T_curr_prev, truth["T_curr_prev"]
    error = T @ invert(T_true)
    delta = se3_log(error)
    try:
        nees = float(delta @ np.linalg.solve(result.covariance, delta))
    except np.linalg.LinAlgError:
        nees = float("inf")
    hit = [epe(h.T_curr_prev, pair, truth) < FAILURE_PX for h in result.hypotheses]
    return {
        "status": str(result.status),
        "estimated": bool(result.ok),
        "epe_px": epe(T, pair, truth),
        "rotation_error_deg": float(np.rad2deg(rotation_angle(error[:3, :3]))),
        "translation_error_m": float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])),
        "nees": nees if np.isfinite(nees) else None,
        "contained": bool(nees < CHI2_6_3SIGMA),
        "inlier_ratio": float(result.inlier_ratio),
        "hypotheses": len(hit),
        "hypothesis_hit": any(hit) if hit else None,
    }


def epe(T: np.ndarray, pair: Any, truth: dict[str, Any]) -> float:
    """Mean L2 end-point error (px, native size) of the ego flow of ``T`` over the true depth.

    Every second pixel each way: the field is smooth within a surface. A point that a wrong motion
    puts behind the camera counts as an error of one image width.
    """
    prev, curr = pair.prev.camera, pair.curr.camera
    depth = truth["depth_true"][::2, ::2].astype(np.float64)
    x = (np.arange(0, prev.width, 2) - prev.cx) / prev.fx * depth
    y = (np.arange(0, prev.height, 2)[:, None] - prev.cy) / prev.fy * depth

    def seen(M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        X, Y, Z = (row[0] * x + row[1] * y + row[2] * depth + row[3] for row in M[:3])
        Z = np.where(Z > 1e-6, Z, np.nan)
        return curr.fx * X / Z, curr.fy * Y / Z, Z

    u, v, _ = seen(T)
    u_true, v_true, z_true = seen(truth["T_curr_prev"])
    error = np.hypot(u - u_true, v - v_true)[np.isfinite(z_true)]
    return float(np.minimum(np.nan_to_num(error, nan=curr.width), curr.width).mean())


def summarise(
    records: list[dict[str, Any]], cells: list[str], methods: list[str]
) -> dict[str, dict[str, dict[str, Any]]]:
    """summary[cell][method]: quartiles of error and time, failures, containment, hypotheses."""
    summary: dict[str, dict[str, dict[str, Any]]] = {}
    for cell in cells:
        summary[cell] = {}
        for method in methods:
            rows = [r for r in records if r["cell"] == cell and r["method"] == method]
            nees = [r["nees"] for r in rows if r["nees"] is not None and r["estimated"]]
            hits = [r["hypothesis_hit"] for r in rows if r["hypothesis_hit"] is not None]
            summary[cell][method] = {
                "pairs": len(rows),
                "epe_px": _quartiles([r["epe_px"] for r in rows]),
                "rotation_error_deg": _quartiles([r["rotation_error_deg"] for r in rows]),
                "translation_error_m": _quartiles([r["translation_error_m"] for r in rows]),
                "ms": _quartiles([r["ms"] for r in rows]),
                "failures": sum(_is_failure(r) for r in rows),
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
    from hybridvo.data.benchmark_pairs import MAIN_CELLS

    shared = [cell for cell in cells if cell in MAIN_CELLS]
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


def peak_memory(methods: dict[str, Callable[..., Any]], seed0: int) -> dict[str, Any]:
    """Extra memory of one call on the mid cell: what Python's allocators saw at most, MiB.

    Memory that a C++ library takes from the system is not seen; the process's high-water mark is
    given beside it.
    """
    from hybridvo.data.benchmark_pairs import make_pair

    pair, _ = make_pair(MID_CELL, seed0)
    peaks: dict[str, Any] = {}
    for name, method in methods.items():
        tracemalloc.start()
        try:
            method(pair)
            peaks[name] = tracemalloc.get_traced_memory()[1] / 2**20
        finally:
            tracemalloc.stop()
    return {
        "traced_peak_mib": peaks,
        "process_peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
    }


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


def markdown(result: dict[str, Any], cells: list[str], methods: list[str]) -> str:
    """The tables for people; every number comes from the JSON."""
    summary = result["summary"]
    first, last = result["seeds"]
    lines = [
        "# Pose solvers on the synthetic cells",
        "",
        f"{last - first + 1} pairs a cell, seeds {first}-{last}; {result['machine']['processor']}, "
        f"{result['machine']['cores']} cores, load {result['machine']['load_average']}. "
        "Medians; times are whole calls from the FramePair on.",
        "",
        "## Error of the ego flow over true depth, px [failures: above 1 px, or no answer]",
        "",
        *_table(cells, methods, lambda c, m: _error_cell(summary[c][m])),
        "",
        "## Time, ms (quartiles)",
        "",
        *_table(cells, methods, lambda c, m: _spread(summary[c][m]["ms"], 2)),
        "",
        "## Error inside the 3 sigma ellipsoid of the covariance, per cent (mean NEES, ideal 6)",
        "",
        *_table(cells, methods, lambda c, m: _containment_cell(summary[c][m])),
        "",
    ]
    if any(summary[c][m]["hypothesis_hits"] is not None for c in cells for m in methods):
        with_any = [m for m in methods if summary[cells[0]][m]["hypothesis_hits"] is not None]
        lines += ["## Pairs whose true motion is among the hypotheses", ""]
        lines += _table(
            cells,
            with_any,
            lambda c, m: f"{summary[c][m]['hypothesis_hits']}/{summary[c][m]['pairs']}",
        )
        lines.append("")
    if result["ratios"]["refine_over"]:
        lines += [
            "## `refine` over each method",
            "",
            f"Error: geometric mean of the medians over {', '.join(result['ratios']['cells'])}. "
            f"Time: medians in {MID_CELL}.",
            "",
            "| against | error | time |",
            "|---|---|---|",
        ]
        for method, row in result["ratios"]["refine_over"].items():
            ratio = "" if row["time"] is None else f"{row['time']:.3f}"
            lines.append(f"| {method} | {row['error']:.3f} | {ratio} |")
        lines.append("")
    lines += ["## Extra memory of one call, MiB (Python's allocators)", ""]
    lines += [f"- {m}: {v:.1f}" for m, v in result["memory"]["traced_peak_mib"].items()]
    lines += ["", "## Versions", ""]
    lines += [f"- {name}: {value}" for name, value in result["versions"].items() if value]
    lines += [f"- not run: {name}: {reason}" for name, reason in result["missing"].items()]
    return "\n".join(lines) + "\n"


def _is_failure(record: dict[str, Any]) -> bool:
    """Wrong by more than a pixel, or no answer at all."""
    return record["epe_px"] > FAILURE_PX or not record["estimated"]


def _table(cells: list[str], methods: list[str], entry: Callable[[str, str], str]) -> list[str]:
    rows = ["| method | " + " | ".join(cells) + " |", "|---|" + "---|" * len(cells)]
    return rows + [f"| {m} | " + " | ".join(entry(c, m) for c in cells) + " |" for m in methods]


def _error_cell(row: dict[str, Any]) -> str:
    failures = f" [{row['failures']}]" if row["failures"] else ""
    return f"{_spread(row['epe_px'], 3)}{failures}"


def _containment_cell(row: dict[str, Any]) -> str:
    nees = "" if row["nees_mean"] is None else f" ({row['nees_mean']:.3g})"
    return f"{100 * row['contained'] / row['pairs']:.0f}{nees}"


def _spread(row: dict[str, float], digits: int) -> str:
    return f"{row['median']:.{digits}f} ({row['q25']:.{digits}f}-{row['q75']:.{digits}f})"


def _quartiles(values: list[float]) -> dict[str, float]:
    q25, median, q75 = np.percentile(values, [25, 50, 75])
    return {"median": float(median), "q25": float(q25), "q75": float(q75), "max": max(values)}


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
