"""Tasks in other processes: the same results as here, also where a worker is killed."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from hybridvo.core import cluster
from hybridvo.core.cluster import Workers
from hybridvo.core.errors import InputError, OutputError
from hybridvo.core.options import FlowOptions, Options
from hybridvo.lab.synthetic.dataset import read_sample
from hybridvo.run.commands.compare import compare
from hybridvo.run.commands.train import draw_training_samples, generate
from tests.run.test_comparison import outcome
from tests.walks import write_walk

distributed = pytest.importorskip("distributed", reason="extra cluster")

METHODS = ("pnp-ransac", "identity")
BY_FILE = Options(flow=FlowOptions(source="file"))


@pytest.fixture
def threads() -> Iterator[Workers]:
    """A scheduler with two workers that are threads of this process."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
    ) as scheduler:
        yield Workers(scheduler=scheduler.scheduler_address)


def square(number: int) -> int:
    return number * number


def refuse(number: int) -> int:
    raise OutputError(f"disk {number} is full")


def noted(log: Path, name: str) -> str:
    with log.open("a") as file:
        file.write(f"{name}\n")
    return name.upper()


def die_once(folder: Path, number: int) -> int:
    """Kill the worker with the first task, once; note what was finished."""
    grave = folder / "grave"
    if number == 0 and not grave.exists():
        grave.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    with (folder / "finished").open("a") as file:
        file.write(f"{number} {os.getpid()} {os.environ['NUMBA_NUM_THREADS']}\n")
    return number * number


def kernels_compiled(_: int) -> int:
    """How many kernels a fresh process had to compile instead of reading their code."""
    from hybridvo.solver import kernels
    from hybridvo.tracking.odometry import warm_up

    warm_up("classical")
    functions = [each for each in vars(kernels).values() if hasattr(each, "stats")]
    assert any(each.stats.cache_hits for each in functions)
    return sum(sum(each.stats.cache_misses.values()) for each in functions)


# --- workers that are threads -----------------------------------------------------


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


@pytest.mark.slow
def test_samples_by_workers_are_those_of_one_process(
    threads: Workers, tmp_path: Path
) -> None:
    here = tmp_path / "here"
    there = tmp_path / "there"
    for folder, workers in ((here, None), (there, threads)):
        generate("paper", 3, folder, size=(32, 64), workers=workers)
    for index in range(3):
        one = read_sample(here, index)
        two = read_sample(there, index)
        assert all((vars(one)[name] == vars(two)[name]).all() for name in vars(one))


def test_finished_shards_are_not_drawn_again(
    threads: Workers, tmp_path: Path, monkeypatch: Any
) -> None:
    drawn = []

    def write_shard(folder: Path, seed: int, makers: Any) -> int:
        drawn.append(seed)
        return seed // 64

    monkeypatch.setattr("hybridvo.run.commands.train.write_shard", write_shard)
    assert draw_training_samples(tmp_path, 64, 128, workers=threads) == {
        "samples": 3
    }
    assert sorted(drawn) == [64, 128]
    assert draw_training_samples(tmp_path, 64, 192, workers=threads) == {
        "samples": 6
    }
    assert sorted(drawn) == [64, 128, 192]
    # with other shares they are others
    shares = (0.0, 0.5, 0.5)
    draw_training_samples(tmp_path, 64, 64, shares=shares, workers=threads)
    assert drawn[3:] == [64]


def test_results_in_a_journal_are_not_computed_again(tmp_path: Path) -> None:
    log = tmp_path / "log"
    journal = tmp_path / "unfinished.jsonl"
    items = {name: name for name in ("a", "b", "c")}
    work = partial(noted, log)
    # interrupted after two
    coming = Workers().results(work, items, journal, {"pairs": 3})
    assert [next(coming), next(coming)] == [("a", "A"), ("b", "B")]
    coming.close()
    assert journal.is_file()
    again = dict(Workers().results(work, items, journal, {"pairs": 3}))
    assert again == {"a": "A", "b": "B", "c": "C"}
    assert log.read_text().split() == ["a", "b", "c"]
    assert not journal.exists()


