"""The benchmark of costs: what is timed, and its figures worked by hand. No test times anything."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hybridvo import open_sequence
from hybridvo.baselines import missing
from tests.scripts import ROOT, load_script

recorded = load_script("tools/bench/recorded.py")


# --- tracked frames ---------------------------------------------------------------


def test_the_first_pair_does_not_count_and_the_median_run_does() -> None:
    """Medians 3, 5 and 4: 4. At 95 %, of 2 and 4: 3.9; of 5 and 5: 5; of 4 and 4: 4."""
    runs = [
        recorded.Run(
            {"hybrid": [900.0, *ms], "opencv-rgbd": [900.0, 8.0, 8.0]},
            {"hybrid": [True, True, False]},
        )
        for ms in ([2.0, 4.0], [5.0, 5.0], [4.0, 4.0])
    ]
    found = recorded.figures(runs)
    assert found["ms"]["hybrid"] == {"median": 4.0, "p95": 4.0}
    assert found["against_rgbd"] == 2.0
    ok = found["ok"]["hybrid"]
    assert (ok["count"], ok["of"]) == (2, 3)


def test_a_run_times_every_pair_and_gives_rgbd_odometry_no_flow(
    image_walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = list(open_sequence(image_walk))[:3]
    ready = [name for name in (recorded.RGBD, recorded.CLOUDS) if not missing(name)]
    monkeypatch.setattr(recorded, "OURS", ("classical",))
    found = recorded.run(frames, ready)
    assert {name: len(ms) for name, ms in found.ms.items()} == dict.fromkeys(
        ("classical", *ready, recorded.DIS), 2
    )
    assert [len(each) for each in found.ok.values()] == [2]

    def refuse(*_: object) -> None:
        raise AssertionError("flow was computed")

    monkeypatch.setattr(sys.modules["hybridvo.flow.providers"], "_calc_dis", refuse)
    T = recorded.by_images(*frames[:2])()
    assert T is None or T.shape == (4, 4)
    with pytest.raises(AssertionError, match="flow was computed"):
        recorded.flow(*frames[:2])()


def test_opencv_gets_depth_that_is_unknown_as_nan() -> None:
    depth = np.array([[1.0, 0.0, np.inf], [2.0, -1.0, 3.0]], np.float32)
    frame = SimpleNamespace(depth=depth)
    expected = [[1, np.nan, np.nan], [2, np.nan, 3]]
    np.testing.assert_array_equal(recorded.known_depth(frame), expected)


# --- the page ---------------------------------------------------------------------


def measured() -> dict:
    """Parts of the costs as the tool writes them."""
    ms = {"median": 10.0, "p95": 20.0}
    some = {"count": 3, "of": 4}
    row = {"ok": {"hybrid": some}, "ms": {"hybrid": ms}, "against_rgbd": 2.0}
    row |= {"size": [480, 640]}
    return {
        "repeats": 3,
        "missing": {"small-gicp": "not installed"},
        "first_call": {"import_s": 1.0, "warm_up_s": 2.0}
        | {"fresh": {"import_s": 3.0, "warm_up_s": 40.0}},
        "recorded": {"tripod/corridor": row, "static": row},
    }


def test_the_page_shows_each_part_once_it_is_measured() -> None:
    made = load_script("tools/make_docs.py")
    results = made.read(ROOT / "docs/results")
    costs = results["benchmark"]["costs"]
    costs["recorded"] = {}
    assert made.table(made.tables(results), "recorded") == ""

    costs.update(measured())
    tables = made.tables(results)
    page = "\n\n".join(made.table(tables, name) for name in ("costs", "recorded"))
    assert "| corridor | 10 / 20 | 3 of 4 | 2.00 |" in page.splitlines()
    assert "the median of 3 runs counts" in page
    assert "a rendered scene of 640x480" in page
    assert "Not run: `small-gicp`, not installed." in page
    assert "3 s and 40 s on a fresh machine" in page
