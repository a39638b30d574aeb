"""The paper's networks: shapes, bad inputs, gradients, pairs that stay apart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import PairBatch
from hybridvo.network.selection import INVALID_LOG_SCALE
from hybridvo_lab.paper.inputs import NetworkInputs, assemble_inputs
from hybridvo_lab.paper.layers import SelfAttention
from hybridvo_lab.paper.networks import NetworkOptions, build_network

TINY = NetworkOptions(width=0.125)


def make_inputs(
    batch: int = 2, height: int = 64, width: int = 96, seed: int = 0
) -> NetworkInputs:
    generator = torch.Generator().manual_seed(seed)
    K = torch.tensor(
        [[80.0, 0, width / 2 - 0.5], [0, 80.0, height / 2 - 0.5], [0, 0, 1]]
    )
    flow = 5 * torch.randn(batch, height, width, 2, generator=generator)
    depths = 1 + 5 * torch.rand(2, batch, height, width, generator=generator)
    K = K.repeat(batch, 1, 1)
    return assemble_inputs(
        PairBatch(flow, depths[0], K, K, depths[1]), None, is_aligned=True
    )


def make_network(options: NetworkOptions = TINY, seed: int = 0) -> torch.nn.Module:
    torch.manual_seed(seed)
    return build_network(options).eval()


def maps(prediction: PixelwisePrediction) -> dict[str, torch.Tensor]:
    return {
        name: x
        for name, x in vars(prediction).items()
        if isinstance(x, torch.Tensor)
    }


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


@pytest.mark.parametrize(
    ("options", "parameters"),
    [
        (NetworkOptions(), 17_181_276),
        (NetworkOptions(uncertainty=False), 17_170_294),
        (NetworkOptions(decoders=2), 17_181_276 + 2_422_016),
        (NetworkOptions(width=0.5), 4_300_364),
        (NetworkOptions(kind="vonet"), 15_270_294),
        (NetworkOptions(kind="vonet-attention"), 15_352_535),
    ],
)
def test_parameter_totals(options, parameters):
    assert count(build_network(options)) == parameters


@pytest.mark.parametrize("size", [(64, 96), (128, 256), (32, 32), (50, 71)])
@pytest.mark.parametrize("stride", [1, 2])
def test_any_size_gives_maps_of_that_size(size, stride):
    network = make_network(NetworkOptions(width=0.125, head_stride=stride))
    with torch.inference_mode():
        prediction = network(make_inputs(1, *size))
    expected = (1, 6, -(-size[0] // stride), -(-size[1] // stride))
    for value in maps(prediction).values():
        assert value.shape == expected
        assert torch.isfinite(value).all()


def test_a_nan_pair_changes_no_neighbour_and_is_uncertain():
    network = make_network()
    inputs = make_inputs(2)
    broken = replace(
        inputs,
        flow=inputs.flow.clone().index_fill_(0, torch.tensor([1]), torch.nan),
        inverse_depth=inputs.inverse_depth.clone().index_fill_(
            0, torch.tensor([1]), torch.inf
        ),
        valid=inputs.valid & torch.tensor([True, False])[:, None, None],
    )
    with torch.inference_mode():
        good, bad = network(inputs), network(broken)
    for name, value in maps(bad).items():
        torch.testing.assert_close(
            value[0], getattr(good, name)[0], atol=5e-6, rtol=0
        )
        assert torch.isfinite(value).all()
    assert (bad.log_scale[1] >= INVALID_LOG_SCALE).all()
    assert (bad.log_scale[0] < INVALID_LOG_SCALE).any()


@pytest.mark.parametrize("stride", [1, 2])
def test_invalid_pixels_alone_are_raised(stride):
    network = make_network(NetworkOptions(width=0.125, head_stride=stride))
    inputs = make_inputs(1)
    valid = torch.ones_like(inputs.valid)
    valid[:, 10:20, 30:50] = False
    with torch.inference_mode():
        s = network(replace(inputs, valid=valid)).log_scale
        free = network(inputs).log_scale
    hole = torch.zeros(s.shape[2:], dtype=torch.bool)
    hole[10 // stride : 20 // stride, 30 // stride : 50 // stride] = True
    assert (s[:, :, hole] >= INVALID_LOG_SCALE).all()
    torch.testing.assert_close(s[:, :, ~hole], free[:, :, ~hole])


@pytest.mark.parametrize("magnitude", [1e3, 1e20, 3e38, torch.inf])
def test_extreme_inputs_give_finite_outputs(magnitude):
    network = make_network()
    inputs = make_inputs(1)
    extreme = replace(
        inputs,
        flow=torch.full_like(inputs.flow, magnitude),
        inverse_depth=torch.full_like(inputs.flow, -magnitude),
        rays=torch.full_like(inputs.flow, magnitude),
    )
    with torch.inference_mode():
        for value in maps(network(extreme)).values():
            assert torch.isfinite(value).all()


def test_gradients_reach_every_parameter():
    network = make_network(NetworkOptions(width=0.125, decoders=2))
    prediction = network(make_inputs(1))
    sum(v.square().sum() for v in maps(prediction).values()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name


def test_attention_starts_as_the_identity_and_matches_a_loop():
    torch.manual_seed(0)
    attention = SelfAttention(16)
    x = torch.randn(2, 16, 2, 3)
    assert torch.equal(attention(x), x)
    with torch.no_grad():
        attention.gain.fill_(0.7)
        query, key, value = (
            f(x).flatten(2)
            for f in (attention.query, attention.key, attention.value)
        )
        expected = x.flatten(2).clone()
        for b in range(2):
            for i in range(6):
                scores = torch.stack(
                    [query[b, :, i] @ key[b, :, j] for j in range(6)]
                )
                weights = torch.exp(scores) / torch.exp(scores).sum()
                for j in range(6):
                    expected[b, :, i] += 0.7 * weights[j] * value[b, :, j]
        torch.testing.assert_close(
            attention(x).flatten(2), expected, atol=1e-5, rtol=1e-5
        )
