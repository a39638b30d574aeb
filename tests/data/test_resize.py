"""Intrinsics, depth and flow are resized together, with pixel (0, 0) a centre."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo.data.resize import resize_camera, resize_frame, resize_pair
from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.types import Camera, Frame, FramePair

CAMERA = Camera(320.0, 320.0, 319.5, 239.5, 480, 640)


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
    camera = Camera(32, 32, 31.5, 23.5, 48, 64)
    frame = Frame(
        np.zeros((48, 64, 3), np.uint8), depth, camera, mask=depth > 2, depth_variance=depth
    )
    for size in ((24, 32), (13, 17), (96, 128)):
        small = resize_frame(frame, *size)
        values = small.depth[np.isfinite(small.depth)]
        assert set(np.unique(values)) <= {1.0, 9.0}
        assert small.rgb.shape == (*size, 3) and small.camera.shape == size
        np.testing.assert_array_equal(small.mask, small.depth > 2)
    third = resize_frame(frame, 16, 64)  # an odd factor: the centre row of each three
    np.testing.assert_array_equal(third.depth, depth[1::3])


@pytest.mark.parametrize("factor", [2, 3])
def test_resized_pair_is_still_rigid(factor):
    """Ego flow of the resized depth and camera meets the resized flow of the full size."""
    height, width = 480, 636  # divisible by 2 and by 3
    big = Camera(320.0, 320.0, 317.5, 239.5, height, width)
    v, u = np.mgrid[0:height, 0:width]
    depth = (3.0 + u / 640 + v / 480).astype(np.float32)  # a smooth slanted surface
    T = se3_exp(np.array([0.05, -0.02, 0.1, 0.01, -0.02, 0.03]))
    flow = ego_flow(depth, T, big, big).astype(np.float32)
    frame = Frame(None, depth, big)
    valid = depth > 3.5
    pair = FramePair(frame, frame, flow, np.full((height, width), 9.0, np.float32), valid)
    small = resize_pair(pair, height // factor, width // factor)
    camera = small.prev.camera
    rigid = ego_flow(small.prev.depth, T, camera, camera)
    error = np.linalg.norm(rigid - small.flow, axis=2)
    # Nearest with an even factor samples half a source pixel beside the new centre, so it is off by
    # at most half the change of the flow from pixel to pixel. An odd factor samples the centre
    # itself: only float32 remains.
    gradient = max(np.abs(np.diff(flow, axis=k)).max() for k in (0, 1))
    assert error.max() < (0.5 * gradient * np.sqrt(2) if factor == 2 else 2e-4)
    assert small.flow.dtype == np.float32
    assert small.flow_variance[0, 0] == pytest.approx(9.0 / factor**2)
    np.testing.assert_array_equal(small.flow_valid, small.prev.depth > 3.5)
