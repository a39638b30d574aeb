"""Covariances of chained motions, and those of other libraries' factors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import adjoint
from hybridvo.results import RelativePose, Step

G2O_ROTATION = 0.5
"""A small rotation in g2o: the vector part of its quaternion is half of the angle."""


def chain_covariance(steps: Iterable[Step | RelativePose]) -> np.ndarray:
    """Covariance of the motion over several steps.

    It is what a pose graph computes from one factor for each step. Steps that failed are
    passed over, as in such a graph: the next one spans them.

    Args:
        steps: of a tracker, in their order; or motions, each from where the one before
            ended.

    Returns:
        (6, 6) covariance of delta in ``Exp(delta) T_last_first``, translation first, m and
        rad; zero without any motion.

    Raises:
        InputError: a step does not start where the one before ended.

    Example:
        >>> import numpy as np
        >>> from hybridvo import RelativePose
        >>> step = RelativePose(covariance=np.diag([1e-4] * 3 + [1e-6] * 3))
        >>> np.diag(chain_covariance([step, step])).round(6).tolist()
        [0.0002, 0.0002, 0.0002, 2e-06, 2e-06, 2e-06]
    """
    covariance = np.zeros((6, 6))
    last_index: int | None = None
    for number, step in enumerate(steps):
        motion = step
        if isinstance(step, Step):
            if step.prev_index is None:
                last_index = step.index
                continue
            if not step.usable:
                continue
            if last_index is not None and step.prev_index != last_index:
                raise InputError(
                    f"chain_covariance: step {number} starts at frame {step.prev_index}; "
                    f"expected {last_index}, where the usable step before it ends."
                )
            last_index = step.index
            motion = step.motion
        elif not isinstance(step, RelativePose):
            got = type(step).__name__
            raise InputError(
                f"chain_covariance: expected steps or motions, got {got}."
            )
        elif not step.usable:
            raise InputError(f"chain_covariance: motion {number} failed.")
        A = adjoint(motion.T_curr_prev)
        covariance = A @ covariance @ A.T + motion.covariance
    return covariance


def to_g2o_information(covariance: np.ndarray) -> np.ndarray:
    """Information for g2o's ``EDGE_SE3:QUAT`` of ``T_prev_curr``.

    g2o's error is the translation and the vector part of the quaternion of
    ``inverse(measurement) estimate``. As GTSAM's it is on the right, so that no axes
    change; the vector part is half of the angle.

    Args:
        covariance: (6, 6) or (N, 6, 6) of ``T_curr_prev``, as in a RelativePose.

    Returns:
        The same shape, (x, y, z, qx, qy, qz); a g2o file has its upper triangle.

    Raises:
        InputError: for another shape, and for a covariance that is not definite.

    >>> information = to_g2o_information(np.diag([0.25, 1, 1, 1, 1, 0.5]))
    >>> np.diag(information).tolist()
    [4.0, 1.0, 1.0, 4.0, 4.0, 8.0]
    """
    C = np.asarray(covariance, dtype=np.float64)
    if C.ndim not in (2, 3) or C.shape[-2:] != (6, 6):
        raise InputError(
            f"to_g2o_information: expected (6, 6) or (N, 6, 6), got {C.shape}."
        )
    scale = np.repeat([1.0, G2O_ROTATION], 3)
    scaled = C * scale * scale[:, None]
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        raise InputError(
            "to_g2o_information: expected a positive definite covariance."
        ) from None
    return np.linalg.inv(scaled)
