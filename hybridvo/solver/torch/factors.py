"""The ego-flow reprojection residual of a batch of pairs in torch, and its normal equations.

The same definition as in :mod:`hybridvo.solver.kernels`, which has the formulas; a test holds
both equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch

from hybridvo.core import torch_geometry
from hybridvo.core.errors import InputError
from hybridvo.core.torch_geometry import (
    MAX_DEPTH,
    MIN_DEPTH,
    left_update,
    move,
    pp,
    rays,
    to_matrix,
    to_pixels,
)
from hybridvo.core.types import PairBatch
from hybridvo.solver import kernels
from hybridvo.solver.kernels import BEHIND_DISTANCE2
from hybridvo.solver.pixels import typical
from hybridvo.solver.robust_fit import SCALE_PER_RESIDUAL
from hybridvo.solver.torch.newton import newton, small_inverse

# Gauss-Newton steps of a fit to the pixels that a network is sure of.
BATCH_FIT_STEPS = 6
# A step of a batch is taken if delta^T H delta is at most so many times its predicted decrease: 1
# / ``MIN_DECREASE``.
MAX_STEP_RATIO = 4.0

# Pixels that are worked on at once: on a CPU this takes half the time of all of them at once.
PART = 131_072
# Every n-th pixel gives the typical residual.
TYPICAL_STRIDE = 3
# Fraction of the golden section: multiples of it are evenly distributed.
GOLDEN_FRACTION = 0.6180339887498949
KERNELS = ("geman-mcclure", "cauchy", "huber", "l2")


class Pixels(NamedTuple):
    """Pixels of a batch in raster order; variances are relative to the typical one."""

    points: torch.Tensor  # (B, 3, N) metres, in the previous camera
    target: torch.Tensor  # (B, 2, N) px, x + F in the current image
    flow_variance: torch.Tensor  # (B, N)
    depth_variance: torch.Tensor  # (B, N)
    weight: torch.Tensor  # (B, N) external weight; 0 where a pixel cannot be used
    K: torch.Tensor  # (B, 3, 3) of the current camera

    @property
    def total(self) -> torch.Tensor:
        """Sum of the weights, (B,) float64."""
        return self.weight.double().sum(dim=1)

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Pixels:
        """Return the pixels with all fields but the camera changed."""
        return Pixels._make([*(change(x) for x in self[:5]), self.K])

    def parts(self, run: int = 1) -> Iterator[Pixels]:
        """Yield all pixels in parts that stay in the cache, in whole runs of ``run`` pixels."""
        step = run * max(1, PART // (len(self.weight) * run))
        pieces = [x.split(step, dim=-1) for x in self[:5]]
        for piece in zip(*pieces, strict=True):
            yield Pixels._make([*piece, self.K])

    def subset(self, count: int) -> Pixels:
        """Return about ``count`` usable pixels of each sample, evenly distributed.

        A sample with fewer has each of them once; the others get the weight 0.
        """
        rank = (self.weight > 0).long().cumsum(dim=1)
        usable = rank[:, -1:]
        count = min(count, rank.shape[1])
        k = torch.arange(count, device=rank.device, dtype=torch.float64)[None]
        distance = (usable / count).clamp(min=1)
        chosen = ((k + (k * GOLDEN_FRACTION).frac()) * distance).long()
        last = rank.shape[1] - 1
        index = torch.searchsorted(rank, chosen + 1).clamp(max=last)

        def take(x: torch.Tensor) -> torch.Tensor:
            places = index if x.ndim == index.ndim else index[:, None]
            return torch.take_along_dim(x, places, -1)

        taken = self.map(take)
        return taken._replace(weight=taken.weight * (chosen < usable))


def gather_pixels(batch: PairBatch, weights: torch.Tensor | None = None) -> Pixels:
    """Return the pixels of a batch; invalid values are replaced, so that no gradient is invalid.

    Args:
        batch: checked by :func:`checked_batch`.
        weights: (B, H, W) factors on the information, or None.
    """
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

    flow_variance = one
    if batch.flow_variance is not None:
        valid = batch.flow_variance > 0
        flow_variance, valid = _relative(batch.flow_variance, valid)
        smallest = 1 / float(kernels.MAX_RELATIVE_INFORMATION)
        flow_variance = flow_variance.clamp(min=smallest)
        usable = usable & valid
    depth_variance = one
    if batch.depth_variance is not None:
        valid = batch.depth_variance >= 0
        depth_variance, valid = _relative(batch.depth_variance, valid)
        largest = float(kernels.MAX_RELATIVE_VARIANCE)
        depth_variance = depth_variance.clamp(max=largest)
        usable = usable & valid
    weight = one
    if weights is not None:
        weight = torch.where((weights > 0) & (weights < MAX_DEPTH), weights, zero)
    if batch.valid is not None:
        usable = usable & batch.valid

    safe_depth = torch.where(usable, depth, one)
    points = rays(height, width, batch.K_prev) * safe_depth[..., None]
    target = torch.where(usable[..., None], target, torch.zeros_like(target))
    maps = (
        # one coordinate after the other in memory: half the time of all that follows
        points.movedim(3, 1).contiguous(),
        target.movedim(3, 1).contiguous(),
        flow_variance,
        depth_variance,
        torch.where(usable, weight, zero),
    )
    return Pixels._make([*(x.flatten(-2) for x in maps), batch.K_curr])


def _relative(
    variance: torch.Tensor, valid: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a variance in units of the typical one of its sample, and where it is valid."""
    scales = [typical(one) for one in variance.detach().cpu().numpy()]
    scale = variance.new_tensor(scales)[:, None, None]
    valid = valid & (variance < MAX_DEPTH)
    return torch.where(valid, variance, scale) / scale, valid


