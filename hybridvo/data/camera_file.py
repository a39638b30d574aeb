"""Cameras that users describe: ``camera.yaml``, ROS ``camera_info``, RealSense, ``fx,fy,cx,cy``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.data.image_io import read_rgb
from hybridvo.data.lists import sorted_files
from hybridvo.errors import FormatError, InputError
from hybridvo.files import atomic_write, parse_yaml, read_text
from hybridvo.options import Positive, option_group
from hybridvo.types import Camera, as_number

CAMERA_FILE = "camera.yaml"
IMAGES = (".png", ".jpg", ".jpeg")
ALIASES = {
    # ROS: a calibration file, or a message
    **dict.fromkeys(("camera_matrix", "K", "k"), "K"),
    **dict.fromkeys(("distortion_coefficients", "D", "d"), "distortion"),
    "image_width": "width",
    "image_height": "height",
    # RealSense
    "ppx": "cx",
    "ppy": "cy",
    "coeffs": "distortion",
}
"""What others call it -> what we do; K holds fx 0 cx 0 fy cy 0 0 1."""


@option_group
class CameraFile:
    """What ``camera.yaml`` may hold; ``docs/own-data.md`` explains it."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    depth_scale: Positive | None = None
    fps: Positive | None = None


KNOWN = ("fx", "fy", "cx", "cy", "width", "height", "distortion", "depth_scale", "fps")


@dataclass(frozen=True)
class Calibration:
    """A pinhole camera and what is known beside it.

    ``distortion`` holds Brown's k1 k2 p1 p2 [k3 [k4 k5 k6]], nothing for rectified images;
    ``depth_scale`` the stored units per metre of depth.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    depth_scale: float | None = None
    fps: float | None = None
    warnings: tuple[str, ...] = ()


class Lens:
    """Remaps images with Brown distortion to a pinhole camera with the same intrinsics."""

    def __init__(self, camera: Camera, distortion: tuple[float, ...]) -> None:
        size = (camera.width, camera.height)
        self._u, self._v = cv2.initUndistortRectifyMap(
            camera.K, np.array(distortion), np.eye(3), camera.K, size, cv2.CV_32FC1
        )
        inside = (self._u >= 0) & (self._u <= camera.width - 1)
        # False where the pinhole image sees beyond the distorted one
        self._inside: np.ndarray = inside & (self._v >= 0) & (self._v <= camera.height - 1)

    def straighten(
        self, rgb: np.ndarray | None, depth: np.ndarray | None, mask: np.ndarray | None
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray]:
        """Image (bilinear), depth and mask (nearest: no mixing across edges) of the pinhole."""
        if rgb is not None:
            rgb = cv2.remap(rgb, self._u, self._v, cv2.INTER_LINEAR)
        if depth is not None:
            depth = cv2.remap(depth, self._u, self._v, cv2.INTER_NEAREST)
        if mask is None:
            return rgb, depth, self._inside
        kept = cv2.remap(mask.view(np.uint8), self._u, self._v, cv2.INTER_NEAREST)
        return rgb, depth, self._inside & (kept > 0)


def parse_camera(
    camera: str | os.PathLike[str] | Camera | Calibration, shape: tuple[int, int]
) -> Calibration:
    """Calibration that a user gives: ``fx,fy,cx,cy`` for images of a shape, a file, or a camera."""
    if isinstance(camera, Calibration):
        return camera
    if isinstance(camera, Camera):
        return Calibration(camera)
    numbers = [as_number(part) for part in os.fspath(camera).split(",")]
    if len(numbers) == 4 and np.isfinite(numbers).all():
        fx, fy, cx, cy = numbers
        return Calibration(Camera(fx, fy, cx, cy, *shape))
    try:
        return read_camera_file(Path(camera))
    except FileNotFoundError:
        raise InputError(
            f"camera: expected a file or 'fx,fy,cx,cy' in pixels, got {os.fspath(camera)[:200]!r}, "
            f"which is neither four numbers nor a file."
        ) from None


def read_camera_file(path: Path) -> Calibration:
    """Calibration of a YAML or JSON file like :class:`CameraFile`, or of ROS or RealSense."""
    text = read_text(path).removesuffix("---\n")  # as ROS prints it
    content = parse_yaml(text, str(path))
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines, got a {type(content).__name__}.")
    is_foreign = any(key in ALIASES for key in content)
    model = str(content.get("distortion_model", content.get("model")))[:40]
    if is_foreign:
        content = _in_our_words(content, path)
    if missing := [key for key in KNOWN[:6] if content.get(key) is None]:
        raise FormatError(f"{path}: missing: {', '.join(missing)}.")
    told: list[str] = []
    try:
        found = CameraFile(**{str(k)[:40]: v for k, v in content.items() if v is not None})
        camera = Camera(found.fx, found.fy, found.cx, found.cy, found.height, found.width)
        scale = units_per_metre(found.depth_scale, str(path), told)
    except InputError as error:
        known = ", ".join(KNOWN)
        raise FormatError(f"{path}: {str(error)[:400]} Known are {known}.") from None
    if len(found.distortion) not in (0, 4, 5, 8):
        raise FormatError(
            f"{path}: distortion: expected a list of 4, 5 or 8 numbers [k1, k2, p1, p2, k3, ...]."
        )
    if is_foreign and any(found.distortion):
        if any(word in model.lower() for word in ("fish", "equidist", "kannala", "ftheta")):
            raise FormatError(
                f"{path}: distortion model '{model}': expected Brown's (plumb_bob, "
                f"rational_polynomial). Rectify the images first."
            )
        told.append(f"{path}: lens distortion is taken out; state none if images are rectified.")
    return Calibration(camera, found.distortion, scale, found.fps, tuple(told))


def units_per_metre(scale: float | None, where: str, told: list[str]) -> float | None:
    """Stored units per metre; below 1 it is RealSense's number, metres per unit, with a warning."""
    if scale is None:
        return None
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"{where}: depth_scale: expected units per metre above 0, got {scale}.")
    if scale >= 1:
        return float(scale)
    units = float(f"{1 / scale:.6g}")  # 0.001 as single precision prints it is 1000
    told.append(
        f"{where}: depth_scale {scale:g} is taken as metres per unit (as RealSense gives it): "
        f"{units:g} units per metre."
    )
    return units


