"""The judge: what it sees, that pairs stay apart, the second look, training data and training."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from hybridvo.data.presets import build_options, read_yaml
from hybridvo.errors import CheckpointError, InputError
from hybridvo.geometry import se3_exp
from hybridvo.hypotheses.generate import HypothesisSet, generate
from hybridvo.hypotheses.selector import _searched
from hybridvo.network import judge as judge_network
from hybridvo.network.judge import JudgeInputs, JudgeNetwork, JudgeOptions
from hybridvo.network.scorer import selector_inputs
from hybridvo.network.weights import load_weights, pretrained, save_weights
from hybridvo.options import Options
from hybridvo.pipeline import refine
from hybridvo.synthetic.scenarios import Scenario, make_pair
from hybridvo.training import judge_data
from hybridvo.training.judge_batches import PictureBatch, ego_flow_error, read_batches
from hybridvo.training.judge_loop import JudgeTrainer, JudgeTrainingOptions

CELL = Scenario(moving=0.6, objects=1, flow_noise_px=0.3, depth_noise=0.01)
SIZE = {"height": 96, "width": 224}


@pytest.fixture(scope="module")
def network() -> JudgeNetwork:
    torch.manual_seed(3)
    made = JudgeNetwork()
    # the last layers start at zero; a judge that says something is wanted here
    for layer in (made.score, made.trust):
        torch.nn.init.normal_(layer.weight, std=0.3)
    return made.eval()


def search(seed: int, **cell: object) -> tuple[HypothesisSet, object, dict]:
    pair, truth = make_pair(replace(CELL, **cell), seed, **SIZE)
    found = generate(pair, np.eye(4)[None], Options())
    assert isinstance(found, HypothesisSet) and len(found.poses) > 1
    return found, pair, truth


def inputs_of(seed: int) -> JudgeInputs:
    found, _, _ = search(seed)
    everything = slice(None)
    return selector_inputs(
        found.maps(), _searched(found), everything, None, None, torch.device("cpu")
    )


def together(parts: list[JudgeInputs]) -> JudgeInputs:
    values = {f.name: torch.cat([getattr(p, f.name) for p in parts]) for f in fields(JudgeInputs)}
    counts = [len(p.owner) for p in parts]
    values["owner"] = torch.repeat_interleave(torch.arange(len(parts)), torch.tensor(counts))
    values["parent"] = torch.arange(sum(counts))
    return JudgeInputs(**values)


def test_support_is_that_of_the_solver(network: JudgeNetwork) -> None:
    # the same robust weight, from torch formulas of their own and from the solver's kernel
    found, pair, _ = search(1)
    answer = refine(pair)
    judged = network.encode(inputs_of(1)).support.detach().numpy()
    for hypothesis in answer.hypotheses:
        errors = [np.abs(s - hypothesis.inliers).max() for s in judged]
        # float32 residuals of 0.3 px noise: a hundredth of a standard deviation
        assert min(errors) < 0.02
    assert found.grid.count == judged[0].size


def test_pictures_do_not_see_each_other(network: JudgeNetwork) -> None:
    parts = [inputs_of(seed) for seed in (1, 2)]
    broken = replace(parts[1], depth=torch.full_like(parts[1].depth, torch.nan))
    with torch.no_grad():
        alone = network(parts[0])
        for other in (parts[1], broken):
            both = network(together([parts[0], other]))
            n = len(parts[0].owner)
            # another batch size may sum in another order
            torch.testing.assert_close(both.score[:n], alone.score, atol=1e-4, rtol=1e-4)
            torch.testing.assert_close(both.mask[:n], alone.mask, atol=1e-3, rtol=1e-3)


def test_holes_and_unknown_depths_give_finite_answers(network: JudgeNetwork) -> None:
    inputs = inputs_of(1)
    usable = inputs.usable.clone()
    usable[:, :20] = False
    nothing = torch.zeros_like(usable)
    unknown = torch.full_like(inputs.log_depth_curr, torch.nan)
    with torch.no_grad():
        for mask in (usable, nothing):
            out = network(replace(inputs, usable=mask, log_depth_curr=unknown))
            assert torch.isfinite(out.score).all() and torch.isfinite(out.mask).all()
            assert (out.support[~mask.expand_as(out.support)] == 0).all()


def test_the_second_look_shares_what_the_first_has_seen(network: JudgeNetwork) -> None:
    # a refit equal to its parent is seen as the parent, but for the flag that it is a refit
    inputs = inputs_of(1)
    with torch.no_grad():
        first = network.encode(inputs)
        again = network.encode(inputs, (inputs, first))
        anew = network.encode(inputs, (inputs, network(inputs)))
    torch.testing.assert_close(first.levels[0], again.levels[0])
    torch.testing.assert_close(again.score, anew.score)
    assert (first.score - again.score).abs().max() > 1e-6


def test_weights_round_trip(network: JudgeNetwork, tmp_path: Path) -> None:
    path = save_weights(tmp_path / "j.safetensors", network, network.options, {}, "float16")
    read, _ = load_weights(path)
    assert isinstance(read, JudgeNetwork) and read.options == JudgeOptions()
    with pytest.raises(InputError):
        save_weights(path, network, JudgeOptions(width=0.5), {})
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError):
        load_weights(path)
    for bad in ({"kind": "pwvo"}, {"width": 0.0}, {"width": True}):
        with pytest.raises(InputError):
            JudgeOptions(**bad)


def test_pictures_are_the_pairs_they_came_from() -> None:
    first, again = judge_data.draw_pictures(3), judge_data.draw_pictures(3)
    assert len(first) == len(again)
    for one, two in zip(first, again, strict=True):
        for key in one:
            np.testing.assert_array_equal(one[key], two[key])


def batches(folder: Path) -> list[PictureBatch]:
    return list(read_batches(sorted(folder.glob("*.npz")), 4, None))


def test_the_truth_of_a_picture_explains_its_static_pixels(shards: Path) -> None:
    for batch in batches(shards):
        owner = torch.arange(len(batch.T))
        assert ego_flow_error(batch.T, owner, batch).max() < 1e-3
        # where the flow is true, static pixels follow the true motion
        for b in np.flatnonzero(batch.source == 1):
            inputs = batch.inputs
            x, y = inputs.ray[b]
            z = batch.depth_true[b]
            P, K = batch.T[b], inputs.K[b]
            X, Y, Z = (z * (P[i, 0] * x + P[i, 1] * y + P[i, 2]) + P[i, 3] for i in range(3))
            u = K[0] * X / Z + K[2] - inputs.target[b, 0]
            v = K[1] * Y / Z + K[3] - inputs.target[b, 1]
            distance = torch.sqrt(u * u + v * v) * 1024 / inputs.image_width[b]
            usable = inputs.usable[b] & (z > 0)
            static = usable & (batch.label[b] == judge_data.STATIC)
            moving = usable & (batch.label[b] == judge_data.MOVING)
            if moving.sum() > 50 and static.sum() > 50:
                assert distance[static].median() < distance[moving].median()


def test_training_learns_and_goes_on(shards: Path, tmp_path: Path) -> None:
    options = JudgeTrainingOptions(JudgeOptions(width=0.5), batch_size=4, second_look_from=0.0)
    trainer = JudgeTrainer(options, shards, tmp_path)
    batch = max(batches(shards), key=lambda b: len(b.T))
    losses = [trainer.update(batch, 0.5) for _ in range(40)]
    assert {"choice", "mask", "second", "trust"} <= set(losses[0])
    # the same pictures again and again: the masks are learned
    assert losses[-1]["mask"] < 0.9 * losses[0]["mask"]
    trainer.save()
    other = JudgeTrainer(options, shards, tmp_path)
    assert other.resume()
    expected, got = trainer.update(batch, 0.5), other.update(batch, 0.5)
    assert expected == got
    with pytest.raises(InputError):
        JudgeTrainer(options, tmp_path / "nothing", tmp_path).run(1.0)
    for bad in ({"batch_size": 0}, {"ema_decay": 1.0}, {"learning_rate": 0.0}):
        with pytest.raises(InputError):
            JudgeTrainingOptions(**bad)


def test_the_card_beside_the_weights_is_theirs() -> None:
    path = pretrained("judge")
    network, card = load_weights(path)
    assert json.loads(path.with_suffix(".json").read_text()) == card
    assert {"command", "commit", "pictures", "held_out", "options"} <= set(card)
    assert sum(p.numel() for p in network.parameters()) < 1_000_000


def test_the_shipped_configuration_loads_and_is_the_shipped_network() -> None:
    path = Path(__file__).parents[2] / "configs" / "train_judge.yaml"
    options = build_options(JudgeTrainingOptions, read_yaml(path), str(path))
    network, _ = load_weights(pretrained("judge"))
    assert options.network == network.options


def test_what_was_expected_is_weighed_by_its_covariance() -> None:
    inputs = inputs_of(1)
    sigma = torch.tensor([0.1, 0.2, 0.4, 0.01, 0.02, 0.04])
    delta = np.array([0.1, 0.0, 0.4, 0.0, 0.02, 0.0])  # one standard deviation on three axes
    pose = torch.as_tensor(se3_exp(delta)[None, :3], dtype=torch.float32)
    told = replace(
        inputs,
        T_last=torch.eye(4)[None, :3],
        has_last=torch.tensor([True]),
        last_information=torch.diag(1 / sigma**2)[None],
        pose=pose.expand(len(inputs.owner), 3, 4),
    )
    _, scalars, _ = judge_network.candidate_channels(told, None)
    # three of six: 1 / (1 + 3 / 6). First order leaves half of 0.02 rad x 0.4 m, 0.04 of 0.1 m:
    # 0.08 in the square, 0.006 here
    torch.testing.assert_close(scalars[0, 4], torch.tensor(2 / 3), atol=7e-3, rtol=0)
    assert scalars[0, 5] == 1
    far = replace(told, last_information=1e12 * told.last_information)
    _, scalars, _ = judge_network.candidate_channels(far, None)
    # a prior that is sure of itself says a bounded amount
    assert torch.isfinite(scalars).all() and scalars.abs().max() < 5
    _, unknown, _ = judge_network.candidate_channels(inputs, None)
    assert (unknown[:, 4:] == 0).all()


def test_a_covariance_that_is_none_counts_as_unknown() -> None:
    inputs = inputs_of(1)
    usual = judge_network.expected_information(inputs.depth, inputs.usable, None)
    for broken in (torch.zeros(1, 6, 6), torch.full((1, 6, 6), torch.nan)):
        told = judge_network.expected_information(inputs.depth, inputs.usable, broken)
        torch.testing.assert_close(told, usual)
    exact = judge_network.expected_information(
        inputs.depth, inputs.usable, torch.diag(torch.tensor([4.0] * 3 + [0.25] * 3))[None]
    )
    torch.testing.assert_close(exact[0].diagonal(), torch.tensor([0.25] * 3 + [4.0] * 3))
    # 0.01 rad, and as much of the typical depth: its reciprocal is the mean of the reciprocals
    near = (1 / inputs.depth[inputs.usable]).mean()
    torch.testing.assert_close(usual[0, 0, 0].sqrt(), near / 0.01)
    torch.testing.assert_close(usual[0, 5, 5].sqrt(), torch.tensor(100.0))


def test_a_judge_that_was_shown_less_can_be_taught_more(
    network: JudgeNetwork, shards: Path, tmp_path: Path
) -> None:
    wide = {"shared.weight": 9, "scalars.weight": 6, "summary.weight": -2}
    state = {
        k: (v[:, : wide[k]] if k in wide else v).contiguous()
        for k, v in network.state_dict().items()
    }
    save_file(state, tmp_path / "old.safetensors")
    trainer = JudgeTrainer(JudgeTrainingOptions(), shards, tmp_path)
    trainer.start_from(tmp_path / "old.safetensors")
    inputs = inputs_of(1)
    shown = replace(inputs, has_static=torch.tensor([True]), static=torch.ones_like(inputs.static))
    with torch.no_grad():
        # what it was never shown counts nothing yet, and what it was counts as before
        got, other = trainer.network.eval()(inputs), trainer.network(shown)
        expected = network(inputs)
    torch.testing.assert_close(got.score, other.score)
    torch.testing.assert_close(got.score, expected.score, atol=1e-4, rtol=1e-4)
    state["score.weight"] = state["score.weight"][:, :-1].contiguous()
    state.pop("score.bias")
    save_file(state, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="not the weights of a judge"):
        trainer.start_from(tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="not a file of weights"):
        trainer.start_from(tmp_path / "nothing.safetensors")
