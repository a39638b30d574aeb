"""Microsoft 7-Scenes: a Kinect in seven rooms, poses from KinectFusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import as_pose
from hybridvo.data.lists import numbered_files
from hybridvo.errors import FormatError
from hybridvo.files import read_text


class SevenScenesSequence(Sequence):
    """One sequence such as ``chess/seq-01``: ``frame-000000.{color.png,depth.png,pose.txt}``.

    K = 585 585 320 240 is the data set's own convention. The data has no stamps.
    """

    kind = "7scenes"
    depth_scale = 1000.0
    markers = (("frame-*.color.*",), ("frame-*.rgb.*",), ("frame-*.depth.png",))

    def _list_files(self) -> None:
        root = self.root
        self.name = f"{root.parent.name}_{root.name}" if root.name.startswith("seq-") else root.name
        numbers = self._list_numbered(
            numbered_files(root, r"frame-(\d+)\.(?:color|rgb)\.(?:png|jpg|jpeg)"),
            numbered_files(root, r"frame-(\d+)\.depth\.png"),
        )
        files = numbered_files(root, r"frame-(\d+)\.pose\.txt")
        if files:
            self._each_pose([files.get(number) for number in numbers], _read_pose)

    def _calibration(self) -> Calibration:
        return Calibration(585, 585, 320, 240, 480, 640)


def _read_pose(path: Path) -> np.ndarray:
    """(4, 4) T_world_cam; NaN where tracking was lost (the file then holds inf or nan)."""
    try:
        T = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise FormatError(f"{path}: expected 16 numbers of a 4x4 matrix ({error}).") from None
    return as_pose(T[:3], str(path)) if np.isfinite(T).all() else np.full((4, 4), np.nan)
