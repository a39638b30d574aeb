"""The benchmark's costs: a pair, a whole frame, a batch, the first call, memory.

Frames of recordings have a file of their own: ``recorded.py``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from known_pairs import rendered
from measuring import digits, methods_here, timed

from bench.recorded import recorded

METHODS = (
    "hybrid",
    "hybrid-flow",
    "classical",
    "pwvo",
    "pnp-ransac-tuned",
    "poselib",
)
"""The methods that are timed."""
PEERS = ("opencv-rgbd", "small-gicp")
"""Methods beside which tracked frames are timed."""
SIZES = ((218, 512), (480, 640), (436, 1024))
"""Rows and columns of the images."""
BATCHES = (1, 8, 32)
"""Pairs of a batch."""
BATCH_SIZE = (128, 256)
"""Rows and columns of a batch's images."""
REPEATS = 5
"""Calls of which the median time is taken."""
FRESH_PROCESS = """
import json, time
begin = time.perf_counter()
from hybridvo.tracking.tracker import warm_up
imported = time.perf_counter()
warm_up("hybrid")
print(json.dumps({"import_s": imported - begin, "warm_up_s": time.perf_counter() - imported}))
"""
"""The program whose first call is timed."""


def costs(args: argparse.Namespace) -> dict[str, Any]:
    """All times and memory; of one scene of moderate motion, flow from DIS,
    depth true, where nothing else is stated.
    """
    frames = {size: list(rendered("light", 0, size, 8)) for size in SIZES}
    methods, missing = methods_here((*METHODS, *PEERS))
    own = [name for name in methods if name in METHODS]
    pair_ms = {}
    frame_ms = {}
    for size in SIZES:
        height, width = size
        pair_ms[f"{width}x{height}"] = pair_times(frames[size], own)
        frame_ms[f"{width}x{height}"] = frame_times(frames[size], own)
    works: dict[str, Callable[[], Any]] = {
        "memory_mib": partial(memory, frames[SIZES[-1]], own),
        "first_call": first_call,
        "batch": partial(batches, args.seed0),
        "recorded": partial(recorded, args.data, args.repeats),
    }
    result: dict[str, Any] = {"missing": missing, "repeats": args.repeats}
    result |= {"pair_ms": pair_ms, "frame_ms": frame_ms}
    for name, work in works.items():
        result[name], ms = timed(work)
        print(f"{name}: {ms / 1e3:.0f} s", file=sys.stderr, flush=True)
    return result


def pair_of(frames: Any) -> Any:
    """The pair of the first two frames, with DIS flow."""
    from hybridvo import FramePair
    from hybridvo.flow.providers import dis_flow, with_flow

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
    """Seconds for import and warm-up in a fresh process: compiled code from
    its cache, and, as on a fresh machine, without any.
    """
    result = fresh_process({})
    with tempfile.TemporaryDirectory() as folder:
        nothing = {"NUMBA_CACHE_DIR": folder}
        return result | {"fresh": fresh_process(nothing)}


def fresh_process(environment: dict[str, str]) -> dict[str, Any]:
    """Seconds for import and warm-up in a process with some variables."""
    done = subprocess.run(
        [sys.executable, "-c", FRESH_PROCESS],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | environment,
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
    from hybridvo_lab.synthetic.noise_scenarios import make_pair

    seeds = range(seed0, seed0 + max(BATCHES))
    pairs = [make_pair("moving30", seed, *BATCH_SIZE)[0] for seed in seeds]
    network = PWVO.from_pretrained()

    def forth_and_back(batch: Any, maps: Any) -> None:
        motion = maps.motion.detach().requires_grad_()
        log_scale = maps.log_scale.detach().requires_grad_()
        start = select(replace(maps, motion=motion, log_scale=log_scale))
        pose = refine(batch, start).T_curr_prev
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
