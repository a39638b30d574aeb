"""Readers of published data sets, as they are shipped.

MPI Sintel and TartanAir are rendered, with exact depth and flow; TUM RGB-D with its relatives
(ICL-NUIM, Bonn, Redwood) and 7-Scenes are recorded by a Kinect, KITTI by a car.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from hybridvo.checks import as_number
from hybridvo.data import image_io, lists
from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.errors import FormatError, InputError
from hybridvo.files import read_text
from hybridvo.geometry import invert, ned_to_camera, pose_matrix
from hybridvo.trajectory import COLUMNS, read_poses
from hybridvo.types import Camera, Frame

SINTEL_PASSES = ("final", "clean", "albedo")
SINTEL_PARTS = {
    **dict.fromkeys(SINTEL_PASSES, "(?:png|jpg|jpeg)"),
    **{
        "flow": "flo",
        "depth": "dpt",
        "camdata_left": "cam",
        "invalid": "png",
        "occlusions": "png",
    },
}
"""The parts of a scene, each a folder, with the ending of the files in it."""


class SintelSequence(Sequence):
    """One Sintel scene, such as ``training/clean/alley_1``, or ``alley_1`` beside ``clean``.

    Images are those of the path, else of the final pass, else of the clean one.
    """

    kind = "sintel"
    frames_per_second = 24.0
    depth_source = "true"
    flow_is_true = True
    markers = ((".../{clean,final,flow,depth,camdata_left}/NAME", "frame_0001.*"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder, which itself need not be there, stands for a scene."""
        folder = folder.absolute()
        return folder.parent.name in SINTEL_PARTS and any(
            _scene_files(folder, part) for part in SINTEL_PARTS
        )

    def _list_files(self) -> None:
        own = self.root.parent.name
        passes = (own,) if own in SINTEL_PASSES else SINTEL_PASSES
        rgb = next(
            (found for p in passes if (found := _scene_files(self.root, p))), {}
        )
        parts = ("depth", "flow", "camdata_left", "invalid")
        depth, flow, cameras, invalid = (
            _scene_files(self.root, part) for part in parts
        )
        numbers = self._list_numbered(rgb, depth, flow)
        if not cameras:
            where = self.root.parent.parent / "camdata_left" / self.name
            raise InputError(
                f"{where}: no frame_*.cam; they come with Sintel's training depth."
            )
        self._cameras = [cameras.get(n) for n in numbers]
        self._invalid = [invalid.get(n) for n in numbers]
        self._read_poses(
            self._cameras, lambda path: invert(image_io.read_cam(path)[1])
        )

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame, for Sintel zooms; FileNotFoundError where it has none."""
        if self._camera is not None:
            return self._camera
        path = self._cameras[index]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no .cam file.")
        try:
            return Camera.from_matrix(
                image_io.read_cam(path)[0], self.height, self.width
            )
        except InputError as error:
            raise FormatError(f"{path}: {error}") from None

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        flow, valid = image_io.read_flow(path, self._size)
        if mask := self._invalid[index]:
            known = ~image_io.read_mask_png(mask, self._size)
            valid = known if valid is None else valid & known
        return flow, valid


def _scene_files(scene: Path, part: str) -> dict[int, Path]:
    """Files of a part of a scene by number; the zips may have been unpacked apart."""
    base = scene.parent.parent
    name = scene.name
    folder = base / part / name
    if not folder.is_dir() and base.name == "training":
        # MPI-Sintel-complete/training beside MPI-Sintel-depth-training/training
        apart = sorted(base.parent.parent.glob(f"*/training/{part}/{name}"))
        folder = apart[0] if apart else folder
    return lists.numbered_files(folder, rf"frame_(\d+)\.{SINTEL_PARTS[part]}")


class TartanAirSequence(Sequence):
    """One TartanAir trajectory, such as ``P000``; its flow is that of the camera alone."""

    kind = "tartanair"
    frames_per_second = 10.0
    depth_source = "true"
    flow_is_true = True
    markers = (
        *(("image_left",), ("depth_left",)),  # V1
        *(("image_lcam_front",), ("depth_lcam_front",)),  # V2
    )

    def _list_files(self) -> None:
        root = self.root
        is_v2 = any(
            (root / f"{what}_lcam_front").is_dir() for what in ("image", "depth")
        )
        camera, flow_folder = (
            ("lcam_front", "flow_lcam_front") if is_v2 else ("left", "flow")
        )
        if root.parent.name in ("Easy", "Hard"):
            self.name = "_".join(root.parts[-3:])
        numbers = self._list_numbered(
            lists.numbered_files(
                root / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)"
            ),
            lists.numbered_files(
                root / f"depth_{camera}", rf"(\d+)_{camera}_depth\.(?:npy|png)"
            ),
            lists.numbered_files(
                root / flow_folder, r"(\d+)_\d+_flow\.(?:npy|png)"
            ),
        )
        pose_file = root / f"pose_{camera}.txt"
        if pose_file.exists():
            poses = ned_to_camera(read_poses(pose_file, COLUMNS["tartanair"])[1])
            self.poses = lists.numbered_poses(numbers, poses)

    def _calibration(self) -> Calibration:
        # a field of view of 90 degrees over the width; TartanAir publishes a centre of 320 px at a
        # width of 640, where pixel (0, 0) is a corner: here it is the centre of the first pixel
        height = self.height
        width = self.width
        centre = (width - 1) / 2, (height - 1) / 2
        return Calibration(Camera(width / 2, width / 2, *centre, height, width))

    def _read_depth(self, path: Path) -> np.ndarray:
        if path.suffix != ".png":
            return super()._read_depth(path)
        # the four bytes of a little-endian float
        what = "a float32 depth PNG of TartanAir V2"
        image = image_io.read_png(path, np.uint8, 4, what, self._size)
        return np.ascontiguousarray(image).view("<f4")[:, :, 0].astype(np.float32)

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        if path.suffix == ".png":  # u, v, mask in OpenCV's order, not in KITTI's
            flow, occluded = image_io.read_flow_png(path, (0, 1, 2), self._size)
            return flow, occluded == 0
        flow, _ = image_io.read_flow(path, self._size)
        # 0 is valid
        mask = path.with_name(path.name.removesuffix("_flow.npy") + "_mask.npy")
        if not mask.exists():
            return flow, None
        return flow, image_io.read_npy(mask, size=self._size) == 0


FR1 = (517.306408, 516.469215, 318.64304, 255.313989)
FR2 = (520.90862, 521.007327, 325.141442, 249.701764)
BONN = (542.822841, 542.576870, 315.593520, 237.756098)
PUBLISHED: dict[
    str, tuple[tuple[float, float, float, float], tuple[float, ...]]
] = {
    "fr1": (FR1, (0.262383, -0.953104, -0.005358, 0.002628, 1.163314)),
    "fr2": (FR2, (0.231222, -0.784899, -0.003257, -0.000105, 0.917205)),
    "fr3": ((535.4, 539.2, 320.1, 247.6), ()),
    "bonn": (BONN, (0.039903, -0.099343, -0.00073, -0.000144, 0.0)),
}
"""Published fx fy cx cy, px, and k1 k2 p1 p2 k3, by a word in the folder's name."""

