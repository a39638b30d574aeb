"""The selector network: which motion is the camera's, and which pixels are static.

It reads the residuals of every candidate motion: to choose among few exact motions is easier
than to segment raw flow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import nn

from hybridvo.hypotheses.selector import Candidate, Scores
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.grid_maps import grid_maps
from hybridvo.network.layers import scaled, single_threaded_inference
from hybridvo.network.selector_inputs import (
    SelectorInputs,
    candidate_channels,
    selector_inputs,
    shared_channels,
)
from hybridvo.options import option_group
from hybridvo.results import MotionPrior

CHANNELS = (24, 40, 64, 96)
HIDDEN = 96
PIXEL_CHANNELS = 8
CANDIDATE_CHANNELS = 14
SHARED_CHANNELS = 11
SCALARS = 13
MIRRORED_CANDIDATE = (0,)
MIRRORED_SHARED = (0, 4)
"""Channels that change their sign in a mirror."""
MAX_SCORE_DEFICIT = 3.0
"""Largest difference from the best score at which a candidate gets a mask, nats: it is then a
twentieth as probable."""


@option_group
class SelectorNetworkOptions:
    """Options that decide the shapes of the weights.

    Attributes:
        kind: the kind of network, in the header of its file.
        width: factor on all channel counts.
    """

    kind: Literal["selector"] = "selector"
    width: Annotated[float, Field(gt=0, le=4)] = 1.0


@dataclass(frozen=True, eq=False)
class SelectorOutput:
    """The network's output for N candidates of B pairs.

    Attributes:
        score: (N,) logit of being the camera's motion, in a softmax over the candidates of a
            pair and 0, the score of none of them.
        mask: (N, h, w) logit of each pixel to be static.
        evidence: (N, 2, h, w) of :func:`candidate_channels`.
        common: (B, C, h', w') features of the first layer, common to the candidates of a pair.
    """

    score: torch.Tensor
    mask: torch.Tensor
    evidence: torch.Tensor
    common: torch.Tensor


FirstPass = tuple[SelectorInputs, SelectorOutput] | None
"""The motions of the search and the output for them; None in the first pass itself."""


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


class SelectorNetwork(nn.Module):
    """Scores and static masks of candidate motions."""

    def __init__(self, options: SelectorNetworkOptions | None = None) -> None:
        super().__init__()
        self.options = options or SelectorNetworkOptions()
        c1, c2, c3, c4 = (scaled(c, self.options.width) for c in CHANNELS)
        hidden = scaled(HIDDEN, self.options.width)
        self.candidate = nn.Conv2d(CANDIDATE_CHANNELS, c1, 3, 2, 1)
        self.shared = nn.Conv2d(SHARED_CHANNELS, c1, 3, 2, 1)
        self.down2 = nn.Conv2d(c1, c2, 3, 2, 1)
        self.block2 = _Block(c2)
        self.down3 = nn.Conv2d(c2, c3, 3, 2, 1)
        self.block3 = _Block(c3)
        self.down4 = nn.Conv2d(c3, c4, 3, 2, 1)
        self.block4 = _Block(c4)
        self.scalars = nn.Linear(SCALARS, c4)
        self.summary = nn.Linear(2 * c4 + c3 + SCALARS, hidden)
        self.inner = nn.Linear(hidden, hidden)
        self.score = nn.Linear(hidden, 1)
        self.up3 = nn.Conv2d(c4, c3, 1)
        self.merge3 = nn.Conv2d(c3, c2, 3, padding=1)
        self.merge2 = nn.Conv2d(c2, c1, 3, padding=1)
        self.merge1 = nn.Conv2d(c1, 16, 3, padding=1)
        self.context = nn.Conv2d(16, PIXEL_CHANNELS, 1)
        self.pixel = nn.Conv2d(CANDIDATE_CHANNELS, PIXEL_CHANNELS, 1)
        self.mask = nn.Conv2d(PIXEL_CHANNELS, 1, 1)
        nn.init.zeros_(self.score.weight)

    def forward(
        self,
        inputs: SelectorInputs,
        first: FirstPass = None,
        mirror: torch.Tensor | None = None,
    ) -> SelectorOutput:
        """Score every candidate and draw its mask.

        Args:
            inputs: pairs and candidates.
            first: the first pass, if the candidates are refits.
            mirror: (B,) bool, pairs that the network reads in a mirror (in training); the
                masks come back unmirrored.
        """
        own = inputs.owner
        rivals = None if first is None else (first[0], first[1].evidence)
        channels, scalars, evidence = candidate_channels(inputs, rivals)
        mirrored = None if mirror is None else mirror[own]
        channels = _framed(channels, mirrored, MIRRORED_CANDIDATE)
        if first is None:
            common = self.shared(
                _framed(shared_channels(inputs), mirror, MIRRORED_SHARED)
            )
        else:
            common = first[1].common
        score, mask = self.core(channels, common[own], scalars)
        mask = mask[:, : evidence.shape[2], : evidence.shape[3]]
        if mirrored is not None:
            mask = torch.where(mirrored[:, None, None], mask.flip(2), mask)
        return SelectorOutput(score, mask, evidence, common)

    def core(
        self, channels: torch.Tensor, common: torch.Tensor, scalars: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Scores (N,) and masks (N, H, W) of channels (N, 14, H, W), sides a multiple of 16."""
        channels = channels.contiguous(memory_format=torch.channels_last)
        x1 = F.relu_(self.candidate(channels) + common)
        x2 = self.block2(F.relu_(self.down2(x1)))
        x3 = self.block3(F.relu_(self.down3(x2)))
        x4 = self.down4(x3) + self.scalars(scalars)[:, :, None, None]
        x4 = self.block4(F.relu_(x4))
        pooled = [x4.mean((2, 3)), x4.amax((2, 3)), x3.mean((2, 3)), scalars]
        hidden = F.relu(self.summary(torch.cat(pooled, 1)))
        score = self.score(F.relu(self.inner(hidden)))[:, 0]
        y = F.interpolate(self.up3(x4), scale_factor=2.0)
        y = F.interpolate(self.merge3(F.relu_(y + x3)), scale_factor=2.0)
        y = F.interpolate(self.merge2(F.relu_(y + x2)), scale_factor=2.0)
        y = F.relu_(self.merge1(F.relu_(y + x1)))
        y = F.interpolate(
            self.context(y), scale_factor=2.0, mode="bilinear", align_corners=False
        )
        return score, self.mask(F.relu_(y + self.pixel(channels)))[:, 0]


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


