"""``hybridvo run`` from a sequence on disk to its files."""

from __future__ import annotations

import base64
import csv
import dataclasses
import json
import os
import shutil
import signal
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.files import Journal, checksum
from hybridvo.core.geometry import se3_exp
from hybridvo.core.results import RelativePose
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.data.sequence import Sequence
from hybridvo.pipeline import METHODS, Method
from hybridvo.run.cli import main
from hybridvo.run.commands.run_folder import CHECKPOINT, STATE, _deciding
from hybridvo_lab.synthetic.scenes import make_scene

FRAMES = 6


def run(sequence: Path, out: Path, *options: str, quiet: bool = True) -> int:
    given = [] if "--method" in options else ["--method", "classical"]
    if quiet:
        given.append("-q")
    return main(["run", str(sequence), "--out", str(out), *given, *options])


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "steps.csv").open() as file:
        return list(csv.DictReader(file))


def load(out: Path, name: str = "metrics.json") -> Any:
    return json.loads((out / name).read_text())


def poses(out: Path) -> np.ndarray:
    return read_trajectory(out / "trajectory.tum").T_world_cam


def true_poses() -> np.ndarray:
    truth = make_scene("static", 3, height=96, width=160, frames=FRAMES).T_world_cam
    return np.linalg.inv(truth[0]) @ truth


def test_true_flow_gives_the_true_trajectory_and_every_file(
    dataset, tmp_path, capsys
):
    out = tmp_path / "out"
    assert run(dataset, out, "--flow", "file") == 0
    assert {path.name for path in out.iterdir()} == {
        *("metrics.json", "run.json", "steps.csv", "steps.npz"),
        *("trajectory.kitti", "trajectory.png", "trajectory.tum"),
    }
    metrics = load(out)
    assert metrics["rot_err_deg_median"] < np.degrees(1e-6)
    assert metrics["trans_err_median"] < 1e-5 and metrics["failed"] == 0
    np.testing.assert_allclose(poses(out), true_poses(), atol=1e-4)
    kitti = read_trajectory(out / "trajectory.kitti").T_world_cam
    np.testing.assert_allclose(kitti, poses(out), atol=1e-6)
    # the oracle is named everywhere
    assert metrics["oracle"] == ["true flow", "true depth"]
    assert load(out, "run.json")["summary"]["oracle"] == ["true flow", "true depth"]
    assert run(dataset, out, "--flow", "file", "--resume", quiet=False) == 0
    assert "ORACLE" in capsys.readouterr().out


