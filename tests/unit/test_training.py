from __future__ import annotations

import dataclasses
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hybridvo.errors import CheckpointError, DegenerateError, InputError
from hybridvo.network.losses import LossOptions
from hybridvo.network.pwvo import NetworkOptions
from hybridvo.network.weights import load_weights
from hybridvo.synthetic.diverse import WideOptions
from hybridvo.synthetic.paper import PaperOptions
from hybridvo.training import checkpoint, held_out, loop, options, stream
from hybridvo.types import PixelwisePrediction

ROOT = Path(__file__).parents[2]
SIZE = {"height": 32, "width": 64}
TINY = options.TrainingOptions(
    network=NetworkOptions(width=0.1, head_stride=2),
    batch_size=4,
    steps=6,
    ema_decay=0.9,
    data=("paper", "wide"),
    data_weights=(0.5, 0.5),
    log_every=2,
    evaluate_count=4,
)


def mixture() -> stream.Mixture:
    return stream.Mixture((PaperOptions(**SIZE), WideOptions(**SIZE)), (0.5, 0.5))


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


# --- stream --------------------------------------------------------------------------------------


def flows(loader, count: int) -> list[torch.Tensor]:
    iterator = iter(loader)
    return [next(iterator).inputs.flow for _ in range(count)]


@pytest.mark.parametrize("workers", [1, 2])
def test_workers_change_nothing(workers):
    alone = flows(stream.SampleStream(1, 8, mixture(), batch_size=2), 4)
    loader = torch.utils.data.DataLoader(
        stream.SampleStream(1, 8, mixture(), batch_size=2),
        batch_size=None,
        num_workers=workers,
        multiprocessing_context="fork",
    )
    for a, b in zip(alone, flows(loader, 4), strict=True):
        assert torch.equal(a, b)


def test_ranks_share_one_stream():
    one = flows(stream.SampleStream(1, 0, mixture(), batch_size=4), 2)
    ranks = [
        flows(stream.SampleStream(1, 0, mixture(), rank, 2, batch_size=2), 2) for rank in (0, 1)
    ]
    for step in range(2):
        assert torch.equal(one[step], torch.cat([ranks[0][step], ranks[1][step]]))


def test_stream_resumes_at_an_index_and_yields_samples():
    samples = iter(stream.SampleStream(1, 5, mixture()))
    direct = stream.SampleStream(1, 0, mixture())
    for index in (5, 6, 7):
        np.testing.assert_array_equal(next(samples).flow, direct.draw(index).flow)


def test_no_training_seed_draws_a_held_out_sample():
    held = {
        tuple(stream.sample_generator(s, i).integers(0, 2**62, 2))
        for s in range(3)
        for i in range(9)
    }
    train = {
        tuple(stream.sample_generator(s, i, training=True).integers(0, 2**62, 2))
        for s in range(3)
        for i in range(9)
    }
    assert len(held) == len(train) == 27 and not held & train


def test_mixture_keeps_its_shares():
    class Mark:
        def __init__(self, name):
            self.name = name

        def sample(self, rng):
            return self.name

    mixed = stream.Mixture((Mark("a"), Mark("b"), Mark("c")), (1.0, 0.0, 3.0))
    drawn = [mixed.sample(stream.sample_generator(0, i)) for i in range(2000)]
    # Four standard errors of a share of a quarter.
    assert drawn.count("a") / 2000 == pytest.approx(0.25, abs=0.04)
    assert "b" not in drawn


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: stream.SampleStream(0, 0, mixture(), 2, 2), "rank"),
        (lambda: stream.SampleStream(-1, 0, mixture()), "seed"),
        (lambda: stream.SampleStream(0, -1, mixture()), "start"),
        (lambda: stream.Mixture((PaperOptions(),), (0.5, 0.5)), "one weight"),
        (lambda: stream.Mixture((PaperOptions(),), (-1.0,)), "non-negative"),
        (lambda: stream.collate([]), "at least one"),
    ],
)
def test_stream_refuses_nonsense(call, message):
    with pytest.raises(InputError, match=message):
        call()


