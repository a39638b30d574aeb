"""What users hand in, as arrays and numbers that can be used, or an error in words."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import numpy as np

from hybridvo.errors import InputError

MAX_SEED = 2**31 - 1
"""Every generator that is seeded takes as much."""


def to_numpy(value: Any, name: str) -> np.ndarray:
    """Numpy view of an array, a tensor or nested lists; masked floats become NaN.

    Raises:
        InputError: no array: ragged lists, or a tensor that records gradients or holds no values.
    """
    if isinstance(value, np.ma.MaskedArray) and value.dtype.kind == "f":
        return np.asarray(value.filled(np.nan))
    try:
        return np.asarray(value)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array, got {error}.") from None


def as_float_image(value: Any, name: str, channels: int | None) -> np.ndarray:
    """Numpy view (or native-endian float32 copy) of an (H, W[, channels]) image of real numbers.

    Raises:
        InputError: another shape, or no floating-point numbers.
    """
    array = to_numpy(value, name)
    expected = "(H, W)" if channels is None else f"(H, W, {channels})"
    if array.ndim == 3 and channels is None and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim < 2 or array.shape[2:] != (() if channels is None else (channels,)):
        raise InputError(f"{name}: expected shape {expected}, got {array.shape}.")
    if array.dtype.kind != "f":
        raise InputError(
            f"{name}: expected a floating-point array, got dtype {array.dtype}. "
            f"Convert to metres (depth) or pixels (flow) as float32 first."
        )
    with np.errstate(over="ignore"):  # beyond float32 is inf, which is invalid
        return array.astype(np.float32, copy=False)


def as_number(value: Any) -> float:
    """A value as float; NaN where it is no number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def as_seed(seed: Any, where: str) -> int:
    """A seed that every generator takes.

    Raises:
        InputError: no whole number from 0 to 2^31 - 1.
    """
    whole = isinstance(seed, Integral) and not isinstance(seed, bool)
    if not whole or not 0 <= seed <= MAX_SEED:
        raise InputError(f"{where}: expected a whole number from 0 to 2^31 - 1, got {seed!r}.")
    return int(seed)


def as_rigid(T: Any, where: str) -> np.ndarray:
    """(4, 4) float64 copy of a rigid transform.

    Raises:
        InputError: another shape, values that are not finite, or no rotation in the upper left.
    """
    T = to_numpy(T, where)
    if T.dtype.kind not in "fiu" or T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{where}: expected a finite (4, 4) transform, got shape {T.shape}.")
    T = T.astype(np.float64)
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise InputError(f"{where}: expected a rotation in the upper left, got {R.tolist()}.")
    if np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise InputError(f"{where}: expected (0, 0, 0, 1) in the last row, got {T[3].tolist()}.")
    return T
