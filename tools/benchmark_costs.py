"""What the refinement costs: one iteration, the first call, batches, memory."""

from __future__ import annotations

import contextlib
import ctypes
import json
import resource
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

ITERATIONS = 50
BATCHES = (1, 8, 32)
BATCH_SHAPE = (128, 256)
REPEATS = 3
BEYOND_CACHE = 256 * 2**20
"""Bytes of the buffer that no cache holds."""

FRESH_PROCESS = """
import json, time
begin = time.perf_counter()
from hybridvo.pipeline import warm_up
imported = time.perf_counter()
first = warm_up()
second = warm_up()
print(json.dumps({"import_s": imported - begin, "warm_up_s": first, "again_s": second}))
"""


def run_kernel(cell: str, seed: int) -> dict[str, Any]:
    """One pass of ``Picture.full_pass`` over 436x1024 pixels beside the memory's speed."""
    from hybridvo.refinement.options import RefinementOptions

    from hybridvo.refinement import pixels as module
    from hybridvo.refinement import solver
    from hybridvo.refinement.full_fit import tile_size
    from hybridvo.synthetic.scenarios import make_pair

    pair, truth = make_pair(cell, seed)
    options = RefinementOptions()
    picture = module.Picture(pair, None)
    tile = tile_size(picture.shape, options.tiles)
    pose = np.ascontiguousarray(truth["T_curr_prev"][:3])
    noise = np.empty(3, np.float32)
    solver.set_noise(0.5, 0.02, options.cutoff, noise)

    def iteration() -> None:
        picture.full_pass(pose, noise, tile)

    flow = pair.flow
    assert flow is not None and pair.prev.depth is not None
    size = pair.prev.depth.nbytes + flow.nbytes
    threads = 2 if picture.shape[0] * picture.shape[1] >= module.PARALLEL_PIXELS else 1
    shipped = _timed(iteration)
    before = module.PARALLEL_PIXELS
    module.PARALLEL_PIXELS = sys.maxsize
    try:
        serial = _timed(iteration)
    finally:
        module.PARALLEL_PIXELS = before
    bandwidth = {"in_cache": memory_speed(size), "beyond_cache": memory_speed(BEYOND_CACHE)}
    read = {
        where: max(row["sum"]["gb_per_s"], row["sum_two_threads"]["gb_per_s"], row["copy_gb_per_s"])
        for where, row in bandwidth.items()
    }
    limit = {where: size / speed / 1e6 for where, speed in read.items()}
    return {
        "pixels": int(picture.shape[0] * picture.shape[1]),
        "bytes": size,
        "threads": threads,
        "shipped": shipped,
        "serial": serial,
        "bandwidth": bandwidth,
        "limit_ms": limit,
        "times_limit": {where: shipped["min_ms"] / ms for where, ms in limit.items()},
        "first_call": first_call(),
    }


