"""The base class of readers whose frames are made when they are used: no file holds one frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.depth_units import depth_unit_fix, typical_depth
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.trajectory import check_increasing
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.image_io import read_mask_png
from hybridvo.io.data.lists import IMAGES, match_files, sorted_files
from hybridvo.io.data.sequence import (
    Files,
    Sequence,
    UndistortionMaps,
    undistort,
)

FISHEYE_MODELS = ("equidistant", "kannala_brandt4", "fisheye", "kannala_brandt")
"""What ROS and others call OpenCV's fisheye model, of four coefficients."""
BROWN_MODELS = (
    "",
    "none",
    "plumb_bob",
    "rational_polynomial",
    "radial-tangential",
    "radtan",
    "brown",
    "brown conrady",
    "inverse brown conrady",
    "modified brown conrady",
)
"""What ROS, Kalibr and RealSense call OpenCV's own model."""


class FrameImages(NamedTuple):
    """What a frame is made of, all of one size; None where there is none."""

    rgb: np.ndarray | None  # (H, W, 3) or (H, W) uint8
    depth: np.ndarray | None  # (H, W) float32 metres, not positive where unknown
    depth_variance: np.ndarray | None = None  # (H, W) of log depth
    mask: np.ndarray | None = None  # (H, W) bool, False where not to be used


def straightened(
    maps: UndistortionMaps | None, rgb: np.ndarray, depth: np.ndarray | None
) -> FrameImages:
    """Return images without the distortion of a lens; as they are where it has none."""
    if maps is None:
        return FrameImages(rgb, depth)
    straight, straight_depth, mask = undistort(maps, rgb, depth, None)
    return FrameImages(straight, straight_depth, mask=mask)


class Lens(NamedTuple):
    """A camera as it takes images, with what its lens bends."""

    camera: Camera  # of the image without distortion
    distortion: tuple[float, ...] = ()
    model: str = ""  # "" or a name in BROWN_MODELS or FISHEYE_MODELS

    @property
    def is_straight(self) -> bool:
        """Whether the lens bends nothing."""
        return not any(self.distortion)

    @property
    def is_fisheye(self) -> bool:
        """Whether the coefficients are those of OpenCV's fisheye model."""
        return self.model.lower() in FISHEYE_MODELS

    def maps(
        self, R: np.ndarray | None = None, K: np.ndarray | None = None
    ) -> UndistortionMaps:
        """Return where each pixel of the image without distortion lies in the taken one.

        Args:
            R: (3, 3) rotation of the new camera against this one; by default none.
            K: (3, 3) intrinsics of the new camera; by default those of this one.

        Returns:
            Columns and rows, (H, W) float32 each.
        """
        old_K = self.camera.K
        new_K = old_K if K is None else K
        rotation = np.eye(3) if R is None else R
        coefficients = np.array(self.distortion or (0.0,) * 4)
        size = (self.camera.width, self.camera.height)
        opencv: Any = cv2.fisheye if self.is_fisheye else cv2
        columns, rows = opencv.initUndistortRectifyMap(
            old_K, coefficients, rotation, new_K, size, cv2.CV_32FC1
        )
        return UndistortionMaps(columns, rows)


def check_lens(lens: Lens, where: str) -> Lens:
    """Return a lens whose distortion OpenCV can take out, else raise a FormatError."""
    model = lens.model.lower()
    count = len(lens.distortion)
    if model not in (*BROWN_MODELS, *FISHEYE_MODELS):
        if lens.is_straight:
            return lens
        known = "plumb_bob, rational_polynomial or equidistant"
        raise FormatError(
            f"{where}: distortion model '{lens.model[:40]}': expected {known}. "
            "Rectify the images first."
        )
    allowed = (0, 4) if lens.is_fisheye else (0, 4, 5, 8, 12, 14)
    if count not in allowed or not np.isfinite(lens.distortion).all():
        expected = f"{', '.join(map(str, allowed))} finite numbers"
        raise FormatError(f"{where}: distortion: expected {expected}, got {count}.")
    return lens


