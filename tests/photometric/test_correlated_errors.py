"""Errors that whole parts of a view share."""

from __future__ import annotations

import numpy as np

from hybridvo.photometric.correlated_errors import shared_covariance


def test_the_covariance_of_errors_of_parts_is_that_of_drawn_ones():
    """The mean over both ways to cut the view, each checked by drawing the parts' errors."""
    rng = np.random.default_rng(3)
    effects = rng.normal(size=(8, 8, 2, 6))
    stated = shared_covariance(effects)

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


def test_an_error_of_a_part_is_larger_than_that_of_its_tiles_apart():
    alike = np.ones((8, 8, 1, 6))
    apart = 64.0
    assert shared_covariance(alike)[0, 0] > 4 * apart
