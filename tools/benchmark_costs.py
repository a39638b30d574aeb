"""The benchmark's costs: a pair, a whole frame, a batch, the first call, memory."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tracemalloc
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from golden_inputs import rendered
from measuring import able, digits, proportion, timed

METHODS = (
    "hybrid",
    "hybrid-flow",
    "classical",
    "pwvo",
    "pnp-ransac-tuned",
    "poselib",
)
SIZES = ((218, 512), (480, 640), (436, 1024))
BATCHES = (1, 8, 32)
BATCH_SHAPE = (128, 256)
RECORDED = (
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tum/redwood_livingroom_5",
    "real_static/rooms_110",
    "tartanair_v2/P000",
)
"""Static scenes, which have no wrong answer: each that is not ok is doubted for nothing."""
REPEATS = 5
FRESH_PROCESS = """
import json, time
begin = time.perf_counter()
from hybridvo.odometry import warm_up
imported = time.perf_counter()
warm_up("hybrid")
print(json.dumps({"import_s": imported - begin, "warm_up_s": time.perf_counter() - imported}))
"""


def costs(args: argparse.Namespace) -> dict[str, Any]:
    """Everything that is timed on one scene of moderate motion, flow from DIS, depth true."""
    frames = {size: list(rendered("light", 0, size, 8)) for size in SIZES}
    methods, missing = able(METHODS)
    return {
        "missing": missing,
        "pair_ms": {
            f"{w}x{h}": pair_times(frames[h, w], methods) for h, w in SIZES
        },
        "frame_ms": {
            f"{w}x{h}": frame_times(frames[h, w], methods) for h, w in SIZES
        },
        "recorded": {name: recorded(args.data / name) for name in RECORDED},
        "memory_mib": memory(frames[SIZES[-1]], methods),
        "first_call": first_call(),
        "batch": batches(args.seed0),
    }


def pair_of(frames: Any) -> Any:
    from hybridvo import FramePair
    from hybridvo.flow import dis_flow, with_flow

    return with_flow(FramePair(*frames[:2], None), dis_flow())


def pair_times(frames: list[Any], methods: list[str]) -> dict[str, float]:
    """Median wall time of an estimate, ms, the flow given."""
    from hybridvo import estimate

    pair = pair_of(frames)
    return {
        method: median_ms(lambda method=method: estimate(pair, method=method))
        for method in methods
    }


def frame_times(frames: list[Any], methods: list[str]) -> dict[str, float]:
    """Median wall time of a tracked frame, ms, its flow included."""
    from hybridvo import Odometry

    rows = {}
    for method in methods:
        odometry = Odometry(method=method)
        times = [
            timed(lambda frame=frame, o=odometry: o.track(frame))[1]
            for frame in frames
        ]
        rows[method] = digits(np.median(times[2:]))
    return rows


def recorded(folder: Path) -> dict[str, Any]:
    """Answers of the tracker that are not ok, and median wall times, ms: of a tracked frame, of its
    DIS flow, and of the selection, whose mean tells what asking PWVO costs.
    """
    from hybridvo import Odometry, open_sequence
    from hybridvo.pipeline import Context

    if not folder.is_dir():
        return {}
    frames = list(open_sequence(folder))
    odometry = Odometry()
    ctx = Context()
    steps = [timed(lambda frame=frame: odometry.track(frame)) for frame in frames][
        1:
    ]
    flows = [timed(lambda two=two: pair_of(two)) for two in pairwise(frames)]
    found = [ctx.search(pair) for pair, _ in flows]
    selections = [
        timed(lambda motions=motions: ctx.select(motions)) for motions in found
    ]
    timings = {"hybrid": steps, "selection": selections, "dis alone": flows}
    times = {what: [ms for _, ms in some] for what, some in timings.items()}
    return {
        "not_ok": proportion(
            sum(not step.motion.ok for step, _ in steps), len(steps)
        ),
        "ms": {what: digits(np.median(some)) for what, some in times.items()}
        | {"selection in the mean": digits(np.mean(times["selection"]))},
    }


def memory(frames: list[Any], methods: list[str]) -> dict[str, float]:
    """Most that Python's and numpy's allocators held during one estimate, MiB."""
    from hybridvo import estimate

    pair = pair_of(frames)
    rows = {}
    for method in methods:
        tracemalloc.start()
        estimate(pair, method=method)
        rows[method] = digits(tracemalloc.get_traced_memory()[1] / 2**20)
        tracemalloc.stop()
    return rows


def first_call() -> dict[str, Any]:
    """Seconds for import and warm-up in a fresh process, compiled code from its cache."""
    done = subprocess.run(
        [sys.executable, "-c", FRESH_PROCESS],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        return {"error": (done.stderr.strip().splitlines() or ["failed"])[-1]}
    return {name: digits(value) for name, value in json.loads(done.stdout).items()}


def batches(seed0: int) -> list[dict[str, Any]]:
    """Seconds of PWVO's maps of a batch to poses and back to gradients of all maps, on the CPU."""
    from dataclasses import replace

    import torch

    from hybridvo import PWVO, PairBatch, refine, select
    from hybridvo.synthetic.noise_scenarios import make_pair

    pairs = [
        make_pair("moving30", seed0 + k, *BATCH_SHAPE)[0]
        for k in range(max(BATCHES))
    ]
    network = PWVO.from_pretrained()
    rows = []
    for size in BATCHES:
        batch = PairBatch.from_pairs(pairs[:size])
        with torch.no_grad():
            maps = network(batch)

        def forth_and_back(batch: Any = batch, maps: Any = maps) -> None:
            leaves = {
                name: getattr(maps, name).detach().requires_grad_()
                for name in ("motion", "log_scale")
            }
            seed = select(replace(maps, **leaves))
            pose = refine(batch, seed.T_curr_prev, seed.weights).T_curr_prev
            pose.square().sum().backward()

        rows.append(
            {
                "pairs": size,
                "forth_and_back_s": digits(median_ms(forth_and_back) / 1e3),
            }
        )
    return rows


def median_ms(work: Any) -> float:
    """Median wall time after one call that does not count."""
    work()
    return digits(np.median([timed(work)[1] for _ in range(REPEATS)]))
