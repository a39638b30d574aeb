from __future__ import annotations

import itertools

import pytest
import torch

from hybridvo_lab.synthetic.draws import (
    HELD_OUT,
    STORED,
    TRAINING,
    sample_generator,
)
from hybridvo_lab.training.paper_task import sample_stream


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
