from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pypose as pp
import pytest
import torch

from hybridvo.geometry import pixel_grid, se3_exp
from hybridvo.pose.batch_solver import gauss_newton_step
from hybridvo.pose.batched import BatchOptions, refine_batch
from hybridvo.pose.implicit import estimating_hessian, solve_small, tangent_gradient
from hybridvo.pose.pixels import gather_pixels
from hybridvo.pose.residuals import (
    CUTOFFS,
    left_update,
    normal_equations,
    reproject,
    score_sum,
)
from hybridvo.types import PairBatch

F64 = torch.float64
NOISE = (0.3, 0.03)
TIGHT = BatchOptions(tight=True)
SLOTS = ("flow", "depth_prev", "K_prev", "K_curr", "weights", "depth_curr")


def noisy_pair(
    batch: int = 2, height: int = 7, width: int = 9, seed: int = 0, motion: float = 1.0
) -> tuple[PairBatch, torch.Tensor]:
    """Noisy pairs with outliers, and external weights, small enough for finite differences."""
    g = torch.Generator().manual_seed(seed)
    K_prev = torch.tensor([[30.0, 0, 4], [0, 31.0, 3], [0, 0, 1]], dtype=F64).repeat(batch, 1, 1)
    K_curr = torch.tensor([[33.0, 0, 4.5], [0, 32.0, 3], [0, 0, 1]], dtype=F64).repeat(batch, 1, 1)
    v, u = torch.meshgrid(
        torch.arange(height, dtype=F64), torch.arange(width, dtype=F64), indexing="ij"
    )
    depth = 3 + 0.03 * u + 0.02 * v + 1.5 * (u > 4)
    depth = depth + torch.rand(batch, height, width, generator=g, dtype=F64) * 0.05
    scale = motion * torch.tensor([0.1] * 3 + [0.02] * 3, dtype=F64)
    T = pp.se3(torch.randn(batch, 6, generator=g, dtype=F64) * scale).Exp().matrix()
    flow = reproject(depth, T, K_prev, K_curr)[0] - torch.stack([u, v], dim=-1)
    flow = flow + 0.3 * torch.randn(flow.shape, generator=g, dtype=F64)
    gross = torch.rand(depth.shape, generator=g, dtype=F64) < 0.1
    flow = flow + gross[..., None] * 2.0
    depth_curr = depth * (1 + 0.01 * torch.randn(depth.shape, generator=g, dtype=F64))
    weights = 0.5 + torch.rand(depth.shape, generator=g, dtype=F64)
    return PairBatch(flow, depth, K_prev, K_curr, depth_curr=depth_curr), weights


def solve(
    inputs: tuple[torch.Tensor, ...], kernel: str, second: bool = False, options=TIGHT
) -> torch.Tensor:
    pair = PairBatch(*inputs[:4], depth_curr=inputs[5] if second else None)
    noise = (*NOISE, 0.05) if second else NOISE
    result = refine_batch(
        pair, weights=inputs[4], noise=noise, kernel=kernel, options=options,
        use_second_depth=second,
    )  # fmt: skip
    assert result.converged.all(), [str(s) for s in result.status]
    return result.T_curr_prev


def inputs_of(pair: PairBatch, weights: torch.Tensor) -> tuple[torch.Tensor, ...]:
    assert pair.depth_curr is not None
    return pair.flow, pair.depth_prev, pair.K_prev, pair.K_curr, weights, pair.depth_curr


def places(slot: int, shape: tuple[int, ...], rng: np.random.Generator) -> list[tuple[int, ...]]:
    if slot in (2, 3):
        return [(b, i, j) for b, i, j in ((0, 0, 0), (0, 1, 2), (1, 1, 1), (1, 0, 2))]
    return [tuple(int(rng.integers(n)) for n in shape) for _ in range(3)]


def slope(
    function: Callable[[tuple[torch.Tensor, ...]], torch.Tensor],
    inputs: tuple[torch.Tensor, ...],
    slot: int,
    place: tuple[int, ...],
) -> float:
    """Central difference of a whole solve."""
    values = []
    for step in (1e-5, -1e-5):
        changed = [value.detach().clone() for value in inputs]
        changed[slot][place] += step
        values.append(float(function(tuple(changed))))
    return (values[0] - values[1]) / 2e-5


