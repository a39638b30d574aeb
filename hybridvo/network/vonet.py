"""VONet and VONet with self-attention: the paper's baselines that predict one pose per pair."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn

from hybridvo.network.inputs import NetworkInputs
from hybridvo.network.layers import Encoder, InputBranches, SelfAttention, initialize
from hybridvo.network.normalization import normalize
from hybridvo.network.options import NetworkOptions


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
        options: kind ``vonet`` or ``vonet-attention`` (the paper's "VONet + self-att.").
    """

    grid = (2, 4)  # of the embedding of a 128x256 input

    def __init__(self, options: NetworkOptions | None = None) -> None:
        super().__init__()
        options = NetworkOptions(kind="vonet") if options is None else options
        self.options = options
        self.branches = InputBranches()
        self.encoder = Encoder(InputBranches.out_channels, options.width, inner_activation=False)
        channels = self.encoder.channels[-1]
        self.attention = (
            SelfAttention(channels) if options.kind == "vonet-attention" else nn.Identity()
        )
        features = channels * math.prod(self.grid)
        self.head_rotation = _PoseHead(features)
        self.head_translation = _PoseHead(features)
        initialize(self, uniform=(self.head_rotation, self.head_translation))

    def forward(
        self, inputs: NetworkInputs, T_start: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Pose of each pair.

        Args:
            inputs: of size (h, w), each at least 1.
            T_start: (B, 4, 4) a first motion, for scale-free networks.

        Returns:
            (B, 3) Euler angles X-Y-Z in degrees (R = Rx Ry Rz) and (B, 3) translation in metres, of
            T_curr_prev, both float32 (float64 for a float64 network). Finite for any input.
        """
        inputs, scale = normalize(inputs, self.options, T_start)
        embedding = self.attention(self.encoder(self.branches(inputs))[-1])
        if embedding.shape[2:] != self.grid:
            embedding = F.adaptive_avg_pool2d(embedding, self.grid)
        features = embedding.flatten(1)
        raw = torch.cat([self.head_rotation(features), self.head_translation(features)], dim=1)
        motion = scale.motion(raw.to(next(self.parameters()).dtype))
        return motion[:, :3], motion[:, 3:]
