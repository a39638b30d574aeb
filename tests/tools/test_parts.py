"""The table of parts: every published figure has a command that still exists."""

import json
import re
import sys

import pytest

from tests.scripts import ROOT, load_script

tables = load_script("tools/tables.py")
benchmark = load_script("tools/benchmark.py")
PARTS = tables.PARTS
TRAINED = {"ablation", "ablation_full", "ablation_long", "paper", "paper_rules"}
"""Files of networks that train for hours."""
SWEPT = {"numbers"}
"""File of ``tools/calibrate.py --numbers``, which takes hours as well."""


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_tool_takes_the_options_of_its_part(part):
    module = benchmark.import_module(f"bench.{part.tool}")
    words = part.words("data", "out.json")
    if hasattr(module, "build_parser"):
        args = module.build_parser().parse_args(words)
        assert str(args.out) == "out.json"
    named = set(getattr(module, "PARTS", ()))
    if "--parts" in words:
        assert set(words[words.index("--parts") + 1].split(",")) <= named


def test_every_file_of_figures_belongs_to_a_part():
    files = {path.stem for path in (ROOT / "docs/results").glob("*.json")}
    assert files - TRAINED - SWEPT == {part.file for part in PARTS}
    template = (ROOT / "tools/templates/tables.md").read_text("utf-8")
    used = set(re.findall(r"results\.benchmark\.(\w+)", template))
    command = " ".join(part.options for part in PARTS if part.tool == "methods")
    assert used <= set(re.findall(r"\w+", command))


def test_only_what_names_another_commit_is_due(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    monkeypatch.setattr(tables, "revision", lambda: "abc1234")
    content = {"heavy": {"commit": "abc1234"}, "real": {"commit": "0000000"}}
    (tmp_path / "benchmark.json").write_text(json.dumps(content))
    assert tables.main(["--list", "--only", "heavy,real,makers"]) == 0
    states = {
        line.split()[0]: "due" in line.split()
        for line in capsys.readouterr().out.splitlines()
    }
    assert states == {"heavy": False, "real": True, "makers": True}


def test_a_part_that_fails_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tables, "LOGS", tmp_path)
    monkeypatch.setattr(tables, "RESULTS", ROOT / "docs" / "results")
    failing = [sys.executable, "-c", "import sys; print('why'); sys.exit(3)"]
    monkeypatch.setattr(tables, "command_of", lambda *words: failing)
    args = tables.build_parser().parse_args([])
    assert tables.measure_all(args, PARTS[:1]) == [PARTS[0].name]
    assert "FAILED" in capsys.readouterr().out
    assert (tmp_path / f"{PARTS[0].name}.log").read_text() == "why\n"


def test_the_entry_shows_every_tool_and_refuses_others(capsys):
    assert benchmark.main([]) == 0
    shown = capsys.readouterr().out
    for name in benchmark.TOOLS:
        assert benchmark.purpose(name) in shown
        assert callable(benchmark.import_module(f"bench.{name}").main)
    assert {part.tool for part in PARTS} <= set(benchmark.TOOLS)
    assert benchmark.main(["makerz"]) == 2
    assert "makerz" in capsys.readouterr().err
