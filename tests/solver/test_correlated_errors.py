"""The information of residuals whose errors neighbours, or whole parts of a view, share."""

from __future__ import annotations

import numpy as np

from hybridvo.core.options import RefineOptions
from hybridvo.solver.correlated_errors import estimate_information, view_of
from hybridvo.solver.products import weighted_products
from hybridvo.solver.shared_errors import shared_covariance

SHAPE = (64, 64)
"""Of an image of 8 x 8 tiles."""


def independent(rng, view):
    """Errors of unit variance, one for each residual."""
    return rng.normal(size=len(view.tile_of))


def alike_in_tiles(rng, view):
    """Errors of unit variance, one for each tile."""
    return rng.normal(size=64)[view.tile_of]


def linear_fit(errors):
    """Residuals of a linear model with 6 + 2 unknowns at its optimum, and their view."""
    rng = np.random.default_rng(5)
    index = rng.integers(0, SHAPE[0], (4000, 2))
    view = view_of(SHAPE, index, RefineOptions.tiles)
    # neighbours have similar derivatives
    J = rng.normal(size=(8, 64))[:, view.tile_of] + rng.normal(size=(8, 4000))
    residual = errors(rng, view)
    residual -= J.T @ np.linalg.lstsq(J.T, residual, rcond=None)[0]
    return np.concatenate([residual[None], J]).astype(np.float32), view


def stated(rows, view, shared_error=0.0):
    """What is stated about the motion if the residuals have unit variance."""
    weights = np.ones(rows.shape[1], np.float32)
    products = weighted_products(rows, weights)
    shared = np.full((1, rows.shape[1]), shared_error, np.float32)
    found = estimate_information(rows, weights, shared, products, view, 0.7)
    expected = np.linalg.inv(np.linalg.inv(products[1:, 1:])[:6, :6])
    return found, expected


def test_independent_errors_leave_the_information_of_the_normal_equations():
    found, expected = stated(*linear_fit(independent))
    # both are inflated by the same factor for what tiles cannot show
    inflation = expected[0, 0] / found.matrix[0, 0]
    np.testing.assert_allclose(inflation * found.matrix, expected, rtol=1e-3)
    assert 4.0 <= inflation < 6.0
    assert found.agreement == 1.0


def test_errors_that_neighbours_share_lower_the_information():
    of_independent, _ = stated(*linear_fit(independent))
    of_alike, _ = stated(*linear_fit(alike_in_tiles))
    assert of_alike.scale < 0.2 * of_independent.scale


def test_errors_that_parts_share_are_added_to_the_covariance():
    rows, view = linear_fit(independent)
    without, _ = stated(rows, view)
    with_shared, _ = stated(rows, view, shared_error=0.5)
    added = np.linalg.inv(with_shared.matrix) - np.linalg.inv(without.matrix)
    covariance = np.linalg.inv(
        weighted_products(rows[1:], np.ones(4000, np.float32))
    )
    effects = np.zeros((64, 1, 6))
    pull = 0.5 * (covariance @ rows[1:])[:6]
    np.add.at(effects[:, 0], view.tile_of, pull.T)
    np.testing.assert_allclose(
        added, shared_covariance(effects, view.part_of), rtol=1e-3, atol=1e-9
    )


def test_what_determines_no_motion_has_no_information():
    rows = np.zeros((9, 100), np.float32)
    index = np.zeros((100, 2), int)
    found, _ = stated_of_nothing(rows, view_of(SHAPE, index, RefineOptions.tiles))
    assert found.scale == 0.0
    assert not found.matrix.any()


def stated_of_nothing(rows, view):
    """The same without what the normal equations state, which is nothing."""
    weights = np.ones(rows.shape[1], np.float32)
    shared = np.zeros((1, rows.shape[1]), np.float32)
    products = np.zeros((9, 9))
    return estimate_information(rows, weights, shared, products, view, 0.7), None