def memory_speed(size: int) -> dict[str, Any]:
    """Numpy's speed on a float32 buffer of ``size`` bytes: sum, sum on two threads, copy.

    The copy's figure counts what it reads and what it writes.
    """
    source = np.ones(size // 4, np.float32)
    target = np.empty_like(source)
    halves = np.array_split(source, 2)
    repeats = ITERATIONS if size < BEYOND_CACHE // 4 else 5

    def both() -> None:
        helper = threading.Thread(target=halves[0].sum)
        helper.start()
        halves[1].sum()
        helper.join()

    speeds: dict[str, Any] = {"bytes": source.nbytes}
    works: tuple[tuple[str, Callable[[], Any]], ...] = (
        ("sum", source.sum),
        ("sum_two_threads", both),
        ("copy", lambda: np.copyto(target, source)),
    )
    for name, work in works:
        times = _timed(work, repeats)
        speeds[name] = times | {"gb_per_s": source.nbytes / times["min_ms"] / 1e6}
    speeds["copy_gb_per_s"] = 2 * speeds["copy"]["gb_per_s"]
    return speeds


def first_call() -> dict[str, Any]:
    """Seconds for import and warm-up in a fresh process, with the cache of kernels as it is."""
    command = [sys.executable, "-c", FRESH_PROCESS]
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    total = time.perf_counter() - begin
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        return {"error": lines[-1]}
    return {**json.loads(done.stdout.splitlines()[-1]), "process_s": total}


def run_batch(
    cell: str, seed0: int, sizes: tuple[int, ...] = BATCHES, shape: tuple[int, int] = BATCH_SHAPE
) -> dict[str, Any]:
    """Throughput of ``refine_batch`` in float32 on the CPU, without gradients."""
    import torch
    from benchmark_scores import FAILURE_PX, epe

    from hybridvo.refinement.torch_backend import refine_batch
    from hybridvo.synthetic.scenarios import make_pair
    from hybridvo.types import PairBatch

    made = [make_pair(cell, seed0 + k, *shape) for k in range(max(sizes))]

    def stacked(values: list[np.ndarray]) -> Any:
        return torch.from_numpy(np.stack(values).astype(np.float32))

    rows = []
    for size in sizes:
        pairs = [pair for pair, _ in made[:size]]
        batch = PairBatch(
            stacked([p.flow for p in pairs]),
            stacked([p.prev.depth for p in pairs]),
            stacked([p.prev.camera.K for p in pairs]),
            stacked([p.curr.camera.K for p in pairs]),
        )
        with torch.no_grad():
            answer = refine_batch(batch)  # the warm-up, and the answer that is judged
            seconds = []
            for _ in range(REPEATS):
                begin = time.perf_counter()
                refine_batch(batch)
                seconds.append(time.perf_counter() - begin)
        errors = [
            epe(T.double().numpy(), pair, truth)
            for T, (pair, truth) in zip(answer.T_curr_prev, made[:size], strict=True)
        ]
        wrong = [e > FAILURE_PX for e in errors]
        failed = answer.failed.tolist()
        rows.append(
            {
                "batch": size,
                "pairs_per_s": size / float(np.median(seconds)),
                "best_pairs_per_s": size / min(seconds),
                "seconds": seconds,
                "epe_px_median": float(np.median(errors)),
                "failures": sum(a or b for a, b in zip(wrong, failed, strict=True)),
            }
        )
    return {
        "cell": cell,
        "shape": list(shape),
        "dtype": "float32",
        "device": "cpu",
        "torch_threads": torch.get_num_threads(),
        "repeats": REPEATS,
        "rows": rows,
    }


def run_network(name: str = "pwvo", sizes: tuple[int, ...] = BATCHES) -> dict[str, Any]:
    """Milliseconds a pair of a shipped network at 128x256, all its passes, on the CPU."""
    import torch

    from hybridvo.learned import LEARNED, next_start, shipped_network
    from hybridvo.network.inputs import assemble_inputs
    from hybridvo.network.passes import predict
    from hybridvo.synthetic.scenarios import make_pair

    network = shipped_network(name)
    choose = next_start(network, LEARNED[name])
    pairs = [make_pair("moving30", seed, 128, 256)[0] for seed in range(max(sizes))]
    rows = []
    for size in sizes:
        inputs = assemble_inputs(pairs[:size])
        for precision, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
            with (
                torch.inference_mode(),
                torch.autocast("cpu", dtype, enabled=precision == "bfloat16"),
            ):
                times = _timed(lambda inputs=inputs: predict(network, inputs, choose), 10)
            rows.append(
                {
                    "batch": size,
                    "precision": precision,
                    "ms_per_pair": times["median_ms"] / size,
                    "best_ms_per_pair": times["min_ms"] / size,
                }
            )
    return {
        "network": name,
        "options": {k: getattr(network.options, k) for k in ("width", "input_stride", "passes")},
        "shape": list(BATCH_SHAPE),
        "device": "cpu",
        "torch_threads": torch.get_num_threads(),
        "rows": rows,
    }


def peak_memory(methods: dict[str, Callable[..., Any]], cell: str, seed: int) -> dict[str, Any]:
    """Extra memory of one call on a 436x1024 pair, MiB.

    ``traced_peak_mib``: what Python's and numpy's allocators saw at most; memory that a C++ library
    takes from the system is not seen. ``resident_peak_mib``: growth of the process's resident
    high-water mark, None where the system cannot reset it.
    """
    from hybridvo.synthetic.scenarios import make_pair

    pair, _ = make_pair(cell, seed)
    traced: dict[str, float] = {}
    resident: dict[str, float | None] = {}
    for name, method in methods.items():
        method(pair)
        with _collected(traced, name):
            method(pair)
        resident[name] = resident_growth(lambda method=method: method(pair))
    return {
        "traced_peak_mib": traced,
        "resident_peak_mib": resident,
        "process_peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
    }


@contextlib.contextmanager
def _collected(peaks: dict[str, float], name: str) -> Iterator[None]:
    """``peaks[name]`` = MiB that the block held at most beyond what was held before."""
    tracemalloc.start()
    try:
        yield
        peaks[name] = tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()


def resident_growth(call: Callable[[], Any]) -> float | None:
    """MiB by which the resident set grew at most during the call (Linux; else None).

    Free memory is handed back first: what a call takes from the allocator's store would not show.
    """
    try:
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # reset the high-water mark to the present
        before = _status_kib("VmRSS")
        call()
        return (_status_kib("VmHWM") - before) / 2**10
    except (OSError, KeyError, TypeError):
        return None


def _status_kib(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    values = dict(line.split(":", 1) for line in lines if ":" in line)
    return int(values[field].split()[0])


def _timed(work: Callable[[], Any], repeats: int = ITERATIONS) -> dict[str, float]:
    """Median and least time, ms, after one call that does not count."""
    work()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - begin))
    return {"median_ms": float(np.median(times)), "min_ms": min(times), "repeats": repeats}
