"""The paper's selection (section 3.3): one motion from the poses of many pixels.

In each patch the pixel of least uncertainty is chosen; then the chosen pixels are
averaged. With s = log U, U the Laplace scale that the network predicts, the methods are:

``softmax``     weights softmax(-s), that is 1/U, as the published code. With 1/U^2 one
                over-confident patch could outweigh all others.
``argmin``      equal weights.
``mean``        the mean of all pixels, without patches: PWVO (naive), pixel-wise, VONet.
``exp_plus_u``  softmax(+U), as the paper prints it: it prefers the most uncertain pixels.
``parts``       softmax(-s) with one s for the rotation and one for the translation: one pixel of
                a patch for each, as the text of the paper has it. The code takes six.
``joint``       softmax(-s) with one s for all six numbers, their mean: one pixel a patch.

Where patches have poses by their own pixels, with a covariance each, the start of a refinement
is one of these:

``fused``       all patches by their information, belief and agreement; the default.
``surest``      the patch of least uncertainty alone: the limit of the paper's selection.
``patch_mean``  the mean of the patches, as if nothing were known of their uncertainty.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from hybridvo.core.checks import as_number, brief, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import check_dense
from hybridvo.network.euler import euler_transform
from hybridvo.solver.torch.tools import (
    PoseSeed,
    to_tiles,
)

# over the largest weight: pixels of large uncertainty decide only where there are
# no others
MIN_SEED_WEIGHT = 1e-2
# of a pixel without flow or depth, at least: 20 degrees or 20 m
INVALID_LOG_SCALE = 3.0

SELECTION_METHODS = ("softmax", "argmin", "mean", "exp_plus_u", "parts", "joint")
CHOSEN_TOGETHER = {"parts": 3, "joint": 6}
"""Components of a motion for which a method chooses one pixel; 1 by default."""
PATCH_METHODS = ("fused", "surest", "patch_mean")
PATCH_ROWS = 4
"""Rows of patches by default: the paper has 4x8 patches of 32 pixels in 128x256."""
MAX_LOG_SCALE = 50.0
"""Limit of log scales: exp stays finite in float32."""


MOTION_SIZE = 6
"""Components of a motion: three angles and a translation."""
EVIDENCE = 4
"""Numbers that speak for the motion of a map."""
MAP_DIMENSIONS = 4
"""Of a batch of motions by pixel, (B, 6, h, w)."""
IMAGE_DIMENSIONS = 2
"""Height and width."""


def select(maps: PixelwisePrediction, method: str | None = None) -> PoseSeed:
    """Select the start of a refinement, with weights from the uncertainty.

    Args:
        maps: the prediction of a network such as ``PWVO`` for a batch.
        method: for patches ``fused``, ``surest`` or ``patch_mean``; for pixels ``softmax``,
            ``argmin``, ``mean``, ``exp_plus_u``, ``parts`` or ``joint``; None: ``fused``, and
            without patches ``softmax``.

    Returns:
        The motions (B, 4, 4), and the weights (B, H, W) of their pixels, in (0, 1], with the
        gradient of the rotation's log scales; None without uncertainty.

    Raises:
        InputError: the maps are no prediction, or the method is unknown.

    Two halves of an image disagree; the surer one wins:

    >>> motion = torch.zeros(1, 6, 4, 8)
    >>> motion[:, 5, :, 4:] = 1.0  # metres along z
    >>> log_scale = torch.full((1, 6, 4, 8), -6.0)
    >>> log_scale[..., 4:] = 6.0
    >>> seed = select(PixelwisePrediction(motion, log_scale))
    >>> round(float(seed.T_curr_prev[0, 2, 3]), 3)
    0.0
    """
    check_kind("select.maps", maps, PixelwisePrediction)
    check_kind("select.method", method, str, type(None))
    _check_maps(maps)
    if method is None:
        method = "softmax" if maps.patches is None else "fused"
    covariance = None
    if method not in (*SELECTION_METHODS, *PATCH_METHODS):
        known = ", ".join((*PATCH_METHODS, *SELECTION_METHODS))
        raise InputError(f"select: method {method!r} unknown; known: {known}.")
    if method in PATCH_METHODS:
        T, covariance = _of_patches(maps, method)
    else:
        T = select_motion(maps, method)
    if maps.log_scale is None:
        return PoseSeed(T, None)
    evidence = maps.evidence
    if evidence is None:
        # the network was used for one motion only: no evidence either way
        evidence = T.new_full((len(T), EVIDENCE), torch.nan)
    return PoseSeed(T, seed_weights(maps), evidence.detach(), covariance)


def _of_patches(
    maps: PixelwisePrediction, method: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """(B, 4, 4) the motion by the poses of patches, and (B, 6, 6) its covariance."""
    patches = maps.patches
    if patches is None:
        raise InputError(
            f"select: method {method!r} needs the poses of patches, which PWVO predicts where "
            "the extra train is installed: pip install 'hybridvo[train]'."
        )
    fused = getattr(patches, method)
    return fused.T_curr_prev.to(maps.motion.dtype), fused.covariance.detach()


def seed_weights(maps: PixelwisePrediction) -> torch.Tensor:
    """(B, H, W) weights of a refinement by the uncertainty, in units of the largest.

    They are the square root of the weights of a fit, because the refinement squares them
    while it still chooses among motions.
    """
    assert maps.log_scale is not None
    image_size = maps.image_size
    s = rotation_log_scale(maps.log_scale)
    smallest = s.flatten(1).amin(dim=1)[:, None, None]
    weights = torch.exp(smallest - s)
    weights = weights.clamp(min=MIN_SEED_WEIGHT)
    if image_size is None:
        return weights
    return F.interpolate(weights[:, None], image_size, mode="bilinear")[:, 0]


def _check_maps(maps: PixelwisePrediction) -> None:
    """Check the shapes and types of a prediction."""
    check_kind("select.maps.motion", maps.motion, torch.Tensor)
    shape = tuple(maps.motion.shape)
    has_components = len(shape) == MAP_DIMENSIONS and shape[1] == MOTION_SIZE
    is_map = has_components and min(shape) > 0
    map_shape: tuple[object, ...] = (
        shape if is_map else ("B", MOTION_SIZE, "h", "w")
    )
    _check_floats("motion", maps.motion, map_shape)
    if maps.log_scale is not None:
        _check_floats("log_scale", maps.log_scale, map_shape)
    if maps.evidence is not None:
        _check_floats("evidence", maps.evidence, (*map_shape[:1], EVIDENCE))
    if maps.image_size is None:
        return
    check_kind("select.maps.image_size", maps.image_size, tuple)
    is_positive = all(as_number(n) >= 1 for n in maps.image_size)
    if len(maps.image_size) != IMAGE_DIMENSIONS or not is_positive:
        got = brief(maps.image_size)
        raise InputError(f"select.maps.image_size: expected (H, W), got {got}.")


def _check_floats(name: str, value: object, expected: tuple[object, ...]) -> None:
    """Check that a part of a prediction is a floating-point tensor of a shape."""
    where = f"select.maps.{name}"
    check_kind(where, value, torch.Tensor)
    assert isinstance(value, torch.Tensor)
    check_dense(where, value)
    if tuple(value.shape) != expected or not value.is_floating_point():
        got = f"{value.dtype} of shape {tuple(value.shape)}"
        raise InputError(
            f"{where}: expected floating point of shape {expected}, got {got}."
        )


def rotation_log_scale(log_scale: torch.Tensor) -> torch.Tensor:
    """Mean log scale of a pixel's rotation, (B, h, w), limited; NaN becomes the largest."""
    mean = log_scale[:, :3].mean(dim=1)
    finite = torch.nan_to_num(mean, MAX_LOG_SCALE, MAX_LOG_SCALE, -MAX_LOG_SCALE)
    return finite.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)


