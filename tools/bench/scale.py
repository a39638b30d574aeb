"""What many sequences cost: frames a core-second, memory, and two workers against one.

    python tools/benchmark.py scale --parts costs,tables --out docs/results/scale.json
    python tools/benchmark.py scale --parts workers --out docs/results/scale.json --overwrite

``costs`` runs methods on a recording as ``hybridvo run`` does, reading and writing included,
in one thread, and takes the processor's time, not that of a clock. ``tables`` takes the time
and the memory of a comparison's tables and report. ``workers`` compares 8 short sequences x 3
methods by one worker and by two: wall times, which are worth something on a quiet machine only.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from measuring import (
    digits,
    methods_here,
    parser_of,
    provenance,
    timed,
    write_result,
)

RECORDING = "tum/rgbd_dataset_freiburg1_rpy_100"
"""A recording of 640x480 below the data folder."""
RECORDED_FRAMES = 40
"""Frames of it."""
METHODS = ("hybrid", "hybrid-flow", "classical", "pnp-ransac-tuned", "poselib")
"""The methods whose time is taken."""
COMPARED = ("hybrid", "classical", "pnp-ransac-tuned")
"""The methods that workers share."""
SEQUENCES = 8
"""Sequences that workers share."""
FRAMES = 20
"""Frames of each of them."""
SIZE = (218, 512)
"""Their rows and columns."""
PAIRS = (30_000, 120_000)
"""Pairs in a comparison's table, of three methods and sequences of 100 frames."""


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--parts", default="costs", help="of " + ", ".join(PARTS))
    add("--repeats", type=int, default=2, help="of which the smallest time counts")
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, default=Path("runs/scale.json"), metavar="FILE")
    add("--overwrite", action="store_true", help="replace its parts in --out")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)

    def measure() -> dict[str, Any]:
        result = {}
        if args.out.exists():
            result = json.loads(args.out.read_text(encoding="utf-8"))
        for part in args.parts.split(","):
            result[part] = provenance("benchmark.py scale", argv) | PARTS[part](
                args
            )
        return result

    return write_result("benchmark.py scale", args.out, args.overwrite, measure)


def costs(args: argparse.Namespace) -> dict[str, Any]:
    """Frames a core-second of each method, and the memory of a process with all of them."""
    import cv2
    import torch

    from hybridvo import open_sequence

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    sequence = open_sequence(args.data / RECORDING)
    methods, missing = methods_here(METHODS)
    rows = {}
    for method in methods:
        # the first call loads kernels and networks
        times_s = [run_time(sequence, method) for _ in range(1 + args.repeats)]
        best_s = min(times_s[1:])
        rows[method] = {
            "core_ms": digits(1e3 * best_s / RECORDED_FRAMES),
            "frames_per_core_s": digits(RECORDED_FRAMES / best_s),
        }
    return {
        "recording": RECORDING,
        "frames": RECORDED_FRAMES,
        "missing": missing,
        "methods": rows,
        "memory_mib": memory_mib(),
    }


def run_time(sequence: Any, method: str) -> float:
    """Seconds of the processor for a whole run of a method."""
    from hybridvo.core.options import Options, RunOptions
    from hybridvo.run.commands.run import run

    options = Options(
        run=RunOptions(method=method, max_failed=1.0, stop=RECORDED_FRAMES)
    )
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        run(sequence, folder, options, mode="overwrite", quiet=True, picture=False)
        return time.process_time() - begin


def memory_mib() -> float:
    """Largest memory of this process so far, MiB."""
    return digits(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)


def tables(args: argparse.Namespace) -> dict[str, Any]:
    """Seconds and memory of the tables and the report of a comparison, by its pairs."""
    rows = []
    for pairs in PAIRS:
        begin = time.process_time()
        size = write_tables(pairs)
        rows.append(
            {
                "pairs": pairs,
                "core_s": digits(time.process_time() - begin),
                "memory_mib": memory_mib(),
                "report_html_mb": digits(size / 1e6),
            }
        )
    return {"rows": rows}


