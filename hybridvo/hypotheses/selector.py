"""The second look: a judge of pictures says which motion is the world and where the world is, the
best few motions are fitted again inside its masks, and it judges old and new ones together. Where
it trusts none it may propose one of its own, which then takes part like every other.

The judge is handed in (:class:`PictureJudge`); this room knows no network.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hybridvo.geometry import invert, pose_matrix, se3_log
from hybridvo.hypotheses import search
from hybridvo.hypotheses.confidence import REFERENCE_WIDTH, probability_right
from hybridvo.hypotheses.generate import CoarseSearch, Grid, fit_in_mask
from hybridvo.refinement import kernels, solver
from hybridvo.refinement.covariance import symmetric
from hybridvo.refinement.options import RefinementOptions
from hybridvo.types import FramePair

__all__ = [
    "PROPOSED",
    "Decision",
    "Expected",
    "Motions",
    "Opinion",
    "PictureJudge",
    "Proposal",
    "decide",
    "mask_weights",
    "nearest_motion",
]

REFITS = 2
"""Motions that are fitted again inside their masks."""
LOOKS = 3
"""Most rounds of fitting and judging. Only a fit that differs from every motion of the search goes
into another round, inside the mask that is drawn about it."""
LOOKS_MORE = 2
"""The same after a proposal has joined."""
SAME_MOTION = 8.0
"""Squared difference, in standard deviations of the fit inside a mask, up to which a motion of the
search is taken for the same one (80 % quantile of chi-square with 6 degrees of freedom). Then the
mask removes no bias, only pixels, and the motion is fitted on all of them. On development pairs
with independent noise the difference stays below 5 and all pixels are better by a tenth; where
movers have bent the fit it is tens to thousands and the mask is better by half."""
LEAST_TRUST = 0.5
"""Probability of being right below which the classical choice stands: there the two err alike."""
LEAST_TRUST_PROPOSED = 0.15
"""The same with a proposal in the race. Between this and 0.5 the judge's best was right in 11 and
the classical choice in 7 of 15 development answers; one that trusts nothing at all stays out."""
CONSULT = 0.94, 0.975
"""Probability of being right, by :mod:`hybridvo.hypotheses.confidence`, below which the judge is
asked
for a proposal: of a flow alone, and of one that states its own variance, as estimated flow does.
Higher than where an answer is degraded, the more where the flow is bent: of 120 development pairs
with DIS flow 7 are wrong with 0.94 (16 asked), 5 with 0.975 (29 asked); of 96 pairs of cells with
independent noise 23 ask with 0.94, 35 with 0.97."""
UNDISPUTED = 0.7, 0.85
"""Share of the picture above which the answer needs that probability only not to be asked about: a
proposal costs more than all the rest, and none of the 9 development answers with so large a share
that were judged was wrong."""
PROPOSED = (0.77, 0.91)
"""Probabilities to be static between which the weights of a proposal grow from 0 to 1. Stricter
than for the judge's masks: on 120 development pairs with DIS flow 12 answers were wrong so, and 15
with the ramp of the masks."""
LEAST_FLOW_NOISE = 0.02
"""px: what even true flow may differ by (rounding, edges of pixels)."""
LEAST_MASK = 0.02
"""Share of the usable pixels that a mask must keep for a fit inside it."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Candidate motions of one pair.

    Args:
        poses: (N, 3, 4) T_curr_prev. flow_noise: (N,) px. depth_noise: (N,) of log depth.
    """

    poses: np.ndarray
    flow_noise: np.ndarray
    depth_noise: np.ndarray


@dataclass(frozen=True, eq=False)
class Expected:
    """The motion that those before let expect: a weak prior.

    Args:
        T_curr_prev: (4, 4).
        covariance: (6, 6) of ``Exp(delta) T_curr_prev``, translation first, m^2 and rad^2; None
            where nobody knows how well it holds.
    """

    T_curr_prev: np.ndarray
    covariance: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Opinion:
    """What the judge says after a look.

    Args:
        score: (N,) of all candidates so far; larger is more likely the world.
        best: (R,) int64, the candidates in whose masks it is worth to fit.
        mask: (R, h, w) for each of them the probability of every pixel to be static world.
        trust: probability that the candidate with the largest score is right.
        memory: whatever the judge wants back for the next look.
    """

    score: np.ndarray
    best: np.ndarray
    mask: np.ndarray
    trust: float = 0.0
    memory: Any = None


@dataclass(frozen=True, eq=False)
class Proposal:
    """A motion that was seen, not searched.

    Args:
        T_curr_prev: (4, 4).
        static: (h, w) probability of every pixel to be static world, over the whole picture at any
            resolution.
    """

    T_curr_prev: np.ndarray
    static: np.ndarray


@runtime_checkable
class PictureJudge(Protocol):
    """Judges the motions of a pair by what they leave unexplained, pixel by pixel."""

    def first_look(
        self, grid: Grid, motions: Motions, expected: Expected | None, masks: int
    ) -> Opinion:
        """Opinion of the motions of the search, with masks for the best of them.

        Args:
            grid: the pixels.
            motions: N of the search.
            expected: what the motions before say, or None.
            masks: how many masks are wanted; R is the smaller of it and N.
        """

    def look_again(self, before: Opinion, refits: Motions, parents: np.ndarray) -> Opinion:
        """Opinion of all candidates, with the mask of the best one where it is a new one.

        Args:
            before: the opinion before.
            refits: R fits inside masks of that opinion; they follow its candidates.
            parents: (R,) int64, the motion of the search that each goes back to.
        """

    def propose(self, pair: FramePair) -> Proposal | None:
        """A motion of the judge's own, or None; asked only where it trusts no candidate."""

    def look_with(
        self, before: Opinion, static: np.ndarray, refits: Motions, parents: np.ndarray, masks: int
    ) -> Opinion:
        """Opinion of all candidates anew, in the light of where a proposal sees the static world.

        Args:
            before: the opinion before.
            static: (h, w) probability of every pixel of the grid to be static world.
            refits: R fits more; they follow the candidates so far.
            parents: (R,) int64, the motion of the search that each goes back to.
            masks: how many masks are wanted, of the best of all candidates.
        """


