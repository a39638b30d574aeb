"""PWVO as the scorer of the stage *select*."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from hybridvo.core.results import MotionPrior, PixelwisePrediction
from hybridvo.hypotheses.select import Candidate, RefitStart, Scores
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.euler import euler_transform
from hybridvo.network.grid_maps import grid_maps
from hybridvo.network.hypothesis_inputs import hypothesis_inputs
from hybridvo.network.hypothesis_maps import (
    FirstLook,
    HypothesisMaps,
    HypothesisNetwork,
    Looks,
)
from hybridvo.network.selection import select_pose

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

        The best ones get the start of a refit, so many of them.
        """
        done = sum(len(looks.score) for looks in self.looks)
        for are_refits in (False, True):
            new = [
                c for c in candidates[done:] if (c.mask is not None) == are_refits
            ]
            if new:
                self._look(new)
        score = torch.cat([looks.score for looks in self.looks]).detach()
        best = score.argsort(descending=True, stable=True)[:refits]
        best = best[score[best] > score.max() - MAX_SCORE_DEFICIT]
        starts = self._refit_starts(best) if len(best) else {}
        return Scores(score.double().cpu().numpy(), starts)

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

    def _refit_starts(self, numbers: torch.Tensor) -> dict[int, RefitStart]:
        """Where candidates are fitted again: their selected poses and static masks."""
        (looks,) = self.looks  # only motions of the search are fitted again
        maps = self.network.maps(looks, numbers)
        poses = selected_poses(maps.motion.detach(), maps.log_scale.detach())
        static = maps.static.detach().sigmoid().cpu().numpy()
        starts = map(RefitStart, poses, static)
        return dict(zip(numbers.tolist(), starts, strict=True))


def selected_poses(motion: torch.Tensor, log_scale: torch.Tensor) -> np.ndarray:
    """Select one pose of each hypothesis from those of its pixels (paper, section 3.3).

    Args:
        motion: (N, 6, h, w) degrees, then metres.
        log_scale: (N, 6, h, w) of it.

    Returns:
        (N, 3, 4) float64 ``T_curr_prev``, metres.
    """
    selected = select_pose(PixelwisePrediction(motion, log_scale))
    return euler_transform(selected)[:, :3].double().cpu().numpy()
