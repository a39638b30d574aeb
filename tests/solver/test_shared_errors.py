"""Errors that whole parts of a view share."""

from __future__ import annotations

import numpy as np
import pytest

from hybridvo.solver import kernels
from hybridvo.solver.noise_estimation import FLOW_NOISE_FLOOR_PX
from hybridvo.solver.pixels import PixelGrid
from hybridvo.solver.shared_errors import (
    coherent_fraction,
    parts_of_tiles,
    shared_covariance,
    tile_pulls,
)
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair

PARTS = parts_of_tiles(8, 8)
"""Of a view of 8 x 8 tiles."""


def test_the_covariance_of_errors_of_parts_is_that_of_drawn_ones():
    """The mean over both ways to cut the view, each checked by drawing the parts' errors."""
    rng = np.random.default_rng(3)
    effects = rng.normal(size=(8, 8, 2, 6))
    stated = shared_covariance(effects.reshape(64, 2, 6), PARTS)

    drawn = []
    for shape in ((2, 2), (4, 1)):
        errors = rng.normal(size=(20_000, *shape, 2))
        tall = np.repeat(errors, 8 // shape[0], axis=1)
        whole = np.repeat(tall, 8 // shape[1], axis=2)
        motion = np.einsum("nrcm,rcmp->np", whole, effects)
        drawn.append(motion.T @ motion / len(motion))
    expected = np.mean(drawn, axis=0)
    # 40 000 draws: each entry to about 1 % of the largest
    np.testing.assert_allclose(stated, expected, atol=0.04 * np.abs(expected).max())


STILL = Scenario(moving=0.0, outliers=0.0, depth_noise=0.0, flow_noise_px=0.0)
"""Exact flow and depth: what is added to them is the error."""


def still_grid(error=0.0, depth_factor=1.0):
    """The pixels of a static pair whose flow (H, W, 2) errs, and its pose (3, 4)."""
    pair, truth = make_pair(STILL, 7, 109, 256)
    pair.flow[:] += error
    pair.prev.depth[:] *= depth_factor
    grid = PixelGrid(pair, None, 109 * 256)
    return grid, truth["T_curr_prev"][:3].copy()


def fraction_of(error, flow_px):
    grid, pose = still_grid(error)
    noise = kernels.residual_noise(flow_px, 0.001, 3.0)
    rows, columns, stride = grid.shape
    assert stride == 1
    return coherent_fraction(grid.samples, rows, columns, pose, grid.K, noise)


def test_the_fraction_is_what_neighbours_share():
    rng = np.random.default_rng(2)
    white = rng.normal(0, 0.1, (109, 256, 2))
    # by chance: of 28 000 pixels 0.1 % at a standard error of 0.1 %
    assert fraction_of(white, 0.1) < 0.003
    # 0.05^2 of 0.05^2 + 0.1^2 is common to all in the mean over two diagonals, of which more or
    # less lies across the parallax
    alike = [0.05 * np.array([1.0, sign]) for sign in (1, -1)]
    found = [fraction_of(white + error, 0.112) for error in alike]
    assert np.mean(found) == pytest.approx(0.2, abs=0.02)


def test_exact_flow_shares_nothing():
    """The smallest noise is stated where there is none: rounding is no shared error."""
    assert fraction_of(0.0, FLOW_NOISE_FLOOR_PX) == 0.0


def test_errors_over_few_pixels_are_not_shared_by_parts():
    rng = np.random.default_rng(3)
    # blocks of four pixels, as those that are compared: each has its own error
    blocks = rng.normal(0, 0.1, (28, 64, 2))
    error = np.kron(blocks, np.ones((4, 4, 1)))[:109]
    # 28 * 64 blocks: standard error of their correlation 1.7 %
    assert fraction_of(error, 0.1) < 0.06


@pytest.mark.parametrize("kind", ["x", "y", "depth"])
def test_a_pull_is_what_an_error_does_to_the_score(kind):
    flow_px = 0.2
    log_depth = 0.005
    noise = kernels.residual_noise(flow_px, log_depth, 3.0)
    tile = 16
    grid, pose = still_grid()
    number = ["x", "y", "depth"].index(kind)
    pulls = tile_pulls(
        grid.samples, grid.shape, pose, grid.K, noise, tile, (7, 16)
    )[:, :, number]

    # a tenth of a standard deviation, for the score is linear in small errors
    part = 0.1
    error = part * flow_px * np.eye(3)[number, :2]
    # flow that fits a longer depth errs as a shorter depth does
    factor = np.exp(-part * log_depth) if kind == "depth" else 1.0
    wrong, _ = still_grid(error.astype(np.float32), np.float32(factor))
    found = wrong.full_pass(pose, noise, tile)
    scores = (
        found.tiles[..., kernels.HESSIAN_SUMS :]
        / found.totals[:, kernels.EXTERNAL_SUM].sum()
    )
    scale = np.abs(pulls).max(axis=(0, 1))
    # the robust weights fall by 2 d^2 / c^2: 0.2 %; single precision
    np.testing.assert_allclose(scores / part / scale, pulls / scale, atol=0.02)
