"""Pose estimators side by side: noise scenarios, rendered scenes,
recorded sequences, costs.

    python tools/benchmark.py methods --out docs/results/benchmark.json --overwrite
    python tools/benchmark.py methods --parts real --data ../shared/data --out runs/real.json
    python tools/benchmark.py methods --parts heavy,real --jobs 8 --out runs/fast.json

Writes one JSON with a key for each part; with --overwrite the other parts of the
file stay. Development uses the seeds 0 to 999, published figures 9000 and up. Flow
or depth that is ground truth is named so: an oracle. Several ``--jobs`` share the items of
scenarios, heavy, video_rate and real; times are then those of a busy machine.
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
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from known_pairs import HEAVY, HEAVY_AT, HEAVY_FRAMES, REAL, SIZE, rendered
from known_pairs import heavy_pairs as heavy_inputs
from measuring import (
    add_workers,
    digits,
    measured,
    methods_here,
    parser_of,
    provenance,
    score,
    summarise,
    timed,
    write_result,
)
from scipy.stats import gmean

from bench.costs import costs
from bench.thresholds import thresholds
from bench.video_rate import video_rate

FLOW_ONLY = (
    "hybrid-flow",
    "pwvo-refine",
    "classical",
    "pwvo",
    "pnp-ransac-tuned",
    "pnp-ransac",
    "usac-magsac",
    "poselib",
    "identity",
)
"""Methods that need no images."""
HEAVY_METHODS = (
    "hybrid",
    "hybrid-flow",
    "pwvo-refine",
    "classical",
    "pwvo",
    "pnp-ransac-tuned",
    "poselib",
)
"""Methods on scenes in which most of the image moves."""
REAL_METHODS = (
    "hybrid",
    "pwvo-refine",
    "classical",
    "poselib",
    "pnp-ransac-tuned",
    "opencv-rgbd",
    "identity",
)
"""Methods on recorded sequences."""
ORACLE = "classical-oracle-static-mask"
"""``classical`` with the true mask of the static pixels."""
FLOWS = ("dis", "true")
"""Flows of the rendered scenes."""
REAL_PAIRS = 40
"""Pairs of a recorded sequence, from its start."""

Estimator = Callable[[Any], Any]
"""From a pair to its motion."""
Records = dict[str, list[dict[str, Any]]]
"""Scores by method."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--parts", default=",".join(PARTS), help="of " + ", ".join(PARTS))
    add("--pairs", type=int, default=20, help="pairs of each scenario")
    add("--sequences", type=int, default=6, help="rendered scenes of each kind")
    add("--model-pairs", type=int, default=200, help="pairs with model noise")
    add(
        "--repeats", type=int, default=3, help="runs of tracked costs: their median"
    )
    add("--video-frames", type=int, default=200, help="frames at video rate")
    add("--seed0", type=int, default=9000, help="first seed of the rendered data")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, default=Path("runs/benchmark.json"), metavar="FILE")
    add("--overwrite", action="store_true", help="replace its parts in --out")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    parts = args.parts.split(",")
    unknown = sorted(set(parts) - set(PARTS))
    if unknown:
        known = ", ".join(PARTS)
        text = f"unknown part {', '.join(unknown)}; known: {known}."
        print(f"benchmark.py: {text}", file=sys.stderr)
        return 2

    def measure() -> dict[str, Any]:
        # parts that are measured replace those of the file; the others stay
        result = {}
        if args.out.exists():
            result = json.loads(args.out.read_text(encoding="utf-8"))
        for part in parts:
            origin = provenance("benchmark.py methods", argv)
            result[part] = origin | PARTS[part](args)
            print(f"{part}: done", file=sys.stderr, flush=True)
        return result

    return write_result("benchmark.py", args.out, args.overwrite, measure)


# --- noise scenarios --------------------------------------------------------------


def scenarios(args: argparse.Namespace) -> dict[str, Any]:
    """Pairs without images, with known noise: error, time and
    covariance in every scenario.
    """
    from hybridvo_lab.synthetic.noise_scenarios import MAIN_SCENARIOS, SCENARIOS

    methods, missing = estimators(FLOW_ONLY)
    work = partial(scenario, range(args.seed0, args.seed0 + args.pairs))
    names = {name: name for name in SCENARIOS}
    summary = measured(args, "scenarios", work, names)

    means = {}
    for method in methods:
        medians = [
            summary[name][method]["epe_px"]["median"] for name in MAIN_SCENARIOS
        ]
        means[method] = digits(gmean(np.maximum(medians, 1e-9)))
    return {
        "seeds": [args.seed0, args.seed0 + args.pairs - 1],
        "main": list(MAIN_SCENARIOS),
        "geometric_mean_px": means,
        "missing": missing,
        "summary": summary,
    }


