"""The pose of every patch of an image by its own pixels, and their fusion.

A patch p has the normal equations of its pixels at a common pose T, see
:mod:`hybridvo.solver.torch.factors`::

    H_p = sum of w J^T A J        g_p = sum of w J^T A r        A = Sigma^-1 of a pixel

where w is the pixel's weight, such as P(static), times its robust weight. The errors of a patch's
pixels are alike. Those that its pixels share, E: the flow's along x and y, each as 1, u, v over
the patch, and one of log depth, have the variances S, and are marginalised::

    G = J^T A E     B = E^T A E     N = (S^-1 + B)^-1
    Lambda_p = H_p - G N G^T        xi_p = (Lambda_p + Lambda_0)^-1 (g_p - G N E^T A r)

``Exp(xi_p) T`` is the pose of the patch, Lambda_p what it is known by, and Lambda_0 keeps at zero
what a patch leaves open. Per direction that it determines, xi_p is off by the squared distance d_p;
the weighted median k of these is how much the errors of the pair exceed their model, and
a_p = (c^2 / (c^2 + d_p / k))^2 how far a patch agrees with the others. The poses are fused by their
information, their pixels' weights and their agreement::

    T <- Exp((sum a_p H_p)^-1 sum a_p g_p) T        C = max(1, k) (sum a_p Lambda_p)^-1

and all patches are linearised again, at the fused pose: the pose to which a patch converges alone
follows the local errors of its flow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch

from hybridvo.core.calibration import KERNEL_CUTOFF
from hybridvo.core.torch_geometry import left_update, pp, se3, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver.calibration import AGREEMENT_CUTOFF, PATCH_PRIOR_RAD
from hybridvo.solver.pixels import grid_stride
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.factors import Pixels, ResidualModel, Weighted
from hybridvo.solver.torch.tools import to_tiles

# About how many patches an image has. With 192 and with 12 the fused pose is as good on some
# clips and worse on others.
PATCHES = 48
# About how many pixels of an image its patches have.
PATCH_PIXELS = 20_000
# Width of the robust kernel in each pass over the patches, in flow noises of the hypothesis. From
# 3 px beside it, the fused pose comes back on all heavy pairs and 20 of 21 kitchen ones.
PATCH_SCALES = (4.0, 2.0, 1.0, 1.0)

# numerical guards: of a patch without any pixel, and of variances that are zero
SMALLEST_WEIGHT = 1e-12
SMALLEST_DEPTH_NOISE = 1e-6
SMALLEST_INVERSE_DEPTH = 1e-6


class FusedPose(NamedTuple):
    """A pose by the patches of each pair.

    Attributes:
        T_curr_prev: (B, 4, 4) metres, float64.
        covariance: (B, 6, 6) of its left perturbation; m^2, m rad, rad^2.
    """

    T_curr_prev: torch.Tensor
    covariance: torch.Tensor


@dataclass(frozen=True, eq=False)
class PatchPoses:
    """The poses of the P patches of B pairs, and what they fuse to.

    Tangents are left perturbations, translation before rotation: m, rad. All is float64.

    Attributes:
        at: (B, 4, 4) the pose at which all patches are linearised, metres.
        xi: (B, P, 6) the pose of a patch is ``Exp(xi) at``; 0 where it has no pixels.
        information: (B, P, 6, 6) Lambda, by which ``xi`` is known; 1 / m^2, 1 / (m rad), 1 / rad^2.
        covariance: (B, P, 6, 6) of ``xi``: (Lambda + Lambda_0)^-1.
        uncertainty_px: (B, P) by how much the image moves under the error that ``covariance``
            states, root mean square.
        share: (B, P) of the information of the pair, sums to 1.
        agreement: (B, P) in [0, 1], how far the patch agrees with the others.
        fused: the pose by all patches.
        grid: rows and columns of the patches.

    >>> import hybridvo as hvo
    >>> prev, curr, _ = hvo.example_frames()
    >>> pair = hvo.FramePair(prev, curr, hvo.dis_flow()(prev, curr).flow)
    >>> patches = hvo.PWVO.from_pretrained()(pair).patches
    >>> patches.grid, patches.xi.shape
    ((6, 8), torch.Size([1, 48, 6]))
    >>> patches.fused.T_curr_prev.shape
    torch.Size([1, 4, 4])
    """

    at: torch.Tensor
    xi: torch.Tensor
    information: torch.Tensor
    covariance: torch.Tensor
    uncertainty_px: torch.Tensor
    share: torch.Tensor
    agreement: torch.Tensor
    fused: FusedPose
    grid: tuple[int, int]

    @property
    def poses(self) -> torch.Tensor:
        """(B, P, 4, 4) ``T_curr_prev`` of every patch, metres."""
        return moved(self.xi, self.at)

    @property
    def surest(self) -> FusedPose:
        """The pose of the patch of least uncertainty."""
        best = self.uncertainty_px.argmin(dim=1)
        index = torch.arange(len(best), device=best.device)
        T = moved(self.xi[index, best][:, None], self.at)[:, 0]
        return FusedPose(T, self.covariance[index, best])

    @property
    def patch_mean(self) -> FusedPose:
        """The mean of the poses of patches with pixels, with the covariance of the fused one."""
        is_used = (self.share > 0).to(self.xi)[..., None]
        mean = (is_used * self.xi).sum(dim=1) / is_used.sum(dim=1).clamp(min=1)
        return FusedPose(moved(mean[:, None], self.at)[:, 0], self.fused.covariance)


def moved(xi: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    """Return ``Exp(xi) at`` (B, P, 4, 4) for tangents (B, P, 6) and poses (B, 4, 4)."""
    count = xi.shape[1]
    start = se3(at.double()).tensor().repeat_interleave(count, dim=0)
    T = left_update(xi.flatten(0, 1), pp.SE3(start))
    return to_matrix(T).unflatten(0, (-1, count))


def patch_poses(
    batch: PairBatch,
    T: torch.Tensor,
    weights: torch.Tensor | None,
    noise: torch.Tensor,
) -> PatchPoses:
    """Solve the normal equations of every patch at a pose that all patches fuse to.

    Differentiable with respect to flow, depth, intrinsics, variances, weights, noise and ``T``.

    Args:
        batch: pairs with flow, and depth of the previous frame.
        T: (B, 4, 4) ``T_curr_prev`` to start from, metres: a motion hypothesis.
        weights: (B, H, W) factors on the information, such as P(static); None: 1.
        noise: (B, 2) of the hypothesis: standard deviations of the flow, px, and of log depth.

    Returns:
        The patches. A pair without usable pixels has the pose ``T``.
    """
    patches = _cut(batch, weights)
    prior = _prior(patches)
    current = se3(T.double())
    for scale in PATCH_SCALES:
        at = current
        equations = _equations(patches, at, noise, scale)
        own = _own_poses(equations, prior)
        kept = own.agreement[..., None]
        H = (kept[..., None] * equations.H).sum(dim=1) + prior
        g = (kept * equations.g).sum(dim=1)
        step = (_inverse(H) @ g[..., None])[..., 0]
        current = left_update(step, at)
    stated = (kept[..., None] * equations.information).sum(dim=1) + prior
    covariance = own.inflation[:, None, None] * _inverse(stated)
    fused = _known(FusedPose(to_matrix(current), covariance), T, prior)
    per_patch = torch.einsum(
        "bpij,bji->bp", own.covariance, _image_motion(patches, at)
    )
    return PatchPoses(
        at=to_matrix(at),
        xi=own.xi,
        information=equations.information,
        uncertainty_px=per_patch.clamp(min=SMALLEST_WEIGHT).sqrt(),
        share=own.share,
        agreement=own.agreement,
        covariance=own.covariance,
        fused=fused,
        grid=patches.grid,
    )


def _known(fused: FusedPose, start: torch.Tensor, prior: torch.Tensor) -> FusedPose:
    """Return fused poses; where data are so odd that one is no number, the start (B, 4, 4)."""
    variances = fused.covariance.diagonal(dim1=1, dim2=2)
    numbers = torch.cat([x.flatten(1) for x in fused], dim=1)
    is_known = torch.isfinite(numbers).all(dim=1) & (variances > 0).all(dim=1)
    is_known = is_known[:, None, None]
    covariance = 0.5 * (fused.covariance + fused.covariance.mT)
    return FusedPose(
        torch.where(is_known, fused.T_curr_prev, start.double()),
        torch.where(is_known, covariance, _inverse(prior)),
    )


def _inverse(A: torch.Tensor) -> torch.Tensor:
    """Return inverses (..., n, n); of a singular one anything, without an exception."""
    inverse: torch.Tensor = torch.linalg.inv_ex(A).inverse
    return inverse


class _Patches(NamedTuple):
    """Some pixels of a batch, each patch as a sample."""

    pixels: Pixels  # (B P, ..., n)
    # (3, n) 1, and where a pixel lies in its patch, from -1 to 1
    position: torch.Tensor
    grid: tuple[int, int]  # rows and columns of patches

    def of_pairs(self, x: torch.Tensor) -> torch.Tensor:
        """Return values (B P, ...) of patches as those (B, P, ...) of pairs."""
        return x.unflatten(0, (-1, self.grid[0] * self.grid[1]))


def _cut(batch: PairBatch, weights: torch.Tensor | None) -> _Patches:
    """Cut the images of a batch into patches of pixels on a grid."""
    height, width = batch.depth_prev.shape[1:]
    stride = grid_stride((height, width), PATCH_PIXELS)
    every = slice(stride // 2, None, stride)
    rows = len(range(stride // 2, height, stride))
    columns = len(range(stride // 2, width, stride))
    side = max(1, round(math.sqrt(rows * columns / PATCHES)))
    grid = (-(-rows // side), -(-columns // side))

    def cut(x: torch.Tensor, fill: float = 1.0) -> torch.Tensor:
        x = x.unflatten(-1, (height, width))[..., every, every]
        # in single precision, what is left of H by the shared errors need not be positive
        return to_tiles(x.double(), side, fill)

    def cut_vectors(x: torch.Tensor) -> torch.Tensor:
        return cut(x).transpose(1, 2).flatten(0, 1)

    whole = factors.gather_pixels(batch, weights)
    pixels = Pixels(
        points=cut_vectors(whole.points),
        target=cut_vectors(whole.target),
        flow_variance=cut(whole.flow_variance).flatten(0, 1),
        depth_variance=cut(whole.depth_variance).flatten(0, 1),
        weight=cut(whole.weight, 0.0).flatten(0, 1),
        K=whole.K.double().repeat_interleave(grid[0] * grid[1], dim=0),
    )
    line = torch.linspace(-1, 1, side).to(pixels.weight)
    v, u = torch.meshgrid(line, line, indexing="ij")
    position = torch.stack([torch.ones_like(u), u, v]).flatten(1)
    return _Patches(pixels, position, grid)


def _prior(patches: _Patches) -> torch.Tensor:
    """Return Lambda_0 (B, 6, 6), at the typical depth of a pair."""
    weight = patches.of_pairs(patches.pixels.weight.detach() > 0).flatten(1)
    inverse = 1 / patches.of_pairs(patches.pixels.points.detach()[:, 2]).flatten(1)
    total = (weight * inverse).sum(dim=1)
    count = weight.sum(dim=1)
    # a pair without any pixel has none: as if it were at a metre
    inverse_depth = torch.where(count > 0, total / count.clamp(min=1), 1.0)
    metres = PATCH_PRIOR_RAD / inverse_depth.clamp(min=SMALLEST_INVERSE_DEPTH)
    angles = torch.full_like(metres, PATCH_PRIOR_RAD)
    stds = torch.stack([*[metres] * 3, *[angles] * 3], dim=1)
    return torch.diag_embed(stds**-2)


class _Equations(NamedTuple):
    """The normal equations of patches, and of the errors that their pixels share; float64."""

    H: torch.Tensor  # (B, P, 6, 6)
    g: torch.Tensor  # (B, P, 6)
    information: torch.Tensor  # (B, P, 6, 6) with the shared errors marginalised
    pull: torch.Tensor  # (B, P, 6) g with them marginalised


def _equations(
    patches: _Patches, T: pp.LieTensor, noise: torch.Tensor, scale: float
) -> _Equations:
    """Return the equations at poses (B, 7), under a kernel ``scale`` times as wide."""
    pixels = patches.pixels
    count = patches.grid[0] * patches.grid[1]
    factor = noise.new_tensor([scale, 1.0])
    kernel_noise = (factor * noise).repeat_interleave(count, dim=0)
    matrix = to_matrix(T).repeat_interleave(count, dim=0)
    model = ResidualModel(kernel_noise, KERNEL_CUTOFF)
    at = factors.weigh(pixels, matrix, model)
    # the six columns of J, then errors of each kind: along x and along y, (13, B P, n)
    none = torch.zeros_like(at.information)
    over_patch = patches.position[:, None].expand(-1, *none.shape)
    without = none.expand_as(over_patch)
    x = torch.cat([_jacobian(at, 0), over_patch, without, at.q[None, :, 0]])
    y = torch.cat([_jacobian(at, 1), without, over_patch, at.q[None, :, 1]])
    products, pulls = _sums(at, x, y)
    H, G, B = products[:, :6, :6], products[:, :6, 6:], products[:, 6:, 6:]
    g, e = pulls.split([6, len(x) - 6], dim=1)
    precision = _shared_precision(noise).repeat_interleave(count, dim=0)
    N = _inverse(torch.diag_embed(precision) + B)
    information = H - G @ N @ G.mT
    pull = g - (G @ N @ e[..., None])[..., 0]
    return _Equations(*map(patches.of_pairs, (H, g, information, pull)))


def _jacobian(at: Weighted, coordinate: int) -> torch.Tensor:
    """Return J (6, B P, n) of one of the two coordinates of pixels."""
    one = torch.ones_like(at.information)
    none = torch.zeros_like(one)
    direction = (one, none) if coordinate == 0 else (none, one)
    return torch.stack(at.jacobian_transpose(*direction))


def _sums(
    at: Weighted, x: torch.Tensor, y: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return products E^T A E (B P, m, m) and pulls E^T A r (B P, m) of columns E.

    Args:
        at: the weighted residuals, with A.
        x: (m, B P, n) the columns along x.
        y: (m, B P, n) along y.
    """
    along = at.kappa * (at.q[:, 0] * x + at.q[:, 1] * y)
    Ax = at.information * (x - along * at.q[:, 0])
    Ay = at.information * (y - along * at.q[:, 1])
    columns = torch.cat([x, y], dim=2).transpose(0, 1)
    weighed = torch.cat([Ax, Ay], dim=2).transpose(0, 1)
    residuals = at.right.flatten(1)[..., None]
    return columns @ weighed.mT, (columns @ residuals)[..., 0]


