"""Fits the probabilities of being right: prints the numbers of hybridvo/calibration.py.

    python tools/calibrate.py --data ../shared/data

Pairs of the development recordings (tools/benchmark_semi_real.py) in two sizes, half of them before
rendered static scenes; a tenth as many scenes of which no part goes the camera's way; and the heavy
development scenes, seeds 900 to 905, with DIS flow. Right is what those benchmarks call so.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from benchmark import heavy_pairs
from benchmark_semi_real import SEEDS, allowed, calibration_error, draw, static_part
from golden_inputs import HEAVY
from measuring import ego_flow_error, parser_of
from scipy.optimize import minimize
from scipy.special import logsumexp

from hybridvo import dis_flow, iter_pairs, open_sequence, refine
from hybridvo.calibration import DIRECT_PROBABILITY, MIN_PROBABILITY
from hybridvo.evaluation.scores import true_motion
from hybridvo.geometry import pose_matrix
from hybridvo.hypotheses import search
from hybridvo.hypotheses.selector import cues, hypotheses, searched, select_by_cues
from hybridvo.network.models import Models
from hybridvo.photometric.direct import direct_start
from hybridvo.pipeline import Context, pwvo_refine
from hybridvo.results import RelativePose, probability_right
from hybridvo.synthetic.diverse import undetermined_pair
from hybridvo.synthetic.scenarios import SCENARIOS, make_pair
from hybridvo.synthetic.semi_real import PIXELS, load_split
from hybridvo.training.selector_data import RENDERED
from hybridvo.training.validation import area_under_curve

HEAVY_SEEDS = range(900, 906)
STATIC = (
    "tum/rgbd_dataset_freiburg1_xyz_first10",
    "tum/redwood_livingroom_5",
    "real_static/rooms_110",
)
RIDGE = 1e-4
"""Penalty on the squared slopes of evidence of unit variance, times the number of answers."""
CUE_RIDGE = 0.02
SCENARIO_SEEDS = range(500, 512)
"""The same of the cues; seeds of the scenarios that they are fitted on."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--pairs", type=int, default=1000, help="semi-real pairs")
    parser.add_argument(
        "--cues", action="store_true", help="fit the weights of the cues alone"
    )
    parser.add_argument(
        "--selector", metavar="FILE", help="weights instead of the shipped ones"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data"), metavar="DIR"
    )
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.cues:
        print(cue_weights(args))
        return 0
    models = Models(weights={"selector": args.selector} if args.selector else None)
    rows: dict[str, list[tuple[tuple[float, ...], bool]]] = {}
    for still, some in ((False, pairs(args)), (True, static_pairs(args.data))):
        for pair, T, depth, limit in some:
            told = () if still else answers(pair, T, depth, models)
            for name, evidence, error in (*direct_answers(pair, T, depth), *told):
                rows.setdefault(name, []).append(
                    (evidence, error <= allowed(limit))
                )
    for name, some in rows.items():
        right = np.array([row[1] for row in some])
        print(f"{name}: {len(right)} answers, {right.sum()} right")
        if name != "clear" and 0 < right.sum() < len(right):
            evidence = np.array([row[0] for row in some])
            fitted = fit(evidence, right)
            p = np.array([probability_right(x, fitted) for x in evidence])
            print(f"  ({', '.join(f'{w:.2f}' for w in fitted)})")
            area = area_under_curve(p, right)
            error = calibration_error(p, right)
            print(f"  AUROC {area:.3f}, calibration error {error}")
            sure = p >= (
                DIRECT_PROBABILITY if name == "direct" else MIN_PROBABILITY
            )
            flagged = (right & ~sure).sum()
            missed = (~right & sure).sum()
            print(f"  {flagged} right ones below, {missed} wrong ones above")
    return 0


def pairs(
    args: argparse.Namespace,
) -> Iterator[tuple[Any, np.ndarray, np.ndarray, float]]:
    """(pair, true motion, depth of the static pixels, error inside the true mask)."""
    for k in range(args.pairs):
        recordings = load_split(args.data, "development", PIXELS[k % 2])
        drawn = draw("development", k, recordings, rendered=RENDERED)
        yield drawn.pair, drawn.T_curr_prev, *static_part(drawn)
        if k % 10 == 0:
            nowhere = undetermined_pair(
                np.random.default_rng([SEEDS["development"], k]), 218, 512
            )
            yield nowhere.pair, nowhere.T_curr_prev, nowhere.depth, 0.0
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
                limit = ego_flow_error(
                    refine(pair).T_curr_prev, T, pair.prev.depth, pair
                )
                yield pair, T, pair.prev.depth, limit


