"""Learn the weights of pixels, end to end through the refinement, in about a minute on a CPU.

    python docs/examples/learn_weights.py
    python docs/examples/learn_weights.py --updates 20 --pairs 16

The flow of these pairs is bent where a channel beside it is high, as an estimator's flow is where
its matching cost is; nothing reports it. A small convolutional network sees the channel, flow and
depth, and gives every pixel a weight. ``hybridvo.refine`` turns weights into a camera motion, and
the loss is the error of that motion's ego flow: no label states which pixels are bad or what moves.
The gradient comes back through the solution of the refinement, not through its iterations.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

import hybridvo as hvo
from hybridvo.synthetic.training_scenes import DiverseOptions
from hybridvo.torch_geometry import reproject

SIZE = (48, 96)  # px
BEND_PX = 2.0  # standard deviation of the flow's error where the channel is 1
BATCH = 8  # pairs an update


class WeightNetwork(nn.Module):
    """(B, 4, H, W) -> (B, H, W) weights in (0, 1)."""

    def __init__(self, channels: int = 16) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for first, dilation in ((4, 1), (channels, 2), (channels, 4)):
            layers += [
                nn.Conv2d(first, channels, 3, padding=dilation, dilation=dilation),
                nn.ELU(),
            ]
        self.layers = nn.Sequential(*layers, nn.Conv2d(channels, 1, 1))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Weights of the pixels."""
        return self.layers(features)[:, 0].sigmoid().clamp(min=1e-3)


def draw(count: int, seed: int) -> tuple[hvo.PairBatch, torch.Tensor, torch.Tensor]:
    """Pairs with moving objects, their channel (B, H, W), and the true motion (B, 4, 4)."""
    preset = DiverseOptions(height=SIZE[0], width=SIZE[1])
    rng, noise = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    samples = [preset.sample(rng) for _ in range(count)]

    def stack(name: str) -> torch.Tensor:
        return torch.from_numpy(
            np.stack([getattr(sample, name) for sample in samples])
        )

    coarse = torch.rand(count, 1, 4, 8, generator=noise)
    cost = F.interpolate(coarse, SIZE, mode="bicubic", align_corners=False)[
        :, 0
    ].clamp(0, 1)
    bend = (
        BEND_PX
        * torch.randn(count, 1, 1, 2, generator=noise)
        * cost[..., None] ** 2
    )
    K = stack("K")
    batch = hvo.PairBatch(
        stack("flow") + bend, stack("depth_prev"), K_prev=K, K_curr=K
    )
    return batch, cost, stack("T_curr_prev")


def landing(batch: hvo.PairBatch, T: torch.Tensor) -> torch.Tensor:
    """(B, H, W, 2) px: where a camera motion takes every pixel."""
    return reproject(batch.depth_prev, T, batch.K_prev, batch.K_curr)[0]


def features(
    batch: hvo.PairBatch, cost: torch.Tensor, T: torch.Tensor
) -> torch.Tensor:
    """(B, 4, H, W): the channel, inverse depth, what a motion T leaves over of the flow."""
    still = landing(batch, torch.eye(4).expand(len(T), 4, 4))
    left = batch.flow - (landing(batch, T) - still)
    depth = batch.depth_prev[..., None]
    near = torch.where(depth > 0, 1 / depth.clamp(min=0.1), 0.0)
    parts = torch.cat([cost[..., None], near, torch.tanh(left)], dim=3)
    return torch.nan_to_num(parts).movedim(3, 1)


def error(batch: hvo.PairBatch, T: torch.Tensor, gt: torch.Tensor) -> torch.Tensor:
    """(B,) mean end-point error of the ego flow in px, no more than 20 a pixel."""
    away = (
        (landing(batch, T.float()) - landing(batch, gt)).norm(dim=3).clamp(max=20.0)
    )
    known = batch.depth_prev > 0
    return torch.where(known, away, 0.0).sum((1, 2)) / known.sum((1, 2)).clamp(
        min=1
    )


def part(batch: hvo.PairBatch, index: torch.Tensor) -> hvo.PairBatch:
    """The pairs of an index."""
    names = ("flow", "depth_prev", "K_prev", "K_curr")
    return hvo.PairBatch(**{name: getattr(batch, name)[index] for name in names})


def main(argv: list[str] | None = None) -> int:
    """Learn, and print the error before and after on pairs that were not learned from."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--updates", type=int, default=60)
    parser.add_argument("--pairs", type=int, default=96, help="pairs to learn from")
    args = parser.parse_args(argv)
    torch.manual_seed(0)

    batch, cost, gt = draw(args.pairs, seed=0)
    test, test_cost, test_gt = draw(48, seed=1)
    with torch.no_grad():
        start, test_start = (
            hvo.refine(b).T_curr_prev.float() for b in (batch, test)
        )
    network = WeightNetwork()
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    before = error(test, test_start, test_gt).median()
    print(f"robust fit, no weights: median error {before:.3f} px")
    for update in range(args.updates):
        index = torch.randint(args.pairs, (BATCH,))
        pairs, T = part(batch, index), start[index]
        motion = hvo.refine(pairs, T, network(features(pairs, cost[index], T)))
        loss = torch.log1p(
            error(pairs, motion.T_curr_prev, gt[index]) / 0.05
        ).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        if update % 10 == 0:
            print(f"update {update}: loss {loss:.3f}", flush=True)
    with torch.no_grad():
        weights = network(features(test, test_cost, test_start))
        motion = hvo.refine(test, test_start, weights)
    after = error(test, motion.T_curr_prev, test_gt).median()
    print(f"learned weights: median error {after:.3f} px")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
