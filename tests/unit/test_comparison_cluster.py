"""The same comparison on a Dask cluster of two workers; the extra ``cluster`` may be absent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from hybridvo.comparison.executors import open_workers
from hybridvo.comparison.runner import ComparisonOptions, compare
from hybridvo.errors import InputError
from hybridvo.synthetic.render import make_scene, write_sintel


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("hybridvo.evaluation.report_page.write_report", lambda folder: [])
    for seed, name in enumerate(("first", "second", "third")):
        scene = make_scene("light", seed, height=64, width=128, frames=4)
        write_sintel(scene, tmp_path / "tree", name)
    return tmp_path / "tree"


def outcome(out: Path) -> tuple[Any, Any]:
    """Rows, and where every method was worst: everything but what the clock said."""
    result = json.loads((out / "results.json").read_text())
    rows = [{k: v for k, v in row.items() if "ms_" not in k} for row in result["rows"]]
    return rows, result["worst_pairs"], result["breakdown"]


# distributed's own sockets and files may still be open when the collector comes by
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_two_dask_workers_give_the_same_rows(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip(
        "distributed", reason="Dask is not installed (extra 'cluster')"
    )
    chosen = {"sequences": (str(tree),), "methods": ("pnp-ransac", "identity"), "flow": "file"}
    compare(ComparisonOptions(**chosen), tmp_path / "here", quiet=True)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        with open_workers(scheduler=address) as workers:
            assert workers.slots() == 2
        monkeypatch.setattr("hybridvo.comparison.job.estimate", None)  # not in this process
        there = ComparisonOptions(**chosen, scheduler=address)
        compare(there, tmp_path / "there", quiet=True)
    assert outcome(tmp_path / "there") == outcome(tmp_path / "here")
    assert len(outcome(tmp_path / "here")[0]) == 6


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_no_scheduler_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed (extra 'cluster')")
    monkeypatch.setattr("hybridvo.comparison.executors.CONNECT_SECONDS", 0.5)
    with (
        pytest.raises(InputError, match=r"no Dask scheduler answers .*dask scheduler"),
        open_workers(scheduler="tcp://127.0.0.1:9"),
    ):
        pass


def test_without_dask_the_remedy_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(InputError, match=r"pip install 'hybridvo\[cluster\]'"),
        open_workers(scheduler="tcp://127.0.0.1:9"),
    ):
        pass
