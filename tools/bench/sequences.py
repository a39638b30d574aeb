"""The default method on whole sequences: paths, failures, and whether
its probability is right.

    python tools/benchmark.py sequences --out docs/results/sequences.json --overwrite

Each method tracks rendered sequences in which about 60 % of every image moves,
from the first frame to the last, as a user would; depth is the renderer's,
flow is DIS and, as an oracle, the true one. Then: how often a motion of some
stated probability is right.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from known_pairs import HEAVY, SIZE, rendered, scene_flow
from measuring import (
    digits,
    methods_here,
    parser_of,
    provenance,
    score,
    summarise,
    timed,
    write_result,
)

from bench.semi_real import reliability

METHODS = {
    "dis": (
        "hybrid",
        "hybrid-flow",
        "classical",
        "pwvo",
        "pnp-ransac-tuned",
        "poselib",
    ),
    "true": ("hybrid-flow", "classical", "pwvo", "pnp-ransac-tuned", "poselib"),
}
"""Methods by flow; images add nothing to a true flow."""
WITH_PROBABILITY = ("hybrid", "hybrid-flow")
"""Methods that state a probability."""


class Run(NamedTuple):
    """A method on a flow."""

    flow: str
    method: str


class Tracked(NamedTuple):
    """A run on one sequence."""

    rmse_cm: float  # root mean square error of the position
    records: list[dict[str, Any]]  # score of every step


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--kinds", default=",".join(HEAVY), help="families of scenes")
    add("--sequences", type=int, default=1, help="of each family")
    add("--frames", type=int, default=100, help="of a sequence")
    add("--seed0", type=int, default=9000, help="0-999 development, else published")
    add("--out", type=Path, default=Path("runs/sequences.json"), metavar="FILE")
    add("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)

    def made() -> dict[str, Any]:
        return provenance("benchmark.py sequences", argv) | measure(args)

    return write_result("benchmark.py sequences", args.out, args.overwrite, made)


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Figures by flow, method and family, and the probability's reliability."""
    kinds = args.kinds.split(",")
    runs = [
        Run(flow, method)
        for flow, names in METHODS.items()
        for method in methods_here(names).ready
    ]
    tracked: dict[Run, dict[str, list[Tracked]]] = {
        run: {kind: [] for kind in kinds} for run in runs
    }
    for kind in kinds:
        for seed in range(args.seed0, args.seed0 + args.sequences):
            sequence = rendered(kind, seed, SIZE, args.frames)
            for run, result in track(sequence, runs).items():
                tracked[run][kind].append(result)
            print(f"{kind}, seed {seed}", file=sys.stderr, flush=True)

    paths: dict[str, dict[str, Any]] = {flow: {} for flow in METHODS}
    pairs: dict[str, dict[str, Any]] = {flow: {} for flow in METHODS}
    probability: dict[str, dict[str, Any]] = {flow: {} for flow in METHODS}
    for (flow, method), by_kind in tracked.items():
        paths[flow][method] = {
            kind: {"rmse_cm": digits(np.mean([each.rmse_cm for each in results]))}
            for kind, results in by_kind.items()
        }
        records = [
            record
            for results in by_kind.values()
            for each in results
            for record in each.records
        ]
        pairs[flow][method] = summarise(records)
        if method in WITH_PROBABILITY:
            probability[flow][method] = probability_figures(records)
    return {
        "kinds": kinds,
        "seeds": [args.seed0, args.seed0 + args.sequences - 1],
        "frames": args.frames,
        "size": list(SIZE),
        "depth": "true (oracle)",
        "missing": methods_here(METHODS["dis"]).missing,
        "paths": paths,
        "pairs": pairs,
        "probability": probability,
    }


def track(sequence: Any, runs: list[Run]) -> dict[Run, Tracked]:
    """Track a sequence by every run; the trackers of a flow share its fields."""
    from hybridvo import FramePair, Odometry
    from hybridvo.flow.providers import dis_flow

    providers = {"dis": dis_flow(), "true": scene_flow(sequence)}
    trackers = {run: Odometry(method=run.method) for run in runs}
    records: dict[Run, list[Any]] = {run: [] for run in runs}
    places: dict[Run, list[np.ndarray]] = {run: [] for run in runs}
    prev = None
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        fields = {}
        if prev is not None:
            fields = {flow: give(prev, frame) for flow, give in providers.items()}
        for run, tracker in trackers.items():
            field = fields.get(run.flow)
            step, ms = timed(partial(tracker.track, frame, field))
            places[run].append(step.T_world_cam[:3, 3])
            if prev is None:
                continue
            T = np.linalg.inv(sequence.poses[i]) @ sequence.poses[i - 1]
            pair = FramePair(prev, frame, None)
            record = score(step.motion, T, prev.depth, pair)
            record["ms"] = ms
            record["probability"] = step.motion.probability
            records[run].append(record)
        prev = frame

    truth = (np.linalg.inv(sequence.poses[0]) @ sequence.poses)[:, :3, 3]
    result = {}
    for run in runs:
        error = np.linalg.norm(np.array(places[run]) - truth, axis=1)
        rmse_cm = 100 * float(np.sqrt(np.mean(error**2)))
        result[run] = Tracked(rmse_cm, records[run])
    return result


def probability_figures(records: list[dict[str, Any]]) -> dict[str, Any]:
    """How often motions of some stated probability are right (within a
    pixel), and which are ok.
    """
    stated = np.array([record["probability"] for record in records])
    right = np.array([not record["failed"] for record in records])
    is_ok = [record["status"].startswith("ok") for record in records]
    flagged = ~np.array(is_ok)
    return {
        "bins": reliability(stated, right),
        "failures": int((~right).sum()),
        "failures_flagged": int((~right & flagged).sum()),
        "right_flagged": int((right & flagged).sum()),
    }
