"""Values that this package makes itself: what a user hands in is checked once, at the door."""

from __future__ import annotations

from typing import Any, TypeVar

T = TypeVar("T")


def made(kind: type[T], **fields: Any) -> T:
    """Return a dataclass of the given fields, all of them, without its checks.

    >>> from hybridvo.core.results import MotionPrior
    >>> import numpy as np
    >>> made(MotionPrior, T_curr_prev=np.eye(4), covariance=np.eye(6)).covariance.shape
    (6, 6)
    """
    value = object.__new__(kind)
    vars(value).update(fields)
    return value


def changed(value: T, **changes: Any) -> T:
    """Return a copy of a dataclass with some fields changed, without its checks."""
    return made(type(value), **{**vars(value), **changes})
