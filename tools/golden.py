"""Golden figures: what an earlier revision estimated, and what has moved since.

    python tools/golden.py --against docs/golden.json     # the frozen figures
    python tools/golden.py --seeds 3 --out docs/golden.json --overwrite    # freeze

The exit code is 1 where something got worse by
more than the spread over random seeds that the frozen figures carry, 0 otherwise.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from golden_inputs import HEAVY, Case, groups, rendered
from measuring import ROOT, digits, parser_of, processor, revision, score
from scipy.spatial.transform import Rotation

PRIORS = {"true": (0.01, 0.003), "before": (0.03, 0.01), "wrong": (0.01, 0.003)}
"""Priors handed in, with their standard deviations in m and rad."""
WRONG_PRIOR = (np.array([0.3, -0.1, 0.2]), np.array([0.05, 0.08, -0.03]))
"""By how much the wrong prior is off, m and rad: thirty of its standard deviations."""
PRIOR_PAIRS = 10
PRIOR_METHODS = ("classical", "hybrid-flow", "hybrid")
WALK_FRAMES = 12
WALK_SIZE = (480, 640)
METHODS = {
    "heavy": {
        "dis": ("classical", "hybrid-flow", "hybrid", "pwvo"),
        "true": ("classical", "hybrid-flow"),
    },
    "scenario": {"made": ("classical", "hybrid-flow")},
    "degenerate": {"made": ("classical", "hybrid")},
    "model": {"made": ("classical",)},
    "real": {"file": ("classical", "hybrid"), "dis": ("classical", "hybrid")},
}
"""First word of a group -> flow -> methods that are measured pair by pair."""
EXPECTED_NEES = 5.35
"""Median of chi-square with six degrees of freedom."""
MODEL_NEES = (4.0, 8.0)
"""Median under the noise that the refinement assumes, over 60 pairs."""
NEES_FACTOR = 1.5
"""By how much more the normalised error may miss its expectation."""
MEDIAN_FACTOR = 1.05
ELSEWHERE_FACTOR = 1.2
WORST_FACTOR = 1.5
TOLERANCE = {"px": 1e-5, "m": 1e-6}
"""Differences that say nothing: below the last digits of the inputs."""
STATUS_SHARE = 0.1
"""Share of the pairs of a case, one pair at least, whose status or reason may change."""


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.out is not None and args.out.exists() and not args.overwrite:
        print(f"golden.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    new = measure(args.data, args.only, args.seeds)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(to_text(new), encoding="utf-8")
    if args.against is None:
        return 0
    findings = compare(json.loads(args.against.read_text(encoding="utf-8")), new)
    for finding in findings:
        print(finding)
    worse = sum(finding.startswith("WORSE") for finding in findings)
    print(
        f"{len(new['cases'])} cases, {worse} findings of something worse, {new['seconds']:.0f} s"
    )
    return int(worse > 0)


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="write the figures here"
    )
    parser.add_argument(
        "--against", type=Path, metavar="FILE", help="figures to compare with"
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


def measure(data: Path, only: str, seeds: int) -> dict[str, Any]:
    """Figures of every case whose name holds one of the words in ``only``."""
    started = time.perf_counter()
    found: dict[str, Any] = {}

    def put(name: str, work: Callable[[], dict[str, Any]]) -> None:
        found[name] = work()
        print(
            f"[{time.perf_counter() - started:4.0f} s] {name}",
            file=sys.stderr,
            flush=True,
        )

    def is_wanted(name: str) -> bool:
        return any(word in name for word in only.split(","))

    for group, make in groups(data).items():
        works: dict[str, Callable[[list[Case]], dict[str, Any]]] = {}
        for flow, methods in METHODS[group.split("_")[0]].items():
            for m in methods:
                works[f"{group}/{flow}/{m}"] = partial(
                    pairs, flow=flow, method=m, seeds=seeds
                )
        for m, kind in product(PRIOR_METHODS, PRIORS if group in HEAVY else ()):
            works[f"prior_{kind}/{group}/{m}"] = partial(
                with_prior, method=m, kind=kind
            )
        wanted = {name: work for name, work in works.items() if is_wanted(name)}
        cases = list(make()) if wanted else []
        for name, work in wanted.items():
            # not all recordings have flow files
            if name.split("/")[1] in (group, *cases[0].pairs):
                put(name, partial(work, cases))
    for method in ("hybrid", "classical"):
        if is_wanted(name := f"track/dis/{method}"):
            put(name, partial(track, method, seeds))
    return {
        "command": "python tools/golden.py " + " ".join(sys.argv[1:]),
        "revision": revision(),
        "processor": processor(),
        "seeds": seeds,
        "seconds": round(time.perf_counter() - started, 1),
        "cases": found,
    }


def pairs(cases: list[Case], flow: str, method: str, seeds: int) -> dict[str, Any]:
    """Figures of a method over pairs; with several seeds also by how much they spread."""
    from hybridvo import estimate

    records: list[list[dict[str, Any]]] = [[] for _ in range(seeds)]
    for case in cases[:5] if method == "pwvo" else cases:
        pair = case.pairs[flow]
        for seed in range(seeds):
            motion = estimate(pair, method=method, seed=seed)
            records[seed].append(score(motion, case.T_curr_prev, case.depth, pair))
    row = summarise(records[0])
    if seeds > 1:
        row["spread"] = spread([summarise(some) for some in records])
    return row


def with_prior(cases: list[Case], method: str, kind: str) -> dict[str, Any]:
    """Figures with a prior, and under ``without`` those of the same pairs without one."""
    from hybridvo import MotionPrior, estimate

    records = []
    without = []
    std_m, std_rad = PRIORS[kind]
    covariance = np.diag([std_m**2] * 3 + [std_rad**2] * 3)
    for case in cases[:PRIOR_PAIRS]:
        pair = case.pairs["dis"]
        truth = (case.T_curr_prev, case.depth, case.pairs["dis"])
        T = case.T_before if kind == "before" else case.T_curr_prev.copy()
        if T is None:
            continue
        if kind == "wrong":
            T[:3, 3] += WRONG_PRIOR[0]
            T[:3, :3] = Rotation.from_rotvec(WRONG_PRIOR[1]).as_matrix() @ T[:3, :3]
        prior = MotionPrior(T, covariance)
        records.append(score(estimate(pair, method=method, prior=prior), *truth))
        without.append(score(estimate(pair, method=method), *truth))
    return summarise(records) | {"without": summarise(without)}


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of one case."""
    errors = [record["error"] for record in records]
    nees = [record["nees"] for record in records if record["nees"] is not None]
    return {
        "pairs": len(records),
        "median": digits(np.median(errors)),
        "worst": digits(max(errors)),
        **{
            key: sum(r[key] for r in records)
            for key in ("failed", "unflagged", "overconfident")
        },
        "status": dict(
            sorted(Counter(record["status"] for record in records).items())
        ),
        "nees": digits(np.median(nees)) if nees else None,
    }


