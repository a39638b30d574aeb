"""Readers of published data sets, as they are shipped.

MPI Sintel and TartanAir are rendered, with exact depth and flow; TUM RGB-D with its relatives
(ICL-NUIM, Bonn, Redwood) and 7-Scenes are recorded by a Kinect, KITTI by a car.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import read_text
from hybridvo.core.geometry import invert, ned_to_camera, pose_matrix
from hybridvo.core.trajectory import COLUMNS, read_poses
from hybridvo.core.types import Camera, Frame
from hybridvo.io.calibration import DISPARITY_STD_PX
from hybridvo.io.data import image_io, lists
from hybridvo.io.data.camera_file import (
    CALIBRATION_FILE,
    Calibration,
    read_camera_file,
)
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.stereo import (
    DISPARITY_STEPS,
    depth_from_disparity,
    matcher_of,
)

# s: a recorder that leaves longer between two frames is no video
LONGEST_DURATION_S = 1.0

FLOW_PNG_CHANNELS = (0, 1, 2)
"""Channels of u, v and the mask, in OpenCV's order, in TartanAir's flow PNGs. KITTI's are
reversed."""

# -- MPI Sintel --------------------------------------------------------------------------

SINTEL_PASSES = ("final", "clean", "albedo")
"""Folders of images, the one that is used by default first."""
SINTEL_PARTS = {
    "final": "(?:png|jpg|jpeg)",
    "clean": "(?:png|jpg|jpeg)",
    "albedo": "(?:png|jpg|jpeg)",
    "flow": "flo",
    "depth": "dpt",
    "camdata_left": "cam",
    "invalid": "png",
    "occlusions": "png",
}
"""The folders of the parts of a scene, with the ending of the files in each."""


class SintelSequence(Sequence):
    """One Sintel scene, such as ``training/clean/alley_1``, or ``alley_1`` beside ``clean``.

    Images are those of the pass in the path, else of the final pass, else of the clean one.
    """

    kind = "sintel"
    frames_per_second = 24.0
    depth_source = "true"
    flow_is_true = True
    markers = ((".../{clean,final,flow,depth,camdata_left}/NAME", "frame_0001.*"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder stands for a scene; the folder itself need not exist."""
        folder = folder.absolute()
        if folder.parent.name not in SINTEL_PARTS:
            return False
        return any(_scene_files(folder, part) for part in SINTEL_PARTS)

    def _list_files(self) -> None:
        scene = self.root
        depth = _scene_files(scene, "depth")
        flow = _scene_files(scene, "flow")
        cameras = _scene_files(scene, "camdata_left")
        invalid = _scene_files(scene, "invalid")
        numbers = self._list_numbered(self._list_images(), depth, flow)
        if not cameras:
            where = scene.parent.parent / "camdata_left" / self.name
            raise InputError(
                f"{where}: no frame_*.cam; they come with Sintel's training depth."
            )
        self._cameras = [cameras.get(n) for n in numbers]
        self._invalid = [invalid.get(n) for n in numbers]
        self._read_poses(self._cameras, _read_sintel_pose)

    def _list_images(self) -> dict[int, Path]:
        """List the images of the pass in the path, else of the first pass that has some."""
        own = self.root.parent.name
        passes = (own,) if own in SINTEL_PASSES else SINTEL_PASSES
        for name in passes:
            if images := _scene_files(self.root, name):
                return images
        return {}

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame: the focal length may change between frames.

        Raises:
            FileNotFoundError: The frame has no camera file.
        """
        if self._camera is not None:
            return self._camera
        path = self._cameras[index]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no .cam file.")
        K, _ = image_io.read_cam(path)
        with format_errors(path):
            return Camera.from_matrix(K, self.height, self.width)

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        flow, valid = image_io.read_flow(path, self._size)
        mask = self._invalid[index]
        if mask is None:
            return flow, valid
        is_valid = ~image_io.read_mask_png(mask, self._size)
        if valid is not None:
            is_valid &= valid
        return flow, is_valid


def _read_sintel_pose(path: Path) -> np.ndarray:
    """Read T_world_cam (4, 4) from a camera file."""
    _, T_cam_world = image_io.read_cam(path)
    return invert(T_cam_world)


def _scene_files(scene: Path, part: str) -> dict[int, Path]:
    """List the files of a part of a scene by frame number.

    The zips of images and of depth may have been unpacked beside each other:
    ``MPI-Sintel-complete/training`` and ``MPI-Sintel-depth-training/training``.
    """
    base = scene.parent.parent
    folder = base / part / scene.name
    if not folder.is_dir() and base.name == "training":
        beside = base.parent.parent
        others = sorted(beside.glob(f"*/training/{part}/{scene.name}"))
        if others:
            folder = others[0]
    return lists.numbered_files(folder, rf"frame_(\d+)\.{SINTEL_PARTS[part]}")


# -- TartanAir ---------------------------------------------------------------------------


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
            (root / name).is_dir()
            for name in ("image_lcam_front", "depth_lcam_front")
        )
        if is_v2:
            camera = "lcam_front"
            flow_folder = root / "flow_lcam_front"
        else:
            camera = "left"
            flow_folder = root / "flow"
        if root.parent.name in ("Easy", "Hard"):
            # The environment, the difficulty and the trajectory
            self.name = "_".join(root.parts[-3:])
        rgb = lists.numbered_files(
            root / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)"
        )
        depth = lists.numbered_files(
            root / f"depth_{camera}", rf"(\d+)_{camera}_depth\.(?:npy|png)"
        )
        flow = lists.numbered_files(flow_folder, r"(\d+)_\d+_flow\.(?:npy|png)")
        numbers = self._list_numbered(rgb, depth, flow)
        pose_file = root / f"pose_{camera}.txt"
        if pose_file.exists():
            _, T_world_body = read_poses(pose_file, COLUMNS["tartanair"])
            poses = ned_to_camera(T_world_body)
            self.poses = lists.numbered_poses(numbers, poses)

    def _calibration(self) -> Calibration:
        # The field of view is 90 degrees over the width. TartanAir publishes a centre of 320 px
        # at a width of 640, with (0, 0) at the corner of the image. Here (0, 0) is the centre of
        # the first pixel.
        height = self.height
        width = self.width
        focal_length = width / 2
        cx = (width - 1) / 2
        cy = (height - 1) / 2
        camera = Camera(
            focal_length, focal_length, cx, cy, height=height, width=width
        )
        return Calibration(camera)

    def _read_depth(self, path: Path) -> np.ndarray:
        if path.suffix != ".png":
            return super()._read_depth(path)
        # The four channels are the bytes of a little-endian float.
        what = "a float32 depth PNG of TartanAir V2"
        image = image_io.read_png(path, np.uint8, 4, what, self._size)
        depth = np.ascontiguousarray(image).view("<f4")[:, :, 0]
        return depth.astype(np.float32)

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        if path.suffix == ".png":
            flow, occluded = image_io.read_flow_png(
                path, FLOW_PNG_CHANNELS, self._size
            )
            return flow, occluded == 0
        flow, _ = image_io.read_flow(path, self._size)
        mask_file = path.with_name(
            path.name.removesuffix("_flow.npy") + "_mask.npy"
        )
        if not mask_file.exists():
            return flow, None
        mask = image_io.read_npy(mask_file, size=self._size)
        return flow, mask == 0


# -- TUM RGB-D and its relatives ---------------------------------------------------------


class PublishedCamera(NamedTuple):
    """The camera of a data set, as its page states it, for images of 640x480."""

    intrinsics: tuple[float, float, float, float]  # fx fy cx cy, pixels
    distortion: tuple[float, ...]  # Brown's k1 k2 p1 p2 k3


PUBLISHED: dict[str, PublishedCamera] = {
    "fr1": PublishedCamera(
        (517.306408, 516.469215, 318.64304, 255.313989),
        (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    "fr2": PublishedCamera(
        (520.90862, 521.007327, 325.141442, 249.701764),
        (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    "fr3": PublishedCamera((535.4, 539.2, 320.1, 247.6), ()),
    "bonn": PublishedCamera(
        (542.822841, 542.576870, 315.593520, 237.756098),
        (0.039903, -0.099343, -0.00073, -0.000144, 0.0),
    ),
}
"""Published cameras by a word in the folder's name."""
ICL_INTRINSICS = (481.2, 480.0, 319.5, 239.5)
"""fx fy cx cy of ICL-NUIM, pixels."""
KINECT_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""fx fy cx cy of a Kinect as it is sold, pixels."""
KINECT_SIZE = (480, 640)
"""Height and width of its images, pixels."""

# A camera of Bonn has the pose T_ROS^-1 T T_ROS T_MARKER, where T is the pose of the tracked body.
BONN_ROS = np.array(
    [
        [-1.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 1.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""T_ROS of that page."""
