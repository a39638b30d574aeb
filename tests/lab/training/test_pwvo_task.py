"""PWVO's training: samples that mean what they say, losses that fall, a second look."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from hybridvo.core.errors import FormatError, InputError
from hybridvo.network.euler import euler_motion
from hybridvo.network.hypothesis_maps import HypothesisMaps
from hybridvo.network.models import load_weights
from hybridvo.network.pwvo import PWVOOptions
from hybridvo_lab.training import hypothesis_samples
from hybridvo_lab.training.hypothesis_samples import Makers, draw_samples
from hybridvo_lab.training.options import PWVOTrainingOptions, load_training_options
from hybridvo_lab.training.pwvo_task import (
    HypothesisBatch,
    PWVOTask,
    TwoLooks,
    ego_flow_error,
    read_batches,
    refits_of,
)
from hybridvo_lab.training.trainer import Trainer

CONFIG = Path(__file__).parents[3] / "configs" / "train_pwvo.yaml"


def batches(folder: Path) -> list[HypothesisBatch]:
    return list(
        read_batches(sorted(folder.glob("*.npz")), 4, np.random.default_rng(0))
    )


@pytest.mark.slow
def test_samples_are_drawn_again_as_they_were():
    first, again = (draw_samples(3, Makers()) for _ in range(2))
    assert first
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
            static = usable & (batch.label[b] == hypothesis_samples.STATIC)
            moving = usable & (batch.label[b] == hypothesis_samples.MOVING)
            if moving.sum() > 50 and static.sum() > 50:
                apart.append(
                    bool(distance[static].median() < distance[moving].median())
                )
    # static pixels follow the true motion; an estimated flow may be bent
    assert len(apart) >= 4 and np.mean(apart) > 0.8


@pytest.mark.slow
def test_training_learns_and_goes_on(shards, tmp_path):
    options = PWVOTrainingOptions(
        network=PWVOOptions(width=0.25), batch_size=4, ema_decay=0.9
    )
    options = dataclasses.replace(
        options,
        optimizer=dataclasses.replace(options.optimizer, learning_rate=4e-3),
    )
    trainer = Trainer(PWVOTask(options, shards), tmp_path)
    # few samples: the updates are quick
    files = sorted(shards.glob("*.npz"))
    read = list(read_batches(files, 2, np.random.default_rng(0)))
    batch = max(read, key=len)
    losses = [trainer.update(batch, 0.5) for _ in range(80)]
    assert {"choice", "mask", "pose", "second"} <= set(losses[0])
    # the same samples again and again: the masks are learned
    assert (
        np.mean([each["mask"] for each in losses[-10:]]) < 0.9 * losses[0]["mask"]
    )
    trainer.save()
    other = Trainer(PWVOTask(options, shards), tmp_path)
    assert other.resume()
    expected = trainer.update(batch, 0.5)
    got = other.update(batch, 0.5)
    assert got == pytest.approx(expected, rel=1e-5)
    with pytest.raises(InputError, match="no shards"):
        next(PWVOTask(options, tmp_path / "nothing").batches(0, 0))


def test_the_score_alone_is_trained(shards, tmp_path):
    options = PWVOTrainingOptions(
        network=PWVOOptions(width=0.25), batch_size=4, layers="score"
    )
    trainer = Trainer(PWVOTask(options, shards), tmp_path)
    before = {
        name: value.clone() for name, value in trainer.network.state_dict().items()
    }
    trainer.update(next(trainer.task.batches(0, 0)), 0.5)
    after = trainer.network.state_dict()
    changed = {
        name.split(".")[0]
        for name in before
        if not torch.equal(before[name], after[name])
    }
    # the last layer begins at zero: what is before it has no gradient yet
    assert "score" in changed
    assert changed <= {"summary", "inner", "score"}


def test_the_error_is_that_of_the_static_pixels(batch):
    """Things that move say nothing about the camera, unless nothing stands."""
    owner = torch.arange(len(batch))
    pose = batch.T.clone()
    pose[:, :, 3] += 0.05
    expected = ego_flow_error(pose, owner, batch)
    is_static = batch.label == hypothesis_samples.STATIC
    farther = torch.where(is_static, batch.depth_true, 10 * batch.depth_true)
    changed = dataclasses.replace(batch, depth_true=farther)
    has_static = is_static[:, ::2, ::2].flatten(1).any(1)
    assert has_static.any()
    got = ego_flow_error(pose, owner, changed)
    torch.testing.assert_close(got[has_static], expected[has_static])
    nothing = torch.full_like(batch.label, hypothesis_samples.MOVING)
    moving = dataclasses.replace(batch, label=nothing)
    assert (ego_flow_error(pose, owner, moving) > 0).all()


@pytest.mark.parametrize("name", ["train_pwvo.yaml", "train_score.yaml"])
def test_the_configuration_is_that_of_the_pretrained_network(name):
    options = load_training_options(CONFIG.with_name(name))
    network, _ = load_weights("pwvo")
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


# --- the parts of the loss --------------------------------------------------------


@pytest.fixture(scope="module")
def batch(shards) -> HypothesisBatch:
    return max(batches(shards), key=len)


@pytest.fixture(scope="module")
def looks(batch) -> TwoLooks:
    torch.manual_seed(0)
    task = PWVOTask(PWVOTrainingOptions(network=PWVOOptions(width=0.25)), Path())
    mirror = torch.arange(len(batch)) % 2 == 0
    with torch.no_grad():
        return TwoLooks(task.network, batch, mirror)


def test_the_masks_have_a_loss_where_there_is_a_label(batch, looks):
    maps = looks.first
    label = batch.label[batch.inputs.owner]
    right = torch.where(label == hypothesis_samples.STATIC, 20.0, -20.0)
    sure = dataclasses.replace(maps, static=right)
    assert float(looks.mask_loss(sure, batch.inputs)) < 1e-6
    wrong = dataclasses.replace(maps, static=-right)
    assert float(looks.mask_loss(wrong, batch.inputs)) > 5
    # nothing is asked of a pixel whose depth is not known
    unknown = label == hypothesis_samples.UNKNOWN
    other = torch.where(unknown, -right, right)
    same = dataclasses.replace(maps, static=other)
    assert float(looks.mask_loss(same, batch.inputs)) < 1e-6


def test_the_pose_loss_is_that_of_a_laplace_distribution(batch, looks):
    maps = looks.first
    truth = euler_motion(batch.T)[batch.inputs.owner][:, :, None, None]
    unit = maps.unit[:, :, None, None].expand_as(maps.motion)
    usable = batch.inputs.usable[batch.inputs.owner].flatten(1).any(1)
    losses = {}

    def mean_pose_loss(wrong: HypothesisMaps) -> float:
        total = looks.pose_loss(wrong, batch.inputs)
        return float(total) / len(batch.inputs.owner)

    for away in (0.0, 2.0, 1e4):
        wrong = dataclasses.replace(
            maps, motion=truth + away * unit, log_scale=unit.log()
        )
        losses[away] = mean_pose_loss(wrong)
    fraction = float(usable.float().mean())
    # |error| / U + log U, in units of what the hypotheses leave unexplained; limited
    assert losses[0.0] == pytest.approx(0.0, abs=1e-3)
    assert losses[2.0] == pytest.approx(2.0 * fraction, rel=1e-3)
    assert losses[1e4] == pytest.approx(20.0 * fraction, rel=1e-3)
    # the best scale is the error
    doubted = dataclasses.replace(
        maps, motion=truth + 2 * unit, log_scale=(2 * unit).log()
    )
    expected = (1 + np.log(2)) * fraction
    assert mean_pose_loss(doubted) == pytest.approx(expected, rel=1e-3)


def test_a_refit_in_the_true_mask_is_right(batch, looks):
    """Fits that start from the true poses, inside the true masks, find the motion."""
    label = batch.label[batch.inputs.owner]
    truth = euler_motion(batch.T)[batch.inputs.owner][:, :, None, None]
    told = dataclasses.replace(
        looks.first,
        static=torch.where(label == hypothesis_samples.STATIC, 20.0, -20.0),
        motion=truth.expand_as(looks.first.motion).contiguous(),
        log_scale=torch.zeros_like(looks.first.log_scale),
    )
    lots = torch.rand(len(batch), 2, generator=torch.Generator().manual_seed(0))
    more = refits_of(batch, looks.looks.score, told, 1, lots)
    assert more is not None
    assert torch.equal(more.owner, batch.inputs.owner[more.parent])
    error = ego_flow_error(more.pose, more.owner, batch)
    # limits are larger where this fit does not determine the motion
    limit = batch.limit[more.owner]
    clear = limit == limit.min()
    assert (error < limit)[clear].all()


def test_the_losses_of_a_batch_are_those_of_its_samples(batch):
    """Whatever the others of a batch are, and however many motions they have."""
    motions = torch.bincount(batch.inputs.owner)
    assert motions.min() < motions.max()
    options = PWVOTrainingOptions(network=PWVOOptions(width=0.25))
    torch.manual_seed(0)
    task = PWVOTask(options, Path())
    mirror = torch.arange(len(batch)) % 2 == 0
    lots = torch.rand(len(batch), 2, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        together = task._sums(batch, mirror, 2, lots)
        alone = [
            task._sums(batch.part([b]), mirror[[b]], 2, lots[[b]])
            for b in range(len(batch))
        ]
    for name in together._fields:
        expected = np.sum([getattr(each, name) for each in alone], axis=0)
        np.testing.assert_allclose(getattr(together, name), expected, rtol=1e-4)


def test_every_loss_has_a_gradient(batch):
    torch.manual_seed(0)
    options = PWVOTrainingOptions(
        network=PWVOOptions(width=0.25), no_motion_share=1.0
    )
    task = PWVOTask(options, Path())
    for layer in task.network.modules():
        # the last layers start at zero, and leave nothing to those before them
        if hasattr(layer, "weight") and not layer.weight.any():
            torch.nn.init.normal_(layer.weight, std=0.1)
    loss, parts = task.loss(batch, 0)
    loss.backward()
    names = {"choice", "mask", "pose"}
    names |= {"second", "second_mask", "second_pose"}
    assert set(parts) == names
    assert float(loss.detach()) == pytest.approx(
        sum(float(p) for p in parts.values()), rel=1e-5
    )
    for name, parameter in task.network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


# --- samples ----------------------------------------------------------------------
