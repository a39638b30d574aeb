"""The tool that plays recordings at 30 Hz through the loop of ``hybridvo live``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.scripts import load_script

live = load_script("tools/bench/live.py")


@pytest.mark.parametrize("mode", ["no limit", "auto"])
def test_what_was_tracked_is_counted(
    mode: str, image_walk: Path, tmp_path: Path
) -> None:
    """How many frames are dropped depends on the machine; none is counted twice."""
    out = tmp_path / "live.json"
    words = ["--recordings", image_walk.name, "--data", str(image_walk.parent)]
    more = ["--frames", "9", "--modes", mode, "--out", str(out)]
    assert live.main([*words, *more]) == 0
    result = json.loads(out.read_text())
    row = result["rows"][0]
    assert row["tracked"]["of"] + row["tried"] == 9
    assert row["tracked"]["count"] <= row["tracked"]["of"]
    assert len(row["load"]) == 2
    assert (row["tried"] > 0) == (mode == "auto")
    assert str(tmp_path) not in out.read_text()
