"""An accelerometer beside the images: the direction of gravity in the world of the tracker."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.geometry import cross_matrix
from hybridvo.core.gravity import Gravity
from hybridvo.core.imu import ImuSamples
from hybridvo.core.results import Step
from hybridvo.tracking.calibration import (
    ACCELERATION_MEMORY_S,
    ACCELERATION_STD,
    ACCELERATION_TIME_S,
    ACCELEROMETER_BIAS_STD,
    FIRST_ACCELERATION_S,
    GYRO_HOLD_S,
    MIN_ACCELERATION_STD,
)

# What an accelerometer at rest reads, m/s^2; over the earth it differs by .3 per cent.
STANDARD_GRAVITY = 9.80665
# Standard deviation of the force along each axis before the first sample, m/s^2: unknown.
UNKNOWN_FORCE_STD = 1e3


@dataclass(frozen=True, eq=False)
class Accelerometer:
    """What is known of the mean of all accelerations, turned into the world.

    An accelerometer reads the camera's own acceleration less gravity. The first is noise with a
    mean of zero that lasts for a fraction of a second; its variance is learned from how far the
    mean of each frame is from a vector of gravity's length. So the mean of all frames points up.
    The rotation of the tracker drifts: the covariance of each step makes the mean less sure. The
    sensor's bias turns with the camera: what is left of it in the mean is the mean rotation.
    """

    # mean reading in the world, m/s^2
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))
    covariance: np.ndarray = field(
        default_factory=lambda: UNKNOWN_FORCE_STD**2 * np.eye(3)
    )
    # mean rotation from the sensor to the world
    R_world_imu: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    # of the camera's own acceleration along each axis, m^2/s^4
    variance: float = ACCELERATION_STD**2
    variance_s: float = FIRST_ACCELERATION_S  # time over which that was averaged
    stamp: float | None = None  # of the last sample that was used

    def after(
        self, samples: ImuSamples, bias: np.ndarray, step: Step, leads: bool = True
    ) -> Accelerometer:
        """Return what is known after the samples up to a step.

        Args:
            samples: those that are held, with accelerations; what was used before, what comes
                after the step, and what a gap parts from it is left out.
            bias: (3,) of the rates, rad/s.
            step: with the pose of the camera at its time.
            leads: whether the world goes on from that pose. If not, the error of the step is one
                of its readings alone.
        """
        new = self._new(samples, step.timestamp)
        if not len(new):
            return self
        readings = _at_one_time(new, bias, step.timestamp)
        R_world_cam = step.T_world_cam[:3, :3]
        mean = R_world_cam @ readings.mean(axis=0)
        duration = self._duration(new)
        # how far a camera at rest is from what was read
        own = _square(mean - self._at_rest(mean)) / 3
        variance_s = self.variance_s + duration
        variance = self.variance + duration / variance_s * (own - self.variance)
        variance = max(variance, MIN_ACCELERATION_STD**2)
        # what was read before had the same noise: all times weigh alike, for what speeds a camera
        # up slows it down again
        before = self.covariance * (variance / self.variance)
        counted = duration if self.force.any() else ACCELERATION_TIME_S
        # a mean over a short time is one draw of an acceleration that lasts longer
        noise = variance * 2 * ACCELERATION_TIME_S / counted
        noise += float(readings.var(axis=0).mean()) / len(new)
        spread = noise * np.eye(3)
        if not leads:
            spread += _turned_by(mean, step)
        gain = before @ np.linalg.inv(before + spread)
        covariance = (np.eye(3) - gain) @ before
        return Accelerometer(
            self.force + gain @ (mean - self.force),
            (covariance + covariance.T) / 2,
            self.R_world_imu
            + gain @ (R_world_cam @ new.R_cam_imu - self.R_world_imu),
            variance,
            min(variance_s, ACCELERATION_MEMORY_S),
            float(new.stamps[-1]),
        )

    def drifted(self, step: Step) -> Accelerometer:
        """Return what is known in a world that turns with the error of a step."""
        turned = _turned_by(self.force, step)
        return replace(self, covariance=self.covariance + turned)

    def moved(self, T_new_old: np.ndarray) -> Accelerometer:
        """Return the same in another world, (4, 4) from the old one."""
        R = T_new_old[:3, :3]
        return replace(
            self,
            force=R @ self.force,
            covariance=R @ self.covariance @ R.T,
            R_world_imu=R @ self.R_world_imu,
        )

    def elsewhere(self) -> Accelerometer:
        """Return what is left in a world whose rotation from this one is not known."""
        return replace(
            Accelerometer(),
            variance=self.variance,
            variance_s=self.variance_s,
            stamp=self.stamp,
        )

    def gravity(self) -> Gravity | None:
        """Return the direction of gravity; None while nothing has been read."""
        length = float(np.linalg.norm(self.force))
        if length == 0:
            return None
        direction = -self.force / length
        # along gravity the bias can be seen
        bias = ACCELEROMETER_BIAS_STD**2 + (length - STANDARD_GRAVITY) ** 2
        R = self.R_world_imu
        across = np.eye(3) - np.outer(direction, direction)
        covariance = across @ (self.covariance + bias * R @ R.T) @ across
        return Gravity(direction, covariance / length**2)

    def _new(self, samples: ImuSamples, end: float) -> ImuSamples:
        """The samples that were not used yet, up to a time, without a gap before it."""
        first = 0
        if self.stamp is not None:
            first = int(np.searchsorted(samples.stamps, self.stamp, "right"))
        last = int(np.searchsorted(samples.stamps, end, "right"))
        new = samples.part(first, last)
        steps = np.diff(np.append(new.stamps, end))
        broken = np.flatnonzero(steps > GYRO_HOLD_S)
        return new.part(int(broken[-1]) + 1) if len(broken) else new

    def _duration(self, new: ImuSamples) -> float:
        """Time that some samples stand for, seconds."""
        start = new.stamps[0] if self.stamp is None else self.stamp
        steps = np.diff(np.concatenate([[start], new.stamps]))
        return float(np.minimum(steps, GYRO_HOLD_S).sum())

    def _at_rest(self, mean: np.ndarray) -> np.ndarray:
        """What a camera at rest would read, by what is known; by a mean where that is nothing."""
        force = self.force if self.force.any() else mean
        length = np.linalg.norm(force)
        return force * (STANDARD_GRAVITY / length) if length > 0 else force


def _at_one_time(samples: ImuSamples, bias: np.ndarray, stamp: float) -> np.ndarray:
    """Accelerations (N, 3) along the axes that the camera has at a time, by the gyroscope."""
    assert samples.accelerations is not None
    durations = np.diff(np.append(samples.stamps, stamp))
    turns = Rotation.from_rotvec((samples.rates - bias) * durations[:, None])
    R_sample_next = turns.as_matrix()
    R_sample_end = np.eye(3)
    readings = np.empty_like(samples.accelerations)
    for k in reversed(range(len(samples))):
        R_sample_end = R_sample_next[k] @ R_sample_end
        readings[k] = R_sample_end.T @ samples.accelerations[k]
    return np.asarray(readings @ np.asarray(samples.R_cam_imu).T)


def _turned_by(force: np.ndarray, step: Step) -> np.ndarray:
    """Covariance (3, 3) of a vector in the world by the rotation's error of a step."""
    rotation = step.covariance[3:, 3:]
    lever = cross_matrix(force) @ step.T_world_cam[:3, :3]
    # a large turn shortens the part along the vector, by the mean of 1 - cos
    shorter = np.trace(rotation) / 2 * force
    across: np.ndarray = lever @ rotation @ lever.T
    return across + np.outer(shorter, shorter)


def _square(vector: np.ndarray) -> float:
    """The squared length of a vector."""
    return float(vector @ vector)