def scenario(seeds: range, name: str) -> dict[str, Any]:
    """Figures of each method in a scenario."""
    from hybridvo_lab.synthetic.noise_scenarios import make_pair

    methods, _ = estimators(FLOW_ONLY)
    records: Records = {method: [] for method in methods}
    for seed in seeds:
        pair, truth = make_pair(name, seed)
        T_true = truth["T_curr_prev"]
        answer(records, methods, pair, T_true, truth["depth_true"])
    return summaries(records)


def model_noise(args: argparse.Namespace) -> dict[str, Any]:
    """Normalised error of ``classical`` under the noise that it assumes.

    Chi-square with six degrees of freedom, mean 6 and median 5.35, where
    the covariance is right.
    """
    from hybridvo import refine
    from hybridvo_lab.synthetic.noise_scenarios import make_model_pair

    records: Records = {"classical": []}
    for seed in range(args.seed0, args.seed0 + args.model_pairs):
        pair, truth = make_model_pair(seed)
        T_true = truth["T_curr_prev"]
        answer(records, {"classical": refine}, pair, T_true, truth["depth_true"])
    nees = [record["nees"] for record in records["classical"]]
    row = summarise(records["classical"])
    row["nees_mean"] = digits(np.mean(nees))
    row["nees_standard_error"] = digits(np.std(nees) / np.sqrt(len(nees)))
    return {
        "seeds": [args.seed0, args.seed0 + args.model_pairs - 1],
        "classical": row,
    }


# --- rendered scenes --------------------------------------------------------------


class HeavyCase(NamedTuple):
    """A pair of a rendered scene."""

    flow: str  # "dis" or "true"
    pair: Any
    T_curr_prev: np.ndarray
    static: np.ndarray  # (H, W) float32, 1 where the scene is static


def heavy(args: argparse.Namespace) -> dict[str, Any]:
    """Rendered scenes in which most of the image moves, on true and
    on DIS flow, depth true.

    ``classical``, ``hybrid-flow`` and ``hybrid`` are also the ablation of the
    default: the refinement alone, with PWVO, and with the images.
    """
    methods, missing = estimators(HEAVY_METHODS)
    names = (*methods, ORACLE)
    seeds = range(args.seed0, args.seed0 + args.sequences)
    scenes = {f"{kind} {seed}": (kind, seed) for kind in HEAVY for seed in seeds}
    found = measured(args, "heavy", heavy_scene, scenes)
    records: dict[str, dict[str, Records]] = {
        kind: {
            flow: {
                name: [
                    row
                    for seed in seeds
                    for row in found[f"{kind} {seed}"][flow][name]
                ]
                for name in names
            }
            for flow in FLOWS
        }
        for kind in HEAVY
    }
    records["total"] = {
        flow: {
            name: [row for kind in HEAVY for row in records[kind][flow][name]]
            for name in names
        }
        for flow in FLOWS
    }
    summary = {
        kind: {flow: summaries(by_method) for flow, by_method in by_flow.items()}
        for kind, by_flow in records.items()
    }
    return {
        "seeds": [args.seed0, args.seed0 + args.sequences - 1],
        "size": list(SIZE),
        "depth": "true (oracle)",
        "missing": missing,
        "summary": summary,
    }


def heavy_scene(scene: tuple[str, int]) -> dict[str, Records]:
    """Scores on a scene of a kind and seed, by flow."""
    methods, _ = estimators(HEAVY_METHODS)
    names = (*methods, ORACLE)
    records: dict[str, Records] = {
        flow: {name: [] for name in names} for flow in FLOWS
    }
    for case in heavy_pairs(*scene):
        depth = case.pair.prev.depth
        all_methods = methods | {ORACLE: masked(case.static)}
        by_method = records[case.flow]
        answer(by_method, all_methods, case.pair, case.T_curr_prev, depth)
    return records


def heavy_pairs(kind: str, seed: int) -> Iterator[HeavyCase]:
    """Pairs distributed over a scene, each with both flows."""
    sequence = rendered(kind, seed, SIZE, HEAVY_FRAMES)
    for i, case in zip(HEAVY_AT, heavy_inputs(sequence), strict=True):
        static = (sequence.scene.object_id(i) <= 0).astype(np.float32)
        for flow in FLOWS:
            yield HeavyCase(flow, case.pairs[flow], case.T_curr_prev, static)


