"""Solver steps on a batch of pixels in torch: graduation, noise, Gauss-Newton, Newton.

Every sample has its own damping, acceptance, convergence and failure. Poses are kept in float64,
pixels in their own type; the 6x6 systems are solved in float64.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from hybridvo.pose.implicit import estimating_hessian, solve_small
from hybridvo.pose.pixels import Pixels
from hybridvo.pose.residuals import (
    NormalEquations,
    left_update,
    normal_equations,
    residual_terms,
    total_cost,
)

__all__ = [
    "Solution",
    "estimate_noise",
    "flow_only",
    "gauss_newton",
    "gauss_newton_step",
    "graduate",
    "masked_median",
    "tighten",
    "with_second_depth",
]

DAMPING = 1e-6
MAX_DAMPING = 1e3
FLOW_NOISE_FLOOR = 2e-3
"""Smallest flow noise assumed, px, as in the numba solver."""
DEPTH_NOISE_CAP = 0.08
_SQRT_HALF = 0.5**0.5
SMALL_STEP = 0.1
"""Steps that move the picture by less, in standard deviations, need no descent."""
SECOND_DEPTH_FLOOR = 2e-3
"""Smallest noise of log D_curr assumed: what bilinear sampling of a smooth surface is good to."""


def gauss_newton_step(
    H: torch.Tensor, g: torch.Tensor, damping: torch.Tensor | float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve (H + damping diag H) delta = g, each sample for itself, in float64.

    Args:
        H: (B, 6, 6).
        g: (B, 6).
        damping: (B,) or a number.

    Returns:
        (B, 6) float64 and (B,) bool. Where H is not positive definite (or not finite) the system is
        replaced by the unit matrix and the step by zero.
    """
    H, g = H.double(), g.double()
    diagonal = H.diagonal(dim1=1, dim2=2)
    good = torch.isfinite(H).flatten(1).all(dim=1) & torch.isfinite(g).all(dim=1)
    good = good & (diagonal > 1e-30).all(dim=1)
    unit = torch.eye(6, dtype=H.dtype, device=H.device)
    scale = torch.where(good[:, None], diagonal, torch.ones_like(diagonal)).rsqrt()
    damping = torch.as_tensor(damping, dtype=H.dtype, device=H.device).reshape(-1, 1, 1)
    scaled = H * scale[:, :, None] * scale[:, None, :] + damping * unit
    scaled = torch.where(good[:, None, None], scaled, unit)
    L, info = torch.linalg.cholesky_ex(scaled)
    good = good & (info == 0) & (L.diagonal(dim1=1, dim2=2).square() > 1e-13).all(dim=1)
    L = torch.where(good[:, None, None], L, unit)
    rhs = torch.where(good[:, None], g * scale, torch.zeros_like(g))
    delta = torch.cholesky_solve(rhs[..., None], L)[..., 0] * scale
    good = good & (delta.abs() < 1e6).all(dim=1)
    return torch.where(good[:, None], delta, torch.zeros_like(delta)), good


