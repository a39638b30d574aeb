"""Cameras that users describe: ``camera.yaml``, ROS ``camera_info``, RealSense, Open3D, numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.checks import as_number
from hybridvo.data.image_io import read_npy
from hybridvo.errors import FormatError, InputError
from hybridvo.files import (
    LARGEST_YAML,
    atomic_write,
    make_folder,
    parse_yaml,
    read_text,
)
from hybridvo.options import Positive, option_group
from hybridvo.types import Camera

CAMERA_FILE = "camera.yaml"
FOREIGN_KEYS = {
    # ROS: a calibration file, or a message; K holds fx 0 cx 0 fy cy 0 0 1
    **dict.fromkeys(("camera_matrix", "K", "k"), "K"),
    **dict.fromkeys(("distortion_coefficients", "D", "d"), "distortion"),
    **{"image_width": "width", "image_height": "height"},
    # RealSense
    **{"ppx": "cx", "ppy": "cy", "coeffs": "distortion"},
}
"""Keys in the files of others, and what they are called here."""


@option_group
class Calibration:
    """A camera with its lens distortion and what else ``camera.yaml`` may say."""

    camera: Camera  # of the image without distortion
    # Brown's k1 k2 p1 p2 [k3 [k4 k5 k6]]; none if rectified
    distortion: tuple[float, ...] = ()
    depth_scale: Positive | None = None  # stored units per metre of depth
    fps: Positive | None = None


def parse_camera(
    camera: str | Path | Camera, shape: tuple[int, int], warnings: list[str]
) -> Calibration:
    """Read the camera that a user gives: ``fx,fy,cx,cy`` in pixels, a file, or a :class:`Camera`.

    ``shape`` is the (height, width) of the images to which four numbers or a matrix belong.
    """
    if isinstance(camera, Camera):
        return Calibration(camera)
    numbers = [as_number(part) for part in str(camera).split(",")]
    if len(numbers) == 4 and np.isfinite(numbers).all():
        fx, fy, cx, cy = numbers
        return Calibration(Camera(fx, fy, cx, cy, *shape))
    try:
        if Path(camera).suffix.lower() == ".npy":
            K = read_npy(camera, size=(3, 3))
            return Calibration(Camera.from_matrix(K.astype(np.float64), *shape))
        return read_camera_file(Path(camera), warnings)
    except FileNotFoundError:
        got = f"{str(camera)[:200]!r}, which is neither four numbers nor a file"
        raise InputError(
            f"camera: expected 'fx,fy,cx,cy' in pixels, got {got}."
        ) from None


def read_camera_file(path: Path, warnings: list[str]) -> Calibration:
    """Read a YAML or JSON file with the keys of ``camera.yaml``, ROS, RealSense or Open3D."""
    text = read_text(path, LARGEST_YAML).removesuffix("---\n")  # as ROS ends it
    content = parse_yaml(text, str(path))
    if not isinstance(content, dict):
        raise FormatError(
            f"{path}: expected 'key: value' lines, got a {type(content).__name__}."
        )
    if isinstance(content.get("intrinsic"), dict):  # Open3D's camera with its pose
        content = content["intrinsic"]
    # Open3D: column by column
    if isinstance(columns := content.get("intrinsic_matrix"), list):
        content["K"] = [value for row in range(3) for value in columns[row::3]]
    needed = list(Camera.__annotations__)
    known = [*needed, "distortion", "depth_scale", "fps"]
    is_foreign = any(key in FOREIGN_KEYS for key in content)
    model = str(content.get("distortion_model", content.get("model"))).lower()
    if is_foreign:
        content = _plain_keys(path, content)
        content = {key: value for key, value in content.items() if key in known}
    if missing := [key for key in needed if content.get(key) is None]:
        raise FormatError(f"{path}: missing: {', '.join(missing)}.")
    given: dict[str, Any] = {
        str(k)[:40]: v for k, v in content.items() if v is not None
    }
    try:
        found = Calibration(
            Camera(**{key: given.pop(key) for key in needed}), **given
        )
    except InputError as error:
        raise FormatError(
            f"{path}: {str(error)[:400]} Known are {', '.join(known)}."
        ) from None
    if len(found.distortion) not in (0, 4, 5, 8):
        expected = "a list of 4, 5 or 8 numbers [k1, k2, p1, p2, k3, ...]"
        raise FormatError(f"{path}: distortion: expected {expected}.")
    if is_foreign and any(found.distortion):
        if any(word in model for word in ("fish", "equidist", "kannala", "ftheta")):
            expected = (
                "Brown's (plumb_bob, rational_polynomial). Rectify the images first"
            )
            raise FormatError(
                f"{path}: distortion model '{model[:40]}': expected {expected}."
            )
        remedy = "state none if images are rectified"
        warnings.append(f"{path}: lens distortion is taken out; {remedy}.")
    return found


def _plain_keys(path: Path, content: dict[Any, Any]) -> dict[Any, Any]:
    """The content of a foreign file by the keys of ``camera.yaml``, and what we do not know."""
    # ROS writes a matrix as {rows, cols, data}
    plain = {
        k: v.get("data") if isinstance(v, dict) else v for k, v in content.items()
    }
    content = {FOREIGN_KEYS.get(key, key): value for key, value in plain.items()}
    K = content.get("K")
    if K is None:
        return content
    if (
        not isinstance(K, list)
        or len(K) != 9
        or any(as_number(K[i]) for i in (1, 3, 6, 7))
    ):
        order = "row by row (Open3D: column by column): fx 0 cx 0 fy cy 0 0 1"
        raise FormatError(f"{path}: camera matrix: expected 9 numbers, {order}.")
    return content | {"fx": K[0], "cx": K[2], "fy": K[4], "cy": K[5]}


def write_camera_template(directory: str | Path) -> Path:
    """Write a ``camera.yaml`` for the user to fill in, and return its path."""
    path = Path(directory) / CAMERA_FILE
    if path.exists():
        raise InputError(f"{path}: exists already; remove it first, or edit it.")
    make_folder(path.parent)
    with atomic_write(path) as file:
        file.write(
            Path(__file__)
            .with_name("camera_template.yaml")
            .read_text(encoding="utf-8")
        )
    return path