class RobustKernel(NamedTuple):
    """A robust kernel at squared distances d^2, each (B, N)."""

    cost: torch.Tensor  # rho
    weight: torch.Tensor  # w = 2 d rho / d d^2
    slope: torch.Tensor  # -2 (d w / d d^2) / w


class ResidualModel(NamedTuple):
    """How residuals are weighted: noise, cutoff and name of the robust kernel."""

    noise: torch.Tensor  # (B, 2) standard deviations: of the flow, px; of log depth
    cutoff: float  # c of the kernel, standard deviations
    name: str = "geman-mcclure"

    def kernel(self, d2: torch.Tensor) -> RobustKernel:
        """Return the robust kernel at squared distances."""
        c2 = self.cutoff**2
        ratio = c2 / (c2 + d2)
        if self.name == "geman-mcclure":
            return RobustKernel(0.5 * ratio * d2, ratio.square(), 4 * ratio / c2)
        if self.name == "cauchy":
            return RobustKernel(
                0.5 * c2 * torch.log1p(d2 / c2), ratio, 2 * ratio / c2
            )
        if self.name == "l2":
            return RobustKernel(0.5 * d2, torch.ones_like(d2), torch.zeros_like(d2))
        beyond = d2.clamp(min=c2)
        linear = (c2 * beyond).sqrt() - 0.5 * c2
        return RobustKernel(
            torch.where(d2 <= c2, 0.5 * d2, linear),
            (c2 / beyond).sqrt(),
            (d2 > c2) / beyond,
        )


def exact_depth_model(
    scale_px: torch.Tensor, kernel: str = "geman-mcclure"
) -> ResidualModel:
    """Return a kernel with scales (B,) in px, around depths without noise."""
    noise = torch.stack([scale_px, torch.zeros_like(scale_px)], dim=1)
    return ResidualModel(noise, 1.0, kernel)


class Residuals(NamedTuple):
    """Residuals at a pose, and where the points are visible."""

    r: torch.Tensor  # (B, 2, N) px, x + F - pi(X')
    ab: torch.Tensor  # (B, 2, N) X'/Z' and Y'/Z'
    i: torch.Tensor  # (B, N) 1/Z'
    front: torch.Tensor  # (B, N) 1 in front of the camera, else 0


def residuals(pixels: Pixels, T: torch.Tensor) -> Residuals:
    """Return the residuals at poses (B, 4, 4)."""
    x, y, z = move(T.to(pixels.points), pixels.points).unbind(1)
    front = (z > MIN_DEPTH).to(z)  # products are 15 times as fast as torch.where
    i = 1 / (z * front + (1 - front))
    ab = torch.stack([x, y], dim=1) * (i * front)[:, None]
    return Residuals(pixels.target - to_pixels(ab, pixels.K), ab, i, front)


