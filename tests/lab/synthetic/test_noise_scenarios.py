from __future__ import annotations

import numpy as np
import pytest

from hybridvo.core.geometry import ego_flow, rotation_angle
from hybridvo_lab.synthetic.noise_scenarios import SCENARIOS, Scenario, make_pair

CLEAN = Scenario(moving=0.3, flow_noise_px=0.0, depth_noise=0.0, outliers=0.0)


@pytest.mark.parametrize("name", SCENARIOS)
def test_pair_keeps_the_conditions_of_its_scenario(name):
    conditions = SCENARIOS[name]
    assert make_pair(name, 0, height=109, width=256)[
        0
    ].prev.camera.fx == pytest.approx(280)
    pair, truth = make_pair(name, 3)
    assert pair.prev.camera.shape == (436, 1024)
    assert pair.prev.camera.fx == pytest.approx(1120)
    for array in (pair.flow, pair.prev.depth, pair.curr.depth):
        assert array.dtype == np.float32 and array.flags.c_contiguous
    low, high = (60, 200) if conditions.scene == "far" else (1, 30)
    assert truth["depth_true"].min() >= low and truth["depth_true"].max() <= high
    # share of the moving pixels: one 2x2 block is 1e-5 of the picture
    assert truth["moving"].mean() == pytest.approx(conditions.moving, abs=1e-3)
    # 446 464 draws: standard deviation of a share is below 8e-4
    assert truth["outlier"].mean() == pytest.approx(conditions.outliers, abs=4e-3)
    T = truth["T_curr_prev"]
    assert np.rad2deg(rotation_angle(T[:3, :3])) <= conditions.rotation_deg + 1e-9
    assert np.linalg.norm(T[:3, 3]) <= conditions.translation_m + 1e-12
    clean = ~truth["outlier"]
    noise = (pair.flow - truth["flow_true"])[clean]
    # relative standard deviation of a sample deviation is 1 / sqrt(2 n) ~ 8e-4
    assert noise.std() == pytest.approx(conditions.flow_noise_px, rel=5e-3)
    if name not in ("structured_light", "stereo"):
        log_ratio = np.log(pair.prev.depth / truth["depth_true"])
        # half of the variance is correlated over 24 px: about 800 independent draws
        spread = np.nanstd(log_ratio)
        assert spread == pytest.approx(conditions.depth_noise, rel=0.15, abs=1e-9)


def test_static_pixels_follow_the_camera_and_moving_ones_do_not():
    pair, truth = make_pair(CLEAN, 0)
    flow = ego_flow(
        truth["depth_true"],
        truth["T_curr_prev"],
        pair.prev.camera,
        pair.curr.camera,
    )
    error = np.linalg.norm(flow - pair.flow, axis=-1)
    # float32 flow below 128 px is rounded by at most 4e-6 px a component
    assert error[~truth["moving"]].max() < 2e-5
    assert np.median(error[truth["moving"]]) > 8.0


def test_current_depth_is_the_moved_surface():
    pair, truth = make_pair(Scenario(0.0, 0, 0.0, 0.0, 0.0, scene="plane"), 5)
    T = truth["T_curr_prev"]
    camera = pair.curr.camera
    # the plane n.X = 1 from three corners, moved by T: z = 1 / (n' . K^-1 (u, v, 1)) analytically
    rays = np.array([[u, v, 1.0] for u, v in ((0, 0), (1023, 0), (0, 435))])
    points = rays @ np.linalg.inv(camera.K).T
    points *= np.array([truth["depth_true"][int(v), int(u)] for u, v, _ in rays])[
        :, None
    ]
    moved = points @ T[:3, :3].T + T[:3, 3]
    n = np.linalg.solve(moved, np.ones(3))
    v, u = np.mgrid[0:436, 0:1024]
    expected = 1 / (
        np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T @ n
    )
    seen = np.isfinite(pair.curr.depth)
    assert seen.mean() > 0.6
    # half a pixel times a slope of 6e-4 a pixel, taken on the previous grid: the frames differ by
    # up to 3 degrees of roll and a few per cent of scale, 6e-4 / 2 * 0.1
    np.testing.assert_allclose(pair.curr.depth[seen], expected[seen], rtol=6e-5)


def test_pair_depends_on_scenario_and_seed_alone():
    cells = (("moving30", 7), ("moving30", 7), ("moving30", 8), ("moving50", 7))
    first, again, *others = (make_pair(*cell, 109, 256)[0] for cell in cells)
    np.testing.assert_array_equal(first.curr.depth, again.curr.depth)
    assert first.flow.tobytes() == again.flow.tobytes()
    assert all(first.flow.tobytes() != other.flow.tobytes() for other in others)


def test_depth_is_that_of_its_sensor():
    pair, truth = make_pair("structured_light", 0)
    measured = pair.prev.depth
    z = truth["depth_true"]
    known = np.isfinite(measured)
    error = (measured - z)[known] / (0.0015 * z[known] ** 2)
    assert error.std() == pytest.approx(1.0, rel=0.02)
    pair, truth = make_pair("stereo", 0)
    steps = 8 * 1120 * 0.12 / pair.prev.depth
    known = np.isfinite(steps)
    np.testing.assert_allclose(steps[known], np.rint(steps[known]), atol=1e-3)
    disparity = 1120 * 0.12 / truth["depth_true"]
    # left of the second eye's image, and just behind what stands in front
    assert not known[np.arange(1024) - disparity < 0].any()
    assert 0.03 < (~known).mean() < 0.2
    nearer = np.diff(disparity[:, 200:]) > 5
    assert (~known[:, 200:-1])[nearer].mean() > 0.9
