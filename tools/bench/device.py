"""The refinement and PWVO on a device: time of a batch, and
its difference from the processor's answer.

    python tools/benchmark.py device --device cuda --out docs/results/device.json

Every batch holds rendered pairs in which half of the view moves. A time is the median
of the repeats after a first call that is not counted.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import torch
from measuring import parser_of, provenance

import hybridvo as hvo
from hybridvo.core.files import write_json
from hybridvo.lab.synthetic.noise_scenarios import make_pair

SIZES = ((128, 256), (480, 640))
"""Heights and widths of the pairs."""
BATCHES = (1, 16, 64)
"""Pairs of a batch."""
REPEATS = 5


def main(argv: list[str] | None = None) -> int:
    """Run the tool.

    Returns its exit code.
    """
    parser = parser_of(__file__, __doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cuda")
    args = parser.parse_args(argv)
    network = hvo.PWVO.from_pretrained()
    rows = [
        measured(network, size, count, args.device)
        for size in SIZES
        for count in BATCHES
    ]
    name = None
    if args.device == "cuda":
        name = torch.cuda.get_device_name()
    origin = provenance("benchmark.py device", argv)
    write_json(args.out, {**origin, "device": name or "cpu", "rows": rows})
    return 0


def measured(
    network: hvo.PWVO, size: tuple[int, int], count: int, device: str
) -> dict[str, Any]:
    """Times and differences of one batch.

    Args:
        network: PWVO, on the processor; it is moved to the device.
        size: height and width of the pairs.
        count: pairs of the batch.
        device: the device to measure.
    """
    pairs = [make_pair("moving50", seed, *size)[0] for seed in range(count)]
    here = hvo.PairBatch.from_pairs(pairs)
    there = hvo.PairBatch.from_pairs(pairs, device)
    with torch.no_grad():
        maps = network.to(device)(there)
        seed = hvo.select(maps)
        motion = hvo.refine(there, seed.T_curr_prev, seed.weights)
        weights = None if seed.weights is None else seed.weights.cpu()
        expected = hvo.refine(here, seed.T_curr_prev.cpu(), weights)
    maps_s = []
    refine_s = []
    for _ in range(REPEATS):
        started = _now(device)
        with torch.no_grad():
            maps = network(there)
            seed = hvo.select(maps)
        looked = _now(device)
        with torch.no_grad():
            hvo.refine(there, seed.T_curr_prev, seed.weights)
        maps_s.append(looked - started)
        refine_s.append(_now(device) - looked)
    difference = motion.T_curr_prev.cpu() - expected.T_curr_prev
    row = {
        "height": size[0],
        "width": size[1],
        "pairs": count,
        "maps_ms_per_pair": _ms_per_pair(maps_s, count),
        "refine_ms_per_pair": _ms_per_pair(refine_s, count),
        "largest_difference": float(difference.abs().max()),
    }
    print(row, flush=True)
    return row


def _now(device: str) -> float:
    """The time when the device has done all its work, seconds."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def _ms_per_pair(seconds: list[float], count: int) -> float:
    return round(1e3 * statistics.median(seconds) / count, 3)
