"""docs/results.md and docs/results/benchmark.md say what the JSON files say, and nothing else."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hybridvo.evaluation.protocols import protocol_summary, protocols
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
TEXT = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"(?<![\w.-])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.])")


def tool(name: str) -> ModuleType:
    return load_script(f"tools/{name}")


@pytest.fixture(scope="module")
def made() -> ModuleType:
    return tool("make_results_page.py")


def parts(text: str) -> dict[str, str]:
    """JSON file -> what the page says from it."""
    return dict(re.findall(r"<!-- from (\S+)\.json -->\n(.*?)<!-- end -->", text, re.DOTALL))


def leaves(value: object) -> list[float]:
    if isinstance(value, dict):
        return [leaf for child in value.values() for leaf in leaves(child)]
    if isinstance(value, list):
        return [leaf for child in value for leaf in leaves(child)]
    if isinstance(value, str):  # notes hold numbers as well
        return [float(number) for number in NUMBER.findall(value)]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return [float(value)] if is_number else []


def cells(text: str) -> list[str]:
    """Cells below the headings of all tables."""
    found, before = [], ""
    for line in text.splitlines():
        if line.startswith("|") and before.startswith("|") and not line.startswith("|--"):
            found += [cell.strip() for cell in line.strip("|").split("|")]
        before = line
    return found


def unknown(shown: list[str], known: np.ndarray) -> list[str]:
    """Numbers in cells that are no rounded value of the known ones."""
    missing = []
    for cell in shown:
        for text in NUMBER.findall(re.sub(r"`[^`]*`", "", cell)):
            decimals = len(text.split("e")[0].partition(".")[2])
            exponent = int(text.partition("e")[2] or 0)
            half = 0.5000001 * 10.0 ** (exponent - decimals)
            if not (np.abs(known - float(text)) <= half).any():
                missing.append(text)
    return missing


def test_the_page_is_that_of_the_tool(made):
    assert made.page(RESULTS) == TEXT, "run python tools/make_results_page.py"


@pytest.mark.parametrize("name", sorted(parts(TEXT)))
def test_every_number_is_in_its_json(name):
    shown = cells(parts(TEXT)[name])
    path = RESULTS / f"{name}.json"
    known = leaves(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else []
    if name.startswith("sintel_"):
        protocol = protocols()[name.removeprefix("sintel_")]
        known += [
            value
            for line in protocol.published
            for value in line.values()
            if isinstance(value, float)
        ]
        known += [14.0, 13.0, 2025.0, 2.0, 1.0, 6.0, 992.0]  # tables and years in the sources
    if name == "ablation":
        content = json.loads(path.read_text(encoding="utf-8"))
        known += [run["seconds"] / 60 for run in content["runs"]]  # shown in minutes
        published = tool("ablation_report.py").published()
        known += [value for line in published.values() for value in line.values()]
        known += [0.0]  # seeds of rows that are not trained
    assert len(NUMBER.findall(" ".join(shown))) > 10
    assert not unknown(shown, np.array(known))


def test_the_check_of_numbers_can_fail():
    known = np.array([0.12345, 20.0])
    assert unknown(["0.124"], known) == ["0.124"]
    assert not unknown(["0.123 [20]", "`pnp-3`"], known)
    assert cells("| a | b 7 |\n|---|---|\n| 1 | 2 |\n") == ["1", "2"]


def test_the_benchmark_page_is_that_of_its_json():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        report = tool("benchmark_report.py")
    finally:
        sys.path.pop(0)
    content = json.loads((RESULTS / "benchmark.json").read_text(encoding="utf-8"))
    names = list(content["summary"])
    page = report.markdown(content, names, list(content["summary"][names[0]]))
    assert page == (RESULTS / "benchmark.md").read_text(encoding="utf-8")


def test_the_commands_of_sintel_are_understood():
    parser = tool("compare_methods.py").build_parser()
    commands = re.findall(r"^python (tools/compare_methods\.py .*)$", TEXT, re.MULTILINE)
    assert len(commands) == 2
    for command, protocol in zip(commands, protocols(), strict=True):
        arguments = parser.parse_args(shlex.split(command)[1:])
        assert arguments.protocol == protocol
        copied = f"cp {arguments.out}/results.json docs/results/sintel_{protocol}.json"
        assert copied in TEXT


def test_tables_without_measurements_hold_dashes():
    for name in protocols():
        if (RESULTS / f"sintel_{name}.json").exists():
            continue
        rows = [line for line in parts(TEXT)[f"sintel_{name}"].splitlines() if line[:3] == "| `"]
        assert len(rows) == 13
        for row in rows:
            assert set(row.split("|")[2:-1]) == {" - "}


def test_a_measured_table_is_filled(made, tmp_path):
    rng = np.random.default_rng(0)
    protocol = protocols()["paper"]
    total = {"method": "refine", "flow_source": "file (true)", "depth_source": "true"}
    total |= {"pairs": 49, "failed": 0, "sequences": 1, "reasons": {"t_err": "because"}}
    total |= {"epe": float(rng.uniform()), "r_err_deg": float(rng.uniform()), "t_err": None}
    summary = protocol_summary(protocol, [total], {"alley_1": 49})
    (tmp_path / "sintel_paper.json").write_text(json.dumps({"protocol": summary}))
    text = parts(made.page(tmp_path))["sintel_paper"]
    (row,) = [line for line in text.splitlines() if line.startswith("| `")]
    shown = [cell.strip() for cell in row.strip("|").split("|")]
    assert shown[:3] == ["`refine`", "file (true)", "49"]
    assert [float(cell) for cell in shown[3:5]] == pytest.approx(
        [total["epe"], total["r_err_deg"]], rel=5e-3
    )
    assert shown[5] == "-"
    assert "22 of 23 sequences are missing" in text


def test_the_ablation_stands_there_once_it_is_measured(made, tmp_path):
    assert "Ablation" not in made.page(tmp_path)
    report = tool("ablation_report.py")
    zero = {"zero_epe": 3.25, "zero_r_err_deg": 0.5, "zero_t_err": 0.25}
    scores = {"epe": 0.8765, "r_err_deg": 0.125, "t_err": 0.0625} | zero
    run = {"row": "pwvo", "seed": 0, "scores": {"data_paper": scores, "data_wide": scores}}
    run |= {"updates": 7, "skipped": 0, "seconds": 90.0, "samples_per_s": 20.0}
    content = report.summary([run], None, 1) | {
        **{"command": ["tools/ablation.py", "--out", "x"], "commit": "abc", "samples": 100},
        **{"base": "configs/ablation.yaml", "device": "cpu", "threads": 1},
        "held_out": {"count": 10, "seed": 4000},
    }
    (tmp_path / "ablation.json").write_text(json.dumps(content))
    text = made.page(tmp_path)
    assert "\n## Ablation" in text and "\n### Table 1: main\n" in text
    row = next(line for line in text.splitlines() if line.startswith("| PWVO | 1 |"))
    assert "| 0.876 | 0.125 | 0.062 |" in row or "| 0.877 | 0.125 | 0.062 |" in row


def test_bad_files_are_named(made, tmp_path, capsys):
    (tmp_path / "benchmark.json").write_text("{}")
    page = tmp_path / "page.md"
    assert made.main(["--results", str(tmp_path), "--page", str(page)]) == 2
    assert "benchmark.json: not as its tool writes it" in capsys.readouterr().err
    assert not page.exists()
    (tmp_path / "benchmark.json").unlink()
    assert made.main(["--results", str(tmp_path), "--page", str(page), "--check"]) == 1
    assert made.main(["--results", str(tmp_path), "--page", str(page)]) == 0
    assert made.main(["--results", str(tmp_path), "--page", str(page), "--check"]) == 0
