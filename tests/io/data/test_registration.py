"""Depth moved into the view of the colour camera: by hand, and of a real sensor."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo import Camera
from hybridvo.core.files import parse_yaml
from hybridvo.io.data.registration import register_depth
from hybridvo.run.commands.diagnosis.inspection import edge_agreement

SMALL = Camera(fx=10.0, fy=10.0, cx=3.5, cy=2.5, height=6, width=8)


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def test_the_same_camera_changes_nothing() -> None:
    depth = np.random.default_rng(0).uniform(0.5, 4, (6, 8)).astype(np.float32)
    depth[1, 2] = 0.0
    depth[3, 4] = np.nan
    depth[5, 7] = -1.0
    expected = np.where(depth > 0, depth, 0)
    np.testing.assert_array_equal(
        register_depth(depth, SMALL, np.eye(4), SMALL), expected
    )


def test_points_move_by_focal_length_times_distance_over_depth() -> None:
    depth = np.zeros((6, 8), np.float32)
    depth[2, 3] = 2.0
    # 10 px x 0.4 m / 2 m = 2 px to the right; 10 x 0.2 / 2 = 1 px up
    found = register_depth(depth, SMALL, moved(0.4, -0.2), SMALL)
    expected = np.zeros((6, 8), np.float32)
    expected[1, 5] = 2.0
    np.testing.assert_array_equal(found, expected)


def test_the_nearest_counts() -> None:
    depth = np.full((6, 8), 4.0, np.float32)
    depth[:, 2] = 1.0
    # 10 x 0.4 / 1 = 4 px for the near column, 1 px for what is behind
    found = register_depth(depth, SMALL, moved(0.4), SMALL)
    assert (found[:, 6] == 1.0).all()
    assert (found[:, [1, 2, 4, 5, 7]] == 4.0).all()
    # what the near column hid, and what lies outside of the depth image
    assert (found[:, [0, 3]] == 0.0).all()


def test_a_larger_colour_image_has_no_holes() -> None:
    """Three times the pixels of depth: each covers 3 x 3 of colour, edges to the pixel."""
    large = Camera(30.0, 30.0, 3 * 4.0 - 0.5, 3 * 3.0 - 0.5, height=18, width=24)
    depth = np.full((6, 8), 3.0, np.float32)
    depth[2, 3] = 1.0
    found = register_depth(depth, SMALL, np.eye(4), large)
    np.testing.assert_array_equal(
        found, np.kron(depth, np.ones((3, 3), np.float32))
    )


def test_rotated_points_against_projection_by_opencv() -> None:
    camera = Camera(200.0, 210.0, 80.0, 60.0, height=120, width=160)
    colour = Camera(180.0, 180.0, 70.0, 50.0, height=110, width=150)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", (2, -3, 1), degrees=True).as_matrix()
    T[:3, 3] = 0.03, -0.01, 0.02
    depth = np.zeros((120, 160), np.float32)
    depth[38:82, 48:102] = 1.5
    found = register_depth(depth, camera, T, colour)
    v, u = (each.reshape(-1) for each in np.mgrid[40:80:10, 50:100:10])
    rays = np.column_stack([(u - 80) / 200, (v - 60) / 210, np.ones(len(u))])
    points = 1.5 * rays
    rotation, _ = cv2.Rodrigues(T[:3, :3])
    pixels, _ = cv2.projectPoints(points, rotation, T[:3, 3], colour.K, None)
    columns, rows = np.round(pixels.reshape(-1, 2)).astype(int).T
    expected = (points @ T[:3, :3].T + T[:3, 3])[:, 2]
    # the centres of the pixels are up to half a pixel apart
    np.testing.assert_allclose(found[rows, columns], expected, rtol=5e-4)


def test_a_real_sensor_whose_depth_is_not_registered(shared_data: Path) -> None:
    """After registration one shift brings the edges of depth onto those of colour, at any depth.

    The shift itself is not 0: the published calibration is that of another unit. Before, edges at
    different depths would need different shifts, and none fits.
    """
    root = shared_data / "tripod" / "unregistered"
    content = parse_yaml((root / "calibration.yaml").read_text(), "calibration")

    def camera(name: str) -> Camera:
        fx, fy, cx, cy = (content[name][key] for key in ("fx", "fy", "cx", "cy"))
        return Camera(
            fx, fy, cx - 1, cy - 1, height=480, width=640
        )  # Matlab counts from 1

    T = np.eye(4)
    T[:3, :3] = content["R_rgb_depth"]
    T[:3, 3] = content["t_rgb_depth"]
    before = np.zeros(())
    after = np.zeros(())
    for image in sorted((root / "rgb").iterdir())[:30:6]:
        rgb = cv2.cvtColor(cv2.imread(str(image)), cv2.COLOR_BGR2RGB)
        stored = cv2.imread(str(root / "depth" / f"{image.stem}.png"), -1)
        depth = stored.astype(np.float32) / 1000
        registered = register_depth(depth, camera("depth"), T, camera("rgb"))
        assert 0.6 < np.count_nonzero(registered) / np.count_nonzero(stored) < 1.1
        before = before + edge_agreement(rgb, depth)
        after = after + edge_agreement(rgb, registered)
    assert before.max() / before.std() < 6
    assert after.max() / after.std() > 12