def write_tables(count: int) -> int:
    """Write the results of a made-up comparison; returns the bytes of its report."""
    import numpy as np
    import pandas as pd

    from hybridvo.core.options import Options
    from hybridvo.core.trajectory import Trajectory
    from hybridvo.network.models import Models
    from hybridvo_lab.commands import compare
    from hybridvo_lab.evaluation import scores

    rng = np.random.default_rng(0)
    numbers = np.arange(count)
    table = scores.pair_table(
        pd.DataFrame(
            {
                "sequence": [f"sequence_{k}" for k in numbers // 300],
                "index": numbers % 100,
                "method": np.array(COMPARED)[numbers // 100 % 3],
                "flow_source": "dis",
                "status": "ok",
                **{
                    name: rng.uniform(0.1, 1.0, count)
                    for name in (*scores.ERRORS, *scores.FACTORS, "ms")
                },
            }
        )
    )
    inputs = {"flow_source": "dis", "depth_source": "sensor"}
    rows = []
    for (sequence, method), own in table.groupby(
        ["sequence", "method"], sort=False
    ):
        named = {"sequence": sequence, "method": method, **inputs}
        row = scores.sequence_row(own, None, named)
        rows.append(row | {"trajectory": "path.tum"})
    descriptions = [
        {"name": name, "path": name, **inputs, "pairs_scored": 100}
        | {"left_out": [], "warnings": [], "ground_truth": None}
        for name in dict.fromkeys(table["sequence"])
    ]
    scored = compare._Scored(table, rows, descriptions[0], [])
    with tempfile.TemporaryDirectory() as folder:
        poses = np.tile(np.eye(4), (100, 1, 1))
        poses[:, 0, 3] = rng.uniform(0, 1, 100)
        Trajectory(np.arange(100.0), poses).save(Path(folder) / "path.tum")
        comparison = compare._Comparison(
            Path(folder), COMPARED, Options(), Models(), None, [], [], True, {},
            compare.Workers(),
        )  # fmt: skip
        result = compare._result(comparison, [scored], table)
        result["sequences"] = descriptions
        compare._write(Path(folder), result, table)
        return (Path(folder) / "report.html").stat().st_size


def workers(args: argparse.Namespace) -> dict[str, Any]:
    """Wall time of a comparison in one process, by one worker and by two."""
    from hybridvo_lab.cluster import Workers

    seconds = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = write_sequences(folder, SEQUENCES, FRAMES)
        for count in (1, 2):
            with local_workers(count) as where:
                # the first one loads kernels and networks in every worker
                times_s = [
                    compared(paths, folder / f"{count}_{k}", COMPARED, where)
                    for k in range(1 + args.repeats)
                ]
                seconds[str(count)] = digits(min(times_s[1:]))
        whole_s = compared(paths, folder / "jobs", COMPARED, Workers(jobs=2))
        seconds["jobs 2, start and end included"] = digits(whole_s)
    return {
        "sequences": SEQUENCES,
        "frames": FRAMES,
        "methods": list(COMPARED),
        "seconds": seconds,
        "two_against_one": digits(seconds["1"] / seconds["2"]),
    }


def compared(
    paths: Sequence[Path], out: Path, methods: Sequence[str], where: Any
) -> float:
    """Seconds of a comparison of methods on sequences by some workers."""
    from hybridvo.core.options import FlowOptions, Options
    from hybridvo_lab.commands.compare import compare

    options = Options(flow=FlowOptions(source="dis"))
    _, ms = timed(
        lambda: compare(paths, out, methods=methods, options=options, workers=where)
    )
    return ms / 1e3


@contextlib.contextmanager
def local_workers(count: int) -> Iterator[Any]:
    """So many workers of one thread each, as long as the context lasts."""
    from distributed import LocalCluster

    from hybridvo_lab.cluster import ONE_THREAD, Workers

    with LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        dashboard_address=None,
        memory_limit=0,
        env=ONE_THREAD,
    ) as cluster:
        yield Workers(scheduler=cluster.scheduler_address)


def write_sequences(folder: Path, count: int, frames: int) -> list[Path]:
    """Render the sequences that workers share."""
    from hybridvo_lab.synthetic.render import write_sintel
    from hybridvo_lab.synthetic.scenes import make_scene

    height, width = SIZE
    paths = []
    for seed in range(count):
        name = f"light_{seed}"
        scene = make_scene("light", seed, height=height, width=width, frames=frames)
        write_sintel(scene, folder, name)
        paths.append(folder / "training" / "clean" / name)
    return paths


PARTS: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "costs": costs,
    "tables": tables,
    "workers": workers,
}
"""The parts by name."""
