"""The reader of OpenLORIS-Scene: a robot's RealSense, with poses measured from outside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import MAX_YAML_LENGTH, parse_yaml, read_text
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.bags.messages import transform_between
from hybridvo.io.data.camera_file import DISTORTION_LENGTHS, Calibration
from hybridvo.io.data.image_io import as_pose
from hybridvo.io.data.sequence import Sequence

COLOUR_FRAME = "d400_color_optical_frame"
BODY_FRAME = "base_link"
"""The frame of the robot, of which ``groundtruth.txt`` holds the poses."""
DEPTH_LIST = "aligned_depth.txt"


class OpenLorisSequence(Sequence):
    """A sequence such as ``office1-1`` in package form: ``color.txt``, ``aligned_depth.txt``.

    The camera is in ``sensors.yaml``, and its place on the robot in ``trans_matrix.yaml``.
    """

    kind = "openloris"
    depth_scale = 1000.0
    markers = (("color.txt", DEPTH_LIST),)

    def _list_files(self) -> None:
        stamps, rgb_names = self._read_list("color.txt")
        depth_stamps, depth_names = self._read_list(DEPTH_LIST)
        where = self.root / "color.txt"
        pairs = lists.depth_at(stamps, depth_stamps, where, self.warnings)
        self.timestamps = stamps[[i for i, _ in pairs]]
        self.depth_timestamps = depth_stamps[[j for _, j in pairs]]
        self.rgb_files = [self._file(rgb_names[i], "color.txt") for i, _ in pairs]
        self.depth_files = [
            self._file(depth_names[j], DEPTH_LIST) for _, j in pairs
        ]
        self._take_truth()

    def _read_list(self, name: str) -> tuple[np.ndarray, list[str]]:
        """Read a list ``timestamp filename``."""
        stamps, words = lists.read_stamps(
            self.root / name, self.warnings, "timestamp filename", words=1
        )
        return stamps, [row[0] for row in words]

    def _file(self, name: str, listed_in: str) -> Path:
        return lists.listed_file(self.root, name, self.root / listed_in)

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
        content = _read_opencv(path)
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
        sensor = _read_opencv(path).get(COLOUR_FRAME)
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
        try:
            size: Any = (sensor.get("height"), sensor.get("width"))
            camera = Camera(fx, fy, cx, cy, *size)
        except InputError as error:
            raise FormatError(f"{path}: {COLOUR_FRAME}: {error}") from None
        return Calibration(camera, distortion)


def _read_opencv(path: Path) -> dict[str, Any]:
    """Read a YAML file of OpenCV, whose first line and tags are no plain YAML."""
    text = read_text(path, MAX_YAML_LENGTH).replace("!!opencv-matrix", "")
    lines = [line for line in text.split("\n") if not line.startswith("%")]
    content = parse_yaml("\n".join(lines), str(path))
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines.")
    return content


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
