from __future__ import annotations

import csv
import functools
import json
import shutil
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import pytest

from hybridvo.core.errors import InputError, LockedError
from hybridvo.core.files import LOCK
from hybridvo.core.options import FlowOptions, Options, RunOptions
from hybridvo.core.results import RelativePose
from hybridvo.core.trajectory import read_trajectory
from hybridvo.io.data.open import open_sequence
from hybridvo.network.models import Models
from hybridvo.odometry import Odometry
from hybridvo.pipeline import METHODS, Method, method_names
from hybridvo.run.cli import main
from hybridvo.run.commands.run_folder import weights_hash
from hybridvo.run.commands.text import text_of
from hybridvo_lab.commands.compare import WRITTEN, compare, methods_to_run, open_all
from hybridvo_lab.evaluation.scores import PAIR_COLUMNS
from hybridvo_lab.synthetic.render import write_sintel
from hybridvo_lab.synthetic.scenes import make_scene

ROWS = set(
    "sequence method flow_source depth_source pairs failed r_err_deg t_err epe epe_l2_px "
    "rot_err_deg_mean rot_err_deg_median trans_err_mean trans_err_median ate_rmse "
    "rpe_trans_rmse rpe_rot_rmse_deg alignment ms_per_pair_median dynamic_fraction".split()
)
"""What other programs rely on."""
FAST = ("pnp-ransac", "identity")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sequences: ``tiny`` of four frames, ``longer`` of six."""
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(
        make_scene("light", 1, height=64, width=128, frames=4), root, "tiny"
    )
    write_sintel(
        make_scene("heavy_two", 2, height=64, width=128, frames=6), root, "longer"
    )
    return root


@pytest.fixture(scope="module")
def tiny(tree: Path) -> Path:
    return tree / "training" / "clean" / "tiny"


def run(*paths: Path, out: Path, flow: str = "auto", **more: Any) -> dict[str, Any]:
    options = Options(flow=FlowOptions(source=flow))
    return compare(paths, out, options=options, **{"methods": FAST} | more)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def outcome(out: Path) -> tuple[Any, Any]:
    """Rows and pairs, but for what the clock said."""
    result = json.loads((out / "results.json").read_text())
    return tuple(
        [{k: v for k, v in row.items() if k != "ms" and "ms_" not in k and "_ms" not in k}
         for row in rows]
        for rows in (result["rows"], rows_of(out / "pairs.csv"))
    )  # fmt: skip


def test_results_hold_what_the_interface_promises(tiny, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    methods = "classical,pnp-ransac,identity"
    arguments = ["compare", "--sequence", str(tiny), "--out", str(out)]
    assert main([*arguments, "--methods", methods, "--flow", "dis"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-len(WRITTEN) :] == [str(out / name) for name in WRITTEN]
    for method in methods.split(","):
        (line,) = (line for line in lines if f" {method} " in line)
        assert len(line.split()) > 8
    assert (out / "report.tex").read_text().count(r"\\") == 4
    result = json.loads((out / "results.json").read_text())
    assert set(result) >= {"command", "versions", "machine", "rows"}
    expected = [(method, "dis") for method in methods.split(",")]
    assert [
        (row["method"], row["flow_source"]) for row in result["rows"]
    ] == expected
    for row in result["rows"]:
        assert set(row) >= ROWS and row["depth_source"] == "true"
        assert row["pairs"] == row["pairs_scored"] == 3
        # what moves is known from the files, whichever flow a method was given
        assert 0 < row["dynamic_fraction"] < 1
        for name, value in row.items():
            assert value is not None or row["reasons"][name]
    ours, _, identity = result["rows"]
    assert ours["rot_err_deg_median"] < identity["rot_err_deg_median"]
    pairs = rows_of(out / "pairs.csv")
    assert tuple(pairs[0]) == PAIR_COLUMNS
    assert len(pairs) == 9 and {pair["index"] for pair in pairs} == {"0", "1", "2"}
    for row, line in zip(result["rows"], rows_of(out / "results.csv"), strict=True):
        mine = [
            float(pair["epe_l2_px"])
            for pair in pairs
            if pair["method"] == row["method"]
        ]
        assert row["epe_l2_px"] == pytest.approx(np.mean(mine))
        assert float(line["epe_l2_px"]) == row["epe_l2_px"]
    assert all((out / row["trajectory"]).exists() for row in result["rows"])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["classical", "pnp-ransac-tuned"])
def test_a_method_gives_what_it_gives_alone(
    tree: Path, tmp_path: Path, method: str
) -> None:
    """Beside others, and with flow that they share, as a tracker of its own: the same motions."""
    path = tree / "training" / "clean" / "longer"
    run(path, out=tmp_path / "out", methods=("identity", method), flow="dis")
    sequence = open_sequence(path)
    vo = Odometry(method=method)
    poses = [vo.track(sequence.frame(i)).T_world_cam for i in range(len(sequence))]
    result = json.loads((tmp_path / "out" / "results.json").read_text())
    (row,) = (row for row in result["rows"] if row["method"] == method)
    found = read_trajectory(tmp_path / "out" / row["trajectory"])
    np.testing.assert_allclose(found.T_world_cam, poses, atol=1e-6)


@pytest.mark.slow
def test_resume_keeps_finished_runs(
    tree: Path, tmp_path: Path, monkeypatch
) -> None:
    paths = [tree / "training" / "clean" / name for name in ("tiny", "longer")]
    files = functools.partial(run, *paths, flow="file")
    files(out=tmp_path / "whole")
    # as after an interruption: the first two runs are finished, the third is not
    cut, track, count = tmp_path / "cut", Odometry.track, 0

    def interrupted(self: Odometry, *arguments: Any, **given: Any) -> Any:
        nonlocal count
        count += 1
        if count == 11:
            raise KeyboardInterrupt
        return track(self, *arguments, **given)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Odometry, "track", interrupted)
        files(out=cut)
    states = [
        json.loads(path.read_text())["state"] for path in cut.rglob("run.json")
    ]
    assert sorted(states) == ["done", "done", "interrupted"]
    with pytest.raises(InputError, match="--resume"):
        files(out=cut)
    steps = cut / "runs" / "tiny" / "identity" / "steps.csv"
    written = steps.stat().st_mtime_ns
    files(out=cut, mode="resume")
    assert steps.stat().st_mtime_ns == written
    assert outcome(cut) == outcome(tmp_path / "whole")


def test_a_broken_frame_is_a_failed_pair_and_the_next_spans_it(
    tiny: Path, tmp_path: Path
) -> None:
    root = tmp_path / "training"
    shutil.copytree(tiny.parents[1], root)
    sequence = root / "clean" / "tiny"
    sorted(sequence.glob("*.png"))[1].write_bytes(b"no image")
    out = tmp_path / "out"
    run(sequence, out=out, methods=("classical", "identity"), flow="dis")
    rows = [
        row for row in rows_of(out / "pairs.csv") if row["method"] == "classical"
    ]
    assert [row["index"] for row in rows] == ["0", "1", "2"]
    assert rows[0]["status"].startswith("failed") and rows[0]["epe_l2_px"] == ""
    assert (rows[1]["prev"], rows[1]["next"]) == ("0", "2")
    assert float(rows[1]["epe_l2_px"]) < 1
    result = json.loads((out / "results.json").read_text())
    row = result["rows"][0]
    assert (row["failed"], row["pairs"], row["pairs_scored"]) == (1, 3, 2)
    assert row["wrong"] >= 1
    assert result["sequences"][0]["left_out"][0]["index"] == 1


def test_without_ground_truth_there_are_reasons(walk: Path, tmp_path: Path) -> None:
    shutil.copytree(walk, tmp_path / "walk")
    (tmp_path / "walk" / "poses.txt").unlink()
    summary = run(tmp_path / "walk", out=tmp_path / "out", flow="file")
    shown = text_of("compare", summary)
    assert "no errors: no pair has ground truth" in shown
    result = json.loads((tmp_path / "out" / "results.json").read_text())
    for row in result["rows"]:
        for key in ("epe", "ate_rmse", "rot_err_deg_mean", "wrong_share"):
            assert row[key] is None and row["reasons"][key]


@pytest.mark.slow
def test_camera_depth_scale_and_mask_are_those_of_a_run(
    tmp_path: Path, image_walk: Path
) -> None:
    """A recording without camera.yaml is compared as ``run`` would take it."""
    own = tmp_path / "own"
    shutil.copytree(image_walk, own)
    text = (own / "camera.yaml").read_text()
    known = dict(line.split(": ") for line in text.splitlines() if ": " in line)
    (own / "camera.yaml").unlink()
    camera = ",".join(known[name].split()[0] for name in ("fx", "fy", "cx", "cy"))
    shared = [
        str(own),
        "--flow=file",
        f"--camera={camera}",
        "--depth-scale=500",
        "-q",
    ]
    out, alone = tmp_path / "out", tmp_path / "alone"
    compared = ["compare", *shared, "--methods=pnp-ransac", f"--out={out}"]
    assert main(compared) == 0
    assert main(["run", *shared, "--method=pnp-ransac", f"--out={alone}"]) == 0
    found = read_trajectory(out / "runs" / "own" / "pnp-ransac" / "trajectory.tum")
    expected = read_trajectory(alone / "trajectory.tum")
    np.testing.assert_allclose(found.T_world_cam, expected.T_world_cam, atol=1e-9)
    masks = tmp_path / "masks"
    masks.mkdir()
    given = ["compare", *shared, f"--mask={masks}", f"--out={tmp_path}/masked"]
    assert main([*given, "--methods", "identity"]) == 2  # no mask for any frame


def test_the_truth_is_that_of_the_frames_that_were_run(
    walk: Path, tmp_path: Path
) -> None:
    options = Options(
        flow=FlowOptions(source="file"), run=RunOptions(start=1, stop=4)
    )
    compare((walk,), tmp_path, methods=("identity",), options=options)
    assert (
        len(read_trajectory(tmp_path / "runs" / "walk" / "ground_truth.tum")) == 3
    )


def broken(pair: Any, context: Any) -> RelativePose:
    raise ZeroDivisionError("a bug")


def test_a_bug_of_a_method_costs_its_run(
    tiny: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setitem(METHODS, "pnp-ransac", Method(broken))
    run(tiny, out=tmp_path / "out", flow="file")
    result = json.loads((tmp_path / "out" / "results.json").read_text())
    assert result["missing"] == {"pnp-ransac on tiny": "ZeroDivisionError: a bug"}
    assert [row["method"] for row in result["rows"]] == ["identity"]


def test_where_every_method_fails_the_report_says_so(
    tiny, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setitem(METHODS, "identity", Method(broken))
    words = [
        "compare",
        str(tiny),
        f"--out={tmp_path}",
        "--methods",
        "identity",
        "-q",
    ]
    assert main(words) == 1
    assert "every method failed" in capsys.readouterr().err
    result = json.loads((tmp_path / "results.json").read_text())
    assert result["rows"] == [] and all(
        (tmp_path / name).is_file() for name in WRITTEN
    )


def test_true_flow_is_named_and_equal_names_are_told_apart(
    tiny: Path, tmp_path: Path
) -> None:
    run(tiny, tiny, out=tmp_path / "out", methods=("identity",))
    result = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [row["sequence"] for row in result["rows"]] == ["tiny", "tiny_2"]
    assert {row["flow_source"] for row in result["rows"]} == {"file (true)"}


def test_a_folder_called_tilde_is_no_home(
    walk: Path, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run(walk, out=Path("~"), methods=("identity",), flow="file")
    result = json.loads((tmp_path / "~" / "results.json").read_text())
    assert not result["missing"] and len(result["rows"]) == 1


def test_refused_folders(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "held").mkdir()
    with filelock.FileLock(tmp_path / "held" / LOCK), pytest.raises(LockedError):
        run(tiny, out=tmp_path / "held")


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--methods", "pnp-ransak"], "pnp-ransac"),
        (["--methods", ","], "pnp-ransac"),
        (["--start", "9"], "frames"),
        (["--stride", "2", "--flow", "file"], "stride"),
        (["--protocol", "paper"], "tiny"),
    ],
)
def test_bad_options(tiny, tmp_path, arguments, field, capsys) -> None:
    given = ["--sequence", str(tiny), "--out", str(tmp_path / "out"), "-q"]
    assert main(["compare", *given, "--methods", "identity", *arguments]) == 2
    assert field in capsys.readouterr().err
    assert not (tmp_path / "out" / "results.json").exists()


def test_a_folder_stands_for_its_sequences(tree: Path, walk: Path) -> None:
    for path in (tree, tree / "training", tree / "training" / "clean"):
        assert [sequence.name for sequence in open_all(path)] == ["longer", "tiny"]
    assert [sequence.root for sequence in open_all(walk)] == [walk]
    with pytest.raises(InputError, match="nothing"):
        open_all(tree / "nothing")


def test_weights_of_a_method_are_all_that_it_reads(tmp_path: Path) -> None:
    names, missing = methods_to_run(("all",))
    assert {"hybrid", "classical", "identity"} <= set(names)
    assert set(missing) == set(method_names()) - set(names)
    (tmp_path / "pwvo").write_bytes(b"other weights")
    other = Models(weights={"pwvo": tmp_path / "pwvo"})
    assert weights_hash("hybrid", other) != weights_hash("hybrid", Models())
    assert weights_hash("classical", other) is None
