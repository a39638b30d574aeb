"""Whole walks through the house: sequence on disk, run, files, scores; interruption and resume."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hybridvo.cli import main
from hybridvo.data.image_io import read_flo
from hybridvo.evaluation.report import to_json
from hybridvo.run_folder import PARTIAL
from hybridvo.synthetic.render import make_scene, write_sintel
from hybridvo.trajectory import read_trajectory

FRAMES = 6
SCENE = "static"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sequence of six rendered frames in Sintel's layout."""
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene(SCENE, 3, height=96, width=160, frames=FRAMES), root, SCENE)
    return root / "training" / "clean" / SCENE


@pytest.fixture
def broken(dataset: Path, tmp_path: Path) -> Path:
    """Copy of the sequence whose third frame (index 2) cannot be decoded."""
    import shutil

    root = tmp_path / "broken"
    shutil.copytree(dataset.parents[2], root)
    sequence = root / "training" / "clean" / SCENE
    image = sequence / "frame_0003.png"
    image.write_bytes(image.read_bytes()[:200])
    return sequence


def run(sequence: Path, out: Path, *options: str) -> int:
    return main(["run", "--sequence", str(sequence), "--out", str(out), "-q", *options])


def rows(out: Path) -> list[dict[str, str]]:
    with (out / "steps.csv").open() as file:
        return list(csv.DictReader(file))


def load(out: Path, name: str = "metrics.json") -> dict:
    return json.loads((out / name).read_text())


def content(out: Path) -> dict[str, object]:
    """Every result, with the wall-clock column left out of steps.csv."""
    found: dict[str, object] = {
        name: (out / name).read_bytes()
        for name in ("trajectory.tum", "trajectory.kitti", "steps.npz", "metrics.json")
    }
    found["trajectory.png"] = (out / "trajectory.png").read_bytes()
    found["steps.csv"] = [
        {key: value for key, value in row.items() if key != "ms"} for row in rows(out)
    ]
    return found