@dataclass(frozen=True, eq=False)
class Decision:
    """Candidates, and which of them is the world.

    Args:
        poses: (N + R, 3, 4). facts: (N + R, :data:`hybridvo.hypotheses.search.FACTS`).
        score: (N + R,).
        best: index of the world.
        mask: (h, w) weights that it was fitted with, or None for a motion of the search.
        kept: share of the usable pixels' weight that the mask leaves.
        trust: probability that it is right. abstained: the classical choice stands.
    """

    poses: np.ndarray
    facts: np.ndarray
    score: np.ndarray
    best: int
    mask: np.ndarray | None
    kept: float
    trust: float
    abstained: bool


def mask_weights(probability: np.ndarray, ramp: tuple[float, float] = (0.4, 0.9)) -> np.ndarray:
    """Weights of a fit from probabilities to be static: 0 below the ramp, 1 above it."""
    low, high = ramp
    return np.clip((probability - low) / (high - low), 0.0, 1.0).astype(np.float32)


def decide(
    judge: PictureJudge,
    found: CoarseSearch,
    pair: FramePair,
    classical: np.ndarray,
    expected: Expected | None,
    options: RefinementOptions,
) -> Decision:
    """Judge, fit the best again inside their masks, judge again.

    Args:
        judge: of pictures.
        found: motions of the search.
        pair: that they were found in.
        classical: (N,) scores of the hand-made judge, for when the judge trusts nothing.
        expected: what the motions before say of this one, or None.
        options: of the refinement.
    """
    race = _Race(judge, found, options)
    motions = _motions(found.poses, found.facts)
    opinion = judge.first_look(found.grid(pair), motions, expected, REFITS)
    for _ in range(LOOKS):
        opinion = race.run(opinion, _in_masks(race, opinion))
        if race.best < race.known or race.same is not None:
            break
    proposal = judge.propose(pair) if race.in_doubt(pair) else None
    if proposal is not None:
        static = race.found.on_grid(proposal.static)
        opinion = race.run(opinion, [_entry(race, proposal.T_curr_prev, static)], static)
        for _ in range(LOOKS_MORE):
            opinion = race.run(opinion, _in_masks(race, opinion))
            if race.best < race.known or race.same is not None:
                break
    least = LEAST_TRUST if proposal is None else LEAST_TRUST_PROPOSED
    best, abstained = race.best, race.trust < least
    if abstained:
        best = int(np.argmax(classical))
    elif race.same is not None:
        best = race.same
    mask = race.masks[best]
    kept = 1.0 if mask is None else race.kept(mask)
    score = np.nan_to_num(opinion.score, nan=-np.inf)
    return Decision(
        np.stack(race.poses), np.stack(race.facts), score, best, mask, kept, race.trust, abstained
    )


_Entry = tuple[np.ndarray, np.ndarray, int]
"""Start (3, 4), weights (h, w) and motion of the search of a fit to come."""