# Bonn's page: a camera has the pose T_ROS^-1 T T_ROS T_MARKER, where T is that of the tracked body.
BONN_ROS = np.array(
    [[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]]
)
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
        root = self.root
        warnings = self.warnings
        if (root / "rgb.txt").exists():
            (stamps, rgb), (depth_stamps, depth) = (
                lists.read_stamps(
                    root / name, warnings, "timestamp filename", words=1
                )
                for name in ("rgb.txt", "depth.txt")
            )
            pairs = lists.depth_at(stamps, depth_stamps, root / "rgb.txt", warnings)
            self.timestamps = stamps[[i for i, _ in pairs]]
            self.rgb_files = [self._file(rgb[i][0], "rgb.txt") for i, _ in pairs]
            self.depth_files = [
                self._file(depth[j][0], "depth.txt") for _, j in pairs
            ]
        else:  # stamp depth stamp rgb (ICL-NUIM), or stamp rgb stamp depth
            listed = root / "associations.txt"
            columns = "timestamp file timestamp file"
            self.timestamps, words = lists.read_stamps(
                listed, warnings, columns, words=3
            )
            rgb_at = 2 if any("depth" in row[0].lower() for row in words) else 0
            self.rgb_files = [self._file(row[rgb_at], listed.name) for row in words]
            self.depth_files = [
                self._file(row[2 - rgb_at], listed.name) for row in words
            ]
        icl = min(root.glob("*.gt.freiburg"), default=None)
        self._is_icl = icl is not None
        pose_file = icl or root / "groundtruth.txt"
        if not pose_file.exists():
            return
        stamps, poses = lists.read_timed_poses(pose_file, warnings)
        if self._is_icl:  # has frame numbers for stamps, and y upwards
            self.timestamps = self.timestamps / self.frames_per_second
            stamps = stamps / self.frames_per_second
            reflection = np.diag([1.0, -1.0, 1.0, 1.0])
            poses = reflection @ poses @ reflection
        elif "bonn" in root.name.lower():  # from the tracked body to the camera
            poses = invert(BONN_ROS) @ poses @ BONN_ROS @ pose_matrix(BONN_MARKER)
        self.poses = lists.poses_at(
            self.timestamps, stamps, poses, pose_file, warnings
        )

    def _file(self, name: str, listed_in: str) -> Path:
        return lists.listed_file(self.root, name, self.root / listed_in)

    def _calibration(self) -> Calibration:
        name = self.name.lower().replace("freiburg", "fr")
        for word, (intrinsics, distortion) in PUBLISHED.items():
            if word in name:
                return Calibration(Camera(*intrinsics, 480, 640), distortion)
        intrinsics = (
            (481.2, 480.0, 319.5, 239.5)
            if self._is_icl
            else (525.0, 525.0, 319.5, 239.5)
        )
        why = "the folder name says neither fr1, fr2, fr3 nor Bonn; else give --camera fx,fy,cx,cy"
        self._assume(f"camera {intrinsics} (fx fy cx cy) is assumed: {why}")
        return Calibration(Camera(*intrinsics, 480, 640))


