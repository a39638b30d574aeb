"""The photometric polish of a batch of pairs in torch: CPU or GPU, differentiable.

The twin of :mod:`hybridvo.refinement.photometric_kernels` and
:mod:`hybridvo.refinement.photometric_problem`;
a test holds residuals, Jacobians and normal equations equal. Samples never see each other. The
gradient is that of the estimating equation at its root (implicit function theorem, see
:mod:`hybridvo.pose.implicit`): one more Newton step is taken with its matrix held.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from hybridvo.errors import InputError
from hybridvo.pose.implicit import solve_small
from hybridvo.pose.pixels import MAX_VALUE, MIN_DEPTH
from hybridvo.pose.residuals import left_update
from hybridvo.refinement.photometric_options import PhotometricOptions

__all__ = ["PhotometricBatch", "PhotometricPixels", "photometric_terms", "polish_photometric_batch"]

MARGIN = 3
NOISE_FLOOR = 0.1
LEAST_AREA = 1e-3
STEPS = 40
TOLERANCE = 1e-6
"""Squared length, in deviations, of the last step: gradients need the root itself."""


@dataclass(frozen=True, eq=False)
class PhotometricPixels:
    """Chosen pixels of the previous pictures, each (B, N).

    Args:
        ray_x, ray_y: normalised coordinates. depth: metres. grey, gradient_x, gradient_y: of the
            picture. weight: 0 where not used.
    """

    ray_x: torch.Tensor
    ray_y: torch.Tensor
    depth: torch.Tensor
    grey: torch.Tensor
    gradient_x: torch.Tensor
    gradient_y: torch.Tensor
    weight: torch.Tensor


@dataclass(frozen=True, eq=False)
class PhotometricBatch:
    """Polished motions.

    Args:
        T_curr_prev: (B, 4, 4); that of the flow where the polish failed. Carries the gradient.
        information: (B, 6, 6) of images and flow together, no gradient.
        gain, offset, noise: (B,) of the pictures. taken: (B,) bool.
    """

    T_curr_prev: torch.Tensor
    information: torch.Tensor
    gain: torch.Tensor
    offset: torch.Tensor
    noise: torch.Tensor
    taken: torch.Tensor


def read_cubic(image: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """(B, N) values of (B, H, W) pictures at (u, v) by cubic convolution with a = -1/2."""
    height, width = image.shape[1:]
    iu, iv = u.detach().floor().long(), v.detach().floor().long()
    x, y = _taps(u - iu), _taps(v - iv)
    flat = image.flatten(1)
    total = torch.zeros_like(u)
    for j in range(4):
        row = (iv + j - 1).clamp(0, height - 1) * width
        for i in range(4):
            total = total + y[j] * x[i] * flat.gather(1, row + (iu + i - 1).clamp(0, width - 1))
    return total


def _taps(f: torch.Tensor) -> tuple[torch.Tensor, ...]:
    f2, f3 = f * f, f * f * f
    return (
        0.5 * (-f3 + 2 * f2 - f),
        0.5 * (3 * f3 - 5 * f2 + 2),
        0.5 * (-3 * f3 + 4 * f2 + f),
        0.5 * (f3 - f2),
    )


def photometric_terms(
    pixels: PhotometricPixels,
    image: torch.Tensor,
    T: torch.Tensor,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor,
    gain: torch.Tensor,
    offset: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Residual, its Jacobian, its sensitivity to log depth, and whether it is seen.

    Args:
        pixels: of the previous pictures.
        image: (B, H, W) current grey pictures.
        T: (B, 4, 4).
        K_prev: (B, 3, 3).
        K_curr: (B, 3, 3).
        gain: (B,) of the current picture.
        offset: (B,).

    Returns:
        r (B, N); J (B, 8, N) for translation, rotation, gain, offset; G^T q (B, N); seen (B, N)
        bool. Unseen pixels hold zeros.
    """
    height, width = image.shape[1:]
    e = T[:, :, :, None].unbind(dim=1)
    x, y, z = pixels.ray_x, pixels.ray_y, pixels.depth
    X, Y, Z = (z * (row[:, 0] * x + row[:, 1] * y + row[:, 2]) + row[:, 3] for row in e[:3])
    front = Z > MIN_DEPTH
    i = 1.0 / torch.where(front, Z, torch.ones_like(Z))
    a, b = X * i, Y * i
    fx, fy, cx, cy = (K_curr[:, r, c, None] for r, c in ((0, 0), (1, 1), (0, 2), (1, 2)))
    px, py = K_prev[:, 0, 0, None], K_prev[:, 1, 1, None]
    u, v = fx * a + cx, fy * b + cy
    s = z * i
    w00 = s * fx / px * (e[0][:, 0] - a * e[2][:, 0])
    w01 = s * fx / py * (e[0][:, 1] - a * e[2][:, 1])
    w10 = s * fy / px * (e[1][:, 0] - b * e[2][:, 0])
    w11 = s * fy / py * (e[1][:, 1] - b * e[2][:, 1])
    area = w00 * w11 - w01 * w10
    seen = front & (u > MARGIN - 1) & (u < width - MARGIN) & (v > MARGIN - 1)
    seen = seen & (v < height - MARGIN) & (area > LEAST_AREA)
    zero = torch.zeros_like(u)
    inner = torch.full_like(u, float(MARGIN))
    value = read_cubic(image, torch.where(seen, u, inner), torch.where(seen, v, inner))
    r = torch.where(seen, value - gain[:, None] * pixels.grey - offset[:, None], zero)
    f = gain[:, None] / torch.where(seen, area, torch.ones_like(area))
    gx = f * (w11 * pixels.gradient_x - w10 * pixels.gradient_y)
    gy = f * (w00 * pixels.gradient_y - w01 * pixels.gradient_x)
    tx, ty, tz = (row[:, 3] for row in e[:3])
    gq = gx * fx * i * (a * tz - tx) + gy * fy * i * (b * tz - ty)
    gx, gy = gx * fx, gy * fy
    J = torch.stack(
        [
            gx * i,
            gy * i,
            -(gx * a + gy * b) * i,
            -(gx * a * b + gy * (1 + b * b)),
            gx * (1 + a * a) + gy * a * b,
            gy * a - gx * b,
            -pixels.grey,
            -torch.ones_like(a),
        ],
        dim=1,
    )
    return r, torch.where(seen[:, None], J, zero[:, None]), torch.where(seen, gq, zero), seen


