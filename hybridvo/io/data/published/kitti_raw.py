"""The reader of KITTI's raw recordings: two rectified images, GPS and IMU as ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import read_text
from hybridvo.core.geometry import invert, make_transform
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.datasets import labelled_matrix
from hybridvo.io.data.image_io import as_pose, image_size
from hybridvo.io.data.stereo import rectified_already
from hybridvo.io.data.stereo_reader import StereoSequence

CAMERAS = "calib_cam_to_cam.txt"
EARTH_RADIUS_M = 6378137.0
"""Of the ellipsoid of GPS, as KITTI's own tools have it."""
OXTS = "lat lon alt roll pitch yaw"
"""The first numbers of an OXTS file: degrees, degrees, metres, radians."""


class KittiRawSequence(StereoSequence):
    """A drive such as ``2011_09_26/2011_09_26_drive_0001_sync``; depth comes from stereo.

    The calibration files of the day lie beside the drives, or in the drive.
    """

    kind = "kitti-raw"
    markers = (("image_02/data",), ("image_00/data",))

    def files(self) -> list[Path]:
        """Return the images, the calibration, the stamps, and the ground truth."""
        beside = {*self.root.glob("*/timestamps.txt"), *self._oxts.values()}
        images = {path for pair in self._pairs for path in pair}
        return sorted({*images, *beside, *self._calibration_folder.glob("calib_*")})

    def _open(self) -> None:
        left_camera, right_camera = self._cameras()
        left = self._images_of(left_camera)
        right = self._images_of(right_camera)
        numbers = sorted({*left} & {*right})
        if not numbers:
            raise InputError(
                f"{self.root}: no frames: no number of image_{left_camera}/data is one of "
                f"image_{right_camera}/data; depth needs both cameras."
            )
        if len(numbers) < len(left):
            self._warn(f"{len(left) - len(numbers)} left images have no right one")
        self._pairs = [(left[n], right[n]) for n in numbers]
        self.rgb_files = [left[n] for n in numbers]
        self.timestamps = self._stamps(left_camera, numbers)
        self._calibration_folder = self._find_calibration()
        self._oxts = lists.numbered_files(
            self.root / "oxts" / "data", r"(\d+)\.txt"
        )
        path = self._calibration_folder / CAMERAS
        P_left = labelled_matrix(path, (f"P_rect_{left_camera}",), (3, 4))
        P_right = labelled_matrix(path, (f"P_rect_{right_camera}",), (3, 4))
        self._take_cameras(P_left, P_right, path)
        self._take_truth(P_left, numbers)

    def _cameras(self) -> tuple[str, str]:
        """The left and the right camera: those in colour, else the grey ones."""
        in_colour = self._images_of("02") and self._images_of("03")
        return ("02", "03") if in_colour else ("00", "01")

    def _images_of(self, camera: str) -> dict[int, Path]:
        folder = self.root / f"image_{camera}" / "data"
        return lists.numbered_files(folder, r"(\d+)\.(?:png|jpg)")

    def _find_calibration(self) -> Path:
        for folder in (self.root, self.root.parent):
            if (folder / CAMERAS).is_file():
                return folder
        raise InputError(
            f"{self.root}: expected {CAMERAS} in it or beside it, got none: unpack "
            "KITTI's 2011_..._calib.zip of the day there."
        )

    def _stamps(self, camera: str, numbers: list[int]) -> np.ndarray:
        """The times of the images, s since 1970, of lines such as 2011-09-26 13:02:25.96."""
        path = self.root / f"image_{camera}" / "timestamps.txt"
        lines = read_text(path).split("\n")
        stamps = list[float]()
        for number in numbers:
            text = lines[number].strip() if number < len(lines) else ""
            try:
                nanoseconds = np.datetime64(text, "ns").astype(np.int64)
            except ValueError:
                nanoseconds = np.datetime64("NaT", "ns").astype(np.int64)
            if not nanoseconds > 0:
                expected = "'2011-09-26 13:02:25.964389445'"
                raise FormatError(
                    f"{path}:{number + 1}: expected a time such as {expected} for image "
                    f"{number}, got {text[:80]!r}."
                )
            stamps.append(float(nanoseconds) / 10**9)
        return np.array(stamps)

    def _take_cameras(
        self, P_left: np.ndarray, P_right: np.ndarray, path: Path
    ) -> None:
        """Take the rectified cameras; the fourth column of P is -f, px, times the place, m."""
        baseline = (P_left[0, 3] - P_right[0, 3]) / P_left[0, 0]
        size = image_size(self._pairs[0][0])
        if self._given_camera is not None:
            found = parse_camera(self._given_camera, size, self.warnings)
            camera = found.camera
        else:
            with format_errors(f"{path}: P_rect"):
                camera = Camera.from_matrix(P_left[:, :3], *size)
        if self.root.name.endswith("_extract"):
            self._warn("images of _extract are not rectified: use the _sync folder")
        self._take_rig(rectified_already(camera, baseline, str(path)), size)

    def _take_truth(self, P_left: np.ndarray, numbers: list[int]) -> None:
        """Take the poses of GPS and IMU, brought to the left camera."""
        if not self._oxts:
            return
        folder = self._calibration_folder
        try:
            T_velo_imu = _rigid(folder / "calib_imu_to_velo.txt")
            T_cam0_velo = _rigid(folder / "calib_velo_to_cam.txt")
        except FileNotFoundError as error:
            self._warn(f"no ground truth: {Path(error.filename).name} is not there")
            return
        R_rect = labelled_matrix(folder / CAMERAS, ("R_rect_00",), (3, 3))
        T_rect_cam0 = make_transform(R_rect, np.zeros(3))
        place = np.linalg.solve(P_left[:, :3], P_left[:, 3])
        T_left_rect = make_transform(np.eye(3), place)
        T_left_imu = T_left_rect @ T_rect_cam0 @ T_cam0_velo @ T_velo_imu
        poses = np.full((len(numbers), 4, 4), np.nan)
        known = [k for k, n in enumerate(numbers) if n in self._oxts]
        if not known:
            return
        rows = np.array([_read_oxts(self._oxts[numbers[k]]) for k in known])
        poses[known] = oxts_poses(rows) @ invert(T_left_imu)
        self.poses = poses