def write_camera_template(directory: str | os.PathLike[str]) -> Path:
    """Write a ``camera.yaml`` to fill in, with what the files in rgb/ and depth/ say."""
    folder = Path(directory)
    path = folder / CAMERA_FILE
    if path.exists():
        raise InputError(f"{path}: exists already; remove it first, or edit it.")
    images = sorted_files(folder / "rgb", IMAGES)
    height, width = read_rgb(images[0]).shape[:2] if images else ("", "")
    comment = "# " if sorted_files(folder / "depth", (".npy", ".dpt")) else ""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        template = Path(__file__).with_name("camera_template.yaml").read_text(encoding="utf-8")
        file.write(template.format(width=width, height=height, comment=comment))
    return path


def _in_our_words(content: dict[Any, Any], path: Path) -> dict[Any, Any]:
    """What a file of ROS or RealSense holds, with our keys; the rest is left out."""
    # ROS writes a matrix as {rows, cols, data}
    plain = {k: v.get("data") if isinstance(v, dict) else v for k, v in content.items()}
    renamed = {ALIASES.get(key, key): value for key, value in plain.items()}
    if "K" in renamed:
        K = renamed["K"]
        if not isinstance(K, list) or len(K) != 9:
            raise FormatError(f"{path}: camera matrix: expected 9 numbers, row by row.")
        renamed |= {"fx": K[0], "cx": K[2], "fy": K[4], "cy": K[5]}
    return {key: value for key, value in renamed.items() if key in KNOWN}