class _Race:
    """Candidates so far, and which of them is ahead."""

    def __init__(
        self, judge: PictureJudge, found: CoarseSearch, options: RefinementOptions
    ) -> None:
        self.judge, self.found, self.options = judge, found, options
        self.poses, self.facts = list(found.poses), list(found.facts)
        self.parents = list(range(len(self.poses)))
        self.masks: list[np.ndarray | None] = [None] * len(self.poses)
        self.known = self.best = 0
        self.same: int | None = None
        self.trust = 0.0
        self._usable = found.samples[kernels.W, : found.count]

    def kept(self, weights: np.ndarray) -> float:
        """Share of the usable pixels' weight that a mask leaves."""
        return float(self._usable @ weights.reshape(-1)) / float(self._usable.sum())

    def in_doubt(self, pair: FramePair) -> bool:
        """Whether the candidate ahead is not probable enough to go without a proposal."""
        mask, fact = self.masks[self.best], self.facts[self.best]
        kept = 1.0 if mask is None else self.kept(mask)
        noise_px = float(fact[search.FLOW_NOISE]) * REFERENCE_WIDTH / pair.prev.camera.width
        share = float(fact[search.SHARE]) * kept
        usual = CONSULT[pair.flow_variance is not None]
        needed = UNDISPUTED[1] if share > UNDISPUTED[0] else usual
        return probability_right(self.trust, noise_px, share) < needed

    def run(
        self, opinion: Opinion, entries: list[_Entry], static: np.ndarray | None = None
    ) -> Opinion:
        """Fit the entries, let the judge look at all candidates, see who is ahead.

        ``static``: where a proposal sees the world; then the judge sees all of them anew.
        """
        self.known = len(self.poses)
        for start, weights, parent in entries:
            if self.kept(weights) < LEAST_MASK:
                continue
            pose, fact = fit_in_mask(
                self.found.samples, weights, self.found.picture.K, start, self.options.cutoff
            )
            if np.isfinite(pose).all() and fact[search.SHARE] > 0:
                self.poses.append(pose)
                self.facts.append(fact)
                self.parents.append(parent)
                self.masks.append(weights)
        refits = _motions(
            np.reshape(self.poses[self.known :], (-1, 3, 4)), np.array(self.facts[self.known :])
        )
        parents = np.array(self.parents[self.known :], np.int64)
        if static is None:
            opinion = self.judge.look_again(opinion, refits, parents)
        else:
            opinion = self.judge.look_with(opinion, static, refits, parents, REFITS)
        self.best = int(np.argmax(np.nan_to_num(opinion.score, nan=-np.inf)))
        self.trust = float(np.nan_to_num(opinion.trust))
        mask = self.masks[self.best]
        self.same = None
        if mask is not None:
            fit = self.poses[self.best], self.facts[self.best]
            self.same = _same(self.found, mask, *fit, self.options)
        return opinion


def _in_masks(race: _Race, opinion: Opinion) -> list[_Entry]:
    """The best candidates of an opinion, each with its mask."""
    return [
        (race.poses[k], mask_weights(probability), race.parents[k])
        for k, probability in zip(opinion.best, opinion.mask, strict=True)
    ]


def _entry(race: _Race, T_curr_prev: np.ndarray, static: np.ndarray) -> _Entry:
    """A proposal as a fit to come; it goes back to the motion of the search nearest to it."""
    start = np.ascontiguousarray(T_curr_prev[:3], dtype=np.float64)
    found = race.found
    parent = nearest_motion(found.poses, start, found.depth_scale)
    return start, mask_weights(static, PROPOSED), parent


def nearest_motion(poses: np.ndarray, pose: np.ndarray, depth_scale: float) -> int:
    """Index of the motion (N, 3, 4) nearest to another (3, 4); metres count 1 / depth radians."""
    T = pose_matrix(pose)
    steps = np.array([se3_log(T @ invert(pose_matrix(P))) for P in poses])
    length = (steps * np.array([depth_scale] * 3 + [1.0] * 3)) ** 2
    return int(np.argmin(length.sum(axis=1)))


def _same(
    found: CoarseSearch,
    mask: np.ndarray,
    pose: np.ndarray,
    fact: np.ndarray,
    options: RefinementOptions,
) -> int | None:
    """Index of the motion of the search that a fit inside a mask differs from by chance only.

    A fit on all pixels that differs by more has been bent by pixels outside of the mask (Hausman's
    test of an efficient estimate by a robust one).
    """
    n = found.count
    samples = found.samples.copy()
    samples[kernels.W, :n] *= mask.reshape(-1)
    noise = np.empty(3, np.float32)
    sf = max(float(fact[search.FLOW_NOISE]), LEAST_FLOW_NOISE)
    solver.set_noise(sf, float(fact[search.DEPTH_NOISE]), options.cutoff, noise)
    sums = np.zeros(kernels.SUMS)
    solver.evaluate(samples, n, pose, found.picture.K, noise, solver.new_work(), sums)
    information = symmetric(sums[:21])
    T = pose_matrix(pose)
    steps = np.array([se3_log(T @ invert(pose_matrix(P))) for P in found.poses])
    gaps = np.einsum("ni,ij,nj->n", steps, information, steps)
    return int(np.argmin(gaps)) if gaps.min() < SAME_MOTION else None


def _motions(poses: np.ndarray, facts: np.ndarray) -> Motions:
    facts = np.reshape(facts, (-1, search.FACTS))
    return Motions(poses, facts[:, search.FLOW_NOISE], facts[:, search.DEPTH_NOISE])
