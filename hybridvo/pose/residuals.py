"""Ego-flow reprojection residuals of a batch of pairs in torch: the twin of the numba kernels.

Per pixel, with X' = T X, a = X'/Z', b = Y'/Z', i = 1/Z' (the definition of
:mod:`hybridvo.refinement.kernels`; a test holds the Gauss-Newton steps of both equal):

- residual r = (x + F) - pi(X') in px, predicted by the pose (paper, equations 6 and 8);
- Jacobian of the prediction with respect to the left perturbation (translation, rotation):
  diag(fx, fy) [[i, 0, -a i, -a b, 1 + a^2, -b], [0, i, -b i, -(1 + b^2), a b, a]];
- u = q = d pi(X') / d log Z = (fx i (a tz - tx), fy i (b tz - ty));
- covariance Sigma = diag(sf^2 v_f, sf^2 v_f) + sd^2 v_d u u^T;
- a, b, i and u of the Jacobian and of Sigma (not of r) are taken at log Z + e, the posterior mean
  of the true log depth, e = sd^2 v_d u^T Sigma^-1 r (errors in variables: see the kernels).

With the second depth a third row joins, r_z = log D_curr(x + F) - log Z'. A left perturbation
moves Z' by dZ' = rho_z + phi_x Y' - phi_y X', so its Jacobian is [0, 0, i, b, -a, 0]; the first
depth acts through Z' = Z (R K^-1 x)_z + tz, so d log Z' / d log Z = (Z' - tz) / Z' = 1 - tz i = h.
The noise of the first depth is common to all three rows: u = (q, h), and
Sigma = diag(sf^2 v_f, sf^2 v_f, sz^2) + sd^2 v_d u u^T. What the flow noise does to the place where
D_curr is sampled is left out.

Sigma is inverted by the rank-one identity: with D the inverse of the diagonal, Sigma^-1 =
D - kappa (D u)(D u)^T, kappa = sd^2 v_d / (1 + sd^2 v_d u^T D u). A pixel without a second depth
has a zero in D and loses that row alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import reduce

import torch
from kornia.geometry.camera import project_points
from kornia.geometry.depth import depth_to_3d_v2

from hybridvo.errors import InputError
from hybridvo.pose.pixels import MAX_VALUE, MIN_DEPTH, Pixels
from hybridvo.quiet_import import quiet_import

pp = quiet_import("pypose")

__all__ = [
    "CUTOFFS",
    "KERNELS",
    "NormalEquations",
    "Terms",
    "jacobian",
    "left_update",
    "normal_equations",
    "pose_to_matrix",
    "reproject",
    "residual_terms",
    "robust_cost",
    "robust_weight",
    "score_sum",
]

KERNELS = ("geman-mcclure", "huber", "cauchy", "l2")
CUTOFFS = {"geman-mcclure": 3.0, "huber": 1.345, "cauchy": 2.385, "l2": 1.0}
"""Default cutoff c in standard deviations: 3 as in the numba solver; the 95 % efficient ones for
Huber and Cauchy (P. J. Huber, Robust Statistics; one-dimensional Gaussian noise)."""

MAX_SHIFT = 0.3
"""Largest correction of log depth that an outlier may cause, as in the numba kernels."""
LOST_DISTANCE2 = 1e4
"""Squared Mahalanobis distance at which a pixel behind the camera is charged."""


@dataclass(frozen=True, eq=False)
class Terms:
    """What the pose says of every pixel, each (B, N), and its t; see this module's formulas."""

    a: torch.Tensor
    b: torch.Tensor
    i: torch.Tensor
    r: tuple[torch.Tensor, ...]
    u: tuple[torch.Tensor, ...]
    t: tuple[torch.Tensor, ...]
    front: torch.Tensor


Whitening = tuple[tuple[torch.Tensor, ...], torch.Tensor, tuple[torch.Tensor, ...]]
"""(D, kappa, D u), see :func:`whitening`."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Weighted normal equations at a pose; H delta = g is the Gauss-Newton step Exp(delta) T.

    Args:
        H: (B, 6, 6) float64, sum of w J^T Sigma^-1 J.
        g: (B, 6) float64, sum of w J^T Sigma^-1 r.
        cost: (B,) robust cost, pixels behind the camera at the full one.
        weights: (B, N) robust weights without the external ones, 0 where unusable.
        weight_sum: (B,) sum of robust times external weights.
        distance2: (B, N) squared Mahalanobis distances.
        scores: (B, 6, N) w J^T Sigma^-1 r per pixel where asked for, else None.
        whitening: of the covariance at this pose.
    """

    H: torch.Tensor
    g: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    weight_sum: torch.Tensor
    distance2: torch.Tensor
    scores: torch.Tensor | None
    whitening: Whitening


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
    """Exp(delta) T for (B, 6) tangents (translation, rotation) and (B, 4, 4) poses.

    pypose's ``se3.Exp`` written out, as in :func:`hybridvo.geometry.se3_exp`: in the solver's loop
    pypose's took 3 ms a call, more than the step. A test holds both equal.
    """
    x, y, z = delta[:, 3:].unbind(dim=1)
    zero = torch.zeros_like(x)
    W = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    theta2 = x * x + y * y + z * z
    small = theta2 < 1e-8
    safe = torch.where(small, torch.ones_like(theta2), theta2)
    theta = safe.sqrt()
    a = torch.where(small, 1 - theta2 / 6, theta.sin() / theta)[:, None, None]
    b = torch.where(small, 0.5 - theta2 / 24, 2 * (theta / 2).sin().square() / safe)[:, None, None]
    c = torch.where(small, 1 / 6 - theta2 / 120, (1 - theta.sin() / theta) / safe)[:, None, None]
    W2 = W @ W
    unit = torch.eye(3, dtype=delta.dtype, device=delta.device)
    shift = (unit + b * W + c * W2) @ delta[:, :3, None]
    top = torch.cat([unit + a * W + b * W2, shift], dim=2) @ T
    return torch.cat([top, T[:, 3:]], dim=1)


