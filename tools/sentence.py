"""What the parts of the refinement's start are worth: the selected pose, the weights.

    python tools/sentence.py --out docs/results/sentence.json

PWVO's maps of each pair are computed once. Then the refinement starts from the selected
pose or from no motion, with or without PWVO's weights; and the selected pose is taken as it
is. On neighbouring frames of the heavy scenes, and on frames further apart, between which
points move by tens of pixels.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from makers import known_pair
from measuring import digits, ego_flow_error, parser_of, proportion, provenance

from hybridvo import PWVO, PairBatch, refine, select
from hybridvo.core.files import write_json
from hybridvo.lab.calibration import WRONG_PX
from hybridvo.lab.synthetic.paper_samples import KnownPair
from hybridvo.lab.synthetic.scenes import HEAVY, make_scene

STEPS = (1, 3, 5)
"""Frames between the two of a pair."""
SCENE_FRAMES = 20
FIRST_SEED = 9340


class Start(NamedTuple):
    """How the refinement starts."""

    selection: str | None  # of the pose; None: no motion
    has_weights: bool
    is_refined: bool = True


STARTS = {
    "selected pose, weights": Start("softmax", True),
    "mean pose, weights": Start("mean", True),
    "no motion, weights": Start(None, True),
    "selected pose, no weights": Start("softmax", False),
    "no motion, no weights": Start(None, False),
    "selected pose, not refined": Start("softmax", False, is_refined=False),
}


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--scenes", type=int, default=3, help="of each heavy family")
    add("--pairs", type=int, default=5, help="of each scene and step")
    add("--weights", default="pwvo", metavar="FILE", help="of PWVO")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    network = PWVO.from_pretrained(args.weights)
    summary: dict[str, dict[str, Any]] = {}
    for step in STEPS:
        errors: dict[str, list[float]] = {name: [] for name in STARTS}
        for known in heavy_pairs(step, args.scenes, args.pairs):
            if known.pair.flow is None:
                continue
            for name, error in errors_px(network, known).items():
                errors[name].append(error)
        summary[str(step)] = {name: figures(errors[name]) for name in STARTS}
        for name, row in summary[str(step)].items():
            print(step, name, row, flush=True)
    result = provenance("sentence.py", argv) | {"steps": summary}
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(args.out, result)
    return 0


def heavy_pairs(step: int, scenes: int, count: int) -> Iterator[KnownPair]:
    """Pairs of frames of the heavy scenes that are ``step`` frames apart, with DIS flow."""
    for kind in HEAVY:
        for seed in range(FIRST_SEED, FIRST_SEED + scenes):
            scene = make_scene(kind, seed, frames=SCENE_FRAMES)
            firsts = (
                np.linspace(0, SCENE_FRAMES - 1 - step, count).round().astype(int)
            )
            for first in firsts:
                yield known_pair(scene, int(first), int(first) + step, "dis")


@torch.inference_mode()
def errors_px(network: PWVO, known: KnownPair) -> dict[str, float]:
    """Error of every start, px of the ego flow over the static pixels."""
    maps = network(known.pair)
    batch = PairBatch.from_pairs([known.pair])
    depth = np.where(known.moving, 0, known.depth)
    errors = {}
    for name, start in STARTS.items():
        seed = select(maps, start.selection or "softmax")
        T_start = seed.T_curr_prev if start.selection else torch.eye(4)[None]
        T = T_start
        if start.is_refined:
            weights = seed.weights if start.has_weights else None
            T = refine(batch, T_start, weights).T_curr_prev
        motion = T[0].double().numpy()
        errors[name] = ego_flow_error(motion, known.T_curr_prev, depth, known.pair)
    return errors


def figures(errors: list[float]) -> dict[str, Any]:
    """Median error, and the fraction of wrong answers."""
    wrong = sum(error > WRONG_PX for error in errors)
    return {
        "median_px": digits(np.median(errors)),
        "wrong": proportion(wrong, len(errors)),
    }


if __name__ == "__main__":
    sys.exit(main())
