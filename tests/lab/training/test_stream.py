from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from hybridvo.lab.synthetic.dataset import Mixture, StoredSamples, write_samples
from hybridvo.lab.synthetic.draws import (
    HELD_OUT,
    STORED,
    TRAINING,
    sample_generator,
)
from hybridvo.lab.synthetic.paper_samples import PaperOptions
from hybridvo.lab.training.paper_task import sample_stream
from hybridvo.lab.training.validation import collate


def flows(loader, count: int) -> list[torch.Tensor]:
    return [batch.inputs.flow for batch in itertools.islice(loader, count)]


# where there is one core
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_workers_change_nothing(mixture):
    one, two = (sample_stream(mixture, 1, 8, 2, workers) for workers in (0, 2))
    for a, b in zip(flows(one, 4), flows(two, 4), strict=True):
        assert torch.equal(a, b)


def test_a_stream_goes_on_at_an_index(mixture):
    one = flows(sample_stream(mixture, 1, 0, 4), 2)
    assert torch.equal(flows(sample_stream(mixture, 1, 4, 4), 1)[0], one[1])


def test_no_training_seed_draws_a_held_out_sample():
    drawn = [
        {
            tuple(sample_generator(seed, i, use).integers(0, 2**62, 2))
            for seed, i in itertools.product(range(3), range(9))
        }
        for use in (HELD_OUT, TRAINING, STORED)
    ]
    assert len(set.union(*drawn)) == 3 * 27


def test_mixture_keeps_its_shares():
    class Mark:
        def __init__(self, name):
            self.name = name

        def sample(self, rng):
            return self.name

    mixed = Mixture((Mark("a"), Mark("b"), Mark("c")), (1.0, 0.0, 3.0))
    drawn = [mixed.sample(sample_generator(0, i)) for i in range(2000)]
    # four standard errors of a share of a quarter
    assert drawn.count("a") / 2000 == pytest.approx(0.25, abs=0.04)
    assert "b" not in drawn


def test_stored_samples_are_one_stream_for_every_training(tmp_path):
    list(write_samples(PaperOptions(height=32, width=64), 5, tmp_path))
    data = Mixture((StoredSamples(str(tmp_path)),), (1.0,))
    first, again = (flows(sample_stream(data, 3, 0, 4), 2) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert data.presets[0].for_evaluation() == PaperOptions(height=32, width=64)


def test_a_batch_holds_its_samples(mixture):
    samples = [mixture.sample(sample_generator(0, i)) for i in range(3)]
    batch = collate(samples)
    assert len(batch) == 3
    np.testing.assert_allclose(
        batch.targets.motion[1, :3], samples[1].rotation_deg, atol=1e-6
    )
    np.testing.assert_array_equal(batch.moving[2], samples[2].moving)