# --- schedule and options ------------------------------------------------------------------------


def test_halving_is_the_published_staircase():
    schedule = options.ScheduleOptions()
    steps = [0, 24_999, 25_000, 50_000, 75_000, 99_999]
    rates = [1e-4 * schedule.factor(step / 100_000) for step in steps]
    assert rates == [1e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5, 1.25e-5]


def test_cosine_by_hand():
    schedule = options.ScheduleOptions(kind="cosine", warmup=0.2, final_share=0.1)
    # Middle of the descent: half way between 1 and 0.1.
    for progress, factor in [(0.1, 0.5), (0.2, 1.0), (0.6, 0.55), (1.0, 0.1), (2.0, 0.1)]:
        assert schedule.factor(progress) == pytest.approx(factor)


JUDGE = ROOT / "configs" / "train_judge.yaml"
# the judge has options of its own, which tests/unit/test_judge.py loads
TRAINING_FILES = sorted(set((ROOT / "configs").glob("train_*.yaml")) - {JUDGE})


@pytest.mark.parametrize("path", TRAINING_FILES, ids=lambda p: p.name)
def test_every_training_file_loads(path):
    run, mixed = options.load_training_options(path)
    assert len(mixed.presets) == len(run.data)
    if path.name in ("train_paper.yaml", "train_vonet.yaml"):
        published = options.TrainingOptions()
        assert (run.optimizer, run.schedule) == (published.optimizer, published.schedule)
        assert (run.batch_size, run.steps) == (100, 100_000)


def test_training_file_with_an_unknown_key(tmp_path):
    path = tmp_path / "train.yaml"
    path.write_text("optimizer: {learning_rat: 1.0e-4}")
    with pytest.raises(InputError, match=r"did you mean 'learning_rate'"):
        options.load_training_options(path)


# --- loop ----------------------------------------------------------------------------------------


def test_resume_is_bit_equal(tmp_path):
    whole = loop.Trainer(TINY, mixture())
    assert whole.run() == "steps"
    first = loop.Trainer(TINY, mixture(), tmp_path)
    first.run(max_steps=3)
    torch.manual_seed(99)
    second = loop.Trainer(dataclasses.replace(TINY, seed=0), mixture(), tmp_path)
    second.resume(tmp_path / "checkpoint.pt")
    assert (second.step, second.samples) == (3, 12)
    second.run()
    assert same(whole.network.state_dict(), second.network.state_dict())
    assert same(whole.exported.state_dict(), second.exported.state_dict())
    for a, b in zip(
        whole.optimizer.state_dict()["state"].values(),
        second.optimizer.state_dict()["state"].values(),
        strict=True,
    ):
        assert same(a, b)
    assert whole.samples == second.samples == 24
    assert torch.equal(whole.state()["rng"], second.state()["rng"])


def test_loss_falls():
    run = dataclasses.replace(
        TINY,
        steps=40,
        network=NetworkOptions(width=0.25, head_stride=2),
        optimizer=options.OptimizerOptions(learning_rate=2e-3, betas=(0.9, 0.999), head_rate=5.0),
        schedule=options.ScheduleOptions(kind="constant"),
        translation_loss="laplace",
    )
    trainer = loop.Trainer(run, mixture())
    batch = next(iter(stream.SampleStream(0, 0, mixture(), batch_size=4)))
    losses = [trainer.update(batch, 0.0)["loss"] for _ in range(40)]
    assert np.mean(losses[-5:]) < 0.75 * np.mean(losses[:5])