def reproject(
    depth: torch.Tensor, T: torch.Tensor, K_prev: torch.Tensor, K_curr: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the pixels of the previous frame are seen by the current one.

    Args:
        depth: (B, H, W) metres.
        T: T_curr_prev, pypose SE3 (B, 7) or (B, 4, 4).
        K_prev: (B, 3, 3) of the previous camera.
        K_curr: (B, 3, 3) of the current camera.

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


def residual_terms(pixels: Pixels, T: torch.Tensor, xi: torch.Tensor | None = None) -> Terms:
    """Residuals and their sensitivity to the depth at a pose.

    Args:
        pixels: see :class:`~hybridvo.pose.pixels.Pixels`.
        T: (B, 4, 4) T_curr_prev.
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
    if pixels.log_depth_curr is not None:
        r.append(pixels.log_depth_curr + i.log())
    u = _sensitivity(a, b, i, tuple(t), fx, fy, len(r))
    return Terms(a, b, i, tuple(r), u, tuple(t), front)


def jacobian(terms: Terms, K: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Rows d prediction / d delta, each (B, 6, N): u, v and, with the second depth, log Z'.

    Terms of (B, C, L) give rows of (B, C, 6, L).
    """
    a, b, i = terms.a, terms.b, terms.i
    fx, fy = (K[:, k].reshape(-1, *[1] * a.ndim) for k in (0, 1))
    zero, ab = torch.zeros_like(a), a * b
    rows = [
        fx * torch.stack([i, zero, -a * i, -ab, 1 + a * a, -b], dim=-2),
        fy * torch.stack([zero, i, -b * i, -1 - b * b, ab, a], dim=-2),
    ]
    if len(terms.r) == 3:
        rows.append(torch.stack([zero, zero, i, b, -a, zero], dim=-2))
    return tuple(rows)


def _sum(values: Iterable[torch.Tensor]) -> torch.Tensor:
    return reduce(torch.add, values)


def whitening(pixels: Pixels, terms: Terms, noise: torch.Tensor) -> Whitening:
    """(D, kappa, D u) with Sigma^-1 = diag(D) - kappa (D u)(D u)^T.

    Args:
        pixels: see :class:`~hybridvo.pose.pixels.Pixels`.
        terms: at the pose.
        noise: (B, 2) sf px, sd of log depth; (B, 3) with sz, of log D_curr.
    """
    flow = 1 / (noise[:, 0, None].square() * pixels.flow_variance)
    D = [flow, flow]
    if pixels.has_depth_curr is not None:
        D.append(pixels.has_depth_curr / noise[:, 2, None].square())
    Du = tuple(d * u for d, u in zip(D, terms.u, strict=True))
    depth = noise[:, 1, None].square() * pixels.depth_variance
    inner = _sum(v * u for v, u in zip(Du, terms.u, strict=True))
    return tuple(D), depth / (1 + depth * inner), Du


def _whitened(
    r: tuple[torch.Tensor, ...], white: Whitening
) -> tuple[list[torch.Tensor], torch.Tensor]:
    """(Sigma^-1 r, squared Mahalanobis distance)."""
    D, kappa, Du = white
    along = kappa * _sum(v * x for v, x in zip(Du, r, strict=True))
    n = [d * x - along * v for d, x, v in zip(D, r, Du, strict=True)]
    return n, _sum(m * x for m, x in zip(n, r, strict=True)).clamp(min=0)


def relinearised(pixels: Pixels, terms: Terms, noise: torch.Tensor) -> Terms:
    """The terms at the depths that the residuals make most likely; the residuals stay.

    With h = 1 - tz i = d log Z' / d log Z: a + e q_u / fx, b + e q_v / fy, i (1 - h e).
    """
    _, kappa, Du = whitening(pixels, terms, noise)
    e = kappa * _sum(v * x for v, x in zip(Du, terms.r, strict=True))
    e = e.clamp(-MAX_SHIFT, MAX_SHIFT)
    fx, fy = pixels.K[:, 0, None], pixels.K[:, 1, None]
    a = terms.a + terms.u[0] * e / fx
    b = terms.b + terms.u[1] * e / fy
    i = terms.i * (1 - (1 - terms.t[2] * terms.i) * e)
    u = _sensitivity(a, b, i, terms.t, fx, fy, len(terms.r))
    return replace(terms, a=a, b=b, i=i, u=u)


def _sensitivity(
    a: torch.Tensor,
    b: torch.Tensor,
    i: torch.Tensor,
    t: tuple[torch.Tensor, ...],
    fx: torch.Tensor,
    fy: torch.Tensor,
    rows: int,
) -> tuple[torch.Tensor, ...]:
    """Sensitivity u = d prediction / d log Z."""
    u = (fx * i * (a * t[2] - t[0]), fy * i * (b * t[2] - t[1]))
    return (*u, 1 - t[2] * i) if rows == 3 else u


def robust_weight(distance2: torch.Tensor, kernel: str, cutoff: float) -> torch.Tensor:
    """Weight of a squared Mahalanobis distance, 2 d rho / d distance2; 1 at 0."""
    c2 = cutoff * cutoff
    if kernel == "geman-mcclure":
        return (c2 / (c2 + distance2)).square()
    if kernel == "cauchy":
        return c2 / (c2 + distance2)
    if kernel == "huber":
        return torch.where(distance2 <= c2, 1.0, cutoff / distance2.clamp(min=c2).sqrt())
    if kernel == "l2":
        return torch.ones_like(distance2)
    raise InputError(f"kernel: expected one of {', '.join(KERNELS)}, got {kernel!r}.")


def robust_cost(distance2: torch.Tensor, kernel: str, cutoff: float) -> torch.Tensor:
    """Rho of a squared Mahalanobis distance; half of it where the kernel is quadratic."""
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
    pixels: Pixels,
    terms: Terms,
    white: Whitening,
    kernel: str,
    cutoff: float,
) -> torch.Tensor:
    """(B,) robust cost of residuals under a given whitening (not necessarily of their own pose)."""
    _, distance2 = _whitened(terms.r, white)
    rho = robust_cost(distance2, kernel, cutoff)
    full = _full_cost(pixels, kernel, cutoff)
    return (pixels.weight * torch.where(terms.front, rho, full)).sum(dim=1)


