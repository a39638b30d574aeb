from __future__ import annotations

import importlib.util

import pytest

from hybridvo.doctor import doctor, doctor_text
from hybridvo.evaluation.report import to_json


def test_everything_is_here() -> None:
    report = doctor()
    assert report["usable"] and report["missing"] == {}
    assert report["warm_up_s"] > 0 and report["numba_cache"]["files"] >= 0
    assert report["methods"]["refine"] == "" and "weights" in report["methods"]["vonet"]
    assert report["methods"]["hybrid"] == report["methods"]["pwvo"] == ""
    assert report["threads"]["numba"] >= 1 and "cpu" in report["devices"]
    text = doctor_text(report)
    assert "numpy" in text and text.endswith("ready\n")
    assert '"usable": true' in to_json(report)


def test_a_missing_package_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "evo" else find(name, *a)
    )
    report = doctor()
    assert not report["usable"]
    assert report["missing"] == {"evo": "pip install evo"}
    text = doctor_text(report)
    assert "MISSING    evo: pip install evo" in text and text.endswith("NOT ready: see above\n")


def test_a_part_that_fails_does_not_end_the_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(report: object) -> None:
        raise RuntimeError("no driver")

    broken.__name__ = "_look_at_devices"
    monkeypatch.setattr("hybridvo.doctor._look_at_devices", broken)
    report = doctor()
    assert report["notes"] == ["devices: RuntimeError: no driver"]
    assert not report["usable"] and report["methods"]["refine"] == ""
