"""What the networks and the refinement of batches share; needs torch alone."""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple, ParamSpec, TypeVar

import torch
import torch.nn.functional as F

from hybridvo.core.errors import InputError
from hybridvo.core.types import PairBatch, check_dense, check_plain

P = ParamSpec("P")
R = TypeVar("R")


class SeedMarks(NamedTuple):
    """What a start of a refinement carries beside its motions.

    Attributes:
        lead: (B,) by how much the score of its network exceeds that of any other motion.
        covariance: (B, 6, 6) of its left perturbation; m^2, m rad, rad^2; None: not stated.
    """

    lead: torch.Tensor
    covariance: torch.Tensor | None = None


def with_marks(T: torch.Tensor, marks: SeedMarks) -> torch.Tensor:
    """Mark the start T (B, 4, 4), and return it.

    ``refine_batch`` finds the marks on this very tensor; a changed copy has none.
    """
    T.seed_marks = marks  # type: ignore[attr-defined]
    return T


def lead_of(T: Any) -> torch.Tensor | None:
    """Return the lead that a start is marked with, or None."""
    marks = getattr(T, "seed_marks", None)
    return None if marks is None else marks.lead


def covariance_of(T: Any) -> torch.Tensor | None:
    """Return the covariance that a start is marked with, or None."""
    marks = getattr(T, "seed_marks", None)
    return None if marks is None else marks.covariance


def has_torch_geometry() -> bool:
    """Return whether pypose and kornia, of the extra ``train``, are installed."""
    return all(find_spec(name) is not None for name in ("pypose", "kornia"))


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """Keep ``torch.compile`` out of a function whose loops depend on the data."""

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> R:
        # not before: disable() loads the compiler, which takes two seconds
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **named)
        return function(*args, **named)

    return call


def as_tensor(
    value: Any, name: str, device: torch.device, where: str = "refine_batch"
) -> torch.Tensor:
    """Return what a user hands in as a dense tensor of real numbers on a device.

    Raises:
        InputError: It is none; the message names it ``name`` of the function ``where``.
    """
    try:
        tensor = torch.as_tensor(value, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        got = f"{type(value).__name__}: {str(error)[:200]}"
        raise InputError(
            f"{where}: expected {name} as numbers, got {got}."
        ) from None
    check_dense(f"{where}: {name}", tensor)
    check_plain(f"{where}: {name}", tensor)
    if tensor.is_complex():
        raise InputError(
            f"{where}: expected {name} as real numbers, got {tensor.dtype}."
        )
    return tensor


def checked_batch(
    batch: PairBatch, weights: Any = None, where: str = "refine_batch"
) -> tuple[PairBatch, torch.Tensor | None]:
    """Return a batch and its weights in one floating type, on one device.

    Args:
        batch: the batch.
        weights: (B, H, W) numbers, (H, W) for a batch of one, or None.
        where: the function that the message names.

    Raises:
        InputError: A shape, type or device does not fit.
    """
    flow = batch.flow
    depth = batch.depth_prev
    if not (flow.is_floating_point() and depth.is_floating_point()):
        raise InputError(
            f"{where}: expected flow and depth_prev as floating-point tensors."
        )
    dtype = torch.promote_types(flow.dtype, depth.dtype)
    if dtype not in (torch.float32, torch.float64):
        dtype = torch.float32
    if weights is not None:
        weights = as_tensor(weights, "weights", flow.device, where)
        if len(flow) == 1 and weights.ndim == depth.ndim - 1:
            weights = weights[None]

    tensors = vars(batch) | {"weights": weights}
    shapes = {
        "flow": flow.shape,
        "K_prev": (len(flow), 3, 3),
        "K_curr": (len(flow), 3, 3),
        "rgb_prev": (*flow.shape[:3], 3),
        "rgb_curr": (*flow.shape[:3], 3),
        "has_images": flow.shape[:1],
    }
    exact_types = {
        "valid": torch.bool,
        "rgb_prev": torch.uint8,
        "rgb_curr": torch.uint8,
        "has_images": torch.bool,
    }
    values = {}
    for name, value in tensors.items():
        if value is None:
            continue
        shape = tuple(shapes.get(name, flow.shape[:3]))
        exact = exact_types.get(name)
        fits = tuple(value.shape) == shape and value.device == flow.device
        if not fits or (exact is not None and value.dtype != exact):
            kind = "" if exact is None else f", {str(exact).removeprefix('torch.')}"
            raise InputError(
                f"{where}: expected {name} of shape {shape} on {flow.device}{kind}, "
                f"got {tuple(value.shape)} on {value.device}, {value.dtype}."
            )
        values[name] = value.to(dtype if exact is None else exact)
    weights = values.pop("weights", None)
    return PairBatch(**values), weights


def to_tiles(x: torch.Tensor, tile: int, fill: float = 0.0) -> torch.Tensor:
    """Cut (..., H, W) into (..., tiles, tile * tile); ``fill`` completes the border."""
    missing_columns = -x.shape[-1] % tile
    missing_rows = -x.shape[-2] % tile
    x = F.pad(x, (0, missing_columns, 0, missing_rows), value=fill)
    x = x.unflatten(-1, (-1, tile)).unflatten(-3, (-1, tile)).transpose(-3, -2)
    return x.flatten(-4, -3).flatten(-2)
