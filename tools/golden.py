"""Golden figures: what an earlier revision estimated, and what has moved since.

    python tools/golden.py --quick     # a minute, without any data
    python tools/golden.py             # with the recordings below --data
    python tools/golden.py --quick --seeds 3 --overwrite --out docs/golden_quick.json

The last line freezes new figures. The exit code is 1 where something got worse, or
where what an estimator states of itself moved, by more than the spread over random
seeds that the frozen figures carry; 0 otherwise.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from golden_cases.figures import (
    Record,
    Row,
    compare,
    labelled,
    record,
    spread,
    summarise,
)
from golden_cases.quick import cases, measure_quick
from known_pairs import Case, groups, rendered
from measuring import ROOT, parser_of, processor, revision

WALK_FRAMES = 12
WALK_SIZE = (480, 640)
METHODS = {
    "heavy": {
        "dis": ("classical", "hybrid-flow", "hybrid", "pwvo"),
        "true": ("classical", "hybrid-flow"),
    },
    "real": {"file": ("classical", "hybrid"), "dis": ("classical", "hybrid")},
}
"""First word of a group -> flow -> methods that are measured pair by pair."""


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.out is not None and args.out.exists() and not args.overwrite:
        print(f"golden.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    new = measured(args)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(to_text(new), encoding="utf-8")
        return 0
    frozen = ROOT / "docs" / ("golden_quick.json" if args.quick else "golden.json")
    findings = compare(json.loads(frozen.read_text(encoding="utf-8")), new)
    for finding in findings:
        print(finding)
    bad = sum(not finding.startswith("better") for finding in findings)
    print(
        f"golden: {len(new['cases'])} cases, {bad} findings, {new['seconds']:.0f} s"
    )
    return int(bad > 0)


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument(
        "--quick", action="store_true", help="only what needs no data: a minute"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write figures here, compare nothing",
    )
    parser.add_argument(
        "--data", type=Path, default=ROOT / "../shared/data", metavar="DIR"
    )
    parser.add_argument(
        "--only",
        default="",
        metavar="A,B",
        help="cases with one of these in their name",
    )
    parser.add_argument(
        "--seeds", type=int, default=1, help="random seeds; more give the spread"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes of --quick")
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def to_text(result: dict[str, Any]) -> str:
    """JSON with a line for each case."""
    head = {name: value for name, value in result.items() if name != "cases"}
    lines = [
        f"  {json.dumps(name)}: {json.dumps(row)}"
        for name, row in result["cases"].items()
    ]
    text = json.dumps(head, indent=1).removesuffix("\n}")
    return text + ',\n "cases": {\n' + ",\n".join(lines) + "\n }\n}\n"


def measured(args: argparse.Namespace) -> dict[str, Any]:
    """Figures, and where they come from."""
    started = time.perf_counter()
    words = args.only.split(",")
    if args.quick:
        names = [name for name in cases() if any(word in name for word in words)]
        rows = measure_quick(names, args.seeds, args.jobs)
    else:
        rows = measure(args.data, words, args.seeds)
    return {
        "command": "python tools/golden.py " + " ".join(sys.argv[1:]),
        "revision": revision(),
        "processor": processor(),
        "seeds": args.seeds,
        "seconds": round(time.perf_counter() - started, 1),
        "cases": rows,
    }


def measure(data: Path, words: list[str], seeds: int) -> dict[str, Row]:
    """Figures of every case whose name holds one of the words."""
    started = time.perf_counter()
    found: dict[str, Row] = {}

    def put(name: str, work: Callable[[], Row]) -> None:
        found[name] = work()
        seconds = time.perf_counter() - started
        print(f"[{seconds:4.0f} s] {name}", file=sys.stderr, flush=True)

    def is_wanted(name: str) -> bool:
        return any(word in name for word in words)

    for group, make in groups(data).items():
        works = {
            name: work
            for name, work in works_of(group, seeds).items()
            if is_wanted(name)
        }
        made = list(make()) if works else []
        for name, work in works.items():
            # not all recordings have flow files
            if name.split("/")[1] in (group, *made[0].pairs):
                put(name, partial(work, made))
    for method in ("hybrid", "classical"):
        name = f"track/dis/{method}"
        if is_wanted(name):
            put(name, partial(track, method, seeds))
    return found


def works_of(group: str, seeds: int) -> dict[str, Callable[[list[Case]], Row]]:
    """What is measured of the pairs of a group, by the name of the case."""
    works: dict[str, Callable[[list[Case]], Row]] = {}
    for flow, methods in METHODS[group.split("_")[0]].items():
        for method in methods:
            works[f"{group}/{flow}/{method}"] = partial(
                pairs, flow=flow, method=method, seeds=seeds
            )
    return works


def pairs(some: list[Case], flow: str, method: str, seeds: int) -> Row:
    """Figures of a method over pairs; with several seeds also by how much they spread."""
    from hybridvo import estimate

    records: list[list[Record]] = [[] for _ in range(seeds)]
    for case in some[:5] if method == "pwvo" else some:
        pair = case.pairs[flow]
        for seed in range(seeds):
            motion = estimate(pair, method=method, seed=seed)
            truth = case.T_curr_prev, case.depth, pair
            records[seed].append(record(motion, *truth))
    row = summarise(records[0])
    if seeds > 1:
        row["spread"] = spread([summarise(each) for each in records])
    return row


def track(method: str, seeds: int) -> Row:
    """A tracker at 640x480: errors of position in metres."""
    from hybridvo import Odometry

    sequence = rendered("light", 0, WALK_SIZE, WALK_FRAMES)
    frames = [sequence.frame(i) for i in range(WALK_FRAMES)]
    truth = (np.linalg.inv(sequence.poses[0]) @ sequence.poses)[:, :3, 3]
    rows = []
    for seed in range(seeds):
        odometry = Odometry(method=method, seed=seed)
        records = []
        for frame, place in zip(frames, truth, strict=True):
            step = odometry.track(frame)
            status = str(step.status)
            error = float(np.linalg.norm(step.T_world_cam[:3, 3] - place))
            failed = status.startswith("failed")
            records.append(labelled(status, error=error, failed=failed))
        rows.append(summarise(records[1:]))
    row = rows[0] | {"unit": "m"}
    return row | ({"spread": spread(rows)} if seeds > 1 else {})


if __name__ == "__main__":
    sys.exit(main())
