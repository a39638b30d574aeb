"""Track with a flow network of one's own: a function of two frames.

    python examples/own_flow.py

The network here has no weights: it compares patches over all shifts up to RADIUS. Put
yours, such as RAFT, in its place.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

import hybridvo as hvo
from hybridvo_lab.synthetic.scenes import make_scene

RADIUS = 8  # px, the longest flow that is found
PATCH = 7  # px, side of the patches that are compared
SHARPNESS = 2.0  # of the softmax over the shifts


class PatchFlow(nn.Module):
    """Two images (1, 3, H, W) -> flow (H, W, 2) in px, and its variance (H, W)."""

    def forward(self, prev: torch.Tensor, curr: torch.Tensor) -> tuple:
        steps = torch.arange(-RADIUS, RADIUS + 1.0)
        shifts = torch.cartesian_prod(steps, steps)  # (n, 2): u, v
        curr = F.pad(curr, [RADIUS] * 4, mode="replicate")
        height, width = prev.shape[2:]
        costs = []
        for u, v in (shifts + RADIUS).int().tolist():
            moved = curr[..., v : v + height, u : u + width]
            difference = (prev - moved).abs().mean(1, keepdim=True)
            costs.append(F.avg_pool2d(difference, PATCH, 1, PATCH // 2))
        weights = (-SHARPNESS * torch.cat(costs, 1)).softmax(1)
        flow = torch.einsum("bnhw,nc->hwc", weights, shifts)
        square = torch.einsum("bnhw,nc->hwc", weights, shifts**2)
        return flow, (square - flow**2).mean(2) + 0.05


@torch.inference_mode()
def my_flow(prev: hvo.Frame, curr: hvo.Frame) -> hvo.FlowField:
    """The flow from one frame to the next; a plain (H, W, 2) array does as well."""
    images = [torch.tensor(x.rgb).float().movedim(2, 0)[None] for x in (prev, curr)]
    flow, variance = PatchFlow()(*images)
    return hvo.FlowField(flow.numpy(), variance.numpy(), source="patches")


if __name__ == "__main__":
    scene = make_scene("light", 0, height=96, width=160, frames=4)
    tracker = hvo.Odometry(flow=my_flow)
    for index in range(scene.frames):
        step = tracker.track(scene.render(index))
        print(index, step.status, step.T_world_cam[:3, 3].round(3))
