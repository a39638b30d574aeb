"""The motion that the trusted pixels agree on: a network's doubt as the weights of a small fit.

A pixel-wise network tells better where the world is than how it moves: its log scales s weigh the
ego-flow equation (paper, equation 8), Gauss-Newton solves it from the selected motion. Batched, in
torch, and differentiable in s: the network learns the doubt that the fit needs.
"""

from __future__ import annotations

import torch

from hybridvo.errors import InputError
from hybridvo.network.selection import SHARPNESS
from hybridvo.torch_geometry import left_update, pp, se3

__all__ = ["pixel_weights", "weighted_fit"]

CUTOFF = 1.5
"""Scale of the robust kernel in weighted medians of the residual."""
LEAST_SCALE = 1e-4
"""Least scale of the kernel in units of the focal length: 0.1 px at a focal length of 1000."""
MEDIAN_STRIDE = 3
"""Every third pixel is enough for a median; three divides no usual width: all columns count."""
LEAST_WEIGHT = 1e-12
"""Sum of all weights after the kernel below which there is nothing to fit."""
DAMPING = 1e-6
"""Share of the diagonal of the normal equations, so that a flat direction stays solvable."""
NEAREST = 1e-2
"""Depth over depth before below which a moved point counts as behind the camera."""
LONGEST_STEP = 0.5
"""Of one iteration, in radians and in nearest depths: the linear model holds no farther."""


