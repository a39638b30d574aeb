"""The loop of damped Newton steps, whatever factors it minimises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybridvo.core.geometry import se3_exp
from hybridvo.solver.newton import (
    FactorSum,
    Linearization,
    MotionState,
    newton,
)
from hybridvo.solver.newton_kernels import newton_step
from hybridvo.solver.prior import Prior

SEEDS = st.integers(0, 2**32 - 1)
START = MotionState(np.eye(4))


def unknowns(state: MotionState) -> np.ndarray:
    """Translation, and gain and offset less those of unchanged light."""
    light = state.gain_offset - START.gain_offset
    return np.concatenate([state.T_curr_prev[:3, 3], np.zeros(3), light])


class Quadratic:
    """A quadratic cost of translation, gain and offset, and how often it was asked."""

    def __init__(self, H: np.ndarray, least: np.ndarray) -> None:
        self.H = H
        self.least = least
        self.costs: list[float] = []

    def linearize(self, state: MotionState) -> Linearization:
        away = unknowns(state) - self.least
        cost = float(0.5 * away @ self.H @ away)
        self.costs.append(cost)
        return Linearization(self.H, -self.H @ away, cost, np.zeros((8, 8)))


def drawn_quadratic(seed: int) -> Quadratic:
    rng = np.random.default_rng(seed)
    # unknowns in units that differ by orders of magnitude
    A = rng.normal(size=(40, 8)) * 10.0 ** rng.uniform(-2, 2, 8)
    A[:, 3:6] = 0.0
    least = 0.3 * rng.normal(size=8)
    least[3:6] = 0.0
    # not at the limits of the gain
    least[6] = np.clip(least[6], -0.5, 0.5)
    return Quadratic(A.T @ A, least)


@given(SEEDS)
def test_one_step_reaches_the_minimum_of_a_quadratic_cost(seed: int) -> None:
    cost = drawn_quadratic(seed)
    found = newton(cost, START, 0, 0.0).state
    # the damping that every step has is a millionth
    assert cost.linearize(found).cost <= 1e-6 * cost.costs[0]


@given(SEEDS)
def test_a_direction_that_nothing_determines_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = drawn_quadratic(seed)
    scale = np.sqrt(np.diag(cost.H))
    # without the gain, which has limits
    scale[6] = 0.0
    normal = np.where(scale > 0, rng.normal(size=8), 0.0)
    normal /= np.linalg.norm(normal)
    across = scale[:, None] * (np.eye(8) - np.outer(normal, normal)) * scale
    flat = Quadratic(across, cost.least)
    found = unknowns(newton(flat, START, 3, 1e-6).state)
    assert flat.costs[-1] <= 1e-5 * flat.costs[0] + 1e-12
    # across what is determined, in the metric of the damping
    direction = np.divide(normal, scale, where=scale > 0, out=np.zeros(8))
    moved = np.diag(across) * found
    assert abs(moved @ direction) <= 1e-6 * np.linalg.norm(moved / (scale + 1e-9))


def test_an_unknown_without_any_pixel_stays() -> None:
    H = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    least = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 5.0, 5.0])
    found = newton(Quadratic(H, least), START, 3, 1e-4).state
    np.testing.assert_array_equal(found.gain_offset, START.gain_offset)
    np.testing.assert_allclose(found.T_curr_prev[:3, 3], least[:3], atol=1e-5)


class Robust:
    """Points under the kernel of Geman-McClure, some of them far from the others."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.points = rng.normal(0.0, 0.5, (40, 3))
        self.points[:12] += rng.normal(0.0, 6.0, (12, 3))

    def linearize(self, state: MotionState) -> Linearization:
        r = self.points - state.T_curr_prev[:3, 3]
        robust = 9 / (9 + np.sum(r**2, axis=1))
        w = robust**2
        H = np.zeros((6, 6))
        H[:3, :3] = w.sum() * np.eye(3)
        g = np.zeros(6)
        g[:3] = w @ r
        curvature = np.zeros((6, 6))
        curvature[:3, :3] = (4 / 9 * w * robust * r.T) @ r
        return Linearization(H, g, float(4.5 * np.sum(1 - robust)), curvature)


