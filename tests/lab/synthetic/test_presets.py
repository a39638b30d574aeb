from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from hybridvo.core.errors import FormatError, InputError
from hybridvo_lab.synthetic.dataset import PRESETS, load_preset, read_yaml
from hybridvo_lab.synthetic.paper_samples import PaperOptions
from hybridvo_lab.synthetic.training_scenes import DiverseOptions

CONFIGS = Path(__file__).parents[3] / "configs"


def test_preset_files_equal_the_defaults():
    assert load_preset(CONFIGS / "data_paper.yaml") == PaperOptions()
    assert load_preset(CONFIGS / "data_diverse.yaml") == DiverseOptions()
    small = load_preset(CONFIGS / "data_paper.yaml", size=(64, 128))
    assert small == PaperOptions(height=64, width=128)


@pytest.mark.parametrize("name", ["paper", "diverse"])
def test_preset_files_name_every_option(name):
    mapping = read_yaml(CONFIGS / f"data_{name}.yaml")
    kind = PRESETS[mapping["preset"]]
    assert set(mapping) == {field.name for field in dataclasses.fields(kind)}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("preset: paper\nobject: 5", "object: unknown"),
        ("preset: paper\nheight: tall", "height.*'tall'"),
        ("preset: diverse\ndis_share: 2", "dis_share"),
        ("preset: small", "paper.*'small'"),
        ("objects: 5", "preset.*None"),
    ],
)
def test_mistakes_in_a_file_name_the_key(tmp_path, text, said):
    path = tmp_path / "data.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"data\.yaml.*{said}"):
        load_preset(path)


@pytest.mark.parametrize("content", [b"[1, 2]", b"a: [", b"\xff\xfe\x00"])
def test_a_file_that_is_no_mapping(tmp_path, content):
    path = tmp_path / "data.yaml"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=r"data\.yaml"):
        read_yaml(path)
    with pytest.raises(InputError, match="no such file"):
        read_yaml(tmp_path / "absent.yaml")


def test_a_file_extends_another(tmp_path):
    (tmp_path / "base.yaml").write_text("a: 1\nb: {c: 2, d: 3}\n")
    (tmp_path / "row.yaml").write_text("extends: base.yaml\nb: {d: 4}\n")
    assert read_yaml(tmp_path / "row.yaml") == {"a": 1, "b": {"c": 2, "d": 4}}
