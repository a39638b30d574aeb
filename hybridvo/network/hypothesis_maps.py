"""What PWVO hands on: its looks at hypotheses, and the maps that it draws of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import torch

from hybridvo.network.hypothesis_inputs import HypothesisInputs


@dataclass(frozen=True, eq=False)
class Looks:
    """PWVO's looks at N hypotheses of B pairs, from which its maps are drawn.

    Attributes:
        score: (N,) logit of being the camera's motion, in a softmax over the hypotheses
            of a pair and 0, the score of none of them.
        evidence: (N, 2, h, w) of :func:`hybridvo.network.hypothesis_inputs.hypothesis_channels`.
        common: (B, C, h', w') features of the first layer, common to the hypotheses of a
            pair.
        channels: (N, 14, H, W) what was read of the hypotheses, framed.
        features: of the encoder's stages, the finest first.
        scalars: (N, 12) numbers of the hypotheses.
        start: (N, 6) the hypotheses: Euler angles in degrees, then metres.
        unit: (N, 6) what they leave unexplained, degrees and metres.
        usable: (N, h, w) bool, pixels with flow and depth.
        mirrored: (N,) bool, those that were read in a mirror; None: none.
    """

    score: torch.Tensor
    evidence: torch.Tensor
    common: torch.Tensor
    channels: torch.Tensor
    features: tuple[torch.Tensor, ...]
    scalars: torch.Tensor
    start: torch.Tensor
    unit: torch.Tensor
    usable: torch.Tensor
    mirrored: torch.Tensor | None


@dataclass(frozen=True, eq=False)
class HypothesisMaps:
    """What PWVO predicts at every pixel for N hypotheses.

    Attributes:
        static: (N, h, w) logit of each pixel to be static, if the hypothesis is right.
        motion: (N, 6, h, w) the camera's motion by each pixel: degrees, then metres.
        log_scale: (N, 6, h, w) s = log U, where U is the Laplace scale of ``motion``. It
            is that of the pose, which is one for the hypothesis, over the probability of
            the pixel to be static.
        unit: (N, 6) what the hypothesis leaves unexplained, degrees and metres.
    """

    static: torch.Tensor
    motion: torch.Tensor
    log_scale: torch.Tensor
    unit: torch.Tensor


FirstLook = tuple[HypothesisInputs, Looks] | None
"""The hypotheses of the search and the looks at them; None in the first look itself."""


class HypothesisNetwork(Protocol):
    """What the stages need of PWVO."""

    def look(self, inputs: HypothesisInputs, first: FirstLook = None) -> Looks:
        """Look at what every hypothesis leaves unexplained, and score it."""

    def maps(
        self, looks: Looks, numbers: torch.Tensor | None = None
    ) -> HypothesisMaps:
        """Draw the maps of hypotheses that were looked at."""

    def parameters(self) -> Iterator[torch.nn.Parameter]:
        """The weights."""
