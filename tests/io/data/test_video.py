"""A video with a depth map for each frame, and the recordings of a phone."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo import InputError, open_sequence
from hybridvo.core.errors import FormatError
from hybridvo.run.cli import main

N = 12
SIZE = (48, 64)
CAMERA = (
    "fx: 80\nfy: 80\ncx: 31.5\ncy: 23.5\nwidth: 64\nheight: 48\ndepth_scale: 1000\n"
)


def shade(i: int) -> int:
    """The grey of a frame: smooth, so that compression keeps it."""
    return 20 * i + 10


def write_video(path: Path, size: tuple[int, int] = SIZE, frames: int = N) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    code = cv2.VideoWriter.fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    writer = cv2.VideoWriter(str(path), code, 20.0, size[::-1])
    for i in range(frames):
        writer.write(np.full((*size, 3), shade(i), np.uint8))
    writer.release()


def write_depth(
    folder: Path, names: list[str], size: tuple[int, int] = SIZE
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        depth = np.full(size, 1000 + 100 * i, np.uint16)
        (folder / f"{name}.png").write_bytes(
            cv2.imencode(".png", depth)[1].tobytes()
        )


def recording(root: Path, ending: str = ".mp4") -> Path:
    write_video(root / f"color{ending}")
    write_depth(root / "depth", [f"{i:06d}" for i in range(N)])
    (root / "camera.yaml").write_text(CAMERA)
    return root


@pytest.mark.parametrize("ending", [".mp4", ".avi"])
def test_frames_come_in_any_order(ending: str, tmp_path: Path) -> None:
    sequence = open_sequence(recording(tmp_path, ending))
    assert (sequence.kind, len(sequence)) == ("video", N)
    np.testing.assert_allclose(sequence.timestamps, np.arange(N) / 20, atol=1e-3)
    for i in (0, 1, 2, 7, 3, 11, 0):
        frame = sequence[i]
        assert np.abs(frame.rgb.astype(int) - shade(i)).max() <= 8
        np.testing.assert_allclose(frame.depth, 1 + 0.1 * i)


def test_a_video_with_depth_in_another_folder(tmp_path: Path) -> None:
    root = recording(tmp_path / "mine")
    (root / "depth").rename(tmp_path / "maps")
    video = root / "color.mp4"
    with pytest.raises(
        InputError, match="a video has no depth: expected 16-bit PNG"
    ):
        open_sequence(video)
    sequence = open_sequence(video, depth_dir=str(tmp_path / "maps"))
    assert len(sequence) == N
    out = tmp_path / "out"
    depth = ["--depth-dir", str(tmp_path / "maps")]
    command = ["run", str(video), *depth, "--out", str(out), "-q"]
    assert main([*command, "--method", "identity"]) == 0
    assert len((out / "trajectory.tum").read_text().splitlines()) == N


def test_depth_of_some_frames_is_matched_by_number_or_time(tmp_path: Path) -> None:
    root = recording(tmp_path)
    for i in range(N):
        if i % 3:
            (root / "depth" / f"{i:06d}.png").unlink()
    sequence = open_sequence(root)
    assert len(sequence) == 4
    np.testing.assert_allclose(sequence.timestamps, [0, 0.15, 0.3, 0.45], atol=1e-3)
    assert np.abs(sequence[1].rgb.astype(int) - shade(3)).max() <= 8
    np.testing.assert_allclose(sequence[1].depth, 1.3)
    assert any("8 of 12 frames have no depth" in text for text in sequence.warnings)

    # by stamps: half a frame late, and one too many
    (root / "timestamps.txt").write_text(
        "\n".join(f"{0.1 * i:.1f}" for i in range(N))
    )
    stamps = [0.01, 0.31, 0.61, 5.0]
    listed = root / "depth_timestamps.txt"
    listed.write_text("\n".join(map(str, stamps)))
    sequence = open_sequence(root)
    np.testing.assert_allclose(sequence.timestamps, [0, 0.3, 0.6])
    np.testing.assert_allclose(sequence[2].depth, 1.6)

    for path in (listed, root / "timestamps.txt"):
        path.unlink()
    (root / "depth" / "000009.png").rename(root / "depth" / "000099.png")
    with pytest.raises(InputError, match="4 depth maps for 12 frames"):
        open_sequence(root)


def test_what_is_missing_or_of_another_size(tmp_path: Path) -> None:
    root = recording(tmp_path)
    (root / "camera.yaml").unlink()
    with pytest.raises(InputError, match=r"no camera\.yaml beside the video"):
        open_sequence(root)
    sequence = open_sequence(root, camera="80,80,31.5,23.5", depth_scale=100)
    assert sequence[0].depth[0, 0] == 10.0
    (root / "camera.yaml").write_text(CAMERA.replace("width: 64", "width: 65"))
    with pytest.raises(InputError, match="the video is 64x48"):
        open_sequence(root)
    (root / "camera.yaml").write_text(CAMERA)
    write_depth(root / "depth", [f"{i:06d}" for i in range(N)], (24, 32))
    with pytest.raises(InputError, match="depth is 32x24, the video 64x48"):
        open_sequence(root)


# -- Stray Scanner ---------------------------------------------------------------------------------


def stray(root: Path) -> Path:
    """The app's layout: video of 320x240, depth of 32x24, poses with OpenCV's axes."""
    write_video(root / "rgb.mp4", (240, 320), 3)
    write_depth(root / "depth", [f"{i:06d}" for i in range(3)], (24, 32))
    for i in range(3):
        levels = np.full((24, 32), 2, np.uint8)
        levels[:, :4] = 0
        path = root / "confidence" / f"{i:06d}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(cv2.imencode(".png", levels)[1].tobytes())
    matrix = "300.0, 0.0, 159.5\n0.0, 300.0, 119.5\n0.0, 0.0, 1.0\n"
    (root / "camera_matrix.csv").write_text(matrix)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(3):
        rows.append(
            f"{100 + i / 60}, {i:06d}, {0.1 * i}, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0"
        )
    (root / "odometry.csv").write_text("\n".join(rows) + "\n")
    return root


def test_a_recording_of_stray_scanner(tmp_path: Path) -> None:
    sequence = open_sequence(stray(tmp_path))
    assert sequence.kind == "strayscanner"
    camera = sequence.camera(0)
    # twice the depth, a fifth of the video: (159.5 + 0.5) / 5 - 0.5
    assert (camera.width, camera.height, camera.fx) == (64, 48, 60.0)
    assert (camera.cx, camera.cy) == pytest.approx((31.5, 23.5))
    np.testing.assert_allclose(np.diff(sequence.timestamps), 1 / 60)
    np.testing.assert_allclose(sequence.poses[:, 0, 3], [0, 0.1, 0.2])
    frame = sequence[1]
    assert frame.rgb.shape == (48, 64, 3)
    assert (frame.depth[:, :8] == 0).all()  # of no confidence
    np.testing.assert_allclose(frame.depth[:, 8:], 1.1)


def test_a_damaged_list_of_stray_scanner(tmp_path: Path) -> None:
    root = stray(tmp_path)
    (root / "camera_matrix.csv").write_text("1,2\n")
    with pytest.raises(FormatError, match="camera_matrix"):
        open_sequence(root)
    stray(tmp_path)
    (root / "odometry.csv").write_text("timestamp\n1,2,3\n")
    with pytest.raises(FormatError, match="odometry"):
        open_sequence(root)