BONN_MARKER = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
    ]
)
"""T_MARKER of that page. Its rotation is published with a scale of 1.0593, which
``pose_matrix`` removes; the translation is in metres."""


class TruePath(NamedTuple):
    """The true poses as their file has them, beside the stamps of the images."""

    stamps: np.ndarray  # (M,) seconds
    poses: np.ndarray  # (M, 4, 4) T_world_cam


def bonn_camera_poses(T_world_body: np.ndarray) -> np.ndarray:
    """Return the poses of Bonn's camera from those that its files have.

    Args:
        T_world_body: (N, 4, 4) poses of the markers, in the axes of the motion capture.

    Returns:
        (N, 4, 4) T_world_cam, metres.
    """
    T_marker_cam = pose_matrix(BONN_MARKER)
    return np.asarray(invert(BONN_ROS) @ T_world_body @ BONN_ROS @ T_marker_cam)


class TumSequence(Sequence):
    """A recording with ``rgb.txt``, ``depth.txt`` and ``groundtruth.txt``, or ICL-NUIM's lists.

    Colour, depth and poses are matched by time; images of fr1, fr2 and Bonn are undistorted.

    Attributes:
        image_stamps: (N,) seconds, of all images in the list, with depth or without.
        true_path: The true poses of the file, with their own stamps; None without a file.
    """

    kind = "tum"
    choices = ("depth_offset_ms",)
    true_path: TruePath | None = None
    depth_scale = 5000.0
    markers: tuple[tuple[str, ...], ...] = (
        ("rgb.txt", "depth.txt"),
        ("associations.txt",),
    )

    def _list_files(self) -> None:
        root = self.root
        if (root / "rgb.txt").exists():
            self._match_lists("rgb.txt", "depth.txt")
        else:
            self._read_associations()
        icl_poses = min(root.glob("*.gt.freiburg"), default=None)
        self._is_icl = icl_poses is not None
        pose_file = icl_poses or root / "groundtruth.txt"
        if pose_file.exists():
            self._match_poses(pose_file)

    def _match_lists(self, colour: str, depth: str) -> None:
        """Match the images and the depth maps of two lists by time."""
        stamps, rgb_names = self._read_list(colour)
        depth_stamps, depth_names = self._read_list(depth)
        depth_stamps = self._by_colours_clock(depth_stamps)
        if are_durations(stamps) and len(depth_names) == len(rgb_names):
            stamps = self._counted(len(stamps))
            depth_stamps = stamps
        where = self.root / colour
        pairs = lists.depth_at(stamps, depth_stamps, where, self.warnings)
        self.image_stamps = stamps
        self.timestamps = stamps[[i for i, _ in pairs]]
        self.depth_timestamps = depth_stamps[[j for _, j in pairs]]
        self.rgb_files = [self._file(rgb_names[i], colour) for i, _ in pairs]
        self.depth_files = [self._file(depth_names[j], depth) for _, j in pairs]

    def _read_list(self, name: str) -> tuple[np.ndarray, list[str]]:
        """Read a list ``timestamp filename``."""
        stamps, words = lists.read_stamps(
            self.root / name, self.warnings, "timestamp filename", words=1
        )
        return stamps, [row[0] for row in words]

    def _read_associations(self) -> None:
        """Read ``stamp depth stamp rgb`` (ICL-NUIM), or ``stamp rgb stamp depth``."""
        name = "associations.txt"
        columns = "timestamp file timestamp file"
        self.timestamps, words = lists.read_stamps(
            self.root / name, self.warnings, columns, words=3
        )
        if are_durations(self.timestamps):
            self.timestamps = self._counted(len(words))
        first_is_depth = any("depth" in row[0].lower() for row in words)
        rgb_column = 2 if first_is_depth else 0
        depth_column = 2 - rgb_column
        self.image_stamps = self.timestamps
        self.rgb_files = [self._file(row[rgb_column], name) for row in words]
        self.depth_files = [self._file(row[depth_column], name) for row in words]

    def _counted(self, count: int) -> np.ndarray:
        """The stamps of a list whose first column holds durations, s, at the frame rate."""
        rate = self.frames_per_second
        instead = lists.assumed_rate(rate)
        self._assume(f"the lists hold durations instead of times: {instead}")
        return np.arange(count) / rate

    def _match_poses(self, pose_file: Path) -> None:
        """Match the true poses of a file to the frames by time."""
        pose_stamps, poses = lists.read_timed_poses(pose_file, self.warnings)
        if self._is_icl:
            # ICL-NUIM has frame numbers for time stamps, and y upwards.
            self.timestamps = self.timestamps / self.frames_per_second
            pose_stamps = pose_stamps / self.frames_per_second
            reflection = np.diag([1.0, -1.0, 1.0, 1.0])
            poses = reflection @ poses @ reflection
        elif "bonn" in self.root.name.lower() and not self._is_converted:
            poses = bonn_camera_poses(poses)
        self.true_path = TruePath(pose_stamps, poses)
        self.poses = lists.poses_at(
            self.timestamps, pose_stamps, poses, pose_file, self.warnings
        )

    def _file(self, name: str, listed_in: str) -> Path:
        return lists.listed_file(self.root, name, self.root / listed_in)

    @property
    def _is_converted(self) -> bool:
        """Whether ``hybridvo convert`` wrote the folder: with its camera, and poses of it."""
        return (self.root / CALIBRATION_FILE).exists()

    def _calibration(self) -> Calibration:
        if self._is_converted:
            return read_camera_file(self.root / CALIBRATION_FILE, self.warnings)
        name = self.name.lower().replace("freiburg", "fr")
        for word, published in PUBLISHED.items():
            if word in name:
                camera = Camera(
                    *published.intrinsics,
                    height=KINECT_SIZE[0],
                    width=KINECT_SIZE[1],
                )
                return Calibration(camera, published.distortion)
        intrinsics = ICL_INTRINSICS if self._is_icl else KINECT_INTRINSICS
        reason = (
            "the folder name states neither fr1, fr2, fr3 nor Bonn; "
            "else give --camera fx,fy,cx,cy"
        )
        self._assume(f"camera {intrinsics} (fx fy cx cy) is assumed: {reason}")
        return Calibration(
            Camera(*intrinsics, height=KINECT_SIZE[0], width=KINECT_SIZE[1])
        )


