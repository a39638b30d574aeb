"""Tasks in other processes: the same results as here, also where a worker is killed.

The processes import this file. What is heavy is therefore imported by the tests that need it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest

from hybridvo.core.errors import InputError, OutputError
from hybridvo.core.options import FlowOptions, Options
from hybridvo_lab import cluster
from hybridvo_lab.cluster import Done, Workers

dask = pytest.importorskip("dask", reason="extra cluster")
distributed = pytest.importorskip("distributed", reason="extra cluster")

METHODS = ("pnp-ransac", "identity")
BY_FILE = Options(flow=FlowOptions(source="file"))


@pytest.fixture
def threads(monkeypatch: Any) -> Iterator[Workers]:
    """A scheduler with two workers that are threads of this process."""
    monkeypatch.setattr(cluster, "_one_thread", lambda: None)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as scheduler:
        yield Workers(scheduler=scheduler.scheduler_address)


def square(number: int) -> int:
    return number * number


def refuse(number: int) -> int:
    raise OutputError(f"disk {number} is full")


def die_once(folder: Path, number: int) -> int:
    """Kill the worker with the first task, once; note what was finished."""
    grave = folder / "grave"
    if number == 0 and not grave.exists():
        grave.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    with (folder / "finished").open("a") as file:
        file.write(f"{number} {os.getpid()} {os.environ['NUMBA_NUM_THREADS']}\n")
    return number * number


def die(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def listening(_: int) -> list[str]:
    """Sockets by which others could reach this process or the one that started it."""
    return [
        f"{each.name()} {one.laddr}"
        for each in (psutil.Process(), psutil.Process(os.getppid()))
        for one in each.net_connections("all")
        if one.status == psutil.CONN_LISTEN or one.type == socket.SOCK_DGRAM
        if one.laddr
    ]


def wait_for_ever(folder: Path, number: int) -> None:
    (folder / f"{number}").write_text(str(os.getpid()))
    time.sleep(3600)


# --- workers of a scheduler, which are threads ------------------------------------


def test_results_are_those_of_a_loop(threads: Workers) -> None:
    here = [done.result for done in Workers().each(square, range(5))]
    there = sorted(threads.each(square, range(5)))
    assert [done.result for done in there] == here == [0, 1, 4, 9, 16]
    assert not list(threads.each(square, []))


def test_an_error_of_a_task_is_raised_as_it_was(threads: Workers) -> None:
    for workers in (Workers(), threads):
        with pytest.raises(OutputError, match="disk 3 is full"):
            list(workers.each(refuse, [3]))


@pytest.mark.slow
def test_a_comparison_by_workers_is_that_of_one_process(
    threads: Workers, walk: Path, image_walk: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    from hybridvo_lab.commands.compare import compare
    from tests.run.test_comparison import outcome

    given: dict[str, Any] = {"methods": METHODS, "options": BY_FILE}
    compare((walk, image_walk), tmp_path / "here", **given)
    # paths are those of the one who asks, not of the worker
    monkeypatch.chdir(tmp_path)
    compare((walk, image_walk), "there", **given, workers=threads)
    assert outcome(tmp_path / "there") == outcome(tmp_path / "here")
    # what is done is not done again
    steps = sorted((tmp_path / "there").glob("runs/*/*/steps.csv"))
    before = [path.stat().st_mtime_ns for path in steps]
    compare((walk, image_walk), "there", **given, workers=threads, mode="resume")
    assert len(steps) == 4
    assert [path.stat().st_mtime_ns for path in steps] == before


def test_finished_shards_are_not_drawn_again(
    threads: Workers, tmp_path: Path, monkeypatch: Any
) -> None:
    from hybridvo_lab.commands.train import draw_training_samples

    drawn = []

    def write_shard(folder: Path, seed: int, makers: Any) -> int:
        drawn.append(seed)
        return seed // 64

    monkeypatch.setattr("hybridvo_lab.commands.train.write_shard", write_shard)
    assert draw_training_samples(tmp_path, 64, 128, workers=threads) == {
        "samples": 3
    }
    assert sorted(drawn) == [64, 128]
    assert draw_training_samples(tmp_path, 64, 192, workers=threads) == {
        "samples": 6
    }
    assert sorted(drawn) == [64, 128, 192]
    # with other shares they are others
    shares = (0.0, 0.5, 0.5, 0.1)
    draw_training_samples(tmp_path, 64, 64, shares=shares, workers=threads)
    assert drawn[3:] == [64]


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"jobs": 0}, "at least 1"),
        ({"jobs": 2, "scheduler": "tcp://127.0.0.1:1"}, "one of them"),
    ],
)
def test_workers_that_cannot_be(given: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Workers(**given)


def test_what_is_missing_is_said_in_a_line(
    tmp_path: Path, monkeypatch: Any
) -> None:
    with pytest.raises(InputError, match="no such file"):
        list(Workers(scheduler=str(tmp_path / "none.json")).each(square, [1]))
    monkeypatch.setattr(cluster, "CONNECT_S", 0.2)
    with pytest.raises(InputError, match="no scheduler answers"):
        list(Workers(scheduler="tcp://127.0.0.1:1").each(square, [1]))

    def absent(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(cluster.importlib, "import_module", absent)
    with pytest.raises(InputError, match=r"pip install 'hybridvo\[cluster\]'"):
        list(Workers(scheduler="tcp://127.0.0.1:1").each(square, [1]))


def test_a_worker_of_another_version_is_refused() -> None:
    with pytest.raises(InputError, match="Install the same version"):
        cluster._at_worker("0.0", square, 1)


# --- processes of this machine ----------------------------------------------------


@pytest.mark.slow
def test_the_task_of_a_killed_process_is_done_by_another(tmp_path: Path) -> None:
    found = sorted(Workers(jobs=2).each(partial(die_once, tmp_path), range(6)))
    assert found == [Done(number, number * number) for number in range(6)]
    lines = (tmp_path / "finished").read_text().splitlines()
    # a task may be done twice only where its process died before it could tell
    assert {line.split()[0] for line in lines} == set("012345")
    assert {line.split()[2] for line in lines} == {"1"}
    assert str(os.getpid()) not in {line.split()[1] for line in lines}
    assert "NUMBA_NUM_THREADS" not in os.environ
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_a_task_of_which_every_process_dies_is_given_up() -> None:
    found = sorted(Workers(jobs=2).each(die, [0, 1, 2]))
    assert [done.result for done in found] == [0, None, 2]
    assert "4 processes died of it" in found[1].lost


@pytest.mark.slow
def test_processes_open_no_port() -> None:
    before = listening(0)
    found = [done.result for done in Workers(jobs=2).each(listening, [0, 1])]
    assert all(set(each) <= set(before) for each in found)


def test_an_error_in_another_process_is_raised_as_it_was() -> None:
    with pytest.raises(OutputError, match="disk 3 is full") as caught:
        list(Workers(jobs=2).each(refuse, [3]))
    assert "in refuse" in str(caught.value.__cause__)
    assert not multiprocessing.active_children()


SCRIPT = """
import sys
from functools import partial
from pathlib import Path
from hybridvo_lab.cluster import Workers
from tests.lab.test_cluster import wait_for_ever
if __name__ == "__main__":
    list(Workers(jobs=2).each(partial(wait_for_ever, Path(sys.argv[1])), [0, 1]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_processes_end_with_the_one_that_started_them(
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
