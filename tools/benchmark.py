"""Pose estimators side by side: scenarios, rendered scenes with movers, recorded sequences, costs.

    python tools/benchmark.py --out docs/results/benchmark.json --overwrite
    python tools/benchmark.py --parts real --data ../shared/data --out runs/real.json

Writes one JSON with a key for each part; with --overwrite the other parts of the file stay.
Development uses the seeds 0 to 999, published figures 9000 and up. Flow or depth that is ground
truth is named so: an oracle.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmark_costs import costs
from benchmark_thresholds import thresholds
from golden_inputs import HEAVY, HEAVY_AT, HEAVY_FRAMES, REAL, SIZE, rendered
from golden_inputs import heavy_pairs as heavy_inputs
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
from scipy.stats import gmean

from hybridvo.geometry import rotation_angle

FLOW_ONLY = (
    "hybrid-flow", "pwvo-refine", "classical", "pwvo", "pnp-ransac-tuned", "pnp-ransac",
    "usac-magsac", "poselib", "identity",
)  # fmt: skip
"""Methods that need no images."""
HEAVY_METHODS = (
    "hybrid", "hybrid-flow", "pwvo-refine", "classical", "pwvo", "pnp-ransac-tuned", "poselib",
)  # fmt: skip
REAL_METHODS = (
    "hybrid", "pwvo-refine", "classical", "poselib", "pnp-ransac-tuned", "opencv-rgbd", "identity",
)  # fmt: skip
ORACLE = "classical-oracle-static-mask"
"""``classical`` with the true mask of static pixels: what a perfect mask would give."""
REAL_PAIRS = 40
"""Pairs of a recorded sequence, from its start: a chain without holes has an error at its end."""

Estimator = Callable[[Any], Any]


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument(
        "--parts", default=",".join(PARTS), help="of " + ", ".join(PARTS)
    )
    parser.add_argument(
        "--pairs", type=int, default=20, help="pairs of each scenario"
    )
    parser.add_argument(
        "--sequences", type=int, default=6, help="rendered scenes of each kind"
    )
    parser.add_argument(
        "--model-pairs", type=int, default=200, help="pairs with model noise"
    )
    parser.add_argument(
        "--seed0", type=int, default=9000, help="first seed of what is made"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data"), metavar="DIR"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/benchmark.json"), metavar="FILE"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace its parts in --out"
    )
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    unknown = sorted(set(args.parts.split(",")) - set(PARTS))
    if unknown:
        known = ", ".join(PARTS)
        print(
            f"benchmark.py: unknown part {', '.join(unknown)}; known: {known}.",
            file=sys.stderr,
        )
        return 2

    def measure() -> dict[str, Any]:
        # parts that are measured anew replace those of the file; the others stay
        result = (
            json.loads(args.out.read_text(encoding="utf-8"))
            if args.out.exists()
            else {}
        )
        for part in args.parts.split(","):
            result[part] = provenance("benchmark.py", argv) | PARTS[part](args)
            print(f"{part}: done", file=sys.stderr, flush=True)
        return result

    return write_result("benchmark.py", args.out, args.overwrite, measure)


def scenarios(args: argparse.Namespace) -> dict[str, Any]:
    """Pairs without images, with known noise: error, time and covariance in every scenario."""
    from hybridvo.synthetic.noise_scenarios import MAIN_SCENARIOS, SCENARIOS, make_pair

    methods, missing = estimators(FLOW_ONLY)
    summary: dict[str, Any] = {}
    for name in SCENARIOS:
        records: dict[str, list[Any]] = {method: [] for method in methods}
        for seed in range(args.seed0, args.seed0 + args.pairs):
            pair, truth = make_pair(name, seed)
            answer(
                records, methods, pair, truth["T_curr_prev"], truth["depth_true"]
            )
        summary[name] = {
            method: summarise(rows) for method, rows in records.items()
        }
        print(f"scenario {name}", file=sys.stderr, flush=True)
    medians = {
        method: [
            max(summary[name][method]["epe_px"]["median"], 1e-9)
            for name in MAIN_SCENARIOS
        ]
        for method in methods
    }
    return {
        "seeds": [args.seed0, args.seed0 + args.pairs - 1],
        "main": list(MAIN_SCENARIOS),
        "geometric_mean_px": {
            method: digits(gmean(some)) for method, some in medians.items()
        },
        "missing": missing,
        "summary": summary,
    }


def model_noise(args: argparse.Namespace) -> dict[str, Any]:
    """Normalised error of ``classical`` under the noise that it assumes.

    Chi-square with six degrees of freedom, mean 6 and median 5.35, where the covariance is right.
    """
    from hybridvo import refine
    from hybridvo.synthetic.noise_scenarios import make_model_pair

    records: dict[str, list[Any]] = {"classical": []}
    for seed in range(args.seed0, args.seed0 + args.model_pairs):
        pair, truth = make_model_pair(seed)
        answer(
            records,
            {"classical": refine},
            pair,
            truth["T_curr_prev"],
            truth["depth_true"],
        )
    nees = [record["nees"] for record in records["classical"]]
    row = summarise(records["classical"])
    row["nees_mean"] = digits(np.mean(nees))
    row["nees_standard_error"] = digits(np.std(nees) / np.sqrt(len(nees)))
    return {
        "seeds": [args.seed0, args.seed0 + args.model_pairs - 1],
        "classical": row,
    }


def heavy(args: argparse.Namespace) -> dict[str, Any]:
    """Rendered scenes in which most of the image moves, on true and on DIS flow, depth true.

    ``refine``, ``hybrid-flow`` and ``hybrid`` are also the ablation of the default: the refinement
    alone, with the selector, and with the images.
    """
    methods, missing = estimators(HEAVY_METHODS)
    records: dict[str, dict[str, dict[str, list[Any]]]] = {}
    for kind in HEAVY:
        by_flow = records[kind] = {
            flow: {method: [] for method in (*methods, ORACLE)}
            for flow in ("dis", "true")
        }
        for seed in range(args.seed0, args.seed0 + args.sequences):
            for flow, pair, T, static in heavy_pairs(kind, seed):
                told = methods | {ORACLE: masked(static)}
                answer(by_flow[flow], told, pair, T, pair.prev.depth)
        print(f"heavy {kind}", file=sys.stderr, flush=True)
    total = {
        flow: {
            m: [r for kind in HEAVY for r in records[kind][flow][m]]
            for m in (*methods, ORACLE)
        }
        for flow in ("dis", "true")
    }
    return {
        "seeds": [args.seed0, args.seed0 + args.sequences - 1],
        "size": list(SIZE),
        "depth": "true (oracle)",
        "missing": missing,
        "summary": {
            kind: {flow: {m: summarise(rows) for m, rows in by_method.items()}
                   for flow, by_method in by_flow.items()}
            for kind, by_flow in (records | {"total": total}).items()
        },
    }  # fmt: skip


def heavy_pairs(
    kind: str, seed: int
) -> Iterator[tuple[str, Any, np.ndarray, np.ndarray]]:
    """(flow, pair, true motion, static pixels): pairs spread over a scene, each with both flows."""
    sequence = rendered(kind, seed, SIZE, HEAVY_FRAMES)
    for i, case in zip(HEAVY_AT, heavy_inputs(sequence), strict=True):
        static = (sequence.scene.object_id(i) <= 0).astype(np.float32)
        for flow in ("dis", "true"):
            yield flow, case.pairs[flow], case.T_curr_prev, static


def masked(static: np.ndarray) -> Estimator:
    """The refinement with the true mask as its weights."""
    from hybridvo import refine

    return lambda pair: refine(pair, weights=static)


def real(args: argparse.Namespace) -> dict[str, Any]:
    """Recorded sequences below the data folder: flow files where there are any, and DIS."""
    from hybridvo import open_sequence
    from hybridvo.flow import dis_flow, file_flow

    methods, missing = estimators(REAL_METHODS)
    summary: dict[str, Any] = {}
    absent = [name for name in REAL if not (args.data / name).is_dir()]
    for name in REAL:
        if name in absent:
            continue
        sequence = open_sequence(args.data / name)
        flows = {"file": file_flow(sequence)} if sequence.has_flow else {}
        summary[name] = {
            "frames": len(sequence),
            "depth": sequence.depth_source,
            "flows": {},
        }
        for flow, provider in (flows | {"dis": dis_flow()}).items():
            label = (
                "file (true)" if flow == "file" and sequence.flow_is_true else flow
            )
            summary[name]["flows"][label] = real_rows(sequence, provider, methods)
        print(f"real {name}", file=sys.stderr, flush=True)
    return {"missing": missing, "absent": absent, "summary": summary}


def real_rows(
    sequence: Any, provider: Any, methods: dict[str, Estimator]
) -> dict[str, Any]:
    """Figures of each method over the pairs, and its error at the end of the chain."""
    from hybridvo import iter_pairs

    records: dict[str, list[Any]] = {method: [] for method in methods}
    end = {method: np.eye(4) for method in methods}
    T_true = np.eye(4)
    for pair in itertools.islice(iter_pairs(sequence, provider), REAL_PAIRS):
        i = pair.prev.index
        T = np.linalg.inv(sequence.poses[i + 1]) @ sequence.poses[i]
        T_true = T @ T_true
        for method, motion in answer(
            records, methods, pair, T, pair.prev.depth
        ).items():
            end[method] = motion.T_curr_prev @ end[method]
    rows = {}
    for method, some in records.items():
        error = end[method] @ np.linalg.inv(T_true)
        rows[method] = summarise(some) | {
            "end_rotation_deg": digits(np.rad2deg(rotation_angle(error[:3, :3]))),
            "end_translation_cm": digits(100 * np.linalg.norm(error[:3, 3])),
        }
    return rows


def demo(args: argparse.Namespace) -> dict[str, Any]:
    """What ``hybridvo demo`` prints, and which motions of our methods are degraded."""
    with tempfile.TemporaryDirectory() as folder:
        program = str(Path(sys.executable).parent / "hybridvo")
        command = [program, "demo", "--out", f"{folder}/demo", "--json", "--quiet"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        runs = sorted(Path(folder).glob("demo/runs/*/*/steps.csv"))
        degraded = {path.parent.name: degraded_motions(path) for path in runs}
    content = json.loads(done.stdout)
    shown = {name: content[name] for name in ("scene", "moving_fraction", "rows")}
    return shown | {
        "degraded": {method: some for method, some in degraded.items() if some}
    }


def degraded_motions(path: Path) -> list[dict[str, Any]]:
    """Reason, probability and error, px, of the degraded motions in a ``steps.csv``."""
    with path.open(encoding="utf-8", newline="") as file:
        steps = [
            step for step in csv.DictReader(file) if step["status"] == "degraded"
        ]
    return [
        {
            "index": int(step["index"]),
            "reason": step["reason"],
            "probability": digits(step["probability"]),
            "epe_px": digits(step["epe_l2_px"]),
        }
        for step in steps
    ]


def estimators(
    names: tuple[str, ...],
) -> tuple[dict[str, Estimator], dict[str, str]]:
    """Those that can run here, by name, and reason and remedy for the others."""
    from hybridvo import estimate

    found, missing = able(names)
    return {m: lambda pair, m=m: estimate(pair, method=m) for m in found}, missing


def answer(
    records: dict[str, list[Any]],
    methods: dict[str, Estimator],
    pair: Any,
    T_true: np.ndarray,
    depth: np.ndarray,
) -> dict[str, Any]:
    """Each method's motion of a pair; its scores and time are added to the records.

    A method's first call is made twice: what is paid once in a process is not timed.
    """
    motions = {}
    for name, method in methods.items():
        if not records[name]:
            method(pair)
        motions[name], ms = timed(lambda method=method: method(pair))
        records[name].append(score(motions[name], T_true, depth, pair) | {"ms": ms})
    return motions


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "scenarios": scenarios,
    "model_noise": model_noise,
    "heavy": heavy,
    "real": real,
    "costs": costs,
    "demo": demo,
    "thresholds": thresholds,
}


if __name__ == "__main__":
    sys.exit(main())
