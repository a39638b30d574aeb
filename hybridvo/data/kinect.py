"""Recordings by a Kinect: TUM RGB-D and its relatives (ICL-NUIM, Bonn, Redwood), and 7-Scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import as_pose
from hybridvo.data.lists import depth_at, numbered_files, poses_at, read_stamps, read_timed_poses
from hybridvo.errors import FormatError
from hybridvo.files import read_text
from hybridvo.geometry import invert, pose_matrix
from hybridvo.types import Camera

FR1 = (517.306408, 516.469215, 318.64304, 255.313989)
FR2 = (520.90862, 521.007327, 325.141442, 249.701764)
BONN = (542.822841, 542.576870, 315.593520, 237.756098)
PUBLISHED: dict[str, tuple[tuple[float, float, float, float], tuple[float, ...]]] = {
    "fr1": (FR1, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "fr2": (FR2, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "fr3": ((535.4, 539.2, 320.1, 247.6), ()),
    "bonn": (BONN, (0.039903, -0.099343, -0.00073, -0.000144, 0.0)),
}
"""Published fx fy cx cy, px, and k1 k2 p1 p2 k3, by a word in the folder's name."""

# Bonn's page: a camera has the pose T_ROS^-1 T T_ROS T_MARKER, where T is that of the tracked body.
BONN_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
# its rotation is published with a scale of 1.0593, which is taken out; the lever arm is in metres
BONN_MARKER = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
    ]
)


class TumSequence(Sequence):
    """A recording with ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt``, or ICL-NUIM's lists.

    Colour, depth and poses are matched by stamp; images of fr1, fr2 and Bonn are undistorted.
    """

    kind = "tum"
    depth_scale = 5000.0
    markers = (("rgb.txt", "depth.txt"), ("associations.txt",))

    def _list_files(self) -> None:
        root, warnings = self.root, self.warnings
        if (root / "rgb.txt").exists():
            (stamps, rgb), (depth_stamps, depth) = (
                read_stamps(root / name, warnings, "timestamp filename", words=1)
                for name in ("rgb.txt", "depth.txt")
            )
            pairs = depth_at(stamps, depth_stamps, root / "rgb.txt", warnings)
            self.timestamps = stamps[[i for i, _ in pairs]]
            self.rgb_files = [root / rgb[i][0] for i, _ in pairs]
            self.depth_files = [root / depth[j][0] for _, j in pairs]
        else:  # stamp depth stamp rgb (ICL-NUIM), or stamp rgb stamp depth
            listed, columns = root / "associations.txt", "timestamp file timestamp file"
            self.timestamps, words = read_stamps(listed, warnings, columns, words=3)
            rgb_at = 2 if any("depth" in row[0].lower() for row in words) else 0
            self.rgb_files = [root / row[rgb_at] for row in words]
            self.depth_files = [root / row[2 - rgb_at] for row in words]
        icl = min(root.glob("*.gt.freiburg"), default=None)
        self._is_icl = icl is not None
        pose_file = icl or root / "groundtruth.txt"
        if not pose_file.exists():
            return
        stamps, poses = read_timed_poses(pose_file, warnings)
        if self._is_icl:  # has frame numbers for stamps, and y upwards
            self.timestamps = self.timestamps / self.frames_per_second
            stamps, reflection = stamps / self.frames_per_second, np.diag([1.0, -1.0, 1.0, 1.0])
            poses = reflection @ poses @ reflection
        elif "bonn" in root.name.lower():  # from the tracked body to the camera
            poses = invert(BONN_ROS) @ poses @ BONN_ROS @ pose_matrix(BONN_MARKER)
        self.poses = poses_at(self.timestamps, stamps, poses)

    def _calibration(self) -> Calibration:
        name = self.name.lower().replace("freiburg", "fr")
        for word, (intrinsics, distortion) in PUBLISHED.items():
            if word in name:
                return Calibration(Camera(*intrinsics, 480, 640), distortion)
        intrinsics = (481.2, 480.0, 319.5, 239.5) if self._is_icl else (525.0, 525.0, 319.5, 239.5)
        why = "the folder name says neither fr1, fr2, fr3 nor Bonn; else give --camera fx,fy,cx,cy"
        self._warn(f"camera {intrinsics} (fx fy cx cy) is assumed: {why}")
        return Calibration(Camera(*intrinsics, 480, 640))


class SevenScenesSequence(Sequence):
    """One sequence such as ``chess/seq-01``: ``frame-000000.{color.png,depth.png,pose.txt}``."""

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
        if files := numbered_files(root, r"frame-(\d+)\.pose\.txt"):
            self._read_poses([files.get(number) for number in numbers], _read_pose)

    def _calibration(self) -> Calibration:
        return Calibration(Camera(585, 585, 320, 240, 480, 640))  # as the data set's page says


def _read_pose(path: Path) -> np.ndarray:
    """T_world_cam (4, 4), NaN where tracking was lost: the file then holds inf or nan."""
    try:
        T = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise FormatError(f"{path}: expected 16 numbers of a 4x4 matrix ({error}).") from None
    return as_pose(T[:3], str(path)) if np.isfinite(T).all() else np.full((4, 4), np.nan)
