"""The benchmark's heavy part: rendered sequences in which most of the picture moves."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from benchmark_scores import FAILURE_PX, epe, is_failure, proportion, quartiles

KINDS = ("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten")
FLOWS = ("true", "dis")
FRAMES = 20
PAIRS = 5
HEIGHT, WIDTH = 218, 512
ORACLE = "refine-oracle-static-mask"
"""``refine`` told by the ground truth which pixels are static: what a perfect mask would give."""

WITH_HYPOTHESES = ("refine", "hybrid-flow")


def run_heavy(
    sequences: int,
    seed0: int,
    progress: Callable[[str], None] = lambda line: None,
    hybrid: bool = False,
) -> dict[str, Any]:
    """Every method on true and on DIS flow of the four heavy kinds, depth true.

    Args:
        sequences: seeds of each kind, from ``seed0`` on.
        seed0: first seed.
        progress: called with a line after each kind.
        hybrid: whether ``hybrid-flow`` takes part.

    Returns:
        ``summary[kind or total][flow][method]``, the conditions, and one record per answer.
    """
    methods = heavy_methods(hybrid)
    records = []
    for kind in KINDS:
        started = time.perf_counter()
        for seed in range(seed0, seed0 + sequences):
            for index, flow, pair, truth in heavy_pairs(kind, seed):
                for name, method in methods.items():
                    begin = time.perf_counter()
                    result = method(pair, truth)
                    ms = 1e3 * (time.perf_counter() - begin)
                    facts = {"kind": kind, "seed": seed, "index": index, "flow": flow}
                    facts |= {"method": name, "ms": ms}
                    records.append(facts | judge_answer(result, pair, truth))
        progress(f"{kind}: {sequences} sequences, {time.perf_counter() - started:.0f} s")
    return {
        "conditions": {
            "kinds": list(KINDS),
            "seeds": [seed0, seed0 + sequences - 1],
            "pairs_per_sequence": PAIRS,
            "size": [HEIGHT, WIDTH],
            "depth": "true (oracle)",
            "flows": {"true": "true (oracle)", "dis": "OpenCV DIS, forward-backward variance"},
            "oracle": ORACLE,
            "interval": "Wilson 95 %, pairs taken as independent",
        },
        "summary": summarise_heavy(records, list(methods)),
        "pairs": records,
    }


def heavy_methods(hybrid: bool = False) -> dict[str, Callable[[Any, dict[str, Any]], Any]]:
    """Methods of this part: called with a pair and, for the oracle alone, its truth."""
    from hybridvo.baselines import pnp as baselines
    from hybridvo.pipeline import estimate, refine

    known = baselines.baselines()
    methods: dict[str, Callable[[Any, dict[str, Any]], Any]] = {
        "refine": lambda pair, truth: refine(pair),
        ORACLE: lambda pair, truth: refine(pair, weights=truth["static"]),
    }
    if hybrid:
        methods["hybrid-flow"] = lambda pair, truth: estimate(pair, method="hybrid-flow")
    for name in ("pnp-ransac-tuned", "poselib"):
        if name in known:
            methods[name] = lambda pair, truth, estimator=known[name]: estimator(pair)
    return methods


def heavy_pairs(kind: str, seed: int) -> Iterator[tuple[int, str, Any, dict[str, Any]]]:
    """(index, flow, pair, truth) of a sequence: pairs spread over it, each with both flows."""
    from hybridvo.flow import dis_flow
    from hybridvo.geometry import invert
    from hybridvo.synthetic.render import SyntheticSequence, make_scene
    from hybridvo.types import FramePair

    sequence = SyntheticSequence(
        make_scene(kind, seed, height=HEIGHT, width=WIDTH, frames=FRAMES), name=kind
    )
    dis = dis_flow()
    T_world_cam = sequence.poses
    for index in np.linspace(0, FRAMES - 2, PAIRS).round().astype(int).tolist():
        prev, curr = sequence.frame(index), sequence.frame(index + 1)
        depth = prev.depth
        assert depth is not None
        truth = {
            "T_curr_prev": invert(T_world_cam[index + 1]) @ T_world_cam[index],
            "depth_true": np.where(np.isfinite(depth), depth, np.nan),
            "static": (~sequence.moving(index)).astype(np.float32),
        }
        true = FramePair(
            prev, curr, sequence.flow(index)[0],
            flow_source="true", flow_is_true=True, depth_source="true",
        )  # fmt: skip
        field = dis(prev, curr)
        estimated = FramePair(
            prev, curr, field.flow, field.variance, field.valid,
            flow_source="dis", depth_source="true",
        )  # fmt: skip
        yield index, "true", true, truth
        yield index, "dis", estimated, truth


def judge_answer(result: Any, pair: Any, truth: dict[str, Any]) -> dict[str, Any]:
    """Error of the answer, and where the true motion stands among the hypotheses.

    ``chosen``: the first hypothesis, or its fit on the full grid, is within a pixel. ``hit``: that,
    or any other hypothesis is. Both None where a method has no hypotheses.
    """
    error = epe(result.T_curr_prev, pair, truth)
    found = [epe(h.T_curr_prev, pair, truth) < FAILURE_PX for h in result.hypotheses]
    chosen = hit = None
    if str(result.method) in WITH_HYPOTHESES:
        answered = bool(result.ok) and error < FAILURE_PX
        chosen = answered or (bool(found) and found[0])
        hit = chosen or any(found)
    return {
        "status": str(result.status),
        "estimated": bool(result.ok),
        "epe_px": error,
        "moving_share": float(1 - truth["static"].mean()),
        "hypotheses": len(found),
        "hit": hit,
        "chosen": chosen,
    }


def summarise_heavy(
    records: list[dict[str, Any]], methods: list[str]
) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """summary[kind][flow][method], and the four kinds together under ``total``."""
    summary: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    for kind in (*KINDS, "total"):
        summary[kind] = {}
        for flow in FLOWS:
            here = [r for r in records if kind in ("total", r["kind"]) and r["flow"] == flow]
            summary[kind][flow] = {}
            for method in methods:
                rows = [r for r in here if r["method"] == method]
                if not rows:
                    continue
                entry: dict[str, Any] = {
                    "pairs": len(rows),
                    "epe_px": quartiles([r["epe_px"] for r in rows]),
                    "ms": quartiles([r["ms"] for r in rows]),
                    "failures": proportion(sum(is_failure(r) for r in rows), len(rows)),
                }
                if method in WITH_HYPOTHESES:
                    for key in ("hit", "chosen"):
                        entry[key] = proportion(sum(bool(r[key]) for r in rows), len(rows))
                summary[kind][flow][method] = entry
    return summary
