"""VONet and VONet with self-attention: the paper's baselines that predict one pose per pair."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from hybridvo.network.inputs import NetworkInputs
from hybridvo.network.layers import Encoder, InputBranches, SelfAttention, initialize
from hybridvo.network.normalization import remove_scale
from hybridvo.network.options import NetworkOptions

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
        options: kind ``vonet`` or ``vonet-attention`` (the paper's "VONet + self-att.").
    """

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
        features = channels * FEATURE_GRID[0] * FEATURE_GRID[1]
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
        scale = None
        inputs = inputs.subsample(self.options.input_stride)
        if self.options.scale_free:
            inputs, scale = remove_scale(inputs, T_start, self.options.later_quantile)
        embedding = self.attention(self.encoder(self.branches(inputs))[-1])
        if embedding.shape[2:] != FEATURE_GRID:
            embedding = F.adaptive_avg_pool2d(embedding, FEATURE_GRID)
        features = embedding.flatten(1)
        rotation, translation = self.head_rotation(features), self.head_translation(features)
        dtype = next(self.parameters()).dtype
        if scale is None:
            return OUTPUT_SCALE * rotation.to(dtype), OUTPUT_SCALE * translation.to(dtype)
        factor, start = scale.factor.to(dtype), scale.start.to(dtype)
        return (
            start[:, :3] + factor[:, :3] * rotation.to(dtype),
            start[:, 3:] + factor[:, 3:] * translation.to(dtype),
        )