class StreamSequence(Sequence):
    """Frames that are made when they are used.

    A reader overrides ``_open``, which fills in ``timestamps``, ``poses`` and ``_camera``, and
    ``_images``, which makes one frame.
    """

    def __init__(
        self,
        root: Path,
        camera: str | Path | Camera | None = None,
        depth_scale: float | None = None,
        mask: str | Path | None = None,
        needs_depth: bool = True,
        **chosen: str,
    ) -> None:
        name = root.stem if root.is_file() else root.name
        self._begin(root, name, camera, depth_scale, mask)
        self._needs_depth = needs_depth
        self.chosen = chosen
        self._open()
        if not len(self):
            raise InputError(f"{root}: no frames.")
        self._check_depth_offset()
        check_increasing(self.timestamps, str(root))
        self.mask_files = self._list_masks()
        self._check_first_frame()
        self._clean_texts()

    def frame(self, index: int) -> Frame:
        """Make a frame; an InputError states what is wrong with what it is made of."""
        images = self._images(index)
        where = f"{self.name}: frame {index}"
        if images.rgb is None and images.depth is None:
            raise FormatError(f"{where}: neither image nor depth is there.")
        camera = self.camera(index)
        stamp = float(self.timestamps[index])
        with format_errors(where):
            return Frame(
                images.rgb,
                images.depth,
                camera,
                stamp,
                index,
                depth_variance=images.depth_variance,
                mask=self._mask(index, images.mask),
            )

    def files(self) -> list[Path]:
        """Return the files that are read."""
        inside = sorted(self.root.glob("*")) if self.root.is_dir() else [self.root]
        return [path for path in inside if path.is_file()]

    def _open(self) -> None:
        """Fill in stamps, poses and camera; every reader has its own."""
        raise NotImplementedError

    def _images(self, index: int) -> FrameImages:
        """Make the images of one frame; every reader has its own."""
        raise NotImplementedError

    def _list_masks(self) -> Files:
        if self._mask_folder is None:
            return [None] * len(self)
        files = sorted_files(self._mask_folder, IMAGES)
        hint = "Expected one PNG or JPEG a frame, 0 where pixels must not be used."
        frames = [None] * len(self)
        return match_files(frames, files, self._mask_folder, hint)

    def _mask(self, index: int, own: np.ndarray | None) -> np.ndarray | None:
        path = self.mask_files[index]
        if path is None:
            return own
        given = read_mask_png(path, self.camera(index).shape)
        return given if own is None else given & own

    def _check_first_frame(self) -> None:
        """Refuse a sequence of which no frame can be made, and look at the unit of depth."""
        frame = self._first_frame()
        self.height, self.width = frame.camera.shape
        if frame.depth is None:
            return
        median = typical_depth(frame.depth)
        if median is None:
            self._warn("the first depth map has no valid value")
        elif advice := depth_unit_fix(median, self.depth_scale):
            what = f"a median depth of {median:.4g} cannot be metres"
            self._warn(f"{what}. Perhaps {advice} (by --depth-scale)")

    def _first_frame(self) -> Frame:
        """The first frame that can be made; the error of the very first where none can."""
        first_error: InputError | OSError | None = None
        for index in range(min(len(self), 10)):
            try:
                return self.frame(index)
            except (InputError, OSError) as error:
                first_error = first_error or error
        raise first_error or InputError(f"{self.root}: no frames.")


def units_per_metre(
    scale: float | None, usual: float, warnings: list[str]
) -> float:
    """Return the stored units of depth in one metre; below 1 it is RealSense's metres per unit."""
    if scale is None:
        return usual
    if scale >= 1:
        return scale
    units = float(f"{1 / scale:.6g}")
    warnings.append(
        f"depth_scale {scale:g}: taken as RealSense's, {units:g} units per metre."
    )
    return units


def check_choices(kind: str, given: dict[str, str], known: tuple[str, ...]) -> None:
    """Raise an InputError for a choice that a kind of sequence does not have."""
    for name, value in given.items():
        if name not in known:
            option = "--" + name.replace("_", "-")
            what = f"a sequence of kind '{kind}' has no such choice"
            raise InputError(f"{option} {value[:100]}: {what}.")
