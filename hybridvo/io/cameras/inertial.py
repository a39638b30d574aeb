"""The inertial sensor of a camera: its readings as they come, handed out with the frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from hybridvo.core.imu import ImuSamples, rising
from hybridvo.io.cameras.base import Reading

# readings a second that are requested, or the next rate above: what EuRoC's sensor
# gives
IMU_RATE_HZ = 200
# readings that are held while no frame comes: ten seconds of the fastest
IMU_READINGS = 4000
# s by which accelerations may end before the rates, or begin after them: several
# readings of the slowest sensor, 63 a second
MAX_ACCELERATION_LAG_S = 0.1

Readings = deque[tuple[float, float, float, float]]
"""Stamps, seconds, each with the three numbers that were read."""


class ImuBuffer:
    """What a gyroscope and an accelerometer read since the last frame.

    The two have rates of their own: accelerations are interpolated to the stamps of the
    gyroscope. Readings may come in a thread of the SDK.

    Args:
        R_cam_imu: (3, 3) from the axes of the sensor to those of the image.

    Raises:
        InputError: that is no rotation.

    Example:
        >>> buffer = ImuBuffer(np.eye(3))
        >>> buffer.add_acceleration(0.0, (0.0, -9.8, 0.0))
        >>> buffer.add_rate(0.005, (0.1, 0.0, 0.0))
        >>> buffer.take().accelerations.tolist()
        [[0.0, -9.8, 0.0]]
    """

    def __init__(self, R_cam_imu: np.ndarray) -> None:
        # refused here, once, and not with the first frame
        nothing = ImuSamples(np.zeros(0), np.zeros((0, 3)), R_cam_imu)
        self._R_cam_imu = nothing.R_cam_imu
        self._rates: Readings = deque(maxlen=IMU_READINGS)
        self._accelerations: Readings = deque(maxlen=IMU_READINGS)

    def add_rate(self, stamp_s: float, rate: tuple[float, float, float]) -> None:
        """Keep what the gyroscope read: rad/s about its axes."""
        self._rates.append((stamp_s, *rate))

    def add_acceleration(
        self, stamp_s: float, acceleration: tuple[float, float, float]
    ) -> None:
        """Keep what the accelerometer read: m/s^2 along its axes, with gravity."""
        self._accelerations.append((stamp_s, *acceleration))

    def take(self) -> ImuSamples | None:
        """Return what came since the last call; None where the gyroscope gave nothing."""
        rates = _taken(self._rates)
        if not len(rates):
            return None
        stamps = rates[:, 0]
        return ImuSamples(
            stamps, rates[:, 1:], self._R_cam_imu, self._accelerations_at(stamps)
        )

    def _accelerations_at(self, stamps: np.ndarray) -> np.ndarray | None:
        """Accelerations (N, 3) at some times; None where there are none near them."""
        # the last one may also stand for the beginning of the next samples
        held = _taken(self._accelerations)
        if len(held):
            self._accelerations.appendleft(tuple(held[-1]))
        is_near = (
            len(held)
            and held[0, 0] - stamps[0] <= MAX_ACCELERATION_LAG_S
            and stamps[-1] - held[-1, 0] <= MAX_ACCELERATION_LAG_S
        )
        if not is_near:
            return None
        axes = [np.interp(stamps, held[:, 0], axis) for axis in held[:, 1:].T]
        return np.stack(axes, axis=1)


class CameraImu:
    """The inertial sensor of a camera that is open, and why it is not used.

    Args:
        start: starts it and returns its buffer; None where the camera has none. Whatever it
            raises means that the camera is used without it.
    """

    def __init__(self, start: Callable[[], ImuBuffer | None]) -> None:
        self._note = ""
        self._buffer: ImuBuffer | None = None
        try:
            self._buffer = start()
        except Exception as error:
            # an SDK raises what it likes
            self.leave_out(str(error) or type(error).__name__)

    def leave_out(self, reason: str) -> None:
        """Use the camera without it; the next frame says why."""
        self._buffer = None
        self._note = f"its IMU is not used: {' '.join(reason.split())}"

    def added_to(self, reading: Reading) -> Reading:
        """Return a frame with the samples since the frame before."""
        note = self._note or reading.note
        self._note = ""
        imu = None if self._buffer is None else self._buffer.take()
        return reading._replace(note=note, imu=imu)


def _taken(readings: Readings) -> np.ndarray:
    """Take all readings (N, 4) that are finite and rise in time."""
    rows = [readings.popleft() for _ in range(len(readings))]
    return rising(np.array(rows, dtype=np.float64).reshape(-1, 4))
