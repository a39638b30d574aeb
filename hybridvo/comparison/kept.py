"""What a resumed comparison reads back: every kept segment is checked before it counts.

The file lies in a folder that anyone may edit, and its rows end up in tables of results. A row that
does not fit is refused as a whole; it is neither mended nor counted twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hybridvo.comparison.job import Job
from hybridvo.evaluation.breakdown import FACTORS

__all__ = ["check_segment"]

_ERRORS = ("epe_l2_px", "rot_err_deg", "trans_err", "r_err_deg", "t_err", "epe")
_STATUSES = ("ok", "degraded(", "failed(")


def check_segment(segment: Any, jobs: Sequence[Job], done: Mapping[int, int]) -> None:
    """Refuse what :func:`hybridvo.comparison.job.run_segment` has not returned for these jobs.

    Args:
        segment: a line of the file.
        jobs: of the comparison.
        done: pairs that the lines before have finished, by job.

    Raises:
        ValueError: with what does not fit.
    """
    number = _whole(_part(segment, "job"), "job", 0, len(jobs) - 1)
    job = jobs[number]
    before = done.get(number, 0)
    end = _whole(_part(segment, "done"), "done", before + 1, max(job.pairs, before + 1))
    if end > job.pairs:
        raise ValueError(f"done: {job.name} was finished before")
    for key, values in _mapping(_part(segment, "T_last"), "T_last").items():
        _pose(values, f"T_last of {key}")
    first, last = job.start + before * job.stride, job.start + end * job.stride
    expected = {(flow, method) for flow in job.flows for method in job.methods}
    position = first
    for pair in _list(_part(segment, "pairs"), "pairs"):
        index = _whole(_part(pair, "index"), "index", position, last - 1)
        position = _whole(_part(pair, "next"), "next", index + 1, last)
        if (index - job.start) % job.stride or (position - job.start) % job.stride:
            raise ValueError(f"pair {index} to {position}: not of this range of frames")
        for name in FACTORS:
            _number(_part(pair, name), name)
        times = _mapping(_part(pair, "flow_ms"), "flow_ms")
        for flow in job.flows:
            _number(_part(times, flow), "flow_ms", required=True)
        found = [_result(result) for result in _list(_part(pair, "results"), "results")]
        if len(found) != len(expected) or set(found) != expected:
            raise ValueError(f"pair {index}: not one result for each method and flow")
    for row in _list(_part(segment, "left_out"), "left_out"):
        _whole(_part(row, "index"), "index", first, last)
        _word(_part(row, "reason"), "reason")


def _result(result: Any) -> tuple[str, str]:
    status = _word(_part(result, "status"), "status")
    if not status.startswith(_STATUSES):
        raise ValueError(f"status: expected ok, degraded or failed, got {status[:40]!r}")
    _word(_part(result, "message"), "message")
    _pose(_part(result, "T_curr_prev"), "T_curr_prev")
    _number(_part(result, "ms"), "ms")
    for name in _ERRORS:
        _number(result.get(name), name)
    return _word(_part(result, "flow"), "flow"), _word(_part(result, "method"), "method")


def _part(value: Any, name: str) -> Any:
    if not isinstance(value, dict) or name not in value:
        raise ValueError(f"{name} is missing")
    return value[name]


def _mapping(value: Any, name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name}: expected a mapping")
    return value


def _list(value: Any, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name}: expected a list")
    return value


def _word(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{name}: expected text")
    return value


def _whole(value: Any, name: str, low: int, high: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ValueError(f"{name}: expected {low} to {high}, got {str(value)[:40]}")
    return value


def _number(value: Any, name: str, required: bool = False) -> None:
    """A finite number of zero or more; None where it need not be known."""
    if value is None and not required:
        return
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError(f"{name}: expected a number")
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"{name}: expected a finite number of zero or more, got {value}")


def _pose(values: Any, name: str) -> None:
    """Sixteen numbers of a rigid motion, to the precision of float32."""
    import numpy as np

    if not isinstance(values, list) or len(values) != 16:
        raise ValueError(f"{name}: expected 16 numbers")
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise ValueError(f"{name}: expected 16 numbers")
    T = np.array(values, dtype=np.float64).reshape(4, 4)
    R = T[:3, :3]
    if not (
        np.isfinite(T).all()
        and np.abs(T).max() < 1e9
        and np.abs(R @ R.T - np.eye(3)).max() < 1e-4
        and np.linalg.det(R) > 0
        and T[3].tolist() == [0, 0, 0, 1]
    ):
        raise ValueError(f"{name}: not a rigid motion")
