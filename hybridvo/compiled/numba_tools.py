"""What every kernel needs: compilation with a safe cache, and arrays of one kind."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic


def as_contiguous(array: np.ndarray, dtype: Any = None) -> np.ndarray:
    """Return a contiguous, aligned, read-only view of an array, or of a copy of it.

    Numba compiles a kernel anew for every other memory layout.

    Args:
        array: any array.
        dtype: of the result; None: that of the array.

    >>> as_contiguous(np.ones((4, 4))[:, ::2]).flags.writeable
    False
    """
    view = np.require(array, dtype, ["C", "A"]).view()
    view.flags.writeable = False
    return view


def njit(
    *, cache: bool = True, **options: Any
) -> Callable[[Callable[..., Any]], Any]:
    """Apply ``numba.njit`` with a cache on disk that cannot stop the program.

    Neither damaged files nor a full disk matter.

    Args:
        cache: whether machine code is kept on disk, see
            :mod:`hybridvo.compiled.kernel_cache`.
        options: of ``numba.njit``.
    """
    import numba

    from hybridvo.compiled.kernel_cache import kernel_cache

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**options)(function)
        if cache:
            # numba's own ``cache=True`` sets the same attribute
            kernel._cache = kernel_cache(function)  # type: ignore[arg-type]
        return kernel

    return decorate


def in_two_threads(work: Callable[[int, int], None], count: int) -> None:
    """Call a kernel on both halves of a range at once; it must release the GIL.

    Args:
        work: called with the first number and the one after the last.
        count: numbers of the range, from 0.
    """
    half = count // 2
    if not half:
        work(0, count)
        return
    other = Thread(target=work, args=(0, half))
    other.start()
    work(half, count)
    other.join()


@intrinsic
def noinline(typing_context):
    """Forbid LLVM to inline the calling kernel.

    Inlined into a loop, the kernel's reductions would not be vectorised.
    """

    def codegen(context, builder, signature, args):
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.none(), codegen
