"""The implicit gradient of the refined pose: against finite differences of the whole estimate."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

import hybridvo as hvo
from hybridvo.batches import refine_batch
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import se3_exp
from hybridvo.core.torch_geometry import left_update, pixel_grid, pp, reproject
from hybridvo.core.types import PairBatch
from hybridvo.solver.torch.factors import (
    KERNELS,
    ResidualModel,
    gather_pixels,
    newton_matrix,
    total_score,
)
from tests.solver.batches import F64, noisy_batch

NOISE = (0.3, 0.03)
NAMES = ("flow", "depth_prev", "K_prev", "K_curr", "weights", "flow_variance")
Values = dict[str, torch.Tensor]


def made(seed: int, size: tuple[int, int] = (7, 9)) -> Values:
    """Inputs small enough for finite differences, every one of them."""
    batch, _ = noisy_batch(2, size, seed, outlier_px=2.0)
    g = torch.Generator().manual_seed(seed + 100)
    noise = torch.randn(batch.depth_prev.shape, generator=g, dtype=F64)
    return {
        **{name: getattr(batch, name) for name in NAMES[:4]},
        "weights": 0.5 + torch.rand(noise.shape, generator=g, dtype=F64),
        "flow_variance": 0.5 + torch.rand(noise.shape, generator=g, dtype=F64),
        "noise": torch.tensor([NOISE] * 2, dtype=F64),
    }


def solve(values: Values, kernel: str = "geman-mcclure"):
    """The refined poses, solved to the precision of float64."""
    values = dict(values)
    weights = values.pop("weights")
    noise = values.pop("noise")
    result = refine_batch(
        PairBatch(**values),
        torch.eye(4, dtype=F64).repeat(2, 1, 1),
        weights if weights.requires_grad else weights.clone().requires_grad_(),
        noise=noise,
        kernel=kernel,
    )
    assert result.converged.all(), result.status
    return result.T_curr_prev


def slope(
    loss: Callable[[Values], torch.Tensor], values: Values, name: str, at
) -> float:
    sides = []
    for step in (1e-5, -1e-5):
        changed = {k: v.detach().clone() for k, v in values.items()}
        changed[name][at] += step
        sides.append(loss(changed).item())
    return (sides[0] - sides[1]) / 2e-5


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["geman-mcclure", "huber", "cauchy"])
def test_against_differences_of_the_whole_estimate(kernel: str) -> None:
    values = made(seed=1)
    C = torch.randn(2, 4, 4, dtype=F64, generator=torch.Generator().manual_seed(3))

    def loss(changed: Values) -> torch.Tensor:
        return (C * solve(changed, kernel)).sum()

    leaves = {k: v.clone().requires_grad_() for k, v in values.items()}
    names = [*NAMES, "noise"]
    gradients = torch.autograd.grad(loss(leaves), [leaves[n] for n in names])
    for name, gradient in zip(names, gradients, strict=True):
        assert gradient.abs().max() > 0, name
        at = {"K_prev": (0, 0, 2), "K_curr": (1, 1, 1), "noise": (1, 0)}.get(
            name, (1, 4, 6)
        )
        expected = slope(loss, values, name, at)
        got = gradient[at].sum()
        # curvature times 1e-10, and a pose exact to 1e-13 over a step of 1e-5
        assert float(got) == pytest.approx(expected, rel=1e-5, abs=2e-7), name


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["geman-mcclure", "cauchy"])
def test_with_estimated_noise_it_is_that_of_the_solution_with_the_noise_held(
    kernel: str,
) -> None:
    """As the public call has it: the gradient at its own noise, and differences at that noise."""
    values = made(seed=4, size=(24, 32))
    values.pop("noise")
    C = torch.randn(2, 4, 4, dtype=F64, generator=torch.Generator().manual_seed(3))

    def motion(changed: Values, noise: torch.Tensor | None):
        weights = changed["weights"]
        batch = PairBatch(
            **{name: x for name, x in changed.items() if name != "weights"}
        )
        start = torch.eye(4, dtype=F64).repeat(2, 1, 1)
        found = hvo.refine(batch, start, weights, noise=noise, kernel=kernel)
        assert found.converged.all()
        return found

    leaves = {k: v.clone().requires_grad_() for k, v in values.items()}
    found = motion(leaves, None)
    gradients = torch.autograd.grad(
        (C * found.T_curr_prev).sum(), list(leaves.values())
    )
    noise = found.noise
    assert ((0 < noise) & (noise < 1)).all() and not noise.requires_grad
    again = motion(leaves, noise)
    held = torch.autograd.grad((C * again.T_curr_prev).sum(), list(leaves.values()))
    for name, gradient, other in zip(leaves, gradients, held, strict=True):
        # two solutions, each exact to 1e-8
        assert (gradient - other).abs().max() < 1e-5 * other.abs().max(), name

    def loss(changed: Values) -> torch.Tensor:
        # solved tightly
        wanted = {k: v.clone().requires_grad_() for k, v in changed.items()}
        return (C * motion(wanted, noise).T_curr_prev).sum()

    for name, gradient in zip(leaves, gradients, strict=True):
        at = {"K_prev": (0, 0, 2), "K_curr": (1, 1, 1)}.get(name, (1, 4, 6))
        expected = slope(loss, values, name, at)
        assert float(gradient[at].sum()) == pytest.approx(
            expected, rel=1e-4, abs=2e-6
        ), name


@pytest.mark.parametrize("noise", [None, NOISE])
@pytest.mark.parametrize("leaf", ["flow", "weights"])
def test_a_second_derivative_is_refused(noise, leaf: str) -> None:
    values = made(seed=5)
    x = values[leaf].clone().requires_grad_()
    changed = values | {leaf: x}
    batch = PairBatch(*(changed[name] for name in NAMES[:4]))
    T = hvo.refine(batch, weights=changed["weights"], noise=noise).T_curr_prev
    for loss in (T.sum(), T.square().sum()):
        (first,) = torch.autograd.grad(loss, x, create_graph=True)
        assert torch.isfinite(first).all() and first.abs().max() > 0
        with pytest.raises(InputError, match="second"):
            torch.autograd.grad(first.square().sum(), x)
    # what else hangs on the same leaf may be differentiated as often as it likes
    (first,) = torch.autograd.grad(x.pow(3).sum(), x, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), x)
    assert torch.equal(second, 6 * x.detach())


def test_gradcheck() -> None:
    values = made(seed=2, size=(5, 6))
    names = NAMES[:5]
    leaves = [values[n].clone().requires_grad_() for n in names]
    assert torch.autograd.gradcheck(
        lambda *x: solve(values | dict(zip(names, x, strict=True))),
        leaves, eps=1e-6, atol=1e-6, fast_mode=True,
    )  # fmt: skip


@pytest.mark.parametrize("kernel", KERNELS)
def test_matrix_of_the_newton_step_against_differences(kernel: str) -> None:
    values = made(seed=6)
    batch = PairBatch(
        **{k: v for k, v in values.items() if k not in ("weights", "noise")}
    )
    pixels = gather_pixels(batch, values["weights"])
    how = ResidualModel(values["noise"], 1.5, kernel)
    T = pp.identity_SE3(2, dtype=F64)
    A = newton_matrix(pixels, T, how)
    for k in range(6):
        step = torch.zeros(2, 6, dtype=F64)
        step[:, k] = 1e-6
        sides = (left_update(s * step, T).matrix() for s in (1, -1))
        ahead, behind = (total_score(pixels, side, how) for side in sides)
        assert (
            (behind - ahead) / 2e-6 - A[:, :, k]
        ).abs().max() < 1e-6 * A.abs().max()


def test_start_does_not_matter_at_the_optimum() -> None:
    values = made(seed=7)
    far = torch.as_tensor(se3_exp([0.1, -0.1, 0.05, 0.02, 0.01, 0.0])).expand(
        2, 4, 4
    )
    found = []
    for start in (None, far.clone().requires_grad_()):
        flow = values["flow"].clone().requires_grad_()
        batch = PairBatch(flow, *(values[n] for n in NAMES[1:4]))
        T = refine_batch(batch, start, values["weights"], noise=NOISE).T_curr_prev
        (gradient,) = torch.autograd.grad(T[:, :3].sum(), flow)
        found.append((T.detach(), gradient))
    assert (found[0][0] - found[1][0]).abs().max() < 1e-11
    assert (found[0][1] - found[1][1]).abs().max() < 1e-8


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("noise", [None, NOISE, (0.3, 0.0)])
def test_exact_flow_has_a_gradient_in_single_precision_as_well(
    dtype, noise
) -> None:
    batch, T = noisy_batch(
        2, seed=3, outliers=0, flow_noise=0, depth_noise=0, dtype=dtype
    )
    leaves = [
        x.clone().requires_grad_()
        for x in (batch.flow, batch.depth_prev, batch.K_prev)
    ]
    result = refine_batch(PairBatch(*leaves, batch.K_curr), noise=noise)
    assert result.converged.all() and (result.T_curr_prev - T).abs().max() < 1e-5
    gradients = torch.autograd.grad(result.T_curr_prev[:, :3].sum(), leaves)
    assert all(torch.isfinite(x).all() for x in gradients)
    assert (gradients[0].abs().amax((1, 2, 3)) > 0).all()


def test_a_failed_sample_gives_zero_gradient_and_leaves_the_others() -> None:
    values = made(seed=9)
    flow = values["flow"].clone()
    flow[1] = torch.nan
    flow.requires_grad_()
    result = refine_batch(
        PairBatch(flow, *(values[n] for n in NAMES[1:4])), noise=NOISE
    )
    assert result.failed.tolist() == [False, True]
    (gradient,) = torch.autograd.grad(result.T_curr_prev.square().sum(), flow)
    assert torch.isfinite(gradient).all() and (gradient[1] == 0).all()
    assert gradient[0].abs().max() > 0


def test_only_on_request() -> None:
    values = made(seed=10)
    flow = values["flow"].clone().requires_grad_()
    batch = PairBatch(flow, *(values[n] for n in NAMES[1:4]))
    assert refine_batch(batch, noise=NOISE).T_curr_prev.requires_grad
    with torch.no_grad():
        assert not refine_batch(batch).T_curr_prev.requires_grad


def test_a_refined_motion_of_half_a_turn() -> None:
    """About the axis of the lens: the only half turn whose two images show the same things."""
    T = (
        pp.se3(torch.tensor([[0.05, -0.02, 0.1, 0.0, 0.0, math.pi]], dtype=F64))
        .Exp()
        .matrix()
    )
    K = torch.tensor([[[40.0, 0, 11.5], [0, 40.0, 7.5], [0, 0, 1]]], dtype=F64)
    grid = pixel_grid(16, 24, K)
    depth = (3 + 0.05 * grid[..., 0] + torch.sin(grid[..., 1] / 3))[None]
    g = torch.Generator().manual_seed(0)
    flow = reproject(depth, T, K, K)[0] - grid
    flow = (
        flow + 0.1 * torch.randn(flow.shape, generator=g, dtype=F64)
    ).requires_grad_()
    found = refine_batch(PairBatch(flow, depth, K, K), T, noise=(0.1, 0.01))
    assert found.converged.all() and (found.T_curr_prev - T).abs().max() < 0.05
    (gradient,) = torch.autograd.grad(found.T_curr_prev.sum(), flow)
    assert torch.isfinite(gradient).all() and 0 < gradient.abs().max() < 1e3
