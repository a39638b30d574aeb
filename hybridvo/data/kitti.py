"""KITTI odometry: a car, stereo cameras, poses from GPS and IMU."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from hybridvo.data.file_sequence import (
    FileSequence,
    check_pose,
    gap_notice,
    numbered_files,
    read_rows,
    to_seconds,
)
from hybridvo.data.image_io import read_npy, read_png16, read_rgb, read_text
from hybridvo.data.sensor_noise import stereo_variance
from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import invert
from hybridvo.types import Camera

__all__ = ["KittiSequence"]

DEPTH_PER_METRE = 256.0
FRAMES_PER_SECOND = 10.0
DEPTH_FOLDERS = ("depth", "depth_2", "depth_0")
LEFT_AND_RIGHT = (("image_2", "image_3"), ("image_0", "image_1"))
IMAGE_PATTERN = r"(\d+)\.(?:png|jpg)"
LARGEST = 1e12
"""No entry of a projection matrix is larger."""
LEAST_STEREO_WIDTH = 32
"""Images narrower than this are not matched: OpenCV's matcher fails, or crashes, below 17 px."""
DISPARITY_SIGMA_PX = 0.5
"""Assumed standard deviation of a block-matched disparity, px: sets the relative depth noise."""


class KittiSequence(FileSequence):
    """One sequence such as ``sequences/00``: image_2 (or image_0), calib.txt, times.txt.

    Depth comes from a folder ``depth`` (16-bit PNG with 256 units per metre, or ``.npy`` in
    metres), else from stereo: OpenCV's semi-global matching with the baseline of ``calib.txt``.
    Poses are those of the colour camera that is read, in KITTI's world (first camera 0).

    Args:
        path: sequence folder, or its image_2 or image_0.
        depth: ``auto``, ``file`` or ``stereo``.
        strict: trailing bytes in a file are errors.
        allow_outside: accepted for symmetry; no list file names paths here.

    Raises:
        InputError: no frames, no calibration, no source of depth. FormatError: damaged text files.
    """

    kind = "kitti"
    looks_for = "kitti: calib.txt and image_2 or image_0"

    def __init__(
        self,
        path: Path,
        *,
        depth: str = "auto",
        strict: bool = False,
        allow_outside: bool = False,
    ) -> None:
        root = _sequence_folder(Path(path).absolute())
        if root is None:
            raise InputError(f"{path}: expected a folder with {self.looks_for.split(': ')[1]}.")
        if depth not in ("auto", "file", "stereo"):
            raise InputError(f"depth: expected auto, file or stereo, got {depth!r}.")
        left_name, right_name = next(
            ((a, b) for a, b in LEFT_AND_RIGHT if numbered_files(root / a, IMAGE_PATTERN)),
            LEFT_AND_RIGHT[0],
        )
        left = numbered_files(root / left_name, IMAGE_PATTERN)
        if not left:
            raise InputError(f"{root}: no frames matched NUMBER.png in image_2 or image_0.")
        numbers = sorted(left)
        right = numbered_files(root / right_name, IMAGE_PATTERN)
        stored = next(
            (d for f in DEPTH_FOLDERS if (d := numbered_files(root / f, r"(\d+)\.(?:png|npy)"))), {}
        )
        if (depth == "file" and not stored) or (depth == "stereo" and not right):
            what = "a depth folder" if depth == "file" else right_name
            raise InputError(f"{root}: depth='{depth}' needs {what}, which holds no numbered file.")
        if not stored and not right:
            raise InputError(
                f"{root}: no source of depth: expected a folder depth (16-bit PNG, 256 per metre, "
                f"or .npy in metres) or the right images {right_name}."
            )
        self._stereo = depth == "stereo" or not stored
        self.depth_source = "stereo" if self._stereo else "file"
        depth_files = right if self._stereo else stored
        projections = _read_calibration(root / "calib.txt")
        P_left = _projection(projections, left_name[-1], root)
        self._focal, self._baseline = P_left[0, 0], 0.0
        if self._stereo:
            P_right = _projection(projections, right_name[-1], root)
            self._baseline = float((P_left[0, 3] - P_right[0, 3]) / P_left[0, 0])
            if not self._baseline > 0:
                raise FormatError(
                    f"{root / 'calib.txt'}: expected a positive baseline between P{left_name[-1]} "
                    f"and P{right_name[-1]}, got {self._baseline} m."
                )
        notices = gap_notice(root.name, numbers)
        stamps = _read_times(root / "times.txt", numbers, notices)
        truth = _truth_file(root)
        sources = [root / "calib.txt", root / "times.txt"]
        poses = None
        if truth is not None:
            poses = _read_poses(truth, numbers, P_left, notices)
            sources.append(truth)
        super().__init__(
            root,
            root.name,
            rgb=[left[n] for n in numbers],
            depth=[depth_files.get(n) for n in numbers],
            timestamps=stamps,
            poses=poses,
            sources=sources,
            notices=notices,
            strict=strict,
        )
        try:
            self._camera = Camera.from_matrix(P_left[:, :3], self.height, self.width)
        except InputError as error:
            raise FormatError(f"{root / 'calib.txt'}: P{left_name[-1]}: {error}") from None
        if not self._stereo:
            self._notice_depth_units()

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a KITTI odometry sequence."""
        return _sequence_folder(path.absolute()) is not None

    def camera(self, index: int) -> Camera:
        """The rectified left camera."""
        self._check_index(index)
        return self._camera

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        if self._stereo:
            left = rgb if rgb is not None else read_rgb(self.rgb_files[index] or path)
            return self._match(left, read_rgb(path), path)
        if path.suffix == ".npy":
            depth = read_npy(path, strict=self.strict)
            if depth.dtype != np.float32:
                raise FormatError(f"{path}: expected depth as floating point, got {depth.dtype}.")
            return depth
        return read_png16(path).astype(np.float32) / np.float32(DEPTH_PER_METRE)

    def _match(self, left: np.ndarray, right: np.ndarray, path: Path) -> np.ndarray:
        """(H, W) float32 depth from a rectified pair; 0 where no match was found."""
        if left.shape != right.shape:
            raise InputError(
                f"{path}: the right image has shape {right.shape}, the left one {left.shape}."
            )
        if left.shape[1] < LEAST_STEREO_WIDTH:
            return np.zeros(left.shape[:2], np.float32)
        # 128 px at KITTI's size: everything beyond 3 m. Narrow images cannot be searched as far.
        disparities = min(128, max(16, left.shape[1] // 2 // 16 * 16))
        block = 5
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=disparities,
            blockSize=block,
            P1=8 * block * block,
            P2=32 * block * block,
            disp12MaxDiff=1,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
        disparity = matcher.compute(gray[0], gray[1]).astype(np.float32) / 16
        depth = np.zeros_like(disparity)
        found = disparity > 0
        depth[found] = self._focal * self._baseline / disparity[found]
        return depth

    def _depth_variance(self, depth: np.ndarray) -> np.ndarray | None:
        if not self._stereo:
            return None
        return stereo_variance(depth, self._focal, self._baseline, DISPARITY_SIGMA_PX)


def _sequence_folder(path: Path) -> Path | None:
    names = {name for pair in LEFT_AND_RIGHT for name in pair} | set(DEPTH_FOLDERS)
    candidates = (path, path.parent) if path.name in names else (path,)
    for folder in candidates:
        images = any((folder / a).is_dir() for a, _ in LEFT_AND_RIGHT)
        if images and (folder / "calib.txt").is_file():
            return folder
    return None


def _read_calibration(path: Path) -> dict[str, np.ndarray]:
    """Name -> (3, 4) matrix."""
    matrices = {}
    for number, line in enumerate(read_text(path, limit=2**20).splitlines(), start=1):
        name, colon, rest = line.partition(":")
        if not colon or not name.strip().startswith(("P", "Tr")):
            continue
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            values = np.zeros(0)
        if values.size != 12 or not np.isfinite(values).all():
            raise FormatError(f"{path}:{number}: expected 12 finite numbers after {name!r}.")
        matrices[name.strip()] = values.reshape(3, 4)
    return matrices


def _projection(matrices: dict[str, np.ndarray], number: str, root: Path) -> np.ndarray:
    for name in (f"P{number}", f"P_rect_0{number}"):
        if name in matrices:
            P = matrices[name]
            upper = P[1, 0] == 0 and np.allclose(P[2, :3], (0, 0, 1)) and np.abs(P).max() < LARGEST
            if not (upper and P[0, 0] > 0 and P[1, 1] > 0):
                raise FormatError(
                    f"{root / 'calib.txt'}: {name}: expected fx 0 cx tx, 0 fy cy ty, 0 0 1 tz with "
                    f"positive fx and fy, got {P.tolist()}."
                )
            return P
    raise FormatError(
        f"{root / 'calib.txt'}: expected a line 'P{number}: ...', found {sorted(matrices)}."
    )


def _read_times(path: Path, numbers: list[int], notices: list[str]) -> np.ndarray:
    """Line i belongs to image number i."""
    if not path.exists():
        notices.append(f"{path}: not there; stamps count {FRAMES_PER_SECOND:g} frames a second.")
        return (np.array(numbers) - numbers[0]) / FRAMES_PER_SECOND
    times, converted = to_seconds([row[0] for row in read_rows(path, "seconds")], path.name)
    notices += converted
    if numbers[-1] >= len(times):
        raise FormatError(
            f"{path}: expected a line for image {numbers[-1]}, got {len(times)} lines."
        )
    return times[numbers]


def _truth_file(root: Path) -> Path | None:
    name = f"{root.name}.txt"
    beside = (root / "poses" / name, root / "poses.txt", root.parent / "poses" / name)
    return next((p for p in (*beside, root.parent.parent / "poses" / name) if p.is_file()), None)


def _read_poses(
    path: Path, numbers: list[int], P_left: np.ndarray, notices: list[str]
) -> np.ndarray:
    """(N, 4, 4) T_world_cam of the left camera that is read; the file holds those of camera 0."""
    rows = read_rows(path, "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz")
    poses = np.full((len(numbers), 4, 4), np.nan)
    T_cam_cam0 = np.eye(4)
    T_cam_cam0[:3, 3] = np.linalg.solve(P_left[:, :3], P_left[:, 3])
    for i, n in enumerate(numbers):
        if n < len(rows) and np.isfinite(rows[n]).all():
            T_world_cam0 = np.vstack([np.reshape(rows[n], (3, 4)), (0.0, 0.0, 0.0, 1.0)])
            check_pose(T_world_cam0, f"{path}: pose {n}")
            poses[i] = T_world_cam0 @ invert(T_cam_cam0)
    missing = int(np.isnan(poses[:, 0, 0]).sum())
    if missing:
        notices.append(f"{path}: {len(rows)} poses; {missing} of {len(numbers)} have no truth.")
    return poses
