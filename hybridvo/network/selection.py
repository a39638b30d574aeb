"""Many pixel-wise poses -> one: the paper's selection (section 3.3), and a fit to trusted pixels.

In each patch the pixel of least uncertainty is chosen; the patches are then weighed. With
s = log U, U the Laplace scale that the network predicts:

``softmax``     weights softmax(-s), that is 1/U, as the published code: one over-confident patch
                cannot silence the rest as it does with 1/U^2.
``argmin``      the chosen pixels of all patches weigh alike.
``mean``        plain mean of all pixels, no patches: PWVO (naive), pixel-wise, VONet.
``exp_plus_u``  softmax(+U), as the paper prints it: it prefers the most uncertain pixels.
``joint``       softmax(-s) with one s for all six numbers, their mean: one pixel a patch.

A network tells better where the world is than how it moves: :func:`fitted_motion` solves the
ego-flow equation (paper, equation 8), weighed by s, and teaches s the doubt that the fit needs.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F

from hybridvo.checks import as_number, brief, check_kind
from hybridvo.errors import InputError
from hybridvo.network.inputs import NetworkInputs, pinhole
from hybridvo.refinement.torch_backend import lead_of, with_lead
from hybridvo.refinement.torch_factors import (
    Pixels,
    fit_pixels,
    residuals,
    to_tiles,
)
from hybridvo.results import PixelwisePrediction
from hybridvo.torch_geometry import euler_transform, se3
from hybridvo.types import check_dense

SELECTION_METHODS = ("softmax", "argmin", "mean", "exp_plus_u", "joint")

PATCH_ROWS = 4  # by default: the paper has 4x8 patches of 32 in 128x256
MAX_LOG_SCALE = 50.0  # log scales are clipped to it: exp stays finite in float32
SHARPNESS = 4.0
"""Where a motion is chosen weights go with exp(-4 s): errors of a mover's pixels are alike, and one
on two thirds of the image must not outvote the rest. Those of the refinement are the root, which
it squares while it chooses. On development pairs 8 did the same as 4."""
# in units of the largest: the refinement hears it where no other speaks
MIN_WEIGHT = 1e-2
MIN_SCALE = 1e-4  # least scale of the fit's kernel, focal lengths: 0.1 px at 1000
# the same of a patch's fit; error that is half explained
PATCH_SCALE = 1e-3
EXPLAINED_SCALE = 5e-3
STARTS = 5  # motions of a pair that a network of several passes is asked about


class PoseSeed(NamedTuple):
    """Where a refinement starts, and how much it heeds each pixel.

    Attributes:
        T_curr_prev: (B, 4, 4) motion, metres. It is marked with the ``lead``.
        weights: (B, H, W) in (0, 1] with the gradient of the rotation's s; None without
            uncertainty.
    """

    T_curr_prev: torch.Tensor
    weights: torch.Tensor | None

    @property
    def lead(self) -> torch.Tensor | None:
        """(B,) by how much log scales rise under other motions; None without uncertainty.

        ``refine`` takes it from ``T_curr_prev``, as evidence for its probability. To a part or a
        copy of the seed hand it as ``lead=``.
        """
        return lead_of(self.T_curr_prev)


def select(maps: PixelwisePrediction, method: str = "softmax") -> PoseSeed:
    """The paper's selection as the start of a refinement, with weights from the uncertainty.

    Args:
        maps: what a network such as ``PWVO`` says of a batch.
        method: ``softmax``, ``argmin``, ``mean``, ``exp_plus_u`` or ``joint``.

    Raises:
        InputError: for what is no prediction, and for an unknown method.
    """
    check_kind("select.maps", maps, PixelwisePrediction)
    check_kind("select.method", method, str)
    _check_maps(maps)
    T = select_motion(maps, method)
    if maps.log_scale is None:
        return PoseSeed(T, None)
    # a network that looked at one motion only cannot tell how much surer it is of it
    lead = T.new_zeros(len(T)) if maps.lead is None else maps.lead
    with_lead(T, lead.detach())
    s = _doubt(maps.log_scale)
    least = s.flatten(1).amin(dim=1)[:, None, None]
    weights = torch.exp(-SHARPNESS / 2 * (s - least)).clamp(min=MIN_WEIGHT)
    if maps.image_size is not None:
        weights = F.interpolate(weights[:, None], maps.image_size, mode="bilinear")[
            :, 0
        ]
    return PoseSeed(T, weights)


def _check_maps(maps: PixelwisePrediction) -> None:
    """Check the shapes and types of a prediction."""
    check_kind("select.maps.motion", maps.motion, torch.Tensor)
    shape = tuple(maps.motion.shape)
    is_map = len(shape) == 4 and shape[1] == 6 and min(shape) > 0
    wanted: dict[str, tuple[object, ...]] = {
        "motion": shape if is_map else ("B", 6, "h", "w")
    }
    if maps.log_scale is not None:
        wanted["log_scale"] = wanted["motion"]
    if maps.lead is not None:
        wanted["lead"] = wanted["motion"][:1]
    for name, expected in wanted.items():
        value = getattr(maps, name)
        check_kind(f"select.maps.{name}", value, torch.Tensor)
        check_dense(f"select.maps.{name}", value)
        if tuple(value.shape) != expected or not value.is_floating_point():
            got = f"{value.dtype} of shape {tuple(value.shape)}"
            text = f"floating point of shape {expected}"
            raise InputError(f"select.maps.{name}: expected {text}, got {got}.")
    if maps.image_size is None:
        return
    check_kind("select.maps.image_size", maps.image_size, tuple)
    if len(maps.image_size) != 2 or not all(
        as_number(n) >= 1 for n in maps.image_size
    ):
        got = brief(maps.image_size)
        raise InputError(f"select.maps.image_size: expected (H, W), got {got}.")


def _doubt(log_scale: torch.Tensor) -> torch.Tensor:
    """(B, h, w) mean log scale of a pixel's rotation, finite."""
    limit = MAX_LOG_SCALE
    return torch.nan_to_num(
        log_scale[:, :3].mean(dim=1), limit, limit, -limit
    ).clamp(-limit, limit)


