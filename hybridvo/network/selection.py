"""Many pixel-wise poses -> one: the paper's selection module (section 3.3) and its alternatives.

In each patch the pixel of least uncertainty speaks; the patches' voices are then weighed. With
s = log U, U the Laplace scale that the network predicts:

========================  =========================================================================
``softmax``               weights softmax(-s), that is 1/U: what the published code computes.
                          Default: the certain speak louder, and one over-confident patch cannot
                          silence the rest as it does with 1/U^2.
``min_variance``          softmax(-2s), that is 1/U^2: least variance if the scales are exact and
                          the patches independent.
``median``                weighted median with weights 1/U: the maximum-likelihood estimate under
                          the Laplace model; indifferent to a mover that holds a minority.
``mean``                  plain mean of all pixels, no patches: PWVO (naive), pixel-wise.
``paper``                 softmax(+U) as the paper prints it. It prefers the most uncertain of the
                          chosen pixels; kept for the record.
========================  =========================================================================
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F

from hybridvo.errors import InputError
from hybridvo.types import PixelwisePrediction

__all__ = [
    "SELECTION_METHODS",
    "chosen_motion",
    "chosen_pose",
    "select",
    "selected_transform",
]

SELECTION_METHODS = ("softmax", "min_variance", "median", "mean", "paper")

PATCH_ROWS = 4
"""Rows of patches when no patch size is given: the paper has 4x8 patches of 32 in 128x256."""

MAX_LOG_SCALE = 60.0
"""Log scales are clipped to this magnitude, so that exp stays finite in float32."""


def select(
    prediction: PixelwisePrediction,
    method: str = "softmax",
    patch: int | None = None,
    joint: bool = False,
) -> tuple[torch.Tensor, torch.Tensor]:
    """One rotation and one translation per pair from the pixel-wise predictions.

    Differentiable in the predictions and, through the weights, in the log scales (``median`` in
    the predictions only); the choice of the pixel has no gradient. Values that are not finite are
    never chosen while their patch has another, and a patch without any has no voice; a pair
    without any gives zero motion.

    Args:
        prediction: maps of (B, 3, h, w).
        method: one of ``SELECTION_METHODS``, see the table above.
        patch: side of the square patches in cells of the prediction's grid; patches at the right
            and lower border may be smaller. A quarter of the height by default: 32 at 128x256 (the
            paper), 16 for the 64x128 maps of a network with ``head_stride=2``.
        joint: False = each of the six numbers has its own pixels and weights (published
            evaluation); True = the three of the rotation share theirs, as do the three of the
            translation: least sum of s, weights from the mean of s.

    Returns:
        (B, 3) Euler angles X-Y-Z in degrees and (B, 3) translation in metres, of T_curr_prev.

    Raises:
        InputError: unknown method, patch below 1, what is no prediction, maps that are no dense
            floating-point tensors, of the wrong shape or on several devices, or a prediction
            without uncertainty for a method that needs it.

    Example:
        >>> import torch
        >>> from hybridvo.types import PixelwisePrediction
        >>> maps = torch.ones(1, 3, 64, 128)
        >>> prediction = PixelwisePrediction(2 * maps, maps, 0 * maps, 0 * maps)
        >>> select(prediction)[0].tolist()
        [[2.0, 2.0, 2.0]]
    """
    if not isinstance(method, str) or method not in SELECTION_METHODS:
        raise InputError(
            f"select: method {method!r} unknown; known: {', '.join(SELECTION_METHODS)}."
        )
    if not isinstance(joint, bool):
        raise InputError(f"select: expected joint to be True or False, got {joint!r}.")
    _check(prediction, needs_scale=method != "mean")
    height, width = prediction.rotation.shape[2:]
    patch = -(-height // PATCH_ROWS) if patch is None else patch
    if isinstance(patch, bool) or not isinstance(patch, int) or patch < 1:
        raise InputError(f"select: expected a patch side of at least 1 cell, got {patch!r}.")
    patch = min(patch, max(height, width))  # a larger one is the whole map, and padding
    pairs = (
        (prediction.rotation, prediction.log_scale_rotation),
        (prediction.translation, prediction.log_scale_translation),
    )
    rotation, translation = (
        _mean(value)
        if scale is None or method == "mean"
        else _vote(value, scale, method, patch, joint)
        for value, scale in pairs
    )
    return rotation, translation


def selected_transform(rotation_deg: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    """Rigid transform T_curr_prev of a selected pose, differentiable everywhere.

    Args:
        rotation_deg: (B, 3) Euler angles X-Y-Z in degrees, R = Rx Ry Rz.
        translation: (B, 3) metres.

    Returns:
        (B, 4, 4), of the wider of the two types.

    Raises:
        InputError: shapes other than (B, 3).
    """
    for name, x in (("rotation_deg", rotation_deg), ("translation", translation)):
        if x.ndim != 2 or x.shape[1] != 3 or x.shape[0] != rotation_deg.shape[0]:
            raise InputError(
                f"selected_transform: expected {name} of shape (B, 3), got {tuple(x.shape)}."
            )
    # Written out, not multiplied: a matrix product would run in bfloat16 under autocast.
    (cx, cy, cz), (sx, sy, sz) = (
        f(torch.deg2rad(rotation_deg)).unbind(1) for f in (torch.cos, torch.sin)
    )
    tx, ty, tz = translation.unbind(1)
    zero, one = torch.zeros_like(tx), torch.ones_like(tx)
    rows = (
        (cy * cz, -cy * sz, sy, tx),
        (cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy, ty),
        (sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy, tz),
        (zero, zero, zero, one),
    )
    return torch.stack([torch.stack(torch.broadcast_tensors(*row), dim=1) for row in rows], dim=1)


def chosen_pose(
    output: PixelwisePrediction | tuple[torch.Tensor, torch.Tensor], method: str = "softmax"
) -> tuple[torch.Tensor, torch.Tensor]:
    """(rotation_deg (B, 3), translation (B, 3)) of any network's output.

    Args:
        output: maps, or the pose itself (VONet).
        method: of :func:`select`; maps without uncertainty are averaged whatever it says.
    """
    if not isinstance(output, PixelwisePrediction):
        return output
    return select(output, "mean" if output.log_scale_rotation is None else method)


def chosen_motion(
    output: PixelwisePrediction | tuple[torch.Tensor, torch.Tensor], method: str = "softmax"
) -> torch.Tensor:
    """(B, 4, 4) T_curr_prev of any network's output, see :func:`chosen_pose`."""
    return selected_transform(*chosen_pose(output, method))


