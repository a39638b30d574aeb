"""A model of COLMAP as text: ``cameras.txt``, ``images.txt``, ``points3D.txt``."""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from hybridvo.core.files import make_folder, write_lines
from hybridvo.core.geometry import invert
from hybridvo.core.types import Camera
from hybridvo.run.commands.export.views import ColouredPoints, PosedImage

MODEL = ("cameras.txt", "images.txt", "points3D.txt")


def write_colmap(
    folder: Path, views: list[PosedImage], points: ColouredPoints
) -> None:
    """Write a model: poses are world to camera, quaternions have w first, axes are OpenCV's.

    Args:
        folder: The folder of the model, such as ``sparse/0``.
        views: The images, which are numbered from 1.
        points: ColouredPoints, which no image refers to.

    Raises:
        OutputError: A file cannot be written.
    """
    make_folder(folder)
    cameras = {view.camera: 0 for view in views}
    for number, camera in enumerate(cameras, start=1):
        cameras[camera] = number
    write_lines(folder / MODEL[0], _camera_lines(views, cameras))
    write_lines(folder / MODEL[1], _image_lines(views, cameras))
    write_lines(folder / MODEL[2], _point_lines(points))


def _camera_lines(views: list[PosedImage], cameras: dict[Camera, int]) -> list[str]:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[fx fy cx cy]"]
    centres = {view.camera: view.centre for view in views}
    for camera, number in cameras.items():
        cx, cy = centres[camera]
        values = f"{camera.fx!r} {camera.fy!r} {cx!r} {cy!r}"
        lines.append(f"{number} PINHOLE {camera.width} {camera.height} {values}")
    return lines


def _image_lines(views: list[PosedImage], cameras: dict[Camera, int]) -> list[str]:
    lines = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for number, view in enumerate(views, start=1):
        T_cam_world = invert(view.T_world_cam)
        rotation = Rotation.from_matrix(T_cam_world[:3, :3])
        wxyz = rotation.as_quat(canonical=True, scalar_first=True)
        values = [*wxyz.tolist(), *T_cam_world[:3, 3].tolist()]
        pose = " ".join(repr(value) for value in values)
        lines.append(f"{number} {pose} {cameras[view.camera]} {view.name}")
        # the line of its points, which are none
        lines.append("")
    return lines


def _point_lines(points: ColouredPoints) -> list[str]:
    lines = [
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    ]
    rows = zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)
    for number, ((x, y, z), (r, g, b)) in enumerate(rows, start=1):
        lines.append(f"{number} {x:.6g} {y:.6g} {z:.6g} {r} {g} {b} 0")
    return lines
