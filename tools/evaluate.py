"""The default method on whole sequences: paths, failures, and whether its doubt is honest.

    python tools/evaluate.py --out docs/results/sequences.json --overwrite

Each method tracks rendered sequences in which about 60 % of every image moves, from the first frame
to the last, as a user would; depth is the renderer's, flow is DIS and, as an oracle, the true one.
Then: how often the stated probability of a motion comes true.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_semi_real import reliability
from golden_inputs import HEAVY, SIZE, rendered, scene_flow
from measuring import (
    able,
    digits,
    parser_of,
    provenance,
    score,
    summarise,
    timed,
    write_result,
)

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
"""By flow; images add nothing to a true flow."""
ASKED = ("hybrid", "hybrid-flow")
"""Methods that state a probability."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument(
        "--kinds", default=",".join(HEAVY), help="families of scenes"
    )
    parser.add_argument("--sequences", type=int, default=1, help="of each family")
    parser.add_argument("--frames", type=int, default=100, help="of a sequence")
    parser.add_argument(
        "--seed0", type=int, default=9000, help="0-999 development, else published"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/sequences.json"), metavar="FILE"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)

    made = lambda: provenance("evaluate.py", argv) | measure(args)  # noqa: E731
    return write_result("evaluate.py", args.out, args.overwrite, made)


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Figures by flow, method and family, and the probability's reliability."""
    paths: dict[str, dict[str, dict[str, list[float]]]] = {
        flow: {} for flow in METHODS
    }
    records: dict[str, dict[str, list[Any]]] = {flow: {} for flow in METHODS}
    methods = {flow: able(names)[0] for flow, names in METHODS.items()}
    for kind in args.kinds.split(","):
        for seed in range(args.seed0, args.seed0 + args.sequences):
            sequence = rendered(kind, seed, SIZE, args.frames)
            for (flow, method), (some, path) in track(sequence, methods).items():
                records[flow].setdefault(method, []).extend(some)
                paths[flow].setdefault(method, {}).setdefault(kind, []).append(path)
            print(f"{kind}, seed {seed}", file=sys.stderr, flush=True)
    return {
        "kinds": args.kinds.split(","),
        "seeds": [args.seed0, args.seed0 + args.sequences - 1],
        "frames": args.frames,
        "size": list(SIZE),
        "depth": "true (oracle)",
        "missing": able(METHODS["dis"])[1],
        "paths": {
            flow: {m: {kind: {"rmse_cm": digits(np.mean(some))} for kind, some in by_kind.items()}
                   for m, by_kind in by_method.items()}
            for flow, by_method in paths.items()
        },
        "pairs": {
            flow: {method: summarise(rows) for method, rows in by_method.items()}
            for flow, by_method in records.items()
        },
        "probability": {
            flow: {m: doubt(by_method[m]) for m in ASKED if m in by_method}
            for flow, by_method in records.items()
        },
    }  # fmt: skip


def track(
    sequence: Any, methods: dict[str, list[str]]
) -> dict[tuple[str, str], tuple[list[dict[str, Any]], float]]:
    """By flow and method: the score of every step, and the error of the path."""
    from hybridvo import FramePair, Odometry
    from hybridvo.flow import dis_flow

    providers = {"dis": dis_flow(), "true": scene_flow(sequence)}
    trackers = {
        (flow, method): Odometry(method=method)
        for flow, names in methods.items()
        for method in names
    }
    records: dict[tuple[str, str], list[Any]] = {key: [] for key in trackers}
    places: dict[tuple[str, str], list[np.ndarray]] = {key: [] for key in trackers}
    prev = None
    for i in range(len(sequence)):
        frame = sequence.frame(i)
        fields = (
            {flow: p(prev, frame) for flow, p in providers.items()}
            if prev is not None
            else {}
        )
        for key, tracker in trackers.items():
            field = fields.get(key[0])
            step, ms = timed(
                lambda t=tracker, f=field, frame=frame: t.track(frame, f)
            )
            places[key].append(step.T_world_cam[:3, 3])
            if prev is not None:
                T = np.linalg.inv(sequence.poses[i]) @ sequence.poses[i - 1]
                row = score(
                    step.motion, T, prev.depth, FramePair(prev, frame, None)
                )
                records[key].append(
                    row | {"ms": ms, "probability": step.motion.probability}
                )
        prev = frame
    truth = (np.linalg.inv(sequence.poses[0]) @ sequence.poses)[:, :3, 3]
    errors = {
        key: np.linalg.norm(np.array(path) - truth, axis=1)
        for key, path in places.items()
    }
    return {
        k: (records[k], 100 * float(np.sqrt(np.mean(e**2))))
        for k, e in errors.items()
    }


def doubt(records: list[dict[str, Any]]) -> dict[str, Any]:
    """How often a motion of some stated probability is right (within a pixel), and what is ok."""
    stated = np.array([record["probability"] for record in records])
    right = np.array([not record["failed"] for record in records])
    flagged = np.array(
        [not record["status"].startswith("ok") for record in records]
    )
    return {
        "bins": reliability(stated, right),
        "failures": int((~right).sum()),
        "failures_flagged": int((~right & flagged).sum()),
        "right_flagged": int((right & flagged).sum()),
    }


if __name__ == "__main__":
    sys.exit(main())
