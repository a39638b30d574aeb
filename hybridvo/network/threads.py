"""One thread for torch on a CPU, in the thread that asks for it and nowhere else.

The networks are small: on two threads they are no faster, and where another program is busy each
of their hundreds of operations waits for the slower one (0.35 s a pair instead of 0.04 s).
``torch.set_num_threads`` is no way: it is of the whole process, and a thread that first uses torch
meanwhile keeps the one thread for good. OpenMP and MKL below it have a number for each thread.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator

import torch


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Within, the calling thread works alone; where torch's libraries are others, as it did."""
    # torch sets a thread's numbers when the thread first asks
    torch.get_num_threads()
    swap_openmp, swap_mkl = _swaps()
    openmp = swap_openmp(1)
    mkl = swap_mkl(1)
    try:
        yield
    finally:
        swap_mkl(mkl)
        swap_openmp(openmp)


Swap = Callable[[int], int]
"""Sets the calling thread's number of threads, and returns the one before."""


@functools.cache
def _swaps() -> tuple[Swap, Swap]:
    """Those of the OpenMP and the MKL that torch runs on; without effect where it has none."""
    try:
        library = ctypes.CDLL(torch._C.__file__)
    except OSError:
        return _keep, _keep
    openmp = mkl = _keep
    if hasattr(library, "omp_set_num_threads"):

        def openmp(count: int) -> int:
            before = library.omp_get_max_threads()
            library.omp_set_num_threads(count)
            return int(before)

    if hasattr(library, "MKL_Set_Num_Threads_Local"):
        mkl = library.MKL_Set_Num_Threads_Local
    return openmp, mkl


def _keep(count: int) -> int:
    """No function of that library: nothing is set."""
    return count