def oxts_poses(rows: np.ndarray) -> np.ndarray:
    """Return ``T_world_imu`` (N, 4, 4), of which the first stands in the origin.

    The axes of the world frame are east, north and up, by Mercator's projection at the first
    latitude.

    Args:
        rows: (N, 6) latitude and longitude, deg, altitude, m, roll, pitch and yaw, rad.
    """
    latitude, longitude = np.deg2rad(rows[:, :2]).T
    radius = np.cos(latitude[0]) * EARTH_RADIUS_M
    north = np.log(np.tan(np.pi / 4 + latitude / 2))
    places = np.column_stack([radius * longitude, radius * north, rows[:, 2]])
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    angles = rows[:, [5, 4, 3]]
    poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    poses[:, :3, 3] = places - places[0]
    return poses


def _read_oxts(path: Path) -> list[float]:
    """The first six numbers of an OXTS file."""
    words = read_text(path).split()[: len(OXTS.split())]
    values = [as_number(word) for word in words]
    if len(values) < len(OXTS.split()) or not np.isfinite(values).all():
        raise FormatError(
            f"{path}: expected '{OXTS} ...', got {' '.join(words)[:80]!r}."
        )
    return values


def _rigid(path: Path) -> np.ndarray:
    """The transform (4, 4) of a file with lines ``R:`` and ``T:``."""
    R = labelled_matrix(path, ("R",), (3, 3))
    t = labelled_matrix(path, ("T",), (3, 1))
    return as_pose(np.hstack([R, t]), str(path))
