"""The refinement as a layer in a training loop: the flow is bent where a channel is high."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

import hybridvo as hvo
from hybridvo_lab.synthetic.training_scenes import DiverseOptions

SIZE = (48, 96)  # px
BEND_PX = 2.0  # standard deviation of the flow's error where the channel is 1
NAMES = ("flow", "depth_prev", "K_prev", "K_curr")


def draw(count: int, seed: int) -> tuple[hvo.PairBatch, torch.Tensor, torch.Tensor]:
    """Pairs, their channel (B, 1, H, W), and the true motions (B, 4, 4)."""
    rng = np.random.default_rng(seed)
    samples = [DiverseOptions(*SIZE).sample(rng) for _ in range(count)]
    rows = [(s.flow, s.depth_prev, s.K, s.T_curr_prev) for s in samples]
    columns = map(np.stack, zip(*rows, strict=True))
    flow, depth, K, truth = map(torch.tensor, columns)
    noise = torch.Generator().manual_seed(seed)
    coarse = torch.rand(count, 1, 4, 8, generator=noise)
    channel = nn.functional.interpolate(coarse, SIZE, mode="bicubic").clamp(0, 1)
    bend = BEND_PX * torch.randn(count, 1, 1, 2, generator=noise)
    flow = flow + bend * channel[:, 0, :, :, None] ** 2
    return hvo.PairBatch(flow, depth, K_prev=K, K_curr=K), channel, truth


def error(T: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    return (T.float() - truth).flatten(1).norm(dim=1)


def learn(updates: int = 60, pairs: int = 64) -> tuple[float, float]:
    """Median errors without weights and with learned ones, on new pairs."""
    torch.manual_seed(0)
    batch, channel, truth = draw(pairs, seed=0)
    start = hvo.refine(batch).T_curr_prev.detach()
    layers = nn.Conv2d(1, 8, 1), nn.ELU(), nn.Conv2d(8, 1, 1), nn.Sigmoid()
    network = nn.Sequential(*layers, nn.Threshold(1e-3, 1e-3), nn.Flatten(0, 1))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.02)
    for _ in range(updates):
        some = torch.randint(pairs, (8,))
        part = hvo.PairBatch(**{name: getattr(batch, name)[some] for name in NAMES})
        motion = hvo.refine(part, start[some], network(channel[some]))
        optimizer.zero_grad()
        (error(motion.T_curr_prev, truth[some]) + 1e-4).log().mean().backward()
        optimizer.step()
    batch, channel, truth = draw(32, seed=1)
    with torch.no_grad():
        plain = hvo.refine(batch).T_curr_prev
        learned = hvo.refine(batch, plain, network(channel)).T_curr_prev
    return tuple(error(T, truth).median().item() for T in (plain, learned))


if __name__ == "__main__":
    print("median error, no weights: {:.5f}, learned: {:.5f}".format(*learn()))
