"""The refinement of a batch of pairs in torch: CPU or GPU, float32 or float64, differentiable.

The torch twin of :mod:`hybridvo.pose.refinement` with the residual of
:mod:`hybridvo.pose.residuals`. Every start is refined side by side on a sparse set of pixels under a
kernel whose scale is graduated; the start of least cost at one common scale is fitted on the whole
grid. Samples never see each other: damping, acceptance, convergence and failure are per sample.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch

from hybridvo.errors import InputError
from hybridvo.pose.implicit import attach_gradient, estimating_hessian, solve_small
from hybridvo.pose.residuals import (
    CUTOFFS,
    KERNELS,
    MAX_VALUE,
    MIN_DEPTH,
    NormalEquations,
    Pixels,
    gather_pixels,
    left_update,
    normal_equations,
    residual_terms,
    total_cost,
)
from hybridvo.types import PairBatch, Reason, Status

__all__ = ["BatchOptions", "BatchedPose", "estimate_noise", "gauss_newton_step", "refine_batch"]

DAMPING = 1e-6
MAX_DAMPING = 1e3
FLOW_NOISE_FLOOR = 2e-3
"""Smallest flow noise assumed, px, as in the numba solver."""
DEPTH_NOISE_CAP = 0.5
SECOND_DEPTH_FLOOR = 2e-3
"""Smallest noise of log D_curr assumed: what bilinear sampling of a smooth surface is good to."""
NO_INFORMATION = (1e4, 1e4, 1e4, 10.0, 10.0, 10.0)
"""Diagonal of the covariance of a failed estimate."""
INLIER_DISTANCE2 = 9.0


@dataclass(frozen=True)
class BatchOptions:
    """Options of :func:`refine_batch`.

    Args:
        cutoff: c of the robust kernel in standard deviations; None: that of the kernel.
        iterations: most Gauss-Newton steps on the whole grid.
        tolerance: the solve has converged when a step moves the picture by less than this many
            standard deviations of the noise.
        tight: go on until the step is at the precision of the numbers, which gradients need. None:
            exactly where a gradient is wanted.
        sparse_pixels: pixels on which starts are refined and the noise is estimated.
        largest_px, smallest_px: largest start and the end of the graduated scale, px.
        levels: Gauss-Newton steps between them.
        minimum_pixels: fewer usable pixels are a failure.
        tile: side of the tiles, px, within which errors may be correlated (sandwich covariance).
    """

    cutoff: float | None = None
    iterations: int = 20
    tolerance: float = 1e-3
    tight: bool | None = None
    sparse_pixels: int = 2048
    largest_px: float = 64.0
    smallest_px: float = 0.4
    levels: int = 15
    minimum_pixels: int = 24
    tile: int = 32

    def __post_init__(self) -> None:
        for name in (
            "cutoff", "iterations", "tolerance", "sparse_pixels", "largest_px", "smallest_px",
            "levels", "minimum_pixels", "tile",
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"BatchOptions.{name}: expected a positive number, got {value!r}.")


@dataclass(frozen=True, eq=False)
class BatchedPose:
    """Camera motions of a batch of pairs.

    Args:
        T_curr_prev: (B, 4, 4) points of the previous camera into the current one, metres; the
            identity where failed. Carries the gradient.
        covariance: (B, 6, 6) of the left perturbation (translation, rotation); no gradient.
        converged: (B,) bool. Where False the gradient of the sample is zero.
        failed: (B,) bool. status: one per sample, with its reason.
        iterations: (B,) Gauss-Newton steps on the whole grid.
        cost: (B,) robust cost per unit of external weight.
        weights: (B, H, W) robust weights without the external ones, 0 where unusable.
        noise: (B, 2) flow noise in px and noise of log depth, estimated or as given; (B, 3) with
            the noise of the second log depth where that is used.
        inlier_ratio: (B,) share of the external weight within three standard deviations.
    """

    T_curr_prev: torch.Tensor
    covariance: torch.Tensor
    converged: torch.Tensor
    failed: torch.Tensor
    status: list[Status]
    iterations: torch.Tensor
    cost: torch.Tensor
    weights: torch.Tensor
    noise: torch.Tensor
    inlier_ratio: torch.Tensor

    @property
    def T_prev_curr(self) -> torch.Tensor:
        """(B, 4, 4) inverse of ``T_curr_prev``."""
        R = self.T_curr_prev[:, :3, :3].transpose(1, 2)
        top = torch.cat([R, -R @ self.T_curr_prev[:, :3, 3:]], dim=2)
        return torch.cat([top, self.T_curr_prev[:, 3:]], dim=1)


def refine_batch(
    pair: PairBatch,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: BatchOptions | None = None,
    differentiable: bool = True,
    use_second_depth: bool = False,
) -> BatchedPose:
    """Camera motion of every pair of a batch by robust dense reprojection.

    Works in the floating type of the flow and depth (half types are raised to float32), outside
    autocast. The noise scales are constants for the gradient.

    Args:
        pair: see :class:`~hybridvo.types.PairBatch`.
        T_init: (B, 4, 4) or (B, S, 4, 4) T_curr_prev, starts beside the identity. A start that is
            not finite is replaced by the identity.
        weights: (B, H, W) factors on the information; what is not positive and finite switches a
            pixel off.
        noise: (sf, sd) flow noise in px and noise of log depth, or (sf, sd, sz) with that of the
            second depth; numbers, or a (B, 2) or (B, 3) tensor. None: estimated per sample.
        kernel: ``geman-mcclure``, ``cauchy``, ``huber`` or ``l2``.
        options: see :class:`BatchOptions`.
        differentiable: attach the gradient, see :mod:`hybridvo.pose.implicit`.
        use_second_depth: add the residual of ``depth_curr`` where it is present.

    Returns:
        Poses with covariance and a status per sample. Bad data give a failed status for that very
        sample, never an exception and never a pose that is not finite.

    Raises:
        InputError: shapes, types or options that cannot be used.
    """
    options = options or BatchOptions()
    if kernel not in KERNELS:
        raise InputError(f"refine_batch: unknown kernel {kernel!r}; known: {', '.join(KERNELS)}.")
    pair, weights = _checked_pair(pair, weights, use_second_depth)
    cutoff = CUTOFFS[kernel] if options.cutoff is None else float(options.cutoff)
    second = use_second_depth and pair.depth_curr is not None
    starts = _starts(T_init, pair.flow)
    fixed = _fixed_noise(noise, pair.flow, second)
    inputs = (
        pair.flow, pair.depth_prev, pair.K_prev, pair.K_curr, weights, fixed, pair.flow_variance,
        pair.depth_variance, pair.depth_curr if second else None,
    )  # fmt: skip
    wanted = differentiable and torch.is_grad_enabled()
    wanted = wanted and any(value is not None and value.requires_grad for value in inputs)
    tight = wanted if options.tight is None else options.tight
    with torch.autocast(pair.flow.device.type, enabled=False):
        with torch.no_grad():
            pixels = gather_pixels(pair, weights, second)
            solution = _solve(pixels, starts, fixed, kernel, cutoff, options, tight)
            result = _finish(pair, pixels, solution, kernel, cutoff, options, tight)
        if not wanted:
            return result
        T = attach_gradient(
            result.T_curr_prev, result.converged & ~result.failed, pair, weights,
            result.noise if fixed is None else fixed, kernel, cutoff, second,
        )  # fmt: skip
    return replace(result, T_curr_prev=T)


def _checked_pair(
    pair: PairBatch, weights: Any, use_second_depth: bool
) -> tuple[PairBatch, torch.Tensor | None]:
    """The batch in one floating type, on one device."""
    where = "refine_batch"
    flow, depth = pair.flow, pair.depth_prev
    for name, value in (("flow", flow), ("depth_prev", depth)):
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            raise InputError(f"{where}: expected PairBatch.{name} as a floating-point tensor.")
    if flow.ndim != 4 or flow.shape[3] != 2 or flow.numel() == 0:
        raise InputError(
            f"{where}: expected PairBatch.flow of shape (B, H, W, 2), got {tuple(flow.shape)}."
        )
    batch, image = flow.shape[0], tuple(flow.shape[:3])
    dtype = torch.promote_types(flow.dtype, depth.dtype)
    if dtype not in (torch.float32, torch.float64):
        dtype = torch.float32
    values: dict[str, torch.Tensor | None] = {}
    if weights is not None:
        weights = torch.as_tensor(weights, device=flow.device)
        if weights.ndim == 2 and batch == 1:
            weights = weights[None]
    for name, value, shape in (
        ("flow", flow, (*image, 2)),
        ("depth_prev", depth, image),
        ("K_prev", pair.K_prev, (batch, 3, 3)),
        ("K_curr", pair.K_curr, (batch, 3, 3)),
        ("depth_curr", pair.depth_curr, image),
        ("flow_variance", pair.flow_variance, image),
        ("depth_variance", pair.depth_variance, image),
        ("weights", weights, image),
        ("valid", pair.valid, image),
    ):
        if value is None and name not in ("K_prev", "K_curr"):
            values[name] = None
            continue
        got = tuple(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
        if got != shape:
            raise InputError(f"{where}: expected {name} of shape {shape}, got {got}.")
        if value.device != flow.device:
            raise InputError(f"{where}: {name} is on {value.device}, the flow on {flow.device}.")
        if name == "valid":
            if value.dtype != torch.bool:
                raise InputError(f"{where}: expected PairBatch.valid as bool, got {value.dtype}.")
            values[name] = value
        else:
            values[name] = value.to(dtype)
    if use_second_depth and pair.depth_curr is None:
        raise InputError(f"{where}: use_second_depth needs PairBatch.depth_curr, which is None.")
    weights = values.pop("weights")
    return PairBatch(**values), weights  # type: ignore[arg-type]


def _starts(T_init: Any, like: torch.Tensor) -> torch.Tensor:
    """(B, S + 1, 4, 4) float64: the identity and the rigid parts of the handed-in starts."""
    batch = like.shape[0]
    unit = torch.eye(4, dtype=torch.float64, device=like.device)
    starts = unit.expand(batch, 1, 4, 4)
    if T_init is None:
        return starts
    T = torch.as_tensor(T_init, device=like.device).detach().double()
    if T.shape == (4, 4) and batch == 1:
        T = T[None]
    if T.ndim == 3:
        T = T[:, None]
    if T.ndim != 4 or T.shape[0] != batch or T.shape[2:] != (4, 4):
        raise InputError(
            f"refine_batch: expected T_init of shape ({batch}, 4, 4) or ({batch}, S, 4, 4), "
            f"got {tuple(T.shape)}."
        )
    good = torch.isfinite(T).flatten(2).all(dim=2) & (T.abs().flatten(2).amax(dim=2) < MAX_VALUE)
    T = torch.where(good[:, :, None, None], T, unit)
    U, _, Vh = torch.linalg.svd(T[:, :, :3, :3])
    U = torch.cat([U[..., :2], U[..., 2:] * torch.linalg.det(U @ Vh)[..., None, None]], dim=-1)
    rigid = unit.expand_as(T).clone()
    rigid[:, :, :3, :3] = U @ Vh
    rigid[:, :, :3, 3] = T[:, :, :3, 3]
    return torch.cat([starts, rigid], dim=1)


def _fixed_noise(noise: Any, like: torch.Tensor, second: bool) -> torch.Tensor | None:
    """(B, 2) or (B, 3) noise as handed in."""
    if noise is None:
        return None
    if isinstance(noise, (tuple, list)):
        columns = [
            torch.as_tensor(value, dtype=like.dtype, device=like.device).expand(like.shape[0])
            for value in noise
        ]
        value = torch.stack(columns, dim=1)
    else:
        value = torch.as_tensor(noise, device=like.device).to(like.dtype)
    if value.ndim != 2 or value.shape[0] != like.shape[0] or value.shape[1] not in (2, 3):
        raise InputError(
            f"refine_batch: expected noise as (sf, sd), (sf, sd, sz) or a tensor of shape "
            f"({like.shape[0]}, 2) or ({like.shape[0]}, 3), got {tuple(value.shape)}."
        )
    known = value.detach()
    if not bool(torch.isfinite(known).all() & (known >= 0).all() & (known[:, 0] > 0).all()):
        raise InputError("refine_batch: expected finite noise, sf positive, sd not negative.")
    if second and value.shape[1] == 2:
        value = torch.cat([value, value[:, 1:].clamp(min=SECOND_DEPTH_FLOOR)], dim=1)
    return value if second else value[:, :2]


def sparse_subset(pixels: Pixels, count: int) -> Pixels:
    """About ``count`` usable pixels of each sample, spread evenly in raster order, all if fewer.

    One pixel is taken from each of ``count`` equal runs, at a place in the run that follows the
    golden section, so that no regular structure of the picture is met in step.
    """
    usable = pixels.weight > 0
    order = usable.long().cumsum(dim=1)
    total = order[:, -1:]
    count = min(count, usable.shape[1])
    k = torch.arange(count, device=usable.device, dtype=torch.float64)[None]
    spread = ((k + (k * 0.6180339887498949).frac()) * total / count).long()
    place = torch.where(total > count, spread, k.long().expand_as(spread))
    index = torch.searchsorted(order, place + 1).clamp(max=usable.shape[1] - 1)
    return pixels.take(index, place < total)


def gauss_newton_step(
    H: torch.Tensor, g: torch.Tensor, damping: torch.Tensor | float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve (H + damping diag H) delta = g, each sample for itself, in float64.

    Args:
        H: (B, 6, 6). g: (B, 6). damping: (B,) or a number.

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


def _masked_median(values: torch.Tensor, mask: torch.Tensor, default: float) -> torch.Tensor:
    """(B,) median of the values under the mask."""
    hidden = torch.where(mask, values, torch.full_like(values, torch.nan))
    return torch.nan_to_num(hidden.nanmedian(dim=1).values, nan=default)


def _flow_only(pixels: Pixels) -> Pixels:
    return replace(pixels, log_depth_curr=None, has_depth_curr=None)


def _graduate(
    sparse: Pixels, T: torch.Tensor, kernel: str, end: torch.Tensor, options: BatchOptions
) -> torch.Tensor:
    """Gauss-Newton steps with isotropic noise while its scale falls geometrically to ``end``."""
    dtype = sparse.depth.dtype
    terms = residual_terms(sparse, T.to(dtype))
    length = (terms.r[0].square() + terms.r[1].square()).sqrt()
    start = 1.5 * _masked_median(length, (sparse.weight > 0) & terms.front, 1.0)
    start = torch.maximum(start.clamp(1.0, options.largest_px), end)
    for level in range(options.levels + 1):
        scale = start * (end / start) ** (level / options.levels)
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
    over a disc, as in :func:`hybridvo.pose.solver.estimate_noise`, in float64. ``noise`` (B, 2) is
    where it starts, and what it returns for samples with fewer than eight pixels near the pose.
    """
    terms = residual_terms(sparse, T.to(sparse.depth.dtype))
    ru, rv, qu, qv = (value.double() for value in (*terms.r[:2], *terms.u[:2]))
    sf, sd = noise[:, :1].double(), noise[:, 1:2].double()
    radius = (8 * sf).clamp(min=4.0)
    weight = sparse.weight.double()
    near = terms.front & (weight > 0) & (ru.square() + rv.square() <= radius.square())
    weight = torch.where(near, weight, torch.zeros_like(weight))
    q2 = qu.square() + qv.square()
    length2 = ru.square() + rv.square()
    x1 = torch.where(q2 > 1e-24, (ru * qu + rv * qv).square() / q2.clamp(min=1e-24), ru.square())
    x2 = (length2 - x1).clamp(min=0)
    alpha = sparse.flow_variance.double()
    beta = sparse.depth_variance.double() * q2
    area = torch.pi * radius.square()
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


