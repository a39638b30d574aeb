"""TUM RGB-D and its relatives: ICL-NUIM, Bonn, Redwood and other recordings in TUM layout."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from hybridvo.data.file_sequence import (
    FileSequence,
    associate,
    poses_from_rows,
    read_rows,
    resolve_inside,
    to_seconds,
)
from hybridvo.data.image_io import read_png16
from hybridvo.data.undistortion import Undistorter, rectify
from hybridvo.errors import InputError
from hybridvo.types import Camera

__all__ = ["TumSequence"]

DEPTH_PER_METRE = 5000.0
ICL_FRAMES_PER_SECOND = 30.0
TIMED_FILE = "timestamp filename"
TIMED_POSE = "timestamp tx ty tz qx qy qz qw"


class _Calibration(NamedTuple):
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()


# Published with the data sets; the first whose key is in the folder name counts.
CALIBRATIONS = {
    "freiburg1": _Calibration(
        517.306408,
        516.469215,
        318.643040,
        255.313989,
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "freiburg2": _Calibration(
        520.908620,
        521.007327,
        325.141442,
        249.701764,
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "freiburg3": _Calibration(535.4, 539.2, 320.1, 247.6),
    "bonn": _Calibration(
        542.822841,
        542.576870,
        315.593520,
        237.756098,
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
}
DEFAULT_CALIBRATION = _Calibration(525.0, 525.0, 319.5, 239.5)
ICL_CALIBRATION = _Calibration(481.2, 480.0, 319.5, 239.5)
ICL_REFLECTION = np.diag([1.0, -1.0, 1.0, 1.0])


class TumSequence(FileSequence):
    """A recording with ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt``.

    Colour, depth and truth are associated by nearest stamp within 0.02 s, one to one. Colour images
    without depth are left out (``keep_unmatched=True`` keeps them). fr1, fr2 and Bonn images are
    undistorted to a pinhole camera with the same K; depth by nearest value.

    ICL-NUIM as published (``associations.txt`` and ``*.gt.freiburg``) is read too: its poses are
    those of a renderer with y upwards and are reflected, K = 481.2 480 319.5 239.5.

    Args:
        path: folder of the recording.
        camera: intrinsics to use instead of those known for the folder's name.
        distortion: k1 k2 p1 p2 k3 that go with ``camera``.
        depth_scale: units per metre of the depth images.
        tolerance: largest difference of stamps in seconds.
        keep_unmatched: keep colour images without depth.
        strict: accepted for symmetry. allow_outside: list files may name paths outside the folder.

    Raises:
        InputError: no frames, stamps that do not increase, paths that leave the folder.
        FormatError: a damaged list file.
    """

    kind = "tum"
    looks_for = "tum: rgb.txt and depth.txt (or associations.txt)"

    def __init__(
        self,
        path: Path,
        *,
        camera: Camera | None = None,
        distortion: tuple[float, ...] | None = None,
        depth_scale: float = DEPTH_PER_METRE,
        tolerance: float = 0.02,
        keep_unmatched: bool = False,
        strict: bool = False,
        allow_outside: bool = False,
    ) -> None:
        root = Path(path).absolute()
        if root.name in ("rgb", "depth") and self.matches(root.parent):
            root = root.parent
        if not depth_scale > 0:
            raise InputError(f"depth_scale: expected units per metre above 0, got {depth_scale}.")
        self._depth_scale = float(depth_scale)
        icl = next(iter(sorted(root.glob("*.gt.freiburg"))), None)
        notices: list[str] = []
        if (root / "rgb.txt").exists():
            stamps, rgb, depth = _read_lists(
                root, tolerance, keep_unmatched, allow_outside, notices
            )
            sources = [root / "rgb.txt", root / "depth.txt"]
        else:
            stamps, rgb, depth = _read_associations(root, icl is not None, allow_outside)
            sources = [root / "associations.txt"]
        if len(stamps) == 0:
            raise InputError(f"{root}: no frames matched the entries of {sources[0].name}.")
        truth = icl or root / "groundtruth.txt"
        poses = None
        if truth.exists():
            poses = _read_truth(truth, stamps, tolerance, icl is not None, notices)
            sources.append(truth)
        super().__init__(
            root,
            root.name,
            rgb=rgb,
            depth=depth,
            timestamps=stamps,
            poses=poses,
            sources=sources,
            notices=notices,
            strict=strict,
        )
        self._camera, lens = self._calibration(camera, distortion, icl is not None)
        self._undistorter = Undistorter(self._camera, lens) if any(lens) else None
        self._notice_depth_units()

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a TUM recording."""
        lists = (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()
        inner = path.name in ("rgb", "depth") and (path.parent / "rgb.txt").is_file()
        return lists or (path / "associations.txt").is_file() or inner

    def camera(self, index: int) -> Camera:
        """The one (undistorted) camera of the recording."""
        self._check_index(index)
        return self._camera

    def _calibration(
        self, camera: Camera | None, distortion: tuple[float, ...] | None, icl: bool
    ) -> tuple[Camera, tuple[float, ...]]:
        if camera is not None:
            return camera, tuple(distortion or ())
        name = self.name.lower()
        for short in ("fr1", "fr2", "fr3"):
            if name.startswith(short + "_"):
                name = name.replace(short, "freiburg" + short[-1], 1)
        known = next((CALIBRATIONS[key] for key in CALIBRATIONS if key in name), None)
        if known is None:
            known = ICL_CALIBRATION if icl else DEFAULT_CALIBRATION
            self._notices.append(
                f"{self.name}: camera {known.fx} {known.fy} {known.cx} {known.cy} (fx fy cx cy) "
                f"is assumed: the folder name says neither fr1, fr2, fr3 nor Bonn. "
                f"Pass camera=... if it is another one (command line: a folder with camera.yaml)."
            )
        if "bonn" in name and self.poses is not None:
            self._notices.append(
                f"{self.name}: Bonn's truth is the pose of the tracked body, whose axes may differ "
                f"from the camera's by a fixed rotation: compare trajectories after alignment."
            )
        calibrated = Camera(known.fx, known.fy, known.cx, known.cy, 480, 640)
        if (self.height, self.width) != (480, 640):
            raise InputError(
                f"{self.root}: images are {self.width}x{self.height}, the known calibration is for "
                f"640x480. Pass camera=Camera(fx, fy, cx, cy, {self.height}, {self.width}); "
                f"on the command line, describe it as a folder with camera.yaml."
            )
        lens = known.distortion if distortion is None else tuple(distortion)
        return calibrated, lens

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        return read_png16(path).astype(np.float32) / np.float32(self._depth_scale)

    def _rectify(
        self, rgb: np.ndarray | None, depth: np.ndarray | None
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        return rectify(self._undistorter, rgb, depth)


def _read_lists(
    root: Path, tolerance: float, keep_unmatched: bool, allow_outside: bool, notices: list[str]
) -> tuple[np.ndarray, list[Path | None], list[Path | None]]:
    columns: list[tuple[np.ndarray, list[Path]]] = []
    for name in ("rgb.txt", "depth.txt"):
        rows = read_rows(root / name, TIMED_FILE, text_columns=1)
        stamps, converted = to_seconds([row[0] for row in rows], name)
        notices += converted
        paths = [resolve_inside(root, row[1], allow_outside, str(root / name)) for row in rows]
        columns.append((stamps, paths))
    (stamps, rgb), (depth_stamps, depth) = columns
    if len(stamps) == 0:
        raise InputError(f"{root}: no frames: rgb.txt lists no image.")
    # The order of the frames is checked before any is left out.
    if (np.diff(stamps) <= 0).any():
        i = int(np.flatnonzero(np.diff(stamps) <= 0)[0])
        raise InputError(
            f"{root / 'rgb.txt'}: timestamps must increase: entry {i} has {float(stamps[i])!r}, "
            f"entry {i + 1} has {float(stamps[i + 1])!r}. Sort the list and remove duplicates."
        )
    pairs = dict(associate(stamps, depth_stamps, tolerance))
    kept = list(range(len(stamps))) if keep_unmatched else sorted(pairs)
    if not kept:
        raise InputError(
            f"{root}: no frames: none of {len(stamps)} colour stamps has a depth stamp within "
            f"{tolerance} s. Are both lists in the same unit and of the same clock?"
        )
    if len(pairs) < len(stamps):
        what = "kept without depth" if keep_unmatched else "left out"
        notices.append(
            f"{root.name}: {len(stamps) - len(pairs)} of {len(stamps)} colour images have no depth "
            f"within {tolerance} s and are {what}."
        )
    depth_paths = [depth[pairs[i]] if i in pairs else None for i in kept]
    return stamps[kept], [rgb[i] for i in kept], depth_paths


def _read_associations(
    root: Path, icl: bool, allow_outside: bool
) -> tuple[np.ndarray, list[Path | None], list[Path | None]]:
    """``stamp depth stamp rgb`` (ICL-NUIM), or ``stamp rgb stamp depth``; told by the folder."""
    path = root / "associations.txt"
    rows = read_rows(path, "timestamp file timestamp file", text_columns=3)
    rgb: list[Path | None] = []
    depth: list[Path | None] = []
    for row in rows:
        names = (row[1], row[3])
        depth_first = "depth" in names[0].lower()
        a, b = (resolve_inside(root, name, allow_outside, str(path)) for name in names)
        depth.append(a if depth_first else b)
        rgb.append(b if depth_first else a)
    stamps, _ = to_seconds([row[0] for row in rows], path.name)
    return (stamps / ICL_FRAMES_PER_SECOND if icl else stamps), rgb, depth


def _read_truth(
    path: Path, stamps: np.ndarray, tolerance: float, icl: bool, notices: list[str]
) -> np.ndarray:
    """(N, 4, 4) poses of the nearest truth stamp, NaN where there is none within the tolerance."""
    rows = np.array(read_rows(path, TIMED_POSE), dtype=np.float64).reshape(-1, 8)
    truth_stamps, converted = to_seconds(rows[:, 0], path.name)
    notices += converted
    truth = poses_from_rows(rows[:, 1:], str(path))
    if icl:
        truth_stamps = truth_stamps / ICL_FRAMES_PER_SECOND
        truth = ICL_REFLECTION @ truth @ ICL_REFLECTION
        notices.append(f"{path.name}: ICL-NUIM poses (y upwards) are reflected to camera axes.")
    poses = np.full((len(stamps), 4, 4), np.nan)
    for i, j in associate(stamps, truth_stamps, tolerance):
        poses[i] = truth[j]
    missing = int(np.isnan(poses[:, 0, 0]).sum())
    if missing:
        notices.append(
            f"{path.name}: {missing} of {len(stamps)} frames have no truth within {tolerance} s."
        )
    return poses