def _check(prediction: PixelwisePrediction, needs_scale: bool) -> None:
    """Refuse what is no prediction, and maps that do not belong to each other."""
    if not isinstance(prediction, PixelwisePrediction):
        raise InputError(
            f"select: expected a PixelwisePrediction, got {type(prediction).__name__}."
        )
    rotation = _checked_map("rotation", prediction.rotation)
    shape = tuple(rotation.shape)
    if len(shape) != 4 or shape[1] != 3 or 0 in shape[2:]:
        raise InputError(f"select: expected rotation maps of shape (B, 3, h, w), got {shape}.")
    maps = {
        "translation": prediction.translation,
        "log_scale_rotation": prediction.log_scale_rotation,
        "log_scale_translation": prediction.log_scale_translation,
    }
    for name, value in maps.items():
        if value is None and name != "translation":
            if needs_scale:
                raise InputError(
                    f"select: the prediction has no {name}; a network without uncertainty can "
                    f"only be averaged: method='mean'."
                )
            continue
        value = _checked_map(name, value)
        if tuple(value.shape) != shape:
            raise InputError(f"select: expected {name} of {shape}, got {tuple(value.shape)}.")
        if value.device != rotation.device:
            raise InputError(
                f"select: expected {name} on {rotation.device} as the rotation, got "
                f"{value.device}. Move it with .to()."
            )