class NetworkScorer:
    """A :data:`hybridvo.hypotheses.selector.Scorer` that keeps what it has computed.

    Args:
        network: the selector network.
        found: the motions of the search of one pair.
        prior: the expected motion, or None.
        static: (h, w) another network's probability that a pixel is static, or None.
    """

    def __init__(
        self,
        network: SelectorNetwork,
        found: HypothesisSet,
        prior: MotionPrior | None,
        static: np.ndarray | None,
    ) -> None:
        self.network = network
        device = next(network.parameters()).device
        with single_threaded_inference():
            self.pair_inputs = selector_inputs(
                grid_maps(found), prior, static, device
            )
        self.first: FirstPass = None
        self.outputs: list[SelectorOutput] = []

    def __call__(self, candidates: Sequence[Candidate], masks: int) -> Scores:
        """Score all candidates, of which those of earlier calls come first.

        Masks are drawn for so many of the best.
        """
        with single_threaded_inference():
            scored = sum(len(output.score) for output in self.outputs)
            for refits in (False, True):
                new = [
                    c for c in candidates[scored:] if (c.mask is not None) == refits
                ]
                if new:
                    poses = np.stack([c.pose for c in new])
                    noise = np.array([c.stats.noise for c in new])
                    parents = [c.parent for c in new]
                    inputs = self.pair_inputs.with_candidates(poses, noise, parents)
                    self.outputs.append(self.network(inputs, self.first))
                    self.first = self.first or (inputs, self.outputs[0])
            score = torch.cat([output.score for output in self.outputs])
            best = score.argsort(descending=True, stable=True)[:masks]
            best = best[score[best] > score.max() - MAX_SCORE_DEFICIT]
            drawn = (
                torch.cat([output.mask for output in self.outputs])[best]
                .sigmoid()
                .cpu()
                .numpy()
            )
        return Scores(
            score.double().cpu().numpy(),
            dict(zip(best.tolist(), drawn, strict=True)),
        )
