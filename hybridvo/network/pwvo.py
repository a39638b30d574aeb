"""PWVO, as the product uses it: a score and a static mask for every hypothesis.

The network looks at what a motion hypothesis leaves unexplained. Its score says how much surer
it is of this motion than of "none of them", and decides. Its maps have the form of the paper's
(section 3.2): a pose at every pixel, which with the trained weights repeats the hypothesis, and
its log scale, which for each component is a constant of the hypothesis minus log P(static).
The poses that seed a refinement are those of patches, estimated from their own pixels weighted
by P(static): :mod:`hybridvo.solver.torch.patches`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import nn

from hybridvo.core.checks import check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.options import option_group
from hybridvo.core.results import PixelwisePrediction
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.network.euler import euler_motion
from hybridvo.network.hypothesis_inputs import (
    HypothesisInputs,
    hypothesis_channels,
    shared_channels,
)
from hybridvo.network.hypothesis_maps import FirstLook, HypothesisMaps, Looks
from hybridvo.network.pair_maps import predict_batch, predict_pairs
from hybridvo.network.weights import read_network_of
from hybridvo.solver.torch.tools import checked_batch

CHANNELS = (24, 40, 64, 96)
HIDDEN = 96
PIXEL_CHANNELS = 16
HYPOTHESIS_CHANNELS = 14
SHARED_CHANNELS = 9
SCALARS = 12
MIRRORED_HYPOTHESIS = (0,)
MIRRORED_SHARED = (0, 4)
"""Channels that change their sign in a mirror."""
MIRRORED_MOTION = (1, 2, 3)
"""Components of a motion that do so: ry, rz, tx."""
MAX_CORRECTION = 20.0
"""Largest correction of a hypothesis, in units of what it leaves unexplained."""


def scaled(channels: int, width: float) -> int:
    """Number of channels at a width factor, at least one."""
    return max(1, round(channels * width))


@option_group
class PWVOOptions:
    """Options that decide the shapes of the weights.

    Attributes:
        kind: the kind of network, in the header of its file.
        width: factor on all channel counts.
    """

    kind: Literal["pwvo-hypotheses"] = "pwvo-hypotheses"
    width: Annotated[float, Field(gt=0, le=4)] = 1.0


class _Block(nn.Module):
    """Two 3x3 convolutions beside a shortcut; starts as the identity."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, C, h, w) -> the same."""
        return F.relu_(x + self.conv2(F.relu_(self.conv1(x))))