def _moved(delta: torch.Tensor, g: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Root mean squared motion of the picture by a step, in standard deviations."""
    decrease = (delta * g.double()).sum(dim=1).clamp(min=0)
    return (decrease / weight.double().clamp(min=1e-12)).sqrt()


def masked_median(values: torch.Tensor, mask: torch.Tensor, default: float) -> torch.Tensor:
    """(B,) median of the values under the mask."""
    hidden = torch.where(mask, values, torch.full_like(values, torch.nan))
    return torch.nan_to_num(hidden.nanmedian(dim=1).values, nan=default)


def flow_only(pixels: Pixels) -> Pixels:
    """The same pixels without the second depth."""
    return replace(pixels, log_depth_curr=None, has_depth_curr=None)


def graduate(
    sparse: Pixels, T: torch.Tensor, kernel: str, end: torch.Tensor, largest_px: float, levels: int
) -> torch.Tensor:
    """Gauss-Newton steps with isotropic noise while its scale falls geometrically to ``end``."""
    dtype = sparse.depth.dtype
    terms = residual_terms(sparse, T.to(dtype))
    length = (terms.r[0].square() + terms.r[1].square()).sqrt()
    start = 1.5 * masked_median(length, (sparse.weight > 0) & terms.front, 1.0)
    start = torch.maximum(start.clamp(1.0, largest_px), end)
    for level in range(levels + 1):
        scale = start * (end / start) ** (level / levels)
        noise = torch.stack([scale, torch.zeros_like(scale)], dim=1)
        system = normal_equations(sparse, T.to(dtype), noise, kernel, 1.0)
        delta, _ = gauss_newton_step(system.H, system.g, DAMPING)
        T = left_update(delta, T)
    return T


def estimate_noise(
    sparse: Pixels, T: torch.Tensor, noise: torch.Tensor, rounds: int = 6
) -> torch.Tensor:
    """(B, 2) flow noise in px and noise of log depth of the pixels that follow (B, 4, 4) poses.

    Expectation-maximisation of a mixture of N(0, sf^2 v_f I + sd^2 v_d q q^T) and a uniform density
    over a disc, as in :func:`hybridvo.refinement.solver.estimate_noise`, in float64. ``noise`` (B,
    2) is
    where it starts, and what it returns for samples with fewer than eight pixels near the pose.
    """
    terms = residual_terms(sparse, T.to(sparse.depth.dtype))
    ru, rv, qu, qv = (value.double() for value in (*terms.r[:2], *terms.u[:2]))
    sf, sd = noise[:, :1].double(), noise[:, 1:2].double()
    radius = (8 * sf).clamp(min=4.0)
    weight = sparse.weight.double()
    alpha = sparse.flow_variance.double()
    length2 = ru.square() + rv.square()
    reach2 = radius.square() * alpha.clamp(min=1.0)
    near = terms.front & (weight > 0) & (length2 <= reach2)
    weight = torch.where(near, weight, torch.zeros_like(weight))
    q2 = qu.square() + qv.square()
    x1 = torch.where(q2 > 1e-24, (ru * qu + rv * qv).square() / q2.clamp(min=1e-24), ru.square())
    x2 = (length2 - x1).clamp(min=0)
    beta = sparse.depth_variance.double() * q2
    area = torch.pi * reach2
    vf, vd = sf.square(), sd.square()
    share = torch.full_like(sf, 0.7)
    inside = weight.sum(dim=1, keepdim=True)
    for _ in range(rounds):
        var2 = vf * alpha
        var1 = var2 + vd * beta
        d2 = x1 / var1 + x2 / var2
        p = share * torch.exp(-0.5 * d2) / (2 * torch.pi * (var1 * var2).sqrt())
        p = weight * p / (p + (1 - share) / area) * (d2 <= 60.0)
        i1, i2 = p / var1.square(), p / var2.square()
        a11 = (alpha.square() * (i1 + i2)).sum(dim=1, keepdim=True)
        a12 = (alpha * beta * i1).sum(dim=1, keepdim=True)
        a22 = (beta.square() * i1).sum(dim=1, keepdim=True)
        b1 = (alpha * (x1 * i1 + x2 * i2)).sum(dim=1, keepdim=True)
        b2 = (beta * x1 * i1).sum(dim=1, keepdim=True)
        share = (p.sum(dim=1, keepdim=True) / inside.clamp(min=1e-30)).clamp(0.01, 0.999)
        determinant = a11 * a22 - a12 * a12
        regular = (determinant > 1e-9 * a11 * a22) & (determinant > 0)
        safe = torch.where(regular, determinant, torch.ones_like(determinant))
        first = a11.clamp(min=1e-30)
        both_f, both_d = (b1 * a22 - b2 * a12) / safe, (b2 * a11 - b1 * a12) / safe
        pair_f = torch.where(both_d < 0, b1 / first, both_f)
        alone_f = ((b1 - a12 * vd) / first).clamp(min=0)
        alive = a11 > 0
        vd = torch.where(alive & regular, both_d.clamp(min=0), vd)
        vf = torch.where(alive, torch.where(regular, pair_f, alone_f), vf)
        vf = torch.minimum(vf.clamp(min=FLOW_NOISE_FLOOR**2), radius.square())
        vd = vd.clamp(1e-10, DEPTH_NOISE_CAP**2)
    few = near.sum(dim=1, keepdim=True) < 8
    found = torch.cat([torch.where(few, sf, vf.sqrt()), torch.where(few, sd, vd.sqrt())], dim=1)
    return torch.where(torch.isfinite(found), found, noise.double()).to(noise.dtype)


def with_second_depth(sparse: Pixels, T: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """(B, 3): the noise of log D_curr from the spread of r_z that sd h does not explain.

    sd may explain half of the variance at most: the two depths come from one sensor, and the flow
    of a slow camera says next to nothing of sd.
    """
    if sparse.has_depth_curr is None:
        return noise
    terms = residual_terms(sparse, T.to(sparse.depth.dtype))
    near = terms.r[0].square() + terms.r[1].square() <= (8 * noise[:, :1]).clamp(min=4.0).square()
    used = (sparse.weight > 0) & (sparse.has_depth_curr > 0) & terms.front & near
    spread = 1.4826 * masked_median(terms.r[2].abs(), used, 0.02)
    share = _SQRT_HALF * spread
    h = masked_median(terms.u[2].abs(), used, 1.0).clamp(min=1e-3)
    sd = torch.minimum(noise[:, 1], share / h)
    sz = (spread.square() - (sd * h).square()).clamp(min=SECOND_DEPTH_FLOOR**2).sqrt()
    return torch.stack([noise[:, 0], sd, sz], dim=1)


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a solver stands.

    Args:
        T: (B, 4, 4) float64. noise: (B, 2) or (B, 3).
        converged: (B,) bool. iterations: (B,) steps.
    """

    T: torch.Tensor
    noise: torch.Tensor
    converged: torch.Tensor
    iterations: torch.Tensor


def gauss_newton(
    pixels: Pixels,
    T: torch.Tensor,
    noise: torch.Tensor,
    kernel: str,
    cutoff: float,
    steps: int,
    tolerance: float,
) -> Solution:
    """Damped Gauss-Newton; a step is taken where the cost under the old covariance does not rise.

    The root of the estimating equation is sought, not the least cost: with the covariance held the
    two nearly agree, and steps below ``SMALL_STEP`` are taken whatever the cost says.
    """
    dtype = pixels.depth.dtype
    batch = T.shape[0]
    system = normal_equations(pixels, T.to(dtype), noise, kernel, cutoff)
    H, g, cost, weight, white = _parts(system)
    damping = torch.full((batch,), DAMPING, dtype=torch.float64, device=T.device)
    done = torch.zeros(batch, dtype=torch.bool, device=T.device)
    converged, iterations = done.clone(), torch.zeros(batch, dtype=torch.long, device=T.device)
    slack = 1 + 16 * torch.finfo(dtype).eps
    for _ in range(steps):
        delta, solved = gauss_newton_step(H, g, damping)
        candidate = left_update(delta, T)
        terms = residual_terms(pixels, candidate.to(dtype))
        new_cost = total_cost(pixels, terms, white, kernel, cutoff)
        moved = _moved(delta, g, weight)
        descends = (new_cost <= cost * slack + 1e-12) | (moved < SMALL_STEP)
        better = solved & ~done & descends
        worse = ~done & ~better
        system = normal_equations(
            pixels, candidate.to(dtype), noise, kernel, cutoff, terms=terms
        )  # fmt: skip
        T = torch.where(better[:, None, None], candidate, T)
        H, g, cost, weight, white = _choose(better, _parts(system), (H, g, cost, weight, white))
        iterations = iterations + (~done).long()
        damping = torch.where(better, (damping * 0.1).clamp(min=DAMPING), damping)
        damping = torch.where(worse, (damping * 10).clamp(min=1e-3), damping)
        small = moved < tolerance
        converged = converged | (better & small) | (worse & solved & small)
        done = done | converged | (damping > MAX_DAMPING)
        if bool(done.all()):
            break
    return Solution(T, noise, converged, iterations)


def _parts(system: NormalEquations) -> tuple[Any, ...]:
    return system.H, system.g, system.cost, system.weight_sum, system.whitening


def _choose(mask: torch.Tensor, new: Any, old: Any) -> Any:
    """``new`` where the sample's mask is set, else ``old``, through nested tuples."""
    if isinstance(new, tuple):
        return tuple(_choose(mask, n, o) for n, o in zip(new, old, strict=True))
    return torch.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def tighten(
    pixels: Pixels, start: Solution, kernel: str, cutoff: float, rounds: int = 4, steps: int = 6
) -> Solution:
    """Newton on the estimating equation until the step no longer shrinks.

    Each Hessian serves several steps: near the root one Hessian contracts by orders of magnitude.
    """
    dtype = pixels.depth.dtype
    T, noise, iterations = start.T, start.noise, start.iterations
    eps = torch.finfo(dtype).eps
    last = torch.full(T.shape[:1], torch.inf, dtype=torch.float64, device=T.device)
    done = torch.zeros_like(start.converged)
    for _ in range(rounds):
        A = estimating_hessian(pixels, T.to(dtype), noise, kernel, cutoff)
        for _ in range(steps):
            system = normal_equations(pixels, T.to(dtype), noise, kernel, cutoff)
            delta, solved = solve_small(A, system.g)
            norm = torch.einsum("bi,bij,bj->b", delta, system.H.double(), delta).clamp(min=0)
            moved = (norm / system.weight_sum.double().clamp(min=1e-12)).sqrt()
            shrinks = solved & (moved < 0.5 * last) & (moved < 1) & ~done
            T = torch.where(shrinks[:, None, None], left_update(delta, T), T)
            last = torch.where(shrinks, moved, last)
            iterations = iterations + shrinks.long()
            done = done | (last <= 8 * eps) | ~solved
            if not bool(shrinks.any()):
                break
        done = done | (last < 1e4 * eps)
        if bool(done.all()):
            break
    tight = last < max(1e-8, 1e4 * eps)
    return replace(start, T=T, converged=tight, iterations=iterations)
