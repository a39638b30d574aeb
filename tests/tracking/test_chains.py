"""Chained covariances, and those of other libraries' factors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridvo import InputError, RelativePose, chain_covariance, to_g2o_information
from hybridvo.core.geometry import adjoint, invert, se3_exp, se3_log
from hybridvo.core.results import Edge, Reason, Status, Step
from tests.doors import refuses


def _random_motions(rng: np.random.Generator, count: int) -> list[RelativePose]:
    motions = []
    for _ in range(count):
        root = rng.normal(size=(6, 6)) * np.repeat([1e-3, 3e-4], 3)[:, None]
        T = se3_exp(rng.normal(size=6) * np.repeat([0.3, 0.2], 3))
        motions.append(RelativePose(T_curr_prev=T, covariance=root @ root.T))
    return motions


def test_the_chain_is_what_samples_of_its_steps_scatter_by() -> None:
    rng = np.random.default_rng(0)
    motions = _random_motions(rng, 5)
    whole = np.eye(4)
    for motion in motions:
        whole = motion.T_curr_prev @ whole

    roots = [np.linalg.cholesky(m.covariance + 1e-18 * np.eye(6)) for m in motions]
    errors = []
    for _ in range(4000):
        T = np.eye(4)
        for motion, root in zip(motions, roots, strict=True):
            T = se3_exp(root @ rng.normal(size=6)) @ motion.T_curr_prev @ T
        errors.append(se3_log(T @ invert(whole)))
    sampled = np.cov(np.array(errors).T)
    stated = chain_covariance(motions)
    ratio = np.linalg.eigvals(np.linalg.solve(stated, sampled)).real
    assert ratio.min() > 0.85 and ratio.max() < 1.15


def test_two_steps_by_hand() -> None:
    first = RelativePose(covariance=np.diag([1, 1, 1, 0, 0, 0]) * 1e-4)
    T = se3_exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    second = RelativePose(
        T_curr_prev=T, covariance=np.diag([4, 0, 0, 0, 0, 0]) * 1e-4
    )
    first_turned = adjoint(T) @ first.covariance @ adjoint(T).T
    np.testing.assert_allclose(first_turned, first.covariance, atol=1e-18)
    expected = np.diag([5, 1, 1, 0, 0, 0]) * 1e-4
    np.testing.assert_allclose(
        chain_covariance([first, second]), expected, atol=1e-18
    )


def _step(index: int, prev: int | None, motion: RelativePose) -> Step:
    return Step(index, float(index), np.eye(4), motion, prev)


def _units(count: float) -> np.ndarray:
    """The covariance of some motions without length that have one of 1e-6 each."""
    return count * 1e-6 * np.eye(6)


UNIT = RelativePose(covariance=_units(1))
FAILED = RelativePose.failed(Reason.NO_FLOW, "none")


def test_steps_follow_the_frames_from_which_they_start() -> None:
    wide = RelativePose(
        covariance=_units(50),
        status=Status.degraded(Reason.AMBIGUOUS_MOTION, "another one"),
    )
    steps = [
        _step(0, None, UNIT),
        _step(1, 0, UNIT),
        # degraded, so that the next step starts at the frame before it
        _step(2, 1, wide),
        _step(3, 1, UNIT),
    ]
    np.testing.assert_allclose(chain_covariance(steps[:3]), _units(51))
    np.testing.assert_allclose(chain_covariance(steps), _units(2))
    # from a keyframe
    steps += [_step(4, 3, UNIT), _step(5, 0, UNIT)]
    np.testing.assert_allclose(chain_covariance(steps), _units(1))
    # from a part of the path: its first frame is where the first step starts
    np.testing.assert_allclose(chain_covariance(steps[3:5]), _units(2))


def test_errors_of_motions_from_one_keyframe_do_not_add_up() -> None:
    from_start = Edge(0, np.eye(4), _units(3))
    steps = [
        _step(0, None, UNIT),
        _step(1, 0, UNIT),
        replace(_step(2, 1, UNIT), measured=from_start),
        replace(_step(3, 2, UNIT), measured=from_start),
    ]
    np.testing.assert_allclose(chain_covariance(steps), _units(3))
    assert steps[3].edge is from_start
    # of a part of the path that begins after the keyframe, the motions themselves
    np.testing.assert_allclose(chain_covariance(steps[2:]), _units(2))


def test_the_edge_of_a_step_that_starts_where_it_was_measured() -> None:
    T = se3_exp(np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]))
    edge = _step(5, 2, RelativePose(T, _units(1))).edge
    assert edge is not None and edge.start == 2
    np.testing.assert_array_equal(edge.T_curr_start, T)
    np.testing.assert_allclose(edge.T_start_curr, invert(T))
    np.testing.assert_array_equal(edge.covariance, _units(1))
    assert _step(0, None, UNIT).edge is None


def test_failed_steps_are_spanned() -> None:
    steps = [
        _step(0, None, UNIT),
        _step(1, 0, UNIT),
        _step(2, 1, FAILED),
        _step(3, 1, UNIT),
        _step(4, 3, FAILED),
    ]
    np.testing.assert_allclose(chain_covariance(steps), _units(2))
    assert not chain_covariance([]).any()


test_refuses = refuses(
    [
        (
            "a start to which no step leads",
            lambda: chain_covariance([_step(4, 3, UNIT), _step(7, 6, UNIT)]),
            InputError,
            ("step 1 starts at frame 6", "such as 3, 4"),
        ),
        (
            "a motion that failed",
            lambda: chain_covariance([FAILED]),
            InputError,
            ("motion 0 failed",),
        ),
        (
            "numbers",
            lambda: chain_covariance([3]),  # type: ignore[list-item]
            InputError,
            ("expected steps or motions", "got int"),
        ),
    ]
)


def test_g2o_errors_have_the_stated_information() -> None:
    rng = np.random.default_rng(1)
    (motion,) = _random_motions(rng, 1)
    measured = invert(motion.T_curr_prev)
    root = np.linalg.cholesky(motion.covariance)
    errors = []
    for _ in range(6000):
        true_curr_prev = se3_exp(root @ rng.normal(size=6)) @ motion.T_curr_prev
        difference = invert(measured) @ invert(true_curr_prev)
        quaternion = Rotation.from_matrix(difference[:3, :3]).as_quat(
            canonical=True
        )
        errors.append(np.concatenate([difference[:3, 3], quaternion[:3]]))
    sampled = np.cov(np.array(errors).T)
    ratio = np.linalg.eigvals(to_g2o_information(motion.covariance) @ sampled).real
    assert ratio.min() > 0.85 and ratio.max() < 1.15


def test_g2o_refuses_what_is_no_covariance() -> None:
    with pytest.raises(InputError, match=r"got \(3, 3\)"):
        to_g2o_information(np.eye(3))
    with pytest.raises(InputError, match="positive definite"):
        to_g2o_information(np.zeros((6, 6)))
    assert to_g2o_information(np.stack([np.eye(6)] * 3)).shape == (3, 6, 6)
