"""``hybridvo convert``: what it writes reads back as what was read."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybridvo import Camera, Frame, InputError, open_sequence
from hybridvo.core.errors import OutputError
from hybridvo.run.cli import main
from hybridvo.run.commands.convert import convert
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
    # a name by which TUM's reader would take another camera, and poses of markers
    out = tmp_path / "bonn_fr1"
    assert main(["convert", str(bag), str(out), "--to", layout, "-q"]) == 0
    before = open_sequence(bag)
    after = open_sequence(out)
    assert (after.kind, len(after)) == (layout, len(before))
    assert after.camera(0) == before.camera(0)
    np.testing.assert_allclose(after.timestamps, before.timestamps, atol=1e-6)
    np.testing.assert_allclose(after.poses, before.poses, atol=1e-12)
    for i in range(len(before)):
        np.testing.assert_array_equal(after[i].rgb, before[i].rgb)
        # millimetres are whole in both units
        np.testing.assert_array_equal(after[i].depth, before[i].depth)
    assert not any("assumed" in text for text in after.warnings)


def test_the_readout_of_a_rolling_shutter_is_kept(
    bag: Path, tmp_path: Path
) -> None:
    camera = replace(open_sequence(bag).camera(0), readout_ms=15.0)
    convert(open_sequence(bag, camera=camera), tmp_path / "out", stop=1)
    assert open_sequence(tmp_path / "out").camera(0) == camera


def test_a_readout_that_is_stated_goes_into_the_camera_file(
    bag: Path, tmp_path: Path, capsys
) -> None:
    stated = ["--readout-ms", "12.5", "--stop", "2"]
    folder = tmp_path / "folder"
    assert main(["convert", str(bag), str(folder), *stated]) == 0
    assert "--readout-ms" not in capsys.readouterr().out
    after = open_sequence(folder)
    assert after.camera(0).readout_ms == after[1].camera.readout_ms == 12.5
    # CameraInfo has no field for it
    again = tmp_path / "walk.bag"
    assert main(["convert", str(bag), str(again), *stated]) == 0
    assert "read it with --readout-ms 12.5" in capsys.readouterr().out
    assert open_sequence(again).camera(0).readout_ms == 0


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
        ({"to": "svo"}, "expected folder, tum, ros1, ros2"),
    ):
        given = {"out": tmp_path / "new"} | options
        with pytest.raises(InputError, match=words):
            convert(sequence, **given)
    assert main(["convert", str(bag)]) == 2
    assert "OUT" in capsys.readouterr().err


def test_a_camera_of_another_size_is_refused(bag: Path, tmp_path: Path) -> None:
    sequence = open_sequence(bag)
    other = Camera(50.0, 50.0, 7.5, 5.5, height=12, width=16)
    first = sequence.camera(0)
    sequence.camera = lambda index: other if index else first
    frame = sequence.frame
    image = np.zeros((12, 16, 3), np.uint8)
    depth = np.ones((12, 16), np.float32)
    sequence.frame = lambda index: (
        Frame(image, depth, other, 1.0 + index, index) if index else frame(0)
    )
    with pytest.raises(InputError, match="of another size"):
        convert(sequence, tmp_path / "out")


def test_a_camera_that_focuses_anew_is_resampled(bag: Path, tmp_path: Path) -> None:
    """Twice the focal length: a step of two pixels becomes one of one."""
    sequence = open_sequence(bag)
    first = sequence.camera(0)
    zoomed = Camera(
        2 * first.fx, 2 * first.fy, first.cx, first.cy, height=24, width=32
    )
    frame = sequence.frame

    def zoom(index: int) -> Frame:
        found = frame(index)
        camera = zoomed if index == 1 else first
        return Frame(found.rgb, found.depth, camera, found.timestamp, index)

    sequence.frame = zoom
    found = convert(sequence, tmp_path / "out")
    assert "1 frames of another camera are resampled" in found["warnings"][-1]
    after = open_sequence(tmp_path / "out")
    assert after.camera(1) == first
    before = frame(1)
    np.testing.assert_array_equal(after[0].rgb, frame(0).rgb)
    # what pixel u sees lies between two of the other camera's: at 2 (u - 15.5) + 15.5
    u, v = 10, 9
    x = int(2 * (u - first.cx) + first.cx - 0.5)
    y = int(2 * (v - first.cy) + first.cy - 0.5)
    patch = before.rgb[y : y + 2, x : x + 2].reshape(-1, 3).astype(float)
    np.testing.assert_allclose(after[1].rgb[v, u], patch.mean(axis=0), atol=1)
    # the border lies outside of what the other camera sees
    assert (after[1].depth[0] == 0).all() and after[1].depth[v, u] > 1


@pytest.mark.parametrize("ros", ["ros1", "ros2"])
@pytest.mark.parametrize("units", ["1000", "1"])
def test_a_bag_reads_back(ros: str, units: str, bag: Path, tmp_path: Path) -> None:
    out = tmp_path / ("out.bag" if ros == "ros1" else "out")
    command = ["convert", str(bag), str(out), "--to", ros, "--units", units, "-q"]
    assert main(command) == 0
    before = open_sequence(bag)
    after = open_sequence(out)
    assert (after.kind, len(after)) == ("bag", len(before))
    assert out.is_file() == (ros == "ros1")
    assert after.camera(0) == before.camera(0)
    np.testing.assert_allclose(after.timestamps, before.timestamps, atol=1e-6)
    np.testing.assert_allclose(after.poses, before.poses, atol=1e-12)
    for i in range(len(before)):
        np.testing.assert_array_equal(after[i].rgb, before[i].rgb)
        np.testing.assert_array_equal(after[i].depth, before[i].depth)
    # whose poses they are, and that depth is registered, stands in the bag
    assert not after.assumed
    [warning] = after.warnings
    assert (
        "topics are guessed" in warning and "truth /ground_truth/camera" in warning
    )


def test_the_ending_of_a_bag_is_enough(tmp_path: Path) -> None:
    """Frames without depth or pose stay without; a first stamp of zero is kept."""
    arrays = {
        "rgb": np.random.default_rng(1).integers(0, 256, (3, 4, 6, 3), np.uint8),
        "depth": np.full((3, 4, 6), 70.0, np.float32),
        "K": np.array([[9.0, 0, 2], [0, 9, 1.5], [0, 0, 1]]),
        "timestamps": np.array([0.0, 0.5, 1.25]),
        "poses": np.stack([np.eye(4)] * 3),
    }
    arrays["depth"][1, 0] = np.inf
    arrays["depth"][:, 2:] = 4.2
    arrays["poses"][1] = np.nan
    np.savez(tmp_path / "walk.npz", **arrays)
    sequence = open_sequence(tmp_path / "walk.npz")
    found = convert(sequence, tmp_path / "walk.bag")
    assert "are farther than 65.53 m" in found["warnings"][-1]
    after = open_sequence(tmp_path / "walk.bag")
    np.testing.assert_allclose(after.timestamps, arrays["timestamps"])
    assert np.isnan(after.poses[1]).all() and np.isfinite(after.poses[2]).all()
    assert (after[0].depth[:2] == 0).all()
    np.testing.assert_allclose(after[0].depth[2:], 4.2)
    convert(sequence, tmp_path / "metres.bag", units=1)
    far = open_sequence(tmp_path / "metres.bag")
    assert (far[0].depth[:2] == 70).all()


def test_bags_that_cannot_be_written(bag: Path, tmp_path: Path) -> None:
    sequence = open_sequence(bag)
    (tmp_path / "there.bag").write_bytes(b"mine")
    (tmp_path / "file").write_bytes(b"mine")
    for out, options, words in (
        ("there.bag", {}, "a new file that ends in .bag, got one that exists"),
        ("walk", {"to": "ros1"}, "ends in .bag, got 'walk'"),
        ("file", {"to": "ros2"}, "a new or an empty folder"),
        ("a.bag", {"units": 5000}, "expected 1000 or 1"),
        ("a.bag", {"start": 99}, "no frame to write"),
        ("file/a.bag", {}, "cannot be created"),
    ):
        with pytest.raises((InputError, OutputError), match=words):
            convert(sequence, tmp_path / out, **options)
    # nothing is left of a bag that has no index
    assert not (tmp_path / "a.bag").exists()
    assert (tmp_path / "there.bag").read_bytes() == b"mine"
    sequence.timestamps = sequence.timestamps - 2e9
    with pytest.raises(InputError, match="times from 1970 on"):
        convert(sequence, tmp_path / "old", to="ros2")
    assert not (tmp_path / "old").exists()
    assert not list(tmp_path.glob("*.part-*"))


KILLED = """
import os, signal, sys
from hybridvo import open_sequence
from hybridvo.run.commands.convert import convert
sequence = open_sequence(sys.argv[1])
frame = sequence.frame
sequence.frame = lambda i: os.kill(os.getpid(), signal.SIGKILL) if i == 3 else frame(i)
convert(sequence, sys.argv[2], sys.argv[3])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "to"), [("out", "folder"), ("out.bag", "ros1"), ("out", "ros2")]
)
def test_after_a_kill_the_same_command_begins_anew(
    name: str, to: str, bag: Path, tmp_path: Path
) -> None:
    out = tmp_path / name
    words = [sys.executable, "-c", KILLED, str(bag), str(out), to]
    assert subprocess.run(words).returncode == -signal.SIGKILL
    assert not out.exists()
    assert main(["convert", str(bag), str(out), "--to", to, "-q"]) == 0
    assert len(open_sequence(out)) == bags.FRAMES


@pytest.mark.parametrize(("name", "to"), [("out", "tum"), ("out.bag", "ros1")])
def test_what_fails_leaves_nothing(
    name: str, to: str, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = open_sequence(bag)
    full = OutputError("the disk is full")

    def fail(*_: object) -> None:
        raise full

    target = "_FolderWriter._close" if to == "tum" else "_BagWriter._close"
    with monkeypatch.context() as patch:
        patch.setattr(f"hybridvo.run.commands.convert.{target}", fail)
        with pytest.raises(OutputError):
            convert(sequence, tmp_path / name, to)
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]
    if to == "tum":
        (tmp_path / name).mkdir()
    convert(sequence, tmp_path / name, to)
    assert len(list(tmp_path.iterdir())) == 2


def test_rosbags_is_named_where_it_is_missing(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = open_sequence(bag)
    name = "hybridvo.io.data.bags.writer.find_spec"
    monkeypatch.setattr(name, lambda library: None)
    with pytest.raises(InputError, match=r"hybridvo\[bags\]"):
        convert(sequence, tmp_path / "a.bag")
