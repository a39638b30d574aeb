"""What earlier frames have shown, as evidence among motions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridvo.core.belief import Belief
from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.options import Options
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.hypotheses.calibration import MEMORY_SURE
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.remembered import memory_scores, on_pixels
from hybridvo.hypotheses.select import Scores, rank_by_scorer
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.solver.points import grid_index

SIZE = (120, 160)
CAMERA = Camera(160.0, 160.0, 79.5, 59.5, height=SIZE[0], width=SIZE[1])
MOTION = se3_exp(np.array([0.02, -0.01, 0.03, 0.004, 0.006, -0.002]))
OTHER = se3_exp(np.array([-0.15, 0.05, 0.0, 0.0, 0.0, 0.03]))
STATIC = np.zeros(SIZE, bool)
STATIC[:, :56] = True
"""A third of the view; the rest goes another way."""


@pytest.fixture(scope="module")
def found() -> HypothesisSet:
    """The motions of a view of which two thirds move."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = (2 + 0.5 * np.sin(u / 9) + 0.4 * np.cos(v / 7)).astype(np.float32)
    flow = np.where(
        STATIC[..., None],
        ego_flow(depth, MOTION, CAMERA, CAMERA),
        ego_flow(depth, OTHER, CAMERA, CAMERA),
    )
    noise = np.random.default_rng(0).normal(0, 0.05, flow.shape)
    frame = Frame(None, depth, CAMERA)
    pair = FramePair(frame, frame, (flow + noise).astype(np.float32))
    return generate(pair, np.eye(4)[None], Options())


def believing(static: np.ndarray, log_odds: float = 3.0) -> Belief:
    """What (H, W) is believed to be static, and all else to move."""
    index = grid_index(SIZE)
    is_static = static[index[..., 0], index[..., 1]]
    return Belief(np.where(is_static, log_odds, -log_odds).astype(np.float16), 5.0)


def inliers_of(found: HypothesisSet, *masks: np.ndarray) -> list[np.ndarray]:
    return [
        on_pixels(found, mask).reshape(found.grid.shape[:2]) > 0.5 for mask in masks
    ]


def test_what_is_static_outweighs_what_is_many(found: HypothesisSet) -> None:
    """Twice as many pixels follow the object: not the fractions."""
    inliers = inliers_of(found, STATIC, ~STATIC)
    right, wrong = memory_scores(found, inliers, believing(STATIC))
    assert right == 0
    assert wrong == pytest.approx(np.log(1 - MEMORY_SURE), abs=0.1)
    again, inverted = memory_scores(found, inliers, believing(~STATIC))
    assert inverted == 0 and again < -3


def test_an_equal_fraction_is_no_evidence(found: HypothesisSet) -> None:
    half = STATIC.copy()
    half[::2] = False
    inliers = inliers_of(found, half, half)
    np.testing.assert_array_equal(
        memory_scores(found, inliers, believing(STATIC)), [0, 0]
    )
    unknown = Belief(np.zeros_like(believing(STATIC).log_odds))
    inliers = inliers_of(found, STATIC, ~STATIC)
    np.testing.assert_array_equal(memory_scores(found, inliers, unknown), [0, 0])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=4), st.floats(0, 4))
def test_memory_scores_are_bounded(
    found: HypothesisSet, fractions: list[float], log_odds: float
) -> None:
    rng = np.random.default_rng(0)
    noise = rng.random(found.grid.shape[:2])
    inliers = [noise < fraction for fraction in fractions]
    scores = memory_scores(found, inliers, believing(STATIC, log_odds))
    assert scores.max() == 0
    assert scores.min() >= np.log(1 - MEMORY_SURE)


def test_the_ranking_follows_the_memory(found: HypothesisSet) -> None:
    """A scorer that is in favour of what most pixels follow, by two nats."""

    def scorer(candidates, refits):
        ratios = [candidate.inlier_ratio for candidate in candidates]
        return Scores(2.0 * (np.array(ratios) == max(ratios)), {})

    options = Options()
    alone = rank_by_scorer(found, scorer, options)
    np.testing.assert_allclose(alone.poses[alone.best], OTHER[:3], atol=0.02)
    remembered = rank_by_scorer(found, scorer, options, believing(STATIC))
    best = remembered.poses[remembered.best]
    np.testing.assert_allclose(best, MOTION[:3], atol=2e-3)
    assert len(remembered.candidates) == len(alone.candidates)
