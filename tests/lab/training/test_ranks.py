"""Several processes train as one does: the same weights, files of the first one only."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import distributed

from hybridvo.core.errors import InputError
from hybridvo.network.pwvo import PWVOOptions
from hybridvo_lab.paper.layers import NetworkOptions
from hybridvo_lab.paper.losses import LossOptions
from hybridvo_lab.synthetic.dataset import Mixture
from hybridvo_lab.training import ranks
from hybridvo_lab.training.options import PaperTrainingOptions, PWVOTrainingOptions
from hybridvo_lab.training.paper_task import PaperTask
from hybridvo_lab.training.pwvo_task import PWVOTask
from hybridvo_lab.training.trainer import Trainer, read_checkpoint
from tests.lab.training.test_tools import write_config

PAPER = PaperTrainingOptions(
    network=NetworkOptions(width=0.1, head_stride=2),
    batch_size=4,
    steps=3,
    ema_decay=0.9,
    data=("paper", "diverse"),
    data_weights=(0.5, 0.5),
    log_every=1,
)
OPTIONS = {
    "paper": PAPER,
    # terms that are divided by a count of the whole batch
    "without-uncertainty": dataclasses.replace(
        PAPER,
        loss=LossOptions(flow_uncertainty=False, depth_uncertainty=False),
    ),
    # batches of three: one of the ranks has a sample less
    "pwvo": PWVOTrainingOptions(
        network=PWVOOptions(width=0.25), batch_size=3, steps=3, log_every=1
    ),
}

TOLERANCE = 1e-3
"""Of the sums of float32 numbers in another order, through three updates."""


def make_task(name: str, data: Any) -> PaperTask | PWVOTask:
    options = OPTIONS[name]
    if isinstance(options, PWVOTrainingOptions):
        return PWVOTask(options, data)
    return PaperTask(options, data)


def train_as_rank(rank: int, name: str, data: Any, folder: Path) -> None:
    """What each of two processes does."""
    torch.set_num_threads(1)
    distributed.init_process_group(
        "gloo", init_method=f"file://{folder / 'meet'}", rank=rank, world_size=2
    )
    assert (ranks.count(), ranks.own()) == (2, rank)
    # where a rank that must not write would do so
    own = folder / "run" if rank == 0 else folder / "other"
    train(name, data, own, folder / "run")
    distributed.destroy_process_group()


def train(name: str, data: Any, own: Path, shared: Path) -> Trainer:
    """Two updates, then another trainer goes on for one more."""
    first = Trainer(make_task(name, data), own)
    batches = first.task.batches(0, 0)
    first.advance(next(batches))
    first.advance(next(batches))
    first.save()
    if ranks.count() > 1:
        distributed.barrier()
    second = Trainer(make_task(name, data), shared)
    assert second.resume()
    # one rank is asked to stop: all of them do, after the update
    second.stop_requested = ranks.own() == ranks.count() - 1
    assert second.run() == "signal"
    assert second.step == 3
    return second


def flat(tensors: Any) -> torch.Tensor:
    return torch.cat([tensor.flatten() for tensor in tensors])


@pytest.mark.long
@pytest.mark.parametrize("name", OPTIONS)
def test_two_processes_train_as_one_with_twice_the_batch(
    name: str, mixture: Mixture, shards: Path, tmp_path: Path
) -> None:
    """Each process has half of every batch; between them the run is resumed."""
    data = shards if name == "pwvo" else mixture
    for folder in ("one", "run", "other"):
        (tmp_path / folder).mkdir()
    start = flat(make_task(name, data).network.state_dict().values())
    alone = train(name, data, tmp_path / "one", tmp_path / "one")
    torch.multiprocessing.spawn(
        train_as_rank, args=(name, data, tmp_path), nprocs=2, join=True
    )

    state = read_checkpoint(tmp_path / "run" / "checkpoint.pt")
    weights = flat(alone.network.state_dict().values())
    moved = (weights - start).norm()
    # Measured: 1e-5 of the way. Single weights differ more: AdamW's first steps have the
    # same length however small, and rounded, a gradient is.
    for part, network in (("network", alone.network), ("ema", alone.exported)):
        difference = flat(network.state_dict().values()) - flat(
            state[part].values()
        )
        assert difference.norm() < TOLERANCE * moved, part
    mine = alone.optimizer.state_dict()["state"].values()
    theirs = state["optimizer"]["state"].values()
    gradients = flat([each["exp_avg"] for each in mine])
    difference = gradients - flat([each["exp_avg"] for each in theirs])
    assert difference.norm() < TOLERANCE * gradients.norm()

    assert state["progress"]["samples"] == alone.samples
    assert not list((tmp_path / "other").iterdir())
    logs = [read_log(tmp_path / folder) for folder in ("run", "one")]
    for entry, expected in zip(*logs, strict=True):
        assert entry["loss"] == pytest.approx(expected["loss"], rel=TOLERANCE)
        assert entry["grad_norm"] == pytest.approx(
            expected["grad_norm"], rel=TOLERANCE
        )


def read_log(folder: Path) -> list[dict[str, float]]:
    text = (folder / "log.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.long
def test_the_command_by_torchrun(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    words = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    words += ["--nproc-per-node", "2", "-m", "hybridvo", "train", "paper"]
    words += ["--config", str(config), "--out", str(tmp_path / "run")]
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    texts = []
    for _ in range(2):
        done = subprocess.run(
            words, capture_output=True, text=True, check=False, env=env
        )
        assert done.returncode == 0, done.stderr
        texts.append(done.stderr)
    assert texts[0].count("ended by steps at update 2") == 1
    assert texts[1].count("goes on at update 2") == 1
    about = json.loads((tmp_path / "run" / "run.json").read_text())
    assert about["processes"] == 2
    assert len(read_log(tmp_path / "run")) == 2


def test_the_second_of_three_ranks_has_its_part(monkeypatch: Any) -> None:
    monkeypatch.setattr(ranks, "count", lambda: 3)
    monkeypatch.setattr(ranks, "own", lambda: 1)
    assert list(ranks.part(range(10, 17))) == [11, 14]


def test_a_batch_that_cannot_be_divided_is_refused(
    mixture: Mixture, monkeypatch: Any
) -> None:
    monkeypatch.setattr(ranks, "count", lambda: 3)
    with pytest.raises(InputError, match="4 samples cannot be divided among 3"):
        PaperTask(PAPER, mixture).batches(0, 0)
