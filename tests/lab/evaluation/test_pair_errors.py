from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow, invert, make_transform
from hybridvo.core.types import Camera
from hybridvo_lab.evaluation.scores import pair_errors, pair_factors

CAMERA = Camera(200.0, 200.0, 127.5, 63.5, height=128, width=256)
"""Camera of the paper's size, principal point in the middle: nothing is resized."""


def test_pair_errors_by_hand():
    # depth 4 m, f = 200: a translation of 0.02 m in x moves every pixel by 200 * 0.02 / 4 = 1 px,
    # -0.04 m in y by -2 px. Component mean 1.5, L2 sqrt(5).
    depth = np.full(CAMERA.shape, 4.0, dtype=np.float32)
    T_est = make_transform(np.eye(3), np.array([0.02, -0.04, 0.0]))
    errors = pair_errors(T_est, np.eye(4), depth, CAMERA, CAMERA)
    assert errors["epe"] == pytest.approx(1.5)
    assert errors["epe_l2_px"] == pytest.approx(np.sqrt(5))
    assert errors["t_err"] == pytest.approx(0.02)
    assert errors["trans_err"] == pytest.approx(np.sqrt(0.002))
    assert errors["r_err_deg"] == 0.0
    assert errors["rot_err_deg"] == 0.0
    assert set(errors) == {
        "r_err_deg",
        "t_err",
        "epe",
        "epe_l2_px",
        "rot_err_deg",
        "trans_err",
    }


def test_paper_epe_at_another_native_size():
    # 512x512 at f = 400: at 128x256 one has fx' = 200, fy' = 100; the same motion gives 1 and -1 px
    camera = Camera(400.0, 400.0, 255.5, 255.5, height=512, width=512)
    depth = np.full(camera.shape, 4.0)
    T_est = make_transform(np.eye(3), np.array([0.02, -0.04, 0.0]))
    errors = pair_errors(T_est, np.eye(4), depth, camera, camera)
    assert errors["epe"] == pytest.approx(1.0)
    assert errors["epe_l2_px"] == pytest.approx(np.sqrt(4 + 16))


def test_paper_epe_scales_the_principal_point_about_pixel_corners():
    # forward motion with a known focus of expansion: u' = (u - cx') z / z' + cx' at the small size,
    # cx' = (511 + 0.5) / 4 - 0.5 = 127.375, cy' = (200 + 0.5) / 2 - 0.5 = 99.75
    camera = Camera(400.0, 400.0, 511.0, 200.0, height=256, width=1024)
    T_est = make_transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    errors = pair_errors(
        T_est, np.eye(4), np.full(camera.shape, 5.0), camera, camera
    )
    u, v = np.arange(256.0), np.arange(128.0)
    expected = 0.25 * (np.abs(u - 127.375).mean() + np.abs(v - 99.75).mean()) / 2
    assert errors["epe"] == pytest.approx(expected)


def test_paper_epe_takes_the_nearest_depth_at_pixel_centres():
    # 384 rows, 3 to 1: centre of small row i is native row 3 i + 1; only those rows hold 4 m
    camera = Camera(200.0, 200.0, 127.5, 191.5, height=384, width=256)
    depth = np.full(camera.shape, 1e-3)
    depth[1::3] = 4.0
    T_est = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    assert pair_errors(T_est, np.eye(4), depth, camera, camera)[
        "epe"
    ] == pytest.approx(0.5)


def test_paper_epe_counts_invalid_and_long_flows_as_zero():
    depth = np.full(CAMERA.shape, 4.0)
    T_est = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    for bad in (0.0, -1.0, np.nan, np.inf):
        half = depth.copy()
        half[:64] = bad
        errors = pair_errors(T_est, np.eye(4), half, CAMERA, CAMERA)
        # (1 + 0) / 2 over all pixels, half of them 0
        assert errors["epe"] == pytest.approx(0.25)
        assert errors["epe_l2_px"] == pytest.approx(1.0)  # over the valid ones
    # 8.1 m aside at 4 m: true ego flow 405 px, zeroed but counted; at 7.9 m: 395 px, kept
    for aside, expected in ((8.1, 0.0), (7.9, 0.5)):
        T_true = make_transform(np.eye(3), np.array([aside, 0.0, 0.0]))
        errors = pair_errors(T_true @ T_est, T_true, depth, CAMERA, CAMERA)
        assert errors["epe"] == pytest.approx(expected)
        assert errors["epe_l2_px"] == pytest.approx(1.0)


def test_no_valid_depth_is_none_not_nan():
    depth = np.zeros(CAMERA.shape)
    errors = pair_errors(np.eye(4), np.eye(4), depth, CAMERA, CAMERA)
    assert errors["epe"] is None and errors["epe_l2_px"] is None


def test_estimate_behind_the_camera_is_finite_and_costs_the_diagonal():
    T_est = make_transform(np.eye(3), np.array([0.0, 0.0, -9.0]))
    errors = pair_errors(
        T_est, np.eye(4), np.full(CAMERA.shape, 4.0), CAMERA, CAMERA
    )
    assert errors["epe_l2_px"] == pytest.approx(np.hypot(128, 256))
    assert np.isfinite(errors["epe"])


def facts_of(
    T: np.ndarray, depth: np.ndarray | None, flow: np.ndarray | None = None
) -> Any:
    """Facts of the first pair of a sequence of two frames."""
    sequence: Any = SimpleNamespace(
        poses=np.stack([np.eye(4), invert(T)]),
        frame=lambda i: SimpleNamespace(depth=depth),
        camera=lambda i: CAMERA,
        flow=lambda i: (flow, None),
        flow_is_true=flow is not None,
        kind="sintel",
    )
    return pair_factors(sequence, 0, 1)


def test_dynamic_fraction_by_hand():
    def dynamic_fraction(flow, depth):
        return facts_of(T, depth, flow).get("dynamic_fraction")

    depth = np.full(CAMERA.shape, 4.0)
    T = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    flow = ego_flow(depth, T, CAMERA, CAMERA).astype(np.float32)
    assert dynamic_fraction(flow, depth) == 0.0
    flow[:32, :, 0] += 0.9  # a quarter moves by less than a pixel
    flow[32:64, :, 1] += 1.1  # a quarter by more
    assert dynamic_fraction(flow, depth) == 0.25
    flow[64:96] = np.nan  # unknown pixels do not count
    depth[96:] = 0.0
    assert dynamic_fraction(flow, depth) == 0.5
    flow[32:48] = 1.666e9  # Middlebury's unknown
    assert dynamic_fraction(flow, depth) == pytest.approx(1 / 3)
    assert dynamic_fraction(flow, depth * 0) is None


def test_facts_of_a_pair_by_hand():
    depth = np.full(CAMERA.shape, 4.0)
    depth[:, :64] = 8.0
    depth[:, 200:] = np.nan
    T = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    facts = facts_of(T, depth)
    assert "dynamic_fraction" not in facts  # no true flow of the scene
    assert (
        facts["translation_m"] == pytest.approx(0.02)
        and facts["rotation_deg"] == 0.0
    )
    # at 4 m, two thirds of what is known
    assert facts["flow_magnitude_px"] == pytest.approx(1.0)
    assert facts["depth_spread"] == pytest.approx(2.0)
    assert facts_of(T, None) == {}
