"""The doors: trainings that are started again, cards that say what a run was trained with."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from hybridvo.core.errors import CheckpointError
from hybridvo.network.models import PWVO_KIND, load_weights
from hybridvo.run import cli
from hybridvo_lab.synthetic.dataset import read_yaml
from hybridvo_lab.training.options import load_paper_options, load_training_options
from hybridvo_lab.training.trainer import export_run

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
    naive = rows["pwvo-naive"]
    assert naive.loss.pose_uncertainty and not naive.loss.flow_uncertainty
    assert naive.selection == rows["pwvo-uncertain"].selection == "mean"
    for name, row in rows.items():
        if name in ("vonet", "pixelwise"):
            assert not row.loss.needs_uncertainty
        if name != "base":
            assert row.loss.flow == ("without" not in name)


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
    export = ["export", "--out", str(out), "--export", str(weights), "--count", "4"]
    assert train(export) == 0
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


def test_an_export_needs_a_run(tmp_path):
    with pytest.raises(CheckpointError, match="not a checkpoint"):
        export_run(tmp_path, tmp_path / "w.safetensors")
