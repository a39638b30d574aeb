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
from benchmark_semi_real import WRONG_FACTOR, WRONG_PX, calibration_error, draw, static_part
from golden_inputs import HEAVY
from measuring import auroc, ego_flow_error, parser_of
from scipy.optimize import minimize

from hybridvo import dis_flow, iter_pairs, open_sequence, refine
from hybridvo.calibration import MIN_CONFIDENCE
from hybridvo.evaluation.pair_errors import true_motion
from hybridvo.hypotheses.selector import select_by_cues
from hybridvo.images.direct import direct_start
from hybridvo.network.models import Models
from hybridvo.pipeline import Context
from hybridvo.results import RelativePose
from hybridvo.synthetic.semi_real import load_split

HEAVY_SEEDS = range(900, 906)
STATIC = (
    "tum/rgbd_dataset_freiburg1_xyz_first10",
    "tum/redwood_livingroom_5",
    "real_static/rooms_110",
)
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
    rows: dict[str, list[tuple[float, bool, bool]]] = {}
    for pair, T, depth, limit in pairs(args):
        for name, gap, error in answers(pair, T, depth, models):
            is_right = error <= max(WRONG_PX, WRONG_FACTOR * limit)
            rows.setdefault(name, []).append((gap, is_right, False))
    for pair, T, depth, limit in static_pairs(args.data):
        found = direct_start(pair)
        if found is not None:
            error = ego_flow_error(found.T_curr_prev, T, depth, pair)
            is_right = error <= max(WRONG_PX, WRONG_FACTOR * limit)
            rows["direct"].append((100 * found.inlier_ratio, is_right, True))
    for name, some in rows.items():
        right, still = (np.array([row[k] for row in some]) for k in (1, 2))
        print(f"{name}: {len(right)} answers, {right.sum()} right")
        if name != "clear" and 0 < right.sum() < len(right):
            gaps = np.array([row[0] for row in some])
            share = max(still.mean(), 1e-9)
            # static scenes and those with movers count alike
            weights = np.where(still, 0.5 / share, 0.5 / (1 - share)) if still.any() else 1.0
            slope, offset = fit(gaps, right, weights)
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
        yield drawn.pair, drawn.T_curr_prev, *static_part(drawn)
    for kind in HEAVY:
        for seed in HEAVY_SEEDS:
            for flow, pair, T, _ in heavy_pairs(kind, seed):
                if flow == "dis":
                    yield pair, T, pair.prev.depth, 0.0


def static_pairs(data: Path) -> Iterator[tuple[Any, np.ndarray, np.ndarray, float]]:
    """The same of neighbouring frames of static recordings, which no test is made on."""
    for name in STATIC:
        sequence = open_sequence(data / name)
        for k, pair in enumerate(iter_pairs(sequence, dis_flow())):
            T = true_motion(sequence, k, k + 1)
            if T is not None and pair.flow is not None:
                limit = ego_flow_error(refine(pair).T_curr_prev, T, pair.prev.depth, pair)
                yield pair, T, pair.prev.depth, limit


def answers(
    pair: Any, T: np.ndarray, depth: np.ndarray, models: Models
) -> Iterator[tuple[str, float, float]]:
    """(which probability, the gap it is computed from, error in px) of both selectors."""
    ctx = Context(models=models)
    direct = direct_start(pair)
    if direct is not None:
        error = ego_flow_error(direct.T_curr_prev, T, depth, pair)
        yield "direct", 100 * direct.inlier_ratio, error
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return
    chosen = {"cues": select_by_cues(found), "selector": ctx.select(pair, found)}
    if not found.is_ambiguous:
        chosen = {"clear": chosen["selector"]}
    for name, selection in chosen.items():
        motion = ctx.refine(pair, found, selection)
        yield name, selection.gap, ego_flow_error(motion.T_curr_prev, T, depth, pair)


def fit(gaps: np.ndarray, right: np.ndarray, weights: Any = 1.0) -> tuple[float, float]:
    """Slope and offset of a logistic regression."""
    middle = gaps.mean()
    sign = np.where(right, 1.0, -1.0)

    def cost(w: np.ndarray) -> float:
        loss = np.logaddexp(0, -sign * (w[0] * (gaps - middle) + w[1]))
        return float((weights * loss).mean() + RIDGE * w[0] ** 2 / 2)

    slope, offset = minimize(cost, np.zeros(2), method="BFGS").x
    return float(slope), float(offset - slope * middle)


if __name__ == "__main__":
    sys.exit(main())
