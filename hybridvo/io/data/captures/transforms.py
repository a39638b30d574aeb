"""The reader of ``transforms.json``: nerfstudio, Polycam, NeRFCapture, instant-ngp."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import read_bytes
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.image_io import as_pose, image_size, read_depth, read_rgb
from hybridvo.io.data.resize import resize_camera
from hybridvo.io.data.sequence import UndistortionMaps, in_metres
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    check_lens,
    straightened,
    units_per_metre,
)

TRANSFORMS = "transforms.json"
MAX_BYTES = 2**23
"""Bytes of the file: some thousand frames."""
DEPTH_KEYS = ("depth_file_path", "depth_path")
"""How a frame names its depth map: nerfstudio and Polycam, instant-ngp and NeRFCapture."""
MILLIMETRES = 1000.0
"""Units per metre where the file states none, as nerfstudio has it."""
ENLARGED = 2
"""Pixels of a frame in one of a depth map of fewer pixels, along a row or column."""
T_OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From axes x right, y down, z forward to those of OpenGL: y up, z backward."""
BROWN = ("k1", "k2", "p1", "p2", "k3")
FISHEYE = ("k1", "k2", "k3", "k4")
PINHOLE = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
"""Models without distortion, by their names in COLMAP and nerfstudio."""


class FrameEntry(NamedTuple):
    """A frame of the file."""

    rgb: Path
    depth: Path | None
    lens: Lens
    T_world_cam: np.ndarray  # (4, 4) with OpenCV's axes; NaN where unknown


