"""Windows of a tripod's recording: the ego flow is that of the rotation, and nothing else."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow, rotation_angle
from hybridvo.core.types import Camera
from hybridvo.flow.providers import dis_flow
from hybridvo_lab.synthetic.turned_windows import (
    TripodRecording,
    draw_turned_window,
    load_tripod,
    turning_camera,
)

HEIGHT = 360
WIDTH = 480
COUNT = 8
SIDE = 70
"""Side of the square that moves, px."""
STEP = 24
"""Its motion from frame to frame, px."""
DEPTH_SCALE = 5000
FRONT_M = 1.5


def texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8, blobs of a few pixels."""
    noise = rng.uniform(0, 255, (height, width, 3)).astype(np.float32)
    image = 128 + 7 * (cv2.GaussianBlur(noise, (0, 0), 2.5) - 128)
    return np.clip(image, 0, 255).astype(np.uint8)


def place(k: int) -> tuple[slice, slice]:
    """Where the square is in frame k."""
    left = 90 + STEP * k
    return np.s_[130 : 130 + SIDE, left : left + SIDE]


def write_tripod(path: Path) -> None:
    """A still wall, before which a textured square moves to the right."""
    rng = np.random.default_rng(0)
    wall = texture(rng, HEIGHT, WIDTH)
    square = texture(rng, SIDE, SIDE)
    v, u = np.indices((HEIGHT, WIDTH))
    far = 3 + 0.5 * np.sin(u / 60) * np.cos(v / 50)
    for name in ("rgb", "depth"):
        (path / name).mkdir(parents=True)
    for k in range(COUNT):
        image = wall.copy()
        depth = far.copy()
        image[place(k)] = square
        depth[place(k)] = FRONT_M
        bgr = np.ascontiguousarray(image[..., ::-1])
        cv2.imwrite(str(path / "rgb" / f"{k:03d}.png"), bgr)
        raw = (depth * DEPTH_SCALE).astype(np.uint16)
        cv2.imwrite(str(path / "depth" / f"{k:03d}.png"), raw)
    (path / "camera.yaml").write_text(
        f"fx: 400\nfy: 400\ncx: {(WIDTH - 1) / 2}\ncy: {(HEIGHT - 1) / 2}\n"
        f"width: {WIDTH}\nheight: {HEIGHT}\ndepth_scale: {DEPTH_SCALE}\n"
    )


@pytest.fixture(scope="module")
def recordings(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[TripodRecording, ...]:
    folder = tmp_path_factory.mktemp("tripod")
    write_tripod(folder / "corridor")
    write_tripod(folder / "not_for_training")
    return load_tripod(folder)


def test_only_recordings_for_training_that_are_there_are_read(
    recordings, tmp_path
) -> None:
    assert [recording.name for recording in recordings] == ["corridor"]
    assert len(recordings[0].frames) == COUNT
    assert load_tripod(tmp_path) == ()


def test_the_foreground_is_what_differs_from_the_empty_scene(recordings) -> None:
    for k, mask in enumerate(recordings[0].foreground):
        assert mask.shape == (HEIGHT, WIDTH)
        rows, columns = place(k)
        assert mask[rows, columns].mean() > 0.95
        empty = mask.copy()
        empty[125:205] = 0
        assert not empty.any()
        # with a seam of a few pixels
        assert mask.sum() < 1.35 * SIDE**2


def test_the_flow_of_the_static_part_is_that_of_the_rotation(recordings) -> None:
    turned = 0
    moved = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        drawn = draw_turned_window(rng, recordings, dis_flow())
        pair = drawn.pair
        T = drawn.T_curr_prev
        assert (T[:3, 3] == 0).all()
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        turned += np.degrees(rotation_angle(T[:3, :3])) > 0.09
        camera = pair.prev.camera
        assert pair.curr.camera == camera
        depth = np.where(drawn.depth > 0, drawn.depth, np.nan)
        own = ego_flow(depth, T, camera, camera)
        error = np.linalg.norm(pair.flow - own, axis=2)
        good = pair.flow_valid & np.isfinite(error) & ~drawn.moving
        assert good.mean() > 0.2
        assert np.median(error[good]) < 0.15
        if drawn.moving.sum() > 200:
            moved += 1
            known = drawn.moving & np.isfinite(error)
            # a foreground pixel may be one of the wall that a frame uncovers
            assert np.median(error[known]) > 2
        assert drawn.static_source == "corridor"
    assert turned >= 9 and moved >= 5


def test_a_camera_that_turns_sees_the_recording_by_a_homography(recordings) -> None:
    """OpenCV's warp of the image, by K R^T K^-1, is the same picture."""
    recording = recordings[0]
    whole = recording.frames[0].camera
    window = Camera(400.0, 400.0, 119.5, 79.5, height=160, width=240)
    yaw = np.radians([0.0, 3.0, -5.0])
    R = np.stack([cv2.Rodrigues(np.array([0.0, each, 0.0]))[0] for each in yaw])
    frames = turning_camera(recording, R, window)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert frames[2].timestamp == recording.frames[2].timestamp
    for k, frame in enumerate(frames):
        H = window.K @ R[k].T @ np.linalg.inv(whole.K)
        expected = cv2.warpPerspective(recording.frames[k].rgb, H, (240, 160))
        # cubic beside linear interpolation
        assert np.abs(frame.rgb.astype(int) - expected)[5:-5, 5:-5].mean() < 3
    # the middle of the second view: the wall is as far as along the ray, by its own axis
    ray = R[1] @ [0, 0, 1]
    column, row, _ = whole.K @ ray / ray[2]
    stored = recording.frames[1].depth[round(row), round(column)]
    seen = frames[1].depth[80, 120]
    assert seen == pytest.approx(stored / ray[2], rel=0.01)
