"""The paper's networks: PWVO, which predicts a pose at every pixel, and the VONet baselines.

PWVO is that of the published code, layer by layer: one U-Net decoder for both heads, each
of two convolutions. ``decoders=2`` builds the two decoders of the paper's text.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import nn

from hybridvo.core.checks import check_kind
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.network.pwvo import scaled
from hybridvo.network.selection import INVALID_LOG_SCALE
from hybridvo.network.weights import read_network_of
from hybridvo_lab.paper import layers
from hybridvo_lab.paper.inputs import NetworkInputs, assemble_inputs
from hybridvo_lab.paper.layers import (
    InputBranches,
    NetworkOptions,
    initialize,
)
from hybridvo_lab.paper.normalization import MotionScale, normalize

# channels of the decoder at full width: of its last layers, and of those before
FINE_CHANNELS = 32
MIDDLE_CHANNELS = 64
COARSE_CHANNELS = 128


class _UpStage(nn.Module):
    """A stage of the decoder: upsampling, the encoder's feature of that size, residual block.

    Args:
        before: channels of the input.
        upsampled: channels after the transposed 2x2 convolution.
        skip: channels of the encoder's feature; 0: it gives the size alone.
        after: channels of the output.
        project: whether the shortcut of the block is a 1x1 convolution in any case.
    """

    def __init__(
        self,
        before: int,
        upsampled: int,
        skip: int,
        after: int,
        project: bool = False,
    ):
        super().__init__()
        self.up = nn.ConvTranspose2d(before, upsampled, 2, 2)
        self.skip = skip
        self.block = layers.ResidualBlock(
            upsampled + skip, after, 1, has_inner_elu=True, project=project
        )

    def forward(self, x: torch.Tensor, feature: torch.Tensor) -> torch.Tensor:
        # upsampling adds a row or column where the encoder halved an odd size
        x = self.up(x)[:, :, : feature.shape[2], : feature.shape[3]]
        if self.skip:
            x = torch.cat([x, feature.to(x.dtype)], dim=1)
        return self.block(x)


class Decoder(nn.Module):
    """U-Net decoder from the embedding to the resolution of the heads.

    Args:
        channels: of the encoder's stages.
        width: factor on the decoder's own channel counts.
        head_stride: 1, or 2, which leaves out the last stage.
    """

    def __init__(
        self, channels: tuple[int, ...], width: float, head_stride: int
    ) -> None:
        super().__init__()
        fine = scaled(FINE_CHANNELS, width)
        middle = scaled(MIDDLE_CHANNELS, width)
        coarse = scaled(COARSE_CHANNELS, width)
        layer1, layer2, layer3, layer4, layer5 = channels
        self.up5 = _UpStage(layer5, layer4, layer4, coarse)
        self.up4 = _UpStage(coarse, coarse, layer3, coarse)
        self.up3 = _UpStage(coarse, coarse, layer2, coarse)
        self.up2 = _UpStage(coarse, middle, layer1, middle)
        # The shortcut of up1 is a 1x1 convolution although the shapes agree: as published.
        self.up1 = _UpStage(middle, middle, 0, middle, project=True)
        if head_stride == 1:
            self.up0: nn.Module | None = _UpStage(middle, fine, 0, fine)
            self.out = nn.Conv2d(fine, fine, 1)
        else:
            self.up0 = None
            self.out = nn.Conv2d(middle, fine, 1)

    def forward(
        self, inputs: torch.Tensor, features: list[torch.Tensor]
    ) -> torch.Tensor:
        """Inputs (B, 18, h, w) and the encoder's features -> (B, 32, h / stride, w / stride)."""
        *skipped, x = features
        stages = (self.up5, self.up4, self.up3, self.up2, self.up1)
        for stage, feature in zip(stages, reversed(skipped), strict=True):
            x = stage(x, feature)
        if self.up0 is not None:
            x = self.up0(x, inputs)
        return self.out(x)


def _map_head(channels: int) -> nn.Sequential:
    """Two 3x3 convolutions to six channels: rx, ry, rz, tx, ty, tz."""
    first = nn.Conv2d(channels, channels, 3, 1, 1)
    last = nn.Conv2d(channels, 6, 3, 1, 1)
    return nn.Sequential(first, nn.ELU(inplace=True), last)


