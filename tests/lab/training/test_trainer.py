"""The loop: the same after an interruption, records that must agree, losses that are not finite."""

from __future__ import annotations

import dataclasses
import itertools
import os

import numpy as np
import pytest
import torch

from hybridvo.core.errors import CheckpointError, DegenerateError, InputError
from hybridvo_lab.paper.layers import NetworkOptions
from hybridvo_lab.paper.losses import LossOptions
from hybridvo_lab.synthetic.dataset import Mixture
from hybridvo_lab.synthetic.paper_samples import PaperOptions
from hybridvo_lab.training.options import (
    OptimizerOptions,
    PaperTrainingOptions,
    ScheduleOptions,
)
from hybridvo_lab.training.paper_task import PaperTask, sample_stream
from hybridvo_lab.training.trainer import Trainer
from hybridvo_lab.training.validation import TrainingBatch

TINY = PaperTrainingOptions(
    network=NetworkOptions(width=0.1, head_stride=2),
    batch_size=4,
    steps=6,
    ema_decay=0.9,
    data=("paper", "diverse"),
    data_weights=(0.5, 0.5),
    log_every=2,
)


def changed(**changes) -> PaperTrainingOptions:
    return dataclasses.replace(TINY, **changes)


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def batch_of(mixture: Mixture):
    return next(sample_stream(mixture, 0, 0, 4))


@pytest.mark.slow
def test_resume_is_equal(mixture, tmp_path):
    (tmp_path / "whole").mkdir()
    whole = Trainer(PaperTask(TINY, mixture), tmp_path / "whole")
    assert whole.run() == "steps"
    first = Trainer(PaperTask(TINY, mixture), tmp_path)
    for batch in itertools.islice(first.task.batches(0, 0), 3):
        first.advance(batch)
    first.save()
    torch.manual_seed(99)
    second = Trainer(PaperTask(TINY, mixture), tmp_path)
    assert second.resume()
    assert (second.step, second.samples) == (3, 12)
    second.run()
    assert same(whole.network.state_dict(), second.network.state_dict())
    assert same(whole.exported.state_dict(), second.exported.state_dict())
    assert whole.samples == second.samples == 24


def test_another_record_is_refused_and_the_log_may_change(mixture, tmp_path):
    Trainer(PaperTask(TINY, mixture), tmp_path).save()
    for changes in (
        {"seed": 1},
        {"loss": LossOptions(translation_form="laplace")},
        {"network": NetworkOptions(width=0.1, head_stride=2, decoders=2)},
    ):
        other = PaperTask(changed(**changes), mixture)
        with pytest.raises(InputError, match=f"another {next(iter(changes))}"):
            Trainer(other, tmp_path).resume()
    presets = (PaperOptions(height=32, width=64, objects=3), mixture.presets[1])
    with pytest.raises(InputError, match="data"):
        Trainer(PaperTask(TINY, Mixture(presets, (0.5, 0.5))), tmp_path).resume()
    assert Trainer(PaperTask(changed(log_every=1), mixture), tmp_path).resume()
    assert not Trainer(PaperTask(TINY, mixture), tmp_path / "none").resume()


@pytest.mark.parametrize(
    "damage", ["truncated", "text", "empty", "foreign", "code"]
)
def test_damaged_checkpoints_are_refused(mixture, tmp_path, damage):
    Trainer(PaperTask(TINY, mixture), tmp_path).save()
    path = tmp_path / "checkpoint.pt"
    whole = path.read_bytes()
    if damage == "foreign":
        torch.save({"model": torch.zeros(3)}, path)
    elif damage == "code":
        torch.save({"record": Evil()}, path)
    else:
        content = {
            "truncated": whole[: len(whole) // 2],
            "text": b"not one",
            "empty": b"",
        }
        path.write_bytes(content[damage])
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt"):
        Trainer(PaperTask(TINY, mixture), tmp_path).resume()


class Evil:
    def __reduce__(self):
        return os.system, ("false",)


def test_time_limit_and_request_end_with_a_checkpoint(mixture, tmp_path):
    trainer = Trainer(PaperTask(TINY, mixture), tmp_path)
    assert trainer.run(time_limit_s=1e-6) == "time"
    trainer.stop_requested = True
    assert trainer.run() == "signal"
    again = Trainer(PaperTask(TINY, mixture), tmp_path)
    assert again.resume() and again.step == 2


def test_a_step_that_is_not_finite_ends_the_run(mixture, tmp_path):
    trainer = Trainer(PaperTask(TINY, mixture), tmp_path)
    good = batch_of(mixture)
    bad = TrainingBatch(
        good.fields | {"T_curr_prev": torch.full((4, 4, 4), torch.nan)}
    )
    before = {k: v.clone() for k, v in trainer.network.state_dict().items()}
    with pytest.raises(DegenerateError, match="not finite at update 0"):
        trainer.update(bad, 0.0)
    assert same(before, trainer.network.state_dict())
    trainer.update(good, 0.0)
    assert not same(before, trainer.network.state_dict())


@pytest.mark.slow
def test_loss_falls(mixture, tmp_path):
    options = changed(
        network=NetworkOptions(width=0.25, head_stride=2),
        optimizer=OptimizerOptions(learning_rate=5e-3, betas=(0.9, 0.999)),
        schedule=ScheduleOptions(halvings=()),
        loss=LossOptions(translation_form="laplace"),
    )
    trainer = Trainer(PaperTask(options, mixture), tmp_path)
    batch = batch_of(mixture)
    losses = [trainer.update(batch, 0.0)["loss"] for _ in range(30)]
    assert np.mean(losses[-5:]) < 0.75 * np.mean(losses[:5])


@pytest.mark.parametrize("kind", ["vonet", "vonet-attention", "pixelwise"])
def test_the_baselines_train(mixture, tmp_path, kind):
    plain = LossOptions(
        pose_uncertainty=False, flow_uncertainty=False, depth_uncertainty=False
    )
    pixelwise = NetworkOptions(width=0.1, uncertainty=False)
    network = pixelwise if kind == "pixelwise" else NetworkOptions(kind, width=0.1)
    run = changed(network=network, loss=plain, selection="mean", steps=2)
    trainer = Trainer(PaperTask(run, mixture), tmp_path)
    trainer.run()
    result = trainer.task.evaluate(trainer.exported, 4)["paper"]
    assert np.isfinite(result["epe"])
    assert result["auroc_rotation"] is None


@pytest.mark.parametrize("kind", ["pwvo", "vonet"])
def test_a_step_below_half_width_at_the_paper_s_size(tmp_path, kind):
    """oneDNN wrote past its memory here in channels-last, see network/paper/layers.py."""
    uncertain = kind == "pwvo"
    loss = LossOptions(
        pose_uncertainty=uncertain, flow_uncertainty=False, depth_uncertainty=False
    )
    options = PaperTrainingOptions(
        network=NetworkOptions(kind, width=0.25), batch_size=2, loss=loss
    )
    task = PaperTask(options, Mixture((PaperOptions(),), (1.0,)))
    figures = Trainer(task, tmp_path).update(next(task.batches(0, 0)), 0.5)
    assert np.isfinite(figures["loss"]) and figures["grad_norm"] > 0


def test_cosine_by_hand():
    schedule = ScheduleOptions(kind="cosine", warmup=0.2, final_share=0.1)
    # middle of the descent: half way between 1 and 0.1
    for progress, factor in [
        (0.1, 0.5),
        (0.2, 1.0),
        (0.6, 0.55),
        (1.0, 0.1),
        (2.0, 0.1),
    ]:
        assert schedule.factor(progress) == pytest.approx(factor)
