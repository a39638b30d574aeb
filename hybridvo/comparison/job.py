"""The unit of work: some consecutive pairs of one sequence, all methods and flows on each.

A sequence is worked through in segments of a few seconds. What a segment hands on (how far it came
and each method's last motion) goes into the next one, so that the rows do not depend on where the
cuts are, nor on which process or machine worked on them. Everything that goes in and out is plain
data that JSON holds.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hybridvo.configuration import RunOptions
from hybridvo.data.sequence import Sequence, iter_pairs, open_sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.pairs import pair_errors, pair_facts
from hybridvo.evaluation.protocols import same_intrinsics
from hybridvo.flow import FlowField, FlowProvider
from hybridvo.geometry import invert
from hybridvo.pipeline import check_method, estimate, warm_up
from hybridvo.run import flow_provider
from hybridvo.types import Frame, FramePair

__all__ = ["Job", "flow_label", "run_segment", "true_motion"]

READS_NO_FLOW = frozenset({"opencv-rgbd", "open3d-rgbd", "identity"})
"""Methods whose result is the same whatever the flow: run once a pair."""
_CAMERA_FLOW_KINDS = frozenset({"tartanair"})
"""Data sets whose true flow is that of the camera alone: it does not show what moves by itself."""

SEGMENT_PAIRS = 50
SEGMENT_SECONDS = 2.0
"""A segment ends after this many pairs or seconds: what an interruption can lose."""


@dataclass(frozen=True)
class Job:
    """All methods on one sequence.

    Args:
        path: sequence folder. dataset: its kind, or None. name: what results call it.
        input_hash: of its files, so that a process that has it open sees a change.
        flows: ``file`` and ``dis``, or one of them. methods: in the order of the results.
        frames: number of frames that the range selects. start, stride: first frame and step.
        seed: of everything drawn at random. same_camera_only: leave out pairs whose intrinsics
            change.
    """

    path: str
    dataset: str | None
    name: str
    input_hash: str
    flows: tuple[str, ...]
    methods: tuple[str, ...]
    frames: int
    start: int = 0
    stride: int = 1
    seed: int = 0
    same_camera_only: bool = False

    @property
    def pairs(self) -> int:
        """Number of pairs, those that cannot be read and those left out included."""
        return max(0, self.frames - 1)


@functools.lru_cache(maxsize=1)
def _opened(path: str, dataset: str | None, input_hash: str) -> Sequence:
    """The sequence of the last segment stays open: lists and cameras are read once."""
    return open_sequence(path, dataset)


@functools.cache
def _make_ready(method: str) -> None:
    """Refuse a method that cannot run in this process; compile its kernels once."""
    check_method(method)
    warm_up(method)


# Frames, flow and kernels of one process serve one segment at a time: numba's simplest threading
# layer and OpenCV's DIS object may not be entered by two threads, and times would mean nothing.
_ONE_AT_A_TIME = threading.Lock()
_called_before: set[tuple[str, tuple[int, int]]] = set()


def flow_label(flow: str, sequence: Sequence) -> str:
    """What results call a source of flow; an oracle is named so."""
    return f"{flow} (true)" if flow == "file" and sequence.flow_is_true else flow


def true_motion(sequence: Sequence, prev: int, curr: int) -> np.ndarray | None:
    """True T_curr_prev (4, 4), or None where it is not known."""
    if sequence.poses is None:
        return None
    T = invert(sequence.poses[curr]) @ sequence.poses[prev]
    return T if np.isfinite(T).all() else None


def run_segment(
    job: Job,
    done: int = 0,
    T_last: Mapping[str, list[float]] | None = None,
    max_pairs: int = SEGMENT_PAIRS,
    max_seconds: float = SEGMENT_SECONDS,
) -> dict[str, Any]:
    """Estimate and score the next pairs of a job.

    Args:
        job: the sequence and what to do with it.
        done: pairs that earlier segments have finished.
        T_last: what the segment before handed on.
        max_pairs: pairs after which the segment ends, at least one.
        max_seconds: seconds after which it ends; one pair is always done.

    Returns:
        ``done`` (pairs finished now), ``T_last``, ``pairs``: a mapping per pair with ``index``,
        ``next``, its facts, ``flow_ms`` by flow and ``results`` (one per flow and method: ``flow``,
        ``method``, ``status``, ``message``, ``T_curr_prev`` as 16 numbers, ``ms`` and the errors);
        ``left_out``: ``index`` and ``reason`` of pairs without results.

    Raises:
        InputError: a method or sequence that cannot be used here.
    """
    with _ONE_AT_A_TIME:
        for method in job.methods:
            _make_ready(method)
        sequence = _opened(job.path, job.dataset, job.input_hash)
        return _run(job, sequence, done, dict(T_last or {}), max_pairs, max_seconds)


def _no_flow(prev: Frame, curr: Frame) -> FlowField:
    return FlowField(None)


def _run(
    job: Job,
    sequence: Sequence,
    done: int,
    T_last: dict[str, list[float]],
    max_pairs: int,
    max_seconds: float,
) -> dict[str, Any]:
    started = time.monotonic()
    flows = {
        flow: flow_provider(sequence, RunOptions(flow=flow, stride=job.stride))
        for flow in job.flows
    }
    first = job.start + done * job.stride
    last = min(done + max_pairs, job.pairs)
    left_out: list[dict[str, Any]] = []
    walk = iter_pairs(
        sequence,
        _no_flow,
        start=first,
        stop=job.start + last * job.stride + 1,
        stride=job.stride,
        on_error=lambda index, error: left_out.append(
            {"index": index, "reason": f"frame cannot be read: {error}"}
        ),
    )
    pairs = []
    for pair in walk:
        if job.same_camera_only and not same_intrinsics(pair.prev.camera, pair.curr.camera):
            left_out.append({"index": pair.prev.index, "reason": "the intrinsics change"})
            T_last = {}  # the pair before the next one is unknown
        else:
            pairs.append(_pair(job, sequence, flows, pair, T_last))
        if time.monotonic() - started >= max_seconds:
            last = (pair.curr.index - job.start) // job.stride
            break
    # the last frame of this segment is the first of the next, which then reports it if it is broken
    end = job.start + last * job.stride
    again = [row for row in left_out if row["index"] == end and last < job.pairs]
    return {
        "done": last,
        "T_last": T_last,
        "pairs": pairs,
        "left_out": [row for row in left_out if row not in again],
    }


def _pair(
    job: Job,
    sequence: Sequence,
    flows: Mapping[str, FlowProvider],
    pair: FramePair,
    T_last: dict[str, list[float]],
) -> dict[str, Any]:
    """Row of one pair; ``T_last`` is brought up to date."""
    fields: dict[str, FlowField] = {}
    flow_ms: dict[str, float] = {}
    for name, provider in flows.items():
        started = time.perf_counter()
        fields[name] = provider(pair.prev, pair.curr)
        flow_ms[name] = 1e3 * (time.perf_counter() - started)
    prev, curr = pair.prev, pair.curr
    T_true = true_motion(sequence, prev.index, curr.index)
    flow_true = _true_flow(sequence, fields.get("file"), prev.index, job.stride)
    facts = pair_facts(T_true, prev.depth, prev.camera, curr.camera, flow_true)
    # which method comes first changes from pair to pair: none always finds a cold cache
    shift = (prev.index // job.stride) % len(job.methods)
    order = (*job.methods[shift:], *job.methods[:shift])
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for flow, flow_field in fields.items():
        given = replace(
            pair,
            flow=flow_field.flow,
            flow_variance=flow_field.variance,
            flow_valid=flow_field.valid,
            flow_source=flow_field.source,
            flow_is_true=flow_field.is_true,
        )
        for method in order:
            before = (next(iter(fields)), method)
            if method in READS_NO_FLOW and before in found:
                found[flow, method] = found[before]
            else:
                key = f"{flow}/{method}"
                found[flow, method] = _result(job, given, method, T_last, key, T_true)
    results = [
        {"flow": flow, "method": method, **found[flow, method]}
        for flow in fields
        for method in job.methods
    ]
    return {
        "index": prev.index,
        "next": curr.index,
        **facts,
        "flow_ms": flow_ms,
        "results": results,
    }


def _true_flow(
    sequence: Sequence, flow_field: FlowField | None, index: int, stride: int
) -> np.ndarray | None:
    """True flow of everything, for the share of moving pixels; never seen by an estimate."""
    if stride > 1 or not (sequence.has_flow and sequence.flow_is_true):
        return None
    if sequence.kind in _CAMERA_FLOW_KINDS:
        return None
    if flow_field is not None:
        return flow_field.flow
    try:
        return sequence.flow(index)[0]
    except (InputError, OSError):
        return None


def _result(
    job: Job,
    pair: FramePair,
    method: str,
    T_last: dict[str, list[float]],
    key: str,
    T_true: np.ndarray | None,
) -> dict[str, Any]:
    """One estimate, its time and its errors."""
    size = (method, pair.prev.camera.shape)
    try:
        if size not in _called_before:  # a library's own first call is not timed
            _called_before.add(size)
            estimate(pair, method=method, seed=job.seed)
        started = time.perf_counter()
        motion = estimate(pair, method=method, seed=job.seed)
        ms = 1e3 * (time.perf_counter() - started)
    except InputError:
        raise
    except Exception as error:  # a method's bug costs its pair, not the night's comparison
        T, status, ms = np.eye(4), "failed(raised)", None
        message = f"{type(error).__name__}: {error}"
    else:
        T, status, message = motion.T_curr_prev, str(motion.status), motion.status.message
        if motion.usable:
            T_last[key] = T.ravel().tolist()
    errors: dict[str, float | None] = {}
    if T_true is not None:
        depth = pair.prev.depth
        if depth is None:
            depth = np.full(pair.prev.camera.shape, np.nan, np.float32)
        errors = pair_errors(T, T_true, depth, pair.prev.camera, pair.curr.camera)
    return {
        "status": status,
        "message": message,
        "T_curr_prev": T.ravel().tolist(),
        "ms": ms,
        **errors,
    }
