"""The reader of OpenLORIS-Scene: a robot's RealSense, with poses measured from outside."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.bags.messages import transform_between
from hybridvo.io.data.camera_file import (
    DISTORTION_LENGTHS,
    Calibration,
    read_opencv_yaml,
)
from hybridvo.io.data.datasets import TumSequence
from hybridvo.io.data.image_io import as_pose

COLOUR_FRAME = "d400_color_optical_frame"
BODY_FRAME = "base_link"
"""The frame of the robot, of which ``groundtruth.txt`` holds the poses."""
DEPTH_LIST = "aligned_depth.txt"


class OpenLorisSequence(TumSequence):
    """A sequence such as ``office1-1`` in package form: ``color.txt``, ``aligned_depth.txt``.

    The camera is in ``sensors.yaml``, and its place on the robot in ``trans_matrix.yaml``.
    """

    kind = "openloris"
    depth_scale = 1000.0
    markers: tuple[tuple[str, ...], ...] = (("color.txt", DEPTH_LIST),)

    def _list_files(self) -> None:
        self._match_lists("color.txt", DEPTH_LIST)
        self._take_truth()

    def _take_truth(self) -> None:
        """Take the poses of the robot, brought to the camera."""
        path = self.root / "groundtruth.txt"
        if not path.is_file():
            return
        T_body_camera = self._place_of_camera()
        if T_body_camera is None:
            T_body_camera = np.eye(4)
            self._assume(
                f"trans_matrix.yaml does not lead from {BODY_FRAME} to {COLOUR_FRAME}: the true "
                "poses are taken as those of the camera"
            )
        stamps, poses = lists.read_timed_poses(path, self.warnings)
        self.poses = lists.poses_at(
            self.timestamps, stamps, poses @ T_body_camera, path, self.warnings
        )

    def _place_of_camera(self) -> np.ndarray | None:
        """``T_body_camera`` (4, 4) of ``trans_matrix.yaml``; None where it has none."""
        path = self.root / "trans_matrix.yaml"
        if not path.is_file():
            return None
        content = read_opencv_yaml(path)
        entries = content.get("trans_matrix")
        edges: dict[tuple[str, str], np.ndarray] = {}
        for entry in entries if isinstance(entries, list) else []:
            if not isinstance(entry, dict):
                continue
            stored = _numbers(entry.get("matrix"), 16, f"{path}: matrix")
            edge = (str(entry.get("parent_frame")), str(entry.get("child_frame")))
            edges[edge] = as_pose(stored.reshape(4, 4)[:3], str(path))
        return transform_between(edges, BODY_FRAME, COLOUR_FRAME)

    def _calibration(self) -> Calibration:
        path = self.root / "sensors.yaml"
        if not path.is_file():
            raise InputError(
                f"{path}: not there: it holds the camera of {COLOUR_FRAME}; or give "
                "--camera fx,fy,cx,cy."
            )
        sensor = read_opencv_yaml(path).get(COLOUR_FRAME)
        if not isinstance(sensor, dict):
            raise FormatError(f"{path}: expected '{COLOUR_FRAME}:', found none.")
        # in this order
        where = f"{path}: {COLOUR_FRAME}: intrinsics (fx cx fy cy)"
        fx, cx, fy, cy = _numbers(sensor.get("intrinsics"), 4, where).tolist()
        distortion: tuple[float, ...] = ()
        if sensor.get("distortion_coefficients") is not None:
            stored = sensor["distortion_coefficients"]
            values = _numbers(stored, None, f"{path}: distortion_coefficients")
            distortion = tuple(values.tolist()) if values.any() else ()
        if len(distortion) not in DISTORTION_LENGTHS:
            raise FormatError(
                f"{path}: distortion_coefficients: expected 4, 5 or 8 numbers, got "
                f"{len(distortion)}."
            )
        with format_errors(f"{path}: {COLOUR_FRAME}"):
            size: Any = (sensor.get("height"), sensor.get("width"))
            return Calibration(
                Camera(fx, fy, cx, cy, height=size[0], width=size[1]), distortion
            )


def _numbers(matrix: Any, count: int | None, where: str) -> np.ndarray:
    """The numbers of a matrix of OpenCV, (N,)."""
    stored = matrix.get("data") if isinstance(matrix, dict) else matrix
    try:
        values = np.array(stored, np.float64).reshape(-1)
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if not np.isfinite(values).all() or (count and values.size != count):
        expected = f"{count} numbers" if count else "numbers"
        raise FormatError(f"{where}: expected {expected}, got {str(stored)[:80]}.")
    return values