class Weighted(NamedTuple):
    """Weighted residuals, taken at the depths that they make most likely.

    Their information, the inverse covariance times the weight, is
    ``information`` (I - kappa q q^T).
    """

    ab: torch.Tensor  # (B, 2, N) X'/Z' and Y'/Z'
    i: torch.Tensor  # (B, N) 1/Z'
    q: torch.Tensor  # (B, 2, N) d pi(X') / d log Z at the measured depth; elsewhere parallel to it
    kappa: torch.Tensor  # (B, N)
    focal: torch.Tensor  # (B, 2, 1)
    information: torch.Tensor  # (B, N)
    right: torch.Tensor  # (B, 2, N) w Sigma^-1 r
    distance2: torch.Tensor  # (B, N) squared Mahalanobis distance
    robust: torch.Tensor  # (B, N) robust weight, without the external one
    # (B, N) without the external weight; the full one behind the camera
    cost: torch.Tensor
    # (B, N) from the measured log depth to the likeliest, and how many times as long q is there
    shift: torch.Tensor
    stretch: torch.Tensor

    def jacobian_transpose(
        self, x: torch.Tensor, y: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the six rows of J^T (x, y), of the left tangent, for x and y (..., B, N)."""
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
        """Return the six rows (B, N) of w J^T Sigma^-1 r, whose sums are 0 at the estimate."""
        return self.jacobian_transpose(*self.right.unbind(1))

    def root(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the two rows (2, B, N) of R with R R^T = w Sigma^-1."""
        x, y = self.q.unbind(1)
        weight = self.information.sqrt()
        left_over = (1 - self.kappa * (x * x + y * y)).clamp(min=0)
        bend = self.kappa / (1 + left_over.sqrt())
        both = -weight * bend * x * y
        first = torch.stack([weight * (1 - bend * x * x), both])
        second = torch.stack([both, weight * (1 - bend * y * y)])
        return first, second

    def whitened_jacobian(self) -> torch.Tensor:
        """Return J^T R (2, B, 6, N) with R R^T = w Sigma^-1: its products sum to the Hessian."""
        return torch.stack(self.jacobian_transpose(*self.root()), dim=2)


def weigh(pixels: Pixels, T: torch.Tensor, model: ResidualModel) -> Weighted:
    """Return the residuals at poses (B, 4, 4) with their weights."""
    r, ab, i, front = residuals(pixels, T)
    t = T[:, :3, 3:].to(r)
    noise = model.noise[:, :, None]
    focal = pixels.K.diagonal(dim1=1, dim2=2)[:, :2, None]
    information = 1 / (noise[:, 0].square() * pixels.flow_variance)
    # variance of log depth over that of the flow
    ratio = noise[:, 1].square() * pixels.depth_variance * information
    q = focal * i[:, None] * (ab * t[:, 2:] - t[:, :2])
    length2 = q.square().sum(dim=1)
    along = (q * r).sum(dim=1)

    # to the log depth that the residuals make most likely, e away
    e = ratio * along / (1 + ratio * length2)
    e = e.clamp(-float(kernels.MAX_SHIFT), float(kernels.MAX_SHIFT))
    near = t[:, 2] * i
    nearer = 1 - (1 - near) * e
    stretch = nearer * (1 + near * e)
    ratio = ratio * stretch.square()
    kappa = ratio / (1 + ratio * length2)
    ab = ab + q * e[:, None] / focal
    i = i * nearer

    right = information[:, None] * (r - (kappa * along)[:, None] * q)
    in_front = (right * r).sum(dim=1).clamp(min=0) * front
    distance2 = in_front + BEHIND_DISTANCE2 * (1 - front)
    kernel = model.kernel(distance2)
    robust = kernel.weight * front
    w = pixels.weight * robust
    return Weighted(
        ab=ab,
        i=i,
        q=q,
        kappa=kappa,
        focal=focal,
        information=w * information,
        right=w[:, None] * right,
        distance2=distance2,
        robust=robust,
        cost=kernel.cost,
        shift=e,
        stretch=stretch,
    )


class NormalEquations(NamedTuple):
    """Robust normal equations of a batch at its poses, float64."""

    H: torch.Tensor  # (B, 6, 6) sum of w J^T Sigma^-1 J
    g: torch.Tensor  # (B, 6) sum of w J^T Sigma^-1 r
    cost: torch.Tensor  # (B,)
    weight: torch.Tensor  # (B,) sum of robust times external weights
    # see :class:`hybridvo.solver.torch.newton.Equations`
    curvature: torch.Tensor | None = None
    max_step_ratio: float = MAX_STEP_RATIO


def linearize(
    pixels: Pixels, T: pp.LieTensor, model: ResidualModel
) -> NormalEquations:
    """Return the normal equations at poses (B, 7)."""
    matrix = to_matrix(T)
    sums = []
    for part in pixels.parts():
        at = weigh(part, matrix, model)
        H = sum(root @ root.transpose(1, 2) for root in at.whitened_jacobian())
        g = torch.stack([row.sum(dim=1) for row in at.scores()], dim=1)
        cost = (part.weight * at.cost).sum(dim=1)
        weight = (part.weight * at.robust).sum(dim=1)
        sums.append((H, g, cost, weight))
    H, g, cost, weight = (
        torch.stack(values).double().sum(dim=0)
        for values in zip(*sums, strict=True)
    )
    return NormalEquations(H, g, cost, weight)


def newton_matrix(
    pixels: Pixels, T: pp.LieTensor, model: ResidualModel
) -> torch.Tensor:
    """Return A = -dg / d xi at poses (B, 7): (B, 6, 6), not symmetric, by autograd."""
    model = model._replace(noise=model.noise.detach())
    matrix = to_matrix(T).detach()
    slopes = torch.zeros(6, *matrix.shape).to(matrix)
    with torch.enable_grad():
        matrix.requires_grad_()
        for part in pixels.map(torch.Tensor.detach).parts():
            for k, score in enumerate(weigh(part, matrix, model).scores()):
                slopes[k] += torch.autograd.grad(
                    score.sum(), matrix, retain_graph=True
                )[0]
    generators = torch.zeros(6, 4, 4).to(slopes)
    generators[range(3), range(3), 3] = 1
    generators[3:, :3, :3] = pp.vec2skew(torch.eye(3).to(slopes))
    return -torch.einsum("kbpq,jpr,brq->bkj", slopes, generators, matrix.detach())


def total_score(
    pixels: Pixels, matrix: torch.Tensor, model: ResidualModel
) -> torch.Tensor:
    """Return g (B, 6), the sum of w J^T Sigma^-1 r at poses (B, 4, 4); 0 at the estimate."""
    at = weigh(pixels, matrix, model)
    return torch.stack([row.sum(dim=1) for row in at.scores()], dim=1)


class _NewtonStep(torch.autograd.Function):
    """The step A^-1 g with the value zero: at the solution it only carries the gradient."""

    @staticmethod
    def forward(ctx: Any, g: torch.Tensor, inverse: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(g, inverse)
        return torch.zeros_like(g, dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> tuple[torch.Tensor, None]:
        g, inverse = ctx.saved_tensors
        slope = (inverse.mT @ slopes[0].double()[..., None])[..., 0].to(g.dtype)
        if torch.is_grad_enabled():
            # with create_graph autograd would go on through this step, and be wrong
            slope = _OnceDifferentiable.apply(slope, g)
        return slope, None


class _OnceDifferentiable(torch.autograd.Function):
    """A gradient as it is, which cannot be differentiated again."""

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


def implicit_step(g: torch.Tensor, inverse: torch.Tensor) -> torch.Tensor:
    """Return the step A^-1 g (..., n) with the value zero, which carries the gradient.

    Args:
        g: (..., n), which is zero at the solution, with its gradient.
        inverse: (..., n, n) of A = -dg / d xi.
    """
    return _NewtonStep.apply(g, inverse)


def attach_implicit_gradient(
    T: pp.LieTensor,
    A: torch.Tensor,
    g: torch.Tensor,
    wanted: torch.Tensor | float = 1.0,
) -> pp.LieTensor:
    """Return the same poses with the gradient A^-1 dg (implicit function theorem).

    Args:
        T: (B, 7) solution of g = 0.
        A: (B, 6, 6) -dg / d xi.
        g: (B, 6) with its gradient.
        wanted: (B, 1) or a number, 0 where there shall be no gradient.
    """
    inverse, exists = small_inverse(A)
    step = implicit_step(g, inverse)
    return left_update(wanted * exists[:, None] * step, T)


def gauss_newton(
    pixels: Pixels,
    T: pp.LieTensor,
    model_at: Callable[[int, pp.LieTensor], ResidualModel],
    steps: int,
) -> pp.LieTensor:
    """Return poses (B, 7) after damped Gauss-Newton steps.

    Args:
        pixels: of the batch.
        T: (B, 7) where to begin.
        model_at: the residuals' model of a step's number, from 0, at poses.
        steps: all of which are made.
    """
    if steps == 0:
        return T

    def linearized(number: int, T: pp.LieTensor) -> NormalEquations:
        return linearize(pixels, T, model_at(number, T))

    return newton(linearized, moved, T, steps).state


def moved(
    T: pp.LieTensor, delta: torch.Tensor, at: NormalEquations
) -> pp.LieTensor:
    """Return poses (B, 7) after steps (B, 6)."""
    return left_update(delta, T)


def typical_residual(
    pixels: Pixels, T: pp.LieTensor, fraction: float = 0.5
) -> torch.Tensor:
    """Return the length (B,) of residual, px, that a fraction of the weight does not exceed.

    By default that is the weighted median. Without any weight it is 1.
    """
    every = pixels.map(lambda x: x[..., ::TYPICAL_STRIDE])
    at = residuals(every, to_matrix(T))
    length, order = at.r.norm(dim=1).sort(dim=1)
    reached = (every.weight * at.front).gather(1, order).cumsum(dim=1)
    wanted = fraction * reached[:, -1:]
    place = (reached < wanted).sum(dim=1, keepdim=True)
    found = length.gather(1, place.clamp(max=length.shape[1] - 1))[:, 0]
    return torch.where(reached[:, -1] > 0, found, 1.0)


def displacement(
    pixels: Pixels, T: pp.LieTensor, covariance: torch.Tensor
) -> torch.Tensor:
    """Return by how much the image moves under an error of poses, root mean square (B,), px.

    Args:
        pixels: whose weighted mean is taken.
        T: (B, 7) poses.
        covariance: (B, 6, 6) of their left perturbation; m^2, m rad, rad^2.
    """
    one_px = exact_depth_model(torch.ones_like(pixels.weight[:, 0]), "l2")
    at = linearize(pixels, T, one_px)
    trace = torch.einsum("bij,bji->b", at.H, covariance.double())
    return (trace / at.weight.clamp(min=1e-12)).clamp(min=0).sqrt()


def fit_pixels(
    pixels: Pixels, start: pp.LieTensor, smallest: float
) -> pp.LieTensor:
    """Fit a motion to weighted pixels, as the start of a refinement or a network's answer.

    The scale of the robust kernel follows the residuals. The gradient reaches the weights alone.
    Pixels far from the motion pull with constant strength (Huber), so that a network can learn
    that they are the static scene.

    Args:
        pixels: (B, N) of a batch; any unit of length in the image.
        start: (B, 7) poses to start from.
        smallest: smallest scale of the kernel, in the unit of the image.

    Returns:
        (B, 7) the motion; the start where that has residuals as small.
    """
    with torch.no_grad():
        fixed = pixels.map(torch.Tensor.detach)

        def model_at(_: int, T: pp.LieTensor) -> ResidualModel:
            width = SCALE_PER_RESIDUAL * typical_residual(fixed, T)
            return exact_depth_model(width.clamp(min=smallest))

        first = typical_residual(fixed, start)
        T = gauss_newton(fixed, start, model_at, BATCH_FIT_STEPS)
        scale = typical_residual(fixed, T)
        better = torch.isfinite(T.tensor()).all(dim=1) & (scale <= first)
        T = pp.SE3(torch.where(better[:, None], T.tensor(), start.tensor()))
        scale = torch.where(better, scale, first)
        width = (SCALE_PER_RESIDUAL * scale).clamp(min=smallest)
    if not pixels.weight.requires_grad:
        return T
    at = linearize(pixels, T, exact_depth_model(width, "huber"))
    return attach_implicit_gradient(T, at.H.detach(), at.g)
