"""Rows that an interrupted comparison has kept, damaged by hand: a line counts whole, or not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hybridvo.comparison.job import Job, run_segment
from hybridvo.comparison.results import Segments

from hybridvo.errors import FormatError
from hybridvo.run_folder import PARTIAL
from tests.sequences import write_folder


def job_of(path: Path, **more: Any) -> Job:
    return Job(str(path), None, "mine", "hash", ("file",), ("identity",), 3, **more)


@pytest.fixture(scope="module")
def segment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = write_folder(tmp_path_factory.mktemp("kept")).path
    return {"job": 0, **run_segment(job_of(path))}


def kept(tmp_path: Path, *segments: Any) -> Segments:
    path = tmp_path / PARTIAL
    path.write_text("".join(json.dumps(s) + "\n" for s in segments))
    return Segments(path, [job_of(tmp_path)])


def changed(segment: dict[str, Any], place: str, value: Any) -> dict[str, Any]:
    """A copy with another value, at a place such as ``pairs.0.index``; None as text removes it."""
    copy = json.loads(json.dumps(segment))
    *way, last = [int(word) if word.isdigit() else word for word in place.split(".")]
    inner = copy
    for step in way:
        inner = inner[step]
    if value == "remove":
        del inner[last]
    else:
        inner[last] = value
    return copy


def test_segments_as_they_were_written_are_taken(tmp_path: Path, segment: dict[str, Any]) -> None:
    assert kept(tmp_path, segment).done == {0: 2}


MIRROR = [-1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
RESULT = "pairs.0.results.0"


@pytest.mark.parametrize(
    ("place", "value"),
    [
        *((name, "remove") for name in ("job", "done", "T_last", "pairs", "left_out")),
        *(("job", value) for value in ("a", 1.5, True, 1, -1, 10**400, None)),
        *(("done", value) for value in (-1, 0, 3, 10**18, "2", 2.0)),
        *(("pairs", value) for value in (None, [1], {})),
        *(("T_last", value) for value in ([1], {"file/identity": [1, 2]}, {"x": MIRROR})),
        *(("left_out", value) for value in (["x"], [{"index": 0}], [{"index": 9, "reason": "x"}])),
        *(("pairs.0.index", value) for value in (-1, 2, 99, "x", 10**9)),
        *(("pairs.0.next", value) for value in (0, 99, None)),
        ("pairs.0.flow_ms", None),
        ("pairs.0.depth_spread", "x"),
        ("pairs.0.results", []),
        ("pairs.0.flow_ms.file", -1.0),
        *((f"{RESULT}.T_curr_prev", v) for v in ([1], None, "x", [0] * 16, [1e300] * 16, MIRROR)),
        (f"{RESULT}.T_curr_prev", [10**400] * 16),
        *((f"{RESULT}.status", value) for value in (5, "<script>", "")),
        *((f"{RESULT}.message", value) for value in ({}, None)),
        *((f"{RESULT}.ms", value) for value in ("x", -1, float("nan"), float("inf"))),
        *((f"{RESULT}.epe_l2_px", v) for v in ("x", -1.0, float("nan"), float("inf"), 10**400)),
        (f"{RESULT}.method", "refine"),
        (f"{RESULT}.flow", "dis"),
    ],
)
def test_damaged_segments_are_refused_in_words(
    tmp_path: Path, segment: dict[str, Any], place: str, value: Any
) -> None:
    with pytest.raises(FormatError, match=r"jsonl:1: not as this comparison wrote it.*--overwrite"):
        kept(tmp_path, changed(segment, place, value))


def test_nothing_counts_twice(tmp_path: Path, segment: dict[str, Any]) -> None:
    pair = segment["pairs"][0]
    twice = {**segment, "pairs": [pair, *segment["pairs"]]}
    backwards = {**segment, "pairs": segment["pairs"][::-1]}
    results = changed(segment, "pairs.0.results", pair["results"] * 2)
    for segments in ([segment, segment], [twice], [backwards], [results]):
        with pytest.raises(FormatError, match="not as this comparison wrote it"):
            kept(tmp_path, *segments)


def test_times_of_the_kept_rows_are_numbers(segment: dict[str, Any]) -> None:
    """The reference of the tests above: a segment holds what they damage."""
    result = segment["pairs"][0]["results"][0]
    assert np.isfinite(result["epe_l2_px"]) and len(result["T_curr_prev"]) == 16
