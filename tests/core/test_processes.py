"""Tasks in processes of this machine: by pipes, done again where a process dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from hybridvo.core.errors import OutputError
from hybridvo.core.processes import run_all


def refuse(number: int) -> int:
    raise OutputError(f"disk {number} is full")


def listening(_: int) -> list[str]:
    """Sockets by which others could reach this process or the one that started it."""
    found = []
    for each in (psutil.Process(), psutil.Process(os.getppid())):
        found += [
            f"{each.name()} {one.laddr}"
            for one in each.net_connections("all")
            if one.status == psutil.CONN_LISTEN or one.type == socket.SOCK_DGRAM
            if one.laddr
        ]
    return found


def test_processes_on_this_machine_open_no_port() -> None:
    before = listening(0)
    found = [done.result for done in run_all(listening, [0, 1], 2)]
    assert all(set(each) <= set(before) for each in found)


def die(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_task_of_which_every_worker_dies_is_given_up() -> None:
    found = sorted(run_all(die, [0, 1, 2], 2))
    assert [done.result for done in found] == [0, None, 2]
    assert "4 processes died of it (exit code -9)" in found[1].lost


def test_an_error_in_another_process_is_raised_as_it_was() -> None:
    with pytest.raises(OutputError, match="disk 3 is full") as caught:
        list(run_all(refuse, [3], 2))
    assert "in refuse" in caught.value.__notes__[0]
    with pytest.raises(RuntimeError, match="a task's function cannot be sent"):
        list(run_all(unsendable, [1], 2))
    assert not multiprocessing.active_children()


def unsendable(_: int) -> Any:
    return lambda: None


def wait_for_ever(folder: Path, number: int) -> None:
    (folder / f"{number}").write_text(str(os.getpid()))
    time.sleep(3600)


SCRIPT = """
import sys
from functools import partial
from pathlib import Path
from hybridvo.core.processes import run_all
from tests.core.test_processes import wait_for_ever
if __name__ == "__main__":
    list(run_all(partial(wait_for_ever, Path(sys.argv[1])), [0, 1], 2))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_the_process_that_started_them(
    number: int, tmp_path: Path
) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    folder = tmp_path / "pids"
    folder.mkdir()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, script, folder],
        env=environment,
        stderr=subprocess.DEVNULL,
    ) as main:
        while (
            len(pids := [p.read_text() for p in folder.iterdir()]) < 2 or "" in pids
        ):
            assert main.poll() is None
            time.sleep(0.05)
        workers = [psutil.Process(int(pid)) for pid in pids]
        main.send_signal(number)
        main.wait()
    _, alive = psutil.wait_procs(workers, timeout=60)
    assert not alive
