"""Camera geometry and rigid motions in torch, on kornia and pypose."""

from __future__ import annotations

import warnings
from typing import Any

import torch

from hybridvo.core.errors import InputError

try:
    with warnings.catch_warnings():
        # both packages warn of their own use of torch.jit while they are loaded
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.simplefilter("ignore", FutureWarning)
        import pypose as pp
        from kornia.geometry.conversions import denormalize_points_with_intrinsics
        from kornia.geometry.depth import unproject_meshgrid
except ModuleNotFoundError as error:
    raise InputError(
        f"the refinement in torch and training need {error.name}: "
        "pip install 'hybridvo[train]'."
    ) from None

# Valid depth lies between these, metres, as in the numba kernels.
MIN_DEPTH = 1e-6
MAX_DEPTH = 1e9
# Squared angle x below which these power series of x are used, rad^2.
SMALL_ANGLE_SQUARED = 1e-2
# (3, 9): a vector times it is the matrix, row by row, of the cross product with that vector.
CROSS = torch.tensor(
    [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ]
)
# sin(angle / 2) / angle, cos(angle / 2), (1 - cos(angle)) / x, (angle - sin(angle)) / angle^3
HALF_SINE = (1 / 2, -1 / 48, 1 / 3840, -1 / 645120)
HALF_COSINE = (1.0, -1 / 8, 1 / 384, -1 / 46080)
FIRST_OF_V = (1 / 2, -1 / 24, 1 / 720, -1 / 40320)
SECOND_OF_V = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880)


def rays(height: int, width: int, K: torch.Tensor) -> torch.Tensor:
    """Return K^-1 (u, v, 1) of every pixel, (B, H, W, 3), for intrinsics (B, 3, 3)."""
    return unproject_meshgrid(height, width, K, device=K.device, dtype=K.dtype)


def pixel_grid(height: int, width: int, like: torch.Tensor) -> torch.Tensor:
    """Return the coordinates (u, v) of the pixel centres, (H, W, 2), in the type of ``like``."""
    rows = torch.arange(height, dtype=like.dtype, device=like.device)
    columns = torch.arange(width, dtype=like.dtype, device=like.device)
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def se3(T: Any) -> pp.LieTensor:
    """Return the pypose SE3 (..., 7) of matrices (..., 4, 4), with the nearest rotations."""
    U, _, Vh = torch.linalg.svd(T[..., :3, :3])
    flip = torch.linalg.det(U @ Vh)[..., None, None]
    T = T.clone()
    T[..., :3, :3] = torch.cat([U[..., :2], U[..., 2:] * flip], dim=-1) @ Vh
    return pp.mat2SE3(T, check=False)


def left_update(delta: torch.Tensor, T: pp.LieTensor) -> pp.LieTensor:
    """Return Exp(delta) T for tangents (B, 6) (translation, rotation) and pypose SE3 (B, 7).

    Without a gradient it is the closed form: pypose's ``Exp`` and product take some times as
    long, in every step of a solver. Their gradients are tangents, so that with one both are
    pypose's.
    """
    if _needs_gradient(delta, T):
        return pp.se3(delta).Exp() @ T
    rho, phi = delta.split(3, dim=-1)
    squared = phi.square().sum(dim=-1, keepdim=True)
    is_small = squared < SMALL_ANGLE_SQUARED
    safe = torch.where(is_small, 1.0, squared)
    angle = safe.sqrt()
    sine = (angle / 2).sin()
    half_sine = torch.where(is_small, _series(squared, HALF_SINE), sine / angle)
    w = torch.where(is_small, _series(squared, HALF_COSINE), (angle / 2).cos())
    # V = I + a [phi] + b [phi]^2 takes rho to the translation
    a = torch.where(
        is_small, _series(squared, FIRST_OF_V), 2 * sine.square() / safe
    )
    b = torch.where(
        is_small,
        _series(squared, SECOND_OF_V),
        (angle - angle.sin()) / (safe * angle),
    )
    turned = torch.linalg.cross(phi, rho)
    shift = rho + a * turned + b * torch.linalg.cross(phi, turned)

    x = half_sine * phi
    place, y, v = T.tensor().split([3, 3, 1], dim=-1)
    # the product of the quaternions (x, w) and (y, v)
    vector = w * y + v * x + torch.linalg.cross(x, y)
    scalar = w * v - (x * y).sum(dim=-1, keepdim=True)
    length = torch.cat([vector, scalar], dim=-1).norm(dim=-1, keepdim=True)
    cross = 2 * torch.linalg.cross(x, place)
    moved = place + w * cross + torch.linalg.cross(x, cross) + shift
    return pp.SE3(torch.cat([moved, vector / length, scalar / length], dim=-1))