class TransformsSequence(StreamSequence):
    """``transforms.json`` with images and depth maps.

    Poses, which have OpenGL's axes of a camera, become the ground truth. Each frame may have
    intrinsics of its own. Depth of fewer pixels than the images (a phone's lidar) has the same
    view: the frames get twice its pixels.
    """

    kind = "transforms"
    depth_source = "file"
    depth_scale = MILLIMETRES
    markers = ((TRANSFORMS,),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is the file, or a folder with it."""
        if folder.is_file():
            return folder.name == TRANSFORMS
        return (folder / TRANSFORMS).is_file()

    def files(self) -> list[Path]:
        """Return the file, the images and the depth maps."""
        listed = [self._path, *self.rgb_files, *self.depth_files]
        return sorted({path for path in listed if path and path.is_file()})

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame, at the size of the frames."""
        return self._cameras[index]

    def _open(self) -> None:
        is_file = self.root.is_file()
        self._folder = self.root.parent if is_file else self.root
        self._path = self._folder / TRANSFORMS
        if is_file:
            self.name = self._folder.name
        content = self._content()
        views = self._views(content)
        if self._needs_depth:
            views = self._with_depth(views)
        self._views_read = views
        self.rgb_files = [view.rgb for view in views]
        self.depth_files = [view.depth for view in views]
        self.poses = np.array([view.T_world_cam for view in views])
        self.timestamps = np.arange(len(views)) / self.frames_per_second
        rate = self.frames_per_second
        self._warn(f"no time stamps; {lists.assumed_rate(rate)}")
        self._warn(
            "poses of transforms.json are compared with as they are; where they were made of "
            "images alone, their unit is no metre"
        )
        self._units = self._units_of(content)
        self._take_sizes(views)

    def _content(self) -> dict[str, Any]:
        """Read the file as an object of JSON with frames."""
        try:
            content = json.loads(read_bytes(self._path, MAX_BYTES))
        except FormatError:
            raise
        except (ValueError, RecursionError):
            content = None
        frames = content.get("frames") if isinstance(content, dict) else None
        if (
            not isinstance(content, dict)
            or not isinstance(frames, list)
            or not frames
            or not all(isinstance(frame, dict) for frame in frames)
        ):
            raise FormatError(
                f"{self._path}: expected a JSON object with 'frames', each with file_path and "
                "transform_matrix."
            )
        return content

    def _views(self, content: dict[str, Any]) -> list[FrameEntry]:
        """The frames in the order of the names of their images."""
        frames = [
            (self._file(frame.get("file_path"), "file_path"), frame)
            for frame in content["frames"]
        ]
        frames.sort(key=lambda pair: lists.by_number(pair[0]))
        return [
            FrameEntry(
                rgb,
                self._depth_file(frame),
                self._lens_of(content | frame, rgb),
                self._pose(frame),
            )
            for rgb, frame in frames
        ]

    def _file(self, name: Any, key: str) -> Path:
        """The file that a frame names; its ending may be left out."""
        if not isinstance(name, str) or not name:
            got = str(name)[:80]
            raise FormatError(f"{self._path}: {key}: expected a name, got {got!r}.")
        path = lists.listed_file(self._folder, name, self._path)
        if path.exists():
            return path
        endings = [path.with_name(path.name + ending) for ending in lists.IMAGES]
        return next((each for each in endings if each.is_file()), path)

    def _depth_file(self, frame: dict[str, Any]) -> Path | None:
        """The depth map of a frame; None where it names none."""
        for key in DEPTH_KEYS:
            if frame.get(key) is not None:
                return self._file(frame[key], key)
        return None

    def _with_depth(self, views: list[FrameEntry]) -> list[FrameEntry]:
        """The frames that have depth; an InputError where none has."""
        kept = [view for view in views if view.depth and view.depth.is_file()]
        if not kept:
            named = [str(view.depth) for view in views if view.depth]
            got = f"{named[0]} is not there" if named else "no frame names any"
            raise InputError(
                f"{self._path}: no depth: {got}; expected depth_file_path in each frame "
                "(nerfstudio: ns-process-data polycam --use-depth; NeRFCapture: with depth), or "
                "--depth onnx:FILE."
            )
        if len(kept) < len(views):
            count = len(views) - len(kept)
            self._warn(f"{count} of {len(views)} frames have no depth")
        return kept

    def _pose(self, frame: dict[str, Any]) -> np.ndarray:
        """The pose of a frame with OpenCV's axes; NaN where it states none."""
        stored = frame.get("transform_matrix")
        if stored is None:
            return np.full((4, 4), np.nan)
        try:
            T = np.array(stored, np.float64)
        except (TypeError, ValueError, OverflowError):
            T = np.zeros(0)
        if T.shape not in ((4, 4), (3, 4)):
            raise FormatError(
                f"{self._path}: transform_matrix: expected 4x4 numbers, got {str(stored)[:80]}."
            )
        return as_pose(T[:3], str(self._path)) @ T_OPENGL_OPENCV

    def _units_of(self, content: dict[str, Any]) -> float:
        """Units per metre of depth of whole numbers."""
        # both state metres per unit
        for key in ("integer_depth_scale", "depth_unit_scale_factor"):
            unit = as_number(content.get(key))
            if self._given_scale is None and 0 < unit < np.inf:
                return 1 / unit
        return units_per_metre(self._given_scale, MILLIMETRES, self.warnings)

    # -- cameras -------------------------------------------------------------------

    def _lens_of(self, stated: dict[str, Any], rgb: Path) -> Lens:
        """The camera of a frame, by its own numbers or those of the file."""
        if self._given_camera is not None:
            found = parse_camera(self._given_camera, image_size(rgb), self.warnings)
            return Lens(found.camera, tuple(found.distortion))
        height = as_number(stated.get("h"))
        width = as_number(stated.get("w"))
        if not (height > 0 and width > 0):
            height, width = image_size(rgb)
        fx = _focal_length(stated, "x", width)
        fy = _focal_length(stated, "y", height)
        if not fy > 0:
            fy = fx
        # their pixel (0, 0) has its corner there, ours its centre
        cx = as_number(stated.get("cx", width / 2)) - 0.5
        cy = as_number(stated.get("cy", height / 2)) - 0.5
        try:
            camera = Camera(fx, fy, cx, cy, height=int(height), width=int(width))
        except (InputError, OverflowError) as error:
            raise FormatError(f"{self._path}: camera: {error}") from None
        model = str(stated.get("camera_model", "OPENCV"))[:40]
        is_fisheye = "FISHEYE" in model.upper() or bool(stated.get("is_fisheye"))
        names = FISHEYE if is_fisheye else BROWN
        distortion = tuple(as_number(stated.get(name, 0)) for name in names)
        if not any(distortion) or model in PINHOLE:
            return Lens(camera)
        kind = "equidistant" if is_fisheye else ""
        return check_lens(Lens(camera, distortion, kind), str(self._path))

    def _take_sizes(self, views: list[FrameEntry]) -> None:
        """Find out the sizes of images and depth, and that of the frames."""
        first = views[0]
        self._image_size = image_size(first.rgb)
        if first.depth is None:
            self._depth_size = self._image_size
        else:
            self._depth_size = image_size(first.depth)
        height, width = self._image_size
        rows, columns = self._depth_size
        if abs(rows * width - columns * height) > rows * width // 50:
            raise InputError(
                f"{self._path}: depth is {columns}x{rows}, images {width}x{height}: expected "
                "two of one shape, which show the same view."
            )
        times = min(ENLARGED, max(1, width // columns))
        self._frame_size = times * rows, times * columns
        self._cameras = [self._camera_of(view) for view in views]
        self._camera = self._cameras[0]
        self._maps: dict[Lens, UndistortionMaps | None] = {}

    def _camera_of(self, view: FrameEntry) -> Camera:
        """The camera of a frame, at the size of the frames."""
        camera = view.lens.camera
        if camera.shape != self._image_size:
            # intrinsics of the images before they were made smaller
            camera = resize_camera(camera, *self._image_size)
        return resize_camera(camera, *self._frame_size)

    def _lens_maps(self, index: int) -> UndistortionMaps | None:
        """The way out of the distortion of a frame; None where there is none."""
        lens = self._views_read[index].lens
        if lens.is_straight:
            return None
        small = Lens(self._cameras[index], lens.distortion, lens.model)
        if small not in self._maps:
            # frames of one camera share it; with one camera each, one is kept
            self._maps = {small: small.maps()}
        return self._maps[small]

    def _images(self, index: int) -> FrameImages:
        view = self._views_read[index]
        height, width = self._frame_size
        size = (width, height)
        rgb = read_rgb(view.rgb, self._image_size)
        if rgb.shape[:2] != self._frame_size:
            rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        depth = None
        if view.depth is not None and self._needs_depth:
            depth = self._depth_of(view.depth)
            depth = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return straightened(self._lens_maps(index), rgb, depth)

    def _depth_of(self, path: Path) -> np.ndarray:
        """Depth of a frame, (h, w) float32 metres."""
        stored = read_depth(path, self._depth_size)
        if stored.dtype.kind != "u":
            return stored.astype(np.float32)
        return in_metres(stored, self._units)


def _focal_length(stated: dict[str, Any], axis: str, length: float) -> float:
    """The focal length along an axis, pixels, by itself or by the angle of view; else NaN."""
    focal_length = as_number(stated.get(f"fl_{axis}"))
    if focal_length > 0:
        return focal_length
    angle = as_number(stated.get(f"camera_angle_{axis}"))
    if 0 < angle < math.pi:
        return length / 2 / math.tan(angle / 2)
    return math.nan
