"""Intrinsics and depth are resized together, with pixel (0, 0) a centre."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.resize import resize_camera, resize_frame

CAMERA = Camera(320.0, 320.0, 319.5, 239.5, height=480, width=640)


def test_camera_by_hand():
    half = resize_camera(CAMERA, 240, 320)
    # 0.5 (319.5 + 0.5) - 0.5 = 159.5: the middle of 320 pixels; 0.5 * 239.5 would be 119.75
    assert (half.fx, half.fy, half.cx, half.cy) == (160.0, 160.0, 159.5, 119.5)
    tall = resize_camera(CAMERA, 960, 640)
    assert (tall.fx, tall.fy, tall.cx, tall.cy) == (320.0, 640.0, 319.5, 479.5)
    assert resize_camera(CAMERA, 480, 640) == CAMERA
    for size in ((0, 5), (5, -1), (2.5, 5)):
        with pytest.raises(InputError, match="positive"):
            resize_camera(CAMERA, *size)


def test_depth_is_never_mixed(rng):
    depth = np.where(rng.random((48, 64)) < 0.5, 1.0, 9.0).astype(np.float32)
    depth[0] = np.nan
    camera = Camera(32, 32, 31.5, 23.5, height=48, width=64)
    frame = Frame(
        np.zeros((48, 64, 3), np.uint8),
        depth,
        camera,
        mask=depth > 2,
        depth_variance=depth,
    )
    for size in ((24, 32), (13, 17), (96, 128)):
        small = resize_frame(frame, *size)
        values = small.depth[np.isfinite(small.depth)]
        assert set(np.unique(values)) <= {1.0, 9.0}
        assert small.rgb.shape == (*size, 3) and small.camera.shape == size
        np.testing.assert_array_equal(small.mask, small.depth > 2)
    # an odd factor: the centre row of each three
    third = resize_frame(frame, 16, 64)
    np.testing.assert_array_equal(third.depth, frame.depth[1::3])  # masked: unknown
