"""The depth maps as a factor: points to planes, and the noise of the sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import se3_exp
from hybridvo.core.options import RefineOptions
from hybridvo.solver.newton import MotionState
from hybridvo.solver.plane_kernels import PlanesAt
from hybridvo.solver.planes import WeightedPlanes, depth_quantum, planes_of
from hybridvo.solver.products import weighted_products
from hybridvo.solver.rows import PLANE_TERMS, PlaneRow
from tests import worlds

SIZE = (192, 256)


def factor_of(pair) -> WeightedPlanes:
    return planes_of(pair).weighted(
        np.ones(SIZE, np.float32), 0.25, RefineOptions()
    )


def gradient(at: PlanesAt) -> np.ndarray:
    """Negative gradient of the cost, without errors that neighbours share."""
    sums = weighted_products(at.rows[:PLANE_TERMS], at.weights)
    return -sums[PlaneRow.MOTION :, PlaneRow.RESIDUAL]


def cost(factor: WeightedPlanes, at: PlanesAt, T: np.ndarray) -> float:
    """The cost at a motion, under the noise at another one."""
    noisy = factor.under(at)._replace(information_scale=1.0)
    return noisy.linearize(MotionState(T)).cost


def noisy(pair, polynomial, seed: int):
    """The pair with Gaussian noise of standard deviation a + b z + c z^2 on both depth maps."""
    rng = np.random.default_rng(seed)

    def spoilt(frame):
        z = frame.depth.astype(np.float64)
        sigma = polynomial[0] + polynomial[1] * z + polynomial[2] * z * z
        z = z + sigma * rng.standard_normal(z.shape)
        return replace(frame, depth=z.astype(np.float32))

    return replace(pair, prev=spoilt(pair.prev), curr=spoilt(pair.curr))


def test_exact_depth_alone_gives_the_motion():
    pair, T = worlds.world(SIZE)
    factor = factor_of(pair)
    start = se3_exp(np.array([0.01, -0.01, 0.02, 0.003, -0.002, 0.004])) @ T
    for _ in range(20):
        at = factor.at(start)
        assert at.determine_motion
        scaled = at.information.scale * gradient(at)
        step = np.linalg.solve(at.information.matrix, scaled)
        start = se3_exp(step) @ start
    worlds.assert_pose_close(start, T, rad=2e-4, m=1e-3)


def test_the_gradient_is_that_of_the_cost():
    # without noise: a point that comes to another pixel of a plane finds the same plane there
    pair, T = worlds.world(SIZE, walls=worlds.WALLS[1:2])
    factor = factor_of(pair)
    near = se3_exp(np.array([0.01, 0.0, 0.02, 0.002, -0.001, 0.0])) @ T
    at = factor.at(near)
    h = 1e-4
    g = gradient(at)
    for k in range(6):
        delta = h * np.eye(6)[k]
        costs = [cost(factor, at, se3_exp(s * delta) @ near) for s in (1, -1)]
        slope = (costs[0] - costs[1]) / (2 * h)
        assert -slope == pytest.approx(g[k], rel=0.02, abs=0.02 * np.abs(g).max())


@pytest.mark.parametrize(
    ("polynomial", "least", "most"),
    [((0.003, 0, 0), 0.6, 1.3), ((0, 0, 0.0002), 1.4, 2.64)],
)
def test_the_noise_follows_the_sensor(polynomial, least, most):
    # a wall from 3.8 to 7 m; its near end is seen at a right angle, its far end is not
    pair, T = worlds.world(SIZE, walls=((0.6, 0.0, 1.0, 5.0),))
    factor = factor_of(noisy(pair, polynomial, 1))
    at = factor.at(T)
    assert at.determine_motion
    near, middle, far = at.noise(np.array([4.0, 5.0, 6.5]))
    assert least <= far / near <= most
    assert 0.9 < middle / (polynomial[0] + 25 * polynomial[2]) < 1.5


def test_nothing_is_made_of_maps_without_depth():
    pair, T = worlds.world(SIZE)
    nothing = np.zeros(SIZE, np.float32)
    without = planes_of(pair).weighted(nothing, 0.25, RefineOptions())
    assert not without.at(T).determine_motion
    empty = replace(pair, curr=replace(pair.curr, depth=np.zeros(SIZE, np.float32)))
    assert not factor_of(empty).at(T).determine_motion


def rounded(depth: np.ndarray, quantum: float) -> np.ndarray:
    """Depth as structured light gives it: the inverse comes in steps."""
    return (1 / (np.rint(1 / depth / quantum) * quantum)).astype(np.float32)


@pytest.mark.parametrize("quantum", [0.00285, 0.001])
def test_the_step_in_which_a_sensor_rounds_is_found(quantum):
    rows, columns = np.mgrid[0:120, 0:160]
    depth = 1.5 + 0.001 * columns + 0.002 * rows
    index = np.stack([rows.ravel(), columns.ravel()], axis=1)
    found = depth_quantum(rounded(depth, quantum), index)
    # steps of inverse depth are quantum z^2 long
    assert found == pytest.approx(quantum, rel=0.15)


def test_depth_that_is_not_rounded_has_no_step():
    rows, columns = np.mgrid[0:120, 0:160]
    depth = (1.5 + 0.004 * columns + 0.002 * rows).astype(np.float32)
    index = np.stack([rows.ravel(), columns.ravel()], axis=1)
    assert depth_quantum(depth, index) == 0.0


def test_two_equally_rounded_maps_are_not_taken_for_exact():
    """A camera that stands gets the same rounded map twice: they agree exactly, and say little."""
    rows, columns = np.mgrid[0:120, 0:160]
    waves = np.sin(columns / 17.0) + np.cos(rows / 13.0)
    depth = rounded(2.0 + 0.3 * waves, 0.00285)
    camera = hvo.Camera(160, 160, 79.5, 59.5, height=120, width=160)
    frame = hvo.Frame(None, depth, camera)
    pair = hvo.FramePair(frame, frame, None)
    planes = planes_of(pair).weighted(np.ones((120, 160)), 0.5, RefineOptions())
    at = planes.at(np.eye(4))
    assert at.determine_motion
    step_m = 0.00285 * 2.0**2
    # of the difference of two depths that are each off by up to half a step
    assert at.noise(np.array([2.0]))[0] >= 0.9 * step_m / np.sqrt(6)
