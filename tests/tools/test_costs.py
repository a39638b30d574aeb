"""The benchmark of costs: what is timed, and its figures worked by hand. No test times anything."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from hybridvo import open_sequence
from hybridvo_lab.baselines import missing
from tests.scripts import load_script

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
