"""Cameras that users describe: ``camera.yaml``, ROS ``camera_info``, RealSense, Open3D, numbers."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import (
    MAX_YAML_LENGTH,
    atomic_write,
    make_folder,
    parse_yaml,
    read_text,
)
from hybridvo.core.options import Positive, option_group
from hybridvo.core.types import Camera
from hybridvo.io.data.image_io import read_npy

CAMERA_FILE = "camera.yaml"
CALIBRATION_FILE = "calibration.yaml"
"""The camera beside TUM's lists, which have none. Called camera.yaml, the folder would be read as a
plain one."""
RECORDER_FILES = (
    *(CAMERA_FILE, "camera_intrinsic.json", "intrinsic.json", "intrinsics.json"),
    *("camera_intrinsics.json", "color_intrinsics.json", "camera.json"),
)
"""What recorders call the file of the camera: Open3D's first, then examples of RealSense."""
OPTIONAL_KEYS = ("readout_ms", "depth_lag_ms")
"""Keys of the camera that its file may have."""
CAMERA_KEYS = tuple(
    field.name for field in fields(Camera) if field.name not in OPTIONAL_KEYS
)
"""Keys that a camera file must have."""
KNOWN_KEYS = (*CAMERA_KEYS, *OPTIONAL_KEYS, "distortion", "depth_scale", "fps")
"""Keys that a camera file may have."""
FOREIGN_KEYS = {
    # ROS, a calibration file or a message. The matrix is fx 0 cx 0 fy cy 0 0 1.
    "camera_matrix": "K",
    "K": "K",
    "k": "K",
    "distortion_coefficients": "distortion",
    "D": "distortion",
    "d": "distortion",
    "image_width": "width",
    "image_height": "height",
    # RealSense
    "ppx": "cx",
    "ppy": "cy",
    "coeffs": "distortion",
}
"""Keys in camera files of other programs, and what ``camera.yaml`` calls them."""
FISHEYE_WORDS = ("fish", "equidist", "kannala", "ftheta")
"""Words in the names of distortion models that are not Brown's."""
DISTORTION_LENGTHS = (0, 4, 5, 8)
"""How many coefficients OpenCV's distortion may have here."""


@option_group
class Calibration:
    """A camera with its lens distortion and what else ``camera.yaml`` may state.

    Attributes:
        camera: the camera of the image without distortion.
        distortion: Brown's k1 k2 p1 p2 [k3 [k4 k5 k6]]; empty if the image is rectified.
        depth_scale: stored units per metre of depth.
        fps: frames per second.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    depth_scale: Positive | None = None
    fps: Positive | None = None


def parse_camera(
    camera: str | Path | Camera, shape: tuple[int, int], warnings: list[str]
) -> Calibration:
    """Read the camera that a user gives.

    Args:
        camera: ``fx,fy,cx,cy`` in pixels, a file, or a :class:`Camera`.
        shape: (height, width) of the images to which four numbers or a matrix belong, pixels.
        warnings: Gets a sentence about what the user should know.

    Returns:
        The camera, with its distortion if a file states one.

    Raises:
        InputError: The camera is neither four numbers nor a file that can be read.

    Example:
        >>> parse_camera("500, 500, 319.5, 239.5", (480, 640), []).camera.fx
        500.0
    """
    if isinstance(camera, Camera):
        return Calibration(camera)
    numbers = [as_number(part) for part in str(camera).split(",")]
    if len(numbers) == 4 and np.isfinite(numbers).all():
        fx, fy, cx, cy = numbers
        return Calibration(Camera(fx, fy, cx, cy, height=shape[0], width=shape[1]))
    path = Path(camera)
    try:
        if path.suffix.lower() == ".npy":
            K = read_npy(path, size=(3, 3)).astype(np.float64)
            return Calibration(Camera.from_matrix(K, *shape))
        return read_camera_file(path, warnings)
    except FileNotFoundError:
        got = f"{str(camera)[:200]!r}, which is neither four numbers nor a file"
        raise InputError(
            f"camera: expected 'fx,fy,cx,cy' in pixels, got {got}."
        ) from None


def read_camera_file(path: Path, warnings: list[str]) -> Calibration:
    """Read a YAML or JSON file with the keys of ``camera.yaml``, ROS, RealSense or Open3D.

    Args:
        path: The file.
        warnings: Gets a sentence if the file states a lens distortion that is not ours.

    Raises:
        FormatError: The file has no such content.
    """
    content = _read_content(path)
    is_foreign = any(key in FOREIGN_KEYS for key in content)
    model = str(content.get("distortion_model", content.get("model"))).lower()
    if is_foreign:
        # Files of other programs have keys of their own.
        content = _with_own_keys(path, content)
        content = {key: content[key] for key in KNOWN_KEYS if key in content}
    calibration = _calibration_of(path, content)
    if is_foreign and any(calibration.distortion):
        _check_distortion_model(path, model)
        remedy = "state none if images are rectified"
        warnings.append(f"{path}: lens distortion is taken out; {remedy}.")
    return calibration


def is_unfilled(path: Path) -> bool:
    """Whether a camera file has keys and no values, as the template that ``init`` writes."""
    return not any(value is not None for value in _read_content(path).values())


def _read_content(path: Path) -> dict[Any, Any]:
    """Read the keys and values of a camera file, with Open3D's matrix as ``K``."""
    text = read_text(path, MAX_YAML_LENGTH)
    text = text.removesuffix("---\n")  # the end of a message that ROS prints
    content = parse_yaml(text, str(path))
    if not isinstance(content, dict):
        raise FormatError(
            f"{path}: expected 'key: value' lines, got a {type(content).__name__}."
        )
    # Open3D's file of a camera with its pose
    if isinstance(content.get("intrinsic"), dict):
        content = content["intrinsic"]
    # Open3D writes the matrix column by column.
    columns = content.get("intrinsic_matrix")
    if isinstance(columns, list):
        content["K"] = [value for row in range(3) for value in columns[row::3]]
    return content