@pytest.mark.parametrize(
    ("kernel", "second"),
    [("geman-mcclure", False), ("geman-mcclure", True), ("huber", False), ("cauchy", True)],
)
def test_against_differences_of_the_whole_solve(kernel: str, second: bool) -> None:
    pair, weights = noisy_pair(seed=1)
    inputs = inputs_of(pair, weights)
    C = torch.randn(2, 4, 4, dtype=F64, generator=torch.Generator().manual_seed(3))

    def loss(values: tuple[torch.Tensor, ...]) -> torch.Tensor:
        return (C * solve(values, kernel, second)).sum()

    leaves = tuple(value.clone().requires_grad_() for value in inputs)
    used = leaves if second else leaves[:5]
    gradients = torch.autograd.grad(loss(leaves), used)
    rng = np.random.default_rng(0)
    for slot, gradient in enumerate(gradients):
        assert gradient.abs().max() > 0, SLOTS[slot]
        for place in places(slot, tuple(gradient.shape), rng):
            expected = slope(loss, inputs, slot, place)
            # curvature times 1e-10 and a pose exact to 1e-13 over a step of 1e-5
            assert float(gradient[place]) == pytest.approx(expected, rel=1e-5, abs=2e-7), SLOTS[
                slot
            ]


def test_gradcheck() -> None:
    pair, weights = noisy_pair(height=5, width=6, seed=2)
    inputs = [pair.flow, pair.depth_prev, pair.K_prev, pair.K_curr, weights]
    leaves = tuple(value.clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(
        lambda *values: solve((*values, values[1]), "geman-mcclure"), leaves, eps=1e-6, atol=1e-6,
        fast_mode=True,
    )  # fmt: skip


def test_against_an_unrolled_solve() -> None:
    pair, weights = noisy_pair(seed=4)
    flow = pair.flow.clone().requires_grad_()
    depth = pair.depth_prev.clone().requires_grad_()
    implicit = refine_batch(
        replace(pair, flow=flow, depth_prev=depth), weights=weights, noise=NOISE, options=TIGHT
    ).T_curr_prev
    C = torch.randn(2, 4, 4, dtype=F64, generator=torch.Generator().manual_seed(5))
    expected = torch.autograd.grad((C * implicit).sum(), (flow, depth))
    # plain Gauss-Newton, every step in the graph; its contraction of about 0.4 needs many steps
    noise = torch.tensor([NOISE] * 2, dtype=F64)
    pixels = gather_pixels(replace(pair, flow=flow, depth_prev=depth), weights)
    T = implicit.detach()
    for _ in range(40):
        system = normal_equations(pixels, T, noise)
        T = left_update(torch.linalg.solve(system.H, system.g), T)
    assert (T - implicit).abs().max() < 1e-11
    unrolled = torch.autograd.grad((C * T).sum(), (flow, depth))
    for got, want in zip(expected, unrolled, strict=True):
        assert (got - want).abs().max() < 1e-6 * want.abs().max()


def test_gauss_newton_hessian_in_its_place_would_be_wrong() -> None:
    pair, weights = noisy_pair(seed=1)
    flow = pair.flow.clone().requires_grad_()
    T = refine_batch(
        replace(pair, flow=flow), weights=weights, noise=NOISE, options=TIGHT
    ).T_curr_prev
    C = torch.randn(2, 4, 4, dtype=F64, generator=torch.Generator().manual_seed(3))
    (exact,) = torch.autograd.grad((C * T).sum(), flow)
    noise = torch.tensor([NOISE] * 2, dtype=F64)
    pixels = gather_pixels(replace(pair, flow=flow), weights)
    tangent = tangent_gradient(C, T.detach())
    g = score_sum(pixels, T.detach(), noise, "geman-mcclure", CUTOFFS["geman-mcclure"])
    H = normal_equations(pixels.detach(), T.detach(), noise).H
    (crude,) = torch.autograd.grad(
        (solve_small(H, tangent)[0] * g).sum(), flow, retain_graph=True
    )  # fmt: skip
    for k in range(2):
        assert (crude[k] - exact[k]).norm() > 0.1 * exact[k].norm()
    A = estimating_hessian(pixels, T.detach(), noise, "geman-mcclure", 3.0)
    (full,) = torch.autograd.grad(
        (solve_small(A.transpose(1, 2), tangent)[0] * g).sum(), flow
    )  # fmt: skip
    assert (full - exact).abs().max() < 1e-12 * exact.abs().max()


@pytest.mark.parametrize("kernel", ["geman-mcclure", "huber", "l2"])
def test_hessian_of_the_estimating_equation_against_differences(kernel: str) -> None:
    pair, weights = noisy_pair(seed=6)
    pixels = gather_pixels(pair, weights, use_second_depth=True)
    noise = torch.tensor([(*NOISE, 0.05)] * 2, dtype=F64)
    T = torch.eye(4, dtype=F64).repeat(2, 1, 1)
    A = estimating_hessian(pixels, T, noise, kernel, 1.5)
    for k in range(6):
        step = torch.zeros(2, 6, dtype=F64)
        step[:, k] = 1e-6
        ahead, behind = (
            score_sum(pixels, left_update(s * step, T), noise, kernel, 1.5) for s in (1, -1)
        )
        # central difference: 1e-12 curvature, and rounding of g over 2e-6
        assert ((behind - ahead) / 2e-6 - A[:, :, k]).abs().max() < 1e-6 * A.abs().max()


def test_seed_does_not_matter_at_the_optimum() -> None:
    pair, weights = noisy_pair(seed=7)
    C = torch.randn(2, 4, 4, dtype=F64, generator=torch.Generator().manual_seed(8))
    found = []
    for seed in (None, torch.as_tensor(se3_exp(np.array([0.1, -0.1, 0.05, 0.02, 0.01, 0.0])))):
        flow = pair.flow.clone().requires_grad_()
        T_init = None if seed is None else seed.expand(2, 4, 4).clone().requires_grad_()
        T = refine_batch(replace(pair, flow=flow), T_init, weights, noise=NOISE).T_curr_prev
        (gradient,) = torch.autograd.grad((C * T).sum(), flow)
        found.append((T.detach(), gradient))
    assert (found[0][0] - found[1][0]).abs().max() < 1e-11
    assert (found[0][1] - found[1][1]).abs().max() < 1e-8


def test_finite_at_identity_and_zero_residual() -> None:
    grid = torch.as_tensor(pixel_grid(12, 16))
    g = torch.Generator().manual_seed(0)
    K = torch.tensor([[30.0, 0, 8], [0, 30.0, 6], [0, 0, 1]], dtype=F64).repeat(2, 1, 1)
    depth = 2 + torch.rand(2, 12, 16, generator=g, dtype=F64)
    for noise in (None, NOISE, (0.3, 0.0)):
        leaves = [torch.zeros(2, *grid.shape, dtype=F64), depth.clone(), K.clone(), K.clone()]
        leaves = [value.requires_grad_() for value in leaves]
        result = refine_batch(PairBatch(*leaves), noise=noise)
        assert result.converged.all()
        assert (result.T_curr_prev - torch.eye(4, dtype=F64)).abs().max() < 1e-12
        gradients = torch.autograd.grad(result.T_curr_prev.square().sum(), leaves)
        assert all(torch.isfinite(value).all() for value in gradients)
        assert gradients[0].abs().max() > 0


def test_unconverged_or_failed_sample_gives_zero_gradient() -> None:
    pair, weights = noisy_pair(batch=3, seed=9)
    flow = pair.flow.clone()
    flow[1] = torch.nan
    flow.requires_grad_()
    depth = pair.depth_prev.clone().requires_grad_()
    changed = replace(pair, flow=flow, depth_prev=depth)
    result = refine_batch(changed, weights=weights, noise=NOISE)
    assert result.converged.tolist() == [True, False, True]
    for gradient in torch.autograd.grad(result.T_curr_prev.square().sum(), (flow, depth)):
        assert torch.isfinite(gradient).all()
        assert (gradient[1] == 0).all()
        assert gradient[0].abs().max() > 0 and gradient[2].abs().max() > 0
    loose = BatchOptions(tight=False, iterations=1, tolerance=1e-12)
    result = refine_batch(changed, weights=weights, noise=NOISE, options=loose)
    assert not result.converged.any()
    assert result.status[0].state.value == "degraded"
    (gradient,) = torch.autograd.grad(result.T_curr_prev.sum(), depth)
    assert (gradient == 0).all()


def test_differentiable_once_and_only_on_request() -> None:
    pair, weights = noisy_pair(seed=10)
    flow = pair.flow.clone().requires_grad_()
    pair = replace(pair, flow=flow)
    T = refine_batch(pair, weights=weights, noise=NOISE).T_curr_prev
    (gradient,) = torch.autograd.grad(T.square().sum(), flow, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate"):
        gradient.sum().backward()
    assert not refine_batch(pair, differentiable=False).T_curr_prev.requires_grad
    with torch.no_grad():
        assert not refine_batch(pair).T_curr_prev.requires_grad


def test_noise_and_variances_carry_gradients() -> None:
    pair, weights = noisy_pair(seed=11)
    g = torch.Generator().manual_seed(12)
    # the typical variance is the median over a sparse grid and constant: perturb another pixel
    variance = 0.5 + torch.rand(2, 7, 9, generator=g, dtype=F64)
    noise = torch.tensor([NOISE] * 2, dtype=F64)

    def loss(values: tuple[torch.Tensor, ...]) -> torch.Tensor:
        T = refine_batch(
            replace(pair, flow_variance=values[0]), weights=weights, noise=values[1], options=TIGHT
        ).T_curr_prev
        return T[:, :3].sum()

    leaves = (variance.clone().requires_grad_(), noise.clone().requires_grad_())
    gradients = torch.autograd.grad(loss(leaves), leaves)
    for slot, place in ((0, (0, 3, 3)), (0, (1, 5, 2)), (1, (0, 0)), (1, (1, 1))):
        expected = slope(loss, (variance, noise), slot, place)
        assert float(gradients[slot][place]) == pytest.approx(expected, rel=1e-5, abs=1e-8)


def test_pypose_tangent_convention() -> None:
    """Translation first, left: Exp(d) T; the gradient of a pose is padded with a zero."""
    d = torch.tensor([0.1, -0.2, 0.3, 0.02, 0.01, -0.03], dtype=F64)
    assert (pp.se3(d).Exp().matrix() - torch.as_tensor(se3_exp(d.numpy()))).abs().max() < 1e-14
    for size in (0.0, 1e-6, 1e-4, 1.0, 30.0):
        T = left_update(size * d[None], torch.eye(4, dtype=F64)[None])
        assert (T[0] - pp.se3(size * d).Exp().matrix()).abs().max() < 1e-13
    T = pp.SE3(torch.tensor([0.5, 0.1, 2.0, 0, 0, 0, 1.0], dtype=F64))
    point = torch.tensor([1.0, 2.0, 3.0], dtype=F64)
    pose = T.clone().requires_grad_()
    direction = torch.tensor([0.7, -0.4, 0.2], dtype=F64)
    (gradient,) = torch.autograd.grad((direction * pose.Act(point)).sum(), pose)
    moved = T.Act(point)
    expected = torch.cat([direction, torch.linalg.cross(moved, direction)])
    assert gradient[:6].tolist() == pytest.approx(expected.tolist(), abs=1e-14)
    assert gradient[6] == 0
    # and ours, from the gradient of the matrix
    M = torch.zeros(1, 4, 4, dtype=F64)
    M[0, :3] = direction[:, None] * torch.cat([point, torch.ones(1, dtype=F64)])
    assert tangent_gradient(M, T.matrix()[None])[0].tolist() == pytest.approx(expected.tolist())


def test_step_of_normal_equations_matches_small_solve() -> None:
    g = torch.Generator().manual_seed(0)
    B = torch.randn(3, 6, 6, generator=g, dtype=F64)
    H = B @ B.transpose(1, 2) + torch.eye(6, dtype=F64)
    b = torch.randn(3, 6, generator=g, dtype=F64)
    H[1] = 0
    step, good = gauss_newton_step(H, b)
    other, fine = solve_small(H, b)
    assert good.tolist() == fine.tolist() == [True, False, True]
    assert (step - other).abs().max() < 1e-12
