"""TUM RGB-D and its relatives: ICL-NUIM, Bonn, Redwood and other recordings in TUM layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Listing, Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.lists import (
    MAX_STAMP_DIFFERENCE_S,
    associate,
    check_increasing,
    listed_path,
    poses_at,
    read_poses,
    read_rows,
    to_seconds,
)
from hybridvo.errors import InputError
from hybridvo.geometry import invert, pose_matrix
from hybridvo.types import Camera

ICL_FRAMES_PER_SECOND = 30.0
ICL = (481.2, 480.0, 319.5, 239.5)
ICL_REFLECTION = np.diag([1.0, -1.0, 1.0, 1.0])
DEFAULT = (525.0, 525.0, 319.5, 239.5)
FREIBURG1 = (517.306408, 516.469215, 318.643040, 255.313989)
FREIBURG2 = (520.908620, 521.007327, 325.141442, 249.701764)
FREIBURG3 = (535.4, 539.2, 320.1, 247.6)
BONN = (542.822841, 542.576870, 315.593520, 237.756098)
# Published with the data sets: fx fy cx cy and k1 k2 p1 p2 k3; the first whose key is in the folder
# name counts.
PUBLISHED = {
    "freiburg1": (FREIBURG1, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "freiburg2": (FREIBURG2, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "freiburg3": (FREIBURG3, ()),
    "fr1_": (FREIBURG1, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "fr2_": (FREIBURG2, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "fr3_": (FREIBURG3, ()),
    "bonn": (BONN, (0.039903, -0.099343, -0.000730, -0.000144, 0.0)),
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

    Colour, depth and truth are associated by nearest stamp within 0.02 s, one to one; colour images
    without depth are left out. fr1, fr2 and Bonn images are undistorted to a pinhole camera with
    the same K; depth by nearest value. Bonn's truth is moved from the tracked body to the camera.

    ICL-NUIM as published (``associations.txt`` and ``*.gt.freiburg``) is read too: its poses are
    those of a renderer with y upwards and are reflected, K = 481.2 480 319.5 239.5.

    Args:
        path: folder of the recording.
        given: what the user says about camera, unit and masks.

    Raises:
        InputError: no frames, stamps that do not increase. FormatError: a damaged list file.
    """

    kind = "tum"
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
            listing.timestamps = listing.timestamps / ICL_FRAMES_PER_SECOND
        if not listing.rgb:
            raise InputError(f"{root}: no frames matched the entries of {listing.sources[0].name}.")
        truth = icl or root / "groundtruth.txt"
        if truth.exists():
            self._add_truth(truth, listing, is_bonn="bonn" in root.name.lower())
        super().__init__(root, root.name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a TUM recording."""
        lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
        inner = path.name in ("rgb", "depth") and (path.parent / "rgb.txt").is_file()
        return lists or (path / "associations.txt").is_file() or inner

    def _calibration(self) -> Calibration:
        found = next((p for key, p in PUBLISHED.items() if key in self.name.lower()), None)
        warnings: tuple[str, ...] = ()
        if found is None:
            found = (ICL if self._is_icl else DEFAULT, ())
            warnings = (
                f"{self.name}: camera {found[0]} (fx fy cx cy) is assumed: the folder name says "
                f"neither fr1, fr2, fr3 nor Bonn. Give another one with --camera fx,fy,cx,cy or "
                f"--camera FILE.",
            )
        if (self.height, self.width) != (480, 640):
            raise InputError(
                f"{self.root}: images are {self.width}x{self.height}, the known calibration is for "
                f"640x480. Give the camera (--camera fx,fy,cx,cy or --camera FILE)."
            )
        return Calibration(Camera(*found[0], 480, 640), found[1], warnings=warnings)

    def _add_truth(self, path: Path, listing: Listing, is_bonn: bool) -> None:
        """Poses of the nearest stamps of the ground truth, in camera axes."""
        stamps, truth = read_poses(path)
        stamps, told = to_seconds(stamps, path.name)
        if self._is_icl:
            stamps = stamps / ICL_FRAMES_PER_SECOND
            truth = ICL_REFLECTION @ truth @ ICL_REFLECTION
            told.append(f"{path.name}: ICL-NUIM poses (y upwards) are reflected to camera axes.")
        elif is_bonn:
            truth = invert(BONN_ROS) @ truth @ BONN_ROS @ pose_matrix(BONN_MARKER)
            told.append(f"{path.name}: Bonn's poses are moved from the tracked body to the camera.")
        listing.poses, missing = poses_at(listing.timestamps, stamps, truth, path.name)
        listing.warnings += told + missing
        listing.sources.append(path)


def _read_lists(root: Path) -> Listing:
    """Colour images and the depth of the nearest stamp."""
    warnings: list[str] = []
    columns: list[tuple[np.ndarray, list[Path]]] = []
    for path in (root / "rgb.txt", root / "depth.txt"):
        rows = read_rows(path, "timestamp filename", words=1)
        stamps, told = to_seconds([row.numbers[0] for row in rows], path.name)
        warnings += told
        files = [listed_path(root, row.words[0], f"{path}:{row.line}") for row in rows]
        columns.append((stamps, files))
    (stamps, rgb), (depth_stamps, depth) = columns
    # The order of the frames is checked before any is left out.
    check_increasing(stamps[np.isfinite(stamps)], str(root / "rgb.txt"))
    pairs = associate(stamps, depth_stamps)
    if len(rgb) and not pairs:
        raise InputError(
            f"{root}: no frames: none of {len(rgb)} colour stamps has a depth stamp within "
            f"{MAX_STAMP_DIFFERENCE_S} s. Are both lists in the same unit and of the same clock?"
        )
    if len(pairs) < len(rgb):
        warnings.append(
            f"{root.name}: {len(rgb) - len(pairs)} of {len(rgb)} colour images have no depth "
            f"within {MAX_STAMP_DIFFERENCE_S} s and are left out."
        )
    return Listing(
        rgb=[rgb[i] for i, _ in pairs],
        depth=[depth[j] for _, j in pairs],
        timestamps=stamps[[i for i, _ in pairs]],
        sources=[root / "rgb.txt", root / "depth.txt"],
        warnings=warnings,
    )


def _read_pairs(root: Path) -> Listing:
    """``stamp depth stamp rgb`` (ICL-NUIM), or ``stamp rgb stamp depth``; told by the folder."""
    path = root / "associations.txt"
    rgb: list[Path | None] = []
    depth: list[Path | None] = []
    rows = read_rows(path, "timestamp file timestamp file", words=3)
    for row in rows:
        names = (row.words[0], row.words[2])
        first, second = (listed_path(root, name, f"{path}:{row.line}") for name in names)
        depth_first = "depth" in names[0].lower()
        depth.append(first if depth_first else second)
        rgb.append(second if depth_first else first)
    stamps, told = to_seconds([row.numbers[0] for row in rows], path.name)
    return Listing(rgb, depth, stamps, sources=[path], warnings=told)
