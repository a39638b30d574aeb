"""The benchmark's costs: a pair, a whole frame, a batch, the first call, memory."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tracemalloc
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from golden_inputs import rendered
from measuring import digits, methods_here, proportion, timed

METHODS = (
    "hybrid",
    "hybrid-flow",
    "classical",
    "pwvo",
    "pnp-ransac-tuned",
    "poselib",
)
"""The methods that are timed."""
SIZES = ((218, 512), (480, 640), (436, 1024))
"""Rows and columns of the images."""
BATCHES = (1, 8, 32)
"""Pairs of a batch."""
BATCH_SIZE = (128, 256)
"""Rows and columns of a batch's images."""
RECORDED = (
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tum/redwood_livingroom_5",
    "real_static/rooms_110",
    "tartanair_v2/P000",
)
"""Recordings of static scenes, in which every motion should be ok."""
REPEATS = 5
"""Calls of which the median time is taken."""
FRESH_PROCESS = """
import json, time
begin = time.perf_counter()
from hybridvo.odometry import warm_up
imported = time.perf_counter()
warm_up("hybrid")
print(json.dumps({"import_s": imported - begin, "warm_up_s": time.perf_counter() - imported}))
"""
"""The program whose first call is timed."""


def costs(args: argparse.Namespace) -> dict[str, Any]:
    """All times and memory, on one scene of moderate motion,
    flow from DIS, depth true.
    """
    frames = {size: list(rendered("light", 0, size, 8)) for size in SIZES}
    methods, missing = methods_here(METHODS)
    pair_ms = {}
    frame_ms = {}
    for size in SIZES:
        height, width = size
        pair_ms[f"{width}x{height}"] = pair_times(frames[size], methods)
        frame_ms[f"{width}x{height}"] = frame_times(frames[size], methods)
    return {
        "missing": missing,
        "pair_ms": pair_ms,
        "frame_ms": frame_ms,
        "recorded": {name: recorded(args.data / name) for name in RECORDED},
        "memory_mib": memory(frames[SIZES[-1]], methods),
        "first_call": first_call(),
        "batch": batches(args.seed0),
    }


def pair_of(frames: Any) -> Any:
    """The pair of the first two frames, with DIS flow."""
    from hybridvo import FramePair
    from hybridvo.flow import dis_flow, with_flow

    return with_flow(FramePair(*frames[:2], None), dis_flow())


def pair_times(frames: list[Any], methods: list[str]) -> dict[str, float]:
    """Median wall time of an estimate by method, ms, the flow given."""
    from hybridvo import estimate

    pair = pair_of(frames)
    return {
        name: median_ms(partial(estimate, pair, method=name)) for name in methods
    }


def frame_times(frames: list[Any], methods: list[str]) -> dict[str, float]:
    """Median wall time of a tracked frame by method, ms, its flow included."""
    from hybridvo import Odometry

    rows = {}
    for method in methods:
        odometry = Odometry(method=method)
        times = [timed(partial(odometry.track, frame))[1] for frame in frames]
        # the first two frames pay for what is done once
        rows[method] = digits(np.median(times[2:]))
    return rows


def recorded(folder: Path) -> dict[str, Any]:
    """How the tracker does on a recording: its answers that are
    not ok, and wall times, ms.

    Of a tracked frame, of its DIS flow alone and of the selection; the median and the
    mean of the last differ, because PWVO looks only where there are several motions.
    """
    from hybridvo import Odometry, open_sequence
    from hybridvo.pipeline import Context

    if not folder.is_dir():
        return {}
    frames = list(open_sequence(folder))
    odometry = Odometry()
    ctx = Context()
    steps = [timed(partial(odometry.track, frame)) for frame in frames][1:]
    flows = [timed(partial(pair_of, two)) for two in pairwise(frames)]
    searched = [ctx.search(pair) for pair, _ in flows]
    selections = [timed(partial(ctx.select, motions)) for motions in searched]

    not_ok = sum(not step.motion.ok for step, _ in steps)
    selection_ms = [ms for _, ms in selections]
    return {
        "not_ok": proportion(not_ok, len(steps)),
        "ms": {
            "hybrid": digits(np.median([ms for _, ms in steps])),
            "selection": digits(np.median(selection_ms)),
            "dis alone": digits(np.median([ms for _, ms in flows])),
            "selection in the mean": digits(np.mean(selection_ms)),
        },
    }


def memory(frames: list[Any], methods: list[str]) -> dict[str, float]:
    """Largest memory of Python's and numpy's allocators during one
    estimate by method, MiB.
    """
    from hybridvo import estimate

    pair = pair_of(frames)
    rows = {}
    for method in methods:
        tracemalloc.start()
        estimate(pair, method=method)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        rows[method] = digits(peak / 2**20)
    return rows


def first_call() -> dict[str, Any]:
    """Seconds for import and warm-up in a fresh process,
    compiled code from its cache.
    """
    done = subprocess.run(
        [sys.executable, "-c", FRESH_PROCESS],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or ["failed"]
        return {"error": lines[-1]}
    return {name: digits(value) for name, value in json.loads(done.stdout).items()}


def batches(seed0: int) -> list[dict[str, Any]]:
    """Seconds from PWVO's maps of a batch to poses and back to
    their gradients, on the CPU.
    """
    from dataclasses import replace

    import torch

    from hybridvo import PWVO, PairBatch, refine, select
    from hybridvo.synthetic.noise_scenarios import make_pair

    seeds = range(seed0, seed0 + max(BATCHES))
    pairs = [make_pair("moving30", seed, *BATCH_SIZE)[0] for seed in seeds]
    network = PWVO.from_pretrained()

    def forth_and_back(batch: Any, maps: Any) -> None:
        motion = maps.motion.detach().requires_grad_()
        log_scale = maps.log_scale.detach().requires_grad_()
        start = select(replace(maps, motion=motion, log_scale=log_scale))
        pose = refine(batch, start.T_curr_prev, start.weights).T_curr_prev
        pose.square().sum().backward()

    rows = []
    for size in BATCHES:
        batch = PairBatch.from_pairs(pairs[:size])
        with torch.no_grad():
            maps = network(batch)
        ms = median_ms(partial(forth_and_back, batch, maps))
        rows.append({"pairs": size, "forth_and_back_s": digits(ms / 1e3)})
    return rows


def median_ms(work: Any) -> float:
    """Median wall time, ms, after one call that does not count."""
    work()
    return digits(np.median([timed(work)[1] for _ in range(REPEATS)]))