def spread(rows: list[dict[str, Any]]) -> dict[str, float]:
    """By how much the figures of the same pairs differ between random seeds, at most."""
    found = {}
    for key in ("median", "worst", "failed", "unflagged", "overconfident"):
        values = [row[key] for row in rows]
        found[key] = digits(max(values) - min(values))
    first = Counter(rows[0]["status"])
    found["status"] = max((first - Counter(row["status"])).total() for row in rows)
    return {key: value for key, value in found.items() if value}


def track(method: str, seeds: int) -> dict[str, Any]:
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
            error = np.linalg.norm(step.T_world_cam[:3, 3] - place)
            failed = {"failed": status.startswith("failed"), "nees": None}
            failed |= dict.fromkeys(("unflagged", "overconfident"), False)
            records.append({"error": float(error), "status": status} | failed)
        rows.append(summarise(records[1:]))
    row = rows[0] | {"unit": "m"}
    return row | ({"spread": spread(rows)} if seeds > 1 else {})


# -- what has moved ------------------------------------------------------------------------------


def compare(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Findings, a line each: WORSE or better.

    Bounds are wider where the processor differs. A case that the old figures do not have is judged
    by itself alone; one that the new ones lack is left out.
    """
    findings = []
    factor = (
        MEDIAN_FACTOR if old["processor"] == new["processor"] else ELSEWHERE_FACTOR
    )
    for name, row in new["cases"].items():
        if "without" in row:
            lines = [
                (level, f"than without it: {text}")
                for level, text in beside_none(name, row)
            ]
        else:
            lines = []
            if (
                name.startswith("model_noise")
                and not MODEL_NEES[0] <= row["nees"] <= MODEL_NEES[1]
            ):
                lines.append(
                    (
                        "WORSE",
                        f"normalised error {row['nees']:.3g}, not in {MODEL_NEES}",
                    )
                )
            if name in old["cases"]:
                lines += judge_beside(old["cases"][name], row, factor)
        findings += [f"{level} {name}: {text}" for level, text in lines]
    return sorted(findings, key=lambda line: line.split(" ")[0] == "better")


def judge_beside(
    old: dict[str, Any], new: dict[str, Any], factor: float
) -> list[tuple[str, str]]:
    """Findings of one case beside its earlier figures."""
    found = []
    spread = old.get("spread", {})
    tolerance = TOLERANCE[new.get("unit", "px")]
    bounds = {  # factor on the earlier figure, and what may come on top
        **dict.fromkeys(("failed", "unflagged"), (1.0, 0.0)),
        "overconfident": (1.0, max(1, 0.05 * old["pairs"])),
        "median": (factor, tolerance),
    }
    if not new["failed"]:  # with failures the worst says nothing
        bounds["worst"] = WORST_FACTOR, tolerance
    for key, (times, more) in bounds.items():
        if new[key] > times * old[key] + more + spread.get(key, 0):
            found.append(("WORSE", f"{key} {old[key]:.4g} -> {new[key]:.4g}"))
    if old["median"] > factor * new["median"] + tolerance + spread.get("median", 0):
        found.append(
            ("better", f"median error {old['median']:.4g} -> {new['median']:.4g}")
        )
    changed = (Counter(old["status"]) - Counter(new["status"])).total()
    if changed > max(1, STATUS_SHARE * old["pairs"]) + spread.get("status", 0):
        found.append(("WORSE", f"status {old['status']} -> {new['status']}"))
    # the covariance of a degraded motion covers its doubt: more of them lower the median
    before, now = (
        sum(
            count
            for status, count in row["status"].items()
            if status.startswith("degraded")
        )
        for row in (old, new)
    )
    doubted = now > before and (new["nees"] or 0) < EXPECTED_NEES
    if not doubted and miss(new["nees"]) > miss(old["nees"]) + math.log(
        NEES_FACTOR
    ):
        found.append(
            ("WORSE", f"normalised error {old['nees']:.3g} -> {new['nees']:.3g}")
        )
    return found


def beside_none(name: str, row: dict[str, Any]) -> list[tuple[str, str]]:
    """A prior beside none on the same pairs: a true one never makes an answer worse."""
    without = row["without"]
    lenient = 0 if name.startswith("prior_true") else 1
    found = []
    for key in ("failed", "unflagged"):
        if row[key] > without[key] + lenient:
            found.append(
                ("WORSE", f"{key} {without[key]} -> {row[key]} of {row['pairs']}")
            )
    if row["median"] > MEDIAN_FACTOR * without["median"] + TOLERANCE["px"]:
        found.append(
            (
                "WORSE",
                f"median error {without['median']:.4g} -> {row['median']:.4g}",
            )
        )
    return found


def miss(nees: float | None) -> float:
    """How far, in logarithms, a median normalised error is from what is expected."""
    return 0.0 if nees is None else abs(math.log(max(nees, 1e-9) / EXPECTED_NEES))


if __name__ == "__main__":
    sys.exit(main())
