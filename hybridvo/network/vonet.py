"""VONet and VONet with self-attention: the paper's baselines that predict one pose per pair."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from hybridvo.network.inputs import NetworkInputs
from hybridvo.network.layers import Encoder, InputBranches, SelfAttention, initialize

__all__ = ["OUTPUT_SCALE", "VONet"]

OUTPUT_SCALE = 0.01
"""Raw head outputs are multiplied by this to give degrees and metres."""

FEATURE_GRID = (2, 4)
"""Grid on which the fully connected heads read the embedding: that of a 128x256 input."""


class _PoseHead(nn.Sequential):
    """Fully connected 128-32-3."""

    def __init__(self, features: int) -> None:
        super().__init__(
            nn.Linear(features, 128), nn.ELU(), nn.Linear(128, 32), nn.ELU(), nn.Linear(32, 3)
        )


class VONet(nn.Module):
    """PWVO's encoder with two fully connected heads (the paper's VONet baseline).

    Inputs of another size than 128x256 are averaged to the same 2x4 grid of features before the
    heads, so that one set of weights serves every size.

    Args:
        width: factor on all channel counts of the encoder.
        attention: self-attention on the embedding (the paper's "VONet + self-att.").
        flow_gain: factor on the normalised flow.
    """

    def __init__(self, width: float = 1.0, attention: bool = False, flow_gain: float = 1.0) -> None:
        super().__init__()
        self.branches = InputBranches(flow_gain)
        self.encoder = Encoder(InputBranches.out_channels, width, inner_activation=False)
        channels = self.encoder.channels[-1]
        self.attention = SelfAttention(channels) if attention else nn.Identity()
        features = channels * FEATURE_GRID[0] * FEATURE_GRID[1]
        self.head_rotation = _PoseHead(features)
        self.head_translation = _PoseHead(features)
        initialize(self, uniform=(self.head_rotation, self.head_translation))

    def forward(self, inputs: NetworkInputs) -> tuple[torch.Tensor, torch.Tensor]:
        """Pose of each pair.

        Args:
            inputs: of size (h, w), each at least 1.

        Returns:
            (B, 3) Euler angles X-Y-Z in degrees (R = Rx Ry Rz) and (B, 3) translation in metres, of
            T_curr_prev, both float32 (float64 for a float64 network). Finite for any input.
        """
        embedding = self.attention(self.encoder(self.branches(inputs))[-1])
        if embedding.shape[2:] != FEATURE_GRID:
            embedding = F.adaptive_avg_pool2d(embedding, FEATURE_GRID)
        features = embedding.flatten(1)
        rotation, translation = self.head_rotation(features), self.head_translation(features)
        dtype = next(self.parameters()).dtype
        return OUTPUT_SCALE * rotation.to(dtype), OUTPUT_SCALE * translation.to(dtype)
