"""The residual of the torch refinement: by hand, against autograd, algebra and numba."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridvo.core.geometry import ego_flow, pixel_grid, se3_exp
from hybridvo.core.torch_geometry import left_update, pp, reproject, se3
from hybridvo.core.types import Camera, Frame, FramePair, PairBatch
from hybridvo.solver import kernels
from hybridvo.solver.newton import MotionState
from hybridvo.solver.pixels import PixelGrid
from hybridvo.solver.refine_flow import FlowFactor
from hybridvo.solver.torch.factors import (
    KERNELS,
    ResidualModel,
    Weighted,
    gather_pixels,
    linearize,
    residuals,
    total_score,
    weigh,
)
from hybridvo.solver.torch.newton import solve_small
from tests.solver.batches import F64, noisy_batch


def jacobian(at: Weighted, k: int) -> torch.Tensor:
    """(B, 6, N) derivatives of u (k = 0) or v in the left tangent."""
    unit = torch.eye(2).to(at.i)[k]
    return torch.stack(
        at.jacobian_transpose(*(x.expand_as(at.i) for x in unit)), dim=1
    )


def test_one_pixel_by_hand() -> None:
    # fx = fy = 100, c = (1, 1); pixel (2, 1) at 2 m; t = (0.1, 0, 0.5): X' = (0.12, 0, 2.5)
    K = torch.tensor([[[100.0, 0, 1], [0, 100.0, 1], [0, 0, 1]]], dtype=F64)
    depth = torch.full((1, 3, 3), math.nan, dtype=F64)
    depth[0, 1, 2] = 2.0
    flow = torch.zeros(1, 3, 3, 2, dtype=F64)
    flow[0, 1, 2] = torch.tensor([5.0, 1.0])
    T = pp.SE3(torch.tensor([[0.1, 0, 0.5, 0, 0, 0, 1]], dtype=F64))
    pixels = gather_pixels(PairBatch(flow, depth, K, K))
    assert pixels.weight.sum() == 1
    at, exact = 5, ResidualModel(torch.tensor([[0.5, 0.0]], dtype=F64), 1e9)
    r, plain = residuals(pixels, T.matrix())[0], weigh(pixels, T.matrix(), exact)
    # a = 0.048, so the pixel lands at 5.8: residual 7 - 5.8; q = 100/2.5 (0.048 0.5 - 0.1)
    found = [float(x) for x in (*r[0, :, at], *plain.q[0, :, at])]
    assert found == pytest.approx([1.2, 1.0, 40 * (0.024 - 0.1), 0.0], abs=1e-12)
    rows = torch.stack([jacobian(plain, k)[0, :, at] for k in (0, 1)])
    expected = 100 * np.array([0.4, 0, -0.048 * 0.4, 0, 1 + 0.048**2, 0])
    assert rows[0].numpy() == pytest.approx(expected, abs=1e-12)
    assert rows[1].numpy() == pytest.approx([0, 40, 0, -100, 0, 4.8], abs=1e-12)
    # Sigma_uu = 0.25 + 0.01 q^2; most likely log depth: e = 0.01 q 1.2 / Sigma_uu beyond log 2
    q = -40 * 0.076
    e = 0.01 * q * 1.2 / (0.25 + 0.01 * q * q)
    how = ResidualModel(torch.tensor([[0.5, 0.1]], dtype=F64), 1e9)
    moved = weigh(pixels, T.matrix(), how)
    assert moved.ab[0, 0, at] == pytest.approx(0.048 + q * e / 100, rel=1e-12)
    # 1 - tz i = 0.8
    assert moved.i[0, at] == pytest.approx(0.4 * (1 - 0.8 * e), rel=1e-12)
    q = float(100 * moved.i[0, at] * (moved.ab[0, 0, at] * 0.5 - 0.1))
    variance = 0.25 + 0.01 * q * q
    assert moved.distance2[0, at] == pytest.approx(
        1.44 / variance + 1 / 0.25, rel=1e-12
    )
    expected = 100 * float(moved.i[0, at]) / 0.25
    assert linearize(pixels, T, how).g[0, 1] == pytest.approx(expected, rel=1e-12)


def test_reproject_is_the_numpy_ego_flow() -> None:
    batch, T = noisy_batch(seed=3)
    pixels, valid, _ = reproject(batch.depth_prev, T, batch.K_prev, batch.K_curr)
    assert valid.all()
    for k in range(2):
        cameras = [
            Camera.from_matrix(K[k].numpy(), 24, 32)
            for K in (batch.K_prev, batch.K_curr)
        ]
        flow = ego_flow(batch.depth_prev[k].numpy(), T[k].numpy(), *cameras)
        assert np.abs(pixels[k].numpy() - pixel_grid(24, 32) - flow).max() < 1e-10


def test_reproject_marks_points_behind_and_stays_finite() -> None:
    batch, _ = noisy_batch()
    T = torch.eye(4, dtype=F64).repeat(2, 1, 1)
    T[0, 2, 3] = -100.0
    depth = batch.depth_prev.clone()
    depth[1, 0, 0] = math.nan
    depth.requires_grad_()
    pixels, valid, _ = reproject(depth, T, batch.K_prev, batch.K_curr)
    assert not valid[0].any()
    assert not valid[1, 0, 0] and valid[1].sum() == 24 * 32 - 1
    (gradient,) = torch.autograd.grad(pixels.sum(), depth)
    assert torch.isfinite(pixels).all() and torch.isfinite(gradient).all()


def test_derivatives_against_autograd() -> None:
    """The Jacobian in the pose, and the sensitivity to the log depth."""
    batch, T = noisy_batch(size=(6, 7), seed=5)
    pixels, pose = gather_pixels(batch), se3(T)
    # without depth noise the pixels stay at the depth measured
    at = weigh(
        pixels,
        pose.matrix(),
        ResidualModel(torch.tensor([[1.0, 0.0]] * 2, dtype=F64), 3.0),
    )
    zero = torch.zeros(2, 6, dtype=F64)
    for k in (0, 1):
        row = jacobian(at, k)
        full = torch.autograd.functional.jacobian(
            lambda d, k=k: (
                -residuals(pixels, left_update(d, pose).matrix())[0][:, k]
            ),
            zero,
        )
        auto = torch.stack([full[b, :, b] for b in range(2)])
        assert (row.transpose(1, 2) - auto).abs().max() < 1e-10
        scale = torch.ones_like(pixels.weight).requires_grad_()
        scaled = pixels._replace(points=pixels.points * scale[:, None])
        r = residuals(scaled, pose.matrix())[0][:, k]
        # at 1: the derivative in log Z
        (slope,) = torch.autograd.grad(-r.sum(), scale)
        assert (slope - at.q[:, k]).abs().max() < 1e-10


@pytest.mark.parametrize("kernel", KERNELS)
def test_weight_and_curvature_are_slopes_of_the_cost(kernel: str) -> None:
    d2 = torch.tensor([0.0, 0.3, 1.0, 4.0, 60.0], dtype=F64, requires_grad=True)
    cost, weight, curvature = ResidualModel(torch.zeros(0), 1.7, kernel).kernel(d2)
    (slope,) = torch.autograd.grad(cost.sum(), d2, retain_graph=True)
    assert (2 * slope - weight).abs().max() < 1e-14
    if kernel != "l2":
        (bend,) = torch.autograd.grad(weight.sum(), d2)
        assert (-2 * bend / weight - curvature).abs().max() < 1e-12


def numba_step(
    batch: PairBatch, weights: torch.Tensor | None, T: np.ndarray, noise: tuple
):
    """Gauss-Newton step of the numba kernels for the only sample of a batch."""
    given = {name: x[0] for name, x in vars(batch).items() if x is not None}
    one = dict.fromkeys(vars(batch)) | {
        name: (x if name == "valid" else x.float()).numpy()
        for name, x in given.items()
    }
    shape = one["depth_prev"].shape
    prev, curr = (Camera.from_matrix(one[K], *shape) for K in ("K_prev", "K_curr"))
    pair = FramePair(
        Frame(None, one["depth_prev"], prev, depth_variance=one["depth_variance"]),
        Frame(None, None, curr),
        one["flow"], one["flow_variance"], one["valid"],
    )  # fmt: skip
    weighting = kernels.residual_noise(*noise, 3.0)
    scores = kernels.ScoreProducts(np.zeros(21), np.zeros(21))
    image = PixelGrid(pair, None if weights is None else weights[0].float().numpy())
    at = FlowFactor(image, weighting, 24, scores).linearize(MotionState(T))
    return np.linalg.solve(at.H, at.g)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("case", ["plain", "variances", "weights", "mask", "all"])
def test_step_equals_the_numba_kernels(case: str, dtype: torch.dtype) -> None:
    pair, T = noisy_batch(1, (60, 80), seed=8, dtype=dtype)
    g = torch.Generator().manual_seed(2)

    def positive() -> torch.Tensor:
        return (0.3 + torch.rand(1, 60, 80, generator=g, dtype=F64)).to(dtype)

    weights = None
    if case in ("variances", "all"):
        flow_variance, depth_variance = positive(), 1e-3 * positive()
        flow_variance[0, 3, 4], flow_variance[0, 5, 5] = math.nan, -1.0
        depth_variance[0, 9, 9], depth_variance[0, 9, 10] = 0.0, math.inf
        pair = replace(
            pair, flow_variance=flow_variance, depth_variance=depth_variance
        )
    if case in ("weights", "all"):
        weights = 3 * positive()
        weights[0, :4] = 0.0
        weights[0, 10, :3] = torch.tensor([math.nan, -2.0, 1e38], dtype=dtype)
    if case in ("mask", "all"):
        pair.depth_prev[0, 20:24, 5] = torch.tensor(
            [math.nan, 0.0, -1.0, math.inf], dtype=dtype
        )
        pair.flow[0, 30, 6] = math.nan
        pair = replace(pair, valid=torch.rand(1, 60, 80, generator=g) > 0.3)
    start = (
        se3_exp(np.array([0.02, -0.01, 0.015, 2e-3, -1e-3, 3e-3])) @ T[0].numpy()
    )
    expected = numba_step(pair, weights, start, (0.35, 0.04))
    how = ResidualModel(torch.tensor([[0.35, 0.04]], dtype=dtype), 3.0)
    found = linearize(
        gather_pixels(pair, weights), se3(torch.as_tensor(start)[None]), how
    )
    step, good = solve_small(found.H, found.g)
    assert good.all()
    # in units of the step along each of translation and rotation
    for part in (slice(0, 3), slice(3, 6)):
        length = np.linalg.norm(expected[part])
        assert np.abs(step[0, part].numpy() - expected[part]).max() < 1e-5 * length


def test_unusable_values_leave_no_trace_in_gradients() -> None:
    batch, T = noisy_batch(seed=10)
    for value in (math.nan, math.inf, -math.inf, 0.0, -3.0, 1e300):
        batch.depth_prev[0, 0, 0] = value
        batch.flow[0, 1, 1, 0] = math.nan if value == 0.0 else value
        inputs = [
            v.clone().requires_grad_()
            for v in (batch.flow, batch.depth_prev, batch.K_prev)
        ]
        pixels = gather_pixels(PairBatch(*inputs, batch.K_curr))
        how = ResidualModel(torch.tensor([[0.3, 0.03]] * 2, dtype=F64), 3.0)
        gradients = torch.autograd.grad(total_score(pixels, T, how).sum(), inputs)
        assert all(torch.isfinite(gradient).all() for gradient in gradients)
        assert gradients[1][0, 0, 0] == 0
