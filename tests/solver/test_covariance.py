"""The sandwich covariance against errors of known correlation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hybridvo.api import refine
from hybridvo.solver.calibration import LONG_GROWTH
from hybridvo.solver.covariance import ScoreStatistics, motion_covariance
from hybridvo.solver.depths import DepthAgreement
from hybridvo.solver.noise_estimation import Noise
from hybridvo.solver.score_blocks import UPPER, block_sums, long_range
from hybridvo.solver.shared_errors import SharedErrors
from hybridvo_lab.synthetic.noise_scenarios import make_pair

FINE, ROWS, COLUMNS = 4, 7, 16
"""Readings along the side of a tile, and tiles: those of a image of 436x1024."""
GRID = (ROWS * FINE, COLUMNS * FINE)


def flow_jacobian() -> np.ndarray:
    """(rows, columns, 2, 6) of the flow of a curved surface, in radians of the image."""
    v, u = np.mgrid[0 : GRID[0], 0 : GRID[1]]
    a, b = (u - GRID[1] / 2) / GRID[1] * 0.9, (v - GRID[0] / 2) / GRID[1] * 0.9
    i = 1 + 0.6 * np.sin(u / 7) * np.cos(v / 5)
    zero = np.zeros_like(a)
    rows = [
        [i, zero, -a * i, -a * b, 1 + a * a, -b],
        [zero, i, -b * i, -1 - b * b, a * b, a],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


J = flow_jacobian()
H_PIXEL = np.einsum("vuki,vukj->vuij", J, J)
H = H_PIXEL.sum(axis=(0, 1))


def to_tiles(values: np.ndarray) -> np.ndarray:
    rest = values.shape[2:]
    return values.reshape(ROWS, FINE, COLUMNS, FINE, *rest).sum(axis=(1, 3))


def smooth(rng: np.random.Generator, width: int) -> np.ndarray:
    """(rows, columns, 2) of unit variance: white noise averaged over ``width`` readings."""
    pad = width - 1
    noise = rng.standard_normal((GRID[0] + pad, GRID[1] + pad, 2))
    for axis in (0, 1):
        sums = np.cumsum(np.insert(noise, 0, 0.0, axis=axis), axis=axis)
        size = sums.shape[axis] - width
        noise = np.take(sums, range(width, width + size), axis) - np.take(
            sums, range(size), axis
        )
    return noise / width


def answer(
    error: np.ndarray, coherent: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """(error of the least-squares motion, covariance that its residuals give)."""
    motion = np.linalg.solve(H, np.einsum("vuki,vuk->i", J, error))
    residual = error - J @ motion
    scores = to_tiles(np.einsum("vuki,vuk->vui", J, residual))
    tiles = np.concatenate(
        [to_tiles(H_PIXEL)[..., UPPER[0], UPPER[1]], scores], axis=2
    )
    products = np.einsum("vuki,vuk->vui", J, residual).reshape(-1, 6)
    meat = products.T @ products
    # of an error as large as the residuals, along each axis of the image
    pulls = np.zeros((ROWS, COLUMNS, 3, 6))
    pulls[:, :, :2] = residual.std() * to_tiles(J)
    shared = SharedErrors(pulls, coherent)
    statistics = ScoreStatistics(tiles, np.zeros((6, 6)), meat, 1.0, shared)
    still = np.zeros(3)
    found = motion_covariance(statistics, 1.0, 300.0, still, Noise(1.0, 0.0), None)
    assert found.tiles == ROWS * COLUMNS
    return motion, found.covariance


def consistency(width: int, draws: int = 150) -> tuple[float, float]:
    """(mean normalised error squared, mean stated over true variance) of errors so correlated."""
    rng = np.random.default_rng([7, width])
    found = [answer(smooth(rng, width)) for _ in range(draws)]
    motions = np.array([motion for motion, _ in found])
    nees = [m @ np.linalg.solve(C, m) for m, C in found]
    true = motions.T @ motions / draws
    stated = np.mean([C for _, C in found], axis=0)
    return float(np.mean(nees)), float(np.trace(np.linalg.solve(true, stated)) / 6)


def test_independent_errors_give_the_models_own_covariance() -> None:
    nees, ratio = consistency(1)
    # 150 draws: standard error of the mean of chi-square with 6 degrees of freedom 0.28; the scaled
    # part never falls below the model's, which costs a few percent
    assert 4.9 < nees < 7.1
    # sampling of the true covariance, 6 directions x 150 draws: 5 %
    assert 0.85 < ratio < 1.25


@pytest.mark.parametrize("width", [2, FINE])
def test_errors_that_neighbours_share_are_inflated_by_the_right_factor(
    width: int,
) -> None:
    nees, ratio = consistency(width)
    # sums over all readings have width^2 times the variance of independent errors: 4 and 16. Errors
    # as wide as a tile lose about a third of it at the blocks' borders, which the errors that parts
    # share are left to make good
    assert 4.2 < nees < (8.5 if width < FINE else 11)
    assert 0.7 < ratio < 1.6


def test_errors_that_whole_parts_share_are_counted_where_the_fraction_is_known() -> (
    None
):
    nees, without = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        # a tenth of the variance is that of quarters of the view, or of four strips of it
        shape = ((2, 2), (4, 1))[seed % 2]
        parts = rng.standard_normal((*shape, 2))
        tall = np.repeat(parts, -(-GRID[0] // shape[0]), axis=0)[: GRID[0]]
        alike = np.repeat(tall, GRID[1] // shape[1], axis=1)
        error = np.sqrt(0.1) * alike + np.sqrt(0.9) * smooth(rng, 1)
        for coherent, found in ((0.1, nees), (0.0, without)):
            motion, C = answer(error, coherent)
            found.append(motion @ np.linalg.solve(C, motion))
    # the fit takes the shared errors into the motion: its residuals show little of them
    assert np.median(without) > 20
    # 5.3 expected of either shape alone; the mean of both is a little narrow for each
    assert 3.5 < np.median(nees) < 9


def test_reach_by_hand() -> None:
    assert long_range(LONG_GROWTH[0], 112) == 1.0
    assert long_range(math.nan, 112) == 1.0
    # 16 times in two doublings, as with equal errors: with the area, and no faster
    assert long_range(16.0, 64) == pytest.approx(64 / 4)
    assert long_range(1e6, 64) == pytest.approx(64 / 4)
    assert long_range(16.0, 3) == 1.0  # a block is the whole image already
    values = [long_range(g, 112) for g in np.linspace(1, 8, 50)]
    assert np.all(np.diff(values) >= 0)


def test_block_sums_by_hand() -> None:
    s = np.zeros((1, 2, 6))
    s[0, 0, 0], s[0, 1, 0], s[0, 1, 1] = 2.0, -1.0, 3.0
    information = np.zeros((1, 2, 21))
    # half of the unit matrix each
    information[..., np.flatnonzero(UPPER[0] == UPPER[1])] = 0.5
    meats, lost, count = block_sums(
        np.concatenate([information, s], axis=2), np.eye(6)
    )
    assert count == 2
    assert meats[0][:2, :2].tolist() == [[5.0, -3.0], [-3.0, 9.0]]
    # blocks {1}, {1, 2}, {2}, each in two rows, a quarter each: sum (1, 3) of both
    assert meats[1][:2, :2].tolist() == [[3.0, 0.0], [0.0, 9.0]]
    # of the unit matrix: (1/4 + 1/4) and (1/4 + 1 + 1/4) / 2
    assert lost[:2].tolist() == [0.5, 0.75]


def test_depth_noise_that_the_flow_cannot_tell_comes_from_the_second_depth() -> (
    None
):
    # 0.3 m at 100 m: a parallax of 3 px, of which 2 % are lost in 0.5 px of flow noise
    pair, _ = make_pair("far", 6)
    result = refine(pair)
    # the depths differ by 1.2 to 1.41 times the noise, as much of it as interpolation averages
    assert result.depth_noise == pytest.approx(0.02, rel=0.2)


def test_every_error_has_a_name_and_their_sum_is_the_covariance() -> None:
    H_tiles = to_tiles(H_PIXEL)[..., UPPER[0], UPPER[1]]
    rng = np.random.default_rng(2)
    scores = to_tiles(np.einsum("vuki,vuk->vui", J, smooth(rng, 1)))
    tiles = np.concatenate([H_tiles, scores], axis=2)
    pulls = np.zeros((ROWS, COLUMNS, 3, 6))
    pulls[:, :, :2] = to_tiles(J)
    statistics = ScoreStatistics(
        tiles, np.zeros((6, 6)), H, 400.0, SharedErrors(pulls, 0.1)
    )
    t = np.array([0.1, 0.0, -0.2])
    depths = DepthAgreement(ratio=1.3, log_deviation=0.0)
    found = motion_covariance(statistics, 0.5, 300.0, t, Noise(1.0, 0.3), depths)
    assert len(found.errors) == 5
    # 400 pixels that are rounded alike by 2e-5 px, beside px of flow and parallax by log depth
    parallax = 300.0 * np.linalg.norm(t) * 0.5
    fraction = 400 * 2e-5**2 / (1 + (0.3 * parallax) ** 2)
    rounding = found.errors["of rounding"]
    np.testing.assert_allclose(rounding, fraction * np.linalg.inv(H), rtol=1e-6)
    for error in found.errors.values():
        # none of them makes a motion surer, and none is there for nothing
        smallest = np.linalg.eigvalsh(error)[0]
        assert smallest > -1e-12 * np.trace(error) and np.trace(error) > 0
    np.testing.assert_allclose(found.covariance, sum(found.errors.values()))
    # a seed that is kept has other errors, but the same depths
    kept = found.of_seed(np.eye(6)).covariance - np.eye(6)
    along = np.zeros((6, 6))
    along[:3, :3] = math.log(1.3) ** 2 * np.outer(t, t)
    np.testing.assert_allclose(kept, along, atol=1e-12)
