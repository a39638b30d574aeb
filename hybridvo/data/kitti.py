"""KITTI odometry: a car, stereo cameras, poses from GPS and IMU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import read_rgb
from hybridvo.data.lists import numbered_files, numbered_poses, read_stamps
from hybridvo.errors import FormatError, InputError
from hybridvo.files import read_text
from hybridvo.geometry import invert
from hybridvo.trajectory import COLUMNS, read_poses
from hybridvo.types import Camera, Frame, as_number

DISPARITY_SIGMA_PX = 0.5  # assumed standard deviation of a block-matched disparity


class KittiSequence(Sequence):
    """One sequence such as ``sequences/00``: image_2 (or image_0), calib.txt, times.txt.

    Depth comes from a folder ``depth`` (16-bit PNG, 256 per metre, or ``.npy``), else from stereo.
    """

    kind = "kitti"
    frames_per_second = 10.0
    depth_source = "file"
    depth_scale = 256.0
    markers = (("calib.txt", "image_2"), ("calib.txt", "image_0"))

    def _list_files(self) -> None:
        root = self.root
        images = {n: numbered_files(root / f"image_{n}", r"(\d+)\.(?:png|jpg)") for n in "2301"}
        left, right = ("2", "3") if images["2"] else ("0", "1")
        depth = numbered_files(root / "depth", r"(\d+)\.(?:png|npy)")
        calibration, times = root / "calib.txt", root / "times.txt"
        self._P_left = _read_projection(calibration, left)
        if not depth and images[right]:
            self.depth_source, depth = "stereo", images[right]
            P_right = _read_projection(calibration, right)
            # focal length, px, times baseline, m
            self._disparity_at_1m = float(self._P_left[0, 3] - P_right[0, 3])
            if not self._disparity_at_1m > 0:
                raise FormatError(f"{calibration}: expected P{right} to the right of P{left}.")
        if images[left] and not depth:
            expected = f"depth/ (16-bit PNG, 256 per metre, or .npy, metres) or image_{right}/"
            raise InputError(f"{root}: no source of depth: expected {expected}.")
        depth = {n: path for n, path in depth.items() if n in images[left]}
        numbers = self._list_numbered(images[left], depth)
        self._left = {depth[n]: images[left][n] for n in depth}
        if times.exists():
            stamps, _ = read_stamps(times, self.warnings)
            if numbers and numbers[-1] >= (count := len(stamps)):
                raise FormatError(f"{times}: expected a line for image {numbers[-1]}, got {count}.")
            self.timestamps = stamps[numbers]
        else:
            assumed = f"{self.frames_per_second:g} frames a second assumed"
            self.warnings.append(f"{times}: not there; {assumed}.")
        for path in (root / "poses.txt", root.parent.parent / "poses" / f"{root.name}.txt"):
            if path.is_file() and self.poses is None:
                # the file holds the poses of camera 0
                T_cam_cam0 = np.eye(4)
                T_cam_cam0[:3, 3] = np.linalg.solve(self._P_left[:, :3], self._P_left[:, 3])
                poses = read_poses(path, COLUMNS["kitti"])[1] @ invert(T_cam_cam0)
                self.poses = numbered_poses(numbers, poses)

    def _calibration(self) -> Calibration:
        try:
            return Calibration(Camera.from_matrix(self._P_left[:, :3], self.height, self.width))
        except InputError as error:
            raise FormatError(f"{self.root / 'calib.txt'}: {error}") from None

    def frame(self, index: int) -> Frame:
        """Read a frame; depth from stereo gets the variance (sigma_d z / (f b))^2 of its log."""
        frame = super().frame(index)
        if self.depth_source != "stereo" or frame.depth is None:
            return frame
        sigma = DISPARITY_SIGMA_PX * frame.depth / self._disparity_at_1m
        return replace(frame, depth_variance=sigma**2)

    def _read_depth(self, path: Path) -> np.ndarray:
        if self.depth_source != "stereo":
            return super()._read_depth(path)
        files = self._left[path], path
        left, right = (cv2.cvtColor(read_rgb(file), cv2.COLOR_RGB2GRAY) for file in files)
        if left.shape != right.shape:
            raise FormatError(f"{path}: expected the size of the left image, got {right.shape}.")
        matcher = cv2.StereoSGBM.create(
            # 128 px at KITTI's size: all beyond 3 m; narrow images cannot be searched as far
            numDisparities=min(128, max(16, left.shape[1] // 2 // 16 * 16)),
            blockSize=5,
            P1=8 * 5 * 5,
            P2=32 * 5 * 5,
            disp12MaxDiff=1,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        disparity = matcher.compute(left, right).astype(np.float32) / 16  # steps of 1/16 px
        found = disparity > 0
        return np.where(found, self._disparity_at_1m / np.where(found, disparity, 1), 0)


def _read_projection(path: Path, number: str) -> np.ndarray:
    """(3, 4) projection of a rectified camera: fx 0 cx tx, 0 fy cy ty, 0 0 1 tz."""
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        name, _, rest = text.partition(":")
        if name in (f"P{number}", f"P_rect_0{number}"):
            numbers = np.array([as_number(word) for word in rest.split()])
            P = numbers.reshape(3, 4) if numbers.size == 12 else np.zeros((3, 4))
            is_camera = P[1, 0] == 0 and np.allclose(P[2, :3], (0, 0, 1)) and P[0, 0] * P[1, 1] > 0
            if is_camera and np.isfinite(P).all():
                return P
            expected = f"{name}: fx 0 cx tx 0 fy cy ty 0 0 1 tz"
            raise FormatError(f"{path}:{line}: expected {expected}, got {rest[:200]!r}.")
    raise FormatError(f"{path}: expected a line 'P{number}: ...', found none.")