def masked(static: np.ndarray) -> Estimator:
    """The refinement with the true mask as its weights."""
    from hybridvo import refine

    return lambda pair: refine(pair, weights=static)


# --- recorded sequences -----------------------------------------------------------


def real(args: argparse.Namespace) -> dict[str, Any]:
    """Recorded sequences below the data folder, on DIS flow."""
    _, missing = estimators(REAL_METHODS)
    absent = [name for name in REAL if not (args.data / name).is_dir()]
    folders = {
        name: (args.data / name).absolute() for name in REAL if name not in absent
    }
    summary = measured(args, "real", real_sequence, folders)
    return {"missing": missing, "absent": absent, "summary": summary}


def real_sequence(folder: Path) -> dict[str, Any]:
    """Figures of each method on a recorded sequence."""
    from hybridvo import open_sequence
    from hybridvo.flow.providers import dis_flow

    methods, _ = estimators(REAL_METHODS)
    sequence = open_sequence(folder)
    return {
        "frames": len(sequence),
        "depth": sequence.depth_source,
        "flows": {"dis": real_rows(sequence, dis_flow(), methods)},
    }


def real_rows(
    sequence: Any, provider: Any, methods: dict[str, Estimator]
) -> dict[str, Any]:
    """Figures of each method over the pairs."""
    from hybridvo import iter_pairs

    records: Records = {method: [] for method in methods}
    for pair in itertools.islice(iter_pairs(sequence, provider), REAL_PAIRS):
        i = pair.prev.index
        T = np.linalg.inv(sequence.poses[i + 1]) @ sequence.poses[i]
        answer(records, methods, pair, T, pair.prev.depth)
    return summaries(records)


# --- the demo ---------------------------------------------------------------------


def demo(args: argparse.Namespace) -> dict[str, Any]:
    """What ``hybridvo demo`` prints, and the degraded motions of our methods."""
    with tempfile.TemporaryDirectory() as folder:
        program = str(Path(sys.executable).parent / "hybridvo")
        command = [program, "demo", "--out", f"{folder}/demo", "--json", "--quiet"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        runs = sorted(Path(folder).glob("demo/runs/*/*/steps.csv"))
        degraded = {path.parent.name: degraded_motions(path) for path in runs}
    content = json.loads(done.stdout)
    result = {name: content[name] for name in ("scene", "moving_fraction", "rows")}
    result["degraded"] = {method: some for method, some in degraded.items() if some}
    return result


def degraded_motions(path: Path) -> list[dict[str, Any]]:
    """Reason, probability and error, px, of the degraded
    motions in a ``steps.csv``.
    """
    with path.open(encoding="utf-8", newline="") as file:
        steps = list(csv.DictReader(file))
    return [
        {
            "index": int(step["index"]),
            "reason": step["reason"],
            "probability": digits(step["probability"]),
            "epe_px": digits(step["epe_l2_px"]),
        }
        for step in steps
        if step["status"] == "degraded"
    ]


# --- methods and their answers ----------------------------------------------------


class Estimators(NamedTuple):
    """Methods that can run here, and reason and remedy of those that cannot."""

    ready: dict[str, Estimator]
    missing: dict[str, str]


def estimators(names: tuple[str, ...]) -> Estimators:
    """The methods of these names."""
    from hybridvo import estimate

    methods = methods_here(names)
    ready = {name: partial(estimate, method=name) for name in methods.ready}
    return Estimators(ready, methods.missing)


def answer(
    records: Records,
    methods: dict[str, Estimator],
    pair: Any,
    T_true: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Append each method's score and time on a pair to the records.

    A method's first call is made twice, so that its set-up is not timed.
    """
    for name, method in methods.items():
        if not records[name]:
            method(pair)
        motion, ms = timed(lambda method=method: method(pair))
        records[name].append(score(motion, T_true, depth, pair) | {"ms": ms})


def summaries(records: Records) -> dict[str, dict[str, Any]]:
    """Figures of each method."""
    return {method: summarise(rows) for method, rows in records.items()}


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "scenarios": scenarios,
    "model_noise": model_noise,
    "heavy": heavy,
    "video_rate": video_rate,
    "real": real,
    "costs": costs,
    "demo": demo,
    "thresholds": thresholds,
}
"""The parts by name."""
