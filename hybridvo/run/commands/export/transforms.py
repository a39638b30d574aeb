"""``transforms.json`` of nerfstudio and instant-ngp, with a cloud of points beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.files import write_json, write_lines
from hybridvo.run.commands.export.views import ColouredPoints, PosedImage

CLOUD = "points.ply"
TRANSFORMS = "transforms.json"


def write_transforms(
    folder: Path,
    views: list[PosedImage],
    points: ColouredPoints,
    images: str,
    masks: str,
) -> None:
    """Write ``transforms.json`` as nerfstudio and instant-ngp read it, and the point cloud.

    Poses are camera to world, with OpenGL's axes of the camera.

    Args:
        folder: The folder of the data set.
        views: The images.
        points: ColouredPoints in the same world frame.
        images: The folder of the images, below it.
        masks: The folder of their masks, which are called as the images with ``.png`` appended.

    Raises:
        OutputError: A file cannot be written.
    """
    content: dict[str, Any] = {"camera_model": "OPENCV"}
    cameras = {view.camera for view in views}
    if len(cameras) == 1:
        content |= _intrinsics(views[0])
    # cameras that have y upwards and look along -z
    T_opencv_opengl = np.diag([1, -1, -1, 1])
    frames = []
    for view in views:
        frame: dict[str, Any] = {
            "file_path": f"{images}/{view.name}",
            "mask_path": f"{masks}/{view.name}.png",
            "transform_matrix": (view.T_world_cam @ T_opencv_opengl).tolist(),
        }
        if len(cameras) > 1:
            frame |= _intrinsics(view)
        frames.append(frame)
    if len(points.xyz):
        _write_cloud(folder / CLOUD, points)
        content["ply_file_path"] = CLOUD
    write_json(folder / TRANSFORMS, content | {"frames": frames})


def _intrinsics(view: PosedImage) -> dict[str, Any]:
    camera = view.camera
    cx, cy = view.centre
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": cx,
        "cy": cy,
        "w": camera.width,
        "h": camera.height,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }


def _write_cloud(path: Path, points: ColouredPoints) -> None:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points.xyz)}"]
    lines += [f"property float {name}" for name in "xyz"]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines.append("end_header")
    rows = zip(points.xyz.tolist(), points.rgb.tolist(), strict=True)
    for (x, y, z), (r, g, b) in rows:
        lines.append(f"{x:.6g} {y:.6g} {z:.6g} {r} {g} {b}")
    write_lines(path, lines)
