"""The benchmark of costs: what is timed, and its figures worked by hand. No test times anything."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from hybridvo import Camera, Frame, open_sequence
from hybridvo.baselines import missing
from tests.scripts import ROOT, load_script

recorded = load_script("tools/bench/recorded.py")
solver = load_script("tools/bench/solver.py")
latency = load_script("tools/bench/latency.py")
growth = load_script("tools/bench/growth.py")
CAMERA = Camera(60.0, 60.0, 3.5, 2.5, 6, 8)


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


# --- solvers ----------------------------------------------------------------------


def test_solvers_stand_beside_opencv() -> None:
    alone = {"classical": [1.0, 3.0, 90.0], solver.OPENCV: [6.0, 6.0, 7.0]}
    answer = {"classical": [4.0], solver.OPENCV: [16.0]}
    found = solver.figures(alone, answer)
    assert found["solver"]["classical"] == {"ms": 3.0, "of_opencv": 0.5}
    assert found["answer"]["classical"] == {"ms": 4.0, "of_opencv": 0.25}


def test_what_is_timed_alone_solves_the_pair() -> None:
    """The call of OpenCV and ours find the same motion of a clean pair."""
    from hybridvo.lab.synthetic.noise_scenarios import make_pair

    pair, truth = make_pair("moving30", 1, 109, 256)
    works = solver.solvers(pair, [solver.OPENCV])
    T_true = truth["T_curr_prev"]
    np.testing.assert_allclose(works[solver.OPENCV](), T_true, atol=0.02)
    for name in (solver.OURS, solver.STARTED):
        T = works[name]().T_curr_prev
        np.testing.assert_allclose(T, T_true, atol=0.01)


# --- a live camera ----------------------------------------------------------------


def test_a_recording_in_memory_comes_at_30_hz(image_walk: Path) -> None:
    original = open_sequence(image_walk)
    sequence = latency.InMemory(original)
    assert len(sequence) == len(original)
    frame = sequence.frame(3)
    assert frame.timestamp == pytest.approx(0.1) and frame.index == 3
    np.testing.assert_array_equal(frame.rgb, original.frame(3).rgb)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30)


def test_the_loop_of_the_live_command_tracks_what_it_does_not_drop(
    image_walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """How many frames are dropped depends on the machine; the first one never is."""
    monkeypatch.setattr(latency, "METHOD", "classical")
    sequence = latency.InMemory(open_sequence(image_walk))
    run = latency.live_run(sequence, 33.0)
    assert 1 <= len(run.ages_s) <= len(sequence)
    assert all(age >= 0 for age in run.ages_s)


def test_a_path_is_lost_that_is_far_off_or_ends_in_a_failure() -> None:
    runs = [
        latency.LiveRun([0.01, 0.03], 0, 4.9, True),
        latency.LiveRun([0.02], 1, 5.1, True),
        latency.LiveRun([0.04], 1, 1.0, False),
        latency.LiveRun([], 0, None, False),
    ]
    assert [run.is_lost for run in runs] == [False, True, True, True]
    found = latency.figures(runs, 4)
    assert found["age_ms"]["median"] == 25.0
    assert found["age_ms"]["p95"] == pytest.approx(38.5)
    assert (found["tracked"]["count"], found["tracked"]["of"]) == (4, 16)
    assert (found["failed"], found["error_cm"]) == (2, 5.1)
    assert found["lost"]["count"] == 3


# --- growth -----------------------------------------------------------------------


def test_a_long_run_goes_to_and_fro() -> None:
    turns = growth.to_and_fro(4)
    assert [next(turns) for _ in range(9)] == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    alone = growth.to_and_fro(1)
    assert [next(alone) for _ in range(3)] == [0, 0, 0]


def test_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (6, 8, 3), np.uint8)
    depth = rng.uniform(1, 3, (6, 8)).astype(np.float32)
    given = [Frame(rgb, depth + k, CAMERA) for k in range(3)]
    folder = growth.write_frames(tmp_path / "frames", given)
    found = list(growth.endless(folder, 4))
    assert [frame.index for frame in found] == [0, 1, 2, 3]
    # the fourth one is the second one again
    np.testing.assert_array_equal(found[3].depth, depth + 1)
    np.testing.assert_array_equal(found[3].rgb, rgb)
    assert found[3].camera == CAMERA


def test_memory_is_read_as_linux_states_it() -> None:
    text = "Name:\tpython\nVmHWM:\t  533760 kB\nVmRSS:\t   10240 kB\n"
    assert growth.memory_of(text, growth.RESIDENT) == 10.0
    assert growth.memory_of(text, growth.LARGEST) == pytest.approx(521.2)


def test_a_mark_takes_the_latest_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "WINDOW", 3)
    assert growth.mark([90.0, 80.0, 1.0, 2.0, 3.0, 7.0])["ms"] == 3.0
    # the first two frames pay for what is done once
    assert growth.mark([90.0, 80.0, 4.0])["ms"] == 4.0


def test_the_process_of_a_case_takes_its_marks(
    image_walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = growth.write_frames(tmp_path / "frames", open_sequence(image_walk))
    words = [str(frames), "--method", "classical", "--marks", "3,7"]
    assert growth.main([*words, "--hypotheses", "2"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["frames"] for row in found["rows"]] == [3, 7]
    assert all(row["ms"] > 0 for row in found["rows"])
    if growth.STATUS.is_file():
        last = found["rows"][-1]
        assert last["peak_mib"] >= last["memory_mib"] > 10


# --- the page ---------------------------------------------------------------------


def measured() -> dict:
    """Parts of the costs as the tool writes them."""
    ms = {"median": 10.0, "p95": 20.0}
    some = {"count": 3, "of": 4}
    one = {"ms": 3.0, "of_opencv": 0.5}
    cost = {"ms": 7.0, "start_mib": 300.0, "peak_mib": 400.0}
    mark = {"frames": 100, "ms": 8.0, "memory_mib": 350.0, "peak_mib": 360.0}
    row = {"ok": {"hybrid": some}, "ms": {"hybrid": ms}, "against_rgbd": 2.0}
    row |= {"size": [480, 640]}
    live = {"recording": "tripod/corridor", "budget_ms": 33.0, "tracked": some}
    live |= {"age_ms": ms, "failed": 0, "error_cm": None, "lost": some}
    run = {"recording": "a/walk", "size": [60, 80], "window": 7, "rows": [mark]}
    compared = {"sequences": 2, "frames": 10, "size": [218, 512]}
    compared |= {"seconds": {"1": 9.0, "2": 5.0}}
    return {
        "repeats": 3,
        "missing": {"small-gicp": "not installed"},
        "first_call": {"import_s": 1.0, "warm_up_s": 2.0}
        | {"fresh": {"import_s": 3.0, "warm_up_s": 40.0}},
        "recorded": {"tripod/corridor": row, "static": row},
        "solver": {"size": [436, 1024], "pairs": 12, "points": 500}
        | {"solver": {"classical": one}, "answer": {"classical": one}},
        "latency": {"method": "hybrid", "frame_rate": 30.0}
        | {"lost_cm": 5.0, "rows": [live]},
        "growth": {
            "method": "hybrid",
            "otherwise": [480, 640],
            "size": [{"width": 320, "height": 240} | cost],
            "moving": [{"kind": "light", "moving_fraction": 0.3} | cost],
            "hypotheses": [{"hypotheses": 1} | cost],
            "run": run | {"start_mib": 300.0},
            "comparison": [compared],
        },
    }


def test_the_page_shows_each_part_once_it_is_measured() -> None:
    made = load_script("tools/make_docs.py")
    results = made.read(ROOT / "docs/results")
    costs = results["benchmark"]["costs"]
    names = ("recorded", "latency", "solver", "growth")
    for name in names[1:]:
        costs.pop(name, None)
    costs["recorded"] = {}
    tables = made.tables(results)
    assert [made.table(tables, name) for name in names] == [""] * 4

    costs.update(measured())
    tables = made.tables(results)
    page = "\n\n".join(made.table(tables, name) for name in ("costs", *names))
    for row in (
        "| corridor | 10 / 20 | 3 of 4 | 2.00 |",
        "| corridor | 33 | 10 / 20 | 75 % | 0 | - | 3 of 4 |",
        "| `classical` | 3 | 0.50 | 3 | 0.50 |",
        "| images of 320x240 | 7 | 400 |",
        "| 30 % of the image moves | 7 | 400 |",
        "| at most 1 hypothesis | 7 | 400 |",
        "| after 100 frames of a run | 8 | 350 |",
    ):
        assert row in page.splitlines(), row
    assert "2 sequences takes 9 s in one process and 5 s in two" in page
    for text in (
        "the median of 3 runs counts",
        "a rendered scene of 640x480",
        "call on 500 points",
        "off by more than 5 cm",
        "the latest 7 frames",
        "10 frames of 512x218 each",
    ):
        assert text in page, text
    assert "Not run: `small-gicp`, not installed." in page
    assert "3 s and 40 s on a fresh machine" in page


@pytest.mark.parametrize("absent", [("run", "comparison"), ()])
def test_the_figure_is_drawn_from_the_figures(
    tmp_path: Path, absent: tuple[str, ...]
) -> None:
    """Without data and without workers some columns are missing."""
    content = measured()["growth"]
    for name in absent:
        del content[name]
    out = tmp_path / "cost.png"
    growth.draw(content, out)
    with Image.open(out) as picture:
        assert picture.size == (1400, 520)
        assert np.asarray(picture.convert("L")).std() > 5
