"""Readers of stereo recordings: EuRoC (ASL) folders, and folders of one's own."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_number, as_rigid
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import MAX_YAML_LENGTH, parse_yaml, read_rows, read_text
from hybridvo.core.geometry import pose_matrix
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import (
    CAMERA_FILE,
    parse_camera,
    read_opencv_yaml,
)
from hybridvo.io.data.image_io import image_size, read_rgb
from hybridvo.io.data.stereo import (
    Rectified,
    StereoRig,
    T_right_left_of,
    rectified_already,
    rectify,
    stereo_images,
)
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    check_lens,
)

# s, between the two images of a pair: cameras that are triggered together state the
# same stamp to a few tenths of a millisecond
MAX_STEREO_INTERVAL_S = 0.005


class StereoSequence(StreamSequence):
    """Pairs of images of two cameras; depth is computed when a frame is used."""

    depth_source = "stereo"
    choices = ("stereo",)
    _takes_baseline = False
    _pairs: list[tuple[Path, Path]]
    _rig: Rectified

    def files(self) -> list[Path]:
        """Return the images and the files beside them."""
        images = [path for pair in self._pairs for path in pair]
        return sorted({*images, *super().files()})

    def opened_with(self) -> dict[str, Any]:
        """Return what decides how the files are read beside themselves, JSON-ready."""
        return super().opened_with() | {"baseline": self._rig.baseline}

    def _images(self, index: int) -> FrameImages:
        left_path, right_path = self._pairs[index]
        left = read_rgb(left_path, self._size_taken)
        right = read_rgb(right_path, self._size_taken)
        return stereo_images(left, right, self._rig)

    def _take_pairs(
        self,
        left: list[Path],
        left_stamps: np.ndarray,
        right: list[Path],
        right_stamps: np.ndarray,
    ) -> None:
        """Pair the images of one moment; those without a partner are left out."""
        pairs = lists.associate(left_stamps, right_stamps, MAX_STEREO_INTERVAL_S)
        if not pairs:
            raise InputError(
                f"{self.root}: no frames: no two stamps of {len(left)} left and {len(right)} "
                f"right images are within {MAX_STEREO_INTERVAL_S} s."
            )
        if len(pairs) < len(left):
            self._warn(f"{len(left) - len(pairs)} left images have no right one")
        self._pairs = [(left[i], right[j]) for i, j in pairs]
        self.rgb_files = [path for path, _ in self._pairs]
        self.timestamps = left_stamps[[i for i, _ in pairs]]

    def _take_rig(self, rig: Rectified, size_taken: tuple[int, int]) -> None:
        if self.chosen.get("stereo") and not self._takes_baseline:
            raise InputError(
                f"--stereo {self.chosen['stereo'][:40]}: {self.root} states its own baseline: "
                "--stereo without a number."
            )
        self._rig = rig
        self._camera = rig.camera
        self._size_taken = size_taken
        if self._given_scale is not None:
            self._warn(
                "depth is made from two images: --depth-scale does not count"
            )


STAMP_DIGITS = 19
"""Of nanoseconds since 1970, for the next three hundred years."""


class EurocSequence(StereoSequence):
    """A recording in the layout of EuRoC and ASL: ``mav0/cam0`` and ``cam1``.

    Each has ``data/``, ``data.csv`` and ``sensor.yaml``. The ground truth of
    ``state_groundtruth_estimate0`` is that of the body, and becomes that of the rectified camera.
    """

    kind = "euroc"
    markers = (
        ("mav0/cam0/data.csv", "mav0/cam1/data.csv"),
        ("cam0/data.csv", "cam1/data.csv"),
    )

    def files(self) -> list[Path]:
        """Return the images, their lists and calibrations, and the ground truth."""
        beside = (*self._base.glob("*/*.csv"), *self._base.glob("*/*.yaml"))
        images = [path for pair in self._pairs for path in pair]
        return sorted({*images, *beside})

    def _open(self) -> None:
        inner = self.root / "mav0"
        self._base = inner if inner.is_dir() else self.root
        left, left_stamps = self._listed("cam0")
        right, right_stamps = self._listed("cam1")
        self._take_pairs(left, left_stamps, right, right_stamps)
        if self._given_camera is None:
            rig, T_body_left = self._calibration_of_sensors()
        else:
            rig = read_rig(Path(str(self._given_camera)))
            T_body_left = np.eye(4)
        rectified = rectify(rig, str(self.root))
        self._take_rig(rectified, rig.left.camera.shape)
        self._take_truth(T_body_left, rectified)
        self._read_imu(T_body_left, rectified)

    def _read_imu(self, T_body_left: np.ndarray, rectified: Rectified) -> None:
        """Take the samples of ``imu0``, whose axes are those of the body."""
        path = self._base / "imu0" / "data.csv"
        if not path.is_file() or self._given_camera is not None:
            return
        numbers = read_rows(path, "timestamp wx wy wz ax ay az").numbers
        samples = np.column_stack([numbers[:, 0] / 1e9, numbers[:, 1:]])
        R_left_body = T_body_left[:3, :3].T
        self._take_imu(samples, rectified.R_rectified_left @ R_left_body)

    def _listed(self, name: str) -> tuple[list[Path], np.ndarray]:
        """The images of a camera in ``data.csv``, and their stamps, s."""
        folder = self._base / name
        path = folder / "data.csv"
        files = list[Path]()
        stamps = list[float]()
        for number, line in enumerate(read_text(path).split("\n"), start=1):
            stamp, _, name = line.partition(",")
            if line.startswith("#") or not line.strip():
                continue
            stamp = stamp.strip()
            is_stamp = stamp.isdecimal() and len(stamp) <= STAMP_DIGITS
            if not is_stamp or not name.strip():
                expected = "'timestamp [ns],filename'"
                raise FormatError(
                    f"{path}:{number}: expected {expected}, got {line[:80]!r}."
                )
            files.append(lists.listed_file(folder / "data", name.strip(), path))
            stamps.append(int(stamp) / 1e9)
        return files, np.array(stamps)

    def _calibration_of_sensors(self) -> tuple[StereoRig, np.ndarray]:
        left, T_body_left = _read_sensor(self._base / "cam0" / "sensor.yaml")
        right, T_body_right = _read_sensor(self._base / "cam1" / "sensor.yaml")
        T_right_left = T_right_left_of(T_body_left, T_body_right)
        return StereoRig(left, right, T_right_left), T_body_left

    def _take_truth(self, T_body_left: np.ndarray, rectified: Rectified) -> None:
        """Take the poses of the body, as those of the rectified left camera."""
        path = self._base / "state_groundtruth_estimate0" / "data.csv"
        if not path.exists():
            return
        columns = "timestamp tx ty tz qw qx qy qz"
        rest = " vx vy vz bwx bwy bwz bax bay baz"
        rows = read_rows(path, columns, columns + rest)
        numbers = rows.numbers
        T_world_body = _poses(numbers[:, 1:4], numbers[:, [5, 6, 7, 4]])
        T_left_rectified = np.eye(4)
        T_left_rectified[:3, :3] = rectified.R_rectified_left.T
        poses = T_world_body @ T_body_left @ T_left_rectified
        self.poses = lists.poses_at(
            self.timestamps, numbers[:, 0] / 1e9, poses, path, self.warnings
        )


class OwnStereoSequence(StereoSequence):
    """A folder of one's own: ``left/``, ``right/``, and ``stereo:`` in ``camera.yaml``.

    With ``--stereo METRES`` the images are rectified, and ``--camera`` or ``camera.yaml`` is that
    of both.
    """

    kind = "stereo"
    markers = (("left", "right", CAMERA_FILE),)
    _takes_baseline = True

    def _open(self) -> None:
        left = lists.sorted_files(self.root / "left", lists.IMAGES)
        right = lists.sorted_files(self.root / "right", lists.IMAGES)
        if not left or not right:
            empty = "right" if left else "left"
            raise InputError(f"{self.root}: no frames: no PNG or JPEG in {empty}/.")
        settings = self._settings(left[0])
        fps = settings.get("fps")
        rate = None if fps is None else as_number(fps)
        left_stamps = lists.stamps_of_files(self.root, left, rate, self.warnings)
        if {path.stem for path in left} & {path.stem for path in right}:
            by_name = {path.stem: path for path in right}
            kept = [i for i, path in enumerate(left) if path.stem in by_name]
            right = [by_name[left[i].stem] for i in kept]
            right_stamps = left_stamps[kept]
        elif len(left) == len(right):
            right_stamps = left_stamps
        else:
            right_stamps = lists.stamps_of_files(
                self.root, right, None, self.warnings
            )
        self._take_pairs(left, left_stamps, right, right_stamps)
        rig, size_taken = rig_of_settings(settings, str(self.root / CAMERA_FILE))
        self._take_rig(rig, size_taken)
        pose_file = self.root / "poses.txt"
        if pose_file.exists():
            stamps, poses = lists.read_timed_poses(pose_file, self.warnings)
            turned = np.eye(4)
            turned[:3, :3] = rig.R_rectified_left.T
            self.poses = lists.poses_at(
                self.timestamps, stamps, poses @ turned, pose_file, self.warnings
            )

    def _settings(self, image: Path) -> dict[str, Any]:
        """What ``camera.yaml`` holds, or what ``--stereo`` and ``--camera`` state in its place."""
        if self.chosen.get("stereo"):
            return self._rectified_settings(image)
        given = self._given_camera
        if isinstance(given, Camera):
            raise InputError(
                f"{self.root}: two cameras are needed: give a camera.yaml with 'stereo:'."
            )
        path = self.root / CAMERA_FILE if given is None else Path(given)
        content = parse_yaml(read_text(path, MAX_YAML_LENGTH), str(path))
        if not isinstance(content, dict) or not isinstance(
            content.get("stereo"), dict
        ):
            raise FormatError(
                f"{path}: expected 'stereo:' with 'baseline' of rectified images, or with "
                "left, right, R_right_left and t_right_left; or give --stereo METRES for the "
                "baseline of rectified images."
            )
        return content

    def _rectified_settings(self, image: Path) -> dict[str, Any]:
        """The settings of rectified images whose baseline is given."""
        own = self.root / CAMERA_FILE
        given = own if self._given_camera is None else self._given_camera
        if given == own and not own.is_file():
            raise InputError(
                f"{self.root}: no {CAMERA_FILE}, and no camera is given: --camera fx,fy,cx,cy."
            )
        found = parse_camera(given, image_size(image), self.warnings)
        if any(found.distortion):
            raise InputError(
                f"{given}: --stereo is for rectified images, but the camera has distortion: "
                "describe both cameras under 'stereo:'."
            )
        baseline = {"baseline": self.chosen["stereo"]}
        return {**asdict(found.camera), "fps": found.fps, "stereo": baseline}


def read_rig(path: Path) -> StereoRig:
    """Read two cameras from Kalibr's ``camchain.yaml``.

    Raises:
        FormatError: Something is missing, or a lens is of a model that is not known.
    """
    content = parse_yaml(read_text(path, MAX_YAML_LENGTH), str(path))
    both = isinstance(content, dict) and {"cam0", "cam1"} <= content.keys()
    if not both:
        raise FormatError(f"{path}: expected cam0 and cam1, as Kalibr writes them.")
    left = _lens_of_sensor(content["cam0"], f"{path}: cam0")
    right = _lens_of_sensor(content["cam1"], f"{path}: cam1")
    T = as_rigid(content["cam1"].get("T_cn_cnm1"), f"{path}: T_cn_cnm1", 1e-3)
    return StereoRig(left, right, pose_matrix(T[:3]))


def rig_of_settings(
    settings: dict[str, Any], where: str
) -> tuple[Rectified, tuple[int, int]]:
    """Return the two cameras of a ``camera.yaml`` with ``stereo:``, and the size of the images.

    Raises:
        FormatError: A number is missing or of no use.
    """
    stereo = settings["stereo"]
    height = settings.get("height")
    width = settings.get("width")
    try:
        if "baseline" in stereo:
            baseline = as_number(stereo["baseline"])
            if not baseline > 0:
                raise InputError(f"baseline: expected metres, got {baseline}")
            camera = _camera(settings, height, width)
            return rectified_already(camera, baseline, where), camera.shape
        left = _own_lens(stereo.get("left"), height, width, f"{where}: left")
        right = _own_lens(stereo.get("right"), height, width, f"{where}: right")
        readout_ms = settings.get("readout_ms", 0.0)
        taken = replace(left.camera, readout_ms=readout_ms)
        left = left._replace(camera=taken)
        R = np.array(stereo.get("R_right_left", np.eye(3)), np.float64)
        t = np.array(stereo.get("t_right_left"), np.float64)
        T = np.eye(4)
        T[:3, :3] = R.reshape(3, 3)
        T[:3, 3] = t.reshape(3)
    except (InputError, TypeError, ValueError) as error:
        raise FormatError(f"{where}: stereo: {error}") from None
    return rectify(StereoRig(left, right, T), where), left.camera.shape


def _camera(content: dict[str, Any], height: Any, width: Any) -> Camera:
    fx, fy, cx, cy = (content.get(name) for name in ("fx", "fy", "cx", "cy"))
    readout_ms = content.get("readout_ms", 0.0)
    return Camera(fx, fy, cx, cy, height=height, width=width, readout_ms=readout_ms)  # type: ignore[arg-type]


def _own_lens(content: Any, height: Any, width: Any, where: str) -> Lens:
    if not isinstance(content, dict):
        raise FormatError(f"{where}: expected fx, fy, cx, cy and distortion.")
    with format_errors(where):
        camera = _camera(content, height, width)
    distortion = tuple(
        as_number(value) for value in content.get("distortion") or ()
    )
    return check_lens(
        Lens(camera, distortion, str(content.get("model", ""))), where
    )


def _read_sensor(path: Path) -> tuple[Lens, np.ndarray]:
    """The lens in a ``sensor.yaml`` of EuRoC, and its place in the body, (4, 4)."""
    content = read_opencv_yaml(path)
    if not isinstance(content.get("T_BS"), dict):
        raise FormatError(f"{path}: expected a sensor.yaml with T_BS.")
    try:
        T = np.array(content["T_BS"].get("data"), np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise FormatError(f"{path}: T_BS: expected 16 numbers.") from None
    T = as_rigid(T, f"{path}: T_BS", 1e-3)
    return _lens_of_sensor(content, str(path)), pose_matrix(T[:3])


def _lens_of_sensor(content: Any, where: str) -> Lens:
    """The lens in the words of EuRoC and Kalibr."""
    if not isinstance(content, dict):
        raise FormatError(f"{where}: expected 'key: value' lines.")
    if str(content.get("camera_model", "pinhole")) != "pinhole":
        got = str(content["camera_model"])[:40]
        raise FormatError(f"{where}: camera_model '{got}': expected pinhole.")
    try:
        fx, fy, cx, cy = content["intrinsics"]
        width, height = content["resolution"]
        coefficients = content.get("distortion_coefficients")
        if coefficients is None:
            coefficients = content.get("distortion_coeffs")
        camera = Camera(fx, fy, cx, cy, height=height, width=width)
        distortion = tuple(float(value) for value in coefficients or ())
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{where}: expected intrinsics, resolution and distortion_coefficients "
            f"({error})."
        ) from None
    lens = Lens(camera, distortion, str(content.get("distortion_model", "")))
    return check_lens(lens, where)


def _poses(positions: np.ndarray, xyzw: np.ndarray) -> np.ndarray:
    """(N, 4, 4) of positions (N, 3) and unit quaternions (N, 4)."""
    known = np.isfinite(xyzw).all(axis=1) & (np.linalg.norm(xyzw, axis=1) > 0.5)
    T = np.full((len(xyzw), 4, 4), np.nan)
    T[known] = np.eye(4)
    T[known, :3, :3] = Rotation.from_quat(xyzw[known]).as_matrix()
    T[known, :3, 3] = positions[known]
    return T
