"""``hybridvo convert``: what it writes reads back as what was read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hybridvo import Camera, InputError, open_sequence
from hybridvo.cli import main
from hybridvo.commands.convert import convert
from tests import bags


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag with true poses."""
    writer = bags.Writer(tmp_path / "bag", "mcap")
    for i in range(bags.FRAMES):
        time = bags.stamp(i)
        writer.write(bags.INFO, writer.info(), time)
        writer.write(bags.RGB, writer.image(bags.rgb(i), "rgb8", time), time)
        depth = writer.image(bags.millimetres(i), "16UC1", time)
        writer.write(bags.DEPTH, depth, time)
        half = np.sqrt(0.5)
        pose = writer.pose((0.1 * i, 0, 1), (0, half, 0, half), time)
        writer.write("/vicon/camera", pose, time)
    return writer.close()


@pytest.mark.parametrize("layout", ["folder", "tum"])
def test_what_is_written_reads_back(layout: str, bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["convert", str(bag), str(out), "--to", layout, "-q"]) == 0
    camera = out / "calibration.yaml" if layout == "tum" else None
    before = open_sequence(bag)
    after = open_sequence(out, camera=camera)
    assert (after.kind, len(after)) == (layout, len(before))
    assert after.camera(0) == before.camera(0)
    np.testing.assert_allclose(after.timestamps, before.timestamps, atol=1e-6)
    np.testing.assert_allclose(after.poses, before.poses, atol=1e-12)
    for i in range(len(before)):
        np.testing.assert_array_equal(after[i].rgb, before[i].rgb)
        # millimetres are whole in both units
        np.testing.assert_array_equal(after[i].depth, before[i].depth)
    assert not any("assumed" in text for text in after.warnings)


def test_a_part_of_a_sequence(bag: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    part = ["--start", "1", "--stop", "5", "--stride", "2"]
    assert main(["convert", str(bag), str(out), *part]) == 0
    assert f"2 frames written to {out}" in capsys.readouterr().out
    after = open_sequence(out)
    assert len(after) == 2
    np.testing.assert_array_equal(after[1].rgb, bags.rgb(3))


def test_depth_beyond_sixteen_bits_is_said(tmp_path: Path) -> None:
    arrays = {
        "rgb": np.zeros((2, 4, 5, 3), np.uint8),
        "depth": np.full((2, 4, 5), 3.0, np.float32),
        "K": np.array([[9.0, 0, 2], [0, 9, 1.5], [0, 0, 1]]),
        "timestamps": np.arange(2),
    }
    arrays["depth"][:, 0] = 80.0
    arrays["depth"][:, 1] = np.nan
    path = tmp_path / "walk.npz"
    np.savez(path, **arrays)
    sequence = open_sequence(path)
    found = convert(sequence, tmp_path / "near")
    text = "10 pixels are farther than 65.53 m"
    assert any(text in warning for warning in found["warnings"])
    depth = open_sequence(tmp_path / "near")[0].depth
    assert (depth[:2] == 0).all() and (depth[2:] == 3).all()
    convert(sequence, tmp_path / "far", units=256)
    assert (open_sequence(tmp_path / "far")[0].depth[0] == 80).all()


def test_what_cannot_be_written(bag: Path, tmp_path: Path, capsys) -> None:
    sequence = open_sequence(bag)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    for options, words in (
        ({"out": tmp_path / "full"}, "a new or an empty folder"),
        ({"units": -1}, "units per metre"),
        ({"stride": 0}, "--stride >= 1"),
        ({"start": 99}, "no frame to write"),
        ({"to": "svo"}, "expected folder or tum"),
    ):
        given = {"out": tmp_path / "new"} | options
        with pytest.raises(InputError, match=words):
            convert(sequence, **given)
    assert main(["convert", str(bag)]) == 2
    assert "OUT" in capsys.readouterr().err


def test_a_camera_that_changes_is_refused(bag: Path, tmp_path: Path) -> None:
    sequence = open_sequence(bag)
    other = Camera(50.0, 50.0, 15.5, 11.5, 24, 32)
    first = sequence.camera(0)
    sequence.camera = lambda index: other if index else first
    with pytest.raises(InputError, match="its camera is not that of the first"):
        convert(sequence, tmp_path / "out")
