"""What the photometric polish adds to the refinement: rendered scenes and the real sequences.

    python tools/measure_polish.py --data ../shared/data --out runs/polish.json

The same pairs and the same DIS flow, refined alone and then polished: end-point error of the ego
flow, rotation, translation, end-point drift of the real sequences, reasons, milliseconds.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

KINDS = ("static", "light", "heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten", "pair")
REAL = (
    "tartanair_v2/P000",
    "tum/redwood_livingroom_5",
    "tum/rgbd_dataset_freiburg1_xyz_first10",
)
PAIRS = (0, 4, 8, 12, 16)
"""Pairs of a rendered sequence that are measured."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="measure_polish.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--seed", type=int, default=100, help="first seed of the scenes")
    parser.add_argument("--scenes", type=int, default=4, help="scenes of each kind")
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    from hybridvo.errors import HybridVOError
    from hybridvo.evaluation.report import write_json
    from hybridvo.hybrid import warm_up
    from hybridvo.run import versions

    given = sys.argv[1:] if argv is None else argv
    if args.out.exists() and not args.overwrite:
        print(f"measure_polish.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    try:
        warm_up("refine", "on")
        rows = [measure(name, pairs) for name, pairs in groups(args)]
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(
            args.out,
            {
                "command": "python tools/measure_polish.py " + shlex.join(given),
                "versions": versions(),
                "rows": rows,
            },
        )
    except HybridVOError as error:
        print(f"measure_polish.py: {error}", file=sys.stderr)
        return 2
    print(args.out)
    return 0


def groups(args: argparse.Namespace) -> Iterator[tuple[str, Iterator[tuple[Any, np.ndarray]]]]:
    """(name, its pairs with their true motions)."""
    from hybridvo.data.sequence import open_sequence
    from hybridvo.data.synthetic import SyntheticSequence, make_scene

    def rendered(kind: str) -> Iterator[tuple[Any, np.ndarray]]:
        for seed in range(args.seed, args.seed + args.scenes * (5 if kind == "pair" else 1)):
            sequence = SyntheticSequence(make_scene(kind, seed))
            yield from pairs_of(sequence, PAIRS if len(sequence) > 2 else (0,))

    for kind in KINDS:
        yield kind, rendered(kind)
    for name in REAL:
        if (args.data / name).exists():
            sequence = open_sequence(args.data / name)
            yield name, pairs_of(sequence, range(len(sequence) - 1))


def pairs_of(sequence: Any, indices: Any) -> Iterator[tuple[Any, np.ndarray]]:
    """Pairs with DIS flow."""
    from hybridvo.flow import dis_flow
    from hybridvo.geometry import invert
    from hybridvo.types import FramePair

    provider = dis_flow()
    for i in indices:
        prev, curr = sequence.frame(i), sequence.frame(i + 1)
        f = provider(prev, curr)
        pair = FramePair(prev, curr, f.flow, f.variance, f.valid, "dis")
        yield pair, invert(sequence.poses[i + 1]) @ sequence.poses[i]


def measure(name: str, pairs: Iterator[tuple[Any, np.ndarray]]) -> dict[str, Any]:
    """Errors before and after."""
    from hybridvo.evaluation.metrics import pair_errors
    from hybridvo.pose.photometric import polish_photometric
    from hybridvo.pose.refinement import refine

    errors: dict[str, list[list[float]]] = {"refine": [], "polished": []}
    end = {key: np.eye(4) for key in ("refine", "polished", "truth")}
    reasons: Counter[str] = Counter()
    wall, work = [], []
    for pair, T in pairs:
        motion = refine(pair)
        started = time.perf_counter(), time.process_time()
        polished = polish_photometric(pair, motion)
        wall.append(1e3 * (time.perf_counter() - started[0]))
        work.append(1e3 * (time.process_time() - started[1]))
        reasons[polished.polish.reason or "taken"] += 1
        end["truth"] = T @ end["truth"]
        for key, found in (("refine", motion), ("polished", polished)):
            end[key] = found.T_curr_prev @ end[key]
            e = pair_errors(
                found.T_curr_prev, T, pair.prev.depth, pair.prev.camera, pair.curr.camera
            )
            errors[key].append([e["epe_l2_px"], e["rot_err_deg"], 100 * e["trans_err"]])
    row: dict[str, Any] = {"name": name, "pairs": len(wall), "reasons": dict(reasons)}
    for key, values in errors.items():
        table = np.array(values)
        row[key] = {
            "epe_px_median": float(np.median(table[:, 0])),
            "epe_px_above_1": float(np.mean(table[:, 0] > 1)),
            "rot_deg_median": float(np.median(table[:, 1])),
            "trans_cm_median": float(np.median(table[:, 2])),
        }
        if "/" in name:
            drift = np.linalg.norm(end[key][:3, 3] - end["truth"][:3, 3])
            row[key]["end_trans_cm"] = 100 * float(drift)
    ratio = np.array(errors["polished"])[:, 0] / np.array(errors["refine"])[:, 0]
    row["epe_ratio_worst"] = float(ratio.max())
    row["epe_ratio_above_1.05"] = float(np.mean(ratio > 1.05))
    row["ms_wall_min"], row["ms_processor_median"] = min(wall), float(np.median(work))
    return row


if __name__ == "__main__":
    sys.exit(main())
