from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pypose as pp
import pytest
import torch

from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow, pixel_grid, se3_exp
from hybridvo.pose.batch_solver import estimate_noise, gauss_newton_step
from hybridvo.pose.pixels import gather_pixels, sample_depth, sparse_subset
from hybridvo.pose.residuals import (
    CUTOFFS,
    KERNELS,
    jacobian,
    left_update,
    normal_equations,
    pose_to_matrix,
    relinearised,
    reproject,
    residual_terms,
    robust_cost,
    robust_weight,
    score_sum,
)
from hybridvo.refinement import kernels, solver
from hybridvo.refinement.pixels import typical
from hybridvo.types import Camera, PairBatch

F64 = torch.float64


def scene(
    batch: int = 2,
    height: int = 24,
    width: int = 32,
    seed: int = 0,
    noise_px: float = 0.3,
    depth_noise: float = 0.03,
    outliers: float = 0.1,
    dtype: torch.dtype = F64,
    motion: float = 1.0,
) -> tuple[PairBatch, torch.Tensor]:
    """A batch of noisy pairs with two different cameras, and the true T_curr_prev."""
    g = torch.Generator().manual_seed(seed)
    K_prev = torch.tensor([[60.0, 0, width / 2], [0, 62.0, height / 2 - 1], [0, 0, 1]], dtype=F64)
    K_curr = torch.tensor([[66.0, 0, width / 2 - 1], [0, 64.0, height / 2], [0, 0, 1]], dtype=F64)
    K_prev, K_curr = K_prev.repeat(batch, 1, 1), K_curr.repeat(batch, 1, 1)
    depth = 2 + 6 * torch.rand(batch, height, width, generator=g, dtype=F64)
    scale = motion * torch.tensor([0.1] * 3 + [0.02] * 3, dtype=F64)
    T = pp.se3(torch.randn(batch, 6, generator=g, dtype=F64) * scale).Exp().matrix()
    pixels, _ = reproject(depth, T, K_prev, K_curr)
    flow = pixels - torch.as_tensor(pixel_grid(height, width))
    flow = flow + noise_px * torch.randn(flow.shape, generator=g, dtype=F64)
    gross = torch.rand(depth.shape, generator=g, dtype=F64) < outliers
    flow = flow + gross[..., None] * 20 * torch.randn(flow.shape, generator=g, dtype=F64)
    depth = depth * torch.exp(depth_noise * torch.randn(depth.shape, generator=g, dtype=F64))
    pair = PairBatch(*(value.to(dtype) for value in (flow, depth, K_prev, K_curr)))
    return pair, T


def test_one_pixel_by_hand() -> None:
    # fx = fy = 100, c = (1, 1); pixel (2, 1) at 2 m; t = (0.1, 0, 0.5): X' = (0.12, 0, 2.5)
    K = torch.tensor([[[100.0, 0, 1], [0, 100.0, 1], [0, 0, 1]]], dtype=F64)
    depth = torch.full((1, 3, 3), math.nan, dtype=F64)
    depth[0, 1, 2] = 2.0
    flow = torch.zeros(1, 3, 3, 2, dtype=F64)
    flow[0, 1, 2] = torch.tensor([5.0, 1.0])
    T = torch.eye(4, dtype=F64)[None].clone()
    T[0, 0, 3], T[0, 2, 3] = 0.1, 0.5
    pixels = gather_pixels(PairBatch(flow, depth, K, K))
    assert pixels.weight.sum() == 1
    terms = residual_terms(pixels, T)
    at = 5
    # a = 0.048, so the pixel lands at 5.8: residual 7 - 5.8; q = 100/2.5 (0.048 0.5 - 0.1)
    assert terms.r[0][0, at] == pytest.approx(1.2, abs=1e-12)
    assert terms.r[1][0, at] == pytest.approx(1.0, abs=1e-12)
    assert terms.u[0][0, at] == pytest.approx(40 * (0.024 - 0.1), abs=1e-12)
    assert terms.u[1][0, at] == pytest.approx(0.0, abs=1e-12)
    rows = jacobian(terms, pixels.K)
    expected = 100 * np.array([0.4, 0, -0.048 * 0.4, 0, 1 + 0.048**2, 0])
    assert rows[0][0, :, at].numpy() == pytest.approx(expected, abs=1e-12)
    assert rows[1][0, :, at].numpy() == pytest.approx([0, 40, 0, -100, 0, 4.8], abs=1e-12)
    # Sigma_uu = 0.25 + 0.01 q^2; most likely log depth: e = 0.01 q 1.2 / Sigma_uu beyond log 2
    q = -40 * 0.076
    e = 0.01 * q * 1.2 / (0.25 + 0.01 * q * q)
    noise = torch.tensor([[0.5, 0.1]], dtype=F64)
    moved = relinearised(pixels, terms, noise)
    assert moved.a[0, at] == pytest.approx(0.048 + q * e / 100, rel=1e-12)
    assert moved.i[0, at] == pytest.approx(0.4 * (1 - 0.8 * e), rel=1e-12)  # 1 - tz i = 0.8
    q = float(100 * moved.i[0, at] * (moved.a[0, at] * 0.5 - 0.1))
    system = normal_equations(pixels, T, noise, "l2")
    variance = 0.25 + 0.01 * q * q
    assert system.distance2[0, at] == pytest.approx(1.44 / variance + 1 / 0.25, rel=1e-12)
    assert system.g[0, 1] == pytest.approx(100 * float(moved.i[0, at]) / 0.25, rel=1e-12)