class PaperPWVO(nn.Module):
    """Pixel-wise prediction of the camera motion with uncertainty (paper, section 3.2).

    Args:
        options: shapes of the weights and use of the network; None: the defaults.
    """

    def __init__(self, options: NetworkOptions | None = None) -> None:
        super().__init__()
        check_kind("PaperPWVO.options", options, NetworkOptions, type(None))
        options = options or NetworkOptions()
        self.options = options
        width = options.width
        stride = options.head_stride
        self.branches = InputBranches()
        self.encoder = layers.Encoder(InputBranches.out_channels, width)
        channels = self.encoder.channels
        self.decoder = Decoder(channels, width, stride)
        self.decoder_uncertainty: Decoder | None = None
        if options.decoders == 2:
            self.decoder_uncertainty = Decoder(channels, width, stride)
        fine = scaled(FINE_CHANNELS, width)
        self.head_motion = _map_head(fine)
        self.head_uncertainty: nn.Sequential | None = None
        if options.uncertainty:
            self.head_uncertainty = _map_head(fine)
        initialize(self)

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path = "pwvo-paper") -> PaperPWVO:
        """Read a network.

        Args:
            name_or_path: the name of pretrained weights, or a file.

        Returns:
            The network, in evaluation mode on the CPU.

        Raises:
            CheckpointError: the file is damaged, or holds another kind of network.
        """
        return read_network_of(
            cls,
            name_or_path,
            lambda options: build_network(NetworkOptions(**options)),
        )

    if TYPE_CHECKING:  # torch declares that a call returns Any

        def __call__(
            self, inputs: NetworkInputs | FramePair | PairBatch
        ) -> PixelwisePrediction:
            """See ``forward``."""

    def forward(
        self, inputs: NetworkInputs | FramePair | PairBatch
    ) -> PixelwisePrediction:
        """Predict pose and log scale at every pixel.

        Args:
            inputs: a pair, a batch, or assembled inputs.

        Returns:
            Maps of (ceil(h / n), ceil(w / n)) pixels, n = input_stride * head_stride; finite
            for any input.
        """
        if not isinstance(inputs, NetworkInputs):
            return self._predict_pairs(inputs)
        dtype = next(self.parameters()).dtype
        inputs, scale = normalize(inputs, self.options)
        x = self.branches(inputs)
        features = self.encoder(x)
        decoded = self.decoder(x, features)
        motion = scale.motion(self.head_motion(decoded).to(dtype))
        if self.head_uncertainty is None:
            return PixelwisePrediction(motion)
        if self.decoder_uncertainty is not None:
            decoded = self.decoder_uncertainty(x, features)
        raw = self.head_uncertainty(decoded).to(dtype)
        return PixelwisePrediction(motion, self._log_scale(raw, inputs, scale))

    def _predict_pairs(self, pairs: FramePair | PairBatch) -> PixelwisePrediction:
        """Assemble the inputs of pairs and predict."""
        if isinstance(pairs, FramePair):
            pairs = PairBatch.from_pairs([pairs])
        weight = next(self.parameters())
        inputs = assemble_inputs(pairs).to(device=weight.device, dtype=weight.dtype)
        output = self(inputs)
        height, width = pairs.flow.shape[1:3]
        return replace(output, image_size=(height, width))

    def _log_scale(
        self, raw: torch.Tensor, inputs: NetworkInputs, scale: MotionScale
    ) -> torch.Tensor:
        """Log scales of a head's output, in degrees and metres; large where invalid."""
        log_scale = raw
        if self.options.scale_free:
            log_factor = scale.factor.to(raw.dtype).log()
            log_scale = log_scale + log_factor[:, :, None, None]
        valid = inputs.valid[:, None].to(raw.dtype)
        valid = F.max_pool2d(valid, self.options.head_stride, ceil_mode=True)
        limited = log_scale.clamp(min=INVALID_LOG_SCALE)
        return torch.where(valid > 0, log_scale, limited)


def _pose_head(features: int) -> nn.Sequential:
    """Three fully connected layers to three numbers."""
    return nn.Sequential(
        nn.Linear(features, 128),
        nn.ELU(),
        nn.Linear(128, 32),
        nn.ELU(),
        nn.Linear(32, 3),
    )


class VONet(nn.Module):
    """PWVO's encoder with two fully connected heads (the paper's VONet baselines).

    Args:
        options: shapes of the weights and use of the network.
    """

    # size of the embedding of a 128x256 input; that of another input is averaged to it
    grid = (2, 4)

    def __init__(self, options: NetworkOptions) -> None:
        super().__init__()
        self.options = options
        self.branches = InputBranches()
        self.encoder = layers.Encoder(
            InputBranches.out_channels, options.width, has_inner_elu=False
        )
        channels = self.encoder.channels[-1]
        self.attention: nn.Module = nn.Identity()
        if options.kind == "vonet-attention":
            self.attention = layers.SelfAttention(channels)
        features = channels * math.prod(self.grid)
        self.head_rotation = _pose_head(features)
        self.head_translation = _pose_head(features)
        initialize(self)

    def forward(self, inputs: NetworkInputs) -> PixelwisePrediction:
        """Predict one motion of each pair, in maps of one pixel; see :meth:`PaperPWVO.forward`."""
        inputs, scale = normalize(inputs, self.options)
        embedding = self.encoder(self.branches(inputs))[-1]
        embedding = self.attention(embedding)
        features = F.adaptive_avg_pool2d(embedding, self.grid).flatten(1)
        rotation = self.head_rotation(features)
        translation = self.head_translation(features)
        raw = torch.cat([rotation, translation], dim=1)
        raw = raw.to(next(self.parameters()).dtype)
        return PixelwisePrediction(scale.motion(raw[:, :, None, None]))


def network_of_options(options: dict[str, Any]) -> nn.Module:
    """Build a network from the options in a file of weights."""
    return build_network(NetworkOptions(**options))


def build_network(options: NetworkOptions) -> nn.Module:
    """Make a :class:`PaperPWVO` or :class:`VONet` with weights from torch's global generator."""
    if options.kind == "pwvo":
        return PaperPWVO(options)
    return VONet(options)