def are_durations(stamps: np.ndarray) -> bool:
    """Return whether numbers, s, are durations of frames instead of times, which increase.

    >>> are_durations(np.array([0.033, 0.034, 0.033])), are_durations(np.array([5.0, 3.0]))
    (True, False)
    """
    if not np.isfinite(stamps).all() or (np.diff(stamps) > 0).all():
        return False
    return bool((stamps >= 0).all() and (stamps < LONGEST_DURATION_S).all())


# -- 7-Scenes ----------------------------------------------------------------------------


class SevenScenesSequence(Sequence):
    """One sequence such as ``chess/seq-01``: ``frame-000000.{color.png,depth.png,pose.txt}``.

    Of the scene, ``chess``, the first sequence is read.
    """

    kind = "7scenes"
    depth_scale = 1000.0
    markers = (
        *(("frame-*.color.*",), ("frame-*.rgb.*",), ("frame-*.depth.png",)),
        ("seq-*/frame-*.color.*",),
    )

    def _list_files(self) -> None:
        self._take_first_of_scene()
        root = self.root
        if root.name.startswith("seq-"):
            self.name = f"{root.parent.name}_{root.name}"
        rgb = lists.numbered_files(
            root, r"frame-(\d+)\.(?:color|rgb)\.(?:png|jpg|jpeg)"
        )
        depth = lists.numbered_files(root, r"frame-(\d+)\.depth\.png")
        pose_files = lists.numbered_files(root, r"frame-(\d+)\.pose\.txt")
        numbers = self._list_numbered(rgb, depth)
        if pose_files:
            files = [pose_files.get(number) for number in numbers]
            self._read_poses(files, image_io.read_matrix)

    def _take_first_of_scene(self) -> None:
        """Go to the first sequence where the folder is that of a scene."""
        if any(self.root.glob("frame-*")):
            return
        first, *others = sorted(
            folder for folder in self.root.glob("seq-*") if folder.is_dir()
        ) or [self.root]
        self.root = first
        if others:
            names = lists.abbreviated([folder.name for folder in others])
            self._warn(f"{first.name} of the scene is read; it also has {names}")

    def _calibration(self) -> Calibration:
        # These intrinsics stand on the page of the data set.
        return Calibration(
            Camera(585, 585, 320, 240, height=KINECT_SIZE[0], width=KINECT_SIZE[1])
        )