def test_steps_that_are_not_finite_are_skipped_and_counted():
    trainer = loop.Trainer(TINY, mixture())
    good = next(iter(stream.SampleStream(0, 0, mixture(), batch_size=4)))
    bad = dataclasses.replace(
        good, targets=dataclasses.replace(good.targets, rotation_deg=torch.full((4, 3), torch.nan))
    )
    before = {k: v.clone() for k, v in trainer.network.state_dict().items()}
    trainer.update(bad, 0.0)
    assert trainer.skipped == 1 and same(before, trainer.network.state_dict())
    trainer.update(good, 0.0)
    assert trainer.skipped_in_a_row == 0 and not same(before, trainer.network.state_dict())
    with pytest.raises(DegenerateError, match="50 times in a row"):
        for _ in range(50):
            trainer.update(bad, 0.0)
    assert all(torch.isfinite(v).all() for v in trainer.network.state_dict().values())


def test_time_limit_and_request_end_with_a_checkpoint(tmp_path):
    trainer = loop.Trainer(TINY, mixture(), tmp_path)
    assert trainer.run(time_limit_s=1e-6) == "time"
    assert checkpoint.load_checkpoint(tmp_path / "checkpoint.pt")["progress"]["step"] == 1
    trainer.stop_requested = True
    assert trainer.run() == "signal"
    assert checkpoint.load_checkpoint(tmp_path / "checkpoint.pt")["progress"]["step"] == 2


@pytest.mark.parametrize("kind", ["vonet", "pixelwise"])
def test_the_baselines_train(kind):
    plain = LossOptions(pose_uncertainty=False, flow_uncertainty=False, depth_uncertainty=False)
    network = (
        NetworkOptions("vonet", width=0.1)
        if kind == "vonet"
        else NetworkOptions(width=0.1, uncertainty=False)
    )
    run = dataclasses.replace(TINY, network=network, loss=plain, selection="mean", steps=2)
    trainer = loop.Trainer(run, mixture())
    trainer.run()
    result = trainer.evaluate()["paper"]
    assert trainer.skipped == 0 and np.isfinite(result["epe"]) and result["auroc"] is None


def test_laplace_loss_by_hand():
    batch = next(iter(stream.SampleStream(0, 0, mixture(), batch_size=2)))
    zero = torch.zeros(2, 3, 32, 64)
    target = batch.targets.translation[:, :, None, None]
    log_scale = torch.full_like(zero, np.log(0.5))
    output = PixelwisePrediction(zero, target + torch.full_like(zero, 0.25), log_scale, log_scale)
    run = dataclasses.replace(
        TINY, translation_loss="laplace", loss=LossOptions(flow=False, depth=False)
    )
    _, parts = loop.training_loss(output, batch, run)
    # (0.25 / 0.5 + log 0.5) / 2
    assert float(parts["translation"]) == pytest.approx((0.5 + np.log(0.5)) / 2, abs=1e-6)


# --- checkpoints ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    loop.Trainer(dataclasses.replace(TINY, steps=1), mixture(), folder).run()
    return folder / "checkpoint.pt"


@pytest.mark.parametrize("damage", ["truncated", "text", "empty", "foreign", "nan", "other"])
def test_damaged_checkpoints_are_refused(finished, tmp_path, damage):
    path = tmp_path / "checkpoint.pt"
    whole = finished.read_bytes()
    if damage == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "text":
        path.write_text("not a checkpoint")
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "foreign":
        torch.save({"model": torch.zeros(3)}, path)
    else:
        state = torch.load(finished, weights_only=True)
        if damage == "nan":
            next(iter(state["network"].values())).fill_(torch.nan)
        else:
            state["options"]["network"]["width"] = 0.2
        torch.save(state, path)
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt"):
        loop.Trainer(TINY, mixture()).resume(path)


class Evil:
    def __reduce__(self):
        return os.system, ("false",)


def test_a_checkpoint_cannot_run_code(tmp_path):
    path = tmp_path / "checkpoint.pt"
    torch.save({"format": checkpoint.FORMAT, "network": Evil()}, path)
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt"):
        checkpoint.load_checkpoint(path)


