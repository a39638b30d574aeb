from __future__ import annotations

import csv
import hashlib
import json
import shutil
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from hybridvo.comparison import job as job_module
from hybridvo.comparison import runner
from hybridvo.comparison.job import READS_NO_FLOW, Job, run_segment
from hybridvo.comparison.plan import expand, unique_names, weights_of
from hybridvo.comparison.results import PAIR_COLUMNS
from hybridvo.comparison.runner import ComparisonOptions, WorkerError, compare
from hybridvo.data.sequence import open_sequence
from hybridvo.errors import InputError, LockedError
from hybridvo.pipeline import METHODS
from hybridvo.synthetic.render import make_scene, write_sintel
from hybridvo.types import RelativePose
from tests.scripts import load_script

ROWS = (  # design/interface.md
    *("sequence", "method", "flow_source", "depth_source", "pairs", "failed", "r_err_deg", "t_err"),
    *("epe", "epe_l2_px", "rot_err_deg_mean", "rot_err_deg_median", "trans_err_mean"),
    *("trans_err_median", "ate_rmse", "rpe_trans_rmse", "rpe_rot_rmse_deg", "alignment"),
    *("ms_per_pair_median", "dynamic_fraction"),
)
PAIRS = (
    *("sequence", "index", "method", "flow_source", "status"),
    *("epe_l2_px", "rot_err_deg", "trans_err", "ms"),
)
FILES = ["results.json", "results.csv", "pairs.csv", "report.md", "report.html"]
FAST = "pnp-ransac,identity"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_script("tools/compare_methods.py")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sequences: ``tiny`` of four frames, ``longer`` of six."""
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene("light", 1, height=64, width=128, frames=4), root, "tiny")
    write_sintel(make_scene("heavy_two", 2, height=64, width=128, frames=6), root, "longer")
    return root


@pytest.fixture(scope="module")
def sequence(tree: Path) -> str:
    return str(tree / "training" / "clean" / "tiny")


@pytest.fixture(autouse=True)
def no_maps(tool: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Path]]:
    """Maps take seconds; one test draws them, with what this returns."""
    draw = tool.draw_maps
    monkeypatch.setattr(tool, "draw_maps", lambda *args: [])
    return draw


def test_maps_of_the_worst_pair_join_the_report(
    tool: ModuleType,
    no_maps: Callable[..., list[Path]],
    sequence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hybridvo.visualization.networks", lambda paths: [])
    out = tmp_path / "out"
    options = ["--methods", FAST, "--flow", "file", "--stop", "3", "-q"]
    assert tool.main(["--sequence", sequence, "--out", str(out), *options]) == 0
    written = no_maps(out, 1, True)
    worst = json.loads((out / "results.json").read_text())["worst_pairs"][0]
    picture = out / "figures" / f"tiny_{worst['index']:06d}.png"
    assert picture in written and picture.read_bytes()[:4] == b"\x89PNG"
    assert f"tiny, pair {worst['index']}" in (out / "report.html").read_text(encoding="utf-8")
    assert no_maps(out, 0, True) == []


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pages have tests of their own."""
    monkeypatch.setattr("hybridvo.evaluation.report_page.write_report", lambda folder: [])


def pairs_of(out: Path) -> list[dict[str, str]]:
    with (out / "pairs.csv").open() as file:
        return list(csv.DictReader(file))


def without_times(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k != "ms" and "ms_" not in k} for row in rows]


def outcome(out: Path) -> tuple[Any, Any]:
    """Rows and pairs of a comparison, but for what the clock said."""
    result = json.loads((out / "results.json").read_text())
    pairs = [{k: v for k, v in row.items() if not k.endswith("ms")} for row in pairs_of(out)]
    return without_times(result["rows"]), pairs


def options(path: Path | str, methods: str = FAST, **more: Any) -> ComparisonOptions:
    return ComparisonOptions((str(path),), methods=tuple(methods.split(",")), **more)


