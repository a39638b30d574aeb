"""Which motion is the camera's: score and static mask, learned through the refinement of all."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

import hybridvo as hvo
from hybridvo.core.geometry import invert, pose_matrix
from hybridvo.hypotheses.generate import generate
from hybridvo.lab.synthetic.scenes import make_scene

KINDS = ("light", "heavy_rigid")  # most pixels are static, or most move
RIVALS = 3  # motions of a pair, NaN where it has fewer


def draw(seeds: range) -> tuple[hvo.PairBatch, np.ndarray, torch.Tensor, list]:
    """Pairs with moving objects, their motions, what a network sees of each, the right one."""
    pairs = []
    right = []
    motions = np.full((len(seeds), RIVALS, 4, 4), np.nan)
    for seed, T in zip(seeds, motions, strict=True):
        scene = make_scene(KINDS[seed % 2], seed, height=48, width=64, frames=2)
        frames = [hvo.Frame(None, scene.depth(k), scene.camera) for k in range(2)]
        pairs.append(hvo.FramePair(*frames, scene.flow(0)[0]))
        found = generate(pairs[-1], np.eye(4)[None], hvo.Options()).motions[:RIVALS]
        T[: len(found)] = [pose_matrix(each.pose) for each in found]
        truth = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
        right.append(np.nanargmin(np.abs(T - truth).sum(axis=(1, 2))))
    batch = hvo.PairBatch.from_pairs(pairs)
    follows = hvo.refine_rivals(batch, motions).motions.weights
    far = batch.depth_prev.clamp(min=1).log().repeat_interleave(RIVALS, dim=0)
    seen = torch.stack([follows, follows * far], dim=1)
    return batch, motions, seen, right


def learn(updates: int = 40) -> tuple[float, float]:
    """Mean loss of the first four updates and of the last four."""
    torch.manual_seed(0)
    batches = [draw(range(8 * k, 8 * k + 8)) for k in range(2)]
    layers = nn.Conv2d(2, 16, 5, 4, 2), nn.ELU(), nn.Conv2d(16, 2, 3, 1, 1)
    network = nn.Sequential(*layers, nn.Upsample(scale_factor=4, mode="bilinear"))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.03)
    losses = []
    for batch, T, seen, right in updates // len(batches) * batches:
        static, score = network(seen).unflatten(0, (-1, RIVALS)).unbind(dim=2)
        rivals = hvo.refine_rivals(batch, T, torch.sigmoid(static))
        log_p = rivals.log_probability(score.mean((2, 3)), cost_weight=5.0)
        loss = nn.functional.nll_loss(log_p, torch.tensor(right))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return float(np.mean(losses[:4])), float(np.mean(losses[-4:]))


if __name__ == "__main__":
    print("loss of the choice, before: {:.3f}, after: {:.3f}".format(*learn()))
