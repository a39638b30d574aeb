from __future__ import annotations

import pytest
import torch

from hybridvo.network.inputs import NetworkInputs, assemble_aligned
from hybridvo.network.layers import SelfAttention
from hybridvo.network.pwvo import NetworkOptions, build_network
from hybridvo.network.vonet import VONet


def make_inputs(batch: int, height: int, width: int) -> NetworkInputs:
    generator = torch.Generator().manual_seed(1)
    K = torch.tensor([[80.0, 0, width / 2], [0, 80.0, height / 2], [0, 0, 1]]).repeat(batch, 1, 1)
    return assemble_aligned(
        5 * torch.randn(batch, height, width, 2, generator=generator),
        1 + torch.rand(batch, height, width, generator=generator),
        1 + torch.rand(batch, height, width, generator=generator),
        K,
    )


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameter_totals():
    with torch.device("meta"):
        plain = build_network(NetworkOptions(kind="vonet"))
        attention = build_network(NetworkOptions(kind="vonet-attention"))
    assert count(plain) == 15_270_294
    assert count(attention) == 15_352_535
    assert count(attention.attention) == 82_241
    assert count(plain.head_rotation) == 266_499
    assert count(plain.encoder) == 14_737_248


@pytest.mark.parametrize("size", [(64, 96), (128, 256), (50, 71)])
@pytest.mark.parametrize("attention", [False, True])
def test_any_size(size, attention):
    torch.manual_seed(0)
    network = VONet(
        NetworkOptions(kind="vonet-attention" if attention else "vonet", width=0.125)
    ).eval()
    inputs = make_inputs(2, *size)
    with torch.inference_mode():
        together = network(inputs)
        alone = network(inputs[1:])
    for a, b in zip(together, alone, strict=True):
        assert a.shape == (2, 3)
        assert a.dtype == torch.float32
        torch.testing.assert_close(a[1], b[0], atol=1e-6, rtol=0)


def test_pooling_is_the_identity_at_the_papers_size():
    torch.manual_seed(0)
    network = VONet(NetworkOptions(kind="vonet", width=0.125)).eval()
    inputs = make_inputs(1, 128, 256)
    with torch.inference_mode():
        embedding = network.encoder(network.branches(inputs))[-1]
        expected = 0.01 * network.head_rotation(embedding.flatten(1))
        torch.testing.assert_close(network(inputs)[0], expected)


def test_attention_starts_as_the_identity_and_matches_a_loop():
    torch.manual_seed(0)
    attention = SelfAttention(16)
    x = torch.randn(2, 16, 2, 3)
    assert torch.equal(attention(x), x)
    with torch.no_grad():
        attention.gain.fill_(0.7)
        query, key, value = (
            f(x).flatten(2) for f in (attention.query, attention.key, attention.value)
        )
        expected = x.flatten(2).clone()
        for b in range(2):
            for i in range(6):
                scores = torch.stack([query[b, :, i] @ key[b, :, j] for j in range(6)])
                weights = torch.exp(scores) / torch.exp(scores).sum()
                for j in range(6):
                    expected[b, :, i] += 0.7 * weights[j] * value[b, :, j]
        torch.testing.assert_close(attention(x).flatten(2), expected, atol=1e-5, rtol=1e-5)


def test_gradients_are_finite_and_autocast_returns_float32():
    torch.manual_seed(0)
    network = VONet(NetworkOptions(kind="vonet-attention", width=0.125))
    inputs = make_inputs(1, 64, 96)
    with torch.autocast("cpu", torch.bfloat16):
        rotation, translation = network(inputs)
    assert rotation.dtype == translation.dtype == torch.float32
    (rotation.sum() + translation.sum()).backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())
