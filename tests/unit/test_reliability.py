"""docs/reliability.md says what the tests did: its tool counts right, and the table cannot rot."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from types import ModuleType

import pytest
import yaml

from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results"


def tool() -> ModuleType:
    return load_script("tools/reliability.py")


STATISTICS = """tests/unit/test_a.py::test_one[b]:

  - during generate phase (0.14 seconds):
    - 37 passing, 1 failing, and 4 invalid test cases
"""
XML = f"""<testsuites><testsuite>
<properties><property name="hypothesis-statistics-tests/unit/test_a.py::test_one[b]"
 value="{base64.b64encode(STATISTICS.encode()).decode()}"/></properties>
<testcase file="tests/unit/test_a.py" name="test_one[a]"/>
<testcase file="tests/unit/test_a.py" name="test_one[b]"><failure message="no"/></testcase>
<testcase file="tests/unit/test_a.py" name="test_two">
 <properties><property name="tries" value="40"/></properties></testcase>
<testcase file="tests/unit/test_a.py" name="test_three"><skipped message="why"/></testcase>
<testcase file="tests/unit/test_a.py" name="test_other"/>
</testsuite></testsuites>"""
NAMES = [f"tests/unit/test_a.py::test_{name}" for name in ("one", "two", "three", "four")]


def test_counting_by_hand(tmp_path):
    (tmp_path / "a.xml").write_text(XML)
    rows = tool().collect([tmp_path / "a.xml"], NAMES)
    one, two, three = (rows[name] for name in NAMES[:3])
    assert (one["cases"], one["tries"], one["failed"], one["skipped"]) == (2, 39, 1, 0)
    assert (two["cases"], two["tries"], two["failed"]) == (1, 40, 0)
    assert (three["cases"], three["tries"], three["reasons"]) == (1, 0, ["why"])
    assert set(rows) == set(NAMES[:3])


def test_what_failed_or_was_not_run_is_said(tmp_path):
    made = tool()
    (tmp_path / "a.xml").write_text(XML)
    rows = made.collect([tmp_path / "a.xml"], NAMES)
    row = {"what": "w", "made": "m"}
    matrix = {
        "faults": {f"F{k}": row | {"tests": [name]} for k, name in enumerate(NAMES, 1)},
        "totals": [{"what": "tracebacks", "tests": NAMES[:2], "counted": ["tracebacks"]}],
    }
    stress = {"kills": {"kills": 200, "runs": 9, "tracebacks": 3}}
    text = made.page(matrix, {"tests": rows} | made.surroundings(), {"stress": stress})
    assert "| F1 | w | m | 39 | **1 of 2 FAIL**: test_one |" in text
    assert "| F2 | w | m | 40 | as it should |" in text
    assert "| F3 | w | m | 0 | as it should; 1 skipped: why |" in text
    assert "| F4 | w | m | 0 | 1 of 1 tests not run |" in text
    assert "| tracebacks | 2, 79 | 1 | kills: 3 of 9 |" in text
    assert "**1 of the tests not run**" in text


def test_every_fault_has_a_test_that_exists():
    made = tool()
    matrix = made.read_faults(made.FAULTS)
    assert len(matrix["faults"]) == 44
    for name, row in matrix["faults"].items():
        assert row["tests"], name
    assert len(matrix["totals"]) == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m["faults"].pop("F7"), "F1 to F44"),
        (lambda m: m["faults"]["F7"]["tests"].append(f"{__name__}.py::x"), "no such file"),
        (
            lambda m: m["faults"]["F7"]["tests"].append("tests/unit/test_reliability.py::test_x"),
            "there is no such test",
        ),
    ],
    ids=["row", "file", "test"],
)
def test_a_matrix_that_is_wrong_is_refused(tmp_path, capsys, change, message):
    made = tool()
    matrix = yaml.safe_load(made.FAULTS.read_text(encoding="utf-8"))
    change(matrix)
    (tmp_path / "faults.yaml").write_text(yaml.safe_dump(matrix, sort_keys=False))
    assert made.main(["--faults", str(tmp_path / "faults.yaml"), "--check"]) == 2
    assert message in capsys.readouterr().err


def test_the_page_is_that_of_the_tool():
    assert tool().main(["--check"]) == 0, "run python tools/reliability.py"


def test_nothing_on_the_page_failed():
    rows = json.loads((RESULTS / "reliability.json").read_text(encoding="utf-8"))["tests"]
    assert [name for name, row in rows.items() if row["failed"]] == []
