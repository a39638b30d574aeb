"""The paper's networks: PWVO, a pose and its uncertainty at every pixel, and the VONet baselines.

PWVO is that of the published code, layer by layer: one shared U-Net decoder with two heads of two
convolutions. ``decoders=2`` builds the two of the paper's text.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import nn

from hybridvo.checks import check_kind
from hybridvo.errors import CheckpointError
from hybridvo.network import layers
from hybridvo.network.inputs import NetworkInputs, assemble_inputs
from hybridvo.network.layers import (
    InputBranches,
    NetworkOptions,
    initialize,
    scaled,
)
from hybridvo.network.prediction import normalize, predict
from hybridvo.network.weights import read_network
from hybridvo.results import PixelwisePrediction
from hybridvo.types import FramePair, PairBatch

# least where flow or depth is missing: U = 20 degrees or 20 m
INVALID_LOG_SCALE = 3.0


class _UpStage(nn.Module):
    """Transposed 2x2 convolution, the encoder's feature of that size beside it, residual block."""

    def __init__(
        self, in_channels: int, up: int, skip: int, out: int, project: bool = False
    ):
        super().__init__()
        self.up = nn.ConvTranspose2d(in_channels, up, 2, 2)
        self.skip = skip
        self.block = layers.ResidualBlock(up + skip, out, 1, True, project)

    def forward(self, x: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
        # upsampling gives a row or column too many where the encoder met an odd size
        x = self.up(x)[:, :, : like.shape[2], : like.shape[3]]
        return self.block(
            torch.cat([x, like.to(x.dtype)], dim=1) if self.skip else x
        )


class Decoder(nn.Module):
    """U-Net decoder from the embedding to the heads' resolution; stride 2 leaves out a stage."""

    def __init__(
        self, channels: tuple[int, ...], width: float, head_stride: int
    ) -> None:
        super().__init__()
        c32, c64, c128 = (scaled(c, width) for c in (32, 64, 128))
        layer1, layer2, layer3, layer4, layer5 = channels
        self.up5 = _UpStage(layer5, layer4, layer4, c128)
        self.up4 = _UpStage(c128, c128, layer3, c128)
        self.up3 = _UpStage(c128, c128, layer2, c128)
        self.up2 = _UpStage(c128, c64, layer1, c64)
        # The shortcut of up1 is a 1x1 convolution although the shapes agree: as published.
        self.up1 = _UpStage(c64, c64, 0, c64, project=True)
        self.up0 = _UpStage(c64, c32, 0, c32) if head_stride == 1 else None
        self.out = nn.Conv2d(c32 if head_stride == 1 else c64, c32, 1)

    def forward(
        self, inputs: torch.Tensor, features: list[torch.Tensor]
    ) -> torch.Tensor:
        """Inputs (B, 18, h, w) and the encoder's features -> (B, 32, h / stride, w / stride)."""
        *skips, x = features
        stages = self.up5, self.up4, self.up3, self.up2, self.up1
        for stage, skip in zip(stages, reversed(skips), strict=True):
            x = stage(x, skip)
        return self.out(x if self.up0 is None else self.up0(x, inputs))


def _map_head(channels: int) -> nn.Sequential:
    """Two 3x3 convolutions to six channels: rx, ry, rz, tx, ty, tz."""
    first = nn.Conv2d(channels, channels, 3, 1, 1)
    last = nn.Conv2d(channels, 6, 3, 1, 1)
    return nn.Sequential(first, nn.ELU(inplace=True), last)


class PWVO(nn.Module):
    """Pixel-wise prediction of the camera motion with uncertainty (paper, section 3.2)."""

    def __init__(self, options: NetworkOptions | None = None) -> None:
        super().__init__()
        check_kind("PWVO.options", options, NetworkOptions, type(None))
        self.options = options = options or NetworkOptions()
        width = options.width
        stride = options.head_stride
        self.branches = InputBranches()
        self.encoder = layers.Encoder(InputBranches.out_channels, width)
        shape = self.encoder.channels, width, stride
        self.decoder = Decoder(*shape)
        self.decoder_uncertainty = (
            Decoder(*shape) if options.decoders == 2 else None
        )
        channels = scaled(32, width)
        self.head_motion = _map_head(channels)
        self.head_uncertainty = _map_head(channels) if options.uncertainty else None
        initialize(self)

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path = "pwvo") -> PWVO:
        """A network in evaluation mode on the CPU, by the name or file of its weights."""
        network, _ = read_network(
            name_or_path, lambda o: build_network(NetworkOptions(**o))
        )
        if not isinstance(network, cls):
            raise CheckpointError(
                f"{name_or_path}: expected the weights of a PWVO, got another's."
            )
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    if TYPE_CHECKING:  # torch says Any

        def __call__(
            self,
            inputs: NetworkInputs | FramePair | PairBatch,
            T_start: torch.Tensor | None = None,
        ) -> PixelwisePrediction:
            """See ``forward``."""

    def forward(
        self,
        inputs: NetworkInputs | FramePair | PairBatch,
        T_start: torch.Tensor | None = None,
    ) -> PixelwisePrediction:
        """Pose and log scale at every pixel: of assembled inputs in one pass, of pairs in all.

        ``T_start`` (B, 4, 4): a first motion; a scale-free network looks at what it leaves. Maps of
        (ceil(h / n), ceil(w / n)), n = input_stride * head_stride; finite for any input.
        """
        options = self.options
        own = next(self.parameters())
        if not isinstance(inputs, NetworkInputs):
            batch = (
                PairBatch.from_pairs([inputs])
                if isinstance(inputs, FramePair)
                else inputs
            )
            output = predict(
                self, assemble_inputs(batch).to(device=own.device, dtype=own.dtype)
            )
            height, width = batch.flow.shape[1:3]
            return replace(output, image_size=(height, width))
        inputs, scale = normalize(inputs, options, T_start)
        x = self.branches(inputs)
        features = self.encoder(x)
        shared = self.decoder(x, features)
        motion = scale.motion(self.head_motion(shared).to(own.dtype))
        if self.head_uncertainty is None:
            return PixelwisePrediction(motion)
        if self.decoder_uncertainty is not None:
            shared = self.decoder_uncertainty(x, features)
        log_scale = self.head_uncertainty(shared).to(own.dtype)
        if options.scale_free:
            log_scale = (
                log_scale + scale.factor.to(own.dtype).log()[:, :, None, None]
            )
        seen = inputs.valid[:, None].to(own.dtype)
        seen = F.max_pool2d(seen, options.head_stride, ceil_mode=True)
        log_scale = torch.where(
            seen > 0, log_scale, log_scale.clamp(min=INVALID_LOG_SCALE)
        )
        return PixelwisePrediction(motion, log_scale)


