"""Fits the probabilities of being right: prints the numbers of hybridvo/calibration.py.

    python tools/calibrate.py --pairs 240 --data ../shared/data

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
from measuring import auroc, ego_flow_error
from scipy.optimize import minimize

HEAVY_SEEDS = range(900, 906)
RIDGE = 0.02
"""Penalty on the squared weights, times the number of answers."""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="calibrate.py", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--pairs", type=int, default=240, help="semi-real pairs")
    parser.add_argument("--heavy", type=int, default=1, help="rendered scenes of each kind")
    parser.add_argument("--selector", metavar="FILE", help="weights instead of the shipped ones")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    rows: dict[str, list[tuple[np.ndarray, bool]]] = {"cues": [], "selector": [], "clear": []}
    for pair, T, depth, limit in pairs(args):
        for name, evidence, error in answers(pair, T, depth, args.selector):
            rows[name].append((evidence, error <= max(WRONG_PX, WRONG_FACTOR * limit)))
    for name, some in rows.items():
        right = np.array([r for _, r in some])
        print(f"{name}: {len(right)} answers, {right.sum()} right")
        if name != "clear" and 0 < right.sum() < len(right):
            X = np.stack([e for e, _ in some])
            weights = fit(X, right)
            p = 1 / (1 + np.exp(-X @ weights[:-1] - weights[-1]))
            print(f"  {tuple(np.round(weights, 3).tolist())}")
            print(f"  AUROC {auroc(p, right)}, calibration error {calibration_error(p, right)}")
    return 0


def pairs(args: argparse.Namespace) -> Iterator[tuple[Any, np.ndarray, np.ndarray, float]]:
    """(pair, true motion, depth of the static pixels, error inside the true mask)."""
    from hybridvo import refine
    from hybridvo.synthetic.semi_real import load_split

    recordings = load_split(args.data, "development")
    for k in range(args.pairs):
        drawn = draw("development", k, recordings)
        depth = np.where(drawn.moving, 0, drawn.depth)
        told = refine(drawn.pair, weights=(~drawn.moving).astype(np.float32))
        limit = ego_flow_error(told.T_curr_prev, drawn.T_curr_prev, depth, drawn.pair)
        yield drawn.pair, drawn.T_curr_prev, depth, limit
    for kind in HEAVY:
        for seed in list(HEAVY_SEEDS)[: args.heavy]:
            for flow, pair, T, _ in heavy_pairs(kind, seed):
                if flow == "dis":
                    yield pair, T, pair.prev.depth, 0.0


def answers(
    pair: Any, T: np.ndarray, depth: np.ndarray, selector: str | None
) -> Iterator[tuple[str, np.ndarray, float]]:
    """(which probability, its evidence, error in px) of both selectors."""
    from hybridvo.hypotheses.selector import CueSelector
    from hybridvo.network.models import Models
    from hybridvo.pipeline import Context
    from hybridvo.results import RelativePose

    weights = {"selector": selector} if selector else None
    ctx = Context(models=MODELS.setdefault(selector, Models(weights=weights)))
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return
    chosen = {"cues": CueSelector().select(found), "selector": ctx.selector().select(found)}
    if not found.is_ambiguous:
        chosen = {"clear": chosen["selector"]}
    for name, selection in chosen.items():
        motion = ctx.refine(pair, found, selection)
        yield name, selection.evidence, ego_flow_error(motion.T_curr_prev, T, depth, pair)


MODELS: dict[str | None, Any] = {}


def fit(X: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Weights and offset of a logistic regression."""
    X = np.column_stack([X, np.ones(len(X))])
    sign = np.where(right, 1.0, -1.0)

    def cost(w: np.ndarray) -> float:
        return float(np.logaddexp(0, -sign * (X @ w)).mean() + RIDGE * (w[:-1] @ w[:-1]) / 2)

    return np.asarray(minimize(cost, np.zeros(X.shape[1]), method="BFGS").x)


if __name__ == "__main__":
    sys.exit(main())
