"""A batch stays where its seed is good, and goes as far as the seed may be off."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hybridvo.batches import refine_batch
from hybridvo.core.geometry import ego_flow, ego_flow_error, se3_exp
from hybridvo.core.torch_geometry import se3
from hybridvo.core.types import FramePair, PairBatch
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.tools import PoseSeed
from tests import worlds

NOISE = (0.3, 0.005)
MOVING = 0.62
"""Fraction of the view that an object covers."""


def with_large_object() -> tuple[PairBatch, FramePair, np.ndarray, np.ndarray]:
    """A pair of which most pixels are an object's, its motion and the object's."""
    pair, T = worlds.world(noise=NOISE, texture=False, second_depth=False)
    T_object = se3_exp(np.array([0.3, 0.1, 0.0, 0.0, 0.0, 0.0])) @ T
    cameras = (pair.prev.camera, pair.curr.camera)
    flow = np.array(pair.flow)
    columns = int(MOVING * flow.shape[1])
    noise = flow - ego_flow(pair.prev.depth, T, *cameras)
    of_object = ego_flow(pair.prev.depth, T_object, *cameras) + noise
    flow[:, :columns] = of_object[:, :columns]
    pair = FramePair(pair.prev, pair.curr, flow.astype(np.float32))
    return PairBatch.from_pairs([pair]), pair, T, T_object


def uneven_weights(pair: FramePair) -> torch.Tensor:
    """Weights that say nothing about what moves."""
    rng = np.random.default_rng(2)
    return torch.from_numpy(rng.uniform(0.9, 1.0, (1, *pair.prev.camera.shape)))


def error_px(pair: FramePair, T: np.ndarray, T_true: np.ndarray) -> float:
    return ego_flow_error(
        T, T_true, pair.prev.depth, pair.prev.camera, pair.curr.camera
    )


def refined(
    batch: PairBatch,
    pair: FramePair,
    T: np.ndarray,
    covariance: torch.Tensor | None = None,
) -> np.ndarray:
    start = torch.from_numpy(T)[None]
    seed = PoseSeed(start, uneven_weights(pair), covariance=covariance)
    found = refine_batch(batch, seed)
    return found.T_curr_prev[0].double().numpy()


def test_a_good_seed_is_not_left_for_what_most_pixels_follow() -> None:
    batch, pair, T, T_object = with_large_object()
    seed = se3_exp(np.array([0.004, -0.003, 0.0, 0.0, 0.0, 0.0])) @ T
    assert 0.1 < error_px(pair, seed, T) < 1.0
    assert error_px(pair, T_object, T) > 5
    found = refined(batch, pair, seed)
    assert error_px(pair, found, T) < 0.1


def test_without_a_seed_the_motion_is_sought_far_away() -> None:
    batch, pair, T, _ = with_large_object()
    found = refine_batch(batch, None, uneven_weights(pair))
    assert error_px(pair, found.T_curr_prev[0].double().numpy(), T) > 2


def test_a_seed_that_is_far_off_is_left_as_its_residuals_show() -> None:
    pair, T = worlds.world(noise=NOISE, texture=False, second_depth=False)
    batch = PairBatch.from_pairs([pair])
    far = se3_exp(np.array([0.4, 0.2, 0.0, 0.02, -0.02, 0.0])) @ T
    assert error_px(pair, far, T) > 5
    assert error_px(pair, refined(batch, pair, far), T) < 0.1


def test_the_covariance_of_a_seed_states_how_far_the_motion_is_sought() -> None:
    batch, pair, T, _ = with_large_object()
    seed = se3_exp(np.array([0.004, -0.003, 0.0, 0.0, 0.0, 0.0])) @ T
    small, large = (
        torch.from_numpy(np.diag([std**2] * 3 + [(0.2 * std) ** 2] * 3))[None]
        for std in (0.005, 0.5)
    )
    near = refined(batch, pair, seed, small)
    assert error_px(pair, near, T) < 0.1
    away = refined(batch, pair, seed, large)
    assert error_px(pair, away, T) > 2


def test_a_displacement_is_that_of_perturbed_poses() -> None:
    pair, T = worlds.world(texture=False)
    pixels = factors.gather_pixels(PairBatch.from_pairs([pair]))
    A = np.diag([0.01, 0.02, 0.01, 0.002, 0.001, 0.003])
    covariance = torch.from_numpy(A @ A)[None]
    stated = float(
        factors.displacement(pixels, se3(torch.from_numpy(T)[None]), covariance)
    )
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(300):
        moved = se3_exp(A @ rng.standard_normal(6)) @ T
        cameras = (pair.prev.camera, pair.curr.camera)
        change = ego_flow(pair.prev.depth, moved, *cameras) - pair.flow
        squares.append(np.mean(np.sum(change**2, axis=2)))
    assert stated == pytest.approx(np.sqrt(np.mean(squares)), rel=0.1)
