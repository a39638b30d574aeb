"""One thread for torch on a CPU, in the calling thread alone.

The networks are small. On two threads they are no faster, and on a busy machine each of
their hundreds of operations waits for the slower thread (0.35 s a pair instead of 0.04 s).
``torch.set_num_threads`` is no solution: it changes the whole process, and a thread that
uses torch for the first time meanwhile keeps the one thread for good. OpenMP and MKL, on
which torch runs, have a number of threads for each calling thread.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator

import torch

Swap = Callable[[int], int]
"""Sets the calling thread's number of threads, and returns the earlier one."""


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread within, in the calling thread alone.

    Where torch runs on other libraries than OpenMP and MKL, nothing changes.
    """
    # torch sets a thread's numbers when the thread uses it for the first time
    torch.get_num_threads()
    swap_openmp, swap_mkl = _swaps()
    openmp_before = swap_openmp(1)
    mkl_before = swap_mkl(1)
    try:
        yield
    finally:
        swap_mkl(mkl_before)
        swap_openmp(openmp_before)


@contextlib.contextmanager
def single_threaded_inference() -> Iterator[None]:
    """Inference in float32 on one thread of the CPU; nothing outside of it changes."""
    # a default device costs every operation some microseconds: it is entered only if needed
    is_elsewhere = torch.get_default_device().type != "cpu"
    device = torch.device("cpu") if is_elsewhere else contextlib.nullcontext()
    with (
        one_thread(),
        torch.inference_mode(),
        torch.autocast("cpu", enabled=False),
        device,
    ):
        yield


@functools.cache
def _swaps() -> tuple[Swap, Swap]:
    """The functions of the OpenMP and of the MKL that torch runs on.

    They have no effect where torch has no such library.
    """
    try:
        library = ctypes.CDLL(torch._C.__file__)
    except OSError:
        return _keep, _keep
    openmp = _keep
    mkl = _keep
    if hasattr(library, "omp_set_num_threads"):
        openmp = functools.partial(_swap_openmp, library)
    if hasattr(library, "MKL_Set_Num_Threads_Local"):
        mkl = library.MKL_Set_Num_Threads_Local
    return openmp, mkl


def _swap_openmp(library: ctypes.CDLL, count: int) -> int:
    """Set OpenMP's number of threads, and return the earlier one."""
    before = library.omp_get_max_threads()
    library.omp_set_num_threads(count)
    return int(before)


def _keep(count: int) -> int:
    """Set nothing: the library is missing."""
    return count
