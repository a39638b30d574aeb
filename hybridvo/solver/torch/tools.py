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


class PoseSeed(NamedTuple):
    """Where the refinement of a batch starts, and what is known of the start.

    Attributes:
        T_curr_prev: (B, 4, 4), metres; or (B, S, 4, 4), several starts.
        weights: (B, H, W) factors on the information of each pixel; None: all alike.
        evidence: (B, 4) what speaks for the motion, a
            :class:`~hybridvo.hypotheses.select.ChoiceEvidence` each, NaN where nothing speaks for
            or against it; None: not known.
        covariance: (B, 6, 6) of the left perturbation of the motion; m^2, m rad, rad^2: how far
            from it the motion is sought; None: not stated.

    Example:
        >>> import torch
        >>> import hybridvo as hvo
        >>> seed = hvo.PoseSeed(torch.eye(4).expand(3, 4, 4), weights=torch.ones(3, 6, 8))
        >>> seed.part(slice(1, None)).T_curr_prev.shape
        torch.Size([2, 4, 4])
    """

    T_curr_prev: torch.Tensor
    weights: torch.Tensor | None = None
    evidence: torch.Tensor | None = None
    covariance: torch.Tensor | None = None

    def part(self, samples: slice | torch.Tensor) -> PoseSeed:
        """Return the seed of some samples.

        Args:
            samples: which ones, as an index of the first axis: a slice, numbers, or a mask.

        Returns:
            Their seed, in that order.
        """
        return PoseSeed(
            self.T_curr_prev[samples],
            None if self.weights is None else self.weights[samples],
            None if self.evidence is None else self.evidence[samples],
            None if self.covariance is None else self.covariance[samples],
        )


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
