"""Checks of what users hand in: each returns the value as it is needed, or raises an InputError."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import numpy as np

from hybridvo.errors import InputError


def to_numpy(value: Any, name: str) -> np.ndarray:
    """View an array, a tensor or nested lists as numpy; masked floats become NaN."""
    if isinstance(value, np.ma.MaskedArray) and value.dtype.kind == "f":
        return np.asarray(value.filled(np.nan))
    try:
        return np.asarray(value)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array, got {error}.") from None


def as_number(value: Any) -> float:
    """Convert a value to float; NaN where it is no number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def brief(value: Any) -> str:
    """What was handed in, in one short line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 100 else f"{text[:100]}..."


def check_kind(what: str, value: Any, *kinds: type) -> None:
    """Raise an InputError where an argument is of none of these types."""
    if not isinstance(value, kinds):
        raise InputError(
            f"{what}: expected {kinds[0].__name__}, got {type(value).__name__}."
        )


def as_seed(seed: Any, where: str) -> int:
    """Check that a seed suits every random generator, and return it as int."""
    whole = isinstance(seed, Integral) and not isinstance(seed, bool)
    if not whole or not 0 <= seed < 2**31:
        raise InputError(
            f"{where}: expected a whole number from 0 to 2^31 - 1, got {brief(seed)}."
        )
    return int(seed)


def rotation_error(R: np.ndarray) -> np.ndarray:
    """Return how far matrices (..., 3, 3) are from rotations; infinite for reflections and NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
        return np.where((np.linalg.det(R) > 0) & np.isfinite(error), error, np.inf)


def as_rigid(
    T: Any, where: str, tolerance: float = 1e-6, *, many: bool = False
) -> np.ndarray:
    """Check a rigid transform (4, 4), or ``many`` (N, 4, 4), and return a float64 copy."""
    T = to_numpy(T, where)
    if T.dtype.kind not in "fiu" or T.ndim != 2 + many or T.shape[-2:] != (4, 4):
        shape = "(N, 4, 4)" if many else "(4, 4)"
        raise InputError(
            f"{where}: expected shape {shape}, got {T.dtype} {T.shape}."
        )
    T = T.astype(np.float64)
    last = np.abs(T[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=-1)
    good = np.maximum(rotation_error(T[..., :3, :3]), last) <= tolerance
    good &= np.isfinite(T).all(axis=(-1, -2))
    if not good.all():
        k = int(np.argmin(good))
        place, bad = (f"{where}[{k}]", T[k]) if many else (where, T)
        wanted = f"a finite rigid transform (rotation to {tolerance:g}, last row 0 0 0 1)"
        raise InputError(f"{place}: expected {wanted}, got {bad.tolist()}.")
    return T