def test_true_flow_gives_the_true_trajectory(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(dataset, out, "--flow", "file") == 0
    assert sorted(p.name for p in out.iterdir()) == [
        "metrics.json",
        "run.json",
        "steps.csv",
        "steps.npz",
        "trajectory.kitti",
        "trajectory.png",
        "trajectory.tum",
    ]
    metrics = load(out)
    # a static scene with exact flow: 1e-6 rad and 1e-5 m a pair, in float32 on disk
    assert metrics["rot_err_deg_median"] < np.degrees(1e-6)
    assert metrics["trans_err_median"] < 1e-5
    assert metrics["ate_rmse"] < 1e-4 and metrics["failed"] == 0
    # the oracle is named everywhere
    assert metrics["oracle"] == ["true flow", "true depth"]
    assert load(out, "run.json")["summary"]["oracle"] == ["true flow", "true depth"]
    assert "ORACLE  " in capsys.readouterr().out
    truth = make_scene(SCENE, 3, height=96, width=160, frames=FRAMES).T_world_cam
    trajectory = read_trajectory(out / "trajectory.tum")
    expected = np.linalg.inv(truth[0]) @ truth
    np.testing.assert_allclose(trajectory.T_world_cam, expected, atol=1e-4)
    kitti = read_trajectory(out / "trajectory.kitti")
    np.testing.assert_allclose(kitti.T_world_cam, trajectory.T_world_cam, atol=1e-6)
    steps = np.load(out / "steps.npz")
    assert steps["T_curr_prev"].shape == (FRAMES, 4, 4)
    assert steps["covariance"].shape == (FRAMES, 6, 6)
    np.testing.assert_array_equal(steps["T_curr_prev"][0], np.eye(4))
    table = rows(out)
    assert list(table[0])[:10] == "index timestamp status reason tx ty tz rx ry rz".split()
    assert [row["index"] for row in table] == [str(i) for i in range(FRAMES)]
    for row, T in zip(table, steps["T_curr_prev"], strict=True):
        assert [float(row[name]) for name in ("tx", "ty", "tz")] == T[:3, 3].tolist()
    state = load(out, "run.json")
    assert state["state"] == "done" and state["frames_done"] == FRAMES
    assert state["options"]["flow"] == "file" and len(state["input_hash"]) == 64
    assert {"numpy", "numba", "python", "hybridvo"} <= set(state["versions"])
    assert state["command"][:2] == ["hybridvo", "run"]


def test_golden_three_frames(dataset: Path, tmp_path: Path) -> None:
    """Frames 1 to 3 with DIS flow: the figures of this very scene, to the platform's spread."""
    out = tmp_path / "out"
    assert run(dataset, out, "--flow", "dis", "--start", "1", "--stop", "4") == 0
    metrics = load(out)
    assert metrics["oracle"] == ["true depth"] and metrics["flow_source"] == ["dis"]
    assert metrics["poses_estimate"] == 3 and metrics["pairs"] == 2
    assert metrics["rot_err_deg_mean"] < 0.2
    assert metrics["trans_err_mean"] < 0.05
    assert metrics["epe_l2_px"] < 0.6


def test_truth_never_enters_the_estimate(dataset: Path, tmp_path: Path) -> None:
    """Poisoned poses change the scores and not one byte of the trajectory."""
    import shutil

    poisoned = tmp_path / "poisoned"
    shutil.copytree(dataset.parents[2], poisoned)
    for path in (poisoned / "training" / "camdata_left" / SCENE).iterdir():
        data = bytearray(path.read_bytes())
        extrinsic = np.frombuffer(data, "<f8", 12, len(data) - 96).reshape(3, 4).copy()
        extrinsic[:, 3] = np.random.default_rng(len(path.name)).normal(size=3)
        data[-96:] = extrinsic.astype("<f8").tobytes()
        path.write_bytes(bytes(data))
    assert run(dataset, tmp_path / "a", "--flow", "dis", "--stop", "3") == 0
    assert (
        run(poisoned / "training" / "clean" / SCENE, tmp_path / "b", "--flow=dis", "--stop=3") == 0
    )
    for name in ("trajectory.tum", "steps.npz"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert load(tmp_path / "a")["ate_rmse_unaligned"] != load(tmp_path / "b")["ate_rmse_unaligned"]


def test_resume_after_any_frame_gives_the_same_bytes(dataset: Path, tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    kept = _partial_lines(dataset, whole)
    expected = content(whole)
    final = load(whole, "run.json")
    cut.mkdir()
    # what a killed run leaves: a state that still says running, and the rows so far
    for frames in (1, 3, FRAMES):
        for path in cut.iterdir():
            path.unlink()
        (cut / "run.json").write_text(to_json(final | {"state": "running"}))
        torn = b'{"index": 9' if frames < FRAMES else b""
        (cut / PARTIAL).write_bytes(b"".join(kept[:frames]) + torn)
        assert run(dataset, cut, "--flow", "dis", "--resume") == 0
        assert content(cut) == expected


def _partial_lines(dataset: Path, out: Path) -> list[bytes]:
    """The kept rows of a run: caught before they are removed."""
    from hybridvo import run_folder

    caught: list[bytes] = []
    remove = run_folder.RunFolder._remove

    def keep(self: run_folder.RunFolder, name: str) -> None:
        if name == PARTIAL and (self.path / name).exists():
            caught.extend((self.path / name).read_bytes().splitlines(keepends=True))
        remove(self, name)

    run_folder.RunFolder._remove = keep  # type: ignore[method-assign]
    try:
        assert run(dataset, out, "--flow", "dis") == 0
    finally:
        run_folder.RunFolder._remove = remove  # type: ignore[method-assign]
    assert len(caught) == FRAMES
    return caught


def test_resume_of_a_finished_run_repeats_its_answer(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ("--flow", "dis", "--stop", "3", "--json")
    assert run(dataset, out, *arguments) == 0
    first = json.loads(capsys.readouterr().out)
    before = content(out)
    assert run(dataset, out, *arguments, "--resume") == 0
    again = json.loads(capsys.readouterr().out)
    assert content(out) == before
    assert again["metrics"] == first["metrics"] and again["state"] == "done"


def test_resume_with_other_options_or_input_is_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(dataset, out, "--flow", "dis", "--stop", "2") == 0
    assert run(dataset, out, "--flow", "dis", "--stop", "3", "--resume") == 2
    assert "cannot be resumed: options differ" in capsys.readouterr().err
    assert run(dataset, out, "--flow", "dis", "--stop", "2") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run(dataset, out, "--flow", "dis", "--stop", "2", "--overwrite") == 0


def test_a_broken_frame_is_one_failed_row_and_is_spanned(broken: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(broken, out, "--flow", "dis") == 0
    table = rows(out)
    assert len(table) == FRAMES
    assert [row["status"] for row in table].count("failed") == 1
    assert (table[2]["status"], table[2]["reason"]) == ("failed", "missing_frame")
    assert "frame_0003" in table[2]["message"]
    assert table[3]["prev_index"] == "1"
    metrics = load(out)
    assert metrics["failed"] == 1
    # the next pair spans the gap: the end of the walk is where it is, to DIS's accuracy
    assert metrics["ate_rmse_origin"] < 0.3
    end = read_trajectory(out / "trajectory.tum").T_world_cam[-1]
    truth = make_scene(SCENE, 3, height=96, width=160, frames=FRAMES).T_world_cam
    expected = np.linalg.inv(truth[0]) @ truth[-1]
    assert np.linalg.norm(end[:3, 3] - expected[:3, 3]) < 0.2


def test_a_broken_frame_ends_a_strict_run(
    broken: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(broken, out, "--flow", "dis", "--strict") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "frame_0003.png" in error
    # what was finished before is kept
    assert len((out / PARTIAL).read_text().splitlines()) == 2


def test_auto_flow_falls_back_to_dis_where_a_file_is_missing(dataset: Path, tmp_path: Path) -> None:
    import shutil

    root = tmp_path / "gap"
    shutil.copytree(dataset.parents[2], root)
    (root / "training" / "flow" / SCENE / "frame_0002.flo").unlink()
    damaged = root / "training" / "flow" / SCENE / "frame_0004.flo"
    assert read_flo(damaged).shape == (96, 160, 2)
    damaged.write_bytes(damaged.read_bytes()[:100])
    out = tmp_path / "out"
    assert run(root / "training" / "clean" / SCENE, out) == 0
    assert [row["flow_source"] for row in rows(out)] == ["", "file", "dis", "file", "dis", "file"]
    assert load(out)["flow_source"] == ["dis", "file"]
    assert run(root / "training" / "clean" / SCENE, out, "--flow=file", "--overwrite") == 3
    assert [row["reason"] for row in rows(out)] == ["", "", "no_flow", "", "no_flow", ""]


def test_too_many_failures_are_exit_code_3(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import shutil

    root = tmp_path / "nodepth"
    shutil.copytree(dataset.parents[2], root)
    for index in (1, 2):
        (root / "training" / "depth" / SCENE / f"frame_{index:04d}.dpt").unlink()
    sequence = root / "training" / "clean" / SCENE
    assert run(sequence, tmp_path / "out", "--flow", "dis") == 3
    table = rows(tmp_path / "out")
    assert [row["status"] == "failed" for row in table[:4]] == [False, True, True, False]
    assert [row["reason"] for row in table[1:3]] == ["no_valid_depth"] * 2
    assert load(tmp_path / "out", "run.json")["state"] == "done"
    assert run(sequence, tmp_path / "more", "--flow", "dis", "--max-failed", "0.5") == 0


def test_one_frame_is_one_pose_with_a_warning(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code = main(["run", "--sequence", str(dataset), "--out", str(out), "--stop=1", "--flow=dis"])
    assert code == 0
    assert "warning: one frame" in capsys.readouterr().err
    trajectory = read_trajectory(out / "trajectory.tum")
    np.testing.assert_array_equal(trajectory.T_world_cam, np.eye(4)[None])
    metrics = load(out)
    assert metrics["ate_rmse"] is None and "not enough poses" in metrics["reasons"]["ate_rmse"]


def test_a_killed_run_and_a_signalled_run_lose_nothing(dataset: Path, tmp_path: Path) -> None:
    """SIGTERM ends with 130 and complete files; kill -9 keeps the rows; both resume to the same."""
    whole = tmp_path / "whole"
    slow = ["--flow", "dis", "--method", "identity"]
    assert run(dataset, whole, *slow) == 0
    # frames made slow, so that the signal comes in the middle
    code = (
        "import sys, time, hybridvo.data.sintel as s\n"
        "read = s.SintelSequence.frame\n"
        "def frame(self, i):\n    time.sleep(0.25)\n    return read(self, i)\n"
        "s.SintelSequence.frame = frame\n"
        "from hybridvo.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    for number in (signal.SIGTERM, signal.SIGKILL):
        out = tmp_path / number.name
        command = [sys.executable, "-c", code, "run", "--sequence", str(dataset), "--out", str(out)]
        child = subprocess.Popen([*command, *slow], stderr=subprocess.PIPE, stdout=subprocess.PIPE)
        deadline = time.monotonic() + 60
        partial = out / PARTIAL
        while not (partial.exists() and partial.read_bytes().count(b"\n") >= 2):
            assert time.monotonic() < deadline and child.poll() is None
            time.sleep(0.02)
        os.kill(child.pid, number)
        child.communicate(timeout=30)
        done = partial.read_bytes().count(b"\n")
        assert 2 <= done < FRAMES
        if number == signal.SIGTERM:
            assert child.returncode == 130
            assert load(out, "run.json")["state"] == "interrupted"
            assert len(rows(out)) == done
            assert not (out / "run.lock").exists()
        else:
            assert child.returncode == -9 and load(out, "run.json")["state"] == "running"
        assert run(dataset, out, *slow, "--resume") == 0
        assert content(out) == content(whole)


def test_demo_compares_five_methods(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    assert main(["demo", "--out", str(out), "--frames", "4", "-q", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    hybrid, ours, ransac, tuned, identity = report["rows"]
    assert hybrid["ate_cm"] < ours["ate_cm"] and hybrid["epe_px"] < ours["epe_px"]
    assert ours["ate_cm"] < tuned["ate_cm"] and ours["epe_px"] < tuned["epe_px"]
    assert ours["ate_cm"] < ransac["ate_cm"] and ours["rotation_deg"] < identity["rotation_deg"]
    assert ours["epe_px"] < ransac["epe_px"] < identity["epe_px"]
    assert report["flow_source"] == "dis" and 0.2 < report["moving_fraction"] < 0.45
    assert (out / "trajectory.png").read_bytes()[:4] == b"\x89PNG"
    assert main(["demo", "--out", str(out), "-q"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("do not touch")
    assert main(["demo", "--out", str(foreign), "--overwrite", "-q"]) == 2
    assert [p.name for p in foreign.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("sequence", "flow", "rotation_deg", "translation_cm"),
    [
        ("tartanair_v2/P000", "file", 0.0005, 0.005),
        ("tartanair_v2/P000", "dis", 0.035, 0.18),
        ("tum/redwood_livingroom_5", "dis", 0.028, 0.094),
    ],
)
def test_real_sequences_reach_the_published_medians(
    shared_data: Path,
    tmp_path: Path,
    sequence: str,
    flow: str,
    rotation_deg: float,
    translation_cm: float,
) -> None:
    assert run(shared_data / sequence, tmp_path / "out", "--flow", flow) == 0
    metrics = load(tmp_path / "out")
    assert metrics["failed"] == 0
    assert metrics["rot_err_deg_median"] <= rotation_deg
    assert 100 * metrics["trans_err_median"] <= translation_cm


def test_drift_on_freiburg_is_below_that_of_ransac(shared_data: Path, tmp_path: Path) -> None:
    ends = {}
    sequence = shared_data / "tum" / "rgbd_dataset_freiburg1_xyz_first10"
    for method in ("refine", "pnp-ransac"):
        out = tmp_path / method
        assert run(sequence, out, "--method", method) == 0
        ends[method] = _end_error(sequence, out)
    assert ends["refine"] <= ends["pnp-ransac"]


def _end_error(sequence: Path, out: Path) -> float:
    """Distance of the last position from the true one, metres."""
    from hybridvo.data.sequence import open_sequence

    poses = open_sequence(sequence).poses
    assert poses is not None
    true = np.linalg.inv(poses[0]) @ poses[-1]
    est = read_trajectory(out / "trajectory.tum").T_world_cam[-1]
    return float(np.linalg.norm(est[:3, 3] - true[:3, 3]))
