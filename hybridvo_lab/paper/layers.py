"""What PWVO and the VONet baselines have in common: options, blocks, encoder, attention.

Stride-2 convolutions pad one pixel on every side. The published TensorFlow code pads
bottom and right only, which matters when its weights are converted.
"""

from __future__ import annotations

from typing import Annotated, Literal, get_args

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import nn

from hybridvo.core.errors import InputError
from hybridvo.core.options import option_group
from hybridvo.network.pwvo import scaled
from hybridvo_lab.paper.inputs import NetworkInputs

INPUT_LIMIT = 100.0
"""Limit of the inputs, so that activations cannot overflow: 20 000 px of flow, 1 cm."""
STEM_CHANNELS = 32
STAGE_CHANNELS = (64, 128, 128, 256, 256)
STAGE_BLOCKS = (3, 4, 6, 7, 3)
"""Channels of the encoder's five stages, and residual blocks in each."""

Kind = Literal["pwvo", "vonet", "vonet-attention"]
KINDS = get_args(Kind)


@option_group
class NetworkOptions:
    """Options that decide the shapes of a network's weights, and how it is used.

    Attributes:
        kind: the architecture; ``pwvo`` also for PWVO (naive) and the pixel-wise network.
        width: factor on all channel counts.
        decoders: one for both heads (published code), or two (the paper's text).
        head_stride: 1: predictions at the resolution of the input; 2: at half of it.
        uncertainty: whether the network predicts log scales.
        scale_free: whether its inputs have no units, see
            :mod:`hybridvo_lab.paper.normalization`.
        input_stride: the network reads every n-th pixel of its inputs.
    """

    kind: Kind = "pwvo"
    width: Annotated[float, Field(gt=0, le=4)] = 1.0
    decoders: Literal[1, 2] = 1
    head_stride: Literal[1, 2] = 1
    uncertainty: bool = True
    scale_free: bool = False
    input_stride: Literal[1, 2, 4] = 1

    def __post_init__(self) -> None:
        if self.decoders == 2 and not self.uncertainty:
            raise InputError(
                "the second decoder is the uncertainty's; without set decoders=1"
            )


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut and ELU.

    Args:
        before: channels of the input.
        after: channels of the output.
        stride: of the first convolution.
        has_inner_elu: whether there is an ELU before the sum (PWVO).
        project: whether the shortcut is a 1x1 convolution even where shapes agree.
    """

    def __init__(
        self,
        before: int,
        after: int,
        stride: int,
        has_inner_elu: bool,
        project: bool = False,
    ):
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride, 1)
        self.conv2 = nn.Conv2d(after, after, 3, 1, 1)
        self.has_inner_elu = has_inner_elu
        self.stride = stride
        project = project or stride != 1 or before != after
        self.shortcut = nn.Conv2d(before, after, 1) if project else nn.Identity()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, before, h, w) -> (B, after, ceil(h / stride), ceil(w / stride))."""
        y = self.conv2(F.elu(self.conv1(x), inplace=True))
        if self.has_inner_elu:
            y = F.elu(y, inplace=True)
        # not a 1x1 convolution of stride 2: oneDNN's gradient of it writes past its
        # memory where there are few channels in channels-last order
        shortcut = self.shortcut(x[..., :: self.stride, :: self.stride])
        return F.elu(y + shortcut, inplace=True)


class InputBranches(nn.Module):
    """The three inputs in one map: flow, and depths and rays through 1x1 convolutions."""

    out_channels = 2 + 8 + 8

    def __init__(self) -> None:
        super().__init__()
        self.depth = nn.Conv2d(2, 8, 1)
        self.rays = nn.Conv2d(2, 8, 1)

    def forward(self, inputs: NetworkInputs) -> torch.Tensor:
        """Network inputs -> (B, 18, h, w)."""
        depth = F.elu(self.depth(_limited(inputs.inverse_depth)))
        rays = F.elu(self.rays(_limited(inputs.rays)))
        flow = _limited(inputs.flow).to(depth.dtype)
        return torch.cat([flow, depth, rays], dim=1)


def _limited(x: torch.Tensor) -> torch.Tensor:
    finite = torch.nan_to_num(x, 0.0, 0.0, 0.0)
    return finite.clamp(-INPUT_LIMIT, INPUT_LIMIT)


class Encoder(nn.Module):
    """Stem of three convolutions, then five stages of residual blocks that halve the image.

    Args:
        in_channels: channels of the input.
        width: factor on all channel counts.
        has_inner_elu: of the residual blocks.
    """

    def __init__(
        self, in_channels: int, width: float, has_inner_elu: bool = True
    ) -> None:
        super().__init__()
        stem = scaled(STEM_CHANNELS, width)
        self.stem = nn.ModuleList(
            [
                nn.Conv2d(in_channels, stem, 3, 2, 1),
                nn.Conv2d(stem, stem, 3, 1, 1),
                nn.Conv2d(stem, stem, 3, 1, 1),
            ]
        )
        self.channels = tuple(scaled(c, width) for c in STAGE_CHANNELS)
        before = stem
        stages = zip(STAGE_BLOCKS, self.channels, strict=True)
        for number, (count, after) in enumerate(stages, start=1):
            blocks = [ResidualBlock(before, after, 2, has_inner_elu)]
            for _ in range(count - 1):
                blocks.append(ResidualBlock(after, after, 1, has_inner_elu))
            self.add_module(f"layer{number}", nn.Sequential(*blocks))
            before = after

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Features of the stem, at half the resolution, to layer5, the paper's psi, at a 64th."""
        for convolution in self.stem:
            x = F.elu(convolution(x), inplace=True)
        features = [x]
        for k in range(len(self.channels)):
            stage = getattr(self, f"layer{k + 1}")
            features.append(stage(features[-1]))
        return features


class SelfAttention(nn.Module):
    """Self-attention of the paper's "VONet + self-att.", with a gain that starts at zero."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = max(1, channels // 8)
        self.query = nn.Conv2d(channels, inner, 1)
        self.key = nn.Conv2d(channels, inner, 1)
        self.value = nn.Conv2d(channels, channels, 1)
        self.gain = nn.Parameter(torch.zeros(()))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, C, h, w) -> the same shape."""
        query = self.query(x).flatten(2)
        key = self.key(x).flatten(2)
        value = self.value(x).flatten(2)
        attention = torch.softmax(query.transpose(1, 2) @ key, dim=-1)
        attended = (value @ attention.transpose(1, 2)).view_as(x)
        return x + self.gain * attended


def initialize(network: nn.Module) -> None:
    """Draw Glorot-normal weights, uniform ones in the heads, by torch's global generator."""
    for name, module in network.named_modules():
        if not isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            continue
        if name.startswith("head_"):
            nn.init.xavier_uniform_(module.weight)
        else:
            nn.init.xavier_normal_(module.weight)
        assert module.bias is not None
        nn.init.zeros_(module.bias)
