"""A video without depth, by the command line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo import InputError, open_sequence
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.run.cli import main
from hybridvo.run.commands.stored_state import restored, saved
from hybridvo.tracking.depth_scale import ScaleFilter, divided
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.tracker_state import Sensors, TrackerState
from tests.io.onnx.graphs import (
    constant_network,
    depth_network,
    describe,
    flow_network,
    mask_network,
)

FRAMES = 5
SIZE = (48, 64)
CAMERA = "fx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\nwidth: 64\nheight: 48\n"


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A textured wall at 2 m, past which the camera moves by 2 px a frame to the right."""
    root = tmp_path / "mine"
    root.mkdir()
    (root / "camera.yaml").write_text(CAMERA)
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (48, 90)), (0, 0), 1.5)
    wall = cv2.normalize(wall, None, 20, 235, cv2.NORM_MINMAX)
    grey = np.dstack([wall] * 3).astype(np.uint8)
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(root / "walk.avi"), code, 20.0, SIZE[::-1])
    for i in range(FRAMES):
        writer.write(np.ascontiguousarray(grey[:, 2 * i : 2 * i + 64]))
    writer.release()
    return root


def wall_network(folder: Path) -> str:
    """Depth of a wall at 2 m, which varies by a little so that nothing is degenerate."""
    v, u = np.mgrid[:48, :64]
    depth = 2.0 + 0.1 * np.sin(u / 9) + 0.1 * np.cos(v / 7)
    inputs = {"image": (1, 3, *SIZE)}
    model = constant_network(folder / "wall.onnx", {"d": depth[None, None]}, inputs)
    return describe(model, "task: depth\n")


def test_a_video_needs_depth_or_a_network(video: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--depth onnx:FILE"):
        open_sequence(video / "walk.avi")
    sequence = open_sequence(video, depth=wall_network(tmp_path))
    assert (sequence.kind, sequence.depth_source) == ("video", "network")
    assert len(sequence) == FRAMES
    frame = sequence[2]
    assert frame.depth_source == "network"
    assert np.median(frame.depth) == pytest.approx(2.0, abs=0.1)
    assert {"wall.onnx", "wall.yaml"} <= {path.name for path in sequence.files()}
    assert sequence.opened_with()["networks"] == {"depth": "wall.onnx"}


def test_run_with_networks_for_everything(video: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    flow = flow_network(tmp_path / "flow.onnx", -2.0, 0.0, SIZE)
    people = mask_network(tmp_path / "people.onnx")
    arguments = [
        *("run", str(video), "--method", "classical", "-q", "--out", str(out)),
        *("--depth", wall_network(tmp_path)),
        *("--flow", describe(flow, "task: flow\nboth_directions: false\n")),
        *("--mask", describe(people, "task: mask\nstd: [500, 500, 500]\n")),
    ]
    assert main(arguments) == 0
    state = json.loads((out / "run.json").read_text())
    summary = state["summary"]
    assert summary["depth_source"] == "network"
    assert summary["flow_source"] == ["onnx flow.onnx"]
    assert summary["oracle"] == []
    assert summary["depth_scale"]["log_std"] < 0.01
    header = (out / "steps.csv").read_text().splitlines()[0].split(",")
    assert {"depth_scale", "scale_change"} <= set(header)
    rows = np.loadtxt(out / "trajectory.tum")
    # 2 px of 60 at 2 m
    np.testing.assert_allclose(np.diff(rows[:, 1]), 2 / 60 * 2, rtol=0.1)


def test_a_resumed_run_reads_depth_in_its_scale(
    video: Path, tmp_path: Path
) -> None:
    sequence = open_sequence(video, depth=wall_network(tmp_path))
    state = TrackerState(
        Keyframe(divided(sequence[1], 1.25), np.eye(4), 1, 1, np.zeros((6, 6))),
        sensors=Sensors(scale=ScaleFilter(1e-4)),
    )
    again = restored(json.loads(json.dumps(saved(state))), sequence)
    assert again.sensors.scale == state.sensors.scale
    assert again.frame.depth_scale == 1.25
    np.testing.assert_array_equal(again.frame.depth, state.frame.depth)


def test_a_network_that_is_missing_is_one_line(
    video: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(video), "--depth", "onnx:no.onnx"]) == 2
    assert "expected an ONNX file, got no such file" in capsys.readouterr().err
    for wrong in ("wall.onnx", "onnx"):
        assert main(["run", str(video), "--depth", wrong]) == 2
        assert "onnx:FILE" in capsys.readouterr().err
    text = wall_network(tmp_path)
    assert main(["run", str(video), "--depth", text, "--flow", "onnx:no.onnx"]) == 2
    assert "--flow onnx:no.onnx" in capsys.readouterr().err


def test_live_frames_go_through_the_networks(video: Path, tmp_path: Path) -> None:
    red = depth_network(tmp_path / "a.onnx", 0.01)
    people = mask_network(tmp_path / "people.onnx")
    camera = choose_camera(
        str(video),
        depth=describe(red, "task: depth\n"),
        mask=describe(people, "task: mask\nstd: [255, 255, 255]\n"),
    )
    camera.open()
    reading = camera.read(1.0)
    assert reading is not None
    frame = reading.frame
    camera.close()
    assert frame.depth_source == "network"
    np.testing.assert_array_equal(frame.mask, frame.rgb[..., 0] <= 127)
    with pytest.raises(InputError, match="expected onnx:FILE, a network"):
        choose_camera(str(video), mask="masks")
