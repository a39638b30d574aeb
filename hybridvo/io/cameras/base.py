"""What every live camera offers, and what the drivers share."""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.imu import ImuSamples
from hybridvo.core.types import Frame
from hybridvo.io.cameras.settings import CameraSettings
from hybridvo.io.data.sequence import undistort
from hybridvo.io.data.streams import Lens, check_lens

SYSTEM_PACKAGES = {"pyrealsense2": "libusb-1.0-0"}
"""Packages of Debian and Ubuntu without which an SDK cannot be loaded."""


class CameraLost(Exception):
    """A camera gives no frames for now; it may be opened again."""


class EndOfFrames(Exception):
    """A recording that is played has come to its end."""


class Reading(NamedTuple):
    """What a camera hands out.

    Attributes:
        frame: the frame; None where one came that cannot be used.
        age_s: seconds from its exposure until it was handed out; 0 where no clock gives it.
        number: of the frame by the camera's own count, in which a gap is a lost frame.
        note: what was wrong with it, or what the user should know of the camera.
        is_gone: whether what it would have come from is no longer there.
        imu: what the camera's IMU measured since the frame before, by the clock of the stamp;
            None where there is none. Readings later than the frame may be among them.
    """

    frame: Frame | None
    age_s: float = 0.0
    number: int | None = None
    note: str = ""
    is_gone: bool = False
    imu: ImuSamples | None = None


class LiveCamera(Protocol):
    """A camera, as :func:`hybridvo.io.live.stream` uses it.

    All three methods are called in one thread. Whatever they raise is a lost camera, which is
    closed and opened again after a while; an InputError before the first frame ends the stream.

    Attributes:
        name: for messages.

    A camera may state its frames a second as ``fps``: the budget of a frame is then its period.

    Example:
        A camera of one's own needs no base class::

            class MyCamera:
                name = "mine"

                def open(self):
                    self.device = sdk.connect()

                def read(self, timeout_s):
                    rgb, depth, stamp = self.device.wait(timeout_s)
                    return Reading(Frame(rgb, depth, intrinsics, stamp))

                def close(self):
                    self.device.disconnect()
    """

    name: str

    def open(self) -> None:
        """Connect and start; called again after :meth:`close`."""

    def read(self, timeout_s: float) -> Reading | None:
        """Wait for the next frame.

        Args:
            timeout_s: how long at most, seconds.

        Returns:
            What came, with arrays that the camera does not change afterwards; None in time.

        Raises:
            EndOfFrames: there will be none.
        """

    def close(self) -> None:
        """Stop and disconnect."""


class FrameMaker:
    """Makes frames of what an SDK hands out: without distortion, depth in metres and in range.

    Args:
        lens: the camera of the image, to which depth is registered.
        settings: what was requested of the camera.

    Raises:
        FormatError: the distortion is of an unknown kind.

    Example:
        >>> from hybridvo.core.types import Camera
        >>> lens = Lens(Camera(50.0, 50.0, 1.0, 0.5, height=2, width=3))
        >>> maker = FrameMaker(lens, CameraSettings(max_depth_m=4.0))
        >>> frame = maker.frame(np.zeros((2, 3), np.uint8), np.full((2, 3), 5.0), 0.1)
        >>> float(frame.depth.max())
        0.0
    """

    def __init__(self, lens: Lens, settings: CameraSettings) -> None:
        check_lens(lens, settings.driver)
        self._camera = lens.camera
        if settings.image == "color":
            # no SDK states them
            self._camera = replace(
                lens.camera,
                readout_ms=settings.readout_ms,
                depth_lag_ms=settings.depth_lag_ms,
            )
        self._maps = None if lens.is_straight else lens.maps()
        self._nearest = settings.min_depth_m
        self._farthest = settings.max_depth_m or np.inf

    def frame(
        self, rgb: np.ndarray, depth: np.ndarray | None, stamp_s: float
    ) -> Frame:
        """Make a frame.

        Args:
            rgb: (H, W, 3) or (H, W) uint8.
            depth: (H, W) metres along the optical axis, registered to the image; None without.
            stamp_s: time of the exposure, seconds.
        """
        mask = None
        if depth is not None:
            in_range = (depth >= self._nearest) & (depth <= self._farthest)
            depth = np.where(in_range, depth, np.float32(0)).astype(np.float32)
        image: np.ndarray | None = rgb
        if self._maps is not None:
            image, depth, mask = undistort(self._maps, rgb, depth, None)
        return Frame(image, depth, self._camera, stamp_s, mask=mask)


def rate_of(camera: LiveCamera) -> float | None:
    """Frames a second of a camera, by its attribute ``fps``; None where it states none."""
    fps = getattr(camera, "fps", None)
    return float(fps) if fps and np.isfinite(fps) and fps > 0 else None


def warnings_of(camera: LiveCamera) -> list[str]:
    """What a camera noticed when it was made; a recording that is played has such sentences."""
    return list(getattr(camera, "warnings", ()))


def load_sdk(module: str, extra: str) -> Any:
    """Import the SDK of a camera.

    Args:
        module: its name in Python.
        extra: the extra of hybridvo that installs it.

    Returns:
        The module.

    Raises:
        InputError: it is not installed, or a library of the system is missing.

    Example:
        >>> load_sdk("no_such_sdk", "oak")
        Traceback (most recent call last):
        hybridvo.core.errors.InputError: camera oak: no_such_sdk is not installed: pip install \
'hybridvo[oak]'.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        problem = f"{module} is not installed: pip install 'hybridvo[{extra}]'"
    except ImportError as error:
        problem = f"{module} cannot be loaded: {error}"
        package = SYSTEM_PACKAGES.get(module)
        if package is not None:
            problem += f". On Debian and Ubuntu: apt-get install {package}"
    raise InputError(f"camera {extra}: {problem}.")
