"""Gradients of the refined pose by implicit differentiation of its estimating equation.

The pose T* solves g(xi = 0; theta) = sum of w J^T Sigma^-1 r = 0. With T = Exp(xi) T*, the implicit
function theorem gives d xi / d theta = A^-1 dg / d theta, A = -dg / d xi. A is the full derivative:
that of the residual (the Gauss-Newton part), of the robust weights, of the Jacobian and of the
covariance. The Gauss-Newton part alone is 27-42 % wrong once the weights depend on the residuals.
The result does not depend on where the solver started, and its memory not on how long it iterated.

The noise scales are constants here, also where they were estimated from the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from hybridvo.pose.pixels import Pixels, gather_pixels
from hybridvo.pose.residuals import score_sum
from hybridvo.types import PairBatch

__all__ = ["attach_gradient", "estimating_hessian", "solve_small", "tangent_gradient"]


@dataclass(frozen=True)
class _Settings:
    kernel: str
    cutoff: float
    use_second_depth: bool


def estimating_hessian(
    pixels: Pixels,
    T: torch.Tensor,
    noise: torch.Tensor,
    kernel: str,
    cutoff: float,
) -> torch.Tensor:
    """A = -dg / d xi at (B, 4, 4) poses, (B, 6, 6), not symmetric; A xi = g is the Newton step."""
    with torch.enable_grad():
        xi = torch.zeros(T.shape[0], 6, dtype=T.dtype, device=T.device, requires_grad=True)
        g = score_sum(pixels.detach(), T.detach(), noise.detach(), kernel, cutoff, xi)
        return _rows(g, xi)


def _rows(g: torch.Tensor, xi: torch.Tensor) -> torch.Tensor:
    """-dg / d xi; the graph is kept."""
    rows = [torch.autograd.grad(g[:, k].sum(), xi, retain_graph=True)[0] for k in range(6)]
    return -torch.stack(rows, dim=1)


def solve_small(A: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve (B, 6, 6) systems in float64, each for itself; other sizes as well.

    Args:
        A: (B, 6, 6), possibly singular or not finite.
        b: (B, 6).

    Returns:
        (B, 6) float64 solutions and (B,) bool; where False the solution is zero.
    """
    A, b = A.double(), b.double()
    unit = torch.eye(A.shape[1], dtype=A.dtype, device=A.device).expand_as(A)
    scale = A.diagonal(dim1=1, dim2=2).abs().sqrt()
    good = torch.isfinite(A).flatten(1).all(dim=1) & torch.isfinite(b).all(dim=1)
    good = good & (scale > 1e-15).all(dim=1)
    A = torch.where(good[:, None, None], A, unit)
    b = torch.where(good[:, None], b, torch.zeros_like(b))
    scale = torch.where(good[:, None], scale, torch.ones_like(scale))
    x, info = torch.linalg.solve_ex(A / (scale[:, :, None] * scale[:, None, :]), b / scale)
    x = x / scale
    good = good & (info == 0) & torch.isfinite(x).all(dim=1)
    return torch.where(good[:, None], x, torch.zeros_like(x)), good


def tangent_gradient(gradient: torch.Tensor, T: torch.Tensor) -> torch.Tensor:
    """(B, 6) gradient with respect to the left tangent from that of the (B, 4, 4) matrix.

    d T = hat(xi) T, so with M = gradient T^T the translation part is M[:3, 3] and the rotation part
    is the skew part of M[:3, :3].
    """
    M = gradient[:, :3, :] @ T.transpose(1, 2)
    return torch.stack(
        [
            M[:, 0, 3],
            M[:, 1, 3],
            M[:, 2, 3],
            M[:, 2, 1] - M[:, 1, 2],
            M[:, 0, 2] - M[:, 2, 0],
            M[:, 1, 0] - M[:, 0, 1],
        ],
        dim=1,
    )


class _ImplicitPose(torch.autograd.Function):
    """The identity on T with the gradient of the implicit function theorem."""

    @staticmethod
    def forward(ctx: Any, T: Any, trusted: Any, settings: Any, valid: Any, *inputs: Any) -> Any:
        ctx.settings = settings
        ctx.save_for_backward(T, trusted, valid, *inputs)
        return T.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> Any:
        T, trusted, valid, *inputs = ctx.saved_tensors
        wanted = ctx.needs_input_grad[4:]
        with torch.enable_grad(), torch.autocast(T.device.type, enabled=False):
            leaves = [
                value if value is None else value.detach().requires_grad_(wants)
                for value, wants in zip(inputs, wanted, strict=True)
            ]
            sums = _vector_jacobian(T, trusted, valid, gradient, leaves, ctx.settings)
        found = iter(sums)
        return None, None, None, None, *(next(found) if wants else None for wants in wanted)


def _vector_jacobian(
    T: torch.Tensor,
    trusted: torch.Tensor,
    valid: torch.Tensor | None,
    gradient: torch.Tensor,
    leaves: list[Any],
    settings: _Settings,
) -> tuple[torch.Tensor, ...]:
    flow, depth, K_prev, K_curr, weights, depth_curr, flow_variance, depth_variance, noise = leaves
    pair = PairBatch(
        flow, depth, K_prev, K_curr, depth_curr, flow_variance, depth_variance, valid
    )  # fmt: skip
    pixels = gather_pixels(pair, weights, settings.use_second_depth)
    xi = torch.zeros(T.shape[0], 6, dtype=T.dtype, device=T.device, requires_grad=True)
    g = score_sum(pixels, T, noise, settings.kernel, settings.cutoff, xi)
    tangent = tangent_gradient(torch.nan_to_num(gradient), T)
    adjoint, solved = solve_small(_rows(g, xi).transpose(1, 2), tangent)
    adjoint = torch.where((solved & trusted)[:, None], adjoint, torch.zeros_like(adjoint))
    wanted = [value for value in leaves if value is not None and value.requires_grad]
    found = torch.autograd.grad(
        (adjoint.to(g.dtype) * g).sum(), wanted, allow_unused=True, materialize_grads=True
    )
    return tuple(found)


def attach_gradient(
    T: torch.Tensor,
    trusted: torch.Tensor,
    pair: PairBatch,
    weights: torch.Tensor | None,
    noise: torch.Tensor,
    kernel: str,
    cutoff: float,
    use_second_depth: bool = False,
) -> torch.Tensor:
    """The converged poses ``T`` as a differentiable function of the tensors of ``pair``.

    Differentiable once, in flow, depths, intrinsics, variances (their typical value constant) and
    weights, and in ``noise`` where the caller handed in a tensor. The backward pass evaluates the
    residuals anew: six vector products for the Hessian and one for the inputs.

    Args:
        T: (B, 4, 4) without a graph.
        trusted: (B,) bool; elsewhere the gradient is zero (a failed or unconverged sample).
        pair: tensors of one floating type.
        weights: (B, H, W) external weights or None.
        noise: (B, 2) or (B, 3), see :func:`hybridvo.pose.residuals.normal_equations`.
        kernel: robust kernel of the solve.
        cutoff: its cutoff in standard deviations.
        use_second_depth: whether the third residual was used.
    """
    settings = _Settings(kernel, cutoff, use_second_depth)
    depth_curr = pair.depth_curr if use_second_depth else None
    return _ImplicitPose.apply(
        T.detach(), trusted, settings, pair.valid, pair.flow, pair.depth_prev, pair.K_prev,
        pair.K_curr, weights, depth_curr, pair.flow_variance, pair.depth_variance, noise,
    )  # fmt: skip
