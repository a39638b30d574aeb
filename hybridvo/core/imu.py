"""What an inertial sensor on the camera measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hybridvo.core.checks import as_number, as_rigid, to_numpy
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import make_transform

# s between what stamps say and what they should, from which the clock has jumped:
# USB holds frames up by some tenths of a second, a bag may be played again
MAX_CLOCK_JUMP_S = 1.0
# s over which samples are kept that no frame has taken: after a minute without a
# usable frame the path is lost anyway
IMU_KEPT_S = 60.0

ROTATION_TOLERANCE = 1e-3
"""By which the axes of a sensor may differ from a rotation, entry by entry."""


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """What a gyroscope, and an accelerometer if there is one, measured beside a camera.

    Attributes:
        stamps: (N,) seconds, increasing, on the clock of the frames.
        rates: (N, 3) rad/s about the axes of the sensor.
        R_cam_imu: (3, 3) rotation from the axes of the sensor to those of the camera.
        accelerations: (N, 3) m/s^2 along the axes of the sensor, with gravity, so that a sensor
            at rest reads 9.81 upwards; or None. They give the direction of gravity, and
            never change a motion.

    Raises:
        InputError: the stamps do not increase, a value is not finite, a shape is wrong, or
            ``R_cam_imu`` is no rotation.

    >>> samples = ImuSamples(np.array([0.0, 0.01]), np.zeros((2, 3)))
    >>> len(samples), len(samples.between(0.005, 0.02))
    (2, 2)
    """

    stamps: np.ndarray
    rates: np.ndarray
    R_cam_imu: np.ndarray | None = None
    accelerations: np.ndarray | None = None

    def __post_init__(self) -> None:
        stamps = to_numpy(self.stamps, "ImuSamples.stamps")
        _set(self, "stamps", stamps, stamps.shape[:1])
        if self.stamps.ndim != 1 or not (np.diff(self.stamps) > 0).all():
            raise InputError(
                "ImuSamples.stamps: expected (N,) that rise, got others."
            )
        count = len(self.stamps)
        _set(self, "rates", self.rates, (count, 3))
        if self.accelerations is not None:
            _set(self, "accelerations", self.accelerations, (count, 3))
        R = np.eye(3) if self.R_cam_imu is None else self.R_cam_imu
        _set(self, "R_cam_imu", R, (3, 3))
        T = make_transform(np.asarray(self.R_cam_imu), np.zeros(3))
        as_rigid(T, "ImuSamples.R_cam_imu", ROTATION_TOLERANCE)

    def __len__(self) -> int:
        return len(self.stamps)

    def between(self, start: float, end: float) -> ImuSamples:
        """Return the samples that are in force between two times.

        Args:
            start: seconds; the last sample at or before it is among them.
            end: seconds.

        Returns:
            These samples.
        """
        first = int(np.searchsorted(self.stamps, as_number(start), "right")) - 1
        last = int(np.searchsorted(self.stamps, as_number(end), "left"))
        return self.part(max(first, 0), last)

    def part(self, first: int, last: int | None = None) -> ImuSamples:
        """Return some samples that follow each other.

        Args:
            first: number of the first one.
            last: number of the first one after them; None: up to the end.

        Returns:
            These samples.
        """
        accelerations = self.accelerations
        if accelerations is not None:
            accelerations = accelerations[first:last]
        return ImuSamples(
            self.stamps[first:last],
            self.rates[first:last],
            self.R_cam_imu,
            accelerations,
        )

    def joined(self, later: ImuSamples) -> ImuSamples:
        """Return these samples and those that come after them.

        Args:
            later: of the same sensor; what is not after the last of these is left out.

        Returns:
            All of them; with accelerations if both have some.
        """
        if not len(self):
            return later
        new = later.stamps > self.stamps[-1]
        accelerations = None
        if self.accelerations is not None and later.accelerations is not None:
            accelerations = np.concatenate(
                [self.accelerations, later.accelerations[new]]
            )
        return ImuSamples(
            np.concatenate([self.stamps, later.stamps[new]]),
            np.concatenate([self.rates, later.rates[new]]),
            later.R_cam_imu,
            accelerations,
        )

    def shifted(self, seconds: float) -> ImuSamples:
        """Return these samples on another clock.

        Args:
            seconds: what their stamps are too early by.

        Returns:
            The same samples with later stamps.
        """
        return replace(self, stamps=self.stamps + as_number(seconds))


def with_earlier(
    earlier: ImuSamples | None, later: ImuSamples | None
) -> ImuSamples | None:
    """Return samples with those of the frames before, which no motion has used yet.

    Args:
        earlier: what those frames left.
        later: what came with this frame.

    Returns:
        All of them, of the last minute; ``later`` alone where the clock jumped back.

    >>> one = ImuSamples(np.array([5.0, 5.1]), np.zeros((2, 3)))
    >>> len(with_earlier(one, one.shifted(0.2))), len(with_earlier(one, one.shifted(-4)))
    (4, 2)
    """
    if earlier is None or not len(earlier):
        return later
    if later is None or not len(later):
        return earlier
    if later.stamps[0] < earlier.stamps[-1] - MAX_CLOCK_JUMP_S:
        return later
    joined = earlier.joined(later)
    return joined.between(joined.stamps[-1] - IMU_KEPT_S, np.inf)


def rising(rows: np.ndarray) -> np.ndarray:
    """Return the readings of a sensor that are finite and rise in time.

    Args:
        rows: (N, K) each with its stamp in the first column.

    Returns:
        (M, K) those that are finite and later than all before them.
    """
    whole = rows[np.isfinite(rows).all(axis=1)]
    if not len(whole):
        return whole
    latest = np.maximum.accumulate(whole[:, 0])
    return np.ascontiguousarray(whole[np.diff(latest, prepend=-np.inf) > 0])


def _set(
    samples: ImuSamples, name: str, value: object, shape: tuple[int, ...]
) -> None:
    """Set an attribute to finite numbers of a shape, as float64."""
    array = to_numpy(value, f"ImuSamples.{name}")
    is_number = array.dtype.kind in "fiu"
    if array.shape != shape or not is_number or not np.isfinite(array).all():
        raise InputError(
            f"ImuSamples.{name}: expected finite numbers of shape {shape}, got "
            f"{array.dtype} {array.shape}."
        )
    object.__setattr__(samples, name, array.astype(np.float64))