def _checked_map(name: str, value: Any) -> torch.Tensor:
    """``value`` if it is a dense tensor of real numbers, which all that follows computes with."""
    if not isinstance(value, torch.Tensor):
        raise InputError(
            f"select: expected {name} as a torch tensor, got {type(value).__name__}. "
            f"torch.as_tensor converts arrays and lists."
        )
    if not value.is_floating_point():
        raise InputError(
            f"select: expected {name} of a floating-point type, got {value.dtype}. "
            f"Convert it with .float()."
        )
    if value.layout is not torch.strided or value.is_nested:
        raise InputError(
            f"select: expected {name} as a dense tensor, got layout {value.layout}. "
            f"Convert it with .to_dense()."
        )
    return value


def _mean(value: torch.Tensor) -> torch.Tensor:
    """(B, 3, h, w) -> (B, 3), over the finite pixels."""
    finite = torch.isfinite(value)
    total = torch.where(finite, value, 0.0).sum(dim=(2, 3))
    return total / finite.sum(dim=(2, 3)).clamp(min=1)


def _vote(
    value: torch.Tensor, log_scale: torch.Tensor, method: str, patch: int, joint: bool
) -> torch.Tensor:
    """(B, 3, h, w) values and log scales -> (B, 3)."""
    usable = torch.isfinite(value) & torch.isfinite(log_scale)
    if joint:
        usable = usable.all(dim=1, keepdim=True).expand_as(usable)
    value = torch.where(usable, value, 0.0)
    log_scale = torch.where(usable, log_scale, 0.0).clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE)
    if joint:
        log_scale = log_scale.mean(dim=1, keepdim=True).expand_as(log_scale)
    # Padding that completes the last patches is infinitely uncertain and unusable: as every patch
    # holds at least one real pixel, and real ones rank below infinity, padding never wins.
    rank = torch.where(usable, log_scale, torch.finfo(log_scale.dtype).max).detach()
    winner = _patches(rank, patch, torch.inf).argmin(dim=-1, keepdim=True)
    chosen, chosen_scale = (
        _patches(x, patch, 0.0).gather(-1, winner)[..., 0] for x in (value, log_scale)
    )
    heard = _patches(usable.to(value.dtype), patch, 0.0).gather(-1, winner)[..., 0] > 0
    if method == "paper":
        logits = chosen_scale.exp()
    else:
        logits = -2 * chosen_scale if method == "min_variance" else -chosen_scale
    # Where nobody is heard the weights are uniform over zeros.
    nobody = ~heard.any(dim=-1, keepdim=True)
    weights = torch.softmax(logits.masked_fill(~(heard | nobody), -torch.inf), dim=-1)
    if method == "median":
        return _weighted_median(chosen, weights.detach())
    return (weights * chosen).sum(dim=-1)


def _patches(x: torch.Tensor, patch: int, fill: float) -> torch.Tensor:
    """(B, 3, h, w) -> (B, 3, patches, patch * patch), the border completed with ``fill``."""
    batch, channels, height, width = x.shape
    rows, cols = -(-height // patch), -(-width // patch)
    x = F.pad(x, (0, cols * patch - width, 0, rows * patch - height), value=fill)
    x = x.reshape(batch, channels, rows, patch, cols, patch).transpose(3, 4)
    return x.reshape(batch, channels, rows * cols, patch * patch)


def _weighted_median(value: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """(..., N) values and weights that sum to one -> (...): the middle of the two medians."""
    ordered, index = value.sort(dim=-1)
    reached = weight.gather(-1, index).cumsum(dim=-1)
    tolerance = 8 * torch.finfo(weight.dtype).eps
    last = value.shape[-1] - 1
    lower, upper = (
        (reached < half).sum(dim=-1, keepdim=True).clamp(max=last)
        for half in (0.5 - tolerance, 0.5 + tolerance)
    )
    return 0.5 * (ordered.gather(-1, lower) + ordered.gather(-1, upper))[..., 0]