def test_the_summary_states_what_the_time_of_a_frame_went_to(own, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(own, out, "--json") == 0
    stages = json.loads(capsys.readouterr().out)["stages"]
    assert stages == load(out, "run.json")["summary"]["stages"]
    assert {"reading", "flow", "search", "solve", "judge"} <= set(stages)
    for stage in stages.values():
        assert 0 <= stage["median_ms"] <= stage["p95_ms"]
    assert stages["reading"]["frames"] == FRAMES - 1
    assert "stages" not in rows(out)[0]


def test_columns_and_arrays(dataset, tmp_path):
    assert run(dataset, tmp_path, "--stop", "3") == 0
    table = rows(tmp_path)
    columns = "index timestamp status reason probability tx ty tz rx ry rz inlier_ratio iterations"
    columns += " cost flow_ms motion_ms frame_ms"
    assert list(table[0])[:17] == columns.split()
    numbers = ("index", "timestamp", "status", "probability", "edge_start")
    shapes = dict.fromkeys((*numbers, "depth_scale", "scale_change"), (3,))
    shapes |= dict.fromkeys(("T_curr_prev", "T_curr_start"), (3, 4, 4))
    shapes |= dict.fromkeys(("covariance", "edge_covariance"), (3, 6, 6))
    with np.load(tmp_path / "steps.npz") as steps:
        assert {name: steps[name].shape for name in steps} == shapes
        for row, T, index in zip(
            table, steps["T_curr_prev"], steps["index"], strict=True
        ):
            assert int(row["index"]) == index
            assert [float(row[name]) for name in ("tx", "ty", "tz")] == [*T[:3, 3]]
        assert hvo.to_gtsam_covariance(steps["covariance"]).shape == (3, 6, 6)
        # the first frame starts at itself
        assert steps["edge_start"][0] == steps["index"][0]
        assert (steps["edge_start"][1:] < steps["index"][1:]).all()
    for row in table[1:]:
        parts = float(row["flow_ms"]) + float(row["motion_ms"])
        assert parts == pytest.approx(float(row["frame_ms"]), abs=2e-3)
    state = load(tmp_path, "run.json")
    assert state["state"] == "done" and state["frames_done"] == 3
    assert state["options"]["run"]["method"] == "classical"
    assert len(state["input_hash"]) == 64
    assert {"numpy", "numba", "python", "hybridvo"} <= set(state["versions"])
    assert set(state["machine"]) == {"platform", "cpus"}


def test_ground_truth_never_enters_the_estimate(dataset, own, tmp_path):
    for path in (own.parents[1] / "camdata_left" / "static").iterdir():
        data = bytearray(path.read_bytes())
        extrinsic = (
            np.frombuffer(data, "<f8", 12, len(data) - 96).reshape(3, 4).copy()
        )
        extrinsic[:, 3] = np.random.default_rng(len(path.name)).normal(size=3)
        data[-96:] = extrinsic.astype("<f8").tobytes()
        path.write_bytes(bytes(data))
    for sequence, name in ((dataset, "a"), (own, "b")):
        assert run(sequence, tmp_path / name, "--flow", "dis", "--stop", "3") == 0
    np.testing.assert_allclose(
        poses(tmp_path / "a"), poses(tmp_path / "b"), atol=1e-6
    )
    unaligned = [load(tmp_path / name)["ate_rmse_unaligned"] for name in "ab"]
    assert unaligned[0] != unaligned[1]


@pytest.mark.slow
def test_a_broken_frame_is_one_failed_row_and_is_spanned(own, tmp_path, capsys):
    image = own / "frame_0003.png"
    image.write_bytes(image.read_bytes()[:200])
    out = tmp_path / "out"
    assert run(own, out, "--flow", "dis", "--max-failed", "0.5", quiet=False) == 0
    table = rows(out)
    assert [row["status"] for row in table].count("failed") == 1
    assert (table[2]["status"], table[2]["reason"]) == ("failed", "missing_frame")
    assert table[3]["prev_index"] == "1" and float(table[2]["probability"]) == 0.0
    np.testing.assert_allclose(
        poses(out)[-1][:3, 3], true_poses()[-1][:3, 3], atol=0.2
    )
    assert "frame_0003" in capsys.readouterr().err
    again = ("--flow", "dis", "--overwrite")
    assert run(own, out, *again, "--max-failed", "0") == 3
    assert run(own, out, *again, "--strict") == 2
    assert "frame_0003.png" in capsys.readouterr().err


def test_auto_flow_falls_back_to_dis_where_a_file_is_missing_or_damaged(
    own, tmp_path
):
    flow = own.parents[1] / "flow" / "static"
    (flow / "frame_0002.flo").unlink()
    damaged = flow / "frame_0004.flo"
    damaged.write_bytes(damaged.read_bytes()[:100])
    out = tmp_path / "out"
    assert run(own, out) == 0
    sources = [row["flow_source"] for row in rows(out)]
    assert sources == ["", "file", "dis", "file", "dis", "file"]
    assert load(out)["flow_source"] == ["dis", "file"]


def without_times(out: Path) -> list[dict[str, str]]:
    times = ("flow_ms", "motion_ms", "frame_ms")
    return [{k: v for k, v in row.items() if k not in times} for row in rows(out)]


def at_frame(
    count: int, act: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Act when so many frames are about to be tracked."""
    track = hvo.Odometry.track
    frames = []

    def watched(self, *arguments, **given):
        frames.append(None)
        if len(frames) == count:
            act()
        return track(self, *arguments, **given)

    monkeypatch.setattr(hvo.Odometry, "track", watched)


@pytest.mark.slow
def test_a_motion_from_an_earlier_frame_is_compared_with_the_truth_from_there(
    dataset, tmp_path, monkeypatch
):
    """As where a lost path is found again from a place."""
    truth = true_poses()
    track = hvo.Odometry.track

    def from_the_first(
        self: hvo.Odometry, frame: hvo.Frame, **given: Any
    ) -> hvo.Step:
        step = track(self, frame, **given)
        if step.prev_index is None:
            return step
        T = np.linalg.inv(truth[frame.index]) @ truth[0]
        motion = step.motion.replace(T_curr_prev=T)
        return dataclasses.replace(step, motion=motion, prev_index=0)

    monkeypatch.setattr(hvo.Odometry, "track", from_the_first)
    assert run(dataset, tmp_path / "out", "--flow", "dis") == 0
    errors = [float(row["trans_err"]) for row in rows(tmp_path / "out")[1:]]
    assert max(errors) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("method", ["classical", "hybrid"])
def test_resume_goes_on_where_a_killed_run_was(
    dataset, tmp_path, monkeypatch, method
):
    """What is on the disk at some moment is what a process leaves that is killed then."""
    options = ("--flow", "dis", "--method", method)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    with monkeypatch.context() as patch:
        at_frame(4, lambda: shutil.copytree(whole, cut), patch)
        assert run(dataset, whole, *options) == 0
    assert (cut / CHECKPOINT).exists() and load(cut, STATE)["state"] == "running"
    assert len(rows(cut)) == 3
    again = []
    with monkeypatch.context() as patch:
        at_frame(4, lambda: again.append(cut), patch)
        assert run(dataset, cut, *options, "--resume") == 0
    # the three frames before are not tracked again
    assert not again
    assert without_times(cut) == without_times(whole)
    np.testing.assert_array_equal(poses(cut), poses(whole))
    assert not (cut / CHECKPOINT).exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_a_run_after_the_frame_at_hand(
    dataset, tmp_path, monkeypatch, number, capsys
):
    options = ("--flow", "dis")
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert run(dataset, whole, *options) == 0
    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = [signal.getsignal(n) for n in signals]
    with monkeypatch.context() as patch:
        at_frame(4, lambda: signal.raise_signal(number), patch)
        assert run(dataset, cut, *options) == 128 + number
    assert "--resume" in capsys.readouterr().err
    state = load(cut, STATE)
    assert (state["state"], state["frames_done"]) == ("interrupted", 4)
    assert len(rows(cut)) == 4
    assert [signal.getsignal(n) for n in signals] == handlers
    assert run(dataset, cut, *options, "--resume") == 0
    assert without_times(cut) == without_times(whole)
    state = load(cut, STATE)
    assert (state["state"], state["frames_done"]) == ("done", 6)


def test_a_signal_that_is_ignored_or_handled_by_others_stays_so(
    dataset, tmp_path, monkeypatch
):
    """As under nohup, or in a program that runs hybridvo."""
    seen = []
    before = (
        signal.signal(signal.SIGHUP, signal.SIG_IGN),
        signal.signal(signal.SIGTERM, lambda *_: seen.append("theirs")),
    )

    def act() -> None:
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)

    try:
        at_frame(2, act, monkeypatch)
        assert run(dataset, tmp_path, "--flow", "dis", "--stop", "3") == 0
    finally:
        signal.signal(signal.SIGHUP, before[0])
        signal.signal(signal.SIGTERM, before[1])
    assert seen == ["theirs"]


def test_a_run_that_an_error_ends_says_how_far_it_came(own, tmp_path):
    image = own / "frame_0003.png"
    image.write_bytes(image.read_bytes()[:200])
    assert run(own, tmp_path, "--flow", "dis", "--strict") == 2
    assert load(tmp_path, STATE)["state"] == "interrupted"
    assert load(tmp_path, STATE)["frames_done"] == len(rows(tmp_path)) == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("option", "then", "now", "name"),
    [
        ("--camera", "48,48,23.5,15.5", "44,44,23.5,15.5", "camera.fx"),
        ("--depth-scale", "1", "2", "depth_scale"),
        ("--readout-ms", "9", "20", "readout_ms"),
        ("--mask", "all", "some", "mask"),
    ],
)
def test_resume_with_another_camera_unit_or_mask_is_refused(
    walk, tmp_path, monkeypatch, capsys, option, then, now, name
):
    for mask in ("all", "some"):
        (tmp_path / mask).mkdir()
        for index in range(6):
            image = np.full((32, 48), 255, np.uint8)
            cv2.imwrite(str(tmp_path / mask / f"{index:06d}.png"), image)
            os.utime(tmp_path / mask / f"{index:06d}.png", (1e9, 1e9))
    values = [str(tmp_path / x) if option == "--mask" else x for x in (then, now)]
    at_frame(4, lambda: signal.raise_signal(signal.SIGINT), monkeypatch)
    out = tmp_path / "out"
    assert run(walk, out, option, values[0]) == 130
    assert run(walk, out, option, values[1], "--resume") == 2
    said = capsys.readouterr().err
    assert f"opened_with.{name} differs" in said and "--overwrite" in said
    assert run(walk, out, option, values[0], "--resume") == 0


def test_a_lens_that_differs_is_refused_when_resuming(walk, tmp_path):
    given = ("--method", "identity", "--flow", "dis", "--camera")
    files = [tmp_path / name for name in ("straight.yaml", "bent.yaml")]
    for path, bend in zip(files, (0.0, 0.1), strict=True):
        lines = (walk / "camera.yaml").read_text()
        path.write_text(f"{lines}distortion: [{bend}, 0, 0, 0]\n")
    out = tmp_path / "out"
    assert run(walk, out, *given, str(files[0])) == 0
    assert run(walk, out, *given, str(files[1]), "--resume") == 2
    assert run(walk, out, *given, str(files[0]), "--resume") == 0


def test_resume_of_a_finished_run_repeats_its_answer(dataset, tmp_path, capsys):
    arguments = ("--flow", "dis", "--stop", "3", "--json")
    assert run(dataset, tmp_path, *arguments) == 0
    first = json.loads(capsys.readouterr().out)
    assert run(dataset, tmp_path, *arguments, "--resume") == 0
    again = json.loads(capsys.readouterr().out)
    assert again["metrics"] == first["metrics"] and again["state"] == "done"


def test_resume_with_other_options_is_refused(dataset, tmp_path, capsys):
    assert run(dataset, tmp_path, "--flow", "dis", "--stop", "2") == 0
    assert run(dataset, tmp_path, "--flow", "dis", "--stop", "3", "--resume") == 2
    assert "options.run.stop differs (2 then, 3 now)" in capsys.readouterr().err


def test_a_motion_of_probability_0_is_never_followed(
    dataset, tmp_path, monkeypatch
):
    T = np.eye(4)
    T[0, 3] = 0.1
    motion = RelativePose(T, 1e-6 * np.eye(6), probability=0.0)

    def certain_to_be_wrong(evidence, ctx):
        yield motion

    monkeypatch.setitem(METHODS, "classical", Method(certain_to_be_wrong))
    assert run(dataset, tmp_path, "--flow", "dis", "--max-failed", "1") == 0
    assert {row["status"] for row in rows(tmp_path)[1:]} == {"failed"}
    assert (poses(tmp_path) == np.eye(4)).all()


def test_one_frame_has_no_motion(dataset, tmp_path, capsys):
    assert run(dataset, tmp_path, "--flow", "dis", "--stop", "1", quiet=False) == 0
    assert "one frame: no motion" in capsys.readouterr().out


@pytest.mark.slow
def test_names_that_are_not_text(walk, tmp_path, capsys):
    """Linux takes any bytes as the name of a folder; Python shows them as surrogates."""
    sequence = tmp_path / os.fsdecode(b"\xffseq")
    out = tmp_path / os.fsdecode(b"o\xff")
    shutil.copytree(walk, sequence)
    (sequence / "depth" / "000002.npy").write_bytes(b"broken")
    options = ("--max-failed", "1")
    assert run(sequence, out, *options, quiet=False) == 0
    assert "\\udcffseq" in rows(out)[2]["message"]
    assert "o\\udcff" in capsys.readouterr().out
    assert load(out, STATE)["sequence"] == str(sequence)
    assert run(sequence, out, *options, "--resume", "--json") == 0
    assert json.loads(capsys.readouterr().out)["out"] == str(out)
    assert run(tmp_path / os.fsdecode(b"\xfe"), out) == 2


def test_results_are_not_written_among_the_frames(dataset, capsys):
    assert run(dataset, dataset) == 2
    assert "--out" in capsys.readouterr().err


def test_a_recording(dataset, tmp_path, capsys):
    pytest.importorskip("rerun", reason="Rerun is not installed (extra viz)")
    assert run(dataset, tmp_path / os.fsdecode(b"\xff"), "--rrd") == 2
    assert "UTF-8" in capsys.readouterr().err
    assert run(dataset, tmp_path, "--flow", "dis", "--stop", "4", "--rrd") == 0
    content = (tmp_path / "recording.rrd").read_bytes()
    assert content[:3] == b"RRF" and len(content) > 5_000
    names = b"world/camera/image weights flow world/path ground_truth".split()
    assert all(name in content for name in names)


def test_a_second_pass_changes_nothing_where_frames_are_of_one_time(
    dataset, tmp_path
):
    once = tmp_path / "once"
    twice = tmp_path / "twice"
    assert run(dataset, once, "--flow", "dis") == 0
    assert run(dataset, twice, "--flow", "dis", "--passes", "2") == 0
    np.testing.assert_array_equal(poses(once), poses(twice))
    assert load(twice, "run.json")["options"]["run"]["passes"] == 2


def test_passes_of_a_camera_whose_rows_take_time(dataset, tmp_path, monkeypatch):
    """The rows of these frames take none, so that what is stated moves the path."""
    stated = ("--readout-ms", "20", "--flow", "dis")
    assert run(dataset, tmp_path / "once", *stated) == 0
    assert run(dataset, tmp_path / "whole", *stated, "--passes", "2") == 0
    whole = poses(tmp_path / "whole")
    assert not np.array_equal(whole, poses(tmp_path / "once"))

    cut = tmp_path / "cut"
    original = hvo.Odometry.track
    calls = []

    def stopped(tracker: hvo.Odometry, frame: hvo.Frame, **given: Any) -> hvo.Step:
        calls.append(frame.index)
        if len(calls) == FRAMES + 4:
            raise KeyboardInterrupt
        return original(tracker, frame, **given)

    monkeypatch.setattr(hvo.Odometry, "track", stopped)
    assert run(dataset, cut, *stated, "--passes", "2") == 130
    monkeypatch.undo()
    # the pass before is made again, and shows the same
    assert run(dataset, cut, *stated, "--passes", "2", "--resume") == 0
    np.testing.assert_array_equal(poses(cut), whole)


def test_a_pass_that_an_error_ends_is_an_interruption(own, tmp_path):
    image = own / "frame_0003.png"
    image.write_bytes(image.read_bytes()[:200])
    passes = ("--flow", "dis", "--passes", "2", "--strict")
    assert run(own, tmp_path, *passes) == 2
    assert load(tmp_path, STATE)["state"] == "interrupted"


def test_passes_need_flow_that_is_computed(dataset, tmp_path, capsys):
    assert run(dataset, tmp_path / "out", "--passes", "2", quiet=False) == 2
    assert "--flow dis" in capsys.readouterr().err


# -- a folder that a stranger has made up --------------------------------------------------


def packed(count: int, shape: list[int], dtype: str = "uint8") -> dict[str, Any]:
    """An array of zeros in a journal, with any shape that it states."""
    content = base64.b64encode(zlib.compress(bytes(count))).decode()
    return {"packed": content, "shape": shape, "dtype": dtype}


def forge(out: Path, row: Any, tracker: Any) -> None:
    """Put another last frame into a journal, with checksums that are right."""
    header = load(out, STATE)
    seed = json.dumps(_deciding(header))
    lines = (out / CHECKPOINT).read_text().splitlines()
    (out / CHECKPOINT).unlink()
    journal = Journal(out / CHECKPOINT, seed)
    for line in lines[:-1]:
        journal.add(json.loads(line)[1])
    last_row, last_tracker = json.loads(lines[-1])[1]
    chosen = [last_row if row is None else row, tracker or last_tracker]
    journal.add(chosen)
    journal.close()


MANY = 200 * 2**20
"""Bytes: more than a test of this kind may need."""
FORGERIES: dict[str, tuple[Any, Any]] = {
    "a bomb": (None, [packed(MANY, [10])]),
    "an array of terabytes": (None, [packed(10, [2**40])]),
    "many arrays": (None, [packed(0, [2**28]) for _ in range(4)]),
    "no lengths": (None, [packed(10, [-2, -5])]),
    "python objects": (None, [packed(800, [100], "O")]),
    "no base64": (None, [{"packed": "?", "shape": [1], "dtype": "f8"}]),
    "another class": (None, [{"state": "Popen", "args": "true"}, None]),
    "no such field": (None, [{"state": "TrackerState", "colour": 1}, None]),
    "one value": (None, [1]),
    "a frame that is not there": (None, [{"frame": 10**9, "depth_scale": 1}, None]),
    "fields of other types": (
        None,
        [{"state": "TrackerState", "keyframes": 7, "count": "many"}, None],
    ),
    "a row of nothing": ({}, None),
    "a row that is a number": (7, None),
}


@pytest.fixture
def stopped(dataset, tmp_path, monkeypatch) -> Path:
    """A run of three frames that was interrupted."""
    out = tmp_path / "stopped"
    with monkeypatch.context() as patch:
        at_frame(3, lambda: signal.raise_signal(signal.SIGINT), patch)
        assert run(dataset, out, "--flow", "dis", "--method", "identity") == 130
    return out


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_run_is_refused_in_one_line(name, stopped, dataset, capsys):
    forge(stopped, *FORGERIES[name])
    capsys.readouterr()
    tracemalloc.start()
    options = ("--flow", "dis", "--method", "identity", "--resume")
    code = run(dataset, stopped, *options)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    said = capsys.readouterr().err
    assert code == 2, said
    assert "Traceback" not in said and said.count("\n") == 1
    assert "cannot be resumed" in said and "--out DIR" in said
    assert peak < MANY / 2


@pytest.mark.parametrize(
    "summary",
    [
        *(None, 5, []),
        *({"files": 3}, {"files": [["x"]]}, {"failed_fraction": "none"}),
        *({"least_sure": 7}, {"metrics": 7}, {"frames": None, "flow_source": None}),
    ],
)
def test_a_forged_summary_is_refused_in_one_line(
    summary, dataset, tmp_path, capsys
):
    out = tmp_path / "out"
    options = ("--flow", "dis", "--method", "identity")
    assert run(dataset, out, *options, "--stop", "2") == 0
    content = load(out, STATE)
    del content["checksum"]
    if isinstance(summary, dict):
        summary = content["summary"] | summary
    content["summary"] = summary
    content["checksum"] = checksum(json.dumps(content))
    (out / STATE).write_text(json.dumps(content))
    capsys.readouterr()
    assert run(dataset, out, *options, "--stop", "2", "--resume") == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said and said.count("\n") == 1
    assert "cannot be resumed" in said


def test_the_path_of_another_frame(dataset, tmp_path, monkeypatch):
    """The robot's base, 30 cm behind the camera and turned: camera path and scores stay."""
    given = ("--flow", "file", "--method", "classical")
    assert run(dataset, tmp_path / "camera", *given) == 0
    T = se3_exp(np.array([0.0, 0.1, -0.3, 0.2, 0.0, 0.5]))
    begin = Sequence._begin

    def with_frame(self, *arguments):
        begin(self, *arguments)
        self.T_cam_frame = T

    monkeypatch.setattr(Sequence, "_begin", with_frame)
    assert run(dataset, tmp_path / "base", *given) == 0
    expected = np.linalg.inv(T) @ poses(tmp_path / "camera") @ T
    np.testing.assert_allclose(poses(tmp_path / "base"), expected, atol=1e-9)
    assert (
        load(tmp_path / "base")["ate_rmse"] == load(tmp_path / "camera")["ate_rmse"]
    )
