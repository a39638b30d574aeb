"""What numba and torch must say alike: the cost behind the camera, inliers, and the status."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from hybridvo.batches import refine_batch
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Reason, State
from hybridvo.core.torch_geometry import se3
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.solver import kernels
from hybridvo.solver import refine_flow as refinement
from hybridvo.solver.noise_estimation import Noise
from hybridvo.solver.pixels import PixelGrid
from hybridvo.solver.status import FitSummary, status_of
from hybridvo.solver.torch import factors
from tests import worlds

NOISE = Noise(0.3, 0.02)
AHEAD_M = (0.0, 2.0, 4.0, 5.0, 5.5, 6.0, 8.0, 30.0)
"""How far the camera is moved ahead; the farthest wall is 6 m away."""


def noisy_world(movers: int = 0, seed: int = 0) -> tuple[FramePair, np.ndarray]:
    return worlds.world(
        noise=NOISE, movers=movers, seed=seed, texture=False, second_depth=False
    )


def ahead(T: np.ndarray, metres: float) -> np.ndarray:
    """A motion after which the camera is farther ahead."""
    moved = T.copy()
    moved[2, 3] -= metres
    return moved


def external_weights(pair: FramePair) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform(0.2, 2.0, pair.prev.camera.shape).astype(np.float32)


def full_cost(pair: FramePair, T: np.ndarray) -> float:
    grid = PixelGrid(pair, external_weights(pair))
    weighting = kernels.residual_noise(*NOISE, 3.0)
    return float(grid.full_pass(T[:3], weighting, 16).totals[:, kernels.COST].sum())


def torch_cost(pair: FramePair, T: np.ndarray) -> float:
    weights = torch.from_numpy(external_weights(pair))[None]
    pixels = factors.gather_pixels(PairBatch.from_pairs([pair]), weights)
    model = factors.ResidualModel(torch.tensor([list(NOISE)]), 3.0)
    return float(
        factors.linearize(pixels, se3(torch.from_numpy(T)[None]), model).cost
    )


def test_the_cost_does_not_fall_when_the_camera_moves_past_the_scene() -> None:
    pair, T = noisy_world()
    costs = [full_cost(pair, ahead(T, metres)) for metres in AHEAD_M]
    assert costs[-1] == pytest.approx(0.5 * 9 * external_weights(pair).sum(), 1e-4)
    falls = np.diff(costs)
    assert falls.min() > -1e-5 * costs[-1]


@pytest.mark.parametrize("metres", AHEAD_M)
def test_the_cost_is_that_of_torch_wherever_the_pixels_are(metres: float) -> None:
    pair, T = noisy_world(movers=1)
    moved = ahead(T, metres)
    assert full_cost(pair, moved) == pytest.approx(
        torch_cost(pair, moved), rel=1e-4
    )


@pytest.mark.parametrize("cutoff", [3.0, 2.0, 1.0])
def test_inliers_are_the_weight_within_the_cutoff(cutoff: float) -> None:
    pair, T = noisy_world(movers=3)
    options = RefineOptions(cutoff=cutoff)
    weights = external_weights(pair)
    start = refinement.Selection(T)
    ours = refinement.refine_pair(pair, start, weights=weights, options=options)
    theirs = refine_batch(
        PairBatch.from_pairs([pair]),
        torch.from_numpy(T)[None],
        torch.from_numpy(weights)[None],
        options=options,
    )
    assert ours.inlier_ratio == pytest.approx(
        float(theirs.inlier_ratio[0]), abs=0.03
    )
    # of the movers none, of the others as many as a normal error in two dimensions has
    expected = 1 - math.exp(-0.5 * cutoff**2)
    static = ours.weights > 0.01
    ratio = weights[static].sum() / weights.sum()
    assert ours.inlier_ratio == pytest.approx(ratio * expected, abs=0.08)


RIGHT = FitSummary(
    is_determined=True,
    inlier_ratio=0.8,
    followers=900.0,
    converged=True,
    max_steps=5,
)
JUDGED = {
    "right": ({}, State.OK, Reason.NONE),
    "open": ({"is_determined": False}, State.FAILED, Reason.DEGENERATE_GEOMETRY),
    "few": ({"inlier_ratio": 0.01}, State.FAILED, Reason.LOW_INLIERS),
    "a handful": ({"followers": 5.0}, State.FAILED, Reason.LOW_INLIERS),
    "far": ({"converged": False}, State.DEGRADED, Reason.SOLVER_DIVERGED),
}


@pytest.mark.parametrize("case", JUDGED)
def test_the_status_follows_from_the_fit(case: str) -> None:
    changed, state, reason = JUDGED[case]
    status = status_of(RIGHT._replace(**changed), None)
    assert (status.state, status.reason) == (state, reason)


def test_a_handful_of_followers_is_refused_by_either() -> None:
    """Thirty pixels, of which each but three has a motion of its own."""
    pair, T = noisy_world()
    rng = np.random.default_rng(1)
    valid = np.zeros(pair.prev.camera.shape, bool)
    chosen = rng.permutation(valid.size)[:30]
    valid.flat[chosen] = True
    flow = np.array(pair.flow).reshape(-1, 2)
    flow[chosen[3:]] += rng.uniform(-40, 40, (27, 2))
    pair = replace(pair, flow=flow.reshape(pair.flow.shape), flow_valid=valid)
    ours = refinement.refine_pair(pair, refinement.Selection(T))
    weights = torch.rand(1, *pair.prev.camera.shape) + 1
    theirs = refine_batch(
        PairBatch.from_pairs([pair]), torch.from_numpy(T)[None], weights
    )
    for status in (ours.status, theirs.status[0]):
        assert not status.ok