def _shared_precision(noise: torch.Tensor) -> torch.Tensor:
    """Return the inverse variances (B, 7) of the errors that the pixels of a patch share."""
    flow, depth = noise.split(1, dim=1)
    depth = depth.clamp(min=SMALLEST_DEPTH_NOISE)
    return torch.cat([flow.expand(-1, 6), depth], dim=1) ** -2


class _OwnPoses(NamedTuple):
    """What patches state by themselves, and of each other."""

    xi: torch.Tensor  # (B, P, 6)
    covariance: torch.Tensor  # (B, P, 6, 6)
    share: torch.Tensor  # (B, P)
    agreement: torch.Tensor  # (B, P)
    inflation: torch.Tensor  # (B,) k, at least 1


def _own_poses(equations: _Equations, prior: torch.Tensor) -> _OwnPoses:
    """Return the poses of patches by their own equations, and how far they agree."""
    information = equations.information
    covariance = _inverse(information + prior[:, None])
    xi = (covariance @ equations.pull[..., None])[..., 0]
    # directions that a patch determines
    determined = (information * covariance.mT).sum(dim=(2, 3))
    determined = determined.clamp(min=SMALLEST_WEIGHT)
    distance2 = torch.einsum("bpi,bpij,bpj->bp", xi, information, xi) / determined
    together = _inverse(information.sum(dim=1) + prior)
    share = torch.einsum("bpij,bji->bp", information, together).clamp(min=0)
    share = share / share.sum(dim=1, keepdim=True).clamp(min=SMALLEST_WEIGHT)
    typical = _weighted_median(distance2, share)[:, None]
    typical = typical.clamp(min=SMALLEST_WEIGHT)
    c2 = AGREEMENT_CUTOFF**2
    agreement = (c2 / (c2 + distance2 / typical)).square()
    inflation = typical[:, 0].clamp(min=1.0)
    return _OwnPoses(xi, covariance, share, agreement, inflation)


def _weighted_median(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Return the weighted median (B,) of values (B, P)."""
    values, order = x.sort(dim=1)
    reached = weight.detach().gather(1, order).cumsum(dim=1)
    place = (reached < 0.5 * reached[:, -1:]).sum(dim=1, keepdim=True)
    return values.gather(1, place.clamp(max=x.shape[1] - 1))[:, 0]


def _image_motion(patches: _Patches, T: pp.LieTensor) -> torch.Tensor:
    """Return the mean (B, 6, 6) of J^T J over the pixels of a pair: how its image moves, px^2."""
    pixels = patches.pixels
    count = patches.grid[0] * patches.grid[1]
    one_px = factors.exact_depth_model(torch.ones_like(pixels.weight[:, 0]), "l2")
    matrix = to_matrix(T).repeat_interleave(count, dim=0)
    at = factors.weigh(pixels, matrix, one_px)
    products, _ = _sums(at, _jacobian(at, 0), _jacobian(at, 1))
    total = patches.of_pairs(products).sum(dim=1)
    weight = patches.of_pairs(pixels.weight).sum(dim=(1, 2))
    return total / weight.clamp(min=SMALLEST_WEIGHT)[:, None, None]
