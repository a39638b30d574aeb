"""The point solvers with several limits on the residual of an inlier.

A part of ``tools/benchmark.py methods``. A comparison is fair where each solver has the
best of these limits. The figures also state which multiple of the flow's noise
``hybridvo/calibration.py`` takes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from known_pairs import HEAVY, HEAVY_FRAMES, SIZE, heavy_pairs, rendered
from measuring import digits, methods_here, score, summarise, timed
from scipy.stats import gmean

METHODS = ("pnp-ransac-tuned", "poselib", "usac-magsac")
"""The point solvers whose limit is an option."""
GRID_PX = (0.25, 0.5, 1.0, 2.0, 3.0)
"""Fixed limits, px."""
BY_NOISE = "by noise"
"""The methods as they are: their limit follows the noise that the flow states."""
SMALLEST_PX = 0.1
"""A further limit on the heavy pairs, px: is the smallest limit of
the methods small enough?"""
MULTIPLES = (1, 2, 3, 4, 6, 8)
"""Limits in standard deviations of a known noise."""
NOISE = ("low_noise", "moving30", "moving50", "moving70", "exact_depth", "noisy")
"""Scenarios with moving objects, in which the flow's noise is known."""
DEMO_FRAMES = 20
"""Frames of the scene of ``hybridvo demo``."""

Limits = dict[str, float | None]
"""Limits in px by their name; None: the method's own."""
Records = dict[str, dict[str, list[dict[str, Any]]]]
"""Scores by method and limit."""


def thresholds(args: argparse.Namespace) -> dict[str, Any]:
    """Errors of every method with every limit: heavy pairs, the
    demo's scene, known noise.
    """
    methods, missing = methods_here(METHODS)
    heavy = heavy_grid(methods, range(args.seed0, args.seed0 + args.sequences))
    return {
        "seeds": [args.seed0, args.seed0 + args.sequences - 1],
        "grid_px": list(GRID_PX),
        "missing": missing,
        "heavy": heavy,
        "demo": demo_grid(methods),
        "multiples": multiples(methods, range(args.seed0, args.seed0 + args.pairs)),
    }


def grid_limits(*more_px: float) -> Limits:
    """The limits of the grid, further ones before it, and the methods' own."""
    limits: Limits = {BY_NOISE: None}
    for px in (*more_px, *GRID_PX):
        limits[label(px)] = px
    return limits


def empty_records(methods: Iterable[str], limits: Iterable[str]) -> Records:
    """No scores yet."""
    return {method: {name: [] for name in limits} for method in methods}


def heavy_grid(methods: list[str], seeds: Iterable[int]) -> dict[str, Any]:
    """Figures over pairs of which most moves; flow: DIS, depth true."""
    limits = grid_limits(SMALLEST_PX)
    records = empty_records(methods, limits)
    for seed in seeds:
        for kind in HEAVY:
            for case in heavy_pairs(rendered(kind, seed, SIZE, HEAVY_FRAMES)):
                pair = case.pairs["dis"]
                answer(records, limits, pair, case.T_curr_prev, case.depth)
    return summary(records)


def demo_grid(methods: list[str]) -> dict[str, Any]:
    """The scene of ``hybridvo demo``: figures over its pairs,
    and the error of the path.
    """
    from hybridvo import FramePair
    from hybridvo.core.geometry import chain
    from hybridvo.flow.providers import dis_flow, with_flow

    sequence = rendered("light", 0, SIZE, DEMO_FRAMES)
    limits = grid_limits()
    records = empty_records(methods, limits)
    first = sequence.poses[0]
    paths = {(method, name): [first] for method in methods for name in limits}
    provider = dis_flow()
    for i in range(len(sequence) - 1):
        prev = sequence.frame(i)
        pair = with_flow(FramePair(prev, sequence.frame(i + 1), None), provider)
        T = np.linalg.inv(sequence.poses[i + 1]) @ sequence.poses[i]
        motions = answer(records, limits, pair, T, prev.depth)
        for key, motion in motions.items():
            paths[key].append(chain(paths[key][-1], motion.T_curr_prev))

    result = summary(records)
    for (method, name), path in paths.items():
        away = np.array(path)[:, :3, 3] - sequence.poses[:, :3, 3]
        ate = np.sqrt(np.mean(np.sum(away**2, axis=1)))
        result[method][name]["ate_cm"] = digits(100 * ate)
    return result


def multiples(methods: list[str], seeds: Iterable[int]) -> dict[str, Any]:
    """Geometric mean of the scenarios' median errors, px, by
    limits in standard deviations.
    """
    from hybridvo_lab.synthetic.noise_scenarios import SCENARIOS, make_pair

    names = [str(k) for k in MULTIPLES]
    medians: dict[str, dict[str, list[float]]]
    medians = {method: {name: [] for name in names} for method in methods}
    for scenario in NOISE:
        std_px = SCENARIOS[scenario].flow_noise_px
        limits: Limits = {str(k): k * std_px for k in MULTIPLES}
        records = empty_records(methods, limits)
        for seed in seeds:
            pair, truth = make_pair(scenario, seed, *SIZE)
            answer(records, limits, pair, truth["T_curr_prev"], truth["depth_true"])
        for method, by_limit in records.items():
            for name, rows in by_limit.items():
                median = float(np.median([row["error"] for row in rows]))
                medians[method][name].append(median)
        print(f"thresholds: {scenario}", file=sys.stderr, flush=True)
    return {
        method: {name: digits(gmean(values)) for name, values in by_limit.items()}
        for method, by_limit in medians.items()
    }


def answer(
    records: Records,
    limits: Limits,
    pair: Any,
    T_true: np.ndarray,
    depth: np.ndarray,
) -> dict[tuple[str, str], Any]:
    """Each method's motion of a pair with each limit.

    The scores are appended to the records.
    """
    from hybridvo_lab import baselines

    motions = {}
    for method, by_limit in records.items():
        for name, px in limits.items():
            work = partial(baselines.estimate, method, pair, inlier_px=px)
            motion, ms = timed(work)
            by_limit[name].append(score(motion, T_true, depth, pair) | {"ms": ms})
            motions[method, name] = motion
    return motions


def summary(records: Records) -> dict[str, Any]:
    """Figures by method and limit."""
    return {
        method: {name: summarise(rows) for name, rows in by_limit.items()}
        for method, by_limit in records.items()
    }


def label(px: float) -> str:
    """A limit as the tables name it."""
    return f"{px:g} px"
