"""Microsoft 7-Scenes: a Kinect in seven rooms, poses from KinectFusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Sequence, numbered_listing
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import read_depth
from hybridvo.data.lists import numbered_files, rigid
from hybridvo.errors import FormatError
from hybridvo.files import read_text
from hybridvo.types import Camera

IMAGE_PATTERN = r"frame-(\d+)\.(?:color|rgb)\.(?:png|jpg|jpeg)"
DEPTH_PATTERN = r"frame-(\d+)\.depth\.png"


class SevenScenesSequence(Sequence):
    """One sequence such as ``chess/seq-01``: ``frame-000000.{color.png,depth.png,pose.txt}``.

    Depth is in millimetres, 0 and 65535 are invalid. K = 585 585 320 240 is the data set's own
    convention for colour and depth. Stamps count 30 frames a second: the data has none. A frame
    whose pose file is damaged has no ground truth.
    """

    kind = "7scenes"
    frames_per_second = 30.0
    depth_scale = 1000.0
    looks_for = "7scenes: frame-000000.color.png, .depth.png, .pose.txt"

    def __init__(self, path: Path, given: Given) -> None:
        root = path.absolute()
        rgb = numbered_files(root, IMAGE_PATTERN)
        depth = numbered_files(root, DEPTH_PATTERN)
        pose_files = numbered_files(root, r"frame-(\d+)\.pose\.txt")
        name = f"{root.parent.name}_{root.name}" if root.name.startswith("seq-") else root.name
        numbers, listing = numbered_listing(name, rgb, depth, self.frames_per_second)
        poses = np.full((len(numbers), 4, 4), np.nan)
        for i, n in enumerate(numbers):
            try:
                if n in pose_files:
                    poses[i] = _read_pose(pose_files[n])
            except FormatError as error:
                listing.warnings.append(f"no ground truth for frame {i}: {error}")
        listing.poses = poses if pose_files else None
        listing.sources = [*pose_files.values()]
        super().__init__(root, name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a 7-Scenes sequence."""
        return any(numbered_files(path, pattern) for pattern in (IMAGE_PATTERN, DEPTH_PATTERN))

    def _calibration(self) -> Calibration:
        return Calibration(Camera(585.0, 585.0, 320.0, 240.0, 480, 640))

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        stored = read_depth(path)
        depth = self._metres(stored)
        depth[stored == 65535] = 0.0
        return depth


def _read_pose(path: Path) -> np.ndarray:
    """(4, 4) T_world_cam; NaN where tracking was lost (the file then holds inf or nan)."""
    try:
        T = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise FormatError(f"{path}: expected 16 numbers of a 4x4 matrix ({error}).") from None
    if not np.isfinite(T).all():
        return np.full((4, 4), np.nan)
    return rigid(T[:3], str(path))
