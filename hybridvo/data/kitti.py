"""KITTI odometry: a car, stereo cameras, poses from GPS and IMU."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from hybridvo.data.base import Given, Listing, Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import read_rgb
from hybridvo.data.lists import numbered_files, numbered_poses, read_stamps, warn_of_gaps
from hybridvo.errors import FormatError, InputError
from hybridvo.files import read_text
from hybridvo.geometry import invert
from hybridvo.trajectory import COLUMNS, read_poses
from hybridvo.types import Camera

DEPTH_FOLDERS = ("depth", "depth_2", "depth_0")
LEFT_AND_RIGHT = (("image_2", "image_3"), ("image_0", "image_1"))
IMAGE_PATTERN = r"(\d+)\.(?:png|jpg)"
DISPARITY_SIGMA_PX = 0.5
"""Assumed standard deviation of a block-matched disparity, px: sets the relative depth noise."""


class KittiSequence(Sequence):
    """One sequence such as ``sequences/00``: image_2 (or image_0), calib.txt, times.txt.

    Depth comes from a folder ``depth`` (16-bit PNG with 256 units per metre, or ``.npy`` in
    metres), else from stereo: OpenCV's semi-global matching with the baseline of ``calib.txt``.
    Poses are those of the colour camera that is read, in KITTI's world (first camera 0).
    """

    kind = "kitti"
    frames_per_second = 10.0  # where times.txt is missing
    depth_source = "file"
    depth_scale = 256.0
    looks_for = "kitti: calib.txt and image_2 or image_0"

    def __init__(self, path: Path, given: Given) -> None:
        root = _sequence_folder(path.absolute())
        if root is None:
            raise InputError(f"{path}: expected a folder with {self.looks_for.split(': ')[1]}.")
        left_name, right_name = next(
            ((a, b) for a, b in LEFT_AND_RIGHT if numbered_files(root / a, IMAGE_PATTERN)),
            LEFT_AND_RIGHT[0],
        )
        left = numbered_files(root / left_name, IMAGE_PATTERN)
        if not left:
            raise InputError(f"{root}: no frames matched NUMBER.png in image_2 or image_0.")
        numbers = sorted(left)
        stored = (numbered_files(root / f, r"(\d+)\.(?:png|npy)") for f in DEPTH_FOLDERS)
        depth = next((files for files in stored if files), {})
        if not depth:
            self.depth_source = "stereo"
            depth = numbered_files(root / right_name, IMAGE_PATTERN)
        if not depth:
            raise InputError(
                f"{root}: no source of depth: expected a folder depth (16-bit PNG, 256 per metre, "
                f"or .npy in metres) or the right images {right_name}."
            )
        calibration = root / "calib.txt"
        self._P_left = _read_projection(calibration, left_name[-1])
        self._disparity_at_1m = 0.0  # px: focal length times baseline
        if self.depth_source == "stereo":
            P_right = _read_projection(calibration, right_name[-1])
            self._disparity_at_1m = float(self._P_left[0, 3] - P_right[0, 3])
            if not self._disparity_at_1m > 0:
                raise FormatError(
                    f"{calibration}: expected the camera of {right_name} to the right of the one "
                    f"of {left_name}."
                )
        times = root / "times.txt"
        told: list[str] = []
        warn_of_gaps(root.name, numbers, told)
        listing = Listing(
            rgb=[left[n] for n in numbers],
            depth=[depth.get(n) for n in numbers],
            timestamps=_read_times(times, numbers, self.frames_per_second, told),
            sources=[calibration, times],
            warnings=told,
        )
        if (pose_file := _pose_file(root)) is not None:
            listing.sources.append(pose_file)
            # the file holds the poses of camera 0
            T_cam_cam0 = np.eye(4)
            T_cam_cam0[:3, 3] = np.linalg.solve(self._P_left[:, :3], self._P_left[:, 3])
            poses = read_poses(pose_file, COLUMNS["kitti"])[1] @ invert(T_cam_cam0)
            listing.poses = numbered_poses(numbers, poses, pose_file, told)
        super().__init__(root, root.name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a KITTI odometry sequence."""
        return _sequence_folder(path.absolute()) is not None

    def _calibration(self) -> Calibration:
        """The rectified left camera."""
        try:
            camera = Camera.from_matrix(self._P_left[:, :3], self.height, self.width)
        except InputError as error:
            raise FormatError(f"{self.root / 'calib.txt'}: {error}") from None
        return Calibration(camera)

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        if self.depth_source == "file":
            return super()._read_depth(path, index, rgb)
        left = rgb if rgb is not None else read_rgb(self.rgb_files[index] or path)
        right = read_rgb(path)
        self._check_shape(right, path, "a right image")
        disparity = _match(left, right)
        depth = np.zeros_like(disparity)
        found = disparity > 0
        depth[found] = self._disparity_at_1m / disparity[found]
        return depth

    def _depth_variance(self, depth: np.ndarray) -> np.ndarray | None:
        """Variance of log depth of a stereo pair: (sigma_d z / (f b))^2."""
        if self.depth_source == "file":
            return None
        return np.square(DISPARITY_SIGMA_PX * depth / self._disparity_at_1m).astype(np.float32)


def _match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(H, W) float32 disparity in pixels of a rectified pair; 0 or less where nothing matches."""
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
    return matcher.compute(gray[0], gray[1]).astype(np.float32) / 16  # steps of 1/16 px


def _sequence_folder(path: Path) -> Path | None:
    names = {name for pair in LEFT_AND_RIGHT for name in pair} | set(DEPTH_FOLDERS)
    candidates = (path, path.parent) if path.name in names else (path,)
    for folder in candidates:
        images = any((folder / a).is_dir() for a, _ in LEFT_AND_RIGHT)
        if images and (folder / "calib.txt").is_file():
            return folder
    return None


def _read_projection(path: Path, number: str) -> np.ndarray:
    """(3, 4) projection of a rectified camera: fx 0 cx tx, 0 fy cy ty, 0 0 1 tz."""
    found = None
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        name, _, rest = text.partition(":")
        if not name.startswith("P"):
            continue
        try:
            P = np.array(rest.split(), dtype=np.float64).reshape(3, 4)
        except ValueError:
            P = np.zeros((3, 4))
        is_rectified = P[1, 0] == 0 and np.allclose(P[2, :3], (0, 0, 1)) and P[0, 0] * P[1, 1] > 0
        if not (is_rectified and np.isfinite(P).all()):
            expected = f"{name}: fx 0 cx tx 0 fy cy ty 0 0 1 tz"
            raise FormatError(f"{path}:{line}: expected {expected}, got {rest[:200]!r}.")
        if name in (f"P{number}", f"P_rect_0{number}"):
            found = P
    if found is None:
        raise FormatError(f"{path}: expected a line 'P{number}: ...', found none.")
    return found


def _read_times(path: Path, numbers: list[int], per_second: float, told: list[str]) -> np.ndarray:
    """Line i belongs to image number i."""
    if not path.exists():
        told.append(f"{path}: not there; stamps count {per_second:g} frames a second.")
        return (np.array(numbers) - numbers[0]) / per_second
    times = read_stamps(path, told)
    if numbers[-1] >= len(times):
        raise FormatError(
            f"{path}: expected a line for image {numbers[-1]}, got {len(times)} lines."
        )
    return times[numbers]


def _pose_file(root: Path) -> Path | None:
    name = f"{root.name}.txt"
    beside = (root / "poses" / name, root / "poses.txt", root.parent / "poses" / name)
    return next((p for p in (*beside, root.parent.parent / "poses" / name) if p.is_file()), None)