# -- KITTI odometry ----------------------------------------------------------------------

KITTI_DEPTH_EXPECTED = "depth/ (16-bit PNG, 256 per metre, or .npy, metres)"


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
        # Cameras 2 and 3 are in colour, 0 and 1 are grey.
        has_colour = bool(self._images_of("2"))
        left_camera = "2" if has_colour else "0"
        right_camera = "3" if has_colour else "1"
        left = self._images_of(left_camera)
        right = self._images_of(right_camera)
        depth = lists.numbered_files(root / "depth", r"(\d+)\.(?:png|npy)")
        calibration = root / "calib.txt"
        self._P_left = _read_projection(calibration, left_camera)
        if not depth and right:
            self.depth_source = "stereo"
            depth = right
            P_right = _read_projection(calibration, right_camera)
            # The entry is minus focal length, pixels, times position, metres.
            self._disparity_at_1m = float(self._P_left[0, 3] - P_right[0, 3])
            if not self._disparity_at_1m > 0:
                raise FormatError(
                    f"{calibration}: expected P{right_camera} to the right of P{left_camera}."
                )
        if left and not depth:
            expected = f"{KITTI_DEPTH_EXPECTED} or image_{right_camera}/"
            raise InputError(f"{root}: no source of depth: expected {expected}.")
        depth = {n: path for n, path in depth.items() if n in left}
        numbers = self._list_numbered(left, depth)
        # For stereo, the depth file of a frame is its right image.
        self._left_of = {path: left[n] for n, path in depth.items()}
        self._read_times(numbers)
        self._read_true_poses(numbers)

    def _images_of(self, camera: str) -> dict[int, Path]:
        """List the images of a camera by frame number."""
        return lists.numbered_files(
            self.root / f"image_{camera}", r"(\d+)\.(?:png|jpg)"
        )

    def _read_times(self, numbers: list[int]) -> None:
        """Take the time stamps of the frames from times.txt, if it is there."""
        path = self.root / "times.txt"
        if not path.exists():
            assumed = lists.assumed_rate(self.frames_per_second)
            self.warnings.append(f"{path}: not there; {assumed}.")
            return
        stamps, _ = lists.read_stamps(path, self.warnings)
        count = len(stamps)
        if numbers and numbers[-1] >= count:
            raise FormatError(
                f"{path}: expected a line for image {numbers[-1]}, got {count}."
            )
        self.timestamps = stamps[numbers]

    def _read_true_poses(self, numbers: list[int]) -> None:
        """Take the true poses from poses.txt, or from the folder ``poses`` of the data set."""
        root = self.root
        own = root / "poses.txt"
        of_data_set = root.parent.parent / "poses" / f"{root.name}.txt"
        for path in (own, of_data_set):
            if path.is_file():
                _, T_world_cam0 = read_poses(path, COLUMNS["kitti"])
                # The file has the poses of camera 0.
                P = self._P_left
                T_cam_cam0 = np.eye(4)
                T_cam_cam0[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
                poses = T_world_cam0 @ invert(T_cam_cam0)
                self.poses = lists.numbered_poses(numbers, poses)
                return

    def _calibration(self) -> Calibration:
        K = self._P_left[:, :3]
        with format_errors(self.root / "calib.txt"):
            return Calibration(Camera.from_matrix(K, self.height, self.width))

    def frame(self, index: int) -> Frame:
        """Read a frame; depth from stereo gets a variance of its logarithm.

        From z = f b / d follows std(log z) = std(d) z / (f b).
        """
        frame = super().frame(index)
        if self.depth_source != "stereo" or frame.depth is None:
            return frame
        log_std = DISPARITY_STD_PX * frame.depth / self._disparity_at_1m
        return replace(frame, depth_variance=log_std**2)

    def _read_depth(self, path: Path) -> np.ndarray:
        if self.depth_source != "stereo":
            return super()._read_depth(path)
        left = self._read_grey(self._left_of[path])
        right = self._read_grey(path)
        steps = matcher_of(left.shape[1]).compute(left, right)
        disparity = steps.astype(np.float32) / DISPARITY_STEPS
        return depth_from_disparity(disparity, self._disparity_at_1m)[0]

    def _read_grey(self, path: Path) -> np.ndarray:
        """Read an image as grey values, (H, W) uint8."""
        rgb = image_io.read_rgb(path, self._size)
        return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


def labelled_matrix(
    path: Path, names: tuple[str, ...], shape: tuple[int, int]
) -> np.ndarray:
    """Read the numbers of the first line ``name: 1.0 2.0 ...`` of one of some names."""
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        name, _, rest = text.partition(":")
        if name.strip() not in names:
            continue
        numbers = np.array([as_number(word) for word in rest.split()])
        if numbers.size == shape[0] * shape[1] and np.isfinite(numbers).all():
            return numbers.reshape(shape)
        expected = f"{shape[0] * shape[1]} numbers of {name.strip()}"
        raise FormatError(
            f"{path}:{line}: expected {expected}, got {rest.strip()[:80]!r}."
        )
    raise FormatError(f"{path}: expected a line '{names[0]}: ...', found none.")


def _read_projection(path: Path, number: str) -> np.ndarray:
    """Read the (3, 4) projection of a rectified camera: fx 0 cx tx, 0 fy cy ty, 0 0 1 tz."""
    P = labelled_matrix(path, (f"P{number}", f"P_rect_0{number}"), (3, 4))
    if _is_projection(P):
        return P
    raise FormatError(
        f"{path}: P{number}: expected fx 0 cx tx 0 fy cy ty 0 0 1 tz, got {P.tolist()}."
    )


def _is_projection(P: np.ndarray) -> bool:
    """Return whether a matrix is the projection of a rectified camera."""
    if P[1, 0] != 0:
        return False
    last_row_fits = np.allclose(P[2, :3], (0, 0, 1))
    focal_lengths_fit = P[0, 0] * P[1, 1] > 0
    return bool(last_row_fits and focal_lengths_fit)
