"""The selector network as a scorer of motions: numpy in, numpy out."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from hybridvo.hypotheses import search
from hybridvo.hypotheses.generate import GridMaps
from hybridvo.hypotheses.selector import Candidates, Scores
from hybridvo.network.models import plain_torch
from hybridvo.network.selector_net import (
    SelectorFeatures,
    SelectorInputs,
    SelectorNetwork,
    prior_information_of,
)
from hybridvo.types import MotionPrior

MAX_LAG = 3.0
"""How far a score may stay behind the best for a mask: at a twentieth of its probability."""


class NetworkScorer:
    """A :class:`hybridvo.hypotheses.selector.Scorer`; keeps nothing between pairs.

    Args:
        network: of :func:`hybridvo.network.weights.load_weights`.
        device: where it runs.
    """

    def __init__(self, network: SelectorNetwork, device: str = "cpu") -> None:
        self.device = torch.device(device)
        network = network.eval().to(self.device)
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def score(
        self,
        maps: GridMaps,
        candidates: Candidates,
        prior: MotionPrior | None,
        static: np.ndarray | None,
        masks: int,
    ) -> Scores:
        """See :class:`hybridvo.hypotheses.selector.Scorer`."""
        n = candidates.searched
        with plain_torch():
            first = selector_inputs(maps, candidates, slice(0, n), prior, static, self.device)
            seen = [self.network.encode(first)]
            if len(candidates.poses) > n:
                refits = selector_inputs(
                    maps, candidates, slice(n, None), prior, static, self.device
                )
                seen.append(self.network.encode(refits, (first, seen[0])))
            score = torch.cat([features.score for features in seen])
            hidden = torch.cat([features.hidden for features in seen])
            best = score.argsort(descending=True, stable=True)[:masks]
            best = best[score[best] > score.max() - MAX_LAG]
            drawn = [self._mask(seen, int(k), n) for k in best]
            owner = torch.zeros(len(score), dtype=torch.int64, device=self.device)
            confidence = torch.sigmoid(self.network.confidence(score, hidden, owner, 1))
        h, w = maps.depth.shape
        return Scores(
            score.double().cpu().numpy(),
            best.cpu().numpy(),
            torch.stack(drawn).cpu().numpy() if drawn else np.zeros((0, h, w), np.float32),
            float(confidence),
        )

    def _mask(self, seen: list[SelectorFeatures], k: int, searched: int) -> torch.Tensor:
        """(h, w) probability of being static, as candidate k sees it."""
        refit = k >= searched
        pick = torch.tensor([k - searched if refit else k], device=self.device)
        return torch.sigmoid(self.network.decode(seen[refit], pick))[0]


def selector_inputs(
    maps: GridMaps,
    candidates: Candidates,
    part: slice,
    prior: MotionPrior | None,
    static: np.ndarray | None,
    device: torch.device,
) -> SelectorInputs:
    """A batch of one image and a part of its candidates."""

    def batch(x: Any) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(x), device=device)[None]

    depth, usable = batch(maps.depth), batch(maps.usable)
    expected = np.eye(4) if prior is None else prior.T_curr_prev
    covariance = None if prior is None else batch(prior.covariance)
    logit = torch.zeros_like(depth)
    if static is not None:
        logit = torch.logit(batch(static).to(torch.float32), eps=1e-4)
    poses, facts = candidates.poses[part], candidates.facts[part]

    def of(x: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
        return torch.as_tensor(x, dtype=dtype, device=device)

    return SelectorInputs(
        ray=batch(maps.ray),
        depth=depth,
        target=batch(maps.target),
        flow_variance=batch(maps.flow_variance),
        depth_variance=batch(maps.depth_variance),
        usable=usable,
        log_depth_curr=batch(maps.log_depth_curr),
        static=logit,
        has_static=torch.tensor([static is not None], device=device),
        K=batch(maps.K),
        image_width=torch.tensor([float(maps.width)], device=device),
        T_prior=batch(expected[:3].astype(np.float32)),
        prior_information=prior_information_of(depth, usable, covariance),
        has_prior=torch.tensor([prior is not None], device=device),
        owner=torch.zeros(len(poses), dtype=torch.int64, device=device),
        parent=of(candidates.parents[part], torch.int64),
        pose=of(poses, torch.float32),
        flow_noise=of(facts[:, search.FLOW_NOISE], torch.float32),
        depth_noise=of(facts[:, search.DEPTH_NOISE], torch.float32),
    )
