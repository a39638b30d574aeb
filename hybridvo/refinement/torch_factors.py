"""The ego-flow reprojection residual of a batch of pairs in torch, and its normal equations.

The same definition as :mod:`hybridvo.refinement.kernels`, formulas there; a test holds both equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F

from hybridvo import torch_geometry
from hybridvo.errors import InputError
from hybridvo.refinement import kernels
from hybridvo.refinement.coarse_fit import DAMPING
from hybridvo.refinement.pixels import typical
from hybridvo.torch_geometry import (
    MAX_DEPTH,
    MIN_DEPTH,
    left_update,
    move,
    pp,
    rays,
    to_pixels,
)
from hybridvo.types import PairBatch, check_dense

# pixels that are worked on at once: on a CPU half the time of all of them at once
PART = 131_072
# kernel's scale in typical residuals; Newton steps of a fit
CUTOFF = 1.5
FIT_STEPS = 6
BEHIND_DISTANCE2 = 1e4  # squared Mahalanobis distance charged behind the camera
KERNELS = ("geman-mcclure", "cauchy", "huber", "l2")


class Pixels(NamedTuple):
    """Pixels of a batch in raster order; variances are relative to the typical one."""

    points: torch.Tensor  # (B, 3, N) metres, in the previous camera
    target: torch.Tensor  # (B, 2, N) px, x + F on the current image
    flow_variance: torch.Tensor  # (B, N)
    depth_variance: torch.Tensor  # (B, N)
    weight: torch.Tensor  # (B, N) external weight, 0 where unusable
    K: torch.Tensor  # (B, 3, 3) of the current camera

    @property
    def total(self) -> torch.Tensor:
        """(B,) float64 sum of the weights."""
        return self.weight.double().sum(dim=1)

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Pixels:
        """The same with all but the camera changed."""
        return Pixels._make([*(change(x) for x in self[:5]), self.K])

    def parts(self, run: int = 1) -> Iterator[Pixels]:
        """All pixels, in whole runs of ``run``, few enough at once to stay in the cache."""
        step = run * max(1, PART // (len(self.weight) * run))
        pieces = [x.split(step, dim=-1) for x in self[:5]]
        return (
            Pixels._make([*piece, self.K]) for piece in zip(*pieces, strict=True)
        )

    def subset(self, count: int) -> Pixels:
        """About ``count`` usable pixels of each sample, spread by the golden section."""
        order = (self.weight > 0).long().cumsum(dim=1)
        total = order[:, -1:]
        count = min(count, order.shape[1])
        k = torch.arange(count, device=order.device, dtype=torch.float64)[None]
        spread = (
            (k + (k * 0.6180339887498949).frac()) * (total / count).clamp(min=1)
        ).long()
        index = torch.searchsorted(order, spread + 1).clamp(max=order.shape[1] - 1)
        taken = self.map(
            lambda x: torch.take_along_dim(
                x, index if x.ndim == 2 else index[:, None], -1
            )
        )
        return taken._replace(weight=taken.weight * (spread < total))


def gather_pixels(batch: PairBatch, weights: torch.Tensor | None = None) -> Pixels:
    """The pixels of a batch; invalid values are replaced first, so that no gradient spreads."""
    depth = batch.depth_prev
    height, width = depth.shape[1:]
    target = torch_geometry.pixel_grid(height, width, depth) + batch.flow
    usable = (
        (depth > MIN_DEPTH)
        & (depth < MAX_DEPTH)
        & (target.abs() < MAX_DEPTH).all(dim=3)
    )
    one = torch.ones_like(depth)
    zero = torch.zeros_like(depth)
    flow_variance = depth_variance = weight = one
    if batch.flow_variance is not None:
        flow_variance, good = _relative(
            batch.flow_variance, batch.flow_variance > 0
        )
        flow_variance = flow_variance.clamp(
            min=1 / float(kernels.MAX_RELATIVE_INFORMATION)
        )
        usable = usable & good
    if batch.depth_variance is not None:
        depth_variance, good = _relative(
            batch.depth_variance, batch.depth_variance >= 0
        )
        depth_variance = depth_variance.clamp(
            max=float(kernels.MAX_RELATIVE_VARIANCE)
        )
        usable = usable & good
    if weights is not None:
        weight = torch.where((weights > 0) & (weights < MAX_DEPTH), weights, zero)
    if batch.valid is not None:
        usable = usable & batch.valid
    points = (
        rays(height, width, batch.K_prev)
        * torch.where(usable, depth, one)[..., None]
    )
    target = torch.where(usable[..., None], target, torch.zeros_like(target))
    # a coordinate after the other in memory: half the time of all that follows
    points, target = (x.movedim(3, 1).contiguous() for x in (points, target))
    maps = (
        points,
        target,
        flow_variance,
        depth_variance,
        torch.where(usable, weight, zero),
    )
    return Pixels._make([*(x.flatten(-2) for x in maps), batch.K_curr])


def to_tiles(x: torch.Tensor, tile: int, fill: float = 0.0) -> torch.Tensor:
    """(..., H, W) -> (..., tiles, tile * tile), the border completed with ``fill``."""
    x = F.pad(x, (0, -x.shape[-1] % tile, 0, -x.shape[-2] % tile), value=fill)
    x = x.unflatten(-1, (-1, tile)).unflatten(-3, (-1, tile)).transpose(-3, -2)
    return x.flatten(-4, -3).flatten(-2)


def _relative(
    variance: torch.Tensor, good: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """A variance in units of the typical one of its sample, 1 where not good; what is good."""
    scales = [typical(one) for one in variance.detach().cpu().numpy()]
    scale = variance.new_tensor(scales)[:, None, None]
    good = good & (variance < MAX_DEPTH)
    return torch.where(good, variance, scale) / scale, good


def as_tensor(
    value: Any, name: str, device: torch.device, where: str = "refine_batch"
) -> torch.Tensor:
    """What a user hands in as a dense tensor of numbers on a device, or an InputError."""
    try:
        tensor = torch.as_tensor(value, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        got = f"{type(value).__name__}: {str(error)[:200]}"
        raise InputError(
            f"{where}: expected {name} as numbers, got {got}."
        ) from None
    check_dense(f"{where}: {name}", tensor)
    if tensor.is_complex():
        raise InputError(
            f"{where}: expected {name} as real numbers, got {tensor.dtype}."
        )
    return tensor


def checked_batch(
    batch: PairBatch, weights: Any = None, where: str = "refine_batch"
) -> tuple[PairBatch, torch.Tensor | None]:
    """The batch and its weights in one floating type, on one device, or an InputError."""
    flow = batch.flow
    depth = batch.depth_prev
    if not all(x.is_floating_point() for x in (flow, depth)):
        raise InputError(
            f"{where}: expected flow and depth_prev as floating-point tensors."
        )
    dtype = torch.promote_types(flow.dtype, depth.dtype)
    dtype = dtype if dtype in (torch.float32, torch.float64) else torch.float32
    if weights is not None:
        weights = as_tensor(weights, "weights", flow.device, where)
        weights = weights[None] if weights.ndim == 2 and len(flow) == 1 else weights
    values = {
        k: v
        for k, v in {**vars(batch), "weights": weights}.items()
        if v is not None
    }
    shapes = {"flow": flow.shape} | dict.fromkeys(
        ("K_prev", "K_curr"), (len(flow), 3, 3)
    )
    for name, value in values.items():
        shape = tuple(shapes.get(name, flow.shape[:3]))
        is_mask = name == "valid"
        fits = tuple(value.shape) == shape and value.device == flow.device
        if not fits or (is_mask and value.dtype != torch.bool):
            raise InputError(
                f"{where}: expected {name} of shape {shape} on {flow.device}{', bool' * is_mask}, "
                f"got {tuple(value.shape)} on {value.device}, {value.dtype}."
            )
        values[name] = value if is_mask else value.to(dtype)
    weights = values.pop("weights", None)
    return PairBatch(**values), weights


class ResidualModel(NamedTuple):
    """How residuals are weighed: noise, cutoff and name of the kernel."""

    noise: torch.Tensor  # (B, 2) sf px, sd
    cutoff: float = 3.0
    name: str = "geman-mcclure"

    def kernel(
        self, d2: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Cost rho of squared distances, weight 2 rho', slope -2 weight' / weight."""
        c2 = self.cutoff**2
        share = c2 / (c2 + d2)
        if self.name == "geman-mcclure":
            return 0.5 * share * d2, share.square(), 4 * share / c2
        if self.name == "cauchy":
            return 0.5 * c2 * torch.log1p(d2 / c2), share, 2 * share / c2
        if self.name == "l2":
            return 0.5 * d2, torch.ones_like(d2), torch.zeros_like(d2)
        beyond = d2.clamp(min=c2)
        cost = torch.where(d2 <= c2, 0.5 * d2, (c2 * beyond).sqrt() - 0.5 * c2)
        return cost, (c2 / beyond).sqrt(), (d2 > c2) / beyond


