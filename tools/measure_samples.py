"""Errors of each pair of the real sequences under ../shared/data, for the README.

    python tools/measure_samples.py --data ../shared/data --out docs/results/real_samples.json

Refinement, OpenCV's PnP-RANSAC (tuned, and with its defaults) and no motion at all, on the flow
files where there are any and on OpenCV DIS. True flow is named so.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

SEQUENCES = (
    "tartanair_v2/P000",
    "tum/redwood_livingroom_5",
    "tum/rgbd_dataset_freiburg1_xyz_first10",
)
METHODS = ("hybrid", "refine", "pnp-ransac-tuned", "pnp-ransac", "identity")
ROUNDED = 7
"""Significant digits that are kept: float32 inputs carry no more."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="measure_samples.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    parser.add_argument("--out", type=Path, default=Path("docs/results/real_samples.json"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.commands.inputs import versions
    from hybridvo.errors import HybridVOError, OutputError
    from hybridvo.evaluation.report import write_json

    given = sys.argv[1:] if argv is None else argv
    try:
        if args.out.exists() and not args.overwrite:
            print(f"measure_samples.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
            return 2
        rows = [row for name in SEQUENCES for row in measure(args.data, name, args.seed)]
        try:
            args.out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{args.out.parent}: {error.strerror or error}.") from error
        result = {
            "command": "python tools/measure_samples.py " + shlex.join(given),
            "versions": versions(),
            "machine": machine(),
            "rows": rows,
        }
        write_json(args.out, result)
    except HybridVOError as error:
        print(f"measure_samples.py: {error}", file=sys.stderr)
        return 5 if isinstance(error, OutputError) else 2
    print(args.out)
    return 0


def measure(data: Path, name: str, seed: int) -> list[dict[str, Any]]:
    """One row per flow source and method."""
    from hybridvo.data.sequence import open_sequence
    from hybridvo.flow import dis_flow, file_flow

    sequence = open_sequence(data / name)
    flows = {"file": file_flow(sequence)} if sequence.has_flow else {}
    rows = []
    for flow in (*flows, "dis"):
        provider = flows.get(flow) or dis_flow()
        rows += measure_on(sequence, provider, flow, name, seed)
        print(f"{name}: {flow}", file=sys.stderr)
    return rows


def measure_on(
    sequence: Any, provider: Any, flow: str, name: str, seed: int
) -> list[dict[str, Any]]:
    """Errors of all methods on the same pairs."""
    from hybridvo.data.sequence import iter_pairs
    from hybridvo.evaluation.pair_errors import pair_errors
    from hybridvo.geometry import invert, rotation_angle
    from hybridvo.pipeline import estimate, warm_up

    warm_up()
    pairs: dict[str, list[dict[str, Any]]] = {method: [] for method in METHODS}
    end = {method: np.eye(4) for method in METHODS}
    last: dict[str, np.ndarray | None] = dict.fromkeys(METHODS)
    for pair in iter_pairs(sequence, provider):
        i = pair.prev.index
        T_true = invert(sequence.poses[i + 1]) @ sequence.poses[i]
        for method in METHODS:
            started = time.perf_counter()
            motion = estimate(pair, T_last=last[method], method=method, seed=seed)
            ms = 1e3 * (time.perf_counter() - started)
            last[method] = motion.T_curr_prev if motion.ok else last[method]
            end[method] = motion.T_curr_prev @ end[method]
            errors = pair_errors(
                motion.T_curr_prev, T_true, pair.prev.depth, pair.prev.camera, pair.curr.camera
            )
            pairs[method].append(
                {
                    "index": i,
                    "status": str(motion.status),
                    "rot_err_deg": digits(errors["rot_err_deg"]),
                    "trans_err_cm": digits(100 * (errors["trans_err"] or 0.0)),
                    "epe_l2_px": digits(errors["epe_l2_px"]),
                    "ms": round(ms, 2),
                }
            )
    T_last_first = invert(sequence.poses[-1]) @ sequence.poses[0]
    rows = []
    for method in METHODS:
        error = end[method] @ invert(T_last_first)
        rows.append(
            {
                "sequence": name,
                "flow_source": f"{flow} (true)"
                if flow == "file" and sequence.flow_is_true
                else flow,
                "depth_source": sequence.depth_source,
                "method": method,
                "pairs": len(pairs[method]),
                "failed": sum(p["status"].startswith("failed") for p in pairs[method]),
                **{
                    f"{key}_median": digits(float(np.median([p[key] for p in pairs[method]])))
                    for key in ("rot_err_deg", "trans_err_cm", "epe_l2_px", "ms")
                },
                "end_rot_err_deg": digits(float(np.degrees(rotation_angle(error[:3, :3])))),
                "end_trans_err_cm": digits(
                    100 * float(np.linalg.norm(end[method][:3, 3] - T_last_first[:3, 3]))
                ),
                "per_pair": pairs[method],
            }
        )
    return rows


def digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.{ROUNDED}g}")


def machine() -> str:
    """Processor and number of cores."""
    import os
    import platform

    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return f"{model}, {os.cpu_count()} cores"


if __name__ == "__main__":
    sys.exit(main())
