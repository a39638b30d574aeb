"""What a gyroscope states of a motion before the images are read."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_number, to_numpy
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import make_transform
from hybridvo.core.results import MotionPrior
from hybridvo.tracking.calibration import (
    GYRO_HOLD_S,
    GYRO_NOISE_DENSITY,
    UNKNOWN_SPEED,
)


def gyro_prior(
    stamps: np.ndarray,
    rates: np.ndarray,
    start: float,
    end: float,
    R_cam_imu: np.ndarray | None = None,
    *,
    bias: np.ndarray | None = None,
    noise_density: float = GYRO_NOISE_DENSITY,
    speed: float = UNKNOWN_SPEED,
) -> MotionPrior:
    """Integrate the rates of a gyroscope between two frames.

    Args:
        stamps: (N,) seconds, rising; the first at or before ``start``.
        rates: (N, 3) rad/s about the axes of the sensor, each in force from its stamp to the
            next, and for a tenth of a second at most.
        start: stamp of the frame from which the motion starts: that of ``state.frame``.
        end: stamp of the frame that is tracked.
        R_cam_imu: (3, 3) rotation from the axes of the sensor to those of the camera; by default
            they are the same.
        bias: (3,) rad/s that the sensor reads at rest, which is subtracted; of a cheap one it is
            larger than all its noise. By default 0.
        noise_density: of the rates, rad/s/sqrt(Hz).
        speed: standard deviation of the unknown velocity along each axis, m/s.

    Returns:
        The prior for :meth:`Odometry.track`: the rotation, and an unknown translation.

    Raises:
        InputError: for stamps that do not rise, or that leave a part of the time between the
            frames without a rate; for a rotation or a bias of another shape.

    Example:
        >>> import numpy as np
        >>> stamps = np.array([0.0, 0.005, 0.01])
        >>> rates = np.array([[0, 0, 0.1]] * 3)
        >>> prior = gyro_prior(stamps, rates, start=0.0, end=0.01)
        >>> round(float(prior.T_curr_prev[0, 1]), 6)  # the scene turns the other way
        0.001
    """
    stamps = to_numpy(stamps, "gyro_prior: stamps").astype(np.float64)
    rates = to_numpy(rates, "gyro_prior: rates").astype(np.float64)
    start = as_number(start)
    end = as_number(end)
    _check(stamps, rates, start, end)
    if bias is not None:
        rates = rates - _of_shape(bias, (3,), "bias")
    inside = (stamps > start) & (stamps < end)
    edges = np.concatenate([[start], stamps[inside], [end]])
    held = np.searchsorted(stamps, edges[:-1], side="right") - 1
    _check_gaps(edges[1:] - stamps[held])
    turns = Rotation.from_rotvec(rates[held] * np.diff(edges)[:, None])
    R_prev_curr = np.eye(3)
    for turn in turns.as_matrix():
        R_prev_curr = R_prev_curr @ turn
    R_cam = np.eye(3)
    if R_cam_imu is not None:
        R_cam = _of_shape(R_cam_imu, (3, 3), "R_cam_imu")
    R_curr_prev = R_cam @ R_prev_curr.T @ R_cam.T
    duration = end - start
    variances = np.repeat([(speed * duration) ** 2, noise_density**2 * duration], 3)
    T = make_transform(R_curr_prev, np.zeros(3))
    return MotionPrior(T, np.diag(variances))


def _of_shape(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return numbers as float64; an InputError where they have another shape."""
    array = to_numpy(value, f"gyro_prior: {name}")
    if array.shape != shape or array.dtype.kind not in "fiu":
        raise InputError(
            f"gyro_prior: {name}: expected numbers of shape {shape}, got "
            f"{array.dtype} {array.shape}."
        )
    return array.astype(np.float64)


def _check_gaps(held_s: np.ndarray) -> None:
    """Refuse rates that would have to last too long, where samples are missing."""
    longest = float(held_s.max())
    # stamps of 1e9 s are rounded by a fraction of a microsecond
    if longest > GYRO_HOLD_S + 1e-6:
        raise InputError(
            f"gyro_prior: expected a rate at least every {GYRO_HOLD_S:g} s up to the end, "
            f"got none for {longest:g} s."
        )


def _check(stamps: np.ndarray, rates: np.ndarray, start: float, end: float) -> None:
    """Refuse rates that do not cover the time between two frames."""
    if stamps.ndim != 1 or rates.shape != (len(stamps), 3):
        raise InputError(
            f"gyro_prior: expected stamps (N,) and rates (N, 3), got "
            f"{stamps.shape} and {rates.shape}."
        )
    if not len(stamps) or not (np.diff(stamps) > 0).all():
        raise InputError("gyro_prior: expected stamps that rise, got others.")
    if not np.isfinite(rates).all():
        raise InputError("gyro_prior: expected finite rates, got others.")
    if not stamps[0] <= start < end:
        raise InputError(
            f"gyro_prior: expected stamps from {start:g} s on and an end after it, got "
            f"stamps from {stamps[0]:g} s and the end {end:g} s."
        )
