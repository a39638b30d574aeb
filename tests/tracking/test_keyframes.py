"""Keyframes: which frame a motion is estimated from, and what becomes of it between neighbours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import (
    adjoint,
    invert,
    mean_flow,
    se3_exp,
    se3_log,
)
from hybridvo.core.results import MotionPrior, Reason, RelativePose
from hybridvo.tracking.calibration import (
    KEYFRAME_AGE,
    KEYFRAME_CORRELATION,
    MIN_DEPTH_SHARE,
)
from hybridvo.tracking.keyframes import (
    Keyframe,
    between_frames,
    expected_motion,
    has_enough_depth,
)
from tests import slow_walk

CAMERA = hvo.Camera(100.0, 100.0, 31.5, 23.5, height=48, width=64)
SIDEWAYS = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def frame(depth: float = 2.0, index: int = 0) -> hvo.Frame:
    """A wall at one depth: a step of t metres to the side is a flow of 100 t / depth pixels."""
    rgb = np.zeros((48, 64, 3), np.uint8)
    return hvo.Frame(rgb, np.full((48, 64), depth, np.float32), CAMERA, index=index)


def keyframe(x: float, count: int, origin: int = 0) -> Keyframe:
    """A keyframe ``x`` metres to the right of the world's origin."""
    return Keyframe(frame(), se3_exp(x * SIDEWAYS), count, origin, 1e-6 * np.eye(6))


def test_a_motion_starts_where_enough_pixels_have_depth() -> None:
    wall = frame()
    assert wall.is_rgbd and has_enough_depth(wall)
    without = replace(wall, depth=None)
    assert not without.is_rgbd and not has_enough_depth(without)
    assert not replace(wall, rgb=None).is_rgbd
    # a covered sensor: single pixels, and values that are no depth
    depth = np.full(CAMERA.shape, np.nan, np.float32)
    depth[1] = np.inf
    depth[2] = -1.0
    needed = int(np.ceil(MIN_DEPTH_SHARE * depth.size))
    depth[0, : needed - 1] = 2.0
    covered = replace(wall, depth=depth)
    assert covered.is_rgbd and not has_enough_depth(covered)
    depth = depth.copy()
    depth[0, :needed] = 2.0
    assert has_enough_depth(replace(wall, depth=depth))


def test_mean_flow_by_hand() -> None:
    # 4 cm at 2 m and 100 px: 2 px of 64
    assert mean_flow(frame(), se3_exp(0.04 * SIDEWAYS)) == pytest.approx(
        2 / 64, rel=1e-5
    )
    assert mean_flow(frame(), np.eye(4)) == pytest.approx(0, abs=1e-12)
    behind = se3_exp(np.array([0, 0, -3.0, 0, 0, 0]))
    assert mean_flow(frame(), behind) == np.inf
    assert mean_flow(replace(frame(), depth=None), np.eye(4)) == np.inf


def test_adjoint_moves_a_perturbation_through_a_motion() -> None:
    T = se3_exp(np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2]))
    delta = np.array([1e-3, 2e-3, -1e-3, 5e-4, -2e-4, 3e-4])
    moved = se3_log(T @ se3_exp(delta) @ invert(T))
    np.testing.assert_allclose(moved, adjoint(T) @ delta, atol=1e-12)


def test_a_prior_of_the_next_step_becomes_one_from_the_keyframe() -> None:
    T_prev_key = se3_exp(np.array([0.1, 0, 0, 0, 0.1, 0]))
    step = se3_exp(np.array([0.02, 0, 0.01, 0, 0.02, 0]))
    prior = expected_motion(MotionPrior(step, np.eye(6)), T_prev_key)
    np.testing.assert_allclose(prior.T_curr_prev, step @ T_prev_key)