def photometric_weights(
    r: torch.Tensor,
    gq: torch.Tensor,
    seen: torch.Tensor,
    weight: torch.Tensor,
    noise: torch.Tensor,
    depth_noise: torch.Tensor,
    cutoff: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """((B, N) robust weight x weight / variance, (B,) robust cost); ``noise`` (B,) grey levels."""
    variance = noise[:, None].square() + (depth_noise[:, None] * gq).square()
    d2 = r.square() / variance
    c2 = cutoff**2
    robust = c2 / (c2 + d2)
    w = torch.where(seen, weight * robust.square() / variance, torch.zeros_like(r))
    return w, 0.5 * (weight * torch.where(seen, robust * d2, torch.full_like(d2, c2))).sum(dim=1)


def gather_photometric(
    grey: torch.Tensor,
    depth: torch.Tensor,
    weights: torch.Tensor,
    K: torch.Tensor,
    options: PhotometricOptions,
    count: int = 4,
) -> PhotometricPixels:
    """The strongest gradients of evenly spread cells, from (B, H, W) pictures."""
    batch, height, width = grey.shape
    cell = max(2, round((height * width * count / options.pixels) ** 0.5))
    valid = (depth > MIN_DEPTH) & (depth < MAX_VALUE) & (weights >= options.least_weight)
    gx, gy = torch.zeros_like(grey), torch.zeros_like(grey)
    gx[:, :, 1:-1] = 0.5 * (grey[:, :, 2:] - grey[:, :, :-2])
    gy[:, 1:-1] = 0.5 * (grey[:, 2:] - grey[:, :-2])
    inner = torch.zeros_like(valid)
    inner[:, MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    strength = torch.where(valid & inner, gx.square() + gy.square(), torch.zeros_like(gx)).detach()
    pad = (0, -(width - 2 * MARGIN) % cell, 0, -(height - 2 * MARGIN) % cell)
    padded = F.pad(strength[:, MARGIN:-MARGIN, MARGIN:-MARGIN], pad)
    rows, columns = padded.shape[1] // cell, padded.shape[2] // cell
    cells = padded.reshape(batch, rows, cell, columns, cell).transpose(2, 3).flatten(3)
    best, place = cells.topk(min(count, cell * cell), dim=3)
    v = torch.arange(rows, device=grey.device)[:, None, None] * cell + place // cell + MARGIN
    u = torch.arange(columns, device=grey.device)[None, :, None] * cell + place % cell + MARGIN
    u, v = u.flatten(1).clamp(max=width - 1), v.flatten(1).clamp(max=height - 1)
    flat = v * width + u
    used = best.flatten(1) > 0

    def at(values: torch.Tensor, instead: float) -> torch.Tensor:
        picked = values.flatten(1).gather(1, flat)
        return torch.where(used, picked, torch.full_like(picked, instead))

    fx, fy, cx, cy = (K[:, r, c, None] for r, c in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return PhotometricPixels(
        (u - cx) / fx, (v - cy) / fy, at(depth, 1.0), at(grey, 0.0), at(gx, 0.0), at(gy, 0.0),
        at(weights, 0.0),
    )  # fmt: skip


def _noise_scale(r: torch.Tensor, used: torch.Tensor) -> torch.Tensor:
    """(B,) 1.4826 median |r| of the pixels used."""
    lengths = torch.where(used, r.detach().abs(), torch.full_like(r, torch.inf)).sort(dim=1).values
    middle = (used.sum(dim=1, keepdim=True) // 2).clamp(max=r.shape[1] - 1)
    scale = 1.4826 * lengths.gather(1, middle)[:, 0]
    return torch.where(torch.isfinite(scale), scale, torch.ones_like(scale)).clamp(min=NOISE_FLOOR)


def polish_photometric_batch(
    grey_prev: torch.Tensor,
    grey_curr: torch.Tensor,
    depth: torch.Tensor,
    K_prev: torch.Tensor,
    K_curr: torch.Tensor,
    T_flow: torch.Tensor,
    covariance: torch.Tensor,
    weights: torch.Tensor,
    depth_noise: torch.Tensor | None = None,
    options: PhotometricOptions | None = None,
) -> PhotometricBatch:
    """Motions of a batch of pairs, sharpened by their pictures.

    One scale: blur the pictures first (:class:`PhotometricOptions` ``blur_px``), and take 128 off
    their grey values. The guard of the single-pair path is reduced to what a training needs: a
    sample whose solve fails or leaves what the flow allows keeps the motion of the flow.

    Args:
        grey_prev: (B, H, W) grey values.
        grey_curr: (B, H, W).
        depth: (B, H, W) metres of the previous frame.
        K_prev: (B, 3, 3).
        K_curr: (B, 3, 3).
        T_flow: (B, 4, 4) T_curr_prev of the flow.
        covariance: (B, 6, 6) of its left perturbation.
        weights: (B, H, W) in [0, 1].
        depth_noise: (B,) standard deviation of log depth; default 0.
        options: see :class:`PhotometricOptions`.

    Raises:
        InputError: shapes that do not fit together.
    """
    options = options or PhotometricOptions()
    shape = tuple(grey_prev.shape)
    batch = shape[0]
    for name, value, expected in (
        ("grey_prev", grey_prev, (batch, *shape[1:3])), ("grey_curr", grey_curr, shape),
        ("depth", depth, shape), ("weights", weights, shape), ("K_prev", K_prev, (batch, 3, 3)),
        ("K_curr", K_curr, (batch, 3, 3)), ("T_flow", T_flow, (batch, 4, 4)),
        ("covariance", covariance, (batch, 6, 6)),
    ):  # fmt: skip
        if tuple(value.shape) != tuple(expected):
            raise InputError(
                f"polish_photometric_batch: expected {name} of shape {tuple(expected)}, "
                f"got {tuple(value.shape)}."
            )
    if depth_noise is None:
        depth_noise = torch.zeros(batch, dtype=depth.dtype, device=depth.device)
    pixels = gather_photometric(grey_prev, depth, weights, K_prev, options)
    prior = torch.linalg.pinv(covariance.detach().double() * options.flow_inflation, hermitian=True)

    def equations(
        T: torch.Tensor, light: torch.Tensor, noise: torch.Tensor, T0: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """(H (B, 8, 8), g (B, 8), cost) of images and flow, gradient kept."""
        r, J, gq, seen = photometric_terms(pixels, grey_curr, T, K_prev, K_curr, *light.unbind(1))
        w, cost = photometric_weights(
            r, gq, seen, pixels.weight, noise, depth_noise, options.cutoff
        )
        xi = _log(T, T0)
        d2 = torch.einsum("bi,bij,bj->b", xi, prior, xi)
        pull = ((options.freedom + 6) / (options.freedom + d2))[:, None, None] * prior
        share = 1.0 / options.image_inflation
        weighted = J * w[:, None]
        H = share * (weighted @ J.transpose(1, 2)).double()
        g = -share * (weighted @ r[:, :, None])[:, :, 0].double()
        H = H + F.pad(pull, (0, 2, 0, 2))
        g = g - F.pad((pull @ xi[:, :, None])[:, :, 0], (0, 2))
        total = share * cost.double() + 0.5 * (options.freedom + 6) * torch.log1p(
            d2 / options.freedom
        )
        return H, g, total, r, seen

    with torch.no_grad():
        T = T_flow.detach().clone()
        light = torch.zeros(batch, 2, dtype=depth.dtype, device=depth.device)
        light[:, 0] = 1.0
        noise = torch.ones(batch, dtype=depth.dtype, device=depth.device)
        for step in range(STEPS):
            if step < 4:
                r, _, _, seen = photometric_terms(
                    pixels, grey_curr, T, K_prev, K_curr, *light.unbind(1)
                )
                noise = _noise_scale(r, seen & (pixels.weight > 0))
            H, g, *_ = equations(T, light, noise, T_flow)
            if step < 2:  # light before motion
                delta = torch.zeros_like(g)
                delta[:, 6:], good = solve_small(H[:, 6:, 6:], g[:, 6:])
            else:
                delta, good = solve_small(H, g)
            delta = torch.where(good[:, None], delta, torch.zeros_like(delta))
            T = left_update(delta[:, :6].to(T.dtype), T)
            light = light + delta[:, 6:].to(light.dtype)
            if step > 4 and bool(((delta * g).sum(dim=1) < TOLERANCE).all()):
                break
        H, g, *_ = equations(T, light, noise, T_flow)
        xi = _log(T, T_flow)
        sigma2 = torch.einsum("bi,bij,bj->b", xi, prior, xi)
        left = (g * solve_small(H, g)[0]).sum(dim=1)
        taken = torch.isfinite(T).flatten(1).all(1) & (sigma2 < options.largest_shift**2)
        taken = taken & (left < 1e-2)
        usable = (pixels.weight > 0).sum(dim=1) >= options.least_pixels
        taken = taken & usable & torch.isfinite(H).flatten(1).all(1)
        T = torch.where(taken[:, None, None], T, T_flow.detach())
    inputs = (grey_prev, grey_curr, depth, T_flow, weights, K_prev, K_curr)
    if torch.is_grad_enabled() and any(value.requires_grad for value in inputs):
        A = _full_derivative(equations, T, light, noise, T_flow.detach())
        _, g, *_ = equations(T, light, noise, T_flow)
        root, solved = solve_small(A, g)
        move = root[:, :6] * (taken & solved)[:, None]
        # the value stays that of the solver
        move = (move - move.detach()).to(T.dtype)
        T = torch.where(taken[:, None, None], left_update(move, T), T_flow)
    light_block = _motion_information(H)
    return PhotometricBatch(T, light_block, light[:, 0], light[:, 1], noise, taken)


def _full_derivative(
    equations: Callable[..., tuple[torch.Tensor, ...]],
    T: torch.Tensor,
    light: torch.Tensor,
    noise: torch.Tensor,
    T0: torch.Tensor,
) -> torch.Tensor:
    """-dg / d(motion, light) at the root, (B, 8, 8)."""
    with torch.enable_grad():
        x = torch.zeros(T.shape[0], 8, dtype=T.dtype, device=T.device, requires_grad=True)
        _, g, *_ = equations(left_update(x[:, :6], T.detach()), light + x[:, 6:], noise, T0)
        rows = [torch.autograd.grad(g[:, k].sum(), x, retain_graph=True)[0] for k in range(8)]
    return -torch.stack(rows, dim=1).double().detach()


def _log(T: torch.Tensor, T0: torch.Tensor) -> torch.Tensor:
    """(B, 6) float64 left tangent from T0 to T, for angles below a right one.

    Written out: the gradient that pypose gives to ``Log`` lives in the tangent space, and would be
    taken for that of the matrix.
    """
    relative = T.double() @ torch.linalg.inv(T0.double())
    R, t = relative[:, :3, :3], relative[:, :3, 3]
    axis = 0.5 * torch.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], dim=1
    )
    sine2 = axis.square().sum(dim=1, keepdim=True)
    small = sine2 < 1e-8
    sine = torch.where(small, torch.full_like(sine2, 0.1), sine2).sqrt()
    theta = sine.asin()
    phi = axis * torch.where(small, 1 + sine2 / 6, theta / sine)
    theta2 = phi.square().sum(dim=1, keepdim=True)
    c = torch.where(small, 1 / 12 + theta2 / 720, theta**-2 - 0.5 / (theta * (0.5 * theta).tan()))
    turned = torch.linalg.cross(phi, t)
    return torch.cat([t - 0.5 * turned + c * torch.linalg.cross(phi, turned), phi], dim=1)


def _motion_information(H: torch.Tensor) -> torch.Tensor:
    """(B, 6, 6) information of the motion with gain and offset free."""
    light = torch.linalg.pinv(H[:, 6:, 6:], hermitian=True)
    return H[:, :6, :6] - H[:, :6, 6:] @ light @ H[:, 6:, :6]
