"""A gyroscope beside the images: the rotation to expect, and the bias that the images show."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.imu import ImuSamples, with_earlier
from hybridvo.core.results import MotionPrior, Step, Term
from hybridvo.solver.calibration import PRIOR_FREEDOM
from hybridvo.tracking.calibration import (
    GYRO_BIAS_STD,
    GYRO_BIAS_WALK,
    GYRO_HOLD_S,
    GYRO_MAX_MISFIT,
    GYRO_MIN_COMPARED,
    GYRO_NOISE_DENSITY,
    MIN_OF_IMAGES,
)
from hybridvo.tracking.inertial import gyro_prior


def _no_samples() -> ImuSamples:
    return ImuSamples(np.zeros(0), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Gyroscope:
    """The samples that may still be needed, and what is known of the bias of the sensor.

    The bias is a state that walks: each sure step whose rotation the images found corrects it.
    """

    samples: ImuSamples = field(default_factory=_no_samples)
    bias: np.ndarray = field(default_factory=lambda: np.zeros(3))  # rad/s
    covariance: np.ndarray = field(
        default_factory=lambda: GYRO_BIAS_STD**2 * np.eye(3)
    )
    # steps that were compared, and the mean of their squared distances, in units of what both err
    compared: int = 0
    misfit: float = 0.0

    @property
    def contradicts_images(self) -> bool:
        """Whether it turns otherwise than the images, again and again: it is then left out."""
        return self.compared >= GYRO_MIN_COMPARED and self.misfit > GYRO_MAX_MISFIT

    def after(self, samples: ImuSamples) -> Gyroscope:
        """Return the gyroscope after further samples; it starts anew where their clock does."""
        held = with_earlier(self.samples, samples)
        return self if held is None else replace(self, samples=held)

    def since(self, stamp: float) -> Gyroscope:
        """Return the gyroscope without samples that are older than is needed from a time on."""
        held = self.samples.between(stamp - GYRO_HOLD_S, np.inf)
        return replace(self, samples=held)

    def prior(
        self, start: float, end: float, expected: MotionPrior | None
    ) -> MotionPrior | None:
        """Return what is expected of the motion between two times.

        Args:
            start: of the frame from which the motion starts, seconds.
            end: of the frame that is tracked.
            expected: the motion by constant velocity, where it is known: its translation stays.

        Returns:
            The rotation by the gyroscope; ``expected`` where samples are missing.
        """
        measured = self.measured(start, end)
        if measured is None:
            return expected
        T = measured.T_curr_prev.copy()
        covariance = measured.covariance.copy()
        if expected is not None:
            T[:3, 3] = expected.T_curr_prev[:3, 3]
            covariance[:3, :3] = expected.covariance[:3, :3]
        return MotionPrior(T, covariance)

    def measured(self, start: float, end: float) -> MotionPrior | None:
        """Return the rotation between two times; None where samples are missing.

        Args:
            start: seconds.
            end: seconds.

        Returns:
            The rotation, as uncertain as noise and bias make it, and an unknown translation.
        """
        turned = self._integrated(start, end)
        if turned is None or self.contradicts_images:
            return None
        covariance = turned.covariance.copy()
        covariance[3:, 3:] += (end - start) ** 2 * self._in_camera(self.covariance)
        return MotionPrior(turned.T_curr_prev, covariance)

    def corrected(self, step: Step, start: float, end: float) -> Gyroscope:
        """Return the gyroscope after a step, whose rotation shows the bias.

        What the gyroscope itself added to the step teaches nothing.

        Args:
            step: a step from a frame to another one.
            start: the stamp of the first, seconds.
            end: the stamp of the second.
        """
        walked = self.covariance + GYRO_BIAS_WALK**2 * (end - start) * np.eye(3)
        waited = replace(self, covariance=walked)
        measured = self.measured(start, end) if step.ok else None
        if measured is None:
            return waited
        duration = end - start
        turned = step.T_curr_prev[:3, :3] @ measured.T_curr_prev[:3, :3].T
        rotation = Rotation.from_matrix(turned).as_rotvec()
        of_images = step.covariance[3:, 3:]
        if Term.GYROSCOPE in step.motion.terms:
            # as it was without the sensor
            kept = np.eye(3) - of_images @ np.linalg.inv(
                measured.covariance[3:, 3:]
            )
            if np.linalg.eigvals(kept).real.min() < MIN_OF_IMAGES:
                return waited
            rotation = np.linalg.solve(kept, rotation)
            of_images = np.linalg.solve(kept, of_images)
        # what the gyroscope turned too far, about the axes of the sensor
        error = self._in_sensor(rotation) / duration
        of_images = self._R.T @ of_images @ self._R
        noise = of_images / duration**2 + GYRO_NOISE_DENSITY**2 / duration * np.eye(
            3
        )
        squared = float(error @ np.linalg.solve(walked + noise, error))
        # Student's kernel: a step that is wrong says little
        factor = (PRIOR_FREEDOM + 3) / (PRIOR_FREEDOM + squared)
        gain = walked @ np.linalg.inv(walked + noise / min(factor, 1.0))
        compared = self.compared + 1
        change = min(squared, 3 * GYRO_MAX_MISFIT) - self.misfit
        return replace(
            self,
            bias=self.bias + gain @ error,
            covariance=(np.eye(3) - gain) @ walked,
            compared=compared,
            misfit=self.misfit + change / min(compared, GYRO_MIN_COMPARED),
        )

    @property
    def _R(self) -> np.ndarray:
        """(3, 3) from the axes of the sensor to those of the camera."""
        return np.asarray(self.samples.R_cam_imu)

    def _in_camera(self, covariance: np.ndarray) -> np.ndarray:
        return self._R @ covariance @ self._R.T

    def _in_sensor(self, vector: np.ndarray) -> np.ndarray:
        return np.asarray(self._R.T @ vector)

    def _integrated(self, start: float, end: float) -> MotionPrior | None:
        """The rotation between two times; None where samples are missing."""
        try:
            return gyro_prior(
                self.samples.stamps,
                self.samples.rates,
                start,
                end,
                self._R,
                bias=self.bias,
            )
        except InputError:
            return None
