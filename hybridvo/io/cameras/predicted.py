"""A camera whose depth, or masks of people, come from networks."""

from __future__ import annotations

import time
from collections.abc import Callable

from hybridvo.core.types import Frame
from hybridvo.io.cameras.base import LiveCamera, Reading, rate_of, warnings_of


class PredictedCamera:
    """Another camera, whose frames go through networks in the thread that reads them.

    Args:
        camera: any camera.
        networks: called one after the other with a frame; each returns a frame.
        clock: seconds, from any start.

    Attributes:
        fps: frames a second, where the camera states them.
        warnings: those of the camera.

    Example:
        >>> from hybridvo.io.onnx.depth import DepthNetwork
        >>> depth = DepthNetwork("onnx:metric3d.onnx")  # doctest: +SKIP
        >>> camera = PredictedCamera(webcam, [depth])  # doctest: +SKIP
    """

    def __init__(
        self,
        camera: LiveCamera,
        networks: list[Callable[[Frame], Frame]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = camera.name
        self.fps = rate_of(camera)
        self.warnings = warnings_of(camera)
        self._camera = camera
        self._networks = networks
        self._clock = clock

    def open(self) -> None:
        """Connect and start."""
        self._camera.open()

    def read(self, timeout_s: float) -> Reading | None:
        """Wait for the next frame, and run the networks on it."""
        reading = self._camera.read(timeout_s)
        if reading is None or reading.frame is None:
            return reading
        started = self._clock()
        frame = reading.frame
        for network in self._networks:
            frame = network(frame)
        age = reading.age_s + self._clock() - started
        return reading._replace(frame=frame, age_s=age)

    def close(self) -> None:
        """Stop and disconnect."""
        self._camera.close()