def test_a_journal_of_other_settings_is_begun_anew(
    tmp_path: Path, caplog: Any
) -> None:
    log = tmp_path / "log"
    journal = tmp_path / "unfinished.jsonl"
    coming = Workers().results(
        partial(noted, log), {"a": "a", "b": "b"}, journal, 1
    )
    next(coming)
    coming.close()
    found = dict(Workers().results(partial(noted, log), {"a": "a"}, journal, 2))
    assert found == {"a": "A"}
    assert log.read_text().split() == ["a", "a"]
    assert "begun anew" in caplog.text


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


def test_a_worker_of_another_version_is_refused(
    threads: Workers, monkeypatch: Any
) -> None:
    begin = cluster._begin
    monkeypatch.setattr(cluster, "_begin", lambda address, _: begin(address, "0.0"))
    with pytest.raises(InputError, match="Install the same version"):
        list(threads.each(square, [1]))


# --- workers that are processes ---------------------------------------------------


@pytest.mark.long
def test_the_task_of_a_killed_worker_is_done_by_another(tmp_path: Path) -> None:
    found = sorted(Workers(jobs=2).each(partial(die_once, tmp_path), range(6)))
    assert [done.result for done in found] == [0, 1, 4, 9, 16, 25]
    assert not any(done.lost for done in found)
    lines = [
        line.split() for line in (tmp_path / "finished").read_text().splitlines()
    ]
    # a task may be done twice only where its worker died before it could tell
    assert sorted({int(number) for number, _, _ in lines}) == list(range(6))
    assert {threads for _, _, threads in lines} == {"1"}
    assert all(int(pid) != os.getpid() for _, pid, _ in lines)


@pytest.mark.long
def test_a_worker_reads_kernels_from_the_cache() -> None:
    from hybridvo.tracking.odometry import warm_up

    warm_up("classical")
    assert [
        done.result for done in Workers(jobs=2).each(kernels_compiled, [0])
    ] == [0]


def kill_one_at_work(
    processes: Any, out: Path, kept: dict[Path, list[str]]
) -> None:
    """Wait until a run has some frames, note these, and kill a worker that has a task."""
    while not kept:
        time.sleep(0.02)
        for path in out.glob("runs/*/*/checkpoint.jsonl"):
            lines = path.read_text().splitlines()
            if len(lines) > 3:
                kept[path.parent] = lines[:3]
    busy = [
        address
        for address, state in processes.scheduler.workers.items()
        if state.processing
    ]
    pids = [
        nanny.pid
        for nanny in processes.workers.values()
        if nanny.worker_address in busy
    ]
    os.kill(pids[0], signal.SIGKILL)


@pytest.mark.long
def test_a_comparison_survives_a_killed_worker(tmp_path: Path) -> None:
    walks = [write_walk(tmp_path / name, 60) for name in ("one", "two", "three")]
    given: dict[str, Any] = {"methods": ("classical", *METHODS), "options": BY_FILE}
    compare(walks, tmp_path / "here", **given)
    kept: dict[Path, list[str]] = {}
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0
    ) as processes:
        out = tmp_path / "there"
        killer = threading.Thread(
            target=kill_one_at_work, args=(processes, out, kept)
        )
        killer.start()
        workers = Workers(scheduler=processes.scheduler_address)
        compare(walks, out, **given, workers=workers)
        killer.join()
        assert len(processes.scheduler.workers) >= 1
    assert outcome(out) == outcome(tmp_path / "here")
    assert not list(out.glob("runs/*/*/checkpoint.jsonl"))
    # the frames that were done before the kill were not done again: their times are kept
    assert kept
    for folder, lines in kept.items():
        times = [json.loads(line)[1][0]["frame_ms"] for line in lines]
        rows = (folder / "steps.csv").read_text().splitlines()
        column = rows[0].split(",").index("frame_ms")
        assert [float(row.split(",")[column]) for row in rows[1:4]] == times