def _pose_head(features: int) -> nn.Sequential:
    layers = (
        nn.Linear(features, 128),
        nn.ELU(),
        nn.Linear(128, 32),
        nn.ELU(),
        nn.Linear(32, 3),
    )
    return nn.Sequential(*layers)


class VONet(nn.Module):
    """PWVO's encoder with two fully connected heads (the paper's VONet baselines)."""

    grid = (2, 4)  # of the embedding of a 128x256 input; others are averaged to it

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.options = options
        self.branches = InputBranches()
        self.encoder = layers.Encoder(
            InputBranches.out_channels, options.width, inner=False
        )
        channels = self.encoder.channels[-1]
        attends = options.kind == "vonet-attention"
        self.attention = (
            layers.SelfAttention(channels) if attends else nn.Identity()
        )
        features = channels * math.prod(self.grid)
        self.head_rotation = _pose_head(features)
        self.head_translation = _pose_head(features)
        initialize(self)

    def forward(
        self, inputs: NetworkInputs, T_start: torch.Tensor | None = None
    ) -> PixelwisePrediction:
        """One motion of each pair, in maps of one pixel."""
        inputs, scale = normalize(inputs, self.options, T_start)
        embedding = self.attention(self.encoder(self.branches(inputs))[-1])
        features = F.adaptive_avg_pool2d(embedding, self.grid).flatten(1)
        raw = torch.cat(
            [self.head_rotation(features), self.head_translation(features)], dim=1
        )
        raw = raw.to(next(self.parameters()).dtype)[:, :, None, None]
        return PixelwisePrediction(scale.motion(raw))


def build_network(options: NetworkOptions) -> nn.Module:
    """A :class:`PWVO` or :class:`VONet` with fresh weights, from torch's global generator."""
    return PWVO(options) if options.kind == "pwvo" else VONet(options)
