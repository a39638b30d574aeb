"""Two real recordings in one view: whose motion is taken for the camera's, by how much of the view
the moving one covers.

    python tools/benchmark.py two_recordings --clips 40 --out docs/results/two_recordings.json

Clips of :mod:`hybridvo_lab.synthetic.two_recordings` of places that no training saw, each with its
recordings exchanged as well, tracked as a user would. A step is wrong by the rule of
tools/bench/semi_real.py. Where the world and the thing are exchanged, the probabilities of one
recording to be the world should sum to one.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measuring import (
    add_workers,
    digits,
    ego_flow_error,
    measured,
    parser_of,
    proportion,
    provenance,
    store,
    timed,
)

from bench.semi_real import answer_row, static_part
from hybridvo import FramePair, Odometry, dis_flow
from hybridvo.flow.providers import with_flow
from hybridvo_lab.synthetic.paper_samples import KnownPair
from hybridvo_lab.synthetic.recordings import Recording
from hybridvo_lab.synthetic.two_recordings import (
    Clip,
    compose,
    draw_two_recordings,
    load_places,
)
from hybridvo_lab.training.validation import allowed_error_px, area_under_curve

METHODS = ("hybrid", "classical", "opencv-rgbd", "poselib")
MIN_MOVING = 0.02
"""Smallest moving fraction of the view of a step that counts."""
SUM_TOLERANCE = 0.2
"""How far from one the probabilities of a recording in its two roles may sum."""
PARTS = {"below half": (0.0, 0.5), "above half": (0.5, 1.0)}
"""Fraction of the view that moves."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--clips", type=int, default=40)
    add("--frames", type=int, default=6, help="of a clip")
    add("--seed", type=int, default=0, help="of the clips")
    add("--methods", default=",".join(METHODS))
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    add_workers(parser)
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    args.data = args.data.absolute()
    numbers = {f"clip {k}": k for k in range(args.clips)}
    found = measured(args, "clips", partial(clip_rows, args), numbers)
    rows = [row for of_clip in found.values() for row in of_clip]
    result = provenance("benchmark.py two_recordings", argv)
    result |= {"clips": len(found), "steps": len(rows), "methods": {}}
    for method in args.methods.split(","):
        summary = summarise(rows, method)
        result["methods"][method] = summary
        for part, row in summary.items():
            print(method, part, row, flush=True)
    store(args.out, result)
    return 0


@functools.cache
def places_of(data: Path) -> dict[str, list[Recording]]:
    """The recordings of places that no training saw, which a process reads once."""
    return load_places(data, ("development", "test"))


def clip_rows(args: argparse.Namespace, number: int) -> list[dict[str, Any]]:
    """Answers of every method to the steps of a clip, and of the same with exchanged roles."""
    rng = np.random.default_rng([args.seed, number])
    places = places_of(args.data)
    parts = draw_two_recordings(rng, places, args.frames)
    rows = []
    for role, each in enumerate((parts, parts.exchanged())):
        clip = compose(each)
        trackers = {
            method: tracked(clip, method) for method in args.methods.split(",")
        }
        for steps in zip(*trackers.values(), strict=True):
            row = {
                "clip": number,
                "role": role,
                "known": clip.is_known,
                "moving": steps[0].pop("moving"),
                "step": steps[0].pop("step"),
            }
            rows.append(row | dict(zip(trackers, steps, strict=True)))
    return rows


def tracked(clip: Clip, method: str) -> Iterator[dict[str, Any]]:
    """The answers of a tracker to the steps of a clip."""
    frames = [clip.pairs[0].pair.prev, *(known.pair.curr for known in clip.pairs)]
    odometry = Odometry(method=method)
    for k, frame in enumerate(frames):
        step, ms = timed(partial(odometry.track, replace(frame, index=k)))
        if not k:
            continue
        start = k - 1 if step.prev_index is None else step.prev_index
        known = between(clip, start, k)
        static = static_part(known)
        row = answer_row(step.motion, known, static)
        of = "world"
        if row["wrong"]:
            T_thing = chained(clip.T_thing[start:k])
            of = "thing" if is_of_thing(step.motion, known, T_thing) else "neither"
        row |= {"ms": digits(ms), "of": of}
        yield row | {"moving": digits(known.moving.mean()), "step": k}


def between(clip: Clip, start: int, stop: int) -> KnownPair:
    """The pair of two frames of a clip that need not be neighbours."""
    known = clip.pairs[start]
    if stop == start + 1:
        return known
    T = chained([each.T_curr_prev for each in clip.pairs[start:stop]])
    pair = FramePair(known.pair.prev, clip.pairs[stop - 1].pair.curr, None)
    return replace(known, pair=with_flow(pair, dis_flow()), T_curr_prev=T)


def chained(motions: Sequence[np.ndarray]) -> np.ndarray:
    """The motion (4, 4) of several, one after the other."""
    T = np.eye(4)
    for each in motions:
        T = each @ T
    return T


def is_of_thing(motion: Any, known: KnownPair, T_thing: np.ndarray) -> bool:
    """Return whether an answer about a pair is the motion of its thing, (4, 4)."""
    thing = static_part(replace(known, T_curr_prev=T_thing, moving=~known.moving))
    error = ego_flow_error(motion.T_curr_prev, T_thing, thing.depth, known.pair)
    return bool(error <= allowed_error_px(thing.oracle_px))


# --- figures ----------------------------------------------------------------------


def summarise(rows: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """Figures of a method, by how much of the view moves."""
    counted = [row for row in rows if row["moving"] >= MIN_MOVING]
    summary = {}
    for name, (low, high) in PARTS.items():
        of_part = [row for row in counted if low <= row["moving"] < high]
        summary[name] = part_figures(of_part, method)
    known = [row for row in counted if row["known"]]
    summary["scene along the border"] = part_figures(known, method)
    summary["roles exchanged"] = role_figures(counted, method)
    return summary


def part_figures(rows: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """Wrong answers among some steps, and what the probability says of them."""
    answers = [row[method] for row in rows]
    wrong = np.array([each["wrong"] for each in answers], bool)
    ok = np.array([each["status"] == "ok" for each in answers], bool)
    of_thing = np.array([each["of"] == "thing" for each in answers], bool)
    probability = np.array([each["probability"] for each in answers])
    clips = {row["clip"] for row in rows}
    bad = {row["clip"] for row, each in zip(rows, wrong, strict=True) if each}
    return {
        "wrong": proportion(int(wrong.sum()), len(rows)),
        "wrong_ok": proportion(int((wrong & ok).sum()), len(rows)),
        "of_the_thing": proportion(int(of_thing.sum()), len(rows)),
        "right_not_ok": proportion(int((~wrong & ~ok).sum()), int((~wrong).sum())),
        "clips_with_wrong": proportion(len(bad), len(clips)),
        "auroc": area_under_curve(probability, ~wrong),
        "ms": digits(np.median([each["ms"] for each in answers] or [0])),
    }


def role_figures(rows: list[dict[str, Any]], method: str) -> dict[str, Any]:
    """How often the probabilities of a recording in its two roles sum to one.

    They do where the recording that is the world has the same probability in both orders.
    """
    of_world: dict[tuple[int, int], list[float]] = {}
    for row in rows:
        answer = row[method]
        if answer["of"] == "neither":
            continue
        p = answer["probability"]
        of_world.setdefault((row["clip"], row["step"]), []).append(
            p if answer["of"] == "world" else 1 - p
        )
    both = [found for found in of_world.values() if len(found) == 2]
    fair = sum(abs(first - second) <= SUM_TOLERANCE for first, second in both)
    return {"sum_to_one": proportion(fair, len(both))}
