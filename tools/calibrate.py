"""Fits the probabilities of being right: prints the numbers of hybridvo/calibration.py.

    python tools/calibrate.py --data ../shared/data

Pairs of the development recordings (tools/benchmark_semi_real.py) and of the heavy development
scenes, seeds 900 to 905, with DIS flow. Right is what those benchmarks call so.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import heavy_pairs
from benchmark_semi_real import WRONG_FACTOR, WRONG_PX, calibration_error, draw
from golden_inputs import HEAVY
from measuring import auroc, ego_flow_error, parser_of
from scipy.optimize import minimize

from hybridvo import refine
from hybridvo.calibration import MIN_CONFIDENCE
from hybridvo.hypotheses.selector import CueSelector
from hybridvo.network.models import Models
from hybridvo.pipeline import Context
from hybridvo.results import RelativePose
from hybridvo.synthetic.semi_real import load_split

HEAVY_SEEDS = range(900, 906)
RIDGE = 0.02
"""Penalty on the squared slope, times the number of answers."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--pairs", type=int, default=200, help="semi-real pairs")
    parser.add_argument("--selector", metavar="FILE", help="weights instead of the shipped ones")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    models = Models(weights={"selector": args.selector} if args.selector else None)
    rows: dict[str, list[tuple[float, bool]]] = {"cues": [], "selector": [], "clear": []}
    for pair, T, depth, limit in pairs(args):
        for name, gap, error in answers(pair, T, depth, models):
            rows[name].append((gap, error <= max(WRONG_PX, WRONG_FACTOR * limit)))
    for name, some in rows.items():
        right = np.array([r for _, r in some])
        print(f"{name}: {len(right)} answers, {right.sum()} right")
        if name != "clear" and 0 < right.sum() < len(right):
            gaps = np.array([gap for gap, _ in some])
            slope, offset = fit(gaps, right)
            p = 1 / (1 + np.exp(-slope * gaps - offset))
            print(f"  ({slope:.2f}, {offset:.2f})")
            print(f"  AUROC {auroc(p, right)}, calibration error {calibration_error(p, right)}")
            sure = p >= MIN_CONFIDENCE
            flagged, missed = (right & ~sure).sum(), (~right & sure).sum()
            print(f"  {flagged} right ones degraded, {missed} wrong ones ok")
    return 0


def pairs(args: argparse.Namespace) -> Iterator[tuple[Any, np.ndarray, np.ndarray, float]]:
    """(pair, true motion, depth of the static pixels, error inside the true mask)."""
    recordings = load_split(args.data, "development")
    for k in range(args.pairs):
        drawn = draw("development", k, recordings)
        depth = np.where(drawn.moving, 0, drawn.depth)
        told = refine(drawn.pair, weights=(~drawn.moving).astype(np.float32))
        limit = ego_flow_error(told.T_curr_prev, drawn.T_curr_prev, depth, drawn.pair)
        yield drawn.pair, drawn.T_curr_prev, depth, limit
    for kind in HEAVY:
        for seed in HEAVY_SEEDS:
            for flow, pair, T, _ in heavy_pairs(kind, seed):
                if flow == "dis":
                    yield pair, T, pair.prev.depth, 0.0


def answers(
    pair: Any, T: np.ndarray, depth: np.ndarray, models: Models
) -> Iterator[tuple[str, float, float]]:
    """(which probability, the gap it is computed from, error in px) of both selectors."""
    ctx = Context(models=models)
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return
    chosen = {"cues": CueSelector().select(found), "selector": ctx.select(pair, found)}
    if not found.is_ambiguous:
        chosen = {"clear": chosen["selector"]}
    for name, selection in chosen.items():
        motion = ctx.refine(pair, found, selection)
        yield name, selection.gap, ego_flow_error(motion.T_curr_prev, T, depth, pair)


def fit(gaps: np.ndarray, right: np.ndarray) -> tuple[float, float]:
    """Slope and offset of a logistic regression."""
    sign = np.where(right, 1.0, -1.0)

    def cost(w: np.ndarray) -> float:
        return float(np.logaddexp(0, -sign * (w[0] * gaps + w[1])).mean() + RIDGE * w[0] ** 2 / 2)

    slope, offset = minimize(cost, np.zeros(2), method="BFGS").x
    return float(slope), float(offset)


if __name__ == "__main__":
    sys.exit(main())
