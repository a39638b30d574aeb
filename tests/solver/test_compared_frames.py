"""What kernels find in two frames at a motion: noise, gain, depths around a point."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from hybridvo.core.options import RefineOptions
from hybridvo.solver.image_factor import ImageFactor
from hybridvo.solver.image_kernels import GREY_NOISE_FLOOR
from hybridvo.solver.plane_kernels import fit_noise, non_negative
from tests import worlds

NUMBERS = st.floats(-4, 4).map(lambda x: round(x, 3))


@settings(max_examples=50)
@given(
    arrays.arrays(np.float64, (6, 3), elements=NUMBERS),
    arrays.arrays(np.float64, 6, elements=NUMBERS),
)
def test_least_squares_without_negative_terms_are_those_of_scipy(
    columns: np.ndarray, values: np.ndarray
) -> None:
    found = non_negative(columns.T @ columns, columns.T @ values)
    assert (found >= 0).all()
    _, distance = scipy.optimize.nnls(columns, values)
    # where columns depend on each other several solutions are as good
    assert np.linalg.norm(columns @ found - values) <= distance + 1e-6


@pytest.mark.parametrize(
    "terms", [(0, 0.003, 0), (0, 0, 0.002), (0.002, 0.0, 0.003)]
)
def test_noise_that_grows_with_depth_is_found_beside_outliers(
    terms: tuple[float, ...], rng: np.random.Generator
) -> None:
    z = rng.uniform(0.5, 5, 4000).astype(np.float32)
    a, b, c = terms
    sigma = a + b * z + c * z**2
    lengths = np.abs(sigma * rng.standard_normal(len(z))).astype(np.float32)
    lengths[::10] *= 40
    found = fit_noise(z, lengths, 3.0)
    fitted = found[0] + found[1] * z + found[2] * z**2
    np.testing.assert_allclose(fitted, sigma, rtol=0.15)


def test_the_noise_of_no_distance_that_differs_is_none() -> None:
    z = np.full(50, 2.0, np.float32)
    assert not fit_noise(z, np.zeros(50, np.float32), 3.0).any()


def test_a_change_of_light_is_gain_and_offset() -> None:
    pair, T = worlds.world((96, 128))
    index = np.argwhere(np.ones((80, 110), bool)) + 8
    factor = ImageFactor(
        pair, np.ones((96, 128), np.float32), index[::7], RefineOptions()
    )
    factor._images.image[:] = 0.8 * factor._images.image + 5
    at = factor.first(T)
    np.testing.assert_allclose(at.gain_offset, [0.8, 5], atol=0.05)
    assert at.noise[0] < 2 * GREY_NOISE_FLOOR
