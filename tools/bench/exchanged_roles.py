"""What PWVO's score reads: the role of a motion, or the appearance of what moves so.

    python tools/benchmark.py exchanged_roles --out docs/results/exchanged_roles.json
    python tools/benchmark.py exchanged_roles --split train --weights pwvo.safetensors

A view of :mod:`hybridvo.lab.synthetic.exchanged_roles` has two rigid parts. The difference of the
scores of their motions is measured in it, in the views in which both parts have exchanged one cue,
and in the view with the roles exchanged: each part keeps picture and sensor, and takes the
other's size, place and motion. There a score that reads the role changes its sign. Half of the
sum of both differences stays with the appearance, half of their difference goes with the role.
Where the search lacks one of the two motions, the view is left out of the figure and counted.
"""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measuring import (
    add_workers,
    digits,
    measured,
    parser_of,
    proportion,
    provenance,
    store,
)

from hybridvo import PWVO, Options
from hybridvo.core.results import StageFailed
from hybridvo.hypotheses.calibration import DISTINCT_MOTION_PX
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.search import distances
from hybridvo.hypotheses.select import Ranking, rank_by_scorer
from hybridvo.lab.synthetic.exchanged_roles import (
    CUES,
    DrawnParts,
    TwoParts,
    draw_frames,
    draw_two_parts,
    exchanged,
    with_roles_exchanged,
)
from hybridvo.lab.synthetic.semi_real import Recording, load_split
from hybridvo.network.scorer import PWVOScorer

SEED = 0x5E1F
"""First word of the seed of every view."""
NEAR = 0.25
"""Distance of a candidate from the motion of a part, over that of both motions, up to which it
is that motion: parts bend a little, and no rigid motion is exactly theirs."""
BASE = "as drawn"
ROLES = "roles"


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--views", type=int, default=60, metavar="N")
    add(
        "--split",
        default="development",
        choices=["rendered", "train", "development"],
        help="where pictures come from, beside rendered ones",
    )
    add("--weights", default="pwvo", metavar="FILE", help="of PWVO")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.data = args.data.absolute()
    numbers = {f"view {k}": k for k in range(args.views)}
    found = measured(args, "views", partial(row_of, args), numbers)
    rows = [row for row in found.values() if row]
    result = provenance("benchmark.py exchanged_roles", argv) | {
        "split": args.split,
        "left_out": args.views - len(rows),
    }
    result |= summary_of(rows)
    for name, value in result.items():
        print(name, value, flush=True)
    store(args.out, result)
    return 0


@functools.cache
def recordings_of(data: Path, split: str) -> Sequence[Recording]:
    """The recordings of a part, which a process reads once."""
    return () if split == "rendered" else load_split(data, split)


def row_of(args: argparse.Namespace, number: int) -> dict[str, float]:
    """The differences of scores of one view, by what is exchanged in it.

    They are those of the part that is the world in the view as drawn, less the other one.
    What lacks a motion is missing, and everything if that is the view as drawn.
    """
    network = PWVO.from_pretrained(args.weights)
    rng = np.random.default_rng([SEED, number])
    view = draw_two_parts(rng, recordings_of(args.data, args.split))
    row: dict[str, float] = {}
    for name, changed in variants_of(view).items():
        difference = score_difference(network, draw_frames(changed), view.world)
        if difference is not None:
            row[name] = difference
        elif name == BASE:
            break
    return row


def variants_of(view: TwoParts) -> dict[str, TwoParts]:
    """The view as drawn, with one cue exchanged, and with the roles exchanged."""
    views = {cue: exchanged(view, cue) for cue in CUES}
    return {BASE: view, **views, ROLES: with_roles_exchanged(view)}


def score_difference(network: PWVO, drawn: DrawnParts, number: int) -> float | None:
    """By how much the motion of a part is scored higher than that of the other one, nats.

    None where one of the two was not found.
    """
    starts = np.concatenate([np.eye(4)[None], drawn.motions])
    try:
        found = generate(drawn.pair, starts, Options())
    except StageFailed:
        return None
    ranking = rank_by_scorer(found, PWVOScorer(network, found, None), Options())
    scores = [best_score(ranking, drawn.motions, part) for part in (0, 1)]
    difference = scores[number] - scores[1 - number]
    return difference if np.isfinite(difference) else None


def best_score(ranking: Ranking, motions: np.ndarray, part: int) -> float:
    """The largest score of the candidates that are a part's motion; minus infinity without any."""
    poses = [*motions[:, :3], *ranking.poses]
    away, from_other = (
        distances(ranking.found.grid, poses, number)[len(motions) :]
        for number in (part, 1 - part)
    )
    apart = distances(ranking.found.grid, poses, part)[1 - part]
    is_it = away < max(DISTINCT_MOTION_PX, NEAR * apart)
    is_it &= away < from_other
    return float(ranking.score[is_it].max(initial=-np.inf))


def summary_of(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Which share of the difference each cue has, and what stays with the appearance.

    Args:
        rows: differences of views by what is exchanged in them.
    """
    if not rows:
        return {"views": 0}
    differences = partial(pairs_of, rows)
    parts = {}
    for cue in CUES:
        base, changed = differences(cue)
        parts[cue] = (base - changed) / 2
    sizes = {cue: float(np.abs(part).mean()) for cue, part in parts.items()}
    total = max(sum(sizes.values()), np.finfo(float).tiny)
    base, roles = differences(ROLES)
    stays = np.abs(base + roles).sum()
    goes = np.abs(base - roles).sum()
    both = np.concatenate([base, -roles])
    return {
        "views": len(rows),
        "difference_nats": digits(np.abs(both).mean()),
        "stays_with_appearance": digits(stays / max(stays + goes, 1e-9)),
        "sign_changes": proportion(int((base * roles < 0).sum()), len(base)),
        "world_is_above": proportion(int((both > 0).sum()), len(both)),
        "cues": {
            cue: {
                "share": digits(sizes[cue] / total),
                "nats": digits(sizes[cue]),
                "towards_world_nats": digits(parts[cue].mean()),
                "views": len(parts[cue]),
            }
            for cue in CUES
        },
    }


def pairs_of(
    rows: Sequence[dict[str, float]], name: str
) -> tuple[np.ndarray, np.ndarray]:
    """The differences as drawn, and with something exchanged, of the views that have both."""
    both = [(row[BASE], row[name]) for row in rows if name in row]
    base, changed = np.array(both).reshape(-1, 2).T
    return base, changed


if __name__ == "__main__":
    sys.exit(main())
