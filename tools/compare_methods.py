"""Methods beside each other on sequences: same pairs, same flow, same clock, scored against truth.

    python tools/compare_methods.py --sequence DIR [--sequence DIR ...] --out runs/comparison

Frames are read and flow is computed once per pair, two frames are in memory. What is timed is the
estimate from a ``FramePair`` on, without the flow. Writes ``results.json``, ``results.csv``,
``pairs.csv``, ``report.md`` and ``report.html``.
"""

from __future__ import annotations

import argparse
import base64
import html
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

WRITTEN = ("results.json", "results.csv", "pairs.csv", "report.md", "report.html")
PAIR_COLUMNS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
)
ROW_COLUMNS = (
    *("sequence", "method", "flow_source", "depth_source", "pairs", "failed", "r_err_deg", "t_err"),
    *("epe", "epe_l2_px", "rot_err_deg_mean", "rot_err_deg_median", "trans_err_mean"),
    *("trans_err_median", "ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "alignment"),
    *("ms_per_pair_median", "dynamic_fraction"),
)
SHOWN = (
    *("sequence", "method", "flow_source", "failed", "rot_err_deg_median", "trans_err_median"),
    *("epe_l2_px", "ate_rmse", "rpe_trans_rmse", "ms_per_pair_median"),
)
NO_TRUTH = "the sequence has no truth for these frames"


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="compare_methods.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--sequence", action="append", required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--methods", default="all", help="comma-separated; default: all that run")
    parser.add_argument("--flow", choices=("auto", "file", "dis"), default="auto")
    parser.add_argument("--dataset", help="kind of the sequences (default: detected)")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--stop", type=int)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overwrite", action="store_true", help="replace results in --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    try:
        args = build_parser().parse_args(argv)
    except SystemExit as end:
        return int(end.code or 0)
    from hybridvo.errors import HybridVOError, OutputError

    command = ["compare_methods.py", *(sys.argv[1:] if argv is None else argv)]
    try:
        for path in compare(args, command):
            print(path)
    except HybridVOError as error:
        print(f"compare_methods.py: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    except KeyboardInterrupt:
        print("compare_methods.py: interrupted.", file=sys.stderr)
        return 130
    return 0


def compare(args: argparse.Namespace, command: list[str]) -> list[Path]:
    """Run every method on every sequence and write the results; returns what was written."""
    from hybridvo.errors import InputError, OutputError
    from hybridvo.evaluation.report import write_csv, write_json
    from hybridvo.run import check_device, versions
    from hybridvo.trajectory import atomic_write

    check_device(args.device)
    methods, absent = chosen_methods(args.methods)
    present = [name for name in WRITTEN if (args.out / name).exists()]
    if present and not args.overwrite:
        raise InputError(f"{args.out}: holds {', '.join(present)}; pass --overwrite.")
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{args.out}: cannot be written: {error.strerror or error}.") from error
    for name, reason in absent.items():
        print(f"not run: {name}: {reason}", file=sys.stderr)
    rows, pairs, pictures = [], [], []
    for path in args.sequence:
        new_rows, new_pairs, picture = compare_on(path, methods, args)
        rows += new_rows
        pairs += new_pairs
        pictures.append(picture)
    result = {
        "command": command,
        "versions": versions(),
        "machine": {"platform": platform.platform(), "cpus": os.cpu_count()},
        "missing": absent,
        "rows": rows,
    }
    write_json(args.out / "results.json", result)
    write_csv(args.out / "results.csv", rows, ROW_COLUMNS)
    write_csv(args.out / "pairs.csv", pairs, PAIR_COLUMNS)
    for name, text in (("report.md", markdown(result)), ("report.html", page(result, pictures))):
        with atomic_write(args.out / name) as file:
            file.write(text)
    return [args.out / name for name in WRITTEN]


def chosen_methods(text: str) -> tuple[list[str], dict[str, str]]:
    """Methods to run, and of those left out by ``all`` the reasons."""
    from hybridvo.errors import InputError
    from hybridvo.hybrid import METHODS, check_method

    if text != "all":
        names = [name.strip() for name in text.split(",") if name.strip()]
        for name in names:
            check_method(name)
        return list(dict.fromkeys(names)), {}
    runnable, absent = [], {}
    for name in METHODS:
        try:
            check_method(name)
        except InputError as error:
            absent[name] = str(error)
        else:
            runnable.append(name)
    return runnable, absent


def compare_on(
    path: str, methods: list[str], args: argparse.Namespace
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Path | None]:
    """(rows, pair rows, picture) of one sequence."""
    from hybridvo.configuration import RunOptions
    from hybridvo.data.sequence import iter_pairs, open_sequence
    from hybridvo.hybrid import estimate, warm_up
    from hybridvo.run import flow_provider

    options = RunOptions(flow=args.flow, start=args.start, stop=args.stop, stride=args.stride)
    sequence = open_sequence(path, args.dataset)
    scorers = {name: Scorer(sequence, name) for name in methods}
    warm_up()
    range_ = {"start": options.start, "stop": options.stop, "stride": options.stride}
    skipped: list[str] = []
    walk = iter_pairs(
        sequence,
        flow_provider(sequence, options),
        **range_,
        on_error=lambda index, error: skipped.append(f"frame {index}: {error}"),
    )
    for count, pair in enumerate(walk):
        if count == 0:  # the libraries' own first calls are not timed
            for name in methods:
                estimate(pair, method=name, seed=args.seed)
        for name in methods[count % len(methods) :] + methods[: count % len(methods)]:
            scorer = scorers[name]
            started = time.perf_counter()
            motion = estimate(pair, T_last=scorer.T_last, method=name, seed=args.seed)
            scorer.add(pair, motion, 1e3 * (time.perf_counter() - started))
        if (count + 1) % 50 == 0:
            print(f"{sequence.name}: {count + 1} pairs", file=sys.stderr)
    for line in skipped:
        print(f"left out: {sequence.name}: {line}", file=sys.stderr)
    moving = next(iter(scorers.values())).dynamic_fraction() if scorers else None
    rows = [scorer.row(moving) for scorer in scorers.values()]
    print(f"{sequence.name}: {rows[0]['pairs']} pairs, {len(methods)} methods", file=sys.stderr)
    pairs = [row for scorer in scorers.values() for row in scorer.pairs]
    return rows, pairs, draw(sequence, scorers, args.out)


class Scorer:
    """Errors and trajectory of one method on one sequence."""

    def __init__(self, sequence: Any, method: str) -> None:
        self.sequence, self.method = sequence, method
        self.pairs: list[dict[str, Any]] = []
        self.errors: list[dict[str, Any]] = []
        self.poses: dict[int, np.ndarray] = {}
        self.moving: list[float] = []
        self.T_last: np.ndarray | None = None
        self.failed = 0

    def add(self, pair: Any, motion: Any, ms: float) -> None:
        """Score the motion of one pair; a failed one counts as the identity that it carries."""
        from hybridvo.evaluation.metrics import pair_errors
        from hybridvo.trajectory import chain

        prev, curr = pair.prev, pair.curr
        self.failed += not motion.ok
        self.T_last = motion.T_curr_prev if motion.ok else self.T_last
        # after a pair that was left out the pose is held
        last = next(reversed(self.poses.values())) if self.poses else np.eye(4)
        T_world_prev = self.poses.setdefault(prev.index, last)
        self.poses[curr.index] = chain(T_world_prev, motion.T_curr_prev)
        T_true = true_motion(self.sequence, prev.index, curr.index)
        errors: dict[str, Any] = {}
        if T_true is not None and prev.depth is not None:
            cameras = prev.camera, curr.camera
            errors = pair_errors(motion.T_curr_prev, T_true, prev.depth, *cameras)
            self.errors.append(errors)
            self._look_at_movement(pair, T_true)
        self.pairs.append(
            {
                "sequence": self.sequence.name,
                "index": prev.index,
                "method": self.method,
                "flow_source": flow_name(pair.flow_source, pair.flow_is_true),
                "status": str(motion.status),
                "ms": ms,
                **errors,
            }
        )

    def _look_at_movement(self, pair: Any, T_true: np.ndarray) -> None:
        from hybridvo.evaluation.metrics import dynamic_fraction

        if pair.flow_is_true and pair.flow is not None:
            cameras = pair.prev.camera, pair.curr.camera
            share = dynamic_fraction(pair.flow, pair.prev.depth, T_true, *cameras)
            self.moving += [] if share is None else [share]

    def dynamic_fraction(self) -> float | None:
        """Mean share of the pixels that move by themselves; None without true flow."""
        return float(np.mean(self.moving)) if self.moving else None

    def row(self, moving: float | None) -> dict[str, Any]:
        """Line of ``results.json``; what cannot be computed is None with a reason."""
        from hybridvo.evaluation.metrics import evaluate_trajectories, mean_pair_errors

        row = mean_pair_errors(self.errors) | {
            "sequence": self.sequence.name,
            "method": self.method,
            "flow_source": ", ".join(sorted({pair["flow_source"] for pair in self.pairs})) or None,
            "depth_source": self.sequence.depth_source,
            "pairs": len(self.pairs),
            "failed": self.failed,
            "ms_per_pair_median": float(np.median([p["ms"] for p in self.pairs]))
            if self.pairs
            else None,
            "dynamic_fraction": moving,
        }
        reasons = row["reasons"]
        if moving is None:
            reasons["dynamic_fraction"] = (
                "needs true flow (--flow file on synthetic data) and truth"
            )
        est, truth = self.trajectories()
        names = ("ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg")
        row["alignment"] = "se3"
        if truth is None or est is None:
            return (
                row | dict.fromkeys(names) | {"reasons": reasons | dict.fromkeys(names, NO_TRUTH)}
            )
        report = evaluate_trajectories(est, truth)
        reasons |= {name: report["reasons"][name] for name in names if name in report["reasons"]}
        return row | {name: report[name] for name in names}

    def trajectories(self) -> tuple[Any, Any]:
        """(estimate, truth); None where there is none."""
        from hybridvo.run_results import true_trajectory
        from hybridvo.trajectory import Trajectory

        if not self.poses:
            return None, None
        indices = list(self.poses)
        est = Trajectory(self.sequence.timestamps[indices], np.stack(list(self.poses.values())))
        return est, true_trajectory(self.sequence, indices)


def true_motion(sequence: Any, prev: int, curr: int) -> np.ndarray | None:
    """True T_curr_prev, or None where it is not known."""
    from hybridvo.geometry import invert

    if sequence.poses is None:
        return None
    T = invert(sequence.poses[curr]) @ sequence.poses[prev]
    return T if np.isfinite(T).all() else None


def flow_name(source: str, is_true: bool) -> str:
    """Source of the flow; an oracle is named so."""
    return f"{source} (true)" if is_true else source


def draw(sequence: Any, scorers: dict[str, Scorer], out: Path) -> Path | None:
    """Picture of all trajectories of a sequence, or None where there is none to draw."""
    from hybridvo.evaluation.plots import plot_trajectories
    from hybridvo.run import run_name

    found = {name: scorer.trajectories() for name, scorer in scorers.items()}
    found = {name: both for name, both in found.items() if both[0] is not None}
    if not found:
        return None
    path = out / f"{run_name(sequence)}.png"
    truth = next(iter(found.values()))[1]
    estimates = {name: both[0] for name, both in found.items()}
    plot_trajectories(estimates, path, truth=truth, title=sequence.name)
    return path


def markdown(result: dict[str, Any]) -> str:
    """Report as Markdown."""
    from hybridvo.evaluation.report import table_markdown

    table = table_markdown(result["rows"], SHOWN)
    note = (
        "Medians and means over pairs; angles in degrees, lengths in metres. A failed pair counts "
        "as no motion. `(true)` marks ground-truth flow, depth_source `true` ground-truth depth."
    )
    absent = "".join(f"- not run: {k}: {v}\n" for k, v in result["missing"].items())
    command = " ".join(result["command"])
    return f"# Comparison of methods\n\n{table}\n{note}\n\n    {command}\n\n{absent}"


def page(result: dict[str, Any], pictures: list[Path | None]) -> str:
    """Report as one self-contained page."""
    from hybridvo.evaluation.report import table_text

    images = "".join(
        f'<p><img alt="{html.escape(p.stem)}" style="max-width:100%" '
        f'src="data:image/png;base64,{base64.b64encode(p.read_bytes()).decode()}"></p>\n'
        for p in pictures
        if p is not None
    )
    table = html.escape(table_text(result["rows"], SHOWN))
    command = html.escape(" ".join(result["command"]))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        "<title>Comparison of methods</title></head>\n<body>\n<h1>Comparison of methods</h1>\n"
        f"<pre>{table}</pre>\n<p>Angles in degrees, lengths in metres; (true) marks ground-truth "
        f"flow.</p>\n{images}<p><code>{command}</code></p>\n</body></html>\n"
    )


if __name__ == "__main__":
    sys.exit(main())