def select_motion(
    maps: PixelwisePrediction, method: str = "softmax"
) -> torch.Tensor:
    """(B, 4, 4) T_curr_prev of a prediction, see :func:`select_pose`."""
    return euler_transform(select_pose(maps, method))


def select_pose(
    maps: PixelwisePrediction, method: str = "softmax", patch: int | None = None
) -> torch.Tensor:
    """One motion of each pair: (B, 6) Euler angles X-Y-Z in degrees, then metres; differentiable.

    Values that are not finite are never chosen while their patch has another; a pair without any
    gives zero motion; without uncertainty the method is ``mean``. ``patch``: side in cells.
    """
    if method not in SELECTION_METHODS:
        raise InputError(
            f"select: method {method!r} unknown; known: {', '.join(SELECTION_METHODS)}."
        )
    value = maps.motion
    s = maps.log_scale
    if s is None or method == "mean":
        finite = torch.isfinite(value)
        total = torch.where(finite, value, 0.0).sum(dim=(2, 3))
        return total / finite.sum(dim=(2, 3)).clamp(min=1)
    usable = torch.isfinite(value) & torch.isfinite(s)
    if method == "joint":
        usable = usable.all(dim=1, keepdim=True).expand_as(usable)
    value = torch.where(usable, value, 0.0)
    s = torch.where(usable, s, 0.0).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    if method == "joint":
        s = s.mean(dim=1, keepdim=True).expand_as(s)
    height, width = value.shape[2:]
    side = min(patch or -(-height // PATCH_ROWS), max(height, width))

    def patches(x: torch.Tensor, fill: float = 0.0) -> torch.Tensor:
        return to_tiles(x, side, fill)

    # Padding that completes the last patches is infinitely uncertain: as every patch holds at least
    # one real pixel, and real ones rank below infinity, padding never wins.
    rank = torch.where(usable, s, torch.finfo(s.dtype).max).detach()
    winner = patches(rank, torch.inf).argmin(dim=-1, keepdim=True)
    chosen, s, known = (
        patches(x).gather(-1, winner)[..., 0]
        for x in (value, s, usable.to(value.dtype))
    )
    logits = {"argmin": 0 * s, "exp_plus_u": s.exp()}.get(method, -s)
    # where no patch is known the weights are uniform over zeros
    known = known.bool() | ~known.bool().any(dim=-1, keepdim=True)
    return (
        torch.softmax(logits.masked_fill(~known, -torch.inf), dim=-1) * chosen
    ).sum(dim=-1)


def fitted_motion(
    maps: PixelwisePrediction, inputs: NetworkInputs, selection: str = "softmax"
) -> torch.Tensor:
    """(B, 4, 4) motion of the pixels that a prediction trusts, with the gradient of log scales."""
    if maps.log_scale is None:
        raise InputError("fitted_motion: expected a prediction with uncertainty.")
    inputs = inputs.on_grid_of(maps.log_scale)
    weights = pixel_weights(maps.log_scale, inputs.valid)
    with torch.autocast(weights.device.type, enabled=False):
        pixels = _pixels(inputs, weights).map(lambda x: x.flatten(-2))
        T = fit_pixels(
            pixels, se3(select_motion(maps, selection).detach().double()), MIN_SCALE
        )
    return T.matrix().to(pixels.weight)


@torch.no_grad()
def starting_motions(
    maps: PixelwisePrediction, inputs: NetworkInputs, selection: str = "softmax"
) -> torch.Tensor:
    """(B, S, 4, 4) motions that the scene may have: of all trusted pixels, then of patches.

    Each patch has the motion fitted to its pixels; in turn the one is taken that explains most of
    what none before does.
    """
    first = fitted_motion(maps, inputs, selection)
    inputs = inputs.on_grid_of(maps.motion)
    batch = len(first)
    side = -(-maps.motion.shape[2] // PATCH_ROWS)
    with torch.autocast(first.device.type, enabled=False):
        pixels = _pixels(inputs, inputs.valid)
        tiles = pixels.map(lambda x: to_tiles(x, side).movedim(-2, 1).flatten(0, 1))
        count = len(tiles.weight) // batch
        tiles = tiles._replace(K=pixels.K.repeat_interleave(count, dim=0))
        start = se3(first.double().repeat_interleave(count, dim=0))
        fitted = (
            fit_pixels(tiles, start, PATCH_SCALE)
            .matrix()
            .to(first)
            .unflatten(0, (batch, -1))
        )
        tried = torch.cat([first[:, None], fitted], dim=1)
        every = pixels.map(
            lambda x: x.flatten(-2).repeat_interleave(count + 1, dim=0)
        )
        every = every._replace(K=pixels.K.repeat_interleave(count + 1, dim=0))
        error = residuals(every, tried.flatten(0, 1))[0].square().sum(dim=1)
    explained = every.weight / (1 + error / EXPLAINED_SCALE**2)
    explained = explained.unflatten(0, (batch, -1))
    chosen = [first]
    best = explained[:, 0]
    for _ in range(STARTS - 1):
        gain = (explained - best[:, None]).clamp(min=0).sum(dim=2)
        taken = torch.arange(batch, device=gain.device), gain.argmax(dim=1)
        chosen.append(tried[taken])
        best = torch.maximum(best, explained[taken])
    return torch.stack(chosen, dim=1)


def _pixels(inputs: NetworkInputs, weights: torch.Tensor) -> Pixels:
    """Maps of what a fit needs of its pixels, in units of the focal length."""
    # over it, flow of an image that was squeezed counts alike in both directions
    focal, centre = pinhole(inputs.K_curr)
    target = (inputs.pixels + inputs.flow - centre) / focal
    depth = 1 / torch.where(inputs.valid, inputs.inverse_depth[:, 0], 1.0)[:, None]
    points = torch.cat([inputs.rays * depth, depth], dim=1)
    one = torch.ones_like(depth[:, 0])
    unit = torch.eye(3).to(points).expand(len(one), 3, 3)
    return Pixels(points, target, one, one, weights.to(one), unit)


def pixel_weights(log_scale: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    """(B, h, w) weights of a fit from log scales (B, 6, h, w): 0 where invalid, their sum one."""
    s = torch.where(valid, -SHARPNESS * _doubt(log_scale), -1e4)
    return torch.softmax(s.flatten(1), dim=1).view_as(s) * valid