def _with_second_depth(sparse: Pixels, T: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """(B, 3): the noise of log D_curr from the spread of r_z that sd h does not explain."""
    if sparse.has_depth_curr is None:
        return noise
    terms = residual_terms(sparse, T.to(sparse.depth.dtype))
    near = terms.r[0].square() + terms.r[1].square() <= (8 * noise[:, :1]).clamp(min=4.0).square()
    used = (sparse.weight > 0) & (sparse.has_depth_curr > 0) & terms.front & near
    spread = 1.4826 * _masked_median(terms.r[2].abs(), used, 0.02)
    common = noise[:, 1] * _masked_median(terms.u[2].abs(), used, 1.0)
    rest = (spread.square() - common.square()).clamp(min=SECOND_DEPTH_FLOOR**2).sqrt()
    return torch.cat([noise, rest[:, None]], dim=1)


@dataclass(frozen=True, eq=False)
class _Solution:
    T: torch.Tensor
    noise: torch.Tensor
    converged: torch.Tensor
    iterations: torch.Tensor


def _gauss_newton(
    pixels: Pixels,
    T: torch.Tensor,
    noise: torch.Tensor,
    kernel: str,
    cutoff: float,
    steps: int,
    tolerance: float,
) -> _Solution:
    """Damped Gauss-Newton; a step is taken where the cost under the old covariance does not rise.

    With the covariance held, the normal equations are those of a descent, and the fixed point is
    the root of the estimating equation; the cost under the moving covariance has another minimum.
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
        better = solved & ~done & (new_cost <= cost * slack + 1e-12)
        worse = ~done & ~better
        moved = _moved(delta, g, weight)
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
    return _Solution(T, noise, converged, iterations)


def _parts(system: NormalEquations) -> tuple[Any, ...]:
    return system.H, system.g, system.cost, system.weight_sum, system.whitening


def _choose(mask: torch.Tensor, new: Any, old: Any) -> Any:
    """``new`` where the sample's mask is set, else ``old``, through nested tuples."""
    if isinstance(new, tuple):
        return tuple(_choose(mask, n, o) for n, o in zip(new, old, strict=True))
    return torch.where(mask.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _tighten(
    pixels: Pixels, start: _Solution, kernel: str, cutoff: float, rounds: int = 4, steps: int = 6
) -> _Solution:
    """Newton on the estimating equation until the step no longer shrinks.

    Each Hessian serves several steps: near the root one Hessian contracts by orders of magnitude.
    """
    dtype = pixels.depth.dtype
    T, noise, iterations = start.T, start.noise, start.iterations
    eps = torch.finfo(dtype).eps
    last = torch.full(T.shape[:1], torch.inf, dtype=torch.float64, device=T.device)
    done = ~start.converged
    for _ in range(rounds):
        A = estimating_hessian(pixels, T.to(dtype), noise, kernel, cutoff)
        for _ in range(steps):
            system = normal_equations(pixels, T.to(dtype), noise, kernel, cutoff)
            delta, solved = solve_small(A, system.g)
            norm = torch.einsum("bi,bij,bj->b", delta, system.H.double(), delta).clamp(min=0)
            moved = (norm / system.weight_sum.double().clamp(min=1e-12)).sqrt()
            shrinks = solved & (moved < 0.5 * last) & ~done
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
    return replace(start, T=T, converged=start.converged & tight, iterations=iterations)


def _solve(
    pixels: Pixels,
    starts: torch.Tensor,
    fixed: torch.Tensor | None,
    kernel: str,
    cutoff: float,
    options: BatchOptions,
    tight: bool,
) -> _Solution:
    """From the starts to the pose of every sample."""
    dtype = pixels.depth.dtype
    batch, count = starts.shape[:2]
    sparse = sparse_subset(pixels, options.sparse_pixels)
    planar = _flow_only(sparse)
    end = pixels.depth.new_full((batch,), options.smallest_px)
    if fixed is not None:
        end = torch.maximum(end, fixed[:, 0])
    many = planar.repeat(count)
    many_end = end.repeat_interleave(count)
    T = _graduate(many, starts.reshape(-1, 4, 4), kernel, many_end, options)
    T = T.reshape(batch, count, 4, 4)
    if count > 1:
        scale = torch.stack([many_end, torch.zeros_like(many_end)], dim=1)
        cost = normal_equations(many, T.reshape(-1, 4, 4).to(dtype), scale, kernel, 1.0).cost
        best = torch.nan_to_num(cost, nan=torch.inf).reshape(batch, count).argmin(dim=1)
        T = T[torch.arange(batch, device=T.device), best]
    else:
        T = T[:, 0]
    if fixed is None:
        noise = torch.tensor([0.7, 0.01], dtype=dtype, device=T.device).repeat(batch, 1)
        for _ in range(3):
            noise = estimate_noise(planar, T, noise[:, :2])
            noise = _with_second_depth(sparse, T, noise)
            T = _gauss_newton(sparse, T, noise, kernel, cutoff, 3, options.tolerance).T
        noise = _with_second_depth(sparse, T, estimate_noise(planar, T, noise[:, :2]))
    else:
        noise = fixed.detach()
        T = _gauss_newton(sparse, T, noise, kernel, cutoff, 6, options.tolerance).T
    solution = _gauss_newton(
        pixels, T, noise, kernel, cutoff, options.iterations, options.tolerance
    )  # fmt: skip
    return _tighten(pixels, solution, kernel, cutoff) if tight else solution


def _finish(
    pair: PairBatch,
    pixels: Pixels,
    solution: _Solution,
    kernel: str,
    cutoff: float,
    options: BatchOptions,
    tight: bool,
) -> BatchedPose:
    """Covariance, weights and status of every sample."""
    batch, height, width = pair.depth_prev.shape
    dtype = pixels.depth.dtype
    T = solution.T.to(dtype)
    system = normal_equations(pixels, T, solution.noise, kernel, cutoff, with_scores=True)
    usable = pixels.weight > 0
    count = usable.sum(dim=1)
    total = pixels.weight.sum(dim=1).clamp(min=1e-30)
    near = (system.weights > 0) & (system.distance2 <= INLIER_DISTANCE2)
    share = (pixels.weight * near).sum(dim=1) / total
    depth = _masked_median(pixels.depth, usable, 1.0).double()
    covariance, definite = _covariance(system, pixels, kernel, cutoff, depth, options.tile, height)
    finite = torch.isfinite(T).flatten(1).all(dim=1)
    few = count < options.minimum_pixels
    lost = (near.sum(dim=1) < 6) | (share < 0.02)
    failed = few | ~definite | ~finite | lost
    nothing = torch.diag(covariance.new_tensor(NO_INFORMATION))
    unit = torch.eye(4, dtype=dtype, device=T.device)
    converged = solution.converged & ~failed
    noise = torch.where(
        torch.isfinite(solution.noise), solution.noise, torch.ones_like(solution.noise)
    )
    status = [
        _status(pair, k, options, *facts)
        for k, facts in enumerate(
            zip(
                count.tolist(), few.tolist(), (definite & finite).tolist(), lost.tolist(),
                share.tolist(), converged.tolist(), strict=True,
            )
        )
    ]  # fmt: skip
    return BatchedPose(
        T_curr_prev=torch.where(failed[:, None, None], unit, T),
        covariance=torch.where(failed[:, None, None], nothing, covariance),
        converged=converged,
        failed=failed,
        status=status,
        iterations=solution.iterations,
        cost=torch.nan_to_num(system.cost / total),
        weights=torch.nan_to_num(system.weights).reshape(batch, height, width),
        noise=noise,
        inlier_ratio=torch.nan_to_num(share),
    )


def _status(
    pair: PairBatch,
    k: int,
    options: BatchOptions,
    count: int,
    few: bool,
    definite: bool,
    lost: bool,
    share: float,
    converged: bool,
) -> Status:
    """Status of one sample."""
    if few:
        for name, K in (("K_prev", pair.K_prev[k]), ("K_curr", pair.K_curr[k])):
            if not bool(torch.isfinite(K).all()) or not bool((K.diagonal() > 0).all()):
                return Status.failed(Reason.NAN_INPUT, f"{name} is no camera matrix")
        depth, flow = pair.depth_prev[k], pair.flow[k]
        depths = int(((depth > MIN_DEPTH) & (depth < MAX_VALUE)).sum())
        flows = int((flow.abs() < MAX_VALUE).all(dim=-1).sum())
        needed = f"{options.minimum_pixels} needed"
        if depths < options.minimum_pixels:
            return Status.failed(
                Reason.NO_VALID_DEPTH, f"{depths} pixels with valid depth, {needed}"
            )
        if flows < options.minimum_pixels:
            return Status.failed(Reason.NO_FLOW, f"{flows} pixels with valid flow, {needed}")
        return Status.failed(Reason.LOW_INLIERS, f"{count} usable pixels, {needed}")
    if not definite:
        return Status.failed(
            Reason.DEGENERATE_GEOMETRY, "the pixels leave a direction of the motion undetermined"
        )
    if lost:
        return Status.failed(
            Reason.LOW_INLIERS, f"{100 * share:.1f} % of the pixels follow one motion"
        )
    if not converged:
        return Status.degraded(
            Reason.SOLVER_DIVERGED, f"not converged after {options.iterations} steps"
        )
    if share < 0.2:
        return Status.degraded(
            Reason.LOW_INLIERS, f"only {100 * share:.0f} % of the pixels follow the motion"
        )
    return Status()


def _covariance(
    system: NormalEquations,
    pixels: Pixels,
    kernel: str,
    cutoff: float,
    depth: torch.Tensor,
    tile: int,
    height: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sandwich covariance (B, 6, 6) and whether the information is definite (B,), in float64 inside.

    As in the numpy refinement. Bread: the Gauss-Newton Hessian less the curvature of the robust
    weights. Meat: outer products of the scores summed over tiles, so that errors correlated within a
    tile count as such, with the small-sample factor of a cluster-robust covariance.
    """
    dtype = pixels.depth.dtype
    scores = system.scores
    assert scores is not None
    unit = torch.eye(6, dtype=torch.float64, device=scores.device)
    # translations in units of the typical depth, so that all six are radians of the picture
    scaling = torch.cat([depth[:, None].expand(-1, 3), unit.new_ones(len(depth), 3)], dim=1)
    outer = scaling[:, :, None] * scaling[:, None, :]
    H = system.H.double() * outer
    good = torch.isfinite(H).flatten(1).all(dim=1)
    H = torch.where(good[:, None, None], H, unit)
    values = torch.linalg.eigvalsh(H)
    definite = good & (values[:, 0] > (1e-8 * values[:, 5]).clamp(min=1e-12))
    H = torch.where(definite[:, None, None], H, unit)
    scores = torch.where(definite[:, None, None], scores, torch.zeros_like(scores))
    curvature = _curvature(scores, system, pixels, kernel, cutoff).double() * outer
    bread = H - curvature
    sound = torch.linalg.eigvalsh(bread)[:, 0] > 0.2 * torch.linalg.eigvalsh(H)[:, 0]
    bread = torch.where(sound[:, None, None], bread, H)
    batch, width = scores.shape[0], scores.shape[2] // height
    image = scores.reshape(batch, 6, height, width)
    pad = (0, -width % tile, 0, -height % tile)
    image = torch.nn.functional.pad(image, pad)
    rows, columns = image.shape[2] // tile, image.shape[3] // tile
    tiles = image.reshape(batch, 6, rows, tile, columns, tile).sum(dim=(3, 5)).flatten(2).double()
    tiles = tiles * scaling[:, :, None]
    clusters = (tiles.abs().amax(dim=1) > 0).sum(dim=1).double()
    factor = clusters / (clusters - 6).clamp(min=1)
    inverse = torch.linalg.inv(bread)
    sandwich = inverse @ (tiles @ tiles.transpose(1, 2)) @ inverse
    sandwich = (
        sandwich * torch.where(clusters >= 12, factor, torch.zeros_like(factor))[:, None, None]
    )
    model = torch.linalg.inv(H)
    cautious = (24 / clusters.clamp(min=1)).clamp(min=1)[:, None, None] * (model + sandwich)
    covariance = torch.where((clusters >= 24)[:, None, None], sandwich, cautious) * outer
    covariance = 0.5 * (covariance + covariance.transpose(1, 2))
    definite = definite & torch.isfinite(covariance).flatten(1).all(dim=1)
    return torch.where(definite[:, None, None], covariance, unit).to(dtype), definite


def _curvature(
    scores: torch.Tensor, system: NormalEquations, pixels: Pixels, kernel: str, cutoff: float
) -> torch.Tensor:
    """(B, 6, 6) sum of -2 w (d weight / d distance2) s s^T, s = J^T Sigma^-1 r."""
    d2, c2 = system.distance2, cutoff * cutoff
    if kernel == "geman-mcclure":
        ratio = 4 / (c2 + d2)  # -2 (d weight / d distance2) / weight
    elif kernel == "cauchy":
        ratio = 2 / (c2 + d2)
    elif kernel == "huber":
        ratio = torch.where(d2 > c2, 1 / d2.clamp(min=c2), torch.zeros_like(d2))
    else:
        return torch.zeros_like(system.H)
    w = pixels.weight * system.weights
    factor = torch.where(w > 1e-12, ratio / w.clamp(min=1e-12), torch.zeros_like(w))
    return (scores * factor[:, None]) @ scores.transpose(1, 2)