def pixel_weights(log_scale: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """Weights of the pixels of a fit from the log scales of a network's prediction.

    Args:
        log_scale: (B, C, h, w), mostly that of the rotation, which tells movers best.
        valid: (B, h, w) bool, flow and depth are known.

    Returns:
        (B, h, w) weights that are 0 where invalid and sum to one (to 0 where nothing is valid).
    """
    s = torch.nan_to_num(log_scale.mean(dim=1), 50.0, 50.0, -50.0).clamp(-50.0, 50.0)
    s = torch.where(valid, -SHARPNESS * s, torch.full_like(s, -1e4))
    return torch.softmax(s.flatten(1), dim=1).view_as(s) * valid


def weighted_fit(
    ray: torch.Tensor,
    inverse_depth: torch.Tensor,
    target: torch.Tensor,
    weights: torch.Tensor,
    T_start: torch.Tensor,
    iterations: int = 6,
) -> torch.Tensor:
    """Motion that maps rays onto targets best under given weights, by robust Gauss-Newton.

    Args:
        ray: (B, 2, N) x / z and y / z of the previous camera.
        inverse_depth: (B, N) 1 / metres; 0: infinitely far.
        target: (B, 2, N) x / z and y / z where the flow says that the points went.
        weights: (B, N) of the pixels, >= 0; may carry a gradient.
        T_start: (B, 4, 4) T_curr_prev to start from.
        iterations: Gauss-Newton steps under a Geman-McClure kernel whose scale follows the weighted
            median of the residuals.

    Returns:
        (B, 4, 4) T_curr_prev. Its gradient with respect to the weights is that of a Gauss-Newton
        step at the solution in which every pixel beyond the kernel's scale pulls alike, as under an
        L1 norm. The exact implicit gradient vanishes for pixels far away: a fit that has settled on
        a mover would never learn of the world. Where the fit is not finite, or explains the
        weighted median pixel no better than the start, the value is that of ``T_start``.

    Raises:
        InputError: shapes that do not fit.
    """
    batch, count = weights.shape
    if ray.shape != (batch, 2, count) or target.shape != ray.shape:
        raise InputError(
            f"weighted_fit: expected ray and target of {(batch, 2, count)} for weights of "
            f"{(batch, count)}, got {tuple(ray.shape)} and {tuple(target.shape)}."
        )
    if inverse_depth.shape != weights.shape or T_start.shape != (batch, 4, 4):
        raise InputError(
            f"weighted_fit: expected inverse_depth of {(batch, count)} and T_start of "
            f"{(batch, 4, 4)}, got {tuple(inverse_depth.shape)} and {tuple(T_start.shape)}."
        )
    with torch.autocast(weights.device.type, enabled=False):
        number = torch.float64 if ray.dtype == torch.float64 else torch.float32
        ray, inverse, target, weights = (
            torch.nan_to_num(x.to(number), 0.0, 0.0, 0.0)
            for x in (ray, inverse_depth, target, weights)
        )
        start = se3(T_start.detach().to(number))
        fixed = weights.detach()
        # Metres of the nearest tenth as the unit of length: rotations and translations alike.
        unit = inverse.quantile(0.9, dim=1).clamp(min=1e-3)
        T = start
        with torch.no_grad():
            step, first = _step(ray, inverse, target, fixed, T, unit)
            for _ in range(iterations - 1):
                T = left_update(step, T)
                step, _ = _step(ray, inverse, target, fixed, T, unit)
            T = left_update(step, T)
            _, last = _step(ray, inverse, target, fixed, T, unit)
            good = torch.isfinite(T.tensor()).all(dim=1) & (last <= first)
            T = pp.SE3(torch.where(good[:, None], T.tensor(), start.tensor()))
        if weights.requires_grad:
            step, _ = _step(ray, inverse, target, weights, T, unit, far=True)
            # value of the solution, gradient of the step
            T = left_update(step - step.detach(), T)
    return T.matrix().to(T_start.dtype)


def _step(
    ray: torch.Tensor,
    inverse: torch.Tensor,
    target: torch.Tensor,
    weights: torch.Tensor,
    T: pp.LieTensor,
    unit: torch.Tensor,
    far: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """((B, 6) Gauss-Newton step (translation, rotation), (B,) scale of the residuals).

    ``far``: pixels far away pull with constant strength, and the gradient is that of the right
    hand side alone.
    """
    M = T.matrix()
    moved = torch.einsum("bij,bjn->bin", M[:, :3, :2], ray) + M[:, :3, 2:3]
    moved = moved + M[:, :3, 3:] * inverse[:, None]
    front = moved[:, 2] > NEAREST
    z = torch.where(front, moved[:, 2], torch.ones_like(inverse))
    x, y = moved[:, 0] / z, moved[:, 1] / z
    d = inverse / (z * unit[:, None])
    zero = torch.zeros_like(x)
    xy = x * y
    # (B, 6, 2, N): rows of translation and rotation, columns of x and y
    J = torch.stack(
        [d, zero, zero, d, -x * d, -y * d, -xy, -1 - y * y, 1 + x * x, xy, -y, x], dim=1
    ).view(len(x), 6, 2, -1)
    residual = target - torch.stack([x, y], dim=1)
    with torch.no_grad():
        length2 = residual.square().sum(dim=1)
        used = torch.where(front, weights, zero)
        some, order = length2[:, ::MEDIAN_STRIDE].sort(dim=1)
        reached = used[:, ::MEDIAN_STRIDE].gather(1, order).cumsum(dim=1)
        middle = (reached < 0.5 * reached[:, -1:]).sum(dim=1, keepdim=True)
        scale2 = some.gather(1, middle.clamp(max=some.shape[1] - 1))
        kernel2 = (CUTOFF**2 * scale2).clamp(min=LEAST_SCALE**2)
        factor = kernel2 / (kernel2 + length2)
        factor = torch.where(front, factor.sqrt() if far else factor.square(), zero)
    g = weights * factor
    total = g.detach().sum(dim=1, keepdim=True)
    enough = (total > LEAST_WEIGHT) & torch.isfinite(total)
    # without weight there is no step and no gradient
    g = torch.where(enough, g / torch.where(enough, total, torch.ones_like(total)), zero)
    rows, weighted = J.flatten(2), (J * g[:, None, None]).flatten(2)
    A = (weighted.detach() if far else weighted) @ rows.transpose(1, 2)
    b = (weighted @ residual.flatten(1)[:, :, None])[:, :, 0]
    diagonal = torch.diag_embed(DAMPING * A.diagonal(dim1=1, dim2=2).detach() + 1e-12)
    step = torch.linalg.solve_ex((A + diagonal).double(), b.double())[0].to(b.dtype)
    step = step * (LONGEST_STEP / step.detach().norm(dim=1, keepdim=True)).clamp(max=1.0)
    metres = torch.cat([step[:, :3] / unit[:, None], step[:, 3:]], dim=1)
    return metres, scale2[:, 0].sqrt()