@given(SEEDS)
def test_the_cost_is_not_higher_at_the_end(seed: int) -> None:
    cost = Robust(seed)
    rng = np.random.default_rng(seed)
    start = MotionState(se3_exp(np.append(rng.normal(0, 4, 3), np.zeros(3))))
    result = newton(cost, start, 20, 0.0)
    before = cost.linearize(start).cost
    assert cost.linearize(result.state).cost <= before + 1e-12
    assert result.at.cost <= before
    assert np.isfinite(result.state.T_curr_prev).all()


def scripted(costs: list[float]):
    """A factor whose call k has a cost and a gradient of its own, and the states it was asked."""
    states: list[MotionState] = []

    class Scripted:
        def linearize(self, state: MotionState) -> Linearization:
            cost = costs[len(states)]
            states.append(state)
            g = np.zeros(6)
            # never shorter: only the cost decides
            g[0] = -1.0 if cost > 0 else 1.0
            return Linearization(np.eye(6), g, cost, np.zeros((6, 6)))

    return Scripted(), states


def test_a_step_that_fails_is_taken_back_and_the_next_is_shorter() -> None:
    factor, states = scripted([0.0, -1.0, 5.0, 5.0])
    result = newton(factor, START, 3, 1e-6)
    assert result.at.cost == -1.0
    np.testing.assert_array_equal(result.state.T_curr_prev, states[1].T_curr_prev)
    x = [state.T_curr_prev[0, 3] for state in states]
    assert 0 < x[3] - x[1] < x[2] - x[1]


def test_no_step_where_the_equations_are_no_numbers() -> None:
    H = np.eye(6)
    H[0, 1] = np.nan
    delta, length2 = newton_step(H, np.zeros((6, 6)), np.ones(6), 1e-6)
    assert length2 == np.inf
    np.testing.assert_array_equal(delta, np.zeros(6))


@given(SEEDS)
def test_a_step_with_a_curvature_of_the_wrong_sign_goes_downhill(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6))
    H = A @ A.T + 0.1 * np.eye(6)
    curvature = H * rng.uniform(0.0, 3.0)
    g = rng.normal(size=6)
    delta, length2 = newton_step(H, curvature, g, 1e-6)
    assert delta @ g == pytest.approx(length2)
    assert length2 > 0


@given(SEEDS)
def test_two_priors_meet_where_their_information_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    near = 1e-3 * rng.normal(size=6)
    first = Prior.around(np.eye(4), np.diag(rng.uniform(1, 4, 6)))
    second = Prior.around(se3_exp(near), np.diag(rng.uniform(1, 4, 6)))
    found = newton(FactorSum([first, second]), START, 10, 0.0).state
    total = first.information + second.information
    expected = np.linalg.solve(total, second.information @ near)
    # near both, Student's kernel is a parabola
    np.testing.assert_allclose(
        found.T_curr_prev[:3, 3], se3_exp(expected)[:3, 3], atol=2e-6
    )


def test_a_factor_of_the_motion_leaves_gain_and_offset_to_the_others() -> None:
    rng = np.random.default_rng(0)
    prior = Prior.around(np.eye(4), np.eye(6))
    images = drawn_quadratic(4)
    at = MotionState(se3_exp(0.1 * rng.normal(size=6)))
    total = FactorSum([images, prior]).linearize(at)
    alone = images.linearize(at)
    by_prior = prior.linearize(at)
    np.testing.assert_allclose(total.H[6:], alone.H[6:])
    np.testing.assert_allclose(total.H[:6, :6], alone.H[:6, :6] + by_prior.H)
    np.testing.assert_allclose(total.g[:6], alone.g[:6] + by_prior.g)
    assert total.cost == pytest.approx(alone.cost + by_prior.cost)


def test_the_gain_stays_within_its_limits() -> None:
    moved = START.moved(np.array([0.0] * 6 + [-9.0, 2.0]))
    assert 0 < moved.gain_offset[0] < 1
    assert moved.gain_offset[1] == 2.0
    np.testing.assert_array_equal(START.gain_offset, [1.0, 0.0])
