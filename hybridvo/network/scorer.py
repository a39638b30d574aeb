"""PWVO as the scorer of the stage *select*."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hybridvo.core.results import MotionPrior
from hybridvo.hypotheses.select import Candidate, Scores
from hybridvo.hypotheses.types import HypothesisSet, MotionSource
from hybridvo.network.grid_maps import grid_maps
from hybridvo.network.hypothesis_inputs import hypothesis_inputs
from hybridvo.network.hypothesis_maps import (
    FirstLook,
    HypothesisMaps,
    HypothesisNetwork,
    Looks,
)

# nats from the best score at which a candidate is fitted again: it is then a
# twentieth as probable
MAX_SCORE_DEFICIT = 3.0


class PWVOScorer:
    """A :data:`hybridvo.hypotheses.select.Scorer` that keeps what it has computed.

    Args:
        network: PWVO.
        found: the motions of the search of one pair.
        prior: the expected motion, or None.
    """

    def __init__(
        self,
        network: HypothesisNetwork,
        found: HypothesisSet,
        prior: MotionPrior | None,
    ) -> None:
        self.network = network
        device = next(network.parameters()).device
        self.pair_inputs = hypothesis_inputs(grid_maps(found), prior, device)
        self.first: FirstLook = None
        self.looks: list[Looks] = []

    def __call__(self, candidates: Sequence[Candidate], refits: int) -> Scores:
        """Score all candidates, of which those of earlier calls come first.

        The best ones get a static mask, so many of them.
        """
        done = sum(len(looks.score) for looks in self.looks)
        for are_refits in (False, True):
            new = [
                c
                for c in candidates[done:]
                if (c.source is MotionSource.REFIT) == are_refits
            ]
            if new:
                self._look(new)
        score = torch.cat([looks.score for looks in self.looks]).detach()
        best = score.argsort(descending=True, stable=True)[:refits]
        best = best[score[best] > score.max() - MAX_SCORE_DEFICIT]
        static = self._static(best) if len(best) else {}
        return Scores(score.double().cpu().numpy(), static)

    def maps_of(self, number: int) -> HypothesisMaps:
        """The maps (1, ...) of one of the candidates so far."""
        for looks in self.looks:
            if number < len(looks.score):
                only = torch.tensor([number], device=looks.score.device)
                return self.network.maps(looks, only)
            number -= len(looks.score)
        raise IndexError(number)

    def _look(self, candidates: Sequence[Candidate]) -> None:
        """Look at further candidates, which are all refits or all of the search."""
        poses = np.stack([candidate.pose for candidate in candidates])
        noise = np.array([candidate.noise for candidate in candidates])
        parents = [candidate.parent for candidate in candidates]
        inputs = self.pair_inputs.with_hypotheses(poses, noise, parents)
        self.looks.append(self.network.look(inputs, self.first))
        self.first = self.first or (inputs, self.looks[0])

    def _static(self, numbers: torch.Tensor) -> dict[int, np.ndarray]:
        """Probabilities (h, w) of pixels to be static under candidates."""
        (looks,) = self.looks  # only motions of the search are fitted again
        static = self.network.maps(looks, numbers).static.detach().sigmoid()
        return dict(zip(numbers.tolist(), static.cpu().numpy(), strict=True))