class SevenScenesSequence(Sequence):
    """One sequence such as ``chess/seq-01``: ``frame-000000.{color.png,depth.png,pose.txt}``."""

    kind = "7scenes"
    depth_scale = 1000.0
    markers = (("frame-*.color.*",), ("frame-*.rgb.*",), ("frame-*.depth.png",))

    def _list_files(self) -> None:
        root = self.root
        self.name = (
            f"{root.parent.name}_{root.name}"
            if root.name.startswith("seq-")
            else root.name
        )
        numbers = self._list_numbered(
            lists.numbered_files(
                root, r"frame-(\d+)\.(?:color|rgb)\.(?:png|jpg|jpeg)"
            ),
            lists.numbered_files(root, r"frame-(\d+)\.depth\.png"),
        )
        if files := lists.numbered_files(root, r"frame-(\d+)\.pose\.txt"):
            self._read_poses([files.get(number) for number in numbers], _read_pose)

    def _calibration(self) -> Calibration:
        # as the data set's page says
        return Calibration(Camera(585, 585, 320, 240, 480, 640))


def _read_pose(path: Path) -> np.ndarray:
    """T_world_cam (4, 4), NaN where tracking was lost: the file then holds inf or nan."""
    try:
        T = np.array(read_text(path).split(), dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise FormatError(
            f"{path}: expected 16 numbers of a 4x4 matrix ({error})."
        ) from None
    return (
        image_io.as_pose(T[:3], str(path))
        if np.isfinite(T).all()
        else np.full((4, 4), np.nan)
    )


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
        images = {
            n: lists.numbered_files(root / f"image_{n}", r"(\d+)\.(?:png|jpg)")
            for n in "2301"
        }
        left, right = ("2", "3") if images["2"] else ("0", "1")
        depth = lists.numbered_files(root / "depth", r"(\d+)\.(?:png|npy)")
        calibration = root / "calib.txt"
        times = root / "times.txt"
        self._P_left = _read_projection(calibration, left)
        if not depth and images[right]:
            self.depth_source = "stereo"
            depth = images[right]
            P_right = _read_projection(calibration, right)
            # focal length, px, times baseline, m
            self._disparity_at_1m = float(self._P_left[0, 3] - P_right[0, 3])
            if not self._disparity_at_1m > 0:
                raise FormatError(
                    f"{calibration}: expected P{right} to the right of P{left}."
                )
        if images[left] and not depth:
            expected = f"depth/ (16-bit PNG, 256 per metre, or .npy, metres) or image_{right}/"
            raise InputError(f"{root}: no source of depth: expected {expected}.")
        depth = {n: path for n, path in depth.items() if n in images[left]}
        numbers = self._list_numbered(images[left], depth)
        self._left = {depth[n]: images[left][n] for n in depth}
        if times.exists():
            stamps, _ = lists.read_stamps(times, self.warnings)
            if numbers and numbers[-1] >= (count := len(stamps)):
                raise FormatError(
                    f"{times}: expected a line for image {numbers[-1]}, got {count}."
                )
            self.timestamps = stamps[numbers]
        else:
            assumed = f"{self.frames_per_second:g} frames a second assumed"
            self.warnings.append(f"{times}: not there; {assumed}.")
        for path in (
            root / "poses.txt",
            root.parent.parent / "poses" / f"{root.name}.txt",
        ):
            if path.is_file() and self.poses is None:
                # the file holds the poses of camera 0
                T_cam_cam0 = np.eye(4)
                T_cam_cam0[:3, 3] = np.linalg.solve(
                    self._P_left[:, :3], self._P_left[:, 3]
                )
                poses = read_poses(path, COLUMNS["kitti"])[1] @ invert(T_cam_cam0)
                self.poses = lists.numbered_poses(numbers, poses)

    def _calibration(self) -> Calibration:
        try:
            return Calibration(
                Camera.from_matrix(self._P_left[:, :3], self.height, self.width)
            )
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
        left, right = (
            cv2.cvtColor(image_io.read_rgb(file, self._size), cv2.COLOR_RGB2GRAY)
            for file in files
        )
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
        # steps of 1/16 px
        disparity = matcher.compute(left, right).astype(np.float32) / 16
        found = disparity > 0
        return np.where(
            found, self._disparity_at_1m / np.where(found, disparity, 1), 0
        )


def _read_projection(path: Path, number: str) -> np.ndarray:
    """(3, 4) projection of a rectified camera: fx 0 cx tx, 0 fy cy ty, 0 0 1 tz."""
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        name, _, rest = text.partition(":")
        if name in (f"P{number}", f"P_rect_0{number}"):
            numbers = np.array([as_number(word) for word in rest.split()])
            P = numbers.reshape(3, 4) if numbers.size == 12 else np.zeros((3, 4))
            is_camera = (
                P[1, 0] == 0
                and np.allclose(P[2, :3], (0, 0, 1))
                and P[0, 0] * P[1, 1] > 0
            )
            if is_camera and np.isfinite(P).all():
                return P
            expected = f"{name}: fx 0 cx tx 0 fy cy ty 0 0 1 tz"
            raise FormatError(
                f"{path}:{line}: expected {expected}, got {rest[:200]!r}."
            )
    raise FormatError(f"{path}: expected a line 'P{number}: ...', found none.")