def test_reproject_is_the_numpy_ego_flow() -> None:
    pair, T = scene(seed=3)
    pixels, valid = reproject(pair.depth_prev, T, pair.K_prev, pair.K_curr)
    for k in range(2):
        cameras = [Camera.from_matrix(K[k].numpy(), 24, 32) for K in (pair.K_prev, pair.K_curr)]
        flow = ego_flow(pair.depth_prev[k].numpy(), T[k].numpy(), *cameras)
        assert valid[k].all()
        assert np.abs(pixels[k].numpy() - pixel_grid(24, 32) - flow).max() < 1e-10


def test_reproject_takes_pypose_poses_and_batches_of_two() -> None:
    pair, T = scene(seed=4)
    lie = pp.mat2SE3(T)
    expected, _ = reproject(pair.depth_prev, T, pair.K_prev, pair.K_curr)
    for pose in (lie, lie.tensor()):
        got, _ = reproject(pair.depth_prev, pose, pair.K_prev, pair.K_curr)
        assert (got - expected).abs().max() < 1e-9
    with pytest.raises(InputError, match="expected T"):
        reproject(pair.depth_prev, lie[:1], pair.K_prev, pair.K_curr)
    with pytest.raises(InputError, match="expected shape"):
        pose_to_matrix(torch.zeros(3, 3))


def test_reproject_marks_points_behind_and_stays_finite() -> None:
    pair, _ = scene()
    T = torch.eye(4, dtype=F64).repeat(2, 1, 1)
    T[0, 2, 3] = -100.0
    depth = pair.depth_prev.clone()
    depth[1, 0, 0] = math.nan
    depth.requires_grad_()
    pixels, valid = reproject(depth, T, pair.K_prev, pair.K_curr)
    assert not valid[0].any()
    assert not valid[1, 0, 0] and valid[1].sum() == 24 * 32 - 1
    (gradient,) = torch.autograd.grad(pixels.sum(), depth)
    assert torch.isfinite(pixels).all() and torch.isfinite(gradient).all()


@pytest.mark.parametrize("second", [False, True])
def test_jacobian_against_autograd_and_differences(second: bool) -> None:
    pair, T = scene(height=6, width=7, seed=5)
    pair = replace(pair, depth_curr=torch.full((2, 6, 7), 4.0, dtype=F64))
    pixels = gather_pixels(pair, use_second_depth=second)
    terms = residual_terms(pixels, T)
    rows = jacobian(terms, pixels.K)
    assert len(rows) == len(terms.r) == 2 + second

    def prediction(delta: torch.Tensor, k: int) -> torch.Tensor:
        return -residual_terms(pixels, left_update(delta, T)).r[k]

    zero = torch.zeros(2, 6, dtype=F64)
    for k, row in enumerate(rows):
        full = torch.autograd.functional.jacobian(lambda d, k=k: prediction(d, k), zero)
        auto = torch.stack([full[b, :, b] for b in range(2)])
        first_order = torch.autograd.functional.jacobian(
            lambda d, k=k: -residual_terms(pixels, T, d).r[k], zero
        )
        first_order = torch.stack([first_order[b, :, b] for b in range(2)])
        assert (row.transpose(1, 2) - auto).abs().max() < 1e-10
        assert (row.transpose(1, 2) - first_order).abs().max() < 1e-10
        for j in range(6):
            step = torch.zeros(2, 6, dtype=F64)
            step[:, j] = 1e-6
            slope = (prediction(step, k) - prediction(-step, k)) / 2e-6
            assert (slope - row[:, j]).abs().max() < 1e-5  # 1e-6^2 curvature + rounding / 1e-6