def _needs_gradient(*tensors: torch.Tensor) -> bool:
    return torch.is_grad_enabled() and any(x.requires_grad for x in tensors)


def _series(x: torch.Tensor, coefficients: tuple[float, ...]) -> torch.Tensor:
    """Power series of x."""
    total = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        total = coefficient + x * total
    return total


def to_matrix(T: pp.LieTensor) -> torch.Tensor:
    """Return the matrices (..., 4, 4) of pypose SE3 (..., 7); faster than ``T.matrix()``."""
    if _needs_gradient(T):
        return T.matrix()
    t, q, w = T.tensor().split([3, 3, 1], dim=-1)
    cross = (q @ CROSS.to(q)).unflatten(-1, (3, 3))
    unit = torch.eye(4, dtype=q.dtype, device=q.device)
    R = unit[:3, :3] + 2 * (w[..., None] * cross + cross @ cross)
    top = torch.cat([R, t[..., None]], dim=-1)
    last = unit[3:].expand(*t.shape[:-1], 1, 4)
    return torch.cat([top, last], dim=-2)


def move(T: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Transform points (B, 3, N) by (B, 4, 4); pypose's ``Act`` takes 20 times as long."""
    return torch.baddbmm(T[:, :3, 3:], T[:, :3, :3], points)


def to_pixels(ab: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """Project X/Z and Y/Z (B, 2, N) into cameras (B, 3, 3): (B, 2, N) px."""
    return denormalize_points_with_intrinsics(ab.transpose(1, 2), K).transpose(1, 2)


def reproject(
    depth: torch.Tensor,
    T: torch.Tensor,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor,
    min_depth: float = MIN_DEPTH,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Project the pixels of the previous frame into the current one: x + ego flow.

    Args:
        depth: (B, H, W) of the previous frame, metres.
        T: (B, 4, 4) T_curr_prev.
        K_prev: (B, 3, 3) intrinsics of the previous camera.
        K_curr: (B, 3, 3) intrinsics of the current camera.
        min_depth: metres; nearer points are not valid.

    Returns:
        (B, H, W, 2) px, always finite; (B, H, W) whether depth is valid and the point farther than
        ``min_depth``; (B, H, W) its depth in the current camera, 1 where depth is not valid.
    """
    height, width = depth.shape[1:]
    valid = (depth > 0) & (depth < MAX_DEPTH)
    with torch.autocast(depth.device.type, enabled=False):
        safe = torch.where(valid, depth, 1.0)
        points = rays(height, width, K_prev) * safe[..., None]
        moved = move(T, points.flatten(1, 2).transpose(1, 2))
        z = torch.where(valid, moved[:, 2].unflatten(1, (height, width)), 1.0)
        front = z >= min_depth
        # before the division: a masked quotient would still give NaN gradients
        ahead = torch.where(front, z, 1.0).flatten(1)[:, None]
        pixels = to_pixels(moved[:, :2] / ahead, K_curr)
    return pixels.transpose(1, 2).unflatten(1, (height, width)), valid & front, z