def flow_noise(scale: torch.Tensor, kernel: str = "geman-mcclure") -> ResidualModel:
    """A kernel of this width (B,) px around exact depths."""
    return ResidualModel(
        torch.stack([scale, torch.zeros_like(scale)], 1), 1.0, kernel
    )


def residuals(pixels: Pixels, T: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Residuals, X'/Z' and Y'/Z' (B, 2, N), 1/Z' and if in front (B, N) at poses (B, 4, 4)."""
    x, y, z = move(T.to(pixels.points), pixels.points).unbind(1)
    front = (z > MIN_DEPTH).to(z)  # products are 15 times as fast as torch.where
    i = 1 / (z * front + (1 - front))
    ab = torch.stack([x, y], dim=1) * (i * front)[:, None]
    return pixels.target - to_pixels(ab, pixels.K), ab, i, front


class Weighted(NamedTuple):
    """Residuals at the depths that they make most likely, and ``information`` (I - kappa q q^T)."""

    ab: torch.Tensor  # (B, 2, N) X'/Z' and Y'/Z'
    i: torch.Tensor  # (B, N) 1/Z'
    # (B, 2, N) d pi(X') / d log Z at the depth measured, and there parallel to it
    q: torch.Tensor
    kappa: torch.Tensor  # (B, N)
    focal: torch.Tensor  # (B, 2, 1)
    information: torch.Tensor  # (B, N)
    right: torch.Tensor  # (B, 2, N) w Sigma^-1 r
    distance2: torch.Tensor  # (B, N) squared Mahalanobis distance
    robust: torch.Tensor
    # (B, N) without the external weight; the full one behind the camera
    cost: torch.Tensor

    def jacobian_transpose(
        self, x: torch.Tensor, y: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """The six rows of J^T (x, y), of the left tangent, for x and y (..., B, N)."""
        a, b = self.ab.unbind(1)
        x = x * self.focal[:, 0]
        y = y * self.focal[:, 1]
        z = -(a * x + b * y)
        return (
            self.i * x,
            self.i * y,
            self.i * z,
            b * z - y,
            x - a * z,
            a * y - b * x,
        )

    def scores(self) -> tuple[torch.Tensor, ...]:
        """The six rows (B, N) of w J^T Sigma^-1 r, whose sums are zero at the estimate."""
        return self.jacobian_transpose(*self.right.unbind(1))

    def whitened_jacobian(self) -> torch.Tensor:
        """J^T R (2, B, 6, N) with R R^T = w Sigma^-1: the normal equations are their products."""
        x, y = self.q.unbind(1)
        weight = self.information.sqrt()
        bend = self.kappa / (
            1 + (1 - self.kappa * (x * x + y * y)).clamp(min=0).sqrt()
        )
        both = -weight * bend * x * y
        first = torch.stack([weight * (1 - bend * x * x), both])
        second = torch.stack([both, weight * (1 - bend * y * y)])
        return torch.stack(self.jacobian_transpose(first, second), dim=2)


def weigh(pixels: Pixels, T: torch.Tensor, how: ResidualModel) -> Weighted:
    """Residuals at poses (B, 4, 4), weighed."""
    r, ab, i, front = residuals(pixels, T)
    t = T[:, :3, 3:].to(r)
    noise = how.noise[:, :, None]
    focal = pixels.K.diagonal(dim1=1, dim2=2)[:, :2, None]
    information = 1 / (noise[:, 0].square() * pixels.flow_variance)
    spread = noise[:, 1].square() * pixels.depth_variance * information
    q = focal * i[:, None] * (ab * t[:, 2:] - t[:, :2])
    length2 = q.square().sum(dim=1)
    along = (q * r).sum(dim=1)
    # how far the log depth that the residuals make most likely lies away
    e = spread * along / (1 + spread * length2)
    e = e.clamp(-float(kernels.MAX_SHIFT), float(kernels.MAX_SHIFT))
    near = t[:, 2] * i
    nearer = 1 - (1 - near) * e
    # there q is this many times as long
    spread = spread * (nearer * (1 + near * e)).square()
    kappa = spread / (1 + spread * length2)
    ab = ab + q * e[:, None] / focal
    i = i * nearer
    right = information[:, None] * (r - (kappa * along)[:, None] * q)
    d2 = (right * r).sum(dim=1).clamp(min=0) * front + BEHIND_DISTANCE2 * (
        1 - front
    )
    cost, robust, _ = how.kernel(d2)
    robust = robust * front
    w = pixels.weight * robust
    return Weighted(
        ab,
        i,
        q,
        kappa,
        focal,
        w * information,
        w[:, None] * right,
        d2,
        robust,
        cost,
    )


class Linearization(NamedTuple):
    """Normal equations at a pose, float64."""

    H: torch.Tensor  # (B, 6, 6) sum of w J^T Sigma^-1 J
    g: torch.Tensor  # (B, 6) sum of w J^T Sigma^-1 r
    cost: torch.Tensor  # (B,)
    weight: torch.Tensor  # (B,) sum of robust times external weights


def linearize(pixels: Pixels, T: pp.LieTensor, how: ResidualModel) -> Linearization:
    """Normal equations at poses (B, 7)."""
    matrix = T.matrix()
    found = []
    for part in pixels.parts():
        at = weigh(part, matrix, how)
        H = sum(root @ root.transpose(1, 2) for root in at.whitened_jacobian())
        sums = [(part.weight * x).sum(dim=1) for x in (at.cost, at.robust)]
        found.append(
            (H, torch.stack([x.sum(dim=1) for x in at.scores()], dim=1), *sums)
        )
    return Linearization(
        *(
            torch.stack(sums).double().sum(dim=0)
            for sums in zip(*found, strict=True)
        )
    )


def newton_matrix(
    pixels: Pixels, T: pp.LieTensor, how: ResidualModel
) -> torch.Tensor:
    """A = -dg / d xi: (B, 6, 6), not symmetric."""
    how = how._replace(noise=how.noise.detach())
    matrix = T.matrix().detach()
    slopes = torch.zeros(6, *matrix.shape).to(matrix)
    with torch.enable_grad():
        matrix.requires_grad_()
        for part in pixels.map(torch.Tensor.detach).parts():
            for k, score in enumerate(weigh(part, matrix, how).scores()):
                slopes[k] += torch.autograd.grad(
                    score.sum(), matrix, retain_graph=True
                )[0]
    generators = torch.zeros(6, 4, 4).to(slopes)
    generators[range(3), range(3), 3] = 1
    generators[3:, :3, :3] = pp.vec2skew(torch.eye(3).to(slopes))
    return -torch.einsum("kbpq,jpr,brq->bkj", slopes, generators, matrix.detach())


def total_score(
    pixels: Pixels, matrix: torch.Tensor, how: ResidualModel
) -> torch.Tensor:
    """The sum g (B, 6) of w J^T Sigma^-1 r at poses (B, 4, 4), zero at the estimate."""
    at = weigh(pixels, matrix, how)
    return torch.stack([x.sum(dim=1) for x in at.scores()], dim=1)


def small_inverse(
    A: torch.Tensor, damping: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, 6, 6) inverse of A + damping diag A; zero where (B,) is False."""
    A = A.detach().double()
    inverse, info = torch.linalg.inv_ex(
        A + damping * torch.diag_embed(A.diagonal(dim1=1, dim2=2))
    )
    good = (info == 0) & torch.isfinite(inverse).flatten(1).all(dim=1)
    return torch.where(
        good[:, None, None], inverse, torch.zeros_like(inverse)
    ), good


def solve_small(
    A: torch.Tensor, b: torch.Tensor, damping: float = 0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, 6) x of (A + damping diag A) x = b; zero where (B,) is False."""
    inverse, good = small_inverse(A, damping)
    x = (inverse @ b.double()[..., None])[..., 0]
    good = good & (x.abs() < 1e6).all(dim=1)
    return torch.where(good[:, None], x, torch.zeros_like(x)), good


class _NewtonStep(torch.autograd.Function):
    """The step A^-1 g with the value zero: at the solution it carries the gradient alone."""

    @staticmethod
    def forward(ctx: Any, g: torch.Tensor, inverse: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(g, inverse)
        return torch.zeros_like(g, dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> tuple[torch.Tensor, None]:
        g, inverse = ctx.saved_tensors
        slope = (inverse.mT @ slopes[0].double()[..., None])[..., 0].to(g.dtype)
        # with create_graph autograd goes on; through this step it must not
        return (_Once.apply(slope, g) if torch.is_grad_enabled() else slope), None


class _Once(torch.autograd.Function):
    """A gradient as it is, which refuses to be differentiated by the score that it depends on."""

    @staticmethod
    def forward(ctx: Any, slope: torch.Tensor, g: torch.Tensor) -> torch.Tensor:
        return slope.clone()

    @staticmethod
    def backward(
        ctx: Any, *slopes: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        raise InputError(
            "refine: expected a first derivative of the refined motion, got a second one. Its "
            "gradient is that of the solution's equation and cannot be differentiated again; "
            "leave out create_graph=True, or take the loss from motion.T_curr_prev.detach()."
        )


def attach_implicit_gradient(
    T: pp.LieTensor,
    A: torch.Tensor,
    g: torch.Tensor,
    wanted: torch.Tensor | float = 1.0,
) -> pp.LieTensor:
    """The same poses with the gradient A^-1 dg, once differentiable."""
    inverse, good = small_inverse(A)
    return left_update(wanted * good[:, None] * _NewtonStep.apply(g, inverse), T)


def stepped(
    pixels: Pixels,
    T: pp.LieTensor,
    how: ResidualModel,
    going: torch.Tensor | float = 1.0,
) -> pp.LieTensor:
    """Poses after a Gauss-Newton step, times ``going``."""
    at = linearize(pixels, T, how)
    return left_update(going * solve_small(at.H, at.g, DAMPING)[0], T)


def typical_residual(pixels: Pixels, T: pp.LieTensor) -> torch.Tensor:
    """(B,) weighted median of the length of the residuals of every third pixel; 1 without any."""
    r, _, _, front = residuals(pixels.map(lambda x: x[..., ::3]), T.matrix())
    length, index = r.norm(dim=1).sort(dim=1)
    reached = (pixels.weight[:, ::3] * front).gather(1, index).cumsum(dim=1)
    middle = (reached < 0.5 * reached[:, -1:]).sum(dim=1, keepdim=True)
    median = length.gather(1, middle.clamp(max=length.shape[1] - 1))[:, 0]
    return torch.where(reached[:, -1] > 0, median, 1.0)


def fit_pixels(
    pixels: Pixels, start: pp.LieTensor, smallest: float
) -> pp.LieTensor:
    """The motion (B, 7) that pixels agree on, or the start where that explains as much.

    The scale follows the residuals, down to ``smallest``. The gradient goes into the weights
    alone, from pixels far away with constant strength: they may be the world.
    """
    with torch.no_grad():
        T = start
        fixed = pixels.map(torch.Tensor.detach)
        first = scale = typical_residual(fixed, T)
        for _ in range(FIT_STEPS):
            T = stepped(fixed, T, flow_noise((CUTOFF * scale).clamp(min=smallest)))
            scale = typical_residual(fixed, T)
        good = torch.isfinite(T.tensor()).all(dim=1) & (scale <= first)
        T = pp.SE3(torch.where(good[:, None], T.tensor(), start.tensor()))
        width = (CUTOFF * torch.where(good, scale, first)).clamp(min=smallest)
    if not pixels.weight.requires_grad:
        return T
    at = linearize(pixels, T, flow_noise(width, "huber"))
    return attach_implicit_gradient(T, at.H.detach(), at.g)
