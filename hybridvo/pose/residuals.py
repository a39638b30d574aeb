"""Ego-flow reprojection residuals of a batch of pairs in torch: the twin of the numba kernels.

Per pixel, with X' = T X, a = X'/Z', b = Y'/Z', i = 1/Z' (the definition of
:mod:`hybridvo.pose.kernels`; a test holds the Gauss-Newton steps of both equal):

- residual r = (x + F) - pi(X') in px, predicted by the pose (paper, equations 6 and 8);
- Jacobian of the prediction with respect to the left perturbation (translation, rotation):
  diag(fx, fy) [[i, 0, -a i, -a b, 1 + a^2, -b], [0, i, -b i, -(1 + b^2), a b, a]];
- u = q = d pi(X') / d log Z = (fx i (a tz - tx), fy i (b tz - ty));
- covariance Sigma = diag(sf^2 v_f, sf^2 v_f) + sd^2 v_d u u^T.

With the second depth a third row joins, r_z = log D_curr(x + F) - log Z'. A left perturbation moves
Z' by dZ' = rho_z + phi_x Y' - phi_y X', so its Jacobian is [0, 0, i, b, -a, 0]; the first depth acts
through Z' = Z (R K^-1 x)_z + tz, so d log Z' / d log Z = (Z' - tz) / Z' = 1 - tz i =: h. The noise of
the first depth is common to all three rows: u = (q, h), and Sigma = diag(sf^2 v_f, sf^2 v_f, sz^2) +
sd^2 v_d u u^T. What the flow noise does to the place where D_curr is sampled is left out.

Sigma is inverted by the rank-one identity: with D the inverse of the diagonal, Sigma^-1 =
D - kappa (D u)(D u)^T, kappa = sd^2 v_d / (1 + sd^2 v_d u^T D u). A pixel without a second depth has
a zero in D and loses that row alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import pypose as pp
import torch
from kornia.geometry.camera import project_points
from kornia.geometry.depth import depth_to_3d_v2, unproject_meshgrid

from hybridvo.errors import InputError
from hybridvo.pose import kernels
from hybridvo.types import PairBatch

__all__ = [
    "CUTOFFS",
    "KERNELS",
    "NormalEquations",
    "Pixels",
    "Terms",
    "gather_pixels",
    "jacobian",
    "left_update",
    "normal_equations",
    "pose_to_matrix",
    "reproject",
    "residual_terms",
    "robust_cost",
    "robust_weight",
    "sample_depth",
    "score_sum",
]

KERNELS = ("geman-mcclure", "huber", "cauchy", "l2")
CUTOFFS = {"geman-mcclure": 3.0, "huber": 1.345, "cauchy": 2.385, "l2": 1.0}
"""Default cutoff c in standard deviations: 3 as in the numba solver; the 95 % efficient ones for
Huber and Cauchy (P. J. Huber, Robust Statistics; one-dimensional Gaussian noise)."""

MIN_DEPTH = float(kernels.MIN_DEPTH)
MAX_VALUE = float(kernels.MAX_VALUE)
LOST_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""
NEIGHBOUR_AGREEMENT = 1.05
"""Largest ratio of the four depths around a sampling point; beyond it lies an edge."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of a batch as the solver takes them, all (B, N); unusable ones have weight 0.

    Args:
        ray_x, ray_y: K_prev^-1 x. depth: metres. target_u, target_v: x + F, px.
        flow_variance, depth_variance: relative to the typical one of the sample.
        weight: external weight, 0 where the pixel cannot be used.
        K: (B, 4) fx, fy, cx, cy of the current camera.
        log_depth_curr: log D_curr(x + F), 0 where absent; None without the second depth.
        has_depth_curr: 1 where it is present, else 0.
    """

    ray_x: torch.Tensor
    ray_y: torch.Tensor
    depth: torch.Tensor
    target_u: torch.Tensor
    target_v: torch.Tensor
    flow_variance: torch.Tensor
    depth_variance: torch.Tensor
    weight: torch.Tensor
    K: torch.Tensor
    log_depth_curr: torch.Tensor | None = None
    has_depth_curr: torch.Tensor | None = None

    def _map(self, change: Any, camera: Any) -> Pixels:
        values = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if value is not None:
                values[item.name] = camera(value) if item.name == "K" else change(value)
        return Pixels(**values)

    def repeat(self, times: int) -> Pixels:
        """Every sample ``times`` times in a row: (B times, N)."""

        def change(value: torch.Tensor) -> torch.Tensor:
            return value.repeat_interleave(times, dim=0)

        return self if times == 1 else self._map(change, change)

    def take(self, index: torch.Tensor, keep: torch.Tensor) -> Pixels:
        """The pixels at ``index`` (B, M); those with ``keep`` False get weight 0."""
        taken = self._map(lambda value: value.gather(1, index), lambda value: value)
        return replace(taken, weight=taken.weight * keep)

    def detach(self) -> Pixels:
        """The same without a graph."""
        return self._map(torch.Tensor.detach, torch.Tensor.detach)


@dataclass(frozen=True, eq=False)
class Terms:
    """What the pose says of every pixel, each (B, N): see the formulas of this module."""

    a: torch.Tensor
    b: torch.Tensor
    i: torch.Tensor
    r: tuple[torch.Tensor, ...]
    u: tuple[torch.Tensor, ...]
    front: torch.Tensor


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Weighted normal equations at a pose; H delta = g is the Gauss-Newton step Exp(delta) T.

    Args:
        H: (B, 6, 6) sum of w J^T Sigma^-1 J. g: (B, 6) sum of w J^T Sigma^-1 r.
        cost: (B,) robust cost, pixels behind the camera at the full one.
        weights: (B, N) robust weights without the external ones, 0 where unusable.
        weight_sum: (B,) sum of robust times external weights.
        distance2: (B, N) squared Mahalanobis distances.
        scores: (B, 6, N) w J^T Sigma^-1 r per pixel where asked for, else None.
        whitening: (D, kappa D u, D u) of the covariance at this pose.
    """

    H: torch.Tensor
    g: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    weight_sum: torch.Tensor
    distance2: torch.Tensor
    scores: torch.Tensor | None
    whitening: tuple[torch.Tensor, ...]


