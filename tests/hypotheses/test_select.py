"""Selection: what is done with a scorer's answers, the cues, and the pretrained PWVO."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hybridvo.api import estimate, refine
from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow
from hybridvo.core.options import Options
from hybridvo.core.results import MotionPrior, RelativePose, State
from hybridvo.core.types import FramePair
from hybridvo.hypotheses.calibration import NO_MOTION
from hybridvo.hypotheses.generate import generate, static_grid
from hybridvo.hypotheses.select import (
    Candidate,
    RefitStart,
    Scores,
    rank_by_scorer,
    score_margin,
    select_from,
)
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.judge.probability import choice_probability
from hybridvo.judge.verdict import believed
from hybridvo.solver.refine_flow import Selection, refine_pair
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair

SCENARIO = Scenario(moving=0.6, objects=1, flow_noise_px=0.3, depth_noise=0.01)
SIZE = {"height": 96, "width": 224}
IDENTITY = np.eye(4)[None]


class Oracle:
    """A scorer that is told where the scene is static; it prefers the latest refit, or none.

    Fits start from the motion of the search, or from ``start``.
    """

    def __init__(
        self,
        static: np.ndarray,
        refits: bool,
        margin: float = 5.0,
        start: np.ndarray | None = None,
    ) -> None:
        self.static, self.refits, self.margin = static, refits, margin
        self.start = start

    def __call__(self, candidates: Sequence[Candidate], refits: int) -> Scores:
        count = len(candidates)
        score = np.zeros(count)
        score[-1 if self.refits else 0] = self.margin
        starts = {}
        for number in range(min(refits, count)):
            pose = candidates[number].pose if self.start is None else self.start
            starts[number] = RefitStart(pose, self.static)
        return Scores(score, starts)


@pytest.fixture(scope="module")
def case() -> tuple[HypothesisSet, FramePair, dict]:
    """A pair of which one object holds 60 %, and the motions found in it."""
    pair, truth = make_pair(SCENARIO, 4, **SIZE)
    found = generate(pair, IDENTITY, Options())
    return found, pair, truth


def gap(T: np.ndarray, pair: FramePair, truth: dict) -> float:
    """Ego-flow error, px."""
    camera = pair.prev.camera
    flows = [
        ego_flow(truth["depth_true"], P, camera, camera)
        for P in (T, truth["T_curr_prev"])
    ]
    return float(np.linalg.norm(flows[0] - flows[1], axis=2).mean())


def refined(case, scorer: Oracle) -> RelativePose:
    found, pair, _ = case
    chosen = select_from([rank_by_scorer(found, scorer, Options())])
    return fitted(found, pair, chosen)


def fitted(
    found: HypothesisSet, pair: FramePair, chosen: Selection
) -> RelativePose:
    """A selected motion, refined inside its mask."""
    options = Options()
    grid = static_grid(found, pair, chosen.mask, None, options.refine)
    return believed(refine_pair(pair, chosen, grid), MIN_PROBABILITY)


def static_mask(case) -> np.ndarray:
    """The true mask on the grid of the search."""
    found, _, truth = case
    stride = found.grid.shape[2]
    moving = truth["moving"][stride // 2 :: stride, stride // 2 :: stride]
    return (~moving).astype(np.float32)


def test_the_camera_is_fitted_where_the_mask_says(case) -> None:
    _, pair, truth = case
    answer = refined(case, Oracle(static_mask(case), refits=True))
    weighted = refine(pair, weights=(~truth["moving"]).astype(np.float32))
    assert (
        answer.hypotheses[0].source == "refit" and answer.status.state is State.OK
    )
    # the mask is drawn on every stride-th pixel: its edges differ, the motion hardly
    assert (
        gap(answer.T_curr_prev, pair, truth)
        < gap(weighted.T_curr_prev, pair, truth) + 0.02
    )
    # 60 % of the pixels move: the ratio is that of the whole image
    assert 0.2 < answer.inlier_ratio < 0.5


def test_a_mask_that_leaves_too_little_makes_no_refit(case) -> None:
    found, _, _ = case
    nowhere = np.zeros(found.grid.shape[:2], np.float32)
    ranking = rank_by_scorer(found, Oracle(nowhere, refits=True), Options())
    assert len(ranking.candidates) == len(ranking.score) == len(found.motions)
    somewhere = rank_by_scorer(found, Oracle(static_mask(case), True), Options())
    refits = Options().select.refits
    more = len(somewhere.candidates) - len(found.motions)
    assert more == min(refits, len(found.motions))


def test_a_score_that_is_no_number_is_never_the_best(case) -> None:
    found, _, _ = case
    score = np.zeros(len(found.motions))
    score[0] = np.nan

    def scorer(candidates: Sequence[Candidate], refits: int) -> Scores:
        return Scores(score, {})

    assert rank_by_scorer(found, scorer, Options()).best != 0


def test_a_small_gap_is_degraded_with_its_probability_and_a_wide_covariance(
    case,
) -> None:
    found, pair, _ = case
    nowhere = np.zeros(found.grid.shape[:2], np.float32)
    sure, chosen = (
        select_from(
            [rank_by_scorer(found, Oracle(nowhere, False, margin), Options())]
        )
        for margin in (5.0, 0.01)
    )
    probability = choice_probability(chosen.evidence)
    assert probability < MIN_PROBABILITY < choice_probability(sure.evidence)
    answer = fitted(found, pair, chosen)
    assert answer.status.state is State.DEGRADED and not answer.ok and answer.usable
    assert answer.probability == probability


def test_what_one_flow_shows_stays_a_rival_in_the_next(case) -> None:
    """A motion that is alone in its flow is doubted where the first flow showed another."""
    found, _, _ = case
    options = Options()
    mask = static_mask(case)
    first = rank_by_scorer(found, Oracle(mask, False, margin=4.0), options)
    other = replace(found, motions=(found.motions[-1],))
    second = rank_by_scorer(other, Oracle(mask, False, margin=4.5), options)
    alone = select_from([second])
    beside = select_from([first, second])
    assert beside.T_curr_prev is not None
    assert alone.evidence.margin > 4.0
    assert beside.evidence.margin == pytest.approx(0.5)
    # what is known of the other motion's place is evidence as well
    assert alone.evidence.log_rival_share < beside.evidence.log_rival_share
    narrow = choice_probability(beside.evidence)
    wide = choice_probability(beside.evidence._replace(margin=4.5))
    assert narrow < wide


@pytest.mark.slow
def test_the_pretrained_pwvo_chooses_no_worse_than_the_cues() -> None:
    # one object on 60 % of the image, development seeds in which each of them fails once
    found: dict[str, list[float]] = {"classical": [], "hybrid-flow": []}
    for seed in range(500, 512):
        pair, truth = make_pair("one60", seed)
        for method, gaps in found.items():
            gaps.append(gap(estimate(pair, method=method).T_curr_prev, pair, truth))
    wrong = {method: sum(g > 1 for g in gaps) for method, gaps in found.items()}
    assert wrong["hybrid-flow"] <= wrong["classical"] <= 2
    assert np.median(found["hybrid-flow"]) <= 1.05 * np.median(found["classical"])


def test_a_prior_needs_a_covariance() -> None:
    with pytest.raises(InputError, match="covariance"):
        MotionPrior(np.eye(4), None)
    with pytest.raises(InputError, match="positive definite"):
        MotionPrior(np.eye(4), np.zeros((6, 6)))
    with pytest.raises(InputError, match="expected MotionPrior, got ndarray"):
        estimate(make_pair(SCENARIO, 4, **SIZE)[0], prior=np.eye(4))


def test_only_another_motion_is_a_rival(case) -> None:
    found, _, _ = case
    poses = [*found.poses, found.poses[0]]  # the first one found twice
    score = np.zeros(len(poses))
    score[[0, -1]] = 3.0
    assert score_margin(found, poses, score) == 3.0
    # a rival that looks as good leaves less to believe
    score[1] = 2.9
    assert score_margin(found, poses, score) == pytest.approx(0.1)
    # alone it is measured against none of them being right
    assert (
        score_margin(found, [poses[0], poses[-1]], score[[0, -1]])
        == 3.0 - NO_MOTION
    )
