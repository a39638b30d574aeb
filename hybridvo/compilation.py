"""Numba with its cache on disk where there is a folder for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba


def njit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``numba.njit``; a function that cannot be cached is compiled in every process instead.

    numba looks at the age of a function's own file only: after a change in a kernel that others
    call, remove ``__pycache__``.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(**options)(function)
        except RuntimeError:  # neither the package nor the user's cache folder can be written
            return numba.njit(**options | {"cache": False})(function)

    return decorate
