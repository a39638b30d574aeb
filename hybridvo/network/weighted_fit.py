"""The motion that the trusted pixels agree on: a network's doubt as the weights of a small fit.

A pixel-wise network tells better where the world is than how it moves: its log scales s weigh the
ego-flow equation (paper, equation 8), Gauss-Newton solves it from the selected motion. Batched, in
torch, and differentiable in s: the network learns the doubt that the fit needs.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from hybridvo.errors import InputError
from hybridvo.network.inputs import NetworkInputs
from hybridvo.network.selection import SHARPNESS, NetworkOutput, select_motion
from hybridvo.refinement.torch_factors import solve_small
from hybridvo.results import PixelwisePrediction
from hybridvo.torch_geometry import left_update, pp, projection_rows, se3, weighted_median

CUTOFF = 1.5
"""Scale of the robust kernel in weighted medians of the residual."""
MIN_SCALE = 1e-4
"""Least scale of the kernel in units of the focal length: 0.1 px at a focal length of 1000."""
MIN_DEPTH_RATIO = 1e-2
"""Depth over depth before below which a moved point counts as behind the camera."""
MAX_STEP = 0.5
"""Of one iteration, in radians and in nearest depths: the linear model holds no farther."""


def fitted_motion(
    output: NetworkOutput, inputs: NetworkInputs, selection: str = "softmax"
) -> torch.Tensor:
    """(B, 4, 4) motion that the pixels agree on which a prediction trusts.

    The selected pose is the start, the log scales of the rotation are the weights, and carry the
    gradient.

    Args:
        output: a :class:`~hybridvo.results.PixelwisePrediction` with log scales.
        inputs: that it was made from.
        selection: of the start.

    Raises:
        InputError: a prediction without uncertainty.
    """
    if not isinstance(output, PixelwisePrediction) or output.log_scale_rotation is None:
        raise InputError("fitted_motion: expected a prediction with uncertainty.")
    log_scale = output.log_scale_rotation
    inputs = on_grid_of(log_scale, inputs)
    if tuple(log_scale.shape[2:]) != inputs.size:
        log_scale = F.interpolate(log_scale, inputs.size, mode="nearest")
    f_prev, f_curr = (
        K.diagonal(dim1=1, dim2=2)[:, :2, None, None] for K in (inputs.K_prev, inputs.K_curr)
    )
    c_prev, c_curr = (K[:, :2, 2, None, None] for K in (inputs.K_prev, inputs.K_curr))
    target = (inputs.rays * f_prev + c_prev + inputs.flow_px - c_curr) / f_curr
    return weighted_fit(
        inputs.rays.flatten(2),
        inputs.inverse_depth[:, 0].flatten(1),
        target.flatten(2),
        pixel_weights(log_scale, inputs.valid).flatten(1),
        select_motion(output, selection),
    )


def on_grid_of(prediction: torch.Tensor, inputs: NetworkInputs) -> NetworkInputs:
    """Every n-th pixel of the inputs, one for each cell (.., h, w) of a prediction."""
    return inputs.subsample(max(1, round(inputs.size[0] / prediction.shape[-2])))


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
        inverse_depth: (B, N) of the previous frame, 1 / metres; 0 counts as infinitely far.
        target: (B, 2, N) ray plus flow in the current camera, over its focal lengths.
        weights: (B, N), 0 where flow or depth is missing.
        T_start: (B, 4, 4) T_curr_prev.
        iterations: steps of Gauss-Newton.

    Returns:
        (B, 4, 4). Its gradient goes into the weights alone, through the pull of the pixels at the
        solution; pixels far away pull with constant strength there, since a network that has
        settled on a mover would never learn of the world. Where the fit is not finite, or explains
        the weighted median pixel no better than the start, the value is that of ``T_start``.
    """
    with torch.autocast(weights.device.type, enabled=False):
        number = torch.float64 if ray.dtype == torch.float64 else torch.float32
        ray, inverse, target, weights = (
            torch.nan_to_num(x.to(number), 0.0, 0.0, 0.0)
            for x in (ray, inverse_depth, target, weights)
        )
        # The nearest tenth sets the unit of length, so that rotations and translations are alike.
        pixels = (ray, inverse, target, inverse.quantile(0.9, dim=1).clamp(min=1e-3)[:, None])
        T = start = se3(T_start.detach().to(number))
        with torch.no_grad():
            step, first = _step(*pixels, weights, T)
            for _ in range(iterations):
                T = left_update(step, T)
                step, last = _step(*pixels, weights, T)
            good = torch.isfinite(T.tensor()).all(dim=1) & (last <= first)
            T = pp.SE3(torch.where(good[:, None], T.tensor(), start.tensor()))
        if weights.requires_grad:
            step, _ = _step(*pixels, weights, T, attached=True)
            # value of the solution, gradient of the step
            T = left_update(step - step.detach(), T)
    return T.matrix().to(T_start.dtype)


def _step(
    ray: torch.Tensor,
    inverse: torch.Tensor,
    target: torch.Tensor,
    unit: torch.Tensor,
    weights: torch.Tensor,
    T: pp.LieTensor,
    attached: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """((B, 6) Gauss-Newton step (translation, rotation), (B,) scale of the residuals).

    ``attached``: the step that carries the gradient: pixels far away pull with constant strength,
    and the gradient is that of the right-hand side alone.
    """
    M = T.matrix()
    moved = M[:, :3, :2] @ ray + M[:, :3, 2:3] + M[:, :3, 3:] * inverse[:, None]
    front = moved[:, 2] > MIN_DEPTH_RATIO
    z = torch.where(front, moved[:, 2], 1.0)
    x, y = moved[:, 0] / z, moved[:, 1] / z
    J = torch.cat(projection_rows(x, y, inverse / (z * unit)), dim=2)  # (B, 6, 2 N)
    residual = target - torch.stack([x, y], dim=1)
    length2 = residual.square().sum(dim=1)
    seen = torch.where(front, weights.detach(), 0.0)
    scale2 = weighted_median(length2[:, ::3], seen[:, ::3], 0.0)[:, None]
    kernel2 = (CUTOFF**2 * scale2).clamp(min=MIN_SCALE**2)
    factor = kernel2 / (kernel2 + length2)
    g = weights * torch.where(front, factor.sqrt() if attached else factor.square(), 0.0)
    total = g.detach().sum(dim=1, keepdim=True)
    enough = (total > 1e-12) & torch.isfinite(total)
    # without weight there is no step and no gradient
    g = torch.where(enough, g / torch.where(enough, total, 1.0), 0.0)
    weighted = J * g.repeat(1, 2)[:, None]
    A = weighted.detach() @ J.transpose(1, 2) + 1e-12 * torch.eye(6).to(J)
    b = (weighted @ residual.flatten(1)[:, :, None])[..., 0]
    step = solve_small(A, b, damping=1e-6)[0].to(b.dtype)
    step = step * (MAX_STEP / step.detach().norm(dim=1, keepdim=True)).clamp(max=1.0)
    return torch.cat([step[:, :3] / unit, step[:, 3:]], dim=1), scale2[:, 0].sqrt()
