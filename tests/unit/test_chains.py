"""Chained covariances, and those of other libraries' factors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridvo import InputError, RelativePose, chain_covariance, to_g2o_information
from hybridvo.geometry import adjoint, invert, se3_exp, se3_log
from hybridvo.results import Reason, Step


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


def test_failed_steps_are_spanned_and_gaps_refused() -> None:
    unit = RelativePose(covariance=np.eye(6) * 1e-6)
    failed = RelativePose.failed(Reason.NO_FLOW, "none")
    steps = [
        _step(0, None, unit),
        _step(1, 0, unit),
        _step(2, 1, failed),
        _step(3, 1, unit),
    ]
    np.testing.assert_allclose(chain_covariance(steps), 2e-6 * np.eye(6))
    with pytest.raises(InputError, match="starts at frame 3"):
        chain_covariance(
            [*steps, _step(5, 4, unit), _step(6, 3, unit)][:4]
            + [
                _step(6, 3, unit),
                _step(7, 3, unit),
            ]
        )
    with pytest.raises(InputError, match="motion 0 failed"):
        chain_covariance([failed])
    with pytest.raises(InputError, match="got int"):
        chain_covariance([3])  # type: ignore[list-item]
    assert not chain_covariance([]).any()


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