def select_motion(
    maps: PixelwisePrediction, method: str = "softmax"
) -> torch.Tensor:
    """``T_curr_prev`` (B, 4, 4) of a prediction, see :func:`select_pose`."""
    return euler_transform(select_pose(maps, method))


def select_pose(
    maps: PixelwisePrediction, method: str = "softmax", patch: int | None = None
) -> torch.Tensor:
    """Select one motion of each pair; differentiable.

    A value that is not finite is never chosen while its patch has another. A pair without
    any has zero motion. Without uncertainty the method is ``mean``.

    Args:
        maps: a prediction for B pairs.
        method: one of ``SELECTION_METHODS``.
        patch: side of the patches, in pixels of the maps; None: four rows of patches.

    Returns:
        (B, 6) Euler angles X-Y-Z in degrees, then metres.

    Raises:
        InputError: for an unknown method.
    """
    if method not in SELECTION_METHODS:
        raise InputError(
            f"select: method {method!r} unknown; known: {', '.join(SELECTION_METHODS)}."
        )
    if maps.log_scale is None or method == "mean":
        return _finite_mean(maps.motion)
    motion, s, usable = _usable_values(maps.motion, maps.log_scale, method)
    height, width = motion.shape[2:]
    side = patch or -(-height // PATCH_ROWS)
    side = min(side, max(height, width))

    # Padding completes the last patches. Its rank is infinite and that of real pixels is
    # not, and every patch holds at least one real pixel: padding is never chosen.
    rank = torch.where(usable, s, torch.finfo(s.dtype).max).detach()
    winner = to_tiles(rank, side, torch.inf).argmin(dim=-1, keepdim=True)

    def of_winner(x: torch.Tensor) -> torch.Tensor:
        return to_tiles(x, side).gather(-1, winner)[..., 0]

    motion_of_patch = of_winner(motion)
    s_of_patch = of_winner(s)
    is_usable = of_winner(usable.to(motion.dtype)).bool()
    # where no patch has a usable pixel, the weights are uniform over zeros
    is_usable |= ~is_usable.any(dim=-1, keepdim=True)
    logits = _logits(s_of_patch, method).masked_fill(~is_usable, -torch.inf)
    return (torch.softmax(logits, dim=-1) * motion_of_patch).sum(dim=-1)


def _finite_mean(motion: torch.Tensor) -> torch.Tensor:
    """(B, 6) mean over the finite values of maps (B, 6, h, w)."""
    is_finite = torch.isfinite(motion)
    total = torch.where(is_finite, motion, 0.0).sum(dim=(2, 3))
    return total / is_finite.sum(dim=(2, 3)).clamp(min=1)


def _usable_values(
    motion: torch.Tensor, s: torch.Tensor, method: str
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Motion and log scales with 0 where one is not finite, and where both are.

    The components of a pixel that are chosen together have one log scale.
    """
    usable = torch.isfinite(motion) & torch.isfinite(s)
    size = CHOSEN_TOGETHER.get(method, 1)
    # (B, groups, components of a group, h, w)
    usable = usable.unflatten(1, (-1, size)).all(dim=2, keepdim=True)
    usable = usable.expand(-1, -1, size, -1, -1).flatten(1, 2)
    motion = torch.where(usable, motion, 0.0)
    s = torch.where(usable, s, 0.0).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    s = s.unflatten(1, (-1, size)).mean(dim=2, keepdim=True)
    return motion, s.expand(-1, -1, size, -1, -1).flatten(1, 2), usable


def _logits(s: torch.Tensor, method: str) -> torch.Tensor:
    """Logits of the patches' weights from the log scales of their chosen pixels."""
    if method == "argmin":
        return 0 * s
    if method == "exp_plus_u":
        return s.exp()
    return -s
