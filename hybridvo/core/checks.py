"""Checks of values from users: each returns a usable one or raises InputError."""

from __future__ import annotations

from numbers import Integral
from typing import Any

import numpy as np

from hybridvo.core.errors import InputError

# characters of a value that a message shows
SHOWN_CHARACTERS = 100
# largest error of a rotation matrix and of the last row of a transform
RIGID_TOLERANCE = 1e-6
# seeds that every random generator takes
SEED_LIMIT = 2**31


def to_numpy(value: Any, name: str) -> np.ndarray:
    """Return an array, a tensor or nested lists as numpy; masked floats become NaN.

    Args:
        value: what was handed in.
        name: of the argument, for the message.

    Raises:
        InputError: for what is no array.
    """
    if isinstance(value, np.ma.MaskedArray) and value.dtype.kind == "f":
        return np.asarray(value.filled(np.nan))
    try:
        return np.asarray(value)
    except (RuntimeError, TypeError, ValueError) as error:
        raise InputError(f"{name}: expected an array, got {error}.") from None


def kind_of(array: np.ndarray) -> str:
    """Return type and shape of an array, for a message; of what is no array, its type.

    >>> kind_of(np.zeros(3)), kind_of(np.asarray(None))
    ('float64 (3,)', 'None')
    """
    if array.dtype == object and array.ndim == 0:
        value = array.item()
        return "None" if value is None else type(value).__name__
    return f"{array.dtype} {array.shape}"


def as_number(value: Any) -> float:
    """Return a value as float; NaN where it is no number.

    >>> as_number("2.5"), as_number(None)
    (2.5, nan)
    """
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def brief(value: Any) -> str:
    """Return a value as one short line, for a message."""
    text = " ".join(repr(value).split())
    if len(text) <= SHOWN_CHARACTERS:
        return text
    return f"{text[:SHOWN_CHARACTERS]}..."


def check_kind(what: str, value: Any, *kinds: type) -> None:
    """Raise an InputError where an argument is of none of these types."""
    if not isinstance(value, kinds):
        raise InputError(
            f"{what}: expected {kinds[0].__name__}, got {type(value).__name__}."
        )


def as_seed(seed: Any, where: str) -> int:
    """Return a seed as int, if every random generator takes it; else an InputError."""
    is_integer = isinstance(seed, Integral) and not isinstance(seed, bool)
    if not is_integer or not 0 <= seed < SEED_LIMIT:
        raise InputError(
            f"{where}: expected a whole number from 0 to 2^31 - 1, got {brief(seed)}."
        )
    return int(seed)


def rotation_error(R: np.ndarray) -> np.ndarray:
    """Return how far matrices are from rotations.

    Args:
        R: (..., 3, 3).

    Returns:
        (...) largest element of |R^T R - I|; infinite for reflections and NaN.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        difference = np.swapaxes(R, -1, -2) @ R - np.eye(3)
        error = np.abs(difference).max(axis=(-1, -2))
        is_proper = (np.linalg.det(R) > 0) & np.isfinite(error)
        return np.where(is_proper, error, np.inf)


def as_rigid(
    T: Any, where: str, tolerance: float = RIGID_TOLERANCE, *, many: bool = False
) -> np.ndarray:
    """Check rigid transforms, and return a float64 copy.

    Args:
        T: (4, 4), or with ``many`` (N, 4, 4).
        where: name of the argument, for the message.
        tolerance: largest error of the rotation and of the last row.
        many: whether there are several transforms.

    Raises:
        InputError: for another shape, and for what is not finite or not rigid.
    """
    T = to_numpy(T, where)
    if T.dtype.kind not in "fiu" or T.ndim != 2 + many or T.shape[-2:] != (4, 4):
        shape = "(N, 4, 4)" if many else "(4, 4)"
        raise InputError(f"{where}: expected shape {shape}, got {kind_of(T)}.")
    T = T.astype(np.float64)
    last_row_error = np.abs(T[..., 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=-1)
    error = np.maximum(rotation_error(T[..., :3, :3]), last_row_error)
    is_rigid = (error <= tolerance) & np.isfinite(T).all(axis=(-1, -2))
    if not is_rigid.all():
        place = where
        wrong = T
        if many:
            first = int(np.argmin(is_rigid))
            place = f"{where}[{first}]"
            wrong = T[first]
        raise InputError(
            f"{place}: expected a finite rigid transform (rotation to {tolerance:g}, "
            f"last row 0 0 0 1), got {wrong.tolist()}."
        )
    return T
