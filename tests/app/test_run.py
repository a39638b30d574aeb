"""``hybridvo run`` from a sequence on disk to its files."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.cli import main
from hybridvo.commands.run import CHECKPOINT, STATE
from hybridvo.synthetic.scenes import make_scene
from hybridvo.trajectory import read_trajectory

FRAMES = 6


def run(sequence: Path, out: Path, *options: str) -> int:
    given = () if "--method" in options else ("--method", "refine")
    return main(["run", str(sequence), "--out", str(out), "-q", *given, *options])


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


def test_true_flow_gives_the_true_trajectory_and_every_file(dataset, tmp_path, capsys):
    out = tmp_path / "out"
    assert run(dataset, out, "--flow", "file") == 0
    assert {path.name for path in out.iterdir()} == {
        *("metrics.json", "run.json", "steps.csv", "steps.npz"),
        *("trajectory.kitti", "trajectory.png", "trajectory.tum"),
    }
    metrics = load(out)
    assert metrics["rot_err_deg_median"] < np.degrees(1e-6) and metrics["trans_err_median"] < 1e-5
    assert metrics["failed"] == 0
    np.testing.assert_allclose(poses(out), true_poses(), atol=1e-4)
    kitti = read_trajectory(out / "trajectory.kitti").T_world_cam
    np.testing.assert_allclose(kitti, poses(out), atol=1e-6)
    # the oracle is named everywhere
    assert metrics["oracle"] == ["true flow", "true depth"]
    assert load(out, "run.json")["summary"]["oracle"] == ["true flow", "true depth"]
    again = ["--flow", "file", "--method", "refine", "--resume"]
    assert main(["run", str(dataset), "--out", str(out), *again]) == 0
    assert "ORACLE" in capsys.readouterr().out


def test_columns_and_arrays(dataset, tmp_path):
    assert run(dataset, tmp_path, "--stop", "3") == 0
    table = rows(tmp_path)
    columns = "index timestamp status reason probability tx ty tz rx ry rz inlier_ratio iterations"
    columns += " cost flow_ms motion_ms frame_ms"
    assert list(table[0])[:17] == columns.split()
    with np.load(tmp_path / "steps.npz") as steps:
        assert {name: steps[name].shape for name in steps} == {
            **{name: (3,) for name in ("index", "timestamp", "status", "probability")},
            "T_curr_prev": (3, 4, 4),
            "covariance": (3, 6, 6),
        }
        for row, T, index in zip(table, steps["T_curr_prev"], steps["index"], strict=True):
            assert int(row["index"]) == index
            assert [float(row[name]) for name in ("tx", "ty", "tz")] == T[:3, 3].tolist()
        assert hvo.to_gtsam_covariance(steps["covariance"]).shape == (3, 6, 6)
    for row in table[1:]:
        parts = float(row["flow_ms"]) + float(row["motion_ms"])
        assert parts == pytest.approx(float(row["frame_ms"]), abs=2e-3)
    state = load(tmp_path, "run.json")
    assert state["state"] == "done" and state["frames_done"] == 3
    assert state["options"]["run"]["method"] == "refine" and len(state["input_hash"]) == 64
    assert {"numpy", "numba", "python", "hybridvo"} <= set(state["versions"])
    assert set(state["machine"]) == {"platform", "cpus"}


def test_ground_truth_never_enters_the_estimate(dataset, own, tmp_path):
    for path in (own.parents[1] / "camdata_left" / "static").iterdir():
        data = bytearray(path.read_bytes())
        extrinsic = np.frombuffer(data, "<f8", 12, len(data) - 96).reshape(3, 4).copy()
        extrinsic[:, 3] = np.random.default_rng(len(path.name)).normal(size=3)
        data[-96:] = extrinsic.astype("<f8").tobytes()
        path.write_bytes(bytes(data))
    for sequence, name in ((dataset, "a"), (own, "b")):
        assert run(sequence, tmp_path / name, "--flow", "dis", "--stop", "3") == 0
    np.testing.assert_allclose(poses(tmp_path / "a"), poses(tmp_path / "b"), atol=1e-6)
    unaligned = [load(tmp_path / name)["ate_rmse_unaligned"] for name in "ab"]
    assert unaligned[0] != unaligned[1]


def test_a_broken_frame_is_one_failed_row_and_is_spanned(own, tmp_path, capsys):
    image = own / "frame_0003.png"
    image.write_bytes(image.read_bytes()[:200])
    out = tmp_path / "out"
    arguments = ["run", str(own), "--out", str(out), "--method", "refine", "--flow", "dis"]
    assert main([*arguments, "--max-failed", "0.5"]) == 0
    table = rows(out)
    assert [row["status"] for row in table].count("failed") == 1
    assert (table[2]["status"], table[2]["reason"]) == ("failed", "missing_frame")
    assert table[3]["prev_index"] == "1" and float(table[2]["probability"]) == 0.0
    np.testing.assert_allclose(poses(out)[-1][:3, 3], true_poses()[-1][:3, 3], atol=0.2)
    said = capsys.readouterr()
    assert "frame 2: failed (missing_frame)" in said.err and "frame_0003" in said.err
    assert "failed 1 of 5 motions" in said.out
    assert main([*arguments, "--overwrite", "--max-failed", "0", "-q"]) == 3
    assert main([*arguments, "--overwrite", "--strict", "-q"]) == 2
    assert "frame_0003.png" in capsys.readouterr().err


def test_auto_flow_falls_back_to_dis_where_a_file_is_missing_or_damaged(own, tmp_path):
    flow = own.parents[1] / "flow" / "static"
    (flow / "frame_0002.flo").unlink()
    damaged = flow / "frame_0004.flo"
    damaged.write_bytes(damaged.read_bytes()[:100])
    out = tmp_path / "out"
    assert run(own, out) == 0
    assert [row["flow_source"] for row in rows(out)] == ["", "file", "dis", "file", "dis", "file"]
    assert load(out)["flow_source"] == ["dis", "file"]


def test_resume_goes_on_where_a_killed_run_was(dataset, tmp_path, monkeypatch):
    """The process ends after frame 4; its state was written after frame 2."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert run(dataset, whole, "--flow", "dis") == 0
    monkeypatch.setattr("hybridvo.commands.run.SAVE_EVERY", 2)
    finish = hvo.Odometry.track
    count = 0

    def track(self, *arguments):
        nonlocal count
        count += 1
        if count == 4:
            raise SystemExit("killed")
        return finish(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(hvo.Odometry, "track", track)
        with pytest.raises(SystemExit):
            run(dataset, cut, "--flow", "dis")
    assert (cut / CHECKPOINT).exists() and load(cut, STATE)["state"] == "running"
    assert len(rows(cut)) == 2
    count = 0
    assert run(dataset, cut, "--flow", "dis", "--resume") == 0
    np.testing.assert_allclose(poses(cut), poses(whole), atol=1e-6)
    assert len(rows(cut)) == FRAMES and not (cut / CHECKPOINT).exists()


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


def test_results_are_not_written_among_the_frames(dataset, capsys):
    assert run(dataset, dataset) == 2
    assert "--out" in capsys.readouterr().err


def test_a_recording(dataset, tmp_path):
    pytest.importorskip("rerun", reason="Rerun is not installed (extra viz)")
    assert run(dataset, tmp_path, "--flow", "dis", "--stop", "4", "--rrd") == 0
    content = (tmp_path / "recording.rrd").read_bytes()
    assert content[:3] == b"RRF" and len(content) > 5_000
    for name in (b"world/camera/image", b"weights", b"flow", b"world/path", b"ground_truth"):
        assert name in content
