"""The tool that plays recordings at 30 Hz through the loop of ``hybridvo live``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hybridvo import open_sequence
from tests.scripts import load_script

live = load_script("tools/bench/live.py")


def test_a_recording_goes_to_and_fro(image_walk: Path) -> None:
    original = open_sequence(image_walk)
    last = len(original) - 1
    sequence = live.ToAndFro(original, 2 * len(original))
    assert len(sequence) == 2 * len(original)
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 30)
    # the frame after the last one is the one before it, and then all come again
    np.testing.assert_array_equal(
        sequence.frame(last + 1).rgb, original.frame(last - 1).rgb
    )
    np.testing.assert_array_equal(
        sequence.frame(2 * last).rgb, original.frame(0).rgb
    )
    assert sequence.frame(last + 1).index == last + 1
    if original.poses is not None:
        np.testing.assert_array_equal(
            sequence.poses[last + 1], original.poses[last - 1]
        )


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