def pose_to_matrix(T: torch.Tensor) -> torch.Tensor:
    """(B, 4, 4) from a pypose SE3 (B, 7: translation, quaternion xyzw) or a (B, 4, 4) tensor.

    Raises:
        InputError: another shape. A missing batch axis would be broadcast in silence.
    """
    if isinstance(T, pp.LieTensor):
        if T.ltype != pp.SE3_type or T.ndim != 2:
            raise InputError(f"T: expected a pypose SE3 of shape (B, 7), got {tuple(T.shape)}.")
        return T.matrix()
    if T.ndim == 2 and T.shape[1] == 7:
        return pp.SE3(T).matrix()
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InputError(f"T: expected shape (B, 4, 4) or (B, 7), got {tuple(T.shape)}.")
    return T


def left_update(delta: torch.Tensor, T: torch.Tensor) -> torch.Tensor:
    """Exp(delta) T for (B, 6) tangents (translation, rotation) and (B, 4, 4) poses."""
    return pp.se3(delta).Exp().matrix() @ T


def reproject(
    depth: torch.Tensor, T: torch.Tensor, K_prev: torch.Tensor, K_curr: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the pixels of the previous frame are seen by the current one.

    Args:
        depth: (B, H, W) metres. T: T_curr_prev, pypose SE3 (B, 7) or (B, 4, 4).
        K_prev, K_curr: (B, 3, 3).

    Returns:
        (B, H, W, 2) px on the current picture and (B, H, W) bool, False where the depth is invalid
        or the point is not in front of the camera; these pixels hold finite values without meaning.

    Raises:
        InputError: shapes that do not fit together.
    """
    if depth.ndim != 3:
        raise InputError(f"reproject: expected depth (B, H, W), got {tuple(depth.shape)}.")
    batch = depth.shape[0]
    T = pose_to_matrix(T)
    for name, value, shape in (
        ("T", T, (batch, 4, 4)),
        ("K_prev", K_prev, (batch, 3, 3)),
        ("K_curr", K_curr, (batch, 3, 3)),
    ):
        if value.shape != shape:
            raise InputError(f"reproject: expected {name} {shape}, got {tuple(value.shape)}.")
    valid = (depth > MIN_DEPTH) & (depth < MAX_VALUE)
    points = depth_to_3d_v2(torch.where(valid, depth, torch.ones_like(depth)), K_prev)
    moved = points @ T[:, None, :3, :3].transpose(-1, -2) + T[:, None, None, :3, 3]
    front = moved[..., 2] > MIN_DEPTH
    moved = torch.where(front[..., None], moved, torch.ones_like(moved))
    return project_points(moved, K_curr[:, None, None]), valid & front


def _typical(variance: torch.Tensor) -> torch.Tensor:
    """(B, 1, 1) median of the positive finite values on a sparse grid; 1 where there are none."""
    sparse = variance.detach()[:, ::7, ::7].flatten(1)
    good = (sparse > 0) & (sparse < MAX_VALUE)
    values = torch.where(good, sparse, torch.full_like(sparse, torch.nan))
    return torch.nan_to_num(torch.nanquantile(values, 0.5, dim=1), nan=1.0)[:, None, None]


def sample_depth(
    depth: torch.Tensor, u: torch.Tensor, v: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Bilinear depth at (u, v), where the four neighbours lie on one surface.

    Args:
        depth: (B, H, W) metres. u, v: (B, N) px; (0, 0) is the centre of the top-left pixel.

    Returns:
        (B, N) metres and (B, N) bool. False (and depth 1) outside the picture, next to an invalid
        depth, and where the four depths differ by more than 5 %. Differentiable in all arguments.
    """
    batch, height, width = depth.shape
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    zero = torch.zeros_like(u)
    u, v = torch.where(inside, u, zero), torch.where(inside, v, zero)
    u0 = u.detach().floor().clamp(max=max(width - 2, 0))
    v0 = v.detach().floor().clamp(max=max(height - 2, 0))
    right = 1 if width > 1 else 0
    below = width if height > 1 else 0
    at = (v0 * width + u0).long()
    flat = depth.reshape(batch, -1)
    corners = torch.stack([flat.gather(1, at + o) for o in (0, right, below, below + right)])
    good = ((corners > MIN_DEPTH) & (corners < MAX_VALUE)).all(dim=0) & inside
    corners = torch.where(good, corners, torch.ones_like(corners))
    good = good & (corners.amax(dim=0) <= NEIGHBOUR_AGREEMENT * corners.amin(dim=0))
    s, t = u - u0, v - v0
    top = corners[0] + s * (corners[1] - corners[0])
    bottom = corners[2] + s * (corners[3] - corners[2])
    sampled = top + t * (bottom - top)
    return torch.where(good, sampled, torch.ones_like(sampled)), good


def gather_pixels(
    pair: PairBatch, weights: torch.Tensor | None = None, use_second_depth: bool = False
) -> Pixels:
    """The pixels of a batch, flattened row by row; unusable ones get weight 0 and harmless values.

    Invalid values are replaced before anything is computed from them, so that neither they nor
    their gradients spread. Variances are divided by the typical one of their sample, which is held
    constant.

    Args:
        pair: tensors of one floating type on one device. weights: (B, H, W) external factors; values
            that are not positive and finite switch a pixel off.
        use_second_depth: sample ``depth_curr`` for the third residual.
    """
    flow, depth = pair.flow, pair.depth_prev
    batch, height, width = depth.shape
    K_prev, good_prev = _usable_camera(pair.K_prev)
    K_curr, good_curr = _usable_camera(pair.K_curr)
    rays = unproject_meshgrid(height, width, K_prev, device=depth.device, dtype=depth.dtype)
    v, u = torch.meshgrid(
        torch.arange(height, device=depth.device, dtype=depth.dtype),
        torch.arange(width, device=depth.device, dtype=depth.dtype),
        indexing="ij",
    )
    target_u, target_v = u + flow[..., 0], v + flow[..., 1]
    usable = (depth > MIN_DEPTH) & (depth < MAX_VALUE) & (good_prev & good_curr)[:, None, None]
    usable = usable & (target_u.abs() < MAX_VALUE) & (target_v.abs() < MAX_VALUE)
    one, zero = torch.ones_like(depth), torch.zeros_like(depth)
    flow_variance = depth_variance = one
    if pair.flow_variance is not None:
        good = (pair.flow_variance > 0) & (pair.flow_variance < MAX_VALUE)
        typical = _typical(pair.flow_variance)
        flow_variance = torch.where(good, pair.flow_variance, typical) / typical
        usable = usable & good
    if pair.depth_variance is not None:
        good = (pair.depth_variance >= 0) & (pair.depth_variance < MAX_VALUE)
        typical = _typical(pair.depth_variance)
        depth_variance = torch.where(good, pair.depth_variance, typical) / typical
        usable = usable & good
    weight = one
    if weights is not None:
        good = (weights > 0) & (weights < MAX_VALUE)
        weight = torch.where(good, weights, zero)
    if pair.valid is not None:
        usable = usable & pair.valid
    weight = torch.where(usable, weight, zero)
    target_u = torch.where(usable, target_u, zero).flatten(1)
    target_v = torch.where(usable, target_v, zero).flatten(1)
    log_depth = present = None
    if use_second_depth and pair.depth_curr is not None:
        sampled, good = sample_depth(pair.depth_curr, target_u, target_v)
        log_depth, present = sampled.log(), (good & usable.flatten(1)).to(depth.dtype)
    return Pixels(
        ray_x=rays[..., 0].flatten(1),
        ray_y=rays[..., 1].flatten(1),
        depth=torch.where(usable, depth, one).flatten(1),
        target_u=target_u,
        target_v=target_v,
        flow_variance=flow_variance.flatten(1),
        depth_variance=depth_variance.flatten(1),
        weight=weight.flatten(1),
        K=torch.stack([K_curr[:, 0, 0], K_curr[:, 1, 1], K_curr[:, 0, 2], K_curr[:, 1, 2]], dim=1),
        log_depth_curr=log_depth,
        has_depth_curr=present,
    )


def _usable_camera(K: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """K with unusable samples replaced by the unit matrix, and which are usable (B,)."""
    good = torch.isfinite(K).all(dim=2).all(dim=1) & (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)
    unit = torch.eye(3, dtype=K.dtype, device=K.device).expand_as(K)
    return torch.where(good[:, None, None], K, unit), good


def residual_terms(pixels: Pixels, T: torch.Tensor, xi: torch.Tensor | None = None) -> Terms:
    """Residuals and their sensitivity to the depth at a pose.

    Args:
        pixels: see :class:`Pixels`. T: (B, 4, 4) T_curr_prev.
        xi: (B, 6) left perturbation, applied to first order: for derivatives at 0 only.
    """
    e = T[:, :, :, None].unbind(dim=1)
    x, y, z = pixels.ray_x, pixels.ray_y, pixels.depth
    P = [z * (row[:, 0] * x + row[:, 1] * y + row[:, 2]) for row in e[:3]]
    t = [row[:, 3] for row in e[:3]]
    X, Y, Z = (p + s for p, s in zip(P, t, strict=True))
    if xi is not None:
        r0, r1, r2, p0, p1, p2 = xi[:, :, None].unbind(dim=1)
        X, Y, Z = (
            X + r0 + p1 * Z - p2 * Y,
            Y + r1 + p2 * X - p0 * Z,
            Z + r2 + p0 * Y - p1 * X,
        )
        t = [
            t[0] + r0 + p1 * t[2] - p2 * t[1],
            t[1] + r1 + p2 * t[0] - p0 * t[2],
            t[2] + r2 + p0 * t[1] - p1 * t[0],
        ]
    front = Z > MIN_DEPTH
    i = 1 / torch.where(front, Z, torch.ones_like(Z))
    a, b = X * i, Y * i
    fx, fy, cx, cy = pixels.K[:, :, None].unbind(dim=1)
    r = [pixels.target_u - (fx * a + cx), pixels.target_v - (fy * b + cy)]
    u = [fx * i * (a * t[2] - t[0]), fy * i * (b * t[2] - t[1])]
    if pixels.log_depth_curr is not None:
        r.append(pixels.log_depth_curr + i.log())
        u.append(1 - t[2] * i)
    return Terms(a, b, i, tuple(r), tuple(u), front)


def jacobian(terms: Terms, K: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Rows d prediction / d delta, each (B, 6, N): u, v and, with the second depth, log Z'."""
    a, b, i = terms.a, terms.b, terms.i
    fx, fy = K[:, 0, None, None], K[:, 1, None, None]
    zero, ab = torch.zeros_like(a), a * b
    rows = [
        fx * torch.stack([i, zero, -a * i, -ab, 1 + a * a, -b], dim=1),
        fy * torch.stack([zero, i, -b * i, -1 - b * b, ab, a], dim=1),
    ]
    if len(terms.r) == 3:
        rows.append(torch.stack([zero, zero, i, b, -a, zero], dim=1))
    return tuple(rows)


def whitening(
    pixels: Pixels, terms: Terms, noise: torch.Tensor
) -> tuple[tuple[torch.Tensor, ...], torch.Tensor, tuple[torch.Tensor, ...]]:
    """(D, kappa, D u) with Sigma^-1 = diag(D) - kappa (D u)(D u)^T.

    Args:
        pixels: see :class:`Pixels`. terms: at the pose.
        noise: (B, 2) sf px, sd of log depth; (B, 3) with sz, of log D_curr.
    """
    flow = 1 / (noise[:, 0, None].square() * pixels.flow_variance)
    D = [flow, flow]
    if pixels.has_depth_curr is not None:
        D.append(pixels.has_depth_curr / noise[:, 2, None].square())
    Du = tuple(d * u for d, u in zip(D, terms.u, strict=True))
    depth = noise[:, 1, None].square() * pixels.depth_variance
    inner = sum(v * u for v, u in zip(Du, terms.u, strict=True))
    return tuple(D), depth / (1 + depth * inner), Du


def _whitened(r: tuple[torch.Tensor, ...], white: Any) -> tuple[list[torch.Tensor], torch.Tensor]:
    """(Sigma^-1 r, squared Mahalanobis distance)."""
    D, kappa, Du = white
    along = kappa * sum(v * e for v, e in zip(Du, r, strict=True))
    n = [d * e - along * v for d, e, v in zip(D, r, Du, strict=True)]
    return n, sum(m * e for m, e in zip(n, r, strict=True)).clamp(min=0)


def robust_weight(distance2: torch.Tensor, kernel: str, cutoff: float) -> torch.Tensor:
    """Weight of a squared Mahalanobis distance, 2 d rho / d distance2; 1 at 0."""
    c2 = cutoff * cutoff
    if kernel == "geman-mcclure":
        return (c2 / (c2 + distance2)).square()
    if kernel == "cauchy":
        return c2 / (c2 + distance2)
    if kernel == "huber":
        return cutoff / distance2.clamp(min=c2).sqrt()
    if kernel == "l2":
        return torch.ones_like(distance2)
    raise InputError(f"kernel: expected one of {', '.join(KERNELS)}, got {kernel!r}.")


def robust_cost(distance2: torch.Tensor, kernel: str, cutoff: float) -> torch.Tensor:
    """rho of a squared Mahalanobis distance; half of it where the kernel is quadratic."""
    c2 = cutoff * cutoff
    if kernel == "geman-mcclure":
        return 0.5 * c2 * distance2 / (c2 + distance2)
    if kernel == "cauchy":
        return 0.5 * c2 * torch.log1p(distance2 / c2)
    if kernel == "huber":
        linear = cutoff * distance2.clamp(min=c2).sqrt() - 0.5 * c2
        return torch.where(distance2 <= c2, 0.5 * distance2, linear)
    if kernel == "l2":
        return 0.5 * distance2
    raise InputError(f"kernel: expected one of {', '.join(KERNELS)}, got {kernel!r}.")


def _full_cost(pixels: Pixels, kernel: str, cutoff: float) -> torch.Tensor:
    if kernel == "geman-mcclure":
        return pixels.depth.new_tensor(0.5 * cutoff * cutoff)
    return robust_cost(pixels.depth.new_tensor(LOST_DISTANCE2), kernel, cutoff)


def total_cost(
    pixels: Pixels, terms: Terms, white: Any, kernel: str, cutoff: float
) -> torch.Tensor:
    """(B,) robust cost of residuals under a given whitening (not necessarily of their own pose)."""
    _, distance2 = _whitened(terms.r, white)
    rho = robust_cost(distance2, kernel, cutoff)
    full = _full_cost(pixels, kernel, cutoff)
    return (pixels.weight * torch.where(terms.front, rho, full)).sum(dim=1)


def normal_equations(
    pixels: Pixels,
    T: torch.Tensor,
    noise: torch.Tensor,
    kernel: str = "geman-mcclure",
    cutoff: float | None = None,
    *,
    with_scores: bool = False,
    terms: Terms | None = None,
) -> NormalEquations:
    """Normal equations of a batch at (B, 4, 4) poses.

    Args:
        pixels: see :class:`Pixels`. T: T_curr_prev.
        noise: (B, 2) flow noise in px and noise of log depth; (B, 3) with the noise of the second
            log depth where it is used.
        kernel: one of ``KERNELS``. cutoff: c in standard deviations; ``CUTOFFS`` by default.
        with_scores: also return the per-pixel scores.
        terms: of this very pose, where they are known already.
    """
    cutoff = CUTOFFS[kernel] if cutoff is None else cutoff
    terms = residual_terms(pixels, T) if terms is None else terms
    white = whitening(pixels, terms, noise)
    D, kappa, Du = white
    n, distance2 = _whitened(terms.r, white)
    usable = terms.front & (pixels.weight > 0)
    weights = torch.where(
        usable, robust_weight(distance2, kernel, cutoff), torch.zeros_like(distance2)
    )
    w = pixels.weight * weights
    J = jacobian(terms, pixels.K)
    along = sum(row * v[:, None] for row, v in zip(J, Du, strict=True))
    G = torch.cat([*J, along], dim=2)
    omega = torch.cat([*(w * d for d in D), -w * kappa], dim=1)
    H = (G * omega[:, None]) @ G.transpose(1, 2)
    e = torch.cat([w * m for m in n], dim=1)
    g = (G[:, :, : e.shape[1]] @ e[..., None])[..., 0]
    rho = torch.where(
        terms.front, robust_cost(distance2, kernel, cutoff), _full_cost(pixels, kernel, cutoff)
    )
    scores = None
    if with_scores:
        scores = sum(row * (w * m)[:, None] for row, m in zip(J, n, strict=True))
    return NormalEquations(
        H=0.5 * (H + H.transpose(1, 2)),
        g=g,
        cost=(pixels.weight * rho).sum(dim=1),
        weights=weights,
        weight_sum=w.sum(dim=1),
        distance2=distance2,
        scores=scores,
        whitening=white,
    )


def score_sum(
    pixels: Pixels,
    T: torch.Tensor,
    noise: torch.Tensor,
    kernel: str,
    cutoff: float,
    xi: torch.Tensor | None = None,
) -> torch.Tensor:
    """(B, 6) estimating equation g = sum of w J^T Sigma^-1 r, built for differentiation.

    The pose that solves g = 0 is the estimate; g is not the gradient of the cost, since Sigma moves
    with the pose. ``xi`` as in :func:`residual_terms`.
    """
    terms = residual_terms(pixels, T, xi)
    n, distance2 = _whitened(terms.r, whitening(pixels, terms, noise))
    usable = terms.front & (pixels.weight > 0)
    w = torch.where(usable, pixels.weight, torch.zeros_like(pixels.weight))
    w = w * robust_weight(distance2, kernel, cutoff)
    a, b, i, ab = terms.a, terms.b, terms.i, terms.a * terms.b
    x = w * n[0] * pixels.K[:, 0, None]
    y = w * n[1] * pixels.K[:, 1, None]
    ax, by = a * x, b * y
    rows = [
        x * i,
        y * i,
        -(ax + by) * i,
        -(ab * x + y + b * by),
        x + a * ax + ab * y,
        a * y - b * x,
    ]
    if len(n) == 3:
        z = w * n[2]
        rows[2], rows[3], rows[4] = rows[2] + z * i, rows[3] + z * b, rows[4] - z * a
    return torch.stack([row.sum(dim=1) for row in rows], dim=1)
