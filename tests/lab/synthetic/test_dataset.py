"""Samples on disk: what is read is what was drawn; the command and its contact sheet."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hybridvo.core.errors import FormatError, InputError
from hybridvo_lab.synthetic import dataset
from hybridvo_lab.synthetic.draws import STORED, sample_generator
from hybridvo_lab.synthetic.paper_samples import PaperOptions
from hybridvo_lab.synthetic.training_scenes import DiverseOptions

SIZE = {"height": 32, "width": 64}


@pytest.mark.parametrize("preset", [PaperOptions(**SIZE), DiverseOptions(**SIZE)])
def test_what_is_read_is_what_was_drawn(tmp_path, preset):
    assert list(dataset.write_samples(preset, 4, tmp_path, seed=2)) == [1, 2, 3, 4]
    for index in range(4):
        read = dataset.read_sample(tmp_path, index)
        drawn = preset.sample(sample_generator(2, index, STORED))
        for field in dataclasses.fields(drawn):
            np.testing.assert_array_equal(
                getattr(read, field.name), getattr(drawn, field.name)
            )


def test_an_interrupted_call_goes_on_and_other_samples_are_refused(tmp_path):
    preset = PaperOptions(**SIZE)
    list(dataset.write_samples(preset, 3, tmp_path))
    written = (tmp_path / "0000001.npz").stat().st_mtime_ns
    (tmp_path / "0000002.npz").unlink()
    assert list(dataset.write_samples(preset, 3, tmp_path)) == [1, 2, 3]
    assert (tmp_path / "0000002.npz").exists()
    assert (tmp_path / "0000001.npz").stat().st_mtime_ns == written
    for other in (
        (preset, 3, 1),
        (PaperOptions(height=64, width=64), 3, 0),
        (preset, 4, 0),
    ):
        with pytest.raises(InputError, match="other samples"):
            list(dataset.write_samples(*other[:2], tmp_path, seed=other[2]))


def test_damage_and_nonsense_are_named(tmp_path):
    list(dataset.write_samples(PaperOptions(**SIZE), 2, tmp_path / "a"))
    with pytest.raises(FormatError, match=r"0000002\.npz: damaged or absent"):
        dataset.read_sample(tmp_path / "a", 2)
    (tmp_path / "a" / "0000000.npz").write_bytes(b"damaged")
    with pytest.raises(FormatError, match="0000000"):
        dataset.read_sample(tmp_path / "a", 0)
    with pytest.raises(InputError, match="count"):
        list(dataset.write_samples(PaperOptions(**SIZE), 0, tmp_path / "b"))
