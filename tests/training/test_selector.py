"""The selector's training: samples that mean what they say, losses that fall, a second look."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from hybridvo.errors import FormatError, InputError
from hybridvo.network.models import load_weights
from hybridvo.network.pwvo import PWVO
from hybridvo.network.selector_net import SelectorNetworkOptions
from hybridvo.training import selector_data
from hybridvo.training.options import SelectorOptions, load_selector_options
from hybridvo.training.selector_task import (
    SelectorBatch,
    SelectorTask,
    ego_flow_error,
    read_batches,
)
from hybridvo.training.trainer import Trainer

CONFIG = Path(__file__).parents[2] / "configs" / "train_selector.yaml"


def batches(folder: Path) -> list[SelectorBatch]:
    return list(
        read_batches(sorted(folder.glob("*.npz")), 4, np.random.default_rng(0))
    )


def test_samples_are_drawn_again_as_they_were():
    first, again = (
        selector_data.draw_samples(3, PWVO.from_pretrained()) for _ in range(2)
    )
    assert len(first) == len(again)
    for one, two in zip(first, again, strict=True):
        for key in one:
            np.testing.assert_array_equal(one[key], two[key])


def test_ground_truth_explains_the_static_pixels(shards):
    apart = []
    for batch in batches(shards):
        assert ego_flow_error(batch.T, torch.arange(len(batch)), batch).max() < 1e-3
        for b in range(len(batch)):
            inputs = batch.inputs
            x, y = inputs.ray[b]
            z = batch.depth_true[b]
            P = batch.T[b]
            K = inputs.K[b]
            X, Y, Z = (
                z * (P[i, 0] * x + P[i, 1] * y + P[i, 2]) + P[i, 3]
                for i in range(3)
            )
            u = K[0] * X / Z + K[2] - inputs.target[b, 0]
            v = K[1] * Y / Z + K[3] - inputs.target[b, 1]
            distance = torch.sqrt(u * u + v * v) * 1024 / inputs.width[b]
            usable = inputs.usable[b] & (z > 0)
            static = usable & (batch.label[b] == selector_data.STATIC)
            moving = usable & (batch.label[b] == selector_data.MOVING)
            if moving.sum() > 50 and static.sum() > 50:
                apart.append(
                    bool(distance[static].median() < distance[moving].median())
                )
    # static pixels follow the true motion; an estimated flow may be bent
    assert len(apart) >= 4 and np.mean(apart) > 0.8


def test_training_learns_and_goes_on(shards, tmp_path):
    options = SelectorOptions(
        network=SelectorNetworkOptions(width=0.25), batch_size=4, ema_decay=0.9
    )
    options = dataclasses.replace(
        options,
        optimizer=dataclasses.replace(options.optimizer, learning_rate=4e-3),
    )
    trainer = Trainer(SelectorTask(options, shards), tmp_path)
    batch = max(batches(shards), key=len)
    losses = [trainer.update(batch, 0.5) for _ in range(120)]
    assert {"choice", "mask", "second"} <= set(losses[0])
    # the same samples again and again: the masks are learned (six seeds: 0.45 to 0.73)
    assert (
        np.mean([each["mask"] for each in losses[-10:]]) < 0.9 * losses[0]["mask"]
    )
    trainer.save()
    other = Trainer(SelectorTask(options, shards), tmp_path)
    assert other.resume()
    expected = trainer.update(batch, 0.5)
    got = other.update(batch, 0.5)
    assert got == pytest.approx(expected, rel=1e-5)
    with pytest.raises(InputError, match="no shards"):
        next(SelectorTask(options, tmp_path / "nothing").batches(0, 0))


def test_the_configuration_is_that_of_the_pretrained_network():
    options = load_selector_options(CONFIG)
    network, _ = load_weights("selector")
    assert options.network == network.options


@pytest.mark.parametrize("content", ["noise", "empty", "other", "objects"])
def test_a_file_that_is_no_shard_is_refused(tmp_path, content):
    path = tmp_path / "0_8x8.npz"
    if content == "noise":
        path.write_bytes(np.random.default_rng(0).bytes(3000))
    elif content == "objects":
        np.savez(path, count=np.array([{}], object))
    else:
        np.savez(path, **({} if content == "empty" else {"x": np.zeros(3)}))
    with pytest.raises(FormatError, match="0_8x8"):
        next(read_batches([path], 4, np.random.default_rng(0)))
