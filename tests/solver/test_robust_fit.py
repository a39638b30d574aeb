"""The compiled fit of one motion, its noise, and the sums over all pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.core.torch_geometry import se3
from hybridvo.core.types import Camera, Frame, FramePair, PairBatch
from hybridvo.solver import kernels, robust_fit
from hybridvo.solver.noise_estimation import (
    Noise,
    estimate_noise,
)
from hybridvo.solver.pixels import PixelGrid
from hybridvo.solver.torch.factors import ResidualModel, gather_pixels, weigh

CAMERA = Camera(300.0, 290.0, 79.5, 59.5, height=120, width=160)
XI = np.array([0.05, -0.03, 0.08, 0.01, -0.015, 0.02])


def noisy_pair(
    seed: int, flow_px: float = 0.3, log_depth: float = 0.0
) -> FramePair:
    """A curved scene whose flow is projected here by hand, with independent noise."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    depth = 4 + np.sin(u / 20) + np.cos(v / 15)
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)],
        axis=-1,
    )
    T = se3_exp(XI)
    moved = (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]
    places = moved @ CAMERA.K.T
    flow = places[..., :2] / places[..., 2:] - np.stack([u, v], axis=-1)
    flow += rng.normal(0, flow_px, flow.shape)
    depth = depth * np.exp(rng.normal(0, log_depth, depth.shape))
    prev = Frame(None, depth.astype(np.float32), CAMERA)
    return FramePair(prev, Frame(None, None, CAMERA), flow.astype(np.float32))


# --- the small linear system ------------------------------------------------------


def packed(H: np.ndarray, g: np.ndarray) -> np.ndarray:
    return np.concatenate([H[np.triu_indices(6)], g])


def test_solve6_is_the_solution_of_numpy() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        # metres and radians differ by orders of magnitude
        J = rng.normal(size=(12, 6)) * [1e-3, 1e-2, 1e-3, 10, 100, 10]
        H = J.T @ J
        g = rng.normal(size=6)
        delta = np.zeros(6)
        assert robust_fit.solve6(packed(H, g), 0.1, delta)
        damped = H + 0.1 * np.diag(np.diag(H))
        np.testing.assert_allclose(delta, np.linalg.solve(damped, g), rtol=1e-8)


@pytest.mark.parametrize("case", ["indefinite", "singular", "zero", "nan", "far"])
def test_solve6_refuses_what_has_no_solution(case: str) -> None:
    H = np.eye(6)
    g = np.ones(6)
    if case == "indefinite":
        H[0, 1] = 2.0
    elif case == "singular":
        H[0, 1] = 1.0
    elif case == "zero":
        H[3, 3] = 0.0
    elif case == "nan":
        H[2, 4] = np.nan
    else:
        g[0] = 1e7
    delta = np.full(6, 7.0)
    assert not robust_fit.solve6(packed(H, g), 0.0, delta)
    assert (delta == 7.0).all()


def test_left_update_in_place() -> None:
    T = se3_exp(2 * XI)
    pose = T[:3].copy()
    robust_fit.left_update(XI, pose, pose)
    np.testing.assert_allclose(pose, (se3_exp(XI) @ T)[:3], atol=1e-14)


# --- the fit on gathered pixels -----------------------------------------------------


def test_the_coarse_fit_finds_motion_and_noise() -> None:
    grid = PixelGrid(noisy_pair(1), None)
    pose, noise, inlier_ratio, iterations = robust_fit.fit_coarse(
        grid.samples, grid.count, grid.K, np.eye(3, 4), 3.0
    )
    T = np.vstack([pose, [0, 0, 0, 1]])
    # 0.3 px over 5000 pixels at 300 px focal length: 1.4e-5 rad, times 4 m, times 10
    assert np.abs(se3_log(T @ invert(se3_exp(XI)))).max() < 1e-3
    # the standard error of a standard deviation from 2 x 4000 numbers: 0.8 %
    assert noise.flow_px == pytest.approx(0.3, rel=0.04)
    assert inlier_ratio > 0.98
    assert iterations > 0


def test_noise_of_depth_shows_where_there_is_parallax() -> None:
    cap = Noise(1.2, 0.2)
    start = Noise(0.5, 0.01)
    pose = se3_exp(XI)[:3].copy()
    for log_depth in (0.0, 0.1):
        grid = PixelGrid(noisy_pair(2, 0.1, log_depth), None)
        found = estimate_noise(
            grid.samples, grid.count, pose, grid.K, start, cap, 50, 8000
        )
        assert found.noise.flow_px == pytest.approx(0.1, rel=0.1)
        assert found.is_depth_observable == (log_depth > 0)
        assert found.noise.log_depth == pytest.approx(log_depth, abs=0.012)


# --- all pixels -----------------------------------------------------------------------


def test_curvature_and_meat_are_those_of_torch() -> None:
    pair = noisy_pair(5, 0.3, 0.03)
    grid = PixelGrid(pair, None, CAMERA.height * CAMERA.width)
    pose = se3_exp(XI * 1.02)[:3].copy()
    noise = kernels.residual_noise(0.3, 0.03, 3.0)
    found = kernels.score_products(grid.samples, grid.count, pose, grid.K, noise)

    pixels = gather_pixels(PairBatch.from_pairs([pair]))
    model = ResidualModel(torch.tensor([[0.3, 0.03]]), 3.0)
    T = torch.eye(4, dtype=torch.float64)
    T[:3] = torch.from_numpy(pose)
    at = weigh(pixels, se3(T[None]).matrix(), model)
    s = torch.stack(at.scores(), dim=1)[0].double().numpy()
    slope = model.kernel(at.distance2).slope[0].numpy()
    meat = s @ s.T / grid.count
    curvature = (s * (slope / at.robust[0].numpy())) @ s.T / grid.count
    upper = np.triu_indices(6)
    for ours, expected in ((found.meat, meat), (found.curvature, curvature)):
        np.testing.assert_allclose(
            ours, expected[upper], atol=2e-4 * np.abs(expected).max()
        )


# --- what cannot be refined -------------------------------------------------------------