def _run_length(count: int) -> int:
    """Length of the runs whose sums stay in the pixels' type; sums of runs are in float64.

    The largest divisor up to 1024: a float32 sum over a whole picture loses the step's fifth digit.
    """
    return next((k for k in range(min(count, 1024), 31, -1) if count % k == 0), count)


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
        pixels: see :class:`~hybridvo.pose.pixels.Pixels`.
        T: T_curr_prev.
        noise: (B, 2) flow noise in px and noise of log depth; (B, 3) with the noise of the second
            log depth where it is used.
        kernel: one of ``KERNELS``.
        cutoff: c in standard deviations; ``CUTOFFS`` by default.
        with_scores: also return the per-pixel scores.
        terms: of this very pose, where they are known already.
    """
    cutoff = CUTOFFS[kernel] if cutoff is None else cutoff
    terms = residual_terms(pixels, T) if terms is None else terms
    terms = relinearised(pixels, terms, noise)
    white = whitening(pixels, terms, noise)
    D, kappa, Du = white
    n, distance2 = _whitened(terms.r, white)
    usable = terms.front & (pixels.weight > 0)
    weights = torch.where(
        usable, robust_weight(distance2, kernel, cutoff), torch.zeros_like(distance2)
    )
    w = pixels.weight * weights
    shape = (w.shape[0], -1, _run_length(w.shape[1]))

    def fold(values: Iterable[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        return tuple(value.reshape(shape) for value in values)

    a, b, i = fold((terms.a, terms.b, terms.i))
    J = jacobian(replace(terms, a=a, b=b, i=i), pixels.K)
    along = _sum(row * v[:, :, None] for row, v in zip(J, fold(Du), strict=True))
    G = torch.cat([*J, along], dim=3)
    omega = torch.cat(fold([*(w * d for d in D), -w * kappa]), dim=2)
    H = ((G * omega[:, :, None]) @ G.transpose(2, 3)).double().sum(dim=1)
    right = torch.cat(fold(w * m for m in n), dim=2)
    g = (G[..., : right.shape[2]] @ right[..., None])[..., 0].double().sum(dim=1)
    rho = torch.where(
        terms.front, robust_cost(distance2, kernel, cutoff), _full_cost(pixels, kernel, cutoff)
    )
    scores = None
    if with_scores:
        scores = _sum(row * m[:, :, None] for row, m in zip(J, fold(w * m for m in n), strict=True))
        scores = scores.transpose(1, 2).flatten(2)
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
    terms = relinearised(pixels, terms, noise)
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