def read_opencv_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file of OpenCV, whose first line and tags are no plain YAML."""
    text = read_text(path, MAX_YAML_LENGTH).replace("!!opencv-matrix", "")
    lines = [line for line in text.split("\n") if not line.startswith("%")]
    content = parse_yaml("\n".join(lines), str(path))
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines.")
    return content


def _calibration_of(path: Path, content: dict[Any, Any]) -> Calibration:
    """Make the calibration that the keys and values of a camera file describe."""
    missing = [key for key in CAMERA_KEYS if content.get(key) is None]
    if missing:
        raise FormatError(f"{path}: missing: {', '.join(missing)}; fill them in.")
    given: dict[str, Any] = {}
    for key, value in content.items():
        if value is not None:
            given[str(key)[:40]] = value
    keys = [*CAMERA_KEYS, *(key for key in OPTIONAL_KEYS if key in given)]
    camera = {key: given.pop(key) for key in keys}
    try:
        calibration = Calibration(Camera(**camera), **given)
    except InputError as error:
        raise FormatError(
            f"{path}: {str(error)[:400]} Known are {', '.join(KNOWN_KEYS)}."
        ) from None
    if len(calibration.distortion) not in DISTORTION_LENGTHS:
        expected = "a list of 4, 5 or 8 numbers [k1, k2, p1, p2, k3, ...]"
        raise FormatError(f"{path}: distortion: expected {expected}.")
    return calibration


def _check_distortion_model(path: Path, model: str) -> None:
    """Refuse the distortion of a fisheye lens."""
    if any(word in model for word in FISHEYE_WORDS):
        expected = (
            "Brown's (plumb_bob, rational_polynomial). Rectify the images first"
        )
        raise FormatError(
            f"{path}: distortion model '{model[:40]}': expected {expected}."
        )


def _with_own_keys(path: Path, content: dict[Any, Any]) -> dict[Any, Any]:
    """Return the content of a foreign file with the keys of ``camera.yaml``.

    Keys that ``camera.yaml`` does not have stay as they are.
    """
    renamed = {}
    for key, value in content.items():
        # ROS writes a matrix as {rows, cols, data}.
        plain = value.get("data") if isinstance(value, dict) else value
        renamed[FOREIGN_KEYS.get(key, key)] = plain
    K = renamed.get("K")
    if K is None:
        return renamed
    if not _is_camera_matrix(K):
        order = "row by row (Open3D: column by column): fx 0 cx 0 fy cy 0 0 1"
        raise FormatError(f"{path}: camera matrix: expected 9 numbers, {order}.")
    return renamed | {"fx": K[0], "cx": K[2], "fy": K[4], "cy": K[5]}


def _is_camera_matrix(K: Any) -> bool:
    """Return whether a value is fx 0 cx 0 fy cy 0 0 1, as far as its zeros show."""
    if not isinstance(K, list) or len(K) != 9:
        return False
    return all(as_number(K[i]) == 0 for i in (1, 3, 6, 7))


def write_camera_template(directory: str | Path) -> Path:
    """Write a ``camera.yaml`` for the user to fill in, and return its path.

    Raises:
        InputError: The file exists already.
        OutputError: It cannot be written.
    """
    path = Path(directory) / CAMERA_FILE
    if path.exists():
        raise InputError(f"{path}: exists already; remove it first, or edit it.")
    make_folder(path.parent)
    template = Path(__file__).with_name("camera_template.yaml")
    with atomic_write(path) as file:
        file.write(template.read_text(encoding="utf-8"))
    return path
