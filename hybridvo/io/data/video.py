"""Readers of a video with a depth map for each frame: one's own, and of Stray Scanner."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_number
from hybridvo.core.depth_units import scale_is_unknown
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import read_rows, read_text
from hybridvo.core.geometry import make_transform
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import (
    CAMERA_FILE,
    Calibration,
    parse_camera,
    read_camera_file,
)
from hybridvo.io.data.image_io import image_size, read_depth, read_mask_png
from hybridvo.io.data.resize import resize_camera
from hybridvo.io.data.sequence import in_metres
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    straightened,
    units_per_metre,
)

VIDEOS = (".mp4", ".avi", ".mov", ".m4v", ".webm", ".mkv")
DEPTHS = (".png", ".npy", ".dpt")
KEPT = 3
"""Decoded frames that are kept: a frame is often used twice."""
LONGEST_WALK = 300
"""Frames that are rather decoded than that the video is opened anew."""


class Video:
    """The frames of a video by number: forward as they are decoded, backward from the start."""

    def __init__(self, path: Path) -> None:
        """Count the frames of a video, and find out their times.

        Raises:
            FormatError: OpenCV cannot decode it.
        """
        self.path = path
        self._kept = OrderedDict[int, np.ndarray]()
        self._rewind()
        times = list[float]()
        while self._capture.grab():
            times.append(self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        if not times:
            raise FormatError(f"{path}: no frames: OpenCV cannot decode the video.")
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.times = np.array(times)  # (N,) s, of the container
        self._rewind()

    def __len__(self) -> int:
        return len(self.times)

    @property
    def has_times(self) -> bool:
        """Whether the times of the container increase, as those of frames do."""
        return bool(
            np.isfinite(self.times).all() and (np.diff(self.times) > 0).all()
        )

    def frame(self, index: int) -> np.ndarray:
        """Return a frame, (H, W, 3) uint8 RGB, as it is stored: without rotation.

        Raises:
            FormatError: It cannot be decoded.
        """
        if index in self._kept:
            return self._kept[index]
        if not 0 <= index - self._next <= LONGEST_WALK:
            self._rewind()
        while self._next < index:
            if not self._capture.grab():
                raise FormatError(f"{self.path}: frame {self._next} is damaged.")
            self._next += 1
        is_there, bgr = self._capture.read()
        self._next += 1
        if not is_there:
            raise FormatError(f"{self.path}: frame {index} is damaged.")
        rgb = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
        self._kept[index] = rgb
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return rgb

    def _rewind(self) -> None:
        self._capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        # the intrinsics belong to the pixels as they are stored
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._next = 0


class VideoSequence(StreamSequence):
    """A video beside ``depth/``, or with ``--depth-dir``; ``camera.yaml`` stands beside it."""

    kind = "video"
    depth_source = "file"
    choices: tuple[str, ...] = ("depth_dir", "depth_offset_ms")

    @classmethod
    def knows_without_depth(cls, folder: Path) -> bool:
        """Return whether a path is a video, or a folder with one and no images."""
        return cls.knows(folder) or (
            len(_videos(folder)) == 1 and not (folder / "rgb").is_dir()
        )

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is a video, or a folder with one video and depth/."""
        if folder.is_file():
            return folder.suffix.lower() in VIDEOS
        has_depth = (folder / "depth").is_dir() and not (folder / "rgb").is_dir()
        return has_depth and len(_videos(folder)) == 1

    def files(self) -> list[Path]:
        """Return the video, its depth maps, and what stands beside them."""
        depth = [path for path in self.depth_files if path is not None]
        names = (CAMERA_FILE, "timestamps.txt", "depth_timestamps.txt", "poses.txt")
        beside = [self._folder / name for name in names]
        return sorted(
            {self._video.path, *depth, *(p for p in beside if p.is_file())}
        )

    def opened_with(self) -> dict[str, Any]:
        """Return what decides how the files are read beside themselves, JSON-ready."""
        return super().opened_with() | {"video": self._video.path.name}

    def _open(self) -> None:
        self._folder = self.root if self.root.is_dir() else self.root.parent
        path = self.root
        if self.root.is_dir():
            videos = _videos(self.root)
            if len(videos) != 1:
                count = len(videos)
                raise InputError(f"{self.root}: expected one video, got {count}.")
            path = videos[0]
        if self._needs_depth:
            # what a video lacks first of all, and what takes its user the longest
            self._depth_files()
        self._video = Video(path)
        first = self._video.frame(0)
        self._take_calibration(first.shape[:2])
        if self._needs_depth:
            self._match_depth(self._stamps())
        else:
            self._take_without_depth(self._stamps())
        self._take_truth()

    def _depth_files(self) -> list[Path]:
        folder = Path(self.chosen.get("depth_dir") or self._folder / "depth")
        files = lists.sorted_files(folder, DEPTHS)
        if not files:
            raise InputError(
                f"{self.root}: no frames: a video has no depth: expected 16-bit PNG, .npy or "
                f".dpt in {folder}; name another folder with --depth-dir DIR, or a network with "
                "--depth onnx:FILE."
            )
        return files

    def _stamps(self) -> np.ndarray:
        """The times of all frames of the video, s."""
        listed = self._folder / "timestamps.txt"
        count = len(self._video)
        if listed.exists():
            return lists.read_stamps_of(self._video.times, listed, self.warnings)
        if self._video.has_times:
            return self._video.times
        rate = self._video.rate if self._video.rate > 0 else self.frames_per_second
        self._warn(f"the video has no times; {lists.assumed_rate(rate)}")
        return np.arange(count) / rate

    def _take_without_depth(self, stamps: np.ndarray) -> None:
        """Take every frame; a network predicts depth."""
        self.rgb_files = []
        self._frame_at = list(range(len(stamps)))
        self.depth_files = [None] * len(stamps)
        self.timestamps = stamps

    def _match_depth(self, stamps: np.ndarray) -> None:
        """Find the depth map of each frame: by count, by number, or by time."""
        files = self._depth_files()
        count = len(stamps)
        numbers = [int(p.stem) if p.stem.isdecimal() else -1 for p in files]
        listed = self._folder / "depth_timestamps.txt"
        if len(files) == count and not listed.exists():
            pairs = [(i, i) for i in range(count)]
        elif min(numbers) >= 0 and max(numbers) < count and not listed.exists():
            pairs = [(number, j) for j, number in enumerate(numbers)]
            self._warn(f"{count - len(pairs)} of {count} frames have no depth")
        else:
            depth_stamps = lists.known_stamps(files, listed, self.warnings)
            if depth_stamps is None:
                raise InputError(
                    f"{self.root}: {len(files)} depth maps for {count} frames: name them by "
                    "the number of their frame, from 0, or write depth_timestamps.txt."
                )
            depth_stamps = self._by_colours_clock(depth_stamps)
            pairs = lists.depth_at(stamps, depth_stamps, self.root, self.warnings)
            self.depth_timestamps = depth_stamps[[j for _, j in pairs]]
        self.rgb_files = []
        self._frame_at = [i for i, _ in pairs]
        self.depth_files = [files[j] for _, j in pairs]
        self.timestamps = stamps[self._frame_at]
        size = image_size(files[0])
        self._check_size(size, files[0])

    def _check_size(self, size: tuple[int, int], path: Path) -> None:
        camera = self.camera(0)
        if size != camera.shape:
            raise InputError(
                f"{path}: depth is {size[1]}x{size[0]}, the video {camera.width}x"
                f"{camera.height} pixels: depth must be registered to colour, not resized."
            )

    def _calibration_of(self, size: tuple[int, int]) -> Calibration:
        if self._given_camera is not None:
            return parse_camera(self._given_camera, size, self.warnings)
        path = self._folder / CAMERA_FILE
        if not path.exists():
            raise InputError(
                f"{self.root}: no {CAMERA_FILE} beside the video, and no camera is given: write "
                f"one with 'hybridvo init {self._folder}', or give --camera fx,fy,cx,cy or FILE."
            )
        return read_camera_file(path, self.warnings)

    def _take_calibration(self, size: tuple[int, int]) -> None:
        found = self._calibration_of(size)
        camera = found.camera
        if camera.shape != size:
            raise InputError(
                f"{self.root}: the video is {size[1]}x{size[0]}, the camera is for "
                f"{camera.width}x{camera.height} pixels: give its own (--camera)."
            )
        self._camera = camera
        if any(found.distortion):
            self._lens = Lens(camera, tuple(found.distortion)).maps()
        if self._given_scale is None:
            self._given_scale = found.depth_scale
        if self._given_scale is not None:
            self._given_scale = units_per_metre(
                self._given_scale, 1.0, self.warnings
            )

    def _take_truth(self) -> None:
        path = self._folder / "poses.txt"
        if path.exists():
            truth = lists.read_timed_poses(path, self.warnings)
            self.poses = lists.poses_at(
                self.timestamps, *truth, path, self.warnings
            )

    def _images(self, index: int) -> FrameImages:
        rgb = self._video.frame(self._frame_at[index])
        depth = None
        if self._needs_depth:
            depth = self._depth_of(index, self.camera(0).shape)
        return straightened(self._lens, rgb, depth)

    def _depth_of(self, index: int, size: tuple[int, int]) -> np.ndarray:
        """Depth of a frame, (H, W) float32 metres."""
        path = self.depth_files[index]
        if path is None:
            raise FormatError(f"{self.name}: frame {index} has no depth.")
        stored = read_depth(path, size)
        if stored.dtype.kind != "u":
            return stored.astype(np.float32)
        if self._given_scale is None:
            where = f"'depth_scale' in {CAMERA_FILE}"
            raise InputError(f"{path}: {scale_is_unknown(stored, where)}")
        return in_metres(stored, self._given_scale)


