"""The camera that a user names, as on the command line."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

from hybridvo.core.errors import InputError
from hybridvo.core.options import NETWORK
from hybridvo.core.pages import page
from hybridvo.core.types import Frame
from hybridvo.io.cameras.base import LiveCamera
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.cameras.oak import OakCamera
from hybridvo.io.cameras.opencv import OpenCVCamera
from hybridvo.io.cameras.orbbec import OrbbecCamera
from hybridvo.io.cameras.predicted import PredictedCamera
from hybridvo.io.cameras.realsense import RealSenseCamera
from hybridvo.io.cameras.settings import CameraSettings, read_preset
from hybridvo.io.data.open import open_sequence
from hybridvo.io.onnx.depth import DepthNetwork
from hybridvo.io.onnx.mask import MaskNetwork

DRIVERS = ("realsense", "oak", "orbbec", "opencv")
"""Names of cameras; anything else is a recording."""


def choose_camera(
    name: str | None = None,
    preset: str | Path | None = None,
    depth: str = "auto",
    mask: str | None = None,
    readout_ms: float | None = None,
    trust: bool = False,
    depth_lag_ms: float | None = None,
    imu: bool = True,
) -> LiveCamera:
    """Make the camera of a name.

    Args:
        name: ``realsense``, ``oak``, ``orbbec`` or ``opencv``, with ``:SERIAL`` (of ``opencv``
            ``:INDEX``) where several are connected, or a folder or file of a recording.
        preset: what to request of it, see :func:`hybridvo.io.cameras.settings.read_preset`.
        depth: ``auto``: the camera's own; or ``onnx:FILE``, a network that predicts it.
        mask: ``onnx:FILE``, a network that finds people, or None.
        readout_ms: time from the first row of an image to the last, where the shutter rolls; by
            default that of the preset, or of the recording.
        trust: whether a recording is read without limits, as in ``open_sequence``.
        depth_lag_ms: how much later than the image depth is measured; by default as above.
        imu: whether the camera's IMU is used, if it has one; ``imu: false`` of a preset counts
            as well.

    Returns:
        The camera, which is not open yet.

    Raises:
        InputError: there is no such camera, its SDK is missing, or the preset is another's.

    Example:
        >>> choose_camera("realsense", preset="kinect_v1")
        Traceback (most recent call last):
        hybridvo.core.errors.InputError: --preset kinect_v1: is for opencv, not for realsense.
    """
    networks: list[Callable[[Frame], Frame]] = []
    if depth != "auto":
        networks.append(DepthNetwork(depth))
    if mask is not None:
        if not mask.startswith(NETWORK):
            raise InputError(f"--mask {mask}: expected {NETWORK}FILE, a network.")
        networks.append(MaskNetwork(mask))
    needs_depth = depth == "auto"
    stated = {"readout_ms": readout_ms, "depth_lag_ms": depth_lag_ms}
    times = {key: value for key, value in stated.items() if value is not None}
    camera = _camera(name, preset, times, needs_depth, trust, imu)
    return PredictedCamera(camera, networks) if networks else camera


def _camera(
    name: str | None,
    preset: str | Path | None,
    times: dict[str, float],
    needs_depth: bool,
    trust: bool,
    imu: bool,
) -> LiveCamera:
    """Make the camera of a name, without networks."""
    settings = None if preset is None else read_preset(preset)
    if name is None:
        if settings is None:
            raise InputError("live: expected --camera or --preset.")
        name = settings.driver
    driver, _, which = name.partition(":")
    if driver not in (*DRIVERS, "own"):
        return _recording(name, preset, times, needs_depth, trust, imu)
    if settings is not None and settings.driver != driver:
        what = f"is for {settings.driver}, not for {driver}"
        raise InputError(f"--preset {preset}: {what}.")
    if driver == "own":
        problem = "hybridvo has no driver for this camera"
        raise InputError(f"--preset {preset}: {problem}; {page('live')} has one.")
    settings = settings or CameraSettings(driver=driver)  # type: ignore[arg-type]
    settings = dataclasses.replace(settings, **times)  # type: ignore[arg-type]
    if not imu:
        settings = dataclasses.replace(settings, imu=False)
    if driver == "opencv":
        if which and not which.isdecimal():
            raise InputError(
                f"--camera {name}: expected opencv:0, or another number."
            )
        return OpenCVCamera(settings, int(which or 0))
    if which:
        settings = dataclasses.replace(settings, serial=which)
    if driver == "realsense":
        return RealSenseCamera(settings)
    return OakCamera(settings) if driver == "oak" else OrbbecCamera(settings)


def _recording(
    name: str,
    preset: str | Path | None,
    times: dict[str, float],
    needs_depth: bool,
    trust: bool,
    imu: bool,
) -> FolderCamera:
    """Open a recording that is played."""
    if preset is not None:
        raise InputError(f"--preset {preset}: a recording has none.")
    if not os.path.exists(name):
        expected = f"{', '.join(DRIVERS)} or a folder or file of a recording"
        raise InputError(f"--camera {name}: expected {expected}.")
    recording = open_sequence(
        name,
        readout_ms=times.get("readout_ms"),
        depth_lag_ms=times.get("depth_lag_ms"),
        needs_depth=needs_depth,
        trust=trust,
    )
    return FolderCamera(recording, imu=imu)