def test_a_failed_write_keeps_the_previous_checkpoint(finished, tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(finished.read_bytes())

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save_checkpoint(path, {"network": {}})
    assert path.read_bytes() == finished.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["checkpoint.pt"]


# --- held-out figures ----------------------------------------------------------------------------


def test_area_under_curve_by_hand():
    score = np.array([0.1, 0.4, 0.35, 0.8])
    label = np.array([False, False, True, True])
    assert held_out.area_under_curve(score, label) == 0.75
    assert held_out.area_under_curve(np.ones(4), label) == 0.5
    assert held_out.area_under_curve(score, np.ones(4, bool)) is None


class Oracle(torch.nn.Module):
    """Answers with a given motion and calls moving pixels uncertain."""

    def __init__(self, truth: stream.TrainingBatch, share: float) -> None:
        super().__init__()
        self.dummy = torch.nn.Parameter(torch.zeros(1))
        self.truth, self.share = truth, share

    def forward(self, inputs):
        maps = self.truth.moving[:, None].expand(-1, 3, -1, -1).float()
        rotation, translation = (
            (self.share * x)[:, :, None, None].expand_as(maps)
            for x in (self.truth.targets.rotation_deg, self.truth.targets.translation)
        )
        return PixelwisePrediction(rotation, translation, maps, maps)


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_figures_of_an_oracle_and_of_zero_motion(share):
    preset = PaperOptions(**SIZE)
    samples = [preset.sample(stream.sample_generator(3, i)) for i in range(6)]
    network = Oracle(stream.collate(samples), share)
    result = held_out.evaluate_network(network, preset, 3, 6, batch_size=6)
    assert result["auroc"] == 1.0
    for name, exact in (("r_err_deg", 1e-5), ("t_err", 1e-6), ("epe", 1e-2)):
        expected = 0.0 if share else result[f"zero_{name}"]
        assert result[name] == pytest.approx(expected, abs=exact)
    direct = np.mean([np.abs(s.rotation_deg).mean() for s in samples])
    assert result["zero_r_err_deg"] == pytest.approx(direct, rel=1e-5)
    flow = np.mean(
        [
            (np.abs(s.ego_flow) * (np.linalg.norm(s.ego_flow, axis=-1) < 400)[..., None]).mean()
            for s in samples
        ]
    )
    assert result["zero_epe"] == pytest.approx(flow, rel=1e-4)


# --- the tool ------------------------------------------------------------------------------------


def write_config(folder: Path, **changes) -> Path:
    for kind in ("paper", "wide"):
        (folder / f"{kind}.yaml").write_text(f"preset: {kind}\nheight: 32\nwidth: 64\n")
    config = {
        "network": {"width": 0.1, "head_stride": 2},
        "data": ["paper.yaml", "wide.yaml"],
        "data_weights": [0.5, 0.5],
        "steps": 3,
        "batch_size": 4,
        "log_every": 1,
    }
    path = folder / "train.yaml"
    path.write_text(json.dumps(config | changes))
    return path


@pytest.fixture
def tool():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import train

        yield train.main
    finally:
        sys.path.remove(str(ROOT / "tools"))


def test_tool_trains_resumes_and_exports(tool, tmp_path, capsys):
    config, out, weights = write_config(tmp_path), tmp_path / "run", tmp_path / "w.safetensors"
    common = ["--config", str(config), "--out", str(out)]
    assert tool([*common, "--steps", "2"]) == 0
    assert tool(common) == 0
    export = ["--no-train", "--export", str(weights), "--export-count", "3"]
    assert tool([*common, *export]) == 0
    log = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in log] == [1, 2, 3]
    assert all(entry["samples_per_s"] > 0 and np.isfinite(entry["loss"]) for entry in log)
    network, card = load_weights(weights)
    assert card["samples"] == 12 and card["seed"] == 0 and card["command"].endswith(f"--out {out}")
    assert card["held_out"]["paper"]["count"] == 3
    state = torch.load(out / "checkpoint.pt", weights_only=True)["network"]
    for name, value in network.state_dict().items():
        # float16: eleven bits of mantissa.
        torch.testing.assert_close(value, state[name], rtol=1e-3, atol=1e-6)