@pytest.mark.slow
def test_the_motion_between_neighbours_and_its_covariance() -> None:
    """Drawn errors of both motions from the keyframe, half of whose variance is common."""
    T_prev_key = se3_exp(np.array([0.10, 0.02, -0.03, 0.02, -0.05, 0.01]))
    step = se3_exp(np.array([0.02, -0.01, 0.05, 0.01, 0.03, -0.02]))
    key = Keyframe(frame(), np.eye(4), 0, 0, np.zeros((6, 6)))
    C_prev = 1e-6 * np.diag([1, 2, 3, 0.1, 0.2, 0.3])
    C_curr = 2e-6 * np.diag([3, 1, 2, 0.3, 0.1, 0.2])
    previous = Keyframe(frame(index=1), invert(T_prev_key), 1, 0, C_prev)
    motion = RelativePose(T_curr_prev=step @ T_prev_key, covariance=C_curr)
    found = between_frames(motion, key, previous)
    np.testing.assert_allclose(found.T_curr_prev, step, atol=1e-12)
    A = adjoint(step)
    expected = (1 - KEYFRAME_CORRELATION) * (C_curr + A @ C_prev @ A.T)
    np.testing.assert_allclose(found.covariance, expected)
    # independent errors, to which a correlation of zero belongs, by drawing them
    rng = np.random.default_rng(0)
    draws = []
    for _ in range(4000):
        curr_key = se3_exp(rng.multivariate_normal(np.zeros(6), C_curr))
        prev_key = se3_exp(rng.multivariate_normal(np.zeros(6), C_prev))
        drawn = curr_key @ step @ T_prev_key @ invert(prev_key @ T_prev_key)
        draws.append(se3_log(drawn @ invert(step)))
    ratio = np.cov(np.array(draws).T) / (expected / (1 - KEYFRAME_CORRELATION))
    np.testing.assert_allclose(np.diag(ratio), 1, atol=0.12)  # 4000 draws: 5 sigma


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7, 8, 9])
def test_slow_objects_do_not_carry_the_path_away(seed: int) -> None:
    """Steps of 1.5 cm, a third of the view moving by less than the noise in each of them.

    Carried away, the path of 57 cm ends 7 cm off.
    """
    frames, poses = slow_walk.frames("light", seed=seed, count=40)
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    steps = [vo.track(frame) for frame in frames]
    end = steps[-1].T_world_cam[:3, 3] - poses[-1][:3, 3]
    assert np.linalg.norm(end) < 0.02


def test_steps_are_given_between_neighbours_and_the_ring_is_short() -> None:
    frames, poses = slow_walk.frames("static", seed=6, count=16)
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    measured = []
    for k, one in enumerate(frames):
        step = vo.track(one)
        assert len(vo.state.keyframes) <= KEYFRAME_AGE + 1
        if k:
            assert step.ok and step.prev_index == k - 1
            true = invert(poses[k]) @ poses[k - 1]
            np.testing.assert_allclose(step.T_curr_prev, true, atol=2e-3)
        measured.append(step.measured)
    # the keyframe hands over once the camera is too far from it
    starts = [each.start for each in measured if each is not None]
    assert len(starts) > 8 and starts == sorted(starts) and len(set(starts)) > 1
    for k, edge in enumerate(measured):
        if edge is not None:
            assert edge.start < k - 1
            true = invert(poses[k]) @ poses[edge.start]
            np.testing.assert_allclose(edge.T_curr_start, true, atol=4e-3)
    assert vo.state.keyframes[0].count < 12


def test_a_frozen_image_loses_no_motion() -> None:
    """Its own step is doubted; the next one starts from the last frame that was sure."""
    frames, poses = slow_walk.frames("static", seed=6, count=8, stride=4)
    stale = 4
    frames[stale] = replace(frames[stale], rgb=frames[stale - 1].rgb)
    vo = hvo.Odometry()
    vo.set_pose(poses[0])
    steps = [vo.track(one) for one in frames]
    assert steps[stale].status.reason is Reason.REPEATED_FRAME
    after = steps[stale + 1]
    assert after.ok and after.prev_index is not None and after.prev_index < stale
    for k in (stale + 1, stale + 2):
        error = steps[k].T_world_cam[:3, 3] - poses[k][:3, 3]
        assert np.linalg.norm(error) < 0.01


def test_set_pose_moves_the_keyframes_along() -> None:
    frames, _ = slow_walk.frames("static", seed=6, count=4)
    vo = hvo.Odometry()
    other = hvo.Odometry()
    start = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3]))
    other.set_pose(start)
    for one in frames[:2]:
        vo.track(one)
        other.track(one)
    vo.set_pose(other.state.T_world_last)
    for one in frames[2:]:
        np.testing.assert_allclose(
            vo.track(one).T_world_cam, other.track(one).T_world_cam, atol=1e-9
        )