@pytest.mark.parametrize("second", [False, True])
def test_sensitivity_to_depth_against_autograd(second: bool) -> None:
    pair, T = scene(height=6, width=7, seed=6)
    pair = replace(pair, depth_curr=torch.full((2, 6, 7), 4.0, dtype=F64))
    pixels = gather_pixels(pair, use_second_depth=second)
    terms = residual_terms(pixels, T)
    for k, u in enumerate(terms.u):
        log_depth = pixels.depth.log().requires_grad_()
        r = residual_terms(replace(pixels, depth=log_depth.exp()), T).r[k]
        (slope,) = torch.autograd.grad(-r.sum(), log_depth)
        assert (slope - u).abs().max() < 1e-10


@pytest.mark.parametrize("kernel", KERNELS)
def test_normal_equations_against_dense_algebra(kernel: str) -> None:
    pair, T = scene(height=5, width=6, seed=7)
    smooth = torch.linspace(3, 3.4, 30, dtype=F64).reshape(5, 6)
    pair = replace(pair, depth_curr=smooth.repeat(2, 1, 1))
    weights = torch.rand(2, 5, 6, dtype=F64, generator=torch.Generator().manual_seed(1))
    noise = torch.tensor([[0.4, 0.05, 0.02], [0.3, 0.02, 0.05]], dtype=F64)
    pixels = gather_pixels(pair, weights, use_second_depth=True)
    present = pixels.has_depth_curr
    assert present is not None and 0 < present.sum() < present.numel()
    system = normal_equations(pixels, T, noise, kernel, with_scores=True)
    terms = residual_terms(pixels, T)
    moved = relinearised(pixels, terms, noise)
    rows = jacobian(moved, pixels.K)
    c = CUTOFFS[kernel]
    for b in range(2):
        H, g, cost = np.zeros((6, 6)), np.zeros(6), 0.0
        for k in range(30):
            keep = [0, 1, 2] if present[b, k] else [0, 1]
            J = np.stack([rows[q][b, :, k].numpy() for q in keep])
            u = np.array([float(moved.u[q][b, k]) for q in keep])
            r = np.array([float(terms.r[q][b, k]) for q in keep])
            sf, sd, sz = noise[b].tolist()
            sigma = np.diag([sf**2, sf**2, sz**2][: len(keep)]) + sd**2 * np.outer(u, u)
            information = np.linalg.inv(sigma)
            d2 = r @ information @ r
            distance2 = torch.tensor(d2, dtype=F64)
            w = float(weights[b].flatten()[k] * robust_weight(distance2, kernel, c))
            H += w * J.T @ information @ J
            g += w * J.T @ information @ r
            cost += float(weights[b].flatten()[k] * robust_cost(distance2, kernel, c))
        assert system.H[b].numpy() == pytest.approx(H, rel=1e-9, abs=1e-9 * np.abs(H).max())
        assert system.g[b].numpy() == pytest.approx(g, rel=1e-9, abs=1e-9 * np.abs(g).max())
        assert float(system.cost[b]) == pytest.approx(cost, rel=1e-10)
    assert system.scores is not None
    assert (system.scores.sum(dim=2) - system.g).abs().max() < 1e-9 * system.g.abs().max()
    lean = score_sum(pixels, T, noise, kernel, c)
    assert (lean - system.g).abs().max() < 1e-9 * system.g.abs().max()


