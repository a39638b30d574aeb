"""A judge network as the refinement takes it: first look, second look, PWVO's word in between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridvo.hypotheses.selector import Expected, Motions, Opinion, Proposal
from hybridvo.learned import plain_torch, propose_motion
from hybridvo.types import FramePair

if TYPE_CHECKING:
    import torch

    from hybridvo.hypotheses.generate import Grid
    from hybridvo.network.judge import JudgeFeatures, JudgeInputs, JudgeNetwork

__all__ = ["LearnedJudge", "judge_inputs"]

OUT_OF_THE_RACE = 3.0
"""How far a score may stay behind the best for a second look: at a twentieth of its probability."""


class LearnedJudge:
    """A judge network as :func:`hybridvo.refinement.refine.refine` takes it.

    Keeps nothing between pairs: one judge may serve several threads.

    Args:
        network: of :func:`hybridvo.network.weights.load_weights`.
        pixelwise: a PWVO, whose motion takes part where the judge trusts no other; or None.
    """

    def __init__(self, network: JudgeNetwork, pixelwise: torch.nn.Module | None = None) -> None:
        import torch

        self._pixelwise = pixelwise
        self._network = network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def first_look(
        self, grid: Grid, motions: Motions, expected: Expected | None, masks: int
    ) -> Opinion:
        """Scores of the motions of the search, and masks for the best, see ``PictureJudge``."""
        import torch

        with plain_torch():
            inputs = judge_inputs(grid, motions, expected)
            features = self._network.encode(inputs)
            best = _worth_a_look(features.score, masks)
            mask = torch.sigmoid(self._network.decode(features, best)).numpy()
        memory = _Memory(inputs, features, features.score, features.hidden, None)
        return Opinion(features.score.double().numpy(), best.numpy(), mask, memory=memory)

    def look_again(self, before: Opinion, refits: Motions, parents: np.ndarray) -> Opinion:
        """Scores of all candidates and the probability that the best of them is right."""
        import torch

        memory: _Memory = before.memory
        score, hidden = memory.score, memory.hidden
        mask = np.zeros((0, *before.mask.shape[1:]))
        with plain_torch():
            best = torch.zeros(0, dtype=torch.int64)
            if len(refits.poses):
                again = replace(memory.inputs, **_candidates(refits, parents))
                new = self._network.encode(again, (memory.inputs, memory.features))
                memory = replace(memory, refits=_joined(memory.refits, again))
                known = len(score)
                score, hidden = torch.cat([score, new.score]), torch.cat([hidden, new.hidden])
                if int(score.argmax()) >= known:
                    best = score.argmax()[None]
                    mask = torch.sigmoid(self._network.decode(new, best - known)).numpy()
            trust = self._trust(score, hidden)
        memory = replace(memory, score=score, hidden=hidden)
        return Opinion(score.double().numpy(), best.numpy(), mask, trust, memory)

    def look_with(
        self, before: Opinion, static: np.ndarray, refits: Motions, parents: np.ndarray, masks: int
    ) -> Opinion:
        """Scores of all candidates with another network's static world beside them."""
        import torch

        memory: _Memory = before.memory
        with plain_torch():
            inputs = replace(
                memory.inputs,
                static=torch.logit(torch.as_tensor(static, dtype=torch.float32), eps=1e-4)[None],
                has_static=torch.tensor([True]),
            )
            features = self._network.encode(inputs)
            score, hidden = features.score, features.hidden
            pool = memory.refits
            if len(refits.poses):
                pool = _joined(pool, replace(inputs, **_candidates(refits, parents)))
            seen = [features]
            if pool is not None:
                pool = replace(pool, static=inputs.static, has_static=inputs.has_static)
                seen.append(self._network.encode(pool, (inputs, features)))
                score = torch.cat([f.score for f in seen])
                hidden = torch.cat([f.hidden for f in seen])
            best = _worth_a_look(score, masks)
            mask = torch.stack([self._mask(seen, int(k)) for k in best]).numpy()
            trust = self._trust(score, hidden)
        memory = _Memory(inputs, features, score, hidden, pool)
        return Opinion(score.double().numpy(), best.numpy(), mask, trust, memory)

    def _mask(self, seen: list[JudgeFeatures], k: int) -> torch.Tensor:
        """(h, w) static probability about candidate k of the search's motions and the refits."""
        import torch

        late = k >= len(seen[0].score)
        pick = torch.tensor([k - len(seen[0].score) if late else k])
        return torch.sigmoid(self._network.decode(seen[late], pick))[0]

    def _trust(self, score: torch.Tensor, hidden: torch.Tensor) -> float:
        import torch

        owner = torch.zeros(len(score), dtype=torch.int64)
        return float(torch.sigmoid(self._network.confidence(score, hidden, owner, 1)))

    def propose(self, pair: FramePair) -> Proposal | None:
        """PWVO's motion and where it sees the static world."""
        if self._pixelwise is None:
            return None
        return propose_motion(self._pixelwise, pair)


@dataclass(frozen=True, eq=False)
class _Memory:
    """What a judge keeps from look to look: candidates as seen, all answers so far."""

    inputs: JudgeInputs
    features: JudgeFeatures
    score: torch.Tensor
    hidden: torch.Tensor
    refits: JudgeInputs | None


def _worth_a_look(score: torch.Tensor, masks: int) -> torch.Tensor:
    """(R,) indices of the best candidates, without those that are far behind."""
    best = score.argsort(descending=True, stable=True)[:masks]
    return best[score[best] > score.max() - OUT_OF_THE_RACE]


def judge_inputs(grid: Grid, motions: Motions, expected: Expected | None) -> JudgeInputs:
    """A batch of one picture."""
    import torch

    from hybridvo.network.judge import JudgeInputs, expected_information

    def batch(x: Any) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(x))[None]

    last = np.eye(4) if expected is None else expected.T_curr_prev
    depth, usable = batch(grid.depth), batch(grid.usable)
    covariance = None if expected is None else expected.covariance
    return JudgeInputs(
        ray=batch(grid.ray),
        depth=depth,
        target=batch(grid.target),
        flow_variance=batch(grid.flow_variance),
        depth_variance=batch(grid.depth_variance),
        usable=usable,
        log_depth_curr=batch(grid.log_depth_curr),
        static=torch.zeros_like(depth),
        has_static=torch.tensor([False]),
        K=batch(grid.K),
        image_width=torch.tensor([float(grid.width)], dtype=torch.float32),
        T_last=batch(last[:3].astype(np.float32)),
        last_information=expected_information(
            depth, usable, None if covariance is None else batch(covariance)
        ),
        has_last=torch.tensor([expected is not None]),
        **_candidates(motions, np.arange(len(motions.poses))),
    )


def _candidates(motions: Motions, parents: np.ndarray) -> dict[str, Any]:
    import torch

    return {
        "owner": torch.zeros(len(motions.poses), dtype=torch.int64),
        "parent": torch.as_tensor(parents, dtype=torch.int64),
        "pose": torch.as_tensor(motions.poses, dtype=torch.float32),
        "flow_noise": torch.as_tensor(motions.flow_noise, dtype=torch.float32),
        "depth_noise": torch.as_tensor(motions.depth_noise, dtype=torch.float32),
    }


def _joined(first: JudgeInputs | None, second: JudgeInputs) -> JudgeInputs:
    """The candidates of both, of one picture."""
    import torch

    if first is None:
        return second
    return replace(
        second,
        **{
            name: torch.cat([getattr(first, name), getattr(second, name)])
            for name in ("owner", "parent", "pose", "flow_noise", "depth_noise")
        },
    )
