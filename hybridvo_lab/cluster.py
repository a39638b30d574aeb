"""Independent tasks one after the other, in several processes, or on many machines.

Processes of this machine are those of :mod:`concurrent.futures`, which talk by pipes: no port is
opened. Machines are dask.distributed's (extra ``cluster``). Both give a task to another process
where one was lost. A task should write its results where it runs, so that little has to travel,
and should do nothing where they are there already: then a program that was stopped goes on where
it was.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

from hybridvo import __version__
from hybridvo.core.errors import InputError

_logger = logging.getLogger(__name__)

ATTEMPTS = 4
"""Processes of this machine that may die of a task until it is given up; dask's own number."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
"""What processes find in their environment: many tasks run beside each other, and further threads
of one only wait for others."""
CONNECT_S = 20
"""Seconds until a scheduler must have answered."""
END_S = 5
"""Seconds that a task has to save what it did when its process must end."""


class Done(NamedTuple):
    """A task that is done, or that no worker could do.

    Attributes:
        number: Of the task, in the order in which the tasks were given.
        result: What it returned; None where it was lost.
        lost: Why it has no result, because several workers died of it; else empty.
    """

    number: int
    result: Any
    lost: str = ""


@dataclass(frozen=True)
class Workers:
    """Where tasks run.

    Attributes:
        jobs: Processes on this machine; with one, tasks run here one after the other.
        scheduler: Address of a scheduler of dask.distributed, such as ``tcp://10.0.0.1:8786``,
            or the file that ``dask scheduler --scheduler-file`` wrote (``.json``); None: this
            machine.

    Raises:
        InputError: Both are given, or there are fewer jobs than one.

    Example:
        >>> [done.result for done in Workers().each(abs, [-1, 2])]
        [1, 2]
    """

    jobs: int = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InputError(f"--jobs: expected at least 1, got {self.jobs}.")
        if self.jobs > 1 and self.scheduler is not None:
            raise InputError(
                "--jobs starts processes on this machine, --cluster uses those of a scheduler: "
                "pass one of them."
            )

    @property
    def are_elsewhere(self) -> bool:
        """Whether tasks run in other processes than this one."""
        return self.jobs > 1 or self.scheduler is not None

    @property
    def are_remote(self) -> bool:
        """Whether tasks may run in another folder or on another machine."""
        return self.scheduler is not None

    def each(
        self, work: Callable[[Any], Any], items: Iterable[Any]
    ) -> Iterator[Done]:
        """Call a function with every item, and yield the results as they come.

        Tasks of a worker that was lost are done again by others.

        Args:
            work: A function of a module, or a partial of one.
            items: Its arguments; what pickle can copy.

        Raises:
            InputError: dask.distributed, which ``scheduler`` needs, is not installed, there is no
                such scheduler, or a worker has another hybridvo.
            Exception: The first that the function raises; tasks that have not begun are dropped.
        """
        items = list(items)
        if not self.are_elsewhere:
            for number, item in enumerate(items):
                yield Done(number, work(item))
        elif self.scheduler is None:
            yield from _in_processes(work, items, min(self.jobs, len(items)))
        elif items:
            yield from _by_scheduler(work, items, self.scheduler)


# -- processes of this machine -------------------------------------------------------


def _in_processes(
    work: Callable[[Any], Any], items: list[Any], jobs: int
) -> Iterator[Done]:
    """Yield what processes of this machine have done, as it comes.

    Each process is a pool of its own, so that its death costs no other task. All end with the
    iterator, and where this process dies.
    """
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    start = partial(ProcessPoolExecutor, 1, context, _begin, (theirs,))
    free = [start() for _ in range(jobs)]
    waiting = deque(range(len(items)))
    deaths = Counter[int]()
    running: dict[Future[Any], tuple[int, ProcessPoolExecutor]] = {}
    try:
        while waiting or running:
            while waiting and free:
                pool = free.pop()
                try:
                    with _environment(ONE_THREAD):
                        future = pool.submit(work, items[waiting[0]])
                except BrokenProcessPool:
                    # it died while it had no task
                    free.append(start())
                    continue
                running[future] = (waiting.popleft(), pool)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                number, pool = running[future]
                try:
                    done = Done(number, future.result())
                except BrokenProcessPool as error:
                    reason = f"{ATTEMPTS} processes died of it ({error})"
                    done = Done(number, None, f"lost: {reason}")
                    deaths[number] += 1
                    pool = start()
                del running[future]
                free.append(pool)
                if done.lost and deaths[number] < ATTEMPTS:
                    waiting.appendleft(number)
                else:
                    yield done
    finally:
        ours.close()
        for _, pool in running.values():
            pool.shutdown()
        for pool in free:
            pool.shutdown()


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Have some values in the environment that a new process gets."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value


def _begin(pipe: Any) -> None:
    """Prepare a new process for its tasks."""
    # the process that hands out the tasks decides what an interrupt means
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(pipe,), daemon=True).start()
    _one_thread()


def _end_with(pipe: Any) -> None:
    """End this process when nobody holds the other end of a pipe."""
    with contextlib.suppress(EOFError, OSError):
        pipe.recv_bytes()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(END_S)
    os._exit(1)


def _one_thread() -> None:
    """Let this process compute with one thread."""
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)


# -- machines ------------------------------------------------------------------------


def _by_scheduler(
    work: Callable[[Any], Any], items: list[Any], scheduler: str
) -> Iterator[Done]:
    """Yield what the workers of a scheduler have done, as it comes."""
    try:
        distributed: Any = importlib.import_module("distributed")
    except ModuleNotFoundError:
        raise InputError(
            "--cluster: distributed is not installed: pip install 'hybridvo[cluster]'."
        ) from None
    with _connected(distributed, scheduler) as client:
        if not client.nthreads():
            _logger.warning(
                "the scheduler has no worker yet: tasks wait for the first one."
            )
        futures = client.map(
            partial(_at_worker, __version__, work), items, pure=False
        )
        numbers = {future.key: number for number, future in enumerate(futures)}
        coming = distributed.as_completed(futures, loop=client.loop)
        # nobody else holds the futures: what was read is forgotten by the cluster
        del futures
        for future in coming:
            number = numbers[future.key]
            try:
                done = Done(number, future.result())
            except distributed.KilledWorker as error:
                done = Done(number, None, f"lost: {error}")
            del future
            yield done


def _connected(distributed: Any, scheduler: str) -> Any:
    """Connect to a scheduler, its address, or its file."""
    given: dict[str, Any] = {"address": scheduler}
    if scheduler.endswith(".json"):
        if not os.path.isfile(scheduler):
            raise InputError(f"--cluster {scheduler}: no such file.")
        given = {"scheduler_file": scheduler}
    try:
        return distributed.Client(**given, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--cluster {scheduler}: no scheduler answers ({error}). Start one with: dask "
            "scheduler."
        ) from None


def _at_worker(version: str, work: Callable[[Any], Any], item: Any) -> Any:
    """Do a task of this version of hybridvo with one thread."""
    if version != __version__:
        raise InputError(
            f"a worker has hybridvo {__version__}, the tasks are of {version}. Install the same "
            "version on every machine."
        )
    _one_thread()
    return work(item)