@pytest.mark.parametrize("kernel", KERNELS)
def test_weight_is_twice_the_slope_of_the_cost(kernel: str) -> None:
    d2 = torch.tensor([0.0, 0.3, 1.0, 4.0, 60.0], dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(robust_cost(d2, kernel, 1.7).sum(), d2)
    assert (2 * slope - robust_weight(d2, kernel, 1.7)).abs().max() < 1e-14
    assert robust_weight(torch.zeros(1), kernel, 1.7) == 1


def test_unknown_kernel() -> None:
    with pytest.raises(InputError, match="expected one of"):
        robust_weight(torch.zeros(1), "tukey", 1.0)
    with pytest.raises(InputError, match="expected one of"):
        robust_cost(torch.zeros(1), "tukey", 1.0)


def numba_step(pair: PairBatch, weights: torch.Tensor | None, T: np.ndarray, noise: tuple) -> tuple:
    """(step, H, g) of the numba kernels for the only sample of a batch."""
    dummy = np.ones((1, 1), np.float32)
    flags, scale = 0, np.ones(2, np.float32)
    data = [pair.depth_prev[0].float().numpy(), pair.flow[0].float().numpy()]
    for index, (value, flag) in enumerate(
        (
            (pair.flow_variance, kernels.HAS_FLOW_VARIANCE),
            (pair.depth_variance, kernels.HAS_DEPTH_VARIANCE),
        )
    ):
        if value is None:
            data.append(dummy)
            continue
        data.append(value[0].float().numpy())
        scale[index] = typical(data[-1])
        flags |= flag
    data.append(dummy if weights is None else weights[0].float().numpy())
    flags |= 0 if weights is None else kernels.HAS_WEIGHTS
    data.append(np.ones((1, 1), np.bool_) if pair.valid is None else pair.valid[0].numpy())
    flags |= 0 if pair.valid is None else kernels.HAS_VALID
    K = pair.K_prev[0].numpy()
    camera = np.array([1 / K[0, 0], 1 / K[1, 1], K[0, 2], K[1, 2]], np.float32)
    K = pair.K_curr[0].numpy()
    current = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.float32)
    three = np.empty(3, np.float32)
    solver.set_noise(*noise, 3.0, three)
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    height, width = pair.depth_prev.shape[1:]
    tile = 24
    tiles = np.zeros((-(-height // tile), -(-width // tile), 27))
    out = np.zeros(kernels.SUMS)
    weight_map = np.empty((height, width), np.float32)
    for band in range(len(tiles)):
        kernels.sum_tiles(
            tuple(data), camera, flags, scale, R, t, current, three, band, tile, weight_map,
            tiles, out,
        )  # fmt: skip
    out[:27] = tiles.sum(axis=(0, 1))
    delta = np.zeros(6)
    assert solver.solve6(out, 0.0, delta)
    return delta, out


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("case", ["plain", "variances", "weights", "mask", "all"])
def test_step_equals_the_numba_kernels(case: str, dtype: torch.dtype) -> None:
    pair, T = scene(1, 60, 80, seed=8, dtype=dtype)
    g = torch.Generator().manual_seed(2)

    def positive() -> torch.Tensor:
        return (0.3 + torch.rand(1, 60, 80, generator=g, dtype=F64)).to(dtype)

    weights = None
    if case in ("variances", "all"):
        flow_variance, depth_variance = positive(), 1e-3 * positive()
        flow_variance[0, 3, 4], flow_variance[0, 5, 5] = math.nan, -1.0
        depth_variance[0, 9, 9], depth_variance[0, 9, 10] = 0.0, math.inf
        pair = replace(pair, flow_variance=flow_variance, depth_variance=depth_variance)
    if case in ("weights", "all"):
        weights = 3 * positive()
        weights[0, :4] = 0.0
        weights[0, 10, :3] = torch.tensor([math.nan, -2.0, 1e38], dtype=dtype)
    if case in ("mask", "all"):
        pair.depth_prev[0, 20:24, 5] = torch.tensor([math.nan, 0.0, -1.0, math.inf], dtype=dtype)
        pair.flow[0, 30, 6] = math.nan
        pair = replace(pair, valid=torch.rand(1, 60, 80, generator=g) > 0.3)
    start = se3_exp(np.array([0.02, -0.01, 0.015, 2e-3, -1e-3, 3e-3])) @ T[0].numpy()
    expected, _ = numba_step(pair, weights, start, (0.35, 0.04))
    pixels = gather_pixels(pair, weights)
    noise = torch.tensor([[0.35, 0.04]], dtype=dtype)
    system = normal_equations(pixels, torch.as_tensor(start)[None].to(dtype), noise)
    step, good = gauss_newton_step(system.H, system.g)
    assert good.all()
    # in units of the step along each of translation and rotation
    for part in (slice(0, 3), slice(3, 6)):
        length = np.linalg.norm(expected[part])
        assert np.abs(step[0, part].numpy() - expected[part]).max() < 1e-5 * length


def test_noise_estimate_equals_the_numba_one() -> None:
    pair, T = scene(1, 25, 36, seed=9, dtype=torch.float32, motion=5.0)
    pixels = gather_pixels(pair)
    buffer = np.stack(
        [
            value[0].numpy()
            for value in (
                pixels.ray_x, pixels.ray_y, pixels.depth, pixels.target_u, pixels.target_v,
                1 / pixels.flow_variance, pixels.depth_variance, pixels.weight,
            )
        ]
    )  # fmt: skip
    pose = np.ascontiguousarray(T[0, :3].numpy())
    sf, sd, *_ = solver.estimate_noise(
        buffer, 900, pose, pixels.K[0].numpy(), 0.7, 0.01, 100.0, 0.08, 6, 1000
    )
    got = estimate_noise(pixels, T, torch.tensor([[0.7, 0.01]]))[0]
    assert got.tolist() == pytest.approx([sf, sd], rel=1e-4)
    # 900 pixels: 1 / sqrt(2 n) = 2 % of sigma for the flow, coarser for the depth
    assert sf == pytest.approx(0.3, rel=0.1)
    assert sd == pytest.approx(0.03, rel=0.25)


def test_sampled_depth_by_hand() -> None:
    depth = torch.tensor([[[4.0, 4.1, 8.0], [4.05, 4.15, 8.0]]], dtype=F64)
    u = torch.tensor([[0.25, 1.0, 1.5, 2.0, -0.1, math.nan]], dtype=F64)
    v = torch.tensor([[0.5, 1.0, 0.5, 1.0, 0.0, 0.0]], dtype=F64)
    sampled, good = sample_depth(depth, u, v)
    assert good.tolist() == [[True, False, False, False, False, False]]
    assert sampled[0, 0] == pytest.approx(0.75 * 4.025 + 0.25 * 4.125)
    depth[0, 1, 0] = math.nan
    assert not sample_depth(depth, u, v)[1].any()
    flat = torch.full((1, 4, 5), 3.0, dtype=F64)
    corner = torch.tensor([[4.0, 0.0]], dtype=F64), torch.tensor([[3.0, 0.0]], dtype=F64)
    assert sample_depth(flat, *corner)[1].all()


def test_unusable_values_leave_no_trace_in_gradients() -> None:
    pair, T = scene(seed=10)
    for value in (math.nan, math.inf, -math.inf, 0.0, -3.0, 1e300):
        pair.depth_prev[0, 0, 0] = value
        pair.flow[0, 1, 1, 0] = math.nan if value == 0.0 else value
        inputs = [v.clone().requires_grad_() for v in (pair.flow, pair.depth_prev, pair.K_prev)]
        pixels = gather_pixels(PairBatch(*inputs, pair.K_curr))
        g = score_sum(pixels, T, torch.tensor([[0.3, 0.03]] * 2, dtype=F64), "geman-mcclure", 3.0)
        gradients = torch.autograd.grad(g.sum(), inputs)
        assert all(torch.isfinite(gradient).all() for gradient in gradients)
        assert gradients[1][0, 0, 0] == 0


def test_sparse_subset_takes_usable_pixels_once() -> None:
    pair, _ = scene(height=40, width=50)
    valid = torch.zeros(2, 40, 50, dtype=torch.bool)
    valid[0, 10:30, 10:40] = True
    valid[1, 5, 5:12] = True
    pixels = gather_pixels(replace(pair, valid=valid))
    sparse = sparse_subset(pixels, 200)
    assert (sparse.weight > 0).sum(dim=1).tolist() == [200, 7]
    places = torch.stack([sparse.ray_x[0], sparse.ray_y[0]], dim=1)
    assert len(torch.unique(places, dim=0)) == 200
    assert torch.unique(sparse.ray_x[1, :7]).numel() == 7


def test_gauss_newton_step_fails_alone() -> None:
    good = 2 * torch.eye(6, dtype=F64)
    H = torch.stack([good, torch.zeros(6, 6, dtype=F64), math.nan * good, -good])
    step, solved = gauss_newton_step(H, torch.ones(4, 6, dtype=F64))
    assert solved.tolist() == [True, False, False, False]
    assert step[0].tolist() == pytest.approx([0.5] * 6)
    assert (step[1:] == 0).all()
