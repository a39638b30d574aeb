"""Where segments run: in this process, in others of this machine, or on a Dask cluster.

All three are ``concurrent.futures`` executors, so that there is one code path.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

from hybridvo.errors import InputError

__all__ = ["Workers", "open_workers"]

CONNECT_SECONDS = 30.0
_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?(?:\[[0-9a-fA-F:.%]+\]|[\w.-]+):([0-9]{1,5})", re.ASCII)


@dataclass(frozen=True)
class Workers:
    """An executor, and how many segments to keep in flight: asked again as workers come and go."""

    executor: Executor
    slots: Callable[[], int]


class _Here(Executor):
    """Runs what it is given at once, in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def _start_worker(threads: int) -> None:
    """Prepare a worker process: its share of the cores; the keyboard speaks to the parent alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # a parent that was killed closes nothing: its workers would wait for work for ever
    threading.Thread(target=_end_with_parent, daemon=True).start()
    import cv2
    import numba

    cv2.setNumThreads(threads)
    numba.set_num_threads(min(threads, numba.get_num_threads()))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def open_workers(jobs: int = 1, scheduler: str | None = None) -> Iterator[Workers]:
    """Workers for the segments of several sequences.

    Args:
        jobs: processes on this machine; 1 works in this process.
        scheduler: address of a Dask scheduler, such as ``tcp://host:8786``; its workers need
            hybridvo and the sequences under the same paths.

    Raises:
        InputError: fewer than one job, both a scheduler and jobs, Dask is not installed, no
            scheduler answers, or it has no worker.
    """
    if jobs < 1:
        raise InputError(f"--jobs: expected at least 1, got {jobs}.")
    if scheduler is not None:
        if jobs != 1:
            raise InputError("--jobs and --scheduler exclude each other: the cluster has workers.")
        yield from _dask(scheduler)
    elif jobs == 1:
        yield Workers(_Here(), lambda: 1)
    else:
        threads = max(1, (os.cpu_count() or 1) // jobs)
        # a fork would copy the threads' locks of numba and OpenCV in whatever state they are
        pool = ProcessPoolExecutor(
            jobs, multiprocessing.get_context("spawn"), _start_worker, (threads,)
        )
        try:
            yield Workers(pool, lambda: jobs)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _check_address(address: str) -> None:
    # Dask takes other words for addresses too, and then waits a minute in a thread of its own
    found = _ADDRESS.fullmatch(address)
    if found is None or not 1 <= int(found[1]) <= 65535:
        raise InputError(
            f"--scheduler: expected an address such as tcp://host:8786, got {address!r}."
        )


def _dask(address: str) -> Iterator[Workers]:
    _check_address(address)
    try:
        from distributed import Client
    except ImportError:
        raise InputError(
            "--scheduler: Dask is not installed; pip install 'hybridvo[cluster]'."
        ) from None
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers ({error}). Start one with "
            f"'dask scheduler' and workers with 'dask worker --nthreads 1 {address}'."
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError:
            raise InputError(
                f"--scheduler {address}: it has no worker after {CONNECT_SECONDS:.0f} s. Start "
                f"some with 'dask worker --nthreads 1 {address}'."
            ) from None
        yield Workers(client.get_executor(pure=False), lambda: max(1, len(client.nthreads())))
