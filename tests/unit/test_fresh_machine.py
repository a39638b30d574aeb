"""The comparison by which tools/fresh_machine.py says that a clean machine prints what is shown."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]


def tool() -> ModuleType:
    return load_script("tools/fresh_machine.py")


def shown() -> str:
    return tool().shown_demo((ROOT / "README.md").read_text(encoding="utf-8"))


def test_the_readmes_own_table_is_as_promised():
    assert len(shown().splitlines()) > 8
    assert tool().differences(shown(), shown()) == []


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda t: t.replace("hybridvo (refine)", "refine"), 1),
        (lambda t: t.replace("ATE [cm]*", "ATE [mm]*"), 1),
        (lambda t: "\n".join(t.splitlines()[:-1]), 1),
        (lambda t: t.replace(t.splitlines()[5].split("  ")[0], "other", 1), 1),
        (lambda t: "", 1),
    ],
    ids=["method", "column", "line", "first_row", "nothing"],
)
def test_what_differs_is_found(change, found):
    assert len(tool().differences(shown(), change(shown()))) >= found


def test_times_and_small_changes_are_let_pass():
    row = (
        "OpenCV PnP-RANSAC           239.390         25.490               0.6832     7.193  0  34.7"
    )
    close = (
        "OpenCV PnP-RANSAC          230.100         25.500               0.6832     7.193  0  99.9"
    )
    far = (
        "OpenCV PnP-RANSAC           139.390         25.490               0.6832     7.193  0  34.7"
    )
    failed = (
        "OpenCV PnP-RANSAC         239.390         25.490               0.6832     7.193  1  34.7"
    )
    assert tool().differences(row, close) == []
    assert tool().differences(row, far) != []
    assert tool().differences(row, failed) != []


def test_this_python_is_found():
    made = tool()
    assert made.version(sys.executable) == sys.version_info[:3]
    assert made.version("/no/such/python") is None


def test_wrong_usage(tmp_path, capsys):
    assert tool().main(["--python", "/no/such/python"]) == 2
    assert tool().main(["--python", sys.executable, "--keep", str(tmp_path)]) == 2
    assert "exists" in capsys.readouterr().err
