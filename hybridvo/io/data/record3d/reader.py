"""The reader of Record3D: a phone's recording with the depth of its lidar or front camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.geometry import make_transform
from hybridvo.core.types import Camera
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.image_io import decode_bytes
from hybridvo.io.data.lists import assumed_rate
from hybridvo.io.data.record3d.archive import Archive
from hybridvo.io.data.resize import resize_camera
from hybridvo.io.data.streams import FrameImages, StreamSequence

KNOWN_DEPTH_SIZES = ((256, 192), (640, 480))
"""Height and width of the lidar's depth and of the front camera's, where the file names none."""
ENLARGED = 2
"""Pixels of a frame in one of a depth map, along a row or column."""


class Record3dSequence(StreamSequence):
    """An ``.r3d`` file, or the folder into which one was unpacked.

    Depth has fewer pixels than the images and the same view: frames have twice the pixels of
    depth, to which the images are made smaller. The app's own poses (ARKit) are the ground truth.
    """

    kind = "record3d"
    markers = (("metadata*", "rgbd/*.depth"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is an ``.r3d`` file, or what is in one."""
        if folder.is_file():
            return folder.suffix.lower() == ".r3d"
        return super().knows(folder)

    def files(self) -> list[Path]:
        """Return the file, or the files of the folder."""
        if self.root.is_file():
            return [self.root]
        return sorted(path for path in self.root.rglob("*") if path.is_file())

    def _open(self) -> None:
        self._archive = Archive(self.root)
        numbers = self._archive.numbers()
        if not numbers:
            raise InputError(
                f"{self.root}: no frames: expected rgbd/0.jpg, rgbd/0.depth and so on."
            )
        self._numbers = numbers
        self._take_size()
        self._cameras = self._read_cameras()
        self._camera = self._cameras[0]
        self.timestamps = self._read_stamps()
        self.poses = self._poses_of_app()

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame: the phone focuses anew."""
        return self._cameras[index if len(self._cameras) > 1 else 0]

    def _take_size(self) -> None:
        """Find out the size of the images, of depth, and of the frames."""
        first = self._numbers[0]
        self._image_size = self._rgb(first).shape[:2]
        height, width = self._image_size
        stated = [
            as_number(self._archive.metadata.get(name)) for name in ("dh", "dw")
        ]
        if np.isfinite(stated).all() and min(stated) >= 1:
            self._depth_size = int(stated[0]), int(stated[1])
        else:
            self._depth_size = self._guessed_depth_size(height > width)
        rows, columns = self._depth_size
        is_other = abs(rows * width - columns * height) > rows * width // 50
        if is_other or columns > width:
            raise FormatError(
                f"{self.root}: depth is {columns}x{rows}, images {width}x{height}: expected two "
                "of one shape, and depth of fewer pixels."
            )
        times = min(ENLARGED, width // columns)
        self._frame_size = times * rows, times * columns

    def _guessed_depth_size(self, is_upright: bool) -> tuple[int, int]:
        """The size of depth by its count of bytes, of a file of an older app."""
        largest = max(4 * tall * wide for tall, wide in KNOWN_DEPTH_SIZES)
        name = f"rgbd/{self._numbers[0]}.depth"
        count = len(self._archive.unpacked(name, largest))
        for tall, wide in KNOWN_DEPTH_SIZES:
            if 4 * tall * wide == count:
                return (tall, wide) if is_upright else (wide, tall)
        raise FormatError(
            f"{self.root}: metadata names no size of depth (dw, dh), and {count} bytes fit to "
            "none that is known."
        )

    def _read_cameras(self) -> list[Camera]:
        """The camera of each frame, or one for all."""
        if self._given_camera is not None:
            size = self._image_size
            found = parse_camera(self._given_camera, size, self.warnings)
            return [self._smaller(found.camera)]
        each = self._archive.table("perFrameIntrinsicCoeffs", 4)
        if each is not None and len(each) > self._numbers[-1]:
            rows = each[self._numbers]
        else:
            K = self._archive.table("K", None)
            if K is None or K.reshape(-1).shape != (9,):
                raise FormatError(
                    f"{self.root}: metadata: K: expected 9 numbers, column by column."
                )
            # column by column: fx 0 0 0 fy 0 cx cy 1
            rows = K.reshape(-1)[None, [0, 4, 6, 7]]
        height, width = self._image_size
        with format_errors(f"{self.root}: metadata: camera"):
            cameras = [
                Camera(fx, fy, cx, cy, height=height, width=width)
                for fx, fy, cx, cy in rows.tolist()
            ]
        return [self._smaller(camera) for camera in cameras]

    def _smaller(self, camera: Camera) -> Camera:
        """The camera of an image that has the size of a frame."""
        return resize_camera(camera, *self._frame_size)

    def _read_stamps(self) -> np.ndarray:
        stamps = self._archive.table("frameTimestamps", None)
        if stamps is not None and stamps.size > self._numbers[-1]:
            chosen = stamps.reshape(-1)[self._numbers]
            if (np.diff(chosen) > 0).all():
                return chosen
        rate = as_number(self._archive.metadata.get("fps"))
        if not rate > 0:
            rate = self.frames_per_second
            self._warn(f"metadata names no fps; {assumed_rate(rate)}")
        return np.array(self._numbers) / rate

    def _poses_of_app(self) -> np.ndarray | None:
        """Read qx qy qz qw tx ty tz, camera to world, with the axes of OpenGL."""
        stored = self._archive.table("poses", 7)
        if stored is None:
            return None
        # ARKit's cameras have y upwards and look along -z
        T_opengl_opencv = np.diag([1, -1, -1, 1])
        poses = np.full((len(self._numbers), 4, 4), np.nan)
        for k, number in enumerate(self._numbers):
            row = stored[number] if number < len(stored) else np.zeros(7)
            if np.linalg.norm(row[:4]) > 0.5:
                R = Rotation.from_quat(row[:4]).as_matrix()
                poses[k] = make_transform(R, row[4:]) @ T_opengl_opencv
        return poses

    def _images(self, index: int) -> FrameImages:
        number = self._numbers[index]
        height, width = self._frame_size
        size = (width, height)
        depth = self._map(f"rgbd/{number}.depth", np.float32)
        name = f"rgbd/{number}.conf"
        if name in self._archive.names:
            # ARKit's levels are 0, 1 and 2: depth of no confidence is left out
            depth = np.where(self._map(name, np.uint8) > 0, depth, np.float32(0))
        rgb = self._rgb(number, self._image_size)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        large = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return FrameImages(small, large)

    def _rgb(self, number: int, size: Any = None) -> np.ndarray:
        name = f"rgbd/{number}.jpg"
        data = self._archive.read(name)
        bgr = decode_bytes(data, cv2.IMREAD_COLOR, f"{self.root}: {name}", size)
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)

    def _map(self, name: str, dtype: type) -> np.ndarray:
        """A map of the size of depth."""
        rows, columns = self._depth_size
        count = rows * columns * np.dtype(dtype).itemsize
        data = self._archive.unpacked(name, count)
        if len(data) != count:
            raise FormatError(
                f"{self.root}: {name}: expected {count} bytes, {columns}x{rows} of "
                f"{np.dtype(dtype)}, got {len(data)}."
            )
        return np.frombuffer(data, dtype).reshape(rows, columns)
