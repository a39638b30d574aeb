"""Independent tasks one after the other, in several processes, or on many machines.

Processes of this machine talk by pipes (:mod:`hybridvo.core.processes`); machines are
dask.distributed's (extra ``cluster``). Both give a task to another worker where one was lost. A
task should write its results where it runs, so that little has to travel, and should do nothing
where they are there already: then a program that was stopped goes on where it was.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridvo import __version__
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import Journal, remove
from hybridvo.core.processes import Done, run_all

_logger = logging.getLogger(__name__)

CONNECT_S = 20
"""Seconds until a scheduler must have answered."""
SAME_PROCESS = "inproc"
"""How the address of a worker begins that is a thread of this process."""
PLUGIN = "hybridvo"
"""The name under which workers know what is done at their start."""


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
            return
        if not items:
            return
        if self.scheduler is None:
            jobs = min(self.jobs, len(items))
            with contextlib.closing(run_all(work, items, jobs, one_thread)) as done:
                yield from done
            return
        with self._client() as client:
            yield from _results(client, work, items)

    def results(
        self,
        work: Callable[[Any], Any],
        items: Mapping[str, Any],
        journal: Path,
        seed: Any,
    ) -> Iterator[tuple[str, Any]]:
        """Call a function with every item, but for those whose results a file holds.

        Args:
            work: As in :meth:`each`; its results are JSON-ready.
            items: Its arguments by a name.
            journal: The file to which every result is added. It is removed after the last one.
            seed: All that decides, JSON-ready. A file of other decisions is begun anew.

        Returns:
            An iterator of name and result: those of the file, then the others as they come.

        Raises:
            RuntimeError: Several workers died of a task.
        """
        kept = _open_journal(journal, json.dumps(seed))
        try:
            known = {name: result for name, result in kept.values if name in items}
            yield from known.items()
            names = [name for name in items if name not in known]
            for done in self.each(work, [items[name] for name in names]):
                name = names[done.number]
                if done.lost:
                    raise RuntimeError(f"{name}: {done.lost}")
                kept.add([name, done.result])
                yield name, done.result
        finally:
            kept.close()
        remove(journal)

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        """Connect to the scheduler."""
        distributed = _distributed()
        with _connected(distributed, self.scheduler) as client:
            _prepare(distributed, client)
            yield client


def _results(
    client: Any, work: Callable[[Any], Any], items: list[Any]
) -> Iterator[Done]:
    """Yield what the workers of a client have done, as it comes."""
    distributed = _distributed()
    run = f"hybridvo-{os.getpid()}-{os.urandom(4).hex()}"
    keys = [f"{run}-{number}" for number in range(len(items))]
    numbers = {key: number for number, key in enumerate(keys)}
    # nobody else holds the futures: what was read is forgotten by the cluster
    coming = distributed.as_completed(
        client.map(work, items, key=keys, pure=False), loop=client.loop
    )
    for future in coming:
        number = numbers[future.key]
        try:
            done = Done(number, future.result())
        except distributed.KilledWorker as error:
            reason = " ".join(str(error).split())
            done = Done(number, None, f"lost: {reason}")
        del future
        yield done


def _distributed() -> Any:
    """Import dask.distributed; an InputError states how to install it."""
    try:
        return importlib.import_module("distributed")
    except ModuleNotFoundError:
        raise InputError(
            "--cluster: distributed is not installed: pip install 'hybridvo[cluster]'."
        ) from None


def _connected(distributed: Any, scheduler: Any) -> Any:
    """Connect to a scheduler, its address, or its file."""
    given: dict[str, Any] = {"address": scheduler}
    if isinstance(scheduler, str) and scheduler.endswith(".json"):
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


def _prepare(distributed: Any, client: Any) -> None:
    """Let every worker, and those that come later, use one thread for a task."""
    if not client.nthreads():
        _logger.warning(
            "the scheduler has no worker yet: tasks wait for the first one."
        )

    class AtStart(distributed.WorkerPlugin):
        """What a worker does before its first task."""

        name = PLUGIN

        def setup(self, worker: Any) -> None:
            _begin(worker.address, __version__)

    try:
        client.register_plugin(AtStart())
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"--cluster: a worker cannot run hybridvo ({type(error).__name__}: {error}). Install "
            "the same version on every machine."
        ) from None


def _begin(address: str, version: str) -> None:
    """Check a worker, and give its tasks one thread each.

    Many tasks run beside each other: further threads of one only wait for others.

    Args:
        address: Of the worker.
        version: Of hybridvo where the tasks come from.
    """
    if version != __version__:
        raise InputError(
            f"worker {address}: has hybridvo {__version__}, the tasks are of {version}. Install "
            "the same version on every machine."
        )
    if not address.startswith(SAME_PROCESS):
        one_thread()


def one_thread() -> None:
    """Let this process compute with one thread."""
    import cv2
    import torch

    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _open_journal(path: Path, seed: str) -> Journal:
    """Open a file of results, a new one where it belongs to something else."""
    try:
        return Journal(path, seed)
    except FormatError:
        _logger.warning("%s: of another run, begun anew.", path)
    remove(path)
    return Journal(path, seed)
