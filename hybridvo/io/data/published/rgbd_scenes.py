"""The reader of the RGB-D Scenes Dataset v2: a Kinect's walk around a table."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import FormatError
from hybridvo.core.files import read_rows
from hybridvo.core.geometry import make_transform
from hybridvo.core.trajectory import FILE_TOLERANCE
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import Calibration
from hybridvo.io.data.sequence import Sequence

INTRINSICS = (570.3, 570.3, 320.0, 240.0)
"""fx fy cx cy of all scenes, pixels of 640x480."""
SIZE = (480, 640)


class RgbdScenesSequence(Sequence):
    """A scene such as ``imgs/scene_01``: ``00000-color.png``, ``00000-depth.png``.

    The poses are in ``pc/01.pose``: a mapping system made them of the same images, so that they
    are no independent ground truth, and a warning states it.
    """

    kind = "rgbd-scenes"
    depth_scale = 1000.0
    markers = (("*-color.png", "*-depth.png"),)

    def files(self) -> list[Path]:
        """Return the images and maps, and the poses beside them."""
        path = self._pose_file()
        return sorted({*super().files(), *([path] if path else [])})

    def _list_files(self) -> None:
        rgb = lists.numbered_files(self.root, r"(\d+)-color\.png")
        depth = lists.numbered_files(self.root, r"(\d+)-depth\.png")
        numbers = self._list_numbered(rgb, depth)
        path = self._pose_file()
        if path is not None:
            self.poses = lists.numbered_poses(numbers, _read_poses(path))
            self._warn(f"{path.name} was estimated from the same images")

    def _pose_file(self) -> Path | None:
        """The file of the poses, in the archive of the point clouds."""
        number = self.root.name.rpartition("_")[2]
        name = f"pc/{number}.pose"
        base = self.root.parent.parent
        places = [self.root.parent / f"{number}.pose", base / name]
        # each archive in a folder of its own
        places += sorted(base.parent.parent.glob(f"*/{base.name}/{name}"))
        return next((path for path in places if path.is_file()), None)

    def _calibration(self) -> Calibration:
        return Calibration(Camera(*INTRINSICS, height=SIZE[0], width=SIZE[1]))


def _read_poses(path: Path) -> np.ndarray:
    """Read ``T_world_cam`` (N, 4, 4), of rows of a quaternion, w first, and a place."""
    rows = read_rows(path, "qw qx qy qz tx ty tz")
    wxyz = rows.numbers[:, :4]
    length = np.linalg.norm(wxyz, axis=1)
    rows.refuse(
        ~(np.abs(length - 1) < FILE_TOLERANCE), "a unit quaternion qw qx qy qz"
    )
    if not len(wxyz):
        raise FormatError(f"{path}: expected 'qw qx qy qz tx ty tz', got no row.")
    return np.array([_pose(row) for row in rows.numbers])


def _pose(row: np.ndarray) -> np.ndarray:
    R = Rotation.from_quat(row[:4], scalar_first=True).as_matrix()
    return make_transform(R, row[4:])
