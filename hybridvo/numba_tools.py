"""What every kernel needs: compilation with a cache that survives, and arrays of one kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic


def as_contiguous(array: np.ndarray, dtype: Any = None) -> np.ndarray:
    """Return a contiguous read-only view: for any other kind numba would compile anew."""
    view = np.require(array, dtype, ["C", "A"]).view()
    view.flags.writeable = False
    return view


def njit(
    *, cache: bool = True, **options: Any
) -> Callable[[Callable[..., Any]], Any]:
    """Apply ``numba.njit``, with a cache on disk that neither damage nor a full disk can stop."""
    import numba

    from hybridvo.kernel_cache import kernel_cache

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**options)(function)
        if cache:
            # numba's own ``cache=True`` sets the same attribute
            kernel._cache = kernel_cache(function)
        return kernel

    return decorate


@intrinsic
def noinline(typing_context):
    """Forbid LLVM to inline the caller: inlined into a loop its reductions are not vectorised."""

    def codegen(context, builder, signature, args):
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.none(), codegen