def _videos(folder: Path) -> list[Path]:
    inside = folder.iterdir() if folder.is_dir() else ()
    return sorted(p for p in inside if p.suffix.lower() in VIDEOS and p.is_file())


R_VIDEO_PHONE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""From the phone's axes to those of its camera, whose images are stored lying on a side: turns of
ARKit agree with ``imu.csv`` of a real recording to .004 rad/s, its vertical to a degree."""
ENLARGED = 2
"""Pixels of a frame in one of Stray Scanner's depth maps, along a row or column."""


class StrayScannerSequence(VideoSequence):
    """A recording of the phone app Stray Scanner.

    ``rgb.mp4``, ``depth/`` of fewer pixels (millimetres), ``confidence/``, ``camera_matrix.csv``
    and ``odometry.csv``. Depth is of the same view as the video: frames have twice the pixels of
    depth, to which the video is made smaller.
    """

    kind = "strayscanner"
    choices = ()
    depth_scale = 1000.0
    markers = (("rgb.mp4", "camera_matrix.csv", "depth"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder is a recording of the app."""
        names = cls.markers[0]
        return folder.is_dir() and all((folder / name).exists() for name in names)

    def files(self) -> list[Path]:
        """Return the video, the maps, and the lists beside them."""
        return sorted({*super().files(), *self.root.glob("*.csv")})

    def _take_calibration(self, size: tuple[int, int]) -> None:
        depth_size = image_size(self._depth_files()[0])
        height = ENLARGED * depth_size[0]
        width = ENLARGED * depth_size[1]
        if abs(height / width - size[0] / size[1]) > 0.02:
            raise InputError(
                f"{self.root}: depth is {depth_size[1]}x{depth_size[0]}, the video "
                f"{size[1]}x{size[0]}: expected two images of one shape."
            )
        taken = self._camera_of_video(size)
        self._camera = resize_camera(taken, height, width)
        self._depth_size = depth_size
        if self._given_scale is None:
            self._given_scale = self.depth_scale

    def _camera_of_video(self, size: tuple[int, int]) -> Camera:
        if self._given_camera is not None:
            return parse_camera(self._given_camera, size, self.warnings).camera
        path = self.root / "camera_matrix.csv"
        K = read_rows(path, "fx 0 cx").numbers
        with format_errors(path):
            return Camera.from_matrix(K, *size)

    def _check_size(self, size: tuple[int, int], path: Path) -> None:
        if size != self._depth_size:
            raise InputError(f"{path}: expected depth of one size, got {size}.")

    def _stamps(self) -> np.ndarray:
        rows = self._odometry()
        if rows is None or len(rows) != len(self._video):
            return super()._stamps()
        return rows[:, 0]

    def _odometry(self) -> np.ndarray | None:
        """Rows of ``odometry.csv``: time, frame, place, and rotation as a quaternion."""
        path = self.root / "odometry.csv"
        if not path.exists():
            return None
        # newer versions of the app append the intrinsics of each frame
        numbers = [
            [as_number(word) for word in line.split(",")[:9]]
            for line in read_text(path).split("\n")
            if line.strip() and not line.startswith(("timestamp", "#"))
        ]
        if any(len(row) != 9 for row in numbers) or not numbers:
            raise FormatError(
                f"{path}: expected 'timestamp, frame, x, y, z, qx, qy, qz, qw'."
            )
        return np.array(numbers)

    def _read_imu(self) -> None:
        """Take ``imu.csv``: of the phone's axes, x to its right and y to its top."""
        path = self.root / "imu.csv"
        if not path.is_file():
            return
        numbers = [
            [as_number(word) for word in line.split(",")]
            for line in read_text(path).split("\n")
            if line.strip() and not line.startswith(("timestamp", "#"))
        ]
        whole = [row for row in numbers if len(row) == 7 and np.isfinite(row).all()]
        if len(whole) < len(numbers):
            count = len(numbers) - len(whole)
            self._warn(f"{count} of {len(numbers)} rows of imu.csv are left out")
        if whole:
            samples = np.array(whole)[:, [0, 4, 5, 6, 1, 2, 3]]
            # a phone at rest on its back reads -9.81 along z, its front: the opposite of force
            samples[:, 4:7] *= -1
            self._take_imu(samples, R_VIDEO_PHONE)

    def _take_truth(self) -> None:
        """Take the app's own poses, which are camera to world with OpenCV's axes."""
        self._read_imu()
        rows = self._odometry()
        if rows is None:
            return
        by_frame = {int(row[1]): row for row in rows if np.isfinite(row).all()}
        poses = np.full((len(self), 4, 4), np.nan)
        for k, number in enumerate(self._frame_at):
            row = by_frame.get(number)
            if row is None or not 0.5 < np.linalg.norm(row[5:9]) < 2:
                continue
            poses[k] = make_transform(
                Rotation.from_quat(row[5:9]).as_matrix(), row[2:5]
            )
        self.poses = poses

    def _images(self, index: int) -> FrameImages:
        camera = self.camera(0)
        rgb = self._video.frame(self._frame_at[index])
        size = (camera.width, camera.height)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        depth = self._depth_of(index, self._depth_size)
        name = Path(self.depth_files[index] or "").name
        confidence = self.root / "confidence" / name
        if confidence.is_file():
            # ARKit's levels are 0, 1 and 2: depth of no confidence is left out
            is_confident = read_mask_png(confidence, self._depth_size)
            depth = np.where(is_confident, depth, np.float32(0))
        large = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return FrameImages(small, large)
