from __future__ import annotations

import csv
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

from hybridvo.data.synthetic import make_scene, write_sintel


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    path = Path(__file__).parents[2] / "tools" / "compare_methods.py"
    spec = importlib.util.spec_from_file_location("compare_methods", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> str:
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene("light", 1, height=64, width=128, frames=4), root, "tiny")
    return str(root / "training" / "clean" / "tiny")


def test_results_hold_what_the_interface_promises(
    tool: ModuleType, sequence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    methods = "refine,pnp-ransac,identity"
    arguments = ["--sequence", sequence, "--out", str(out), "--methods", methods]
    assert tool.main(arguments) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5
    result = json.loads((out / "results.json").read_text())
    assert set(result) >= {"command", "versions", "machine", "rows"}
    assert [row["method"] for row in result["rows"]] == methods.split(",")
    for row in result["rows"]:
        assert set(tool.ROW_COLUMNS) <= set(row)
        assert row["flow_source"] == "file (true)" and row["depth_source"] == "true"
        assert row["pairs"] == 3 and 0 < row["dynamic_fraction"] < 1
        for name in tool.ROW_COLUMNS:  # null only with a reason
            assert row[name] is not None or row["reasons"][name]
    ours, _, identity = result["rows"]
    assert ours["rot_err_deg_median"] < identity["rot_err_deg_median"]
    with (out / "pairs.csv").open() as file:
        pairs = list(csv.DictReader(file))
    assert list(pairs[0]) == list(tool.PAIR_COLUMNS) and len(pairs) == 9
    assert "data:image/png;base64," in (out / "report.html").read_text()
    assert "| refine |" in (out / "report.md").read_text()
    assert tool.main(arguments) == 2
    assert "pass --overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--methods", "refin"], "did you mean 'refine'"),
        (["--methods", "hybrid"], "needs network weights"),
        (["--stride", "2", "--flow", "file"], "pass --flow dis"),
        (["--flow", "raft"], "invalid choice"),
    ],
)
def test_bad_options(
    tool: ModuleType,
    sequence: str,
    tmp_path: Path,
    options: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert tool.main(["--sequence", sequence, "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
