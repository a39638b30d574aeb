"""The doors: trainings that are started again, cards that say what a run was trained with."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from hybridvo.core.errors import CheckpointError, InputError
from hybridvo.lab.synthetic.dataset import read_yaml
from hybridvo.lab.training.hypothesis_samples import Makers
from hybridvo.lab.training.options import load_paper_options, load_training_options
from hybridvo.lab.training.trainer import export_run
from hybridvo.network.models import PWVO_KIND, load_weights
from hybridvo.network.selection import SELECTION_METHODS
from hybridvo.run import cli
from hybridvo.run.commands.train import draw_training_samples
from tests.scripts import load_script

ROOT = Path(__file__).parents[3]


def write_config(folder: Path, **changes) -> Path:
    for kind in ("paper", "diverse"):
        (folder / f"{kind}.yaml").write_text(
            f"preset: {kind}\nheight: 32\nwidth: 64\n"
        )
    config = {
        "network": {"width": 0.1, "head_stride": 2},
        "data": ["paper.yaml", "diverse.yaml"],
        "data_weights": [0.5, 0.5],
        "steps": 2,
        "batch_size": 4,
        "log_every": 1,
    }
    path = folder / "train.yaml"
    path.write_text(json.dumps(config | changes))
    return path


@pytest.mark.parametrize(
    "path",
    sorted((ROOT / "configs").glob("train_*.yaml"))
    + sorted((ROOT / "configs/ablation").glob("*.yaml")),
    ids=lambda path: path.name,
)
def test_every_training_file_loads(path):
    if read_yaml(path).get("network", {}).get("kind") == PWVO_KIND:
        load_training_options(path)
    else:
        options, mixture = load_paper_options(path)
        assert len(mixture.presets) == len(options.data)


def test_a_recipe_is_laid_over_the_rows():
    rows = ROOT / "configs" / "ablation"
    for path in (rows / "recipes").iterdir():
        recipe = read_yaml(path)
        options, _ = load_paper_options(rows / "vonet.yaml", recipe)
        assert (options.network.kind, options.batch_size) == (
            "vonet",
            recipe["batch_size"],
        )
        assert (options.network.width == 1.0) == (path.stem == "full")


def test_the_rows_are_those_of_the_paper():
    rows = {}
    for path in (ROOT / "configs" / "ablation").glob("*.yaml"):
        rows[path.stem] = load_paper_options(path)[0]
    paper = rows["pwvo-paper"]
    assert paper.moving_weight == paper.fit_weight == 0
    assert (paper.loss.translation_form, paper.selection) == (
        "direction",
        "softmax",
    )
    for name in ("vonet", "pixelwise"):
        assert not rows[name].loss.needs_uncertainty
    naive = rows["pwvo-naive"]
    uncertain = rows["pwvo-uncertain"]
    assert naive.loss.pose_uncertainty and not naive.loss.flow_uncertainty
    assert uncertain.loss.flow_uncertainty and uncertain.loss.depth_uncertainty
    assert naive.selection == uncertain.selection == "mean"
    plain = [name for name in rows if name != "base" and "without" not in name]
    assert all(rows[name].loss.flow for name in plain)
    assert all(
        not row.loss.flow
        for name, row in rows.items()
        if name.endswith("-without-flow")
    )


def train(words: list[str]) -> int:
    return cli.main(["train", *words])


@pytest.mark.slow
def test_train_resumes_and_the_card_is_of_the_run(tmp_path, capsys):
    config = write_config(tmp_path)
    out = tmp_path / "run"
    weights = tmp_path / "w.safetensors"
    words = ["paper", "--config", str(config), "--out", str(out), "--seed", "2"]
    handler = signal.getsignal(signal.SIGTERM)
    assert train(words) == 0
    # a program that trains can be stopped as before
    assert signal.getsignal(signal.SIGTERM) == handler
    assert train(words) == 0
    assert "goes on at update 2" in capsys.readouterr().err
    other = write_config(tmp_path, selection="mean")
    assert (
        train(["paper", "--config", str(other), "--out", str(out), "--seed", "2"])
        == 2
    )
    assert (
        "another selection: it was 'softmax', now 'mean'" in capsys.readouterr().err
    )
    assert (
        train(
            ["export", "--out", str(out), "--export", str(weights), "--count", "4"]
        )
        == 0
    )
    _, card = load_weights(weights)
    assert (
        card["options"]["seed"] == 2
        and card["options"]["steps"] == card["updates"] == 2
    )
    assert "--seed 2" in card["command"] and set(card["held_out"]) == {
        "paper",
        "diverse",
    }
    assert json.loads(weights.with_suffix(".json").read_text()) == card


@pytest.mark.long
def test_pwvo_is_trained_and_exported(shards, tmp_path):
    config = tmp_path / "pwvo.yaml"
    weights = tmp_path / "w.safetensors"
    options = {"network": {"width": 0.25}, "steps": 2, "batch_size": 2, "files": 1}
    config.write_text(json.dumps(options))
    data = tmp_path / "shards"
    out = str(tmp_path / "run")
    words = ["pwvo", "--config", str(config), "--data", str(data), "--out", out]
    export = ["export", "--out", out, "--export", str(weights)]
    data.symlink_to(shards)
    assert train(words) == 0 and train(export) == 0
    network, card = load_weights(weights)
    assert network.options.kind == PWVO_KIND and card["updates"] == 2


def test_samples_are_drawn_shard_by_shard(tmp_path, monkeypatch, capsys):
    drawn = []

    def write_shard(folder, seed, makers):
        drawn.append((folder, seed, makers))
        return 5

    monkeypatch.setattr("hybridvo.run.commands.train.write_shard", write_shard)
    data = tmp_path / "data"
    words = [
        "samples",
        "--data",
        str(data),
        "--first-seed",
        "128",
        "--seeds",
        "100",
    ]
    assert train(words) == 0
    assert drawn == [(data, seed, Makers()) for seed in (128, 192)]
    assert data.is_dir() and "10" in capsys.readouterr().out
    assert train([*words[:-1], "-1"]) == 2
    assert "--seeds" in capsys.readouterr().err


def test_shares_are_named_where_some_are_missing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"tripod, semi_real, of_kind, got 2"):
        draw_training_samples(tmp_path, 0, 0, shares=(0.1, 0.2))
    assert draw_training_samples(tmp_path, 0, 0, shares=(0.1, 0.2, 0.3)) == {
        "samples": 0
    }


def test_an_export_needs_a_run(tmp_path):
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        export_run(tmp_path, tmp_path / "w.safetensors")


@pytest.mark.slow
def test_ablation_scores_milestones_and_goes_on(tmp_path, monkeypatch):
    tool = load_script("tools/ablation.py")
    configs = tmp_path / "configs"
    out = tmp_path / "out"
    configs.mkdir()
    plain = {
        "pose_uncertainty": False,
        "flow_uncertainty": False,
        "depth_uncertainty": False,
    }
    for name, changes in (
        ("vonet", {"network": {"kind": "vonet", "width": 0.1}, "loss": plain}),
        ("pwvo-paper", {"network": {"width": 0.1, "head_stride": 2}}),
    ):
        data = {
            "data": ["../paper.yaml"],
            "data_weights": [1.0],
            "data_size": [32, 64],
        }
        write_config(tmp_path, **data, **changes).rename(configs / f"{name}.yaml")
    monkeypatch.setattr(tool, "MILESTONES", (4, 8))
    words = [
        "--out",
        str(out),
        "--configs",
        str(configs),
        "--samples",
        "8",
        "--count",
        "4",
    ]
    handler = signal.getsignal(signal.SIGTERM)
    assert tool.main([*words, "--seeds", "0", "1"]) == 0
    assert signal.getsignal(signal.SIGTERM) == handler
    result = json.loads((out / "ablation.json").read_text())
    assert {(run["row"], run["seed"]) for run in result["runs"]} == {
        (row, seed) for row in ("vonet", "pwvo-paper") for seed in (0, 1)
    }
    assert all(set(run["curve"]) == {"4", "8"} for run in result["runs"])
    claim = next(c for c in result["claims"] if c["samples"] == 8)
    assert claim["as_claimed"].endswith("of 2") and claim["spread_of_seeds_px"] >= 0
    rules = result["runs"][0]["curve"]["8"]["rules_data_paper"]
    assert set(rules) == set(SELECTION_METHODS)
    load_weights(out / "pwvo-paper-seed0" / "weights.safetensors")
    trained = (out / "vonet-seed0" / "log.jsonl").read_text()
    assert tool.main([*words, "--seeds", "0", "1"]) == 0
    assert (out / "vonet-seed0" / "log.jsonl").read_text() == trained
    assert tool.main([*words, "--rows", "vonnet"]) == 2