class PWVO(nn.Module):
    """A score, a static mask, and maps in the form of the paper's, for each motion hypothesis.

    Args:
        options: shapes of the weights; None: the defaults.

    Raises:
        InputError: the options have the wrong type.

    Example:
        >>> import hybridvo as hvo
        >>> prev, curr, _ = hvo.example_frames()
        >>> pair = hvo.FramePair(prev, curr, hvo.dis_flow()(prev, curr).flow)
        >>> maps = hvo.PWVO.from_pretrained()(pair)
        >>> maps.motion.shape  # a pose for each pixel of the search's grid
        torch.Size([1, 6, 60, 80])
        >>> hvo.select(maps).T_curr_prev.shape
        torch.Size([1, 4, 4])
    """

    def __init__(self, options: PWVOOptions | None = None) -> None:
        super().__init__()
        check_kind("PWVO.options", options, PWVOOptions, type(None))
        self.options = options or PWVOOptions()
        c1, c2, c3, c4 = (scaled(c, self.options.width) for c in CHANNELS)
        hidden = scaled(HIDDEN, self.options.width)
        # the two input branches: of the hypothesis, and of the pair
        self.hypothesis = nn.Conv2d(HYPOTHESIS_CHANNELS, c1, 3, 2, 1)
        self.shared = nn.Conv2d(SHARED_CHANNELS, c1, 3, 2, 1)
        # the encoder
        self.down2 = nn.Conv2d(c1, c2, 3, 2, 1)
        self.block2 = _Block(c2)
        self.down3 = nn.Conv2d(c2, c3, 3, 2, 1)
        self.block3 = _Block(c3)
        self.down4 = nn.Conv2d(c3, c4, 3, 2, 1)
        self.block4 = _Block(c4)
        self.scalars = nn.Linear(SCALARS, c4)
        # the score, from the embedding
        self.summary = nn.Linear(2 * c4 + c3 + SCALARS, hidden)
        self.inner = nn.Linear(hidden, hidden)
        self.score = nn.Linear(hidden, 1)
        # the decoder
        self.up3 = nn.Conv2d(c4, c3, 1)
        self.merge3 = nn.Conv2d(c3, c2, 3, padding=1)
        self.merge2 = nn.Conv2d(c2, c1, 3, padding=1)
        self.merge1 = nn.Conv2d(c1, 16, 3, padding=1)
        self.context = nn.Conv2d(16, PIXEL_CHANNELS, 1)
        self.pixel = nn.Conv2d(HYPOTHESIS_CHANNELS, PIXEL_CHANNELS, 1)
        # the heads: pose, its log scale, and the logit of being static
        self.head_motion = nn.Conv2d(PIXEL_CHANNELS, 6, 1)
        self.head_uncertainty = nn.Conv2d(PIXEL_CHANNELS, 6, 1)
        self.head_static = nn.Conv2d(PIXEL_CHANNELS, 1, 1)
        for layer in (self.score, self.head_motion, self.head_uncertainty):
            nn.init.zeros_(layer.weight)

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path = "pwvo") -> PWVO:
        """Read a network.

        Args:
            name_or_path: the name of pretrained weights, or a file.

        Returns:
            The network, in evaluation mode on the CPU.

        Raises:
            CheckpointError: the file is damaged, or holds another kind of network.
        """
        return read_network_of(cls, name_or_path, _of_options)

    if TYPE_CHECKING:  # torch declares that a call returns Any

        def __call__(self, pairs: FramePair | PairBatch) -> PixelwisePrediction:
            """See ``forward``."""

    def forward(self, pairs: FramePair | PairBatch) -> PixelwisePrediction:
        """Predict pose and log scale at every pixel, for the hypothesis with the best score.

        The motions of each pair are searched, and the network looks at each of them. The
        maps carry the gradient of the network's weights; the search has none.

        Args:
            pairs: a pair, or a batch.

        Returns:
            Maps on the grid of the search, about 8000 pixels, finite for any input; and with
            the extra ``train`` the poses of patches by their own pixels, weighed by P(static).

        Raises:
            InputError: for what is neither a pair nor a batch.
        """
        if isinstance(pairs, FramePair):
            device = next(self.parameters()).device
            batch = PairBatch.from_pairs([pairs], device)
            return predict_pairs(self, [pairs], batch=batch)
        if not isinstance(pairs, PairBatch):
            got = type(pairs).__name__
            raise InputError(
                f"PWVO: expected a FramePair or a PairBatch, got {got}."
            )
        return predict_batch(self, checked_batch(pairs, where="PWVO")[0])

    def look(
        self,
        inputs: HypothesisInputs,
        first: FirstLook = None,
        mirror: torch.Tensor | None = None,
    ) -> Looks:
        """Look at what every hypothesis leaves unexplained, and score it.

        Args:
            inputs: pairs and hypotheses.
            first: the first look, if the hypotheses are refits.
            mirror: (B,) bool, pairs that the network reads in a mirror (in training); the
                maps come back unmirrored.

        Returns:
            Scores and features, from which :meth:`maps` draws the maps.
        """
        own = inputs.owner
        rivals = None if first is None else (first[0], first[1].evidence)
        read = hypothesis_channels(inputs, rivals)
        mirrored = None if mirror is None else mirror[own]
        channels = _framed(read.maps, mirrored, MIRRORED_HYPOTHESIS)
        channels = channels.contiguous(memory_format=torch.channels_last)
        if first is None:
            pair_channels = shared_channels(inputs)
            common = self.shared(_framed(pair_channels, mirror, MIRRORED_SHARED))
        else:
            common = first[1].common
        features = self._encode(channels, common[own], read.scalars)
        return Looks(
            score=self._score(features[2], features[3], read.scalars),
            evidence=read.evidence,
            common=common,
            channels=channels,
            features=features,
            scalars=read.scalars,
            start=euler_motion(inputs.pose),
            unit=read.unit,
            usable=inputs.usable[own],
            mirrored=mirrored,
        )

    def maps(
        self, looks: Looks, numbers: torch.Tensor | None = None
    ) -> HypothesisMaps:
        """Draw the maps of hypotheses that were looked at.

        Args:
            looks: what :meth:`look` returned.
            numbers: (M,) which hypotheses; None: all.

        Returns:
            Pose, log scale and static logit at every pixel.
        """
        if numbers is None:
            numbers = torch.arange(len(looks.score), device=looks.score.device)
        decoded = self._decode(
            looks.channels[numbers], *(each[numbers] for each in looks.features)
        )
        height, width = looks.evidence.shape[2:]
        raw = decoded[:, :, :height, :width]
        if looks.mirrored is not None:
            turned = raw.flip(3)
            turned[:, list(MIRRORED_MOTION)] *= -1
            raw = torch.where(
                looks.mirrored[numbers][:, None, None, None], turned, raw
            )
        correction, log_scale, static = raw.split([6, 6, 1], dim=1)
        # one scale of the pose for all pixels: they differ by whether they are static
        usable = looks.usable[numbers][:, None]
        count = usable.sum(dim=(2, 3), keepdim=True).clamp(min=1)
        pose_scale = (log_scale * usable).sum(dim=(2, 3), keepdim=True) / count
        # in the units of what the hypothesis leaves unexplained
        unit = looks.unit[numbers][:, :, None, None]
        start = looks.start[numbers][:, :, None, None]
        limited = correction.clamp(-MAX_CORRECTION, MAX_CORRECTION)
        return HypothesisMaps(
            static=static[:, 0],
            motion=start + unit * limited,
            # a pixel that moves carries less information about the camera's pose
            log_scale=pose_scale + unit.log() - F.logsigmoid(static),
            unit=looks.unit[numbers],
        )

    def _encode(
        self, channels: torch.Tensor, common: torch.Tensor, scalars: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Features of four stages, the finest first.

        Args:
            channels: (N, 14, H, W), sides a multiple of 16.
            common: (N, C, H / 2, W / 2) features of the pair's channels.
            scalars: (N, 12).
        """
        x1 = F.relu_(self.hypothesis(channels) + common)
        x2 = self.block2(F.relu_(self.down2(x1)))
        x3 = self.block3(F.relu_(self.down3(x2)))
        x4 = self.down4(x3) + self.scalars(scalars)[:, :, None, None]
        return x1, x2, x3, self.block4(F.relu_(x4))

    def _score(
        self, x3: torch.Tensor, x4: torch.Tensor, scalars: torch.Tensor
    ) -> torch.Tensor:
        """(N,) scores, from the features of the third and fourth stages and the numbers."""
        pooled = [x4.mean((2, 3)), x4.amax((2, 3)), x3.mean((2, 3)), scalars]
        hidden = F.relu(self.summary(torch.cat(pooled, 1)))
        return self.score(F.relu(self.inner(hidden)))[:, 0]

    def _decode(
        self,
        channels: torch.Tensor,
        x1: torch.Tensor,
        x2: torch.Tensor,
        x3: torch.Tensor,
        x4: torch.Tensor,
    ) -> torch.Tensor:
        """(N, 13, H, W): six of the motion, six of its log scale, the logit of being static."""
        y = F.interpolate(self.up3(x4), scale_factor=2.0)
        y = F.interpolate(self.merge3(F.relu_(y + x3)), scale_factor=2.0)
        y = F.interpolate(self.merge2(F.relu_(y + x2)), scale_factor=2.0)
        y = F.relu_(self.merge1(F.relu_(y + x1)))
        y = F.interpolate(
            self.context(y), scale_factor=2.0, mode="bilinear", align_corners=False
        )
        y = F.relu_(y + self.pixel(channels))
        heads = (self.head_motion, self.head_uncertainty, self.head_static)
        return torch.cat([head(y) for head in heads], dim=1)


def _of_options(options: dict[str, Any]) -> PWVO:
    """Make a network for weights of which only the options are known."""
    kind = options.get("kind")
    if kind != PWVOOptions.kind:
        raise InputError(
            f"expected the weights of our PWVO, got a {kind} of the paper; the methods of "
            f"that name read it"
        )
    return PWVO(PWVOOptions(**options))


def _framed(
    x: torch.Tensor, mirror: torch.Tensor | None, signed: tuple[int, ...]
) -> torch.Tensor:
    """Mirror some of the maps (N, C, h, w), and pad all with zeros to a multiple of 16.

    Args:
        x: the maps.
        mirror: (N,) bool, those to be mirrored; None: none of them.
        signed: channels that change their sign in a mirror.
    """
    if mirror is not None:
        turned = x.flip(3)
        turned[:, list(signed)] *= -1
        x = torch.where(mirror[:, None, None, None], turned, x)
    return F.pad(x, (0, -x.shape[3] % 16, 0, -x.shape[2] % 16))
