"""TUM RGB-D and its relatives: ICL-NUIM, Bonn, Redwood and other recordings in TUM layout."""

from __future__ import annotations

import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.lists import depth_at, poses_at, read_stamps, read_timed_poses
from hybridvo.geometry import invert, pose_matrix
from hybridvo.types import Camera

# Published with the data sets: fx fy cx cy and k1 k2 p1 p2 k3, by what the folder's name holds.
PUBLISHED = {
    ("freiburg1", "fr1_"): (
        (517.306408, 516.469215, 318.643040, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    ("freiburg2", "fr2_"): (
        (520.908620, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    ("freiburg3", "fr3_"): ((535.4, 539.2, 320.1, 247.6), ()),
    ("bonn",): (
        (542.822841, 542.576870, 315.593520, 237.756098),
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
}

# From Bonn's page: the pose of the camera is T_ROS^-1 T T_ROS T_MARKER, T that of the tracked body.
BONN_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
# The published rotation has a scale of 1.0593, which is taken out; the lever arm (m) stays.
BONN_MARKER = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
    ]
)


class TumSequence(Sequence):
    """A recording with ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt``.

    Colour, depth and poses are associated by nearest stamp within 0.02 s, one to one; colour images
    without depth are left out. fr1, fr2 and Bonn images are undistorted to a pinhole camera with
    the same K; depth by nearest value. Bonn's poses are moved from the tracked body to the camera.

    ICL-NUIM as published (``associations.txt`` and ``*.gt.freiburg``) is read too: its poses are
    those of a renderer with y upwards and are reflected, K = 481.2 480 319.5 239.5.
    """

    kind = "tum"
    depth_scale = 5000.0
    markers = (("rgb.txt", "depth.txt"), ("associations.txt",))

    def _list_files(self) -> None:
        root, told = self.root, self.warnings
        if (root / "rgb.txt").exists():
            self._read_two_lists()
        else:
            self._read_pairs()
        icl = next(iter(sorted(root.glob("*.gt.freiburg"))), None)
        self._is_icl = icl is not None
        pose_file = icl or root / "groundtruth.txt"
        stamps, poses = np.zeros(0), np.zeros((0, 4, 4))
        if pose_file.exists():
            stamps, poses = read_timed_poses(pose_file, told)
            self._sources.append(pose_file)
        if self._is_icl:  # has frame numbers
            self.timestamps, stamps = (
                t / self.frames_per_second for t in (self.timestamps, stamps)
            )
            reflection = np.diag([1.0, -1.0, 1.0, 1.0])
            poses = reflection @ poses @ reflection
            told.append(f"{pose_file.name}: ICL-NUIM poses (y upwards) are reflected.")
        elif "bonn" in root.name.lower():
            poses = invert(BONN_ROS) @ poses @ BONN_ROS @ pose_matrix(BONN_MARKER)
            told.append(f"{root.name}: Bonn's poses are moved from the tracked body to the camera.")
        if pose_file.exists():
            self.poses = poses_at(self.timestamps, stamps, poses, pose_file.name, told)

    def _read_two_lists(self) -> None:
        """Colour images and the depth of the nearest stamp."""
        root, told = self.root, self.warnings
        lists = [root / "rgb.txt", root / "depth.txt"]
        (stamps, rgb), (depth_stamps, depth) = (
            read_stamps(path, told, "timestamp filename", words=1) for path in lists
        )
        pairs = depth_at(stamps, depth_stamps, lists[0], told)
        self.rgb_files = [root / rgb[i][0] for i, _ in pairs]
        self.depth_files = [root / depth[j][0] for _, j in pairs]
        self.timestamps = stamps[[i for i, _ in pairs]]
        self._sources += lists

    def _read_pairs(self) -> None:
        """``stamp depth stamp rgb`` (ICL-NUIM), or ``stamp rgb stamp depth``."""
        path = self.root / "associations.txt"
        columns = "timestamp file timestamp file"
        self.timestamps, words = read_stamps(path, self.warnings, columns, words=3)
        is_depth_first = any("depth" in row[0].lower() for row in words)
        rgb, depth = (2, 0) if is_depth_first else (0, 2)
        self.rgb_files = [self.root / row[rgb] for row in words]
        self.depth_files = [self.root / row[depth] for row in words]
        self._sources.append(path)

    def _calibration(self) -> Calibration:
        name = self.name.lower()
        for keys, (intrinsics, distortion) in PUBLISHED.items():
            if any(key in name for key in keys):
                return Calibration(Camera(*intrinsics, 480, 640), distortion)
        published_icl, default = (481.2, 480.0, 319.5, 239.5), (525.0, 525.0, 319.5, 239.5)
        intrinsics = published_icl if self._is_icl else default
        told = (
            f"{self.name}: camera {intrinsics} (fx fy cx cy) is assumed: the folder name says "
            f"neither fr1, fr2, fr3 nor Bonn. Give another one with --camera fx,fy,cx,cy or "
            f"--camera FILE."
        )
        return Calibration(Camera(*intrinsics, 480, 640), warnings=(told,))
