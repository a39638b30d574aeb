"""What PWVO and the VONet baselines share: options, blocks, the encoder, self-attention.

Stride-2 convolutions pad one pixel on every side; the published TensorFlow code pads bottom and
right only, which matters when weights are ported.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Literal, get_args

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import nn

from hybridvo.errors import InputError
from hybridvo.network.inputs import NetworkInputs
from hybridvo.network.threads import one_thread
from hybridvo.options import option_group

INPUT_LIMIT = 100.0  # 20 000 px of flow, 1 cm of depth: activations cannot overflow

Kind = Literal["pwvo", "vonet", "vonet-attention"]
KINDS = get_args(Kind)


@option_group
class NetworkOptions:
    """What decides the shapes of a network's weights, and how it is used."""

    kind: Kind = "pwvo"  # also of PWVO naive and the pixel-wise network
    width: Annotated[float, Field(gt=0, le=4)] = 1.0  # factor on all channel counts
    # shared by both heads (published code), or two (the paper's text)
    decoders: Literal[1, 2] = 1
    # predictions at the resolution of the input, or at half of it
    head_stride: Literal[1, 2] = 1
    uncertainty: bool = True
    # inputs without units, see hybridvo.network.prediction
    scale_free: bool = False
    # how often a scale-free network is used: each later pass looks at what the motion that the
    # trusted pixels of the one before agree on leaves unexplained
    passes: Annotated[int, Field(ge=1, le=8)] = 1
    # the network reads every n-th pixel of its inputs
    input_stride: Literal[1, 2, 4] = 1
    # of the lengths of the unexplained flow, scales the inputs of a later pass, as 0.4 in the first
    # one: after a good start what is left of the static scene is short
    later_quantile: Annotated[float, Field(gt=0, le=0.5)] = 0.4

    def __post_init__(self) -> None:
        if self.passes > 1 and not (
            self.scale_free and self.kind == "pwvo" and self.uncertainty
        ):
            raise InputError(
                "passes above 1 need scale_free=True, kind='pwvo' and uncertainty"
            )
        if self.decoders == 2 and not self.uncertainty:
            raise InputError(
                "the second decoder is the uncertainty's; without set decoders=1"
            )


def scaled(channels: int, width: float) -> int:
    """Number of channels at a width factor, at least one."""
    return max(1, round(channels * width))


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut and ELU.

    ``inner``: ELU before the sum (PWVO); ``project``: a 1x1 convolution even where shapes agree.
    """

    def __init__(
        self,
        before: int,
        after: int,
        stride: int,
        inner: bool,
        project: bool = False,
    ):
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride, 1)
        self.conv2 = nn.Conv2d(after, after, 3, 1, 1)
        self.inner = inner
        self.stride = stride
        project = project or stride != 1 or before != after
        self.shortcut = nn.Conv2d(before, after, 1) if project else nn.Identity()

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, before, h, w) -> (B, after, ceil(h / stride), ceil(w / stride))."""
        y = self.conv2(F.elu(self.conv1(x), inplace=True))
        if self.inner:
            y = F.elu(y, inplace=True)
        # not a 1x1 convolution of stride 2: oneDNN's gradient of it writes past its memory where
        # there are few channels in channels-last order
        return F.elu(
            y + self.shortcut(x[..., :: self.stride, :: self.stride]), inplace=True
        )


class InputBranches(nn.Module):
    """The three inputs side by side: flow as it is, depths and rays through a 1x1 convolution."""

    out_channels = 2 + 8 + 8

    def __init__(self) -> None:
        super().__init__()
        self.depth = nn.Conv2d(2, 8, 1)
        self.rays = nn.Conv2d(2, 8, 1)

    def forward(self, inputs: NetworkInputs) -> torch.Tensor:
        """Network inputs -> (B, 18, h, w)."""
        flow, depth, rays = (
            torch.nan_to_num(x, 0.0, 0.0, 0.0).clamp(-INPUT_LIMIT, INPUT_LIMIT)
            for x in (inputs.flow, inputs.inverse_depth, inputs.rays)
        )
        depth = F.elu(self.depth(depth))
        rays = F.elu(self.rays(rays))
        return torch.cat([flow.to(depth.dtype), depth, rays], dim=1)


class Encoder(nn.Module):
    """Stem of three convolutions and five stages of residual blocks, each halving the image."""

    def __init__(self, in_channels: int, width: float, inner: bool = True) -> None:
        super().__init__()
        stem = scaled(32, width)
        strides = ((in_channels, 2), (stem, 1), (stem, 1))
        self.stem = nn.ModuleList(
            nn.Conv2d(n, stem, 3, stride, 1) for n, stride in strides
        )
        self.channels = tuple(scaled(c, width) for c in (64, 128, 128, 256, 256))
        sizes = zip((3, 4, 6, 7, 3), pairwise((stem, *self.channels)), strict=True)
        for k, (count, (before, after)) in enumerate(sizes, start=1):
            blocks = [ResidualBlock(before, after, 2, inner)]
            blocks += [
                ResidualBlock(after, after, 1, inner) for _ in range(count - 1)
            ]
            self.add_module(f"layer{k}", nn.Sequential(*blocks))

    def forward(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Features of the stem, at half the resolution, to layer5, the paper's psi, at a 64th."""
        for convolution in self.stem:
            x = F.elu(convolution(x), inplace=True)
        features = [x]
        for k in range(len(self.channels)):
            features.append(getattr(self, f"layer{k + 1}")(features[-1]))
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
        """(B, C, h, w) -> the same."""
        query, key, value = (
            f(x).flatten(2) for f in (self.query, self.key, self.value)
        )
        attention = torch.softmax(query.transpose(1, 2) @ key, dim=-1)
        return x + self.gain * (value @ attention.transpose(1, 2)).view_as(x)


@contextlib.contextmanager
def single_threaded_inference() -> Iterator[None]:
    """Inference in float32 on one thread of the CPU; nothing outside of it is changed."""
    # entering a default device costs every operation some microseconds
    elsewhere = torch.get_default_device().type != "cpu"
    device = torch.device("cpu") if elsewhere else contextlib.nullcontext()
    with (
        one_thread(),
        torch.inference_mode(),
        torch.autocast("cpu", enabled=False),
        device,
    ):
        yield


def initialize(network: nn.Module) -> None:
    """Glorot-normal weights, uniform ones in the heads, by torch's global generator."""
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            is_head = name.startswith("head_")
            (nn.init.xavier_uniform_ if is_head else nn.init.xavier_normal_)(
                module.weight
            )
            assert module.bias is not None
            nn.init.zeros_(module.bias)