Answers = Iterator[tuple[str, tuple[float, ...], float]]
"""(which probability, the evidence it is computed from, error in px)."""


def direct_answers(
    pair: Any, T: np.ndarray, depth: np.ndarray, starts: Any = (None,)
) -> Answers:
    """The direct motion from the identity or from other motions (4, 4), sure or not."""
    for start in starts:
        direct = direct_start(pair, start, min_probability=0.0)
        if direct is not None:
            error = ego_flow_error(direct.T_curr_prev, T, depth, pair)
            yield "direct", direct.evidence, error


def answers(pair: Any, T: np.ndarray, depth: np.ndarray, models: Models) -> Answers:
    """The same of both selectors, of PWVO refined, of the direct motion from two of the search."""
    ctx = Context(models=models)
    found = ctx.search(pair)
    if isinstance(found, RelativePose):
        return
    yield from direct_answers(
        pair, T, depth, [pose_matrix(x) for x in found.poses[-2:]]
    )
    batch = pwvo_refine(pair, ctx)
    if batch.usable:
        yield (
            "pwvo-refine",
            batch.evidence,
            ego_flow_error(batch.T_curr_prev, T, depth, pair),
        )
    chosen = {"cues": select_by_cues(found), "selector": ctx.select(found)}
    if not found.is_ambiguous:
        chosen = {"clear": chosen["selector"]}
    for name, selection in chosen.items():
        motion = ctx.refine(pair, found, selection)
        yield (
            name,
            motion.evidence,
            ego_flow_error(motion.T_curr_prev, T, depth, pair),
        )


def cue_weights(args: argparse.Namespace) -> dict[str, float]:
    """Weights by which the right motions of a pair are the likeliest, where some are wrong."""
    scenes = [
        (pair, T, pair.prev.depth, 0.0)
        for kind in HEAVY
        for seed in HEAVY_SEEDS
        for flow, pair, T, _ in heavy_pairs(kind, seed)
        if flow == "true"
    ]
    made = (make_pair(name, seed) for name in SCENARIOS for seed in SCENARIO_SEEDS)
    cells = (
        (pair, truth["T_curr_prev"], truth["depth_true"], 0.0)
        for pair, truth in made
    )
    tables = []
    names = []
    for pair, T, depth, limit in chain(pairs(args), scenes, cells):
        found = Context().search(pair)
        if isinstance(found, RelativePose) or not found.is_ambiguous:
            continue
        alone = [
            c for c in searched(found) if c.facts[search.SOURCE] != search.RUNNER_UP
        ]
        motions = hypotheses(found, alone)
        errors = [ego_flow_error(m.T_curr_prev, T, depth, pair) for m in motions]
        right = np.array(errors) <= allowed(limit)
        if right.any() and not right.all():
            values = cues(found, motions)
            names = list(values)
            tables.append((np.stack(list(values.values()), axis=1), right))
    scale = np.concatenate([values for values, _ in tables]).std(axis=0)

    def cost(w: np.ndarray) -> float:
        scores = [(values / scale @ w, right) for values, right in tables]
        loss = [
            logsumexp(score) - logsumexp(score[right]) for score, right in scores
        ]
        return float(np.mean(loss) + CUE_RIDGE * w @ w / 2)

    fitted = minimize(cost, np.zeros(len(names)), method="BFGS").x / scale
    print(f"cues: {len(tables)} pairs with right and wrong motions")
    return {name: round(float(w), 2) for name, w in zip(names, fitted, strict=True)}


def fit(evidence: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Weights of a logistic regression on evidence (N, k); the last one stands alone."""
    middle = evidence.mean(axis=0)
    spread = evidence.std(axis=0)
    unit = (evidence - middle) / spread
    sign = np.where(right, 1.0, -1.0)

    def cost(w: np.ndarray) -> float:
        loss = np.logaddexp(0, -sign * (unit @ w[:-1] + w[-1]))
        return float(loss.mean() + RIDGE * w[:-1] @ w[:-1] / 2)

    w = minimize(
        cost, np.zeros(evidence.shape[1] + 1), method="BFGS"
    ).x / np.append(spread, 1.0)
    return np.append(w[:-1], w[-1] - middle @ w[:-1])


if __name__ == "__main__":
    sys.exit(main())
