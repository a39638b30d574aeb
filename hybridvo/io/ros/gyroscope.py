"""Samples of a gyroscope, from their messages to the frame that comes after them."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

from hybridvo.core.imu import IMU_KEPT_S, MAX_CLOCK_JUMP_S, ImuSamples
from hybridvo.io.data.bags.messages import imu_row

NS = 1e9
"""Nanoseconds in a second."""


def has_rates(message: Any) -> bool:
    """Return whether an ``Imu`` holds rates: -1 in their covariance says that it does not."""
    return bool(message.angular_velocity_covariance[0] >= 0)


class Rates:
    """Samples that no frame has taken yet, in the order of their stamps.

    Attributes:
        latest_ns: the stamp of the latest sample; None where none has come.
        frame_id: the name of its axes.
    """

    def __init__(self) -> None:
        self.latest_ns: float | None = None
        self.frame_id = ""
        # as ``imu_row`` has them
        self._rows: deque[list[float]] = deque()

    def add(self, message: Any, needed_from_ns: int | None) -> None:
        """Add a sample; one that comes late or twice is left out.

        Args:
            message: A ``sensor_msgs/Imu`` with rates.
            needed_from_ns: The stamp of the first frame that waits; None where none does.
        """
        row = imu_row(message)
        if not np.isfinite(row).all():
            return
        self.frame_id = str(message.header.frame_id).lstrip("/")
        if self.latest_ns is not None and row[0] <= self.latest_ns:
            if self.latest_ns - row[0] < MAX_CLOCK_JUMP_S * NS:
                return
            # a bag that is played again
            self._rows.clear()
        self.latest_ns = row[0]
        self._rows.append(row)
        needed_ns = row[0] if needed_from_ns is None else needed_from_ns
        while self._rows and self._rows[0][0] < needed_ns - IMU_KEPT_S * NS:
            self._rows.popleft()

    def reach(self, stamp_ns: int | None) -> bool:
        """Return whether all samples before a stamp have come; for none they have."""
        if stamp_ns is None:
            return True
        return self.latest_ns is not None and self.latest_ns >= stamp_ns

    def taken(
        self, stamp_ns: int, R_cam_imu: np.ndarray | None
    ) -> ImuSamples | None:
        """Take the samples before the stamp of a frame.

        Args:
            stamp_ns: The stamp.
            R_cam_imu: (3, 3) from the axes of the sensor to those of the camera; None where it is
                not known.

        Returns:
            The samples; None where there are none, or where they cannot be used.
        """
        rows = list[list[float]]()
        # as seconds, for then a sample counts as before where the tracker says so
        while self._rows and self._rows[0][0] / NS < stamp_ns / NS:
            rows.append(self._rows.popleft())
        if not rows or R_cam_imu is None:
            return None
        samples = np.array(rows)
        accelerations = samples[:, 4:7]
        # a sensor that is only a gyroscope leaves them at 0
        has_accelerations = bool(accelerations.any())
        return ImuSamples(
            samples[:, 0] / NS,
            samples[:, 1:4],
            R_cam_imu,
            accelerations if has_accelerations else None,
        )
