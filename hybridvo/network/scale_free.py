"""Inputs without units: one network for a desk and a street, for a slow and a fast camera.

Twice the flow is twice the motion, and a scene twice as large moves by twice as many metres: the
network need not learn that if its inputs are divided by the pair's own scales and its outputs are
multiplied by them. To first order in the motion nothing is lost: over the focal length, flow is
rotation + translation / depth.

The same network then refines its own answer: what the flow and the second depth leave unexplained
after a first motion is, to first order, the flow of the motion that is missing, and over its own
scale it looks like any other pair. What moves by itself stands out in it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from hybridvo.network.inputs import NetworkInputs

__all__ = ["MotionScale", "euler_deg", "remove_scale"]

SMALLEST_MOTION = 5e-5
"""rad; flow smaller than this is not amplified any further: at 2000 px of focal length 0.1 px."""

QUANTILE = 0.4
"""Of the lengths of the flow: below one half, so that movers on half of the picture do not set the
scale of what is left of the world."""

NEAR_QUANTILE = 0.9
"""Of the inverse depth: near things tell the translation, and set its scale."""

FARTHEST = 50.0
"""Metres; where all is farther, flow tells no translation, and a camera still moves by metres."""

LIMIT = 10.0
"""Magnitude that squashed values approach; values of the order of one stay as they are."""

LOCKED, LARGEST_SINE = 1e-12, 1 - 1e-6
"""Squared cosine of the middle angle below which it counts as a quarter turn, and the largest sine
whose angle has a slope that is worth following."""

NEAREST = 1e-2
"""Metres; a moved point nearer than this, or behind the camera, has no residual."""


@dataclass(frozen=True, eq=False)
class MotionScale:
    """What turns a network's scale-free outputs into motions.

    Args:
        factor: (B, 6) scales of rx, ry, rz (degrees) and tx, ty, tz (metres).
        start: (B, 6) the motion that was taken out of the inputs, in the same units.
    """

    factor: torch.Tensor
    start: torch.Tensor


def euler_deg(R: torch.Tensor) -> torch.Tensor:
    """(B, 3) Euler angles X-Y-Z in degrees of rotations (B, 3, 3) = Rx Ry Rz; finite gradient."""
    # a quarter turn about y leaves only the sum or difference of the others: rz = 0 there, and no
    # 0 / 0 in the gradient
    locked = R[:, 0, 0] ** 2 + R[:, 0, 1] ** 2 < LOCKED
    one, zero = torch.ones_like(R[:, 0, 0]), torch.zeros_like(R[:, 0, 0])
    angles = (
        torch.atan2(
            torch.where(locked, R[:, 2, 1], -R[:, 1, 2]),
            torch.where(locked, R[:, 1, 1], R[:, 2, 2]),
        ),
        torch.asin(R[:, 0, 2].clamp(-LARGEST_SINE, LARGEST_SINE)),
        torch.atan2(torch.where(locked, zero, -R[:, 0, 1]), torch.where(locked, one, R[:, 0, 0])),
    )
    return torch.rad2deg(torch.stack(angles, dim=1))


def remove_scale(
    inputs: NetworkInputs, T_start: torch.Tensor | None = None, later_quantile: float = QUANTILE
) -> tuple[NetworkInputs, MotionScale]:
    """Take a first motion out of a batch's inputs and divide them by the scales of each pair.

    Args:
        inputs: of size (h, w).
        T_start: (B, 4, 4) T_curr_prev of the first motion; none by default.
        later_quantile: of the lengths of the flow that sets the scale of the pairs whose first
            motion is not the identity.

    Returns:
        Inputs whose ``flow`` is what the flow leaves unexplained, over the focal length and over
        its own typical length m, ``inverse_depth[:, 0]`` the inverse depth over that of the near
        things, ``inverse_depth[:, 1]`` what the second depth leaves unexplained, in log depth over
        m (0 where either depth is missing), all squashed at 10; and the scales: m as an angle, and
        m times the depth of the near things. Pixels without depth count as infinitely far. Finite
        for any input.
    """
    focal = torch.stack([inputs.K_prev[:, 0, 0], inputs.K_prev[:, 1, 1]], dim=1)[:, :, None, None]
    inverse = torch.nan_to_num(inputs.inverse_depth, 0.0, 0.0, 0.0)
    flow = torch.nan_to_num(inputs.flow_px, 0.0, 0.0, 0.0)
    both = (inverse > 0).all(dim=1, keepdim=True)
    safe = torch.where(both, inverse, torch.ones_like(inverse))
    start = torch.zeros(len(inputs), 6, dtype=flow.dtype, device=flow.device)
    change = safe[:, :1].log() - safe[:, 1:].log()
    quantile = torch.full((len(inputs), 1), QUANTILE, dtype=flow.dtype, device=flow.device)
    if T_start is not None:
        T_start = T_start.to(flow.dtype)
        start = torch.cat([euler_deg(T_start[:, :3, :3]), T_start[:, :3, 3]], dim=1)
        quantile = torch.where((start != 0).any(dim=1, keepdim=True), later_quantile, quantile)
        ego, log_ratio = _ego_motion(inputs, inverse[:, 0], T_start)
        # No flow was measured where it is exactly zero in both components and the pixel is invalid.
        seen = inputs.valid[:, None] | (flow != 0).any(dim=1, keepdim=True)
        flow = torch.where(seen, flow - ego, flow)
        change = change - log_ratio
    change = torch.where(both, change, torch.zeros_like(change))
    angle = flow / focal
    length = (angle.square().sum(dim=1) + 1e-20).sqrt()
    motion = _quantile(length, inputs.valid, quantile, 1.0).clamp(SMALLEST_MOTION, 1.0)
    nearness = _quantile(
        inverse[:, 0],
        inputs.valid & (inverse[:, 0] > 0),
        torch.full_like(quantile, NEAR_QUANTILE),
        1.0,
    )
    nearness = nearness.clamp(FARTHEST**-1, 1e3)
    m = motion[:, None, None, None]
    depth = torch.cat(
        [_squash(inverse[:, :1] / nearness[:, None, None, None]), _squash(change / m)], dim=1
    )
    factor = torch.stack([torch.rad2deg(motion), motion / nearness], dim=1)
    scale = MotionScale(factor.repeat_interleave(3, dim=1), start)
    return replace(inputs, flow=_squash(angle / m), inverse_depth=depth), scale


def _ego_motion(
    inputs: NetworkInputs, inverse: torch.Tensor, T: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """((B, 2, h, w) px, (B, 1, h, w)) flow and change of log depth that a motion causes; zero where
    the moved point is behind the camera.
    """
    rays = torch.cat([inputs.rays, torch.ones_like(inputs.rays[:, :1])], dim=1)
    # Over its depth, a point is ray + translation * inverse depth: finite for the farthest.
    moved = torch.einsum("bij,bjhw->bihw", T[:, :3, :3], rays)
    moved = moved + T[:, :3, 3, None, None] * inverse[:, None]
    limit = NEAREST * inverse.clamp(min=1e-3)
    front = moved[:, 2] > limit
    z = torch.where(front, moved[:, 2], torch.ones_like(limit))[:, None]
    K_prev, K_curr = inputs.K_prev, inputs.K_curr

    def pixels(K: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        focal = torch.stack([K[:, 0, 0], K[:, 1, 1]], dim=1)[:, :, None, None]
        return focal * x + K[:, :2, 2, None, None]

    flow = pixels(K_curr, moved[:, :2] / z) - pixels(K_prev, inputs.rays)
    flow = torch.where(front[:, None], flow, torch.zeros_like(flow))
    return flow, torch.where(front[:, None], z.log(), torch.zeros_like(z))


def _squash(x: torch.Tensor) -> torch.Tensor:
    return x / (1 + x.abs() / LIMIT)


def _quantile(
    x: torch.Tensor, mask: torch.Tensor, q: torch.Tensor, fallback: float
) -> torch.Tensor:
    """(B,) quantile (B, 1) of a (B, h, w) map over a mask; ``fallback`` where that is empty."""
    pick = (..., slice(None, None, 2), slice(None, None, 2))  # enough for a scale
    kept = torch.where(mask, x, torch.full_like(x, torch.nan))[pick].flatten(1)
    # NaN sort to the end; linear between neighbours as in numpy
    ordered = kept.sort(dim=1).values
    count = (~kept.isnan()).sum(dim=1, keepdim=True)
    place = q * (count - 1).clamp(min=0)
    low = place.floor().long()
    high = torch.minimum(low + 1, (count - 1).clamp(min=0))
    a, b = ordered.gather(1, low), ordered.gather(1, high)
    value = (a + (place - low) * (b - a))[:, 0]
    return torch.nan_to_num(value, fallback, fallback, fallback)
