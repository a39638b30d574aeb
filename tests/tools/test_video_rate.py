"""The benchmark at video rate: what it renders, what its sensor measures, what it counts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hybridvo.core.results import Edge, Reason, RelativePose, Status, Step
from tests.scripts import load_script

video = load_script("tools/bench/video_rate.py")


def test_depth_noise_is_that_of_structured_light():
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 100:] = 4.0
    frame = SimpleNamespace(rgb=np.full((120, 160, 3), 100, np.uint8), depth=depth)
    rng = np.random.default_rng(0)
    exact = video.measured(frame, video.NOISES["exact"], rng)
    np.testing.assert_array_equal(exact.depth, depth)
    # rounding adds 1/12: sqrt(4 + 1/12) = 2.02
    assert exact.rgb.std() == pytest.approx(2.02, rel=0.02)

    noisy = video.measured(frame, video.NOISES["structured light"], rng).depth
    # the edge is lost on both sides, and nothing else
    assert (noisy[:, 99:101] == 0).all()
    assert (noisy[:, :99] > 0).all() and (noisy[:, 101:] > 0).all()
    # 0.0015 * 2^2 = 6 mm and 0.0015 * 4^2 = 24 mm
    assert (noisy[:, :99] - 2).std() == pytest.approx(0.006, rel=0.1)
    assert (noisy[:, 101:] - 4).std() == pytest.approx(0.024, rel=0.1)
    # correlated: neighbours have a correlation of exp(-1 / (4 * 1.5^2)) = 0.89
    left = noisy[:, :98] - 2
    right = noisy[:, 1:99] - 2
    correlation = np.corrcoef(left.ravel(), right.ravel())[0, 1]
    assert correlation == pytest.approx(0.89, abs=0.03)


def step(index, prev_index, T_curr_prev, T_world_cam, std_m=0.001, ok=True):
    covariance = np.diag([std_m**2] * 3 + [1e-12] * 3)
    status = Status() if ok else Status.degraded(Reason.AMBIGUOUS_MOTION, "another")
    motion = RelativePose(T_curr_prev, covariance, status=status)
    return Step(index, index / 30, T_world_cam, motion, prev_index)


def translation(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_figures_of_a_path_by_hand():
    truth = np.stack([translation(0.01 * i) for i in range(4)])
    steps = [
        step(0, None, np.eye(4), truth[0]),
        # right: the camera moves by 10 mm
        step(1, 0, translation(-0.01), truth[1]),
        # 6 mm too far: off, and 6 standard deviations, squared
        step(2, 1, translation(-0.016), translation(0.026)),
        # from the keyframe 1, not from 2: its pose does not have the error of 2
        step(3, 1, translation(-0.02), truth[3]),
    ]
    figures = video.path_figures(steps, truth)
    assert figures["end_cm"] == pytest.approx(0.0, abs=1e-9)
    # two steps of 1 mm in each of three directions: sqrt(6) mm, and rotations of 1e-6 rad
    assert figures["sigma_cm"] == pytest.approx(0.1 * np.sqrt(6), rel=1e-3)
    assert (figures["steps"], figures["failed"], figures["ok_and_off"]) == (3, 0, 1)
    np.testing.assert_allclose(figures["nees"], [0, 36, 0], atol=1e-6)
    # 6 mm against two steps of 1 mm
    np.testing.assert_allclose(figures["positions"], [0, 18, 0], atol=1e-3)

    row = video.summarise_runs([figures | {"ms": [1.0, 2.0, 3.0]}])
    assert row["nees_median"] == pytest.approx(0, abs=1e-6)
    assert (row["beyond_3_sigma"]["count"], row["beyond_3_sigma"]["of"]) == (1, 3)
    # 14.16 is the quantile of chi-square with three degrees of freedom
    assert (row["positions_inside"]["count"], row["positions_inside"]["of"]) == (
        2,
        3,
    )
    assert row["ms"] == 2.0


def test_motions_from_one_keyframe_and_their_correlation():
    """Two errors of 1 mm that are alike: steps scatter less than both motions would."""
    keyed = step(2, 1, np.eye(4), translation(0.001), std_m=0.0005)
    edge = Edge(0, translation(-0.001), 1e-6 * np.eye(6))
    steps = [
        step(0, None, np.eye(4), np.eye(4)),
        step(1, 0, translation(-0.001), translation(0.001)),
        replace(keyed, measured=edge),
    ]
    figures = video.path_figures(steps, np.stack([np.eye(4)] * 3))
    # the path is as sure as the motion from the keyframe, not as both steps together
    assert figures["sigma_cm"] == pytest.approx(0.1 * np.sqrt(3), rel=1e-3)
    np.testing.assert_allclose(figures["positions"], [1, 1], rtol=1e-3)
    np.testing.assert_allclose(figures["scatter"], [0], atol=1e-9)
    # 2.366 is the median of chi-square with three degrees of freedom
    scatter = np.array([0.2366, 0.4732, 1.0])
    assert video.correlation_of(scatter) == pytest.approx(0.8, abs=1e-3)
    assert video.correlation_of(np.array([])) is None
