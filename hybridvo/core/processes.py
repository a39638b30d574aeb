"""Tasks in other processes of this machine, which talk by pipes: no port is opened.

A port on this machine can be reached by everybody who has an account on it, whatever the
account; a pipe only by the two processes that hold its ends.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator
from multiprocessing import connection
from typing import Any, NamedTuple

ATTEMPTS = 4
"""Workers that may die of a task until it is given up."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
"""What the processes find in their environment: many tasks run beside each other, and further
threads of one only wait for others."""
END_S = 5.0
"""Seconds until a process that should end is killed."""


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


def run_all(
    work: Callable[[Any], Any],
    items: list[Any],
    jobs: int,
    begin: Callable[[], None] | None = None,
) -> Generator[Done, None, None]:
    """Call a function with every item in several processes; yield results as they come.

    The task of a process that dies is given to another one. The processes end with the iterator,
    and where this process dies.

    Args:
        work: A function of a module, or a partial of one.
        items: Its arguments; what pickle can copy.
        jobs: How many processes.
        begin: What each process calls first.

    Raises:
        Exception: The first that the function raises.
    """
    waiting = deque(range(len(items)))
    deaths = Counter[int]()
    workers = list[_Worker]()
    try:
        while waiting or any(worker.task is not None for worker in workers):
            while waiting and _has_room(workers, jobs):
                worker = _free_worker(workers, begin)
                number = waiting.popleft()
                worker.give(number, work, items[number])
            for worker in _ready(workers):
                number = worker.task
                answer = worker.answer()
                if answer is not None:
                    yield Done(number, _unwrapped(answer))
                    continue
                workers.remove(worker)
                deaths[number] += 1
                if deaths[number] < ATTEMPTS:
                    waiting.appendleft(number)
                    continue
                code = worker.exit_code()
                reason = f"{ATTEMPTS} processes died of it (exit code {code})"
                yield Done(number, None, f"lost: {reason}")
    finally:
        for worker in workers:
            worker.ask_to_end()
        for worker in workers:
            worker.end()


class _Answer(NamedTuple):
    """What a process sends back."""

    result: Any
    error: BaseException | None


class _Worker:
    """A process that does one task after the other.

    Attributes:
        task: The number of its task; None while it has none.
    """

    def __init__(self, begin: Callable[[], None] | None) -> None:
        self.task: Any = None
        context = multiprocessing.get_context("spawn")
        pipe = context.Pipe()
        self.pipe = pipe[0]
        self._process = context.Process(target=_serve, args=(pipe[1], begin))
        with _environment(ONE_THREAD):
            self._process.start()
        # else the pipe would stay open where the process dies
        pipe[1].close()

    def give(self, number: int, work: Callable[[Any], Any], item: Any) -> None:
        """Hand over a task; where the process has died, its answer shows that."""
        self.task = number
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send((work, item))

    def answer(self) -> _Answer | None:
        """Receive its answer; None where it died."""
        try:
            answer = self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            return None
        self.task = None
        return answer

    def exit_code(self) -> int | None:
        """Return with what a process ended; minus the number of a signal."""
        return self._process.exitcode

    def ask_to_end(self) -> None:
        """Take the pipe away, and the task."""
        self.pipe.close()
        if self.task is not None:
            self._process.terminate()

    def end(self) -> None:
        """Wait until the process has ended."""
        self.ask_to_end()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _has_room(workers: list[_Worker], jobs: int) -> bool:
    """Whether a process is free, or another one may be started."""
    return len(workers) < jobs or any(worker.task is None for worker in workers)


def _free_worker(
    workers: list[_Worker], begin: Callable[[], None] | None
) -> _Worker:
    for worker in workers:
        if worker.task is None:
            return worker
    workers.append(_Worker(begin))
    return workers[-1]


def _ready(workers: list[_Worker]) -> list[_Worker]:
    """Wait for processes that have an answer, or have died."""
    busy = [worker for worker in workers if worker.task is not None]
    ready = connection.wait([worker.pipe for worker in busy])
    return [worker for worker in busy if worker.pipe in ready]


def _unwrapped(answer: _Answer) -> Any:
    if answer.error is not None:
        raise answer.error
    return answer.result


@contextlib.contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Have some values in the environment that a new process gets."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# -- in the other process --------------------------------------------------------------


def _serve(pipe: Any, begin: Callable[[], None] | None) -> None:
    """Do tasks until the pipe is closed."""
    # the process that hands out the tasks decides what an interrupt means
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if begin is not None:
        begin()
    while True:
        try:
            work, item = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = _Answer(work(item), None)
        except KeyboardInterrupt:
            # the process should end, and what was done is saved
            return
        except Exception as error:
            error.add_note(f"In another process:\n{traceback.format_exc()}")
            answer = _Answer(None, error)
        _send(pipe, answer)


def _send(pipe: Any, answer: _Answer) -> None:
    """Send what pickle can copy, and an error where it cannot."""
    try:
        pipe.send(answer)
    except (BrokenPipeError, ConnectionResetError):
        return
    # pickle raises errors of many kinds
    except Exception as error:
        got = type(answer.error or answer.result).__name__
        text = f"a task's {got} cannot be sent to another process: {error}"
        pipe.send(_Answer(None, RuntimeError(text)))


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, also where that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
