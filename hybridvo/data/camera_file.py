"""Cameras that users describe: ``camera.yaml``, ROS ``camera_info``, RealSense, ``fx,fy,cx,cy``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.errors import FormatError, InputError
from hybridvo.files import atomic_write, make_folder, parse_yaml, read_text
from hybridvo.options import Positive, option_group
from hybridvo.types import Camera, as_number

CAMERA_FILE = "camera.yaml"
ALIASES = {
    # ROS: a calibration file, or a message
    **dict.fromkeys(("camera_matrix", "K", "k"), "K"),
    **dict.fromkeys(("distortion_coefficients", "D", "d"), "distortion"),
    **{"image_width": "width", "image_height": "height"},
    # RealSense
    **{"ppx": "cx", "ppy": "cy", "coeffs": "distortion"},
}
"""What others call it -> what we do; K holds fx 0 cx 0 fy cy 0 0 1."""


@option_group
class Calibration:
    """A camera and what is known beside it: what ``camera.yaml`` may hold."""

    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int
    distortion: tuple[float, ...] = ()  # Brown's k1 k2 p1 p2 [k3 [k4 k5 k6]]; none if rectified
    depth_scale: Positive | None = None  # stored units per metre of depth
    fps: Positive | None = None

    @property
    def camera(self) -> Camera:
        """The pinhole camera, without the distortion."""
        return Camera(self.fx, self.fy, self.cx, self.cy, self.height, self.width)


def parse_camera(
    camera: str | os.PathLike[str] | Camera, shape: tuple[int, int], told: list[str]
) -> Calibration:
    """Calibration that a user gives: ``fx,fy,cx,cy`` for images of a shape, a file, or a camera."""
    if isinstance(camera, Camera):
        return Calibration(**vars(camera))
    numbers = [as_number(part) for part in os.fspath(camera).split(",")]
    if len(numbers) == 4 and np.isfinite(numbers).all():
        fx, fy, cx, cy = numbers
        return Calibration(fx, fy, cx, cy, *shape)
    try:
        return read_camera_file(Path(camera), told)
    except FileNotFoundError:
        got = f"{os.fspath(camera)[:200]!r}, which is neither four numbers nor a file"
        raise InputError(f"camera: expected 'fx,fy,cx,cy' in pixels, got {got}.") from None


def read_camera_file(path: Path, told: list[str]) -> Calibration:
    """Calibration of a YAML or JSON file: our words, or those of ROS or RealSense."""
    content = parse_yaml(read_text(path).removesuffix("---\n"), str(path))  # as ROS ends it
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines, got a {type(content).__name__}.")
    known = list(Calibration.__annotations__)
    is_foreign = any(key in ALIASES for key in content)
    model = str(content.get("distortion_model", content.get("model"))).lower()
    if is_foreign:
        # ROS writes a matrix as {rows, cols, data}; what we do not know is left out
        plain = {k: v.get("data") if isinstance(v, dict) else v for k, v in content.items()}
        content = {ALIASES.get(key, key): value for key, value in plain.items()}
        K = content.get("K")
        if K is not None and not (isinstance(K, list) and len(K) == 9):
            raise FormatError(f"{path}: camera matrix: expected 9 numbers, row by row.")
        content |= {"fx": K[0], "cx": K[2], "fy": K[4], "cy": K[5]} if K else {}
        content = {key: value for key, value in content.items() if key in known}
    if missing := [key for key in known[:6] if content.get(key) is None]:
        raise FormatError(f"{path}: missing: {', '.join(missing)}.")
    given: dict[str, Any] = {str(k)[:40]: v for k, v in content.items() if v is not None}
    try:
        found = Calibration(**given)
        _ = found.camera  # which checks the numbers
    except InputError as error:
        raise FormatError(f"{path}: {str(error)[:400]} Known are {', '.join(known)}.") from None
    if len(found.distortion) not in (0, 4, 5, 8):
        expected = "a list of 4, 5 or 8 numbers [k1, k2, p1, p2, k3, ...]"
        raise FormatError(f"{path}: distortion: expected {expected}.")
    if is_foreign and any(found.distortion):
        if any(word in model for word in ("fish", "equidist", "kannala", "ftheta")):
            expected = "Brown's (plumb_bob, rational_polynomial). Rectify the images first"
            raise FormatError(f"{path}: distortion model '{model[:40]}': expected {expected}.")
        told.append(f"{path}: lens distortion is taken out; state none if images are rectified.")
    return found


def write_camera_template(directory: str | os.PathLike[str]) -> Path:
    """Write a ``camera.yaml`` to fill in."""
    path = Path(directory) / CAMERA_FILE
    if path.exists():
        raise InputError(f"{path}: exists already; remove it first, or edit it.")
    make_folder(path.parent)
    with atomic_write(path) as file:
        file.write(Path(__file__).with_name("camera_template.yaml").read_text(encoding="utf-8"))
    return path
