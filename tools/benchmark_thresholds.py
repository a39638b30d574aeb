"""The point solvers with several limits on the residual of an inlier, and the noise they follow.

A part of ``tools/benchmark.py``. A comparison is fair where each solver has the best of these
limits; and the figures say which multiple of the flow's noise ``hybridvo/calibration.py`` takes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from golden_inputs import HEAVY, HEAVY_FRAMES, SIZE, heavy_pairs, rendered
from measuring import able, digits, score, summarise, timed
from scipy.stats import gmean

METHODS = ("pnp-ransac-tuned", "poselib", "usac-magsac")
GRID_PX = (0.25, 0.5, 1.0, 2.0, 3.0)
BY_NOISE = "by noise"
"""The methods as they are: their limit follows the noise that the flow states."""
SMALLEST_PX = 0.1
"""On the heavy pairs alone: is the smallest limit of the methods small enough?"""
MULTIPLES = (1, 2, 3, 4, 6, 8)
"""Limits in standard deviations of a known noise."""
NOISE = ("low_noise", "moving30", "moving50", "moving70", "exact_depth", "noisy")
"""Scenarios with movers, in which the flow's noise is known."""

Records = dict[str, dict[str, list[dict[str, Any]]]]
"""Method -> limit -> scores."""


def thresholds(args: argparse.Namespace) -> dict[str, Any]:
    """Errors of every method with every limit: heavy pairs, the demo's scene, known noise."""
    methods, missing = able(METHODS)
    heavy = heavy_grid(methods, range(args.seed0, args.seed0 + args.sequences))
    print("thresholds: heavy", file=sys.stderr, flush=True)
    demo = demo_grid(methods)
    print("thresholds: demo", file=sys.stderr, flush=True)
    return {
        "seeds": [args.seed0, args.seed0 + args.sequences - 1],
        "grid_px": list(GRID_PX),
        "missing": missing,
        "heavy": heavy,
        "demo": demo,
        "multiples": multiples(methods, range(args.seed0, args.seed0 + args.pairs)),
    }


def heavy_grid(methods: list[str], seeds: Iterable[int]) -> dict[str, Any]:
    """Figures over pairs of which most moves; flow: DIS, depth true."""
    limits = {BY_NOISE: None} | {label(px): px for px in (SMALLEST_PX, *GRID_PX)}
    records: Records = {m: {name: [] for name in limits} for m in methods}
    for seed in seeds:
        for kind in HEAVY:
            for case in heavy_pairs(rendered(kind, seed, SIZE, HEAVY_FRAMES)):
                pair = case.pairs["dis"]
                answer(records, limits, pair, case.T_curr_prev, case.depth)
    return summary(records)


def demo_grid(methods: list[str]) -> dict[str, Any]:
    """The scene of ``hybridvo demo``: figures over its pairs, and the error of the path."""
    from hybridvo import FramePair
    from hybridvo.flow import dis_flow, with_flow
    from hybridvo.geometry import chain

    sequence = rendered("light", 0, SIZE, 20)
    limits = {BY_NOISE: None} | {label(px): px for px in GRID_PX}
    records: Records = {m: {name: [] for name in limits} for m in methods}
    poses = {(m, name): [sequence.poses[0]] for m in methods for name in limits}
    provider = dis_flow()
    for i in range(len(sequence) - 1):
        prev = sequence.frame(i)
        pair = with_flow(FramePair(prev, sequence.frame(i + 1), None), provider)
        T = np.linalg.inv(sequence.poses[i + 1]) @ sequence.poses[i]
        found = answer(records, limits, pair, T, prev.depth)
        for key, motion in found.items():
            poses[key].append(chain(poses[key][-1], motion.T_curr_prev))
    result = summary(records)
    for (method, name), path in poses.items():
        away = np.array(path)[:, :3, 3] - sequence.poses[:, :3, 3]
        ate = np.sqrt(np.mean(np.sum(away**2, axis=1)))
        result[method][name]["ate_cm"] = digits(100 * ate)
    return result


def multiples(methods: list[str], seeds: Iterable[int]) -> dict[str, Any]:
    """Geometric mean of the scenarios' median errors, px, by limits in standard deviations."""
    from hybridvo.synthetic.noise_scenarios import SCENARIOS, make_pair

    medians: dict[str, dict[str, list[float]]]
    medians = {m: {str(k): [] for k in MULTIPLES} for m in methods}
    for name in NOISE:
        std_px = SCENARIOS[name].flow_noise_px
        limits = {str(k): k * std_px for k in MULTIPLES}
        records: Records = {m: {k: [] for k in limits} for m in methods}
        for seed in seeds:
            pair, truth = make_pair(name, seed, *SIZE)
            answer(records, limits, pair, truth["T_curr_prev"], truth["depth_true"])
        for method, by_limit in records.items():
            for k, rows in by_limit.items():
                medians[method][k].append(
                    float(np.median([row["error"] for row in rows]))
                )
        print(f"thresholds: {name}", file=sys.stderr, flush=True)
    return {
        method: {k: digits(gmean(values)) for k, values in by_limit.items()}
        for method, by_limit in medians.items()
    }


def answer(
    records: Records, limits: Any, pair: Any, T_true: np.ndarray, depth: np.ndarray
) -> dict[tuple[str, str], Any]:
    """Each method's motion of a pair with each limit; its scores are added to the records."""
    from hybridvo import baselines

    found = {}
    for method, by_limit in records.items():
        for name, px in limits.items():
            motion, ms = timed(
                lambda method=method, px=px: baselines.estimate(
                    method, pair, inlier_px=px
                )
            )
            by_limit[name].append(score(motion, T_true, depth, pair) | {"ms": ms})
            found[method, name] = motion
    return found


def summary(records: Records) -> dict[str, Any]:
    """Figures by method and limit."""
    return {
        method: {name: summarise(rows) for name, rows in by_limit.items()}
        for method, by_limit in records.items()
    }


def label(px: float) -> str:
    """A limit as the tables name it."""
    return f"{px:g} px"