def test_tool_says_what_is_wrong(tool, tmp_path, capsys):
    config = write_config(tmp_path, bach_size=3)
    assert tool(["--config", str(config), "--out", str(tmp_path / "run")]) == 2
    assert "did you mean 'batch_size'" in capsys.readouterr().err
    config = write_config(tmp_path)
    assert tool(["--config", str(config), "--out", str(tmp_path / "none"), "--no-train"]) == 2
    (tmp_path / "file").write_text("")
    assert tool(["--config", str(config), "--out", str(tmp_path / "file" / "run")]) == 5


WORKER = """
import sys
import torch
import torch.distributed as dist
from hybridvo.synthetic.paper import PaperOptions
from hybridvo.network.pwvo import NetworkOptions
from hybridvo.training import loop, options, stream
torch.set_num_threads(1)
dist.init_process_group("gloo")
run = options.TrainingOptions(network=NetworkOptions(width=0.1, head_stride=2), batch_size=2,
                              steps=1, optimizer=options.OptimizerOptions(clip_norm=1e9))
mixture = stream.Mixture((PaperOptions(height=32, width=64),), (1.0,))
trainer = loop.Trainer(run, mixture)
assert trainer.run() == "steps" and trainer.samples == 4
if dist.get_rank() == 0:
    torch.save({n: p.grad for n, p in trainer.network.named_parameters()}, sys.argv[1])
dist.destroy_process_group()
"""


def test_two_processes_have_the_gradient_of_one(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    result = tmp_path / "gradients.pt"
    environment = {
        **os.environ,
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "OMP_NUM_THREADS": "1",
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WORKER, str(result)],
            env={**environment, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
        )
        for rank in (0, 1)
    ]
    for process in processes:
        _, error = process.communicate(timeout=120)
        assert process.returncode == 0, error.decode()
    run = options.TrainingOptions(
        network=NetworkOptions(width=0.1, head_stride=2),
        batch_size=4,
        steps=1,
        optimizer=options.OptimizerOptions(clip_norm=1e9),
    )
    trainer = loop.Trainer(run, stream.Mixture((PaperOptions(**SIZE),), (1.0,)))
    trainer.run()
    shared = torch.load(result, weights_only=True)
    for name, parameter in trainer.network.named_parameters():
        # Sums of float32 in another order.
        torch.testing.assert_close(
            shared[name], parameter.grad, rtol=1e-3, atol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_separation_by_hand():
    # Left half of the first pair moves; s of the rotation is 1 there and 0 elsewhere.
    moving = torch.zeros(2, 4, 4, dtype=torch.bool)
    moving[0, :, :2] = True
    s = moving[:, None, :, :].expand(-1, 3, -1, -1).float()
    batch = SimpleNamespace(moving=moving, inputs=SimpleNamespace(valid=torch.ones_like(moving)))
    zero = torch.zeros_like(s)
    # one unit of s apart, slope 2: log(1 + exp(-2)); the other way round log(1 + exp(2))
    expected = np.log1p(np.exp(-2.0))
    right = PixelwisePrediction(s, s, s, zero)
    assert float(loop._separation(right, batch)) == pytest.approx(expected, rel=1e-5)
    wrong = PixelwisePrediction(s, s, -s, zero)
    assert float(loop._separation(wrong, batch)) == pytest.approx(2.0 + expected, rel=1e-5)
    # a batch with one kind of pixels only tells nothing
    still = SimpleNamespace(moving=torch.zeros_like(moving), inputs=batch.inputs)
    assert float(loop._separation(right, still)) == 0.0


def test_a_checkpoint_of_another_training_is_refused(tmp_path, monkeypatch):
    asked = options.TrainingOptions(network=NetworkOptions(width=0.25), ema_decay=0.0)
    trainer = loop.Trainer(asked, stream.Mixture((PaperOptions(),), (1.0,)))
    for state in ({}, {"options": {"judge": {}}}, {"options": {"network": 3}}):
        monkeypatch.setattr(loop, "load_checkpoint", lambda path, state=state: state)
        with pytest.raises(CheckpointError, match="no checkpoint"):
            trainer.resume(tmp_path / "other.pt")
