"""Golden figures: what an earlier revision estimated on kept inputs, and what has moved since.

    python tools/golden.py --against docs/golden.json     # the frozen figures
    python tools/golden.py --seeds 3 --out docs/golden.json --overwrite    # freeze

Only public names are called. The exit code is 1 where something got worse by
more than the spread over random seeds that the frozen figures carry, 0 otherwise.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from golden_compare import compare
from golden_inputs import HEAVY, read_pair, write_inputs
from measuring import ROOT, digits, parser_of, processor, revision, score
from scipy.spatial.transform import Rotation

TIMED_PAIRS, REPEATS = 3, 3
PRIORS = {"true": (0.01, 0.003), "before": (0.03, 0.01), "wrong": (0.01, 0.003)}
"""Priors handed in, with their standard deviations in m and rad."""
WRONG_PRIOR = (np.array([0.3, -0.1, 0.2]), np.array([0.05, 0.08, -0.03]))
"""By how much the wrong prior is off, m and rad: thirty of its standard deviations."""
PRIOR_PAIRS = 10


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    if args.out is not None and args.out.exists() and not args.overwrite:
        print(f"golden.py: {args.out} exists; pass --overwrite.", file=sys.stderr)
        return 2
    if not (args.inputs / "index.json").is_file():
        write_inputs(args.inputs, args.data)
    new = measure(args.inputs, args.only, args.seeds)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(to_text(new), encoding="utf-8")
    if args.against is None:
        return 0
    findings = compare(json.loads(args.against.read_text(encoding="utf-8")), new)
    for finding in findings:
        print(finding)
    worse = sum(finding.startswith("WORSE") for finding in findings)
    print(f"{len(new['cases'])} cases, {worse} findings of something worse, {new['seconds']:.0f} s")
    return int(worse > 0)


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the figures here")
    parser.add_argument("--against", type=Path, metavar="FILE", help="figures to compare with")
    parser.add_argument("--inputs", type=Path, default=ROOT / "runs/golden/inputs", metavar="DIR")
    parser.add_argument("--data", type=Path, default=ROOT / "../shared/data", metavar="DIR")
    parser.add_argument(
        "--only", default="", metavar="A,B", help="cases with one of these in their name"
    )
    parser.add_argument("--seeds", type=int, default=1, help="random seeds; more give the spread")
    parser.add_argument("--overwrite", action="store_true", help="replace --out")
    return parser


def to_text(result: dict[str, Any]) -> str:
    """JSON with a line for each case."""
    head = {name: value for name, value in result.items() if name != "cases"}
    lines = [f"  {json.dumps(name)}: {json.dumps(row)}" for name, row in result["cases"].items()]
    text = json.dumps(head, indent=1).removesuffix("\n}")
    return text + ',\n "cases": {\n' + ",\n".join(lines) + "\n }\n}\n"


def measure(inputs: Path, only: str, seeds: int) -> dict[str, Any]:
    """Figures of every case whose name holds one of the words in ``only``."""
    started = time.perf_counter()
    cases: dict[str, Any] = {}
    runs: dict[str, Callable[[], dict[str, Any]]] = {}
    for group, flow, method in pair_cases(inputs):
        files = sorted((inputs / group).glob("*.npz"))
        if method == "pwvo":
            files = files[:5]
        runs[f"{group}/{flow}/{method}"] = lambda f=files, w=flow, m=method: pairs(f, w, m, seeds)
    runs |= prior_cases(inputs)
    runs["track/dis/hybrid"] = lambda: track(inputs, "hybrid", seeds)
    runs["track/dis/refine"] = lambda: track(inputs, "refine", seeds)
    for name, run in runs.items():
        if any(word in name for word in only.split(",")):
            cases[name] = run()
            print(f"[{time.perf_counter() - started:4.0f} s] {name}", file=sys.stderr, flush=True)
    return {
        "command": "python tools/golden.py " + " ".join(sys.argv[1:]),
        "revision": revision(),
        "processor": processor(),
        "inputs": json.loads((inputs / "index.json").read_text())["key"],
        "seeds": seeds,
        "seconds": round(time.perf_counter() - started, 1),
        "cases": cases,
    }


def pair_cases(inputs: Path) -> Iterator[tuple[str, str, str]]:
    """(group, flow, method) of everything that is measured pair by pair."""
    groups = sorted(path.name for path in inputs.iterdir() if path.is_dir())
    for group in groups:
        if group in HEAVY:
            yield from ((group, "dis", m) for m in ("refine", "hybrid-flow", "hybrid", "pwvo"))
            yield from ((group, "true", method) for method in ("refine", "hybrid-flow"))
        elif group.startswith("scenario_"):
            yield from ((group, "made", method) for method in ("refine", "hybrid-flow"))
        elif group.startswith("degenerate_"):
            yield from ((group, "made", method) for method in ("refine", "hybrid"))
        elif group == "model_noise":
            yield group, "made", "refine"
        elif group.startswith("real_"):
            with np.load(next((inputs / group).glob("*.npz"))) as file:
                flows = [name.removeprefix("flow.") for name in file.files if name[:5] == "flow."]
            yield from ((group, flow, m) for flow in flows for m in ("refine", "hybrid"))
    yield "scenario_moving30", "made", "pwvo"


def pairs(files: list[Path], flow: str, method: str, seeds: int) -> dict[str, Any]:
    """Figures of a method over pairs; with several seeds also by how much they spread."""
    from hybridvo import estimate

    estimate(read_pair(files[0], flow)[0], method=method)  # what is paid once is not timed
    records: list[list[dict[str, Any]]] = [[] for _ in range(seeds)]
    times = []
    for k, file in enumerate(files):
        pair, *truth, _ = read_pair(file, flow)
        for seed in range(seeds):
            records[seed].append(score(estimate(pair, method=method, seed=seed), *truth, pair))
        if k < TIMED_PAIRS:
            times.append(least_ms(lambda pair=pair: estimate(pair, method=method)))
    row = summarise(records[0]) | {"ms": round(float(np.median(times)), 2)}
    if seeds > 1:
        row["spread"] = spread([summarise(some) for some in records])
    return row


def prior_cases(inputs: Path) -> dict[str, Callable[[], dict[str, Any]]]:
    """The heavy pairs with the true motion, the one before and a wrong one as prior."""
    runs: dict[str, Callable[[], dict[str, Any]]] = {}
    for group in HEAVY:
        files = sorted((inputs / group).glob("*.npz"))[:PRIOR_PAIRS]
        for method in ("refine", "hybrid-flow", "hybrid"):
            for kind in PRIORS:
                name = f"prior_{kind}/{group}/{method}"
                runs[name] = lambda f=files, m=method, k=kind: with_prior(f, m, k)
    return runs


def with_prior(files: list[Path], method: str, kind: str) -> dict[str, Any]:
    """Figures with a prior, and under ``without`` those of the same pairs without one."""
    from hybridvo import MotionPrior, estimate

    records, without = [], []
    std_m, std_rad = PRIORS[kind]
    covariance = np.diag([std_m**2] * 3 + [std_rad**2] * 3)
    for file in files:
        pair, *truth, T_before = read_pair(file, "dis")
        T = truth[0].copy() if kind != "before" else T_before
        if T is None:
            continue
        if kind == "wrong":
            T[:3, 3] += WRONG_PRIOR[0]
            T[:3, :3] = Rotation.from_rotvec(WRONG_PRIOR[1]).as_matrix() @ T[:3, :3]
        prior = MotionPrior(T, covariance)
        records.append(score(estimate(pair, method=method, prior=prior), *truth, pair))
        without.append(score(estimate(pair, method=method), *truth, pair))
    return summarise(records) | {"without": summarise(without)}


def summarise(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of one case."""
    errors = [record["error"] for record in records]
    nees = [record["nees"] for record in records if record["nees"] is not None]
    return {
        "pairs": len(records),
        "median": digits(np.median(errors)),
        "worst": digits(max(errors)),
        **{key: sum(r[key] for r in records) for key in ("failed", "unflagged", "overconfident")},
        "status": dict(sorted(Counter(record["status"] for record in records).items())),
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


def track(inputs: Path, method: str, seeds: int) -> dict[str, Any]:
    """A tracker at 640x480: errors of position in metres, time of a whole frame with its flow."""
    from hybridvo import Camera, Frame, Odometry

    with np.load(inputs / "walk.npz") as file:
        arrays = dict(file)
    poses = np.linalg.inv(arrays["poses"][0]) @ arrays["poses"]
    camera = Camera.from_matrix(arrays["K"], *arrays["depth"].shape[1:])
    images = zip(arrays["rgb"], arrays["depth"], arrays["time"], strict=True)
    frames = [
        Frame(rgb, depth, camera, timestamp=float(stamp), index=i)
        for i, (rgb, depth, stamp) in enumerate(images)
    ]
    rows, times = [], []
    for seed in range(max(seeds, REPEATS)):
        odometry = Odometry(method=method, seed=seed if seeds > 1 else 0)
        records, spent = [], []
        for frame, pose in zip(frames, poses, strict=True):
            begin = time.process_time()
            step = odometry.track(frame)
            spent.append(1e3 * (time.process_time() - begin))
            records.append(along_path(step.T_world_cam, pose, str(step.motion.status)))
        rows.append(summarise(records[1:]))
        times.append(spent[1:])
    row = rows[0] | {"unit": "m", "ms": round(float(np.median(np.min(times, axis=0))), 2)}
    return row | ({"spread": spread(rows)} if seeds > 1 else {})


def along_path(T: np.ndarray, T_true: np.ndarray, status: str) -> dict[str, Any]:
    """A pose of a path as a record: its error is the distance to the true place, in metres."""
    failed = status.startswith("failed")
    record = {"error": float(np.linalg.norm(T[:3, 3] - T_true[:3, 3])), "status": status}
    return record | {"failed": failed, "unflagged": False, "overconfident": False, "nees": None}


def least_ms(work: Callable[[], Any]) -> float:
    """Processor time in ms, the least of a few: other programs on the machine disturb it least."""
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - begin))
    return min(times)


if __name__ == "__main__":
    sys.exit(main())