def test_results_hold_what_the_interface_promises(
    tool: ModuleType, sequence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    methods = "refine,pnp-ransac,identity"
    arguments = ["--sequence", sequence, "--out", str(out), "--methods", methods]
    assert tool.main(arguments) == 0
    assert capsys.readouterr().out.splitlines() == [str(out / name) for name in FILES]
    result = json.loads((out / "results.json").read_text())
    assert set(result) >= {"command", "versions", "machine", "rows"}
    expected = [(m, f) for f in ("file (true)", "dis") for m in methods.split(",")]
    assert [(row["method"], row["flow_source"]) for row in result["rows"]] == expected
    for row in result["rows"]:
        assert set(ROWS) <= set(row) and row["depth_source"] == "true"
        assert row["pairs"] == row["pairs_scored"] == row["pairs_scored_epe"] == 3
        # what moves is known from the files, whichever flow a method was given
        assert 0 < row["dynamic_fraction"] < 1
        for name, value in row.items():  # null only with a reason
            assert value is not None or row["reasons"][name]
    by_flow = {(row["method"], row["flow_source"]): row for row in result["rows"]}
    for flow in ("file (true)", "dis"):
        ours, identity = by_flow["refine", flow], by_flow["identity", flow]
        assert ours["rot_err_deg_median"] < identity["rot_err_deg_median"]
        assert ours["ms_with_flow_median"] > ours["ms_per_pair_median"]
        assert identity["flow_ms_median"] == 0  # it reads no flow, it need not wait for one
    pairs = pairs_of(out)
    assert tuple(pairs[0])[: len(PAIRS)] == PAIRS and len(pairs) == 18
    assert tuple(pairs[0]) == PAIR_COLUMNS
    for row in result["rows"]:
        mine = [
            p
            for p in pairs
            if (p["method"], p["flow_source"]) == (row["method"], row["flow_source"])
        ]
        assert row["epe_l2_px"] == pytest.approx(np.mean([float(p["epe_l2_px"]) for p in mine]))
    for entry in result["trajectories"]:
        assert len((out / entry["path"]).read_text().splitlines()) == 4
    worst = result["worst_pairs"]
    assert len(worst) == 18 and [w["rank"] for w in worst[:3]] == [1, 2, 3]
    for w in worst:  # three panels of 256 px with a caption
        picture = cv2.imread(str(out / w["picture"]))
        assert picture is not None and picture.shape == (128 + 18, 3 * 256, 3)
        assert w["status"] and w["picture_reason"] is None
    assert "<html" in (out / "report.html").read_text()
    assert "refine" in (out / "report.md").read_text()
    assert tool.main(arguments) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert json.loads((out / "run.json").read_text())["state"] == "done"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "refin"], "did you mean 'refine'"),
        (["--methods", ","], "expected names, got none"),
        (["--stride", "2", "--flow", "file"], "pass --flow dis"),
        (["--flow", "raft"], "invalid choice"),
        (["--jobs", "0"], "expected at least 1"),
        (["--jobs", "2", "--scheduler", "tcp://localhost:1"], "exclude each other"),
        (["--start", "9"], "no frames from 9 on: there are 4"),
        (["--stride", "0"], "stride >= 1"),
        (["--protocol", "paper"], "none of the 23 training sequences"),
    ],
)
def test_bad_options(
    tool: ModuleType,
    sequence: str,
    tmp_path: Path,
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert tool.main(["--sequence", sequence, "--out", str(tmp_path / "out"), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_methods_that_cannot_run_are_named_with_the_remedy(
    sequence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    no_report: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def check(method: str) -> None:
        if method != "identity":
            raise InputError(f"method '{method}' cannot run here: pip install {method}.")

    monkeypatch.setattr("hybridvo.comparison.plan.check_method", check)
    compare(options(sequence, "all", flow="file"), tmp_path)
    result = json.loads((tmp_path / "results.json").read_text())
    assert [row["method"] for row in result["rows"]] == ["identity"]
    assert list(result["missing"]) == sorted(set(METHODS) - {"identity"})
    assert result["missing"]["poselib"].endswith("pip install poselib.")
    assert "not run: poselib: method 'poselib' cannot run here" in capsys.readouterr().err


def test_rows_do_not_depend_on_cuts_or_processes(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None
) -> None:
    chosen = options(tree, "refine,pnp-ransac,identity")
    compare(chosen, tmp_path / "whole", quiet=True)
    rows, pairs = outcome(tmp_path / "whole")
    assert [row["sequence"] for row in rows] == ["longer"] * 6 + ["tiny"] * 6
    assert len(pairs) == (5 + 3) * 6

    def one_pair(job: Job, done: int, T_last: Any) -> Any:
        return run_segment(job, done, T_last, max_pairs=1)

    monkeypatch.setattr(runner, "run_segment", one_pair)
    compare(chosen, tmp_path / "cut", quiet=True)
    assert outcome(tmp_path / "cut") == (rows, pairs)
    monkeypatch.undo()
    monkeypatch.setattr("hybridvo.evaluation.report_page.write_report", lambda folder: [])
    monkeypatch.setattr(job_module, "estimate", None)  # not in this process
    two = ComparisonOptions(chosen.sequences, methods=chosen.methods, jobs=2)
    compare(two, tmp_path / "two", quiet=True)
    assert outcome(tmp_path / "two") == (rows, pairs)


def test_an_interrupted_comparison_goes_on(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None
) -> None:
    chosen = options(tree)
    compare(chosen, tmp_path / "whole", quiet=True)
    calls: list[tuple[str, int]] = []

    def few(job: Job, done: int, T_last: Any) -> Any:
        calls.append((job.name, done))
        if len(calls) == 4:
            raise MemoryError("the power went off")
        return run_segment(job, done, T_last, max_pairs=1)

    monkeypatch.setattr(runner, "run_segment", few)
    out = tmp_path / "broken"
    with pytest.raises(MemoryError):
        compare(chosen, out, quiet=True)
    partial = out / "steps.partial.jsonl"
    kept = partial.read_bytes()
    assert kept.count(b"\n") == 3
    partial.write_bytes(kept + b'{"job": 0, "done": 4, "pai')  # torn in the middle of a line
    with pytest.raises(InputError, match="Pass --overwrite"):
        compare(chosen, out, quiet=True)
    with pytest.raises(InputError, match="methods differ"):
        compare(options(tree, "identity"), out, mode="resume", quiet=True)
    compare(chosen, out, mode="resume", quiet=True)
    assert ("longer", 3) in calls[4:] and ("longer", 0) not in calls[4:]
    assert outcome(out) == outcome(tmp_path / "whole")
    assert not partial.exists()
    calls.clear()
    assert compare(chosen, out, mode="resume", quiet=True)  # was finished: nothing to do
    assert not calls


def test_ctrl_c_keeps_what_was_done(
    tool: ModuleType,
    tree: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    no_report: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import os
    import signal

    def interrupted(job: Job, done: int, T_last: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        return run_segment(job, done, T_last, max_pairs=2)

    monkeypatch.setattr(runner, "run_segment", interrupted)
    arguments = ["--sequence", str(tree), "--out", str(tmp_path), "--methods", "identity"]
    assert tool.main(arguments) == 130
    assert "interrupted: 2 of 8 pairs are kept; go on with --resume" in capsys.readouterr().err
    assert json.loads((tmp_path / "run.json").read_text())["state"] == "interrupted"
    monkeypatch.setattr(runner, "run_segment", run_segment)
    assert tool.main([*arguments, "--resume"]) == 0
    assert "resumed after 2 pairs" in capsys.readouterr().err


def test_progress_tells_the_time_left(
    tree: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    no_report: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("hybridvo.console.PLAIN_INTERVAL_S", 0.0)

    def one_pair(job: Job, done: int, T_last: Any) -> Any:
        return run_segment(job, done, T_last, max_pairs=1)

    monkeypatch.setattr(runner, "run_segment", one_pair)
    compare(options(tree, "identity"), tmp_path)
    lines = [line for line in capsys.readouterr().err.splitlines() if "/8 pairs" in line]
    assert len(lines) == 8
    assert all(" min left" in line for line in lines[:-1]) and "left" not in lines[-1]


def test_another_comparison_holds_the_folder(tree: Path, tmp_path: Path) -> None:
    from hybridvo.run_folder import RunFolder

    with RunFolder(tmp_path / "out", {}, {}), pytest.raises(LockedError):
        compare(options(tree, "identity"), tmp_path / "out", mode="overwrite")


def test_a_dead_worker_is_told_from_a_bug() -> None:
    from concurrent.futures.process import BrokenProcessPool

    future: Future[Any] = Future()
    future.set_exception(BrokenProcessPool("terminated abruptly"))
    with pytest.raises(WorkerError, match="go on with --resume"):
        runner._outcome(future)
    future = Future()
    future.set_exception(ZeroDivisionError())
    with pytest.raises(ZeroDivisionError):
        runner._outcome(future)


def test_a_method_that_fails_is_counted_and_takes_part(
    sequence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None
) -> None:
    real: Callable[..., RelativePose] = job_module.estimate

    def brittle(pair: Any, *, method: str, **more: Any) -> RelativePose:
        if method == "poselib" and pair.prev.index == 1:
            raise ZeroDivisionError("a bug of the method")
        if method == "usac-magsac":
            from hybridvo.types import Reason

            return RelativePose.failed(Reason.LOW_INLIERS, "made to fail", method)
        return real(pair, method=method, **more)

    monkeypatch.setattr(job_module, "estimate", brittle)
    compare(options(sequence, "poselib,usac-magsac,identity", flow="file"), tmp_path, quiet=True)
    result = json.loads((tmp_path / "results.json").read_text())
    rows = {row["method"]: row for row in result["rows"]}
    assert {m: row["failed"] for m, row in rows.items()} == {
        "poselib": 1, "usac-magsac": 3, "identity": 0,
    }  # fmt: skip
    for method, row in rows.items():
        mine = [p for p in pairs_of(tmp_path) if p["method"] == method]
        wrong = [p["status"].startswith("failed") or float(p["epe_l2_px"]) > 1 for p in mine]
        assert row["failures"] == sum(wrong) and row["failure_rate"] == np.mean(wrong)
    # a failed estimate has the errors of no motion, and medians say over how many pairs they are
    assert rows["usac-magsac"]["epe_l2_px_median"] == rows["identity"]["epe_l2_px_median"]
    assert rows["usac-magsac"]["pairs_scored"] == 3
    (broken,) = (p for p in pairs_of(tmp_path) if p["status"] == "failed(raised)")
    assert (broken["method"], broken["index"]) == ("poselib", "1")
    assert broken["message"] == "ZeroDivisionError: a bug of the method" and broken["ms"] == ""


def test_methods_without_flow_are_run_once_a_pair(sequence: str) -> None:
    """And may be: flow or none, their result is the same."""
    from hybridvo.data.sequence import iter_pairs
    from hybridvo.pipeline import check_method, estimate

    pair = next(iter_pairs(open_sequence(sequence)))
    assert set(METHODS) >= READS_NO_FLOW
    for method in METHODS:
        try:
            check_method(method)
        except InputError:
            continue
        blind = estimate(type(pair)(pair.prev, pair.curr, None), method=method)
        seeing = estimate(pair, method=method)
        same = np.array_equal(blind.T_curr_prev, seeing.T_curr_prev)
        assert (same and blind.ok == seeing.ok) == (method in READS_NO_FLOW), method


def test_broken_frames_are_left_out_and_told(
    tree: Path, tmp_path: Path, no_report: None, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(tree, tmp_path / "tree")
    base = tmp_path / "tree" / "training"
    (base / "depth" / "longer" / "frame_0003.dpt").write_bytes(b"PIEH")
    (base / "flow" / "longer" / "frame_0005.flo").unlink()
    chosen = options(base / "clean" / "longer", flow="file")
    compare(chosen, tmp_path / "out")
    result = json.loads((tmp_path / "out" / "results.json").read_text())
    (about,) = result["sequences"]
    assert about["pairs"] == 3
    assert [row["index"] for row in about["left_out"]] == [2]
    assert "left out: longer: frame 2: frame cannot be read" in capsys.readouterr().err
    by_method = {row["method"]: row for row in result["rows"]}
    assert by_method["pnp-ransac"]["pairs"] == 3
    assert by_method["pnp-ransac"]["failed"] == 1  # the pair without a flow file
    assert by_method["identity"]["failed"] == 0
    assert by_method["identity"]["pairs_scored"] == 3
    (base / "depth" / "longer" / "frame_0001.dpt").write_bytes(b"PIEH")  # the very first
    compare(options(base / "clean" / "longer"), tmp_path / "more", quiet=True)
    result = json.loads((tmp_path / "more" / "results.json").read_text())
    assert {row["flow_source"] for row in result["rows"]} == {"file (true)", "dis"}
    assert result["sequences"][0]["pairs"] == 2 and result["timing"] == "one estimate at a time"


def test_one_pair_no_truth_and_a_still_camera_give_nulls_with_reasons(
    tree: Path, tmp_path: Path, no_report: None
) -> None:
    folder = tmp_path / "mine"
    clean = tree / "training" / "clean" / "tiny"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    for i in (1, 2):
        shutil.copy(clean / f"frame_{i:04d}.png", folder / "rgb" / f"{i}.png")
        np.save(folder / "depth" / f"{i}.npy", np.full((64, 128), 3.0, np.float32))
    camera = "fx: 100\nfy: 100\ncx: 63.5\ncy: 31.5\nwidth: 128\nheight: 64\n"
    (folder / "camera.yaml").write_text(camera)
    compare(options(folder), tmp_path / "unknown", quiet=True)
    result = json.loads((tmp_path / "unknown" / "results.json").read_text())
    for row in result["rows"]:
        assert row["flow_source"] == "dis" and row["pairs"] == 1 and row["pairs_scored"] == 0
        for name in ("epe", "rot_err_deg_median", "ate_rmse", "dynamic_fraction", "failure_rate"):
            assert row[name] is None and row["reasons"][name]
    poses = "0 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n"
    (folder / "poses.txt").write_text(poses)
    compare(options(folder), tmp_path / "still", quiet=True)
    result = json.loads((tmp_path / "still" / "results.json").read_text())
    for row in result["rows"]:
        assert row["ate_rmse"] is None and row["reasons"]["ate_rmse"]
        assert row["rot_err_deg_median"] is not None and row["rpe_trans_rmse"] is not None
    text = (tmp_path / "still" / "results.json").read_text()
    assert "NaN" not in text and "Infinity" not in text


def test_a_single_frame_has_no_pair_but_rows(
    sequence: str, tmp_path: Path, no_report: None
) -> None:
    compare(options(sequence, stop=1, flow="file"), tmp_path, quiet=True)
    result = json.loads((tmp_path / "results.json").read_text())
    for row in result["rows"]:
        assert row["pairs"] == 0 and row["failed"] == 0
        for name, value in row.items():
            assert value is not None or row["reasons"][name], name


def test_a_folder_stands_for_its_sequences(tree: Path, tmp_path: Path) -> None:
    camdata = tree / "training" / "camdata_left"
    for root in (tree, tree / "training"):
        assert expand(root) == [camdata / "longer", camdata / "tiny"]
    clean = tree / "training" / "clean"
    assert expand(clean) == [clean / "longer", clean / "tiny"]
    assert expand(clean / "tiny") == [clean / "tiny"]
    assert expand(tree, "tum") == [tree] and expand(tmp_path / "none") == [tmp_path / "none"]
    for name in ("a", "b"):
        (tmp_path / "all" / name).mkdir(parents=True)
        (tmp_path / "all" / name / "camera.yaml").write_text("")
    assert expand(tmp_path / "all") == [tmp_path / "all" / "a", tmp_path / "all" / "b"]


def test_equal_names_are_told_apart() -> None:
    paths = [Path("/x/office/Easy/P000"), Path("/x/house/Easy/P000"), Path("/x/house/Easy/P001")]
    names = unique_names(paths, ["P000", "P000", "P001"])
    assert names == ["office/Easy/P000", "house/Easy/P000", "P001"]
    with pytest.raises(InputError, match="given twice"):
        unique_names([Path("a"), Path("a")], ["a", "a"])


def test_weights_are_part_of_what_a_result_depends_on(tmp_path: Path) -> None:
    for name in ("judge", "pwvo", "vonet"):
        (tmp_path / f"{name}.safetensors").write_bytes(name.encode())
    assert weights_of(["refine", "identity"], tmp_path) == {}
    found = weights_of(["hybrid", "pwvo", "refine"], tmp_path)
    assert list(found) == ["judge", "pwvo"]
    assert found["pwvo"] == hashlib.sha256(b"pwvo").hexdigest()
