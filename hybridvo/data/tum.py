"""TUM RGB-D and its relatives: ICL-NUIM, Bonn, Redwood and other recordings in TUM layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Listing, Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.lists import (
    depth_at,
    poses_at,
    read_timed_poses,
    to_seconds,
)
from hybridvo.files import read_rows
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
    frames_per_second = 30.0  # of ICL-NUIM, which has frame numbers
    depth_scale = 5000.0
    looks_for = "tum: rgb.txt and depth.txt (or associations.txt)"

    def __init__(self, path: Path, given: Given) -> None:
        root = path.absolute()
        if root.name in ("rgb", "depth") and self.matches(root.parent):
            root = root.parent
        icl = next(iter(sorted(root.glob("*.gt.freiburg"))), None)
        self._is_icl = icl is not None
        listing = _read_lists(root) if (root / "rgb.txt").exists() else _read_pairs(root)
        if self._is_icl:
            listing.timestamps = listing.timestamps / self.frames_per_second
        pose_file = icl or root / "groundtruth.txt"
        if pose_file.exists():
            self._add_poses(pose_file, listing, is_bonn="bonn" in root.name.lower())
        super().__init__(root, root.name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a TUM recording."""
        lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
        inner = path.name in ("rgb", "depth") and (path.parent / "rgb.txt").is_file()
        return lists or (path / "associations.txt").is_file() or inner

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

    def _add_poses(self, path: Path, listing: Listing, is_bonn: bool) -> None:
        """Poses of the nearest stamps of the ground truth, in camera axes."""
        told = listing.warnings
        stamps, poses = read_timed_poses(path, told)
        if self._is_icl:
            stamps = stamps / self.frames_per_second
            reflection = np.diag([1.0, -1.0, 1.0, 1.0])
            poses = reflection @ poses @ reflection
            told.append(f"{path.name}: ICL-NUIM poses (y upwards) are reflected to camera axes.")
        elif is_bonn:
            poses = invert(BONN_ROS) @ poses @ BONN_ROS @ pose_matrix(BONN_MARKER)
            told.append(f"{path.name}: Bonn's poses are moved from the tracked body to the camera.")
        listing.poses = poses_at(listing.timestamps, stamps, poses, path.name, told)
        listing.sources.append(path)


def _read_lists(root: Path) -> Listing:
    """Colour images and the depth of the nearest stamp."""
    told: list[str] = []
    columns: list[tuple[np.ndarray, list[Path]]] = []
    lists = [root / "rgb.txt", root / "depth.txt"]
    for path in lists:
        rows = read_rows(path, "timestamp filename", words=1)
        stamps = to_seconds([row.numbers[0] for row in rows], path.name, told)
        columns.append((stamps, [root / row.words[0] for row in rows]))
    (stamps, rgb), (depth_stamps, depth) = columns
    pairs = depth_at(stamps, depth_stamps, lists[0], told)
    return Listing(
        rgb=[rgb[i] for i, _ in pairs],
        depth=[depth[j] for _, j in pairs],
        timestamps=stamps[[i for i, _ in pairs]],
        sources=lists,
        warnings=told,
    )


def _read_pairs(root: Path) -> Listing:
    """``stamp depth stamp rgb`` (ICL-NUIM), or ``stamp rgb stamp depth``; told by the folder."""
    path = root / "associations.txt"
    rows = read_rows(path, "timestamp file timestamp file", words=3)
    told: list[str] = []
    stamps = to_seconds([row.numbers[0] for row in rows], path.name, told)
    rgb, depth = ([root / row.words[k] for row in rows] for k in (0, 2))
    if any("depth" in row.words[0].lower() for row in rows):
        rgb, depth = depth, rgb
    return Listing([*rgb], [*depth], stamps, sources=[path], warnings=told)
