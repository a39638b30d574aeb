"""Transforms of torch.func are refused in one line; what stands in for them works."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

import hybridvo as hvo
from hybridvo_lab.windows.window import refine_window
from tests.solver.batches import noisy_batch

BATCH, _ = noisy_batch(1, (16, 20), outliers=0)
NOISE = (0.3, 0.02)


def of_flow(flow: torch.Tensor) -> torch.Tensor:
    batch = replace(BATCH, flow=flow)
    return hvo.refine(batch, noise=NOISE).T_curr_prev


def of_weights(weights: torch.Tensor) -> torch.Tensor:
    return hvo.refine(BATCH, weights=weights, noise=NOISE).T_curr_prev


def of_noise(noise: torch.Tensor) -> torch.Tensor:
    return refine_window(BATCH, [[0, 1]], noise=noise).T_frame_first


def of_depth(depth: torch.Tensor) -> torch.Tensor:
    batch = replace(BATCH, depth_prev=depth)
    return hvo.refine(batch, noise=NOISE).T_curr_prev


INPUTS: dict[Callable, torch.Tensor] = {
    of_flow: BATCH.flow,
    of_weights: torch.ones_like(BATCH.depth_prev),
    of_noise: torch.tensor(NOISE),
    of_depth: BATCH.depth_prev,
}
TRANSFORMS: dict[str, Callable] = {
    "jacrev": lambda f, x: torch.func.jacrev(f)(x),
    "jacfwd": lambda f, x: torch.func.jacfwd(f)(x),
    "grad": lambda f, x: torch.func.grad(lambda y: f(y).sum())(x),
    "vjp": lambda f, x: torch.func.vjp(f, x),
    "jvp": lambda f, x: torch.func.jvp(f, (x,), (torch.ones_like(x),)),
    "vmap": lambda f, x: torch.func.vmap(f)(x[None]),
}


@pytest.mark.parametrize("function", INPUTS)
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_a_transform_is_refused_in_one_line(function, transform: str) -> None:
    with pytest.raises(hvo.InputError) as caught:
        TRANSFORMS[transform](function, INPUTS[function])
    message = str(caught.value)
    assert "\n" not in message
    for word in ("expected a plain tensor", "torch.func", "autograd", "batch"):
        assert word in message


def test_forward_mode_is_refused_instead_of_losing_the_tangent() -> None:
    with torch.autograd.forward_ad.dual_level():
        flow = torch.autograd.forward_ad.make_dual(BATCH.flow, BATCH.flow)
        with pytest.raises(hvo.InputError, match="forward-mode"):
            of_flow(flow)


@pytest.mark.parametrize("vectorize", [False, True])
def test_what_the_message_names_works(vectorize: bool) -> None:
    push = torch.zeros(2, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(
        lambda x: of_flow(BATCH.flow + x)[0, :3, 3], push, vectorize=vectorize
    )
    step = 1e-5 * torch.eye(2, dtype=torch.float64)
    for k in range(2):
        sides = [of_flow_exact(BATCH.flow + s * step[k]) for s in (1, -1)]
        slope = (sides[0] - sides[1]) / 2e-5
        assert torch.allclose(jacobian[:, k], slope, rtol=1e-4, atol=1e-6)


def of_flow_exact(flow: torch.Tensor) -> torch.Tensor:
    """The translation, solved as exactly as for a gradient."""
    return of_flow(flow.clone().requires_grad_()).detach()[0, :3, 3]
