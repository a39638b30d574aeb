"""Training of the score alone: the rest of PWVO stays, and a stopped run goes on."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from hybridvo.core.errors import InputError
from hybridvo.lab.training.options import PWVOTrainingOptions, load_training_options
from hybridvo.lab.training.pwvo_task import PWVOTask
from hybridvo.lab.training.score_task import (
    SCORE_LAYERS,
    ScoreBatch,
    ScoreTask,
    pwvo_task,
    with_score_stage,
)
from hybridvo.lab.training.trainer import Trainer, export_run
from hybridvo.network.models import load_weights
from hybridvo.network.pwvo import PWVO, PWVOOptions

CONFIG = Path(__file__).parents[3] / "configs" / "train_score.yaml"
OPTIONS = PWVOTrainingOptions(
    network=PWVOOptions(width=0.25),
    batch_size=8,
    steps=60,
    score_only=True,
    rounds=1,
)


@pytest.mark.slow
def test_only_the_score_learns_and_a_stopped_run_goes_on(shards, tmp_path):
    task = pwvo_task(OPTIONS, shards)
    assert isinstance(task, ScoreTask)
    before = {k: v.clone() for k, v in task.network.state_dict().items()}
    trainer = Trainer(task, tmp_path)
    batches = task.batches(0, 0)
    losses = [trainer.update(next(batches), 0.1)["loss"] for _ in range(40)]
    assert np.mean(losses[-8:]) < np.mean(losses[:8])
    for name, value in task.network.state_dict().items():
        may_change = name.startswith(SCORE_LAYERS)
        assert may_change or torch.equal(value, before[name]), name
    assert not torch.equal(task.network.score.weight, before["score.weight"])

    trainer.save()
    again = Trainer(pwvo_task(OPTIONS, shards), tmp_path)
    assert again.resume() and again.step == 40
    torch.testing.assert_close(
        again.network.score.weight, trainer.network.score.weight
    )


def test_features_are_computed_once(shards, tmp_path, monkeypatch):
    task = ScoreTask(OPTIONS, shards)
    next(task.batches(0, 0))
    module = "hybridvo.lab.training.score_task.features_of"
    monkeypatch.setattr(module, None)
    next(ScoreTask(OPTIONS, shards).batches(0, 0))


def test_the_score_of_features_is_that_of_the_look(shards):
    """The features hold all that the score reads, to half precision."""
    task = ScoreTask(OPTIONS, shards)
    torch.manual_seed(3)
    torch.nn.init.normal_(task.network.score.weight)
    from hybridvo.lab.training.pwvo_task import TwoLooks, read_batches
    from hybridvo.lab.training.score_task import features_of

    shard = sorted(shards.glob("*.npz"))[0]
    features = features_of(task.network, shard, 0, OPTIONS)
    rng = np.random.default_rng([OPTIONS.seed, 0])
    (batch, *_) = read_batches([shard], 8, rng)
    looks = TwoLooks(task.network, batch, torch.zeros(len(batch), dtype=torch.bool))
    count = len(looks.score)
    score = task.network.score_of(features.x3[:count], features.scalars[:count])
    torch.testing.assert_close(score, looks.score, rtol=1e-4, atol=1e-4)


def test_a_stage_of_its_own_begins_with_the_same_scores():
    plain = PWVO(PWVOOptions(width=0.25))
    torch.nn.init.normal_(plain.score.weight)
    torch.nn.init.normal_(plain.block4.conv2.weight)
    own = PWVO(PWVOOptions(width=0.25, score_stage=True))
    own.load_state_dict(with_score_stage(plain.state_dict(), own))
    x3 = torch.rand(3, plain.down4.in_channels, 6, 8)
    scalars = torch.rand(3, plain.scalars.in_features)
    torch.testing.assert_close(
        own.score_of(x3, scalars), plain.score_of(x3, scalars)
    )


def test_what_is_unexplained_counts_against_a_motion():
    """Of two motions with equal scores and errors the loss prefers none; with the cost it
    lowers the probability of the one that leaves more unexplained."""
    task = ScoreTask(OPTIONS, Path())
    batch = ScoreBatch(
        x3=torch.zeros(2, task.network.summary.in_features),
        scalars=torch.zeros(2, task.network.scalars.in_features),
        cost=torch.tensor([0.0, 1.0]),
        error=torch.tensor([0.0, 50.0]),
        owner=torch.tensor([0, 0]),
        limit=torch.tensor([1.0]),
    )
    with_cost = task.loss(batch, 0)[0]
    swapped = dataclasses.replace(batch, cost=batch.cost.flip(0))
    assert task.loss(swapped, 0)[0] > with_cost + 0.3


def test_the_run_is_exported(shards, tmp_path):
    task = ScoreTask(OPTIONS, shards)
    trainer = Trainer(task, tmp_path)
    trainer.update(next(task.batches(0, 0)), 0.1)
    trainer.save()
    (tmp_path / "run.json").write_text("{}")
    card = export_run(tmp_path, tmp_path / "score.safetensors")
    assert card["options"]["score_only"]
    network, _ = load_weights(tmp_path / "score.safetensors")
    assert isinstance(network, PWVO)


def test_the_recipe_is_of_the_score_and_a_missing_folder_is_named(tmp_path):
    options = load_training_options(CONFIG)
    assert options.score_only
    assert type(
        pwvo_task(dataclasses.replace(options, score_only=False), tmp_path)
    ) is (PWVOTask)
    with pytest.raises(InputError, match="no shards"):
        next(ScoreTask(OPTIONS, tmp_path).batches(0, 0))
