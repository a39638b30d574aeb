"""The scales of a depth network's frames, learned from flow through a window of frames.

Flow to the next frame and to the one after it agree on one path only where all scales are right.
"""

from __future__ import annotations

import numpy as np
import torch

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, invert
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.windows.window import refine_window

FRAMES = 4
EDGES = [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]


def pairs_of_a_scene(log_scale: np.ndarray) -> hvo.PairBatch:
    """The edges of a rendered scene, whose depth is off by exp(log_scale) (FRAMES,)."""
    scene = make_scene("static", 0, height=48, width=64, frames=FRAMES)
    pairs = []
    for prev, curr in EDGES:
        T = invert(scene.T_world_cam[curr]) @ scene.T_world_cam[prev]
        depth = scene.depth(prev)
        flow = ego_flow(depth, T, scene.camera, scene.camera)
        frame = hvo.Frame(None, depth * np.exp(log_scale[prev]), scene.camera)
        pairs.append(
            hvo.FramePair(frame, hvo.Frame(None, None, scene.camera), flow)
        )
    return hvo.PairBatch.from_pairs(pairs)


def learn(updates: int = 40) -> tuple[float, float]:
    """Largest relative error of the scales before and after; the last frame's has no flow."""
    wrong = np.random.default_rng(0).normal(0, 0.1, FRAMES)
    batch = pairs_of_a_scene(wrong)
    correction = torch.zeros(FRAMES, requires_grad=True)
    optimizer = torch.optim.Adam([correction], lr=0.02)
    prev, curr = torch.tensor(EDGES).T
    for _ in range(updates):
        depth = batch.depth_prev * correction[prev].exp()[:, None, None]
        scaled = hvo.PairBatch(batch.flow, depth, batch.K_prev, batch.K_curr)
        window = refine_window(scaled, EDGES, noise=(0.1, 0.0))
        T = window.T_frame_first
        joint = T[curr] @ torch.linalg.inv(T[prev])
        apart = (window.edges.T_curr_prev - joint)[:, :3, 3].norm(dim=1)
        optimizer.zero_grad()
        apart.mean().backward()
        optimizer.step()
    left = wrong + correction.detach().numpy()
    errors = [np.expm1(each - each[0])[:-1] for each in (wrong, left)]
    return tuple(float(np.abs(error).max()) for error in errors)


if __name__ == "__main__":
    print("largest error, before: {:.3f}, after: {:.3f}".format(*learn()))
