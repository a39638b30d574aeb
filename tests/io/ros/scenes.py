"""A rendered drive as a bag: images, depth, camera, and a robot's fixed frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.lab.synthetic.render import Scene
from hybridvo.lab.synthetic.scenes import make_scene
from tests import bags

FRAMES = 6
SIZE = (120, 160)
BASE, LINK, OPTICAL = "base_link", "camera_link", "color_optical"
OPTICAL_XYZW = (-0.5, 0.5, -0.5, 0.5)
"""How ROS turns body axes into optical ones: roll -90, yaw -90 degrees."""
MOUNT_XYZ = (0.3, 0.05, 0.8)
MOUNT_XYZW = (0.0, np.sin(0.1), 0.0, np.cos(0.1))
"""The camera looks down by 0.2 rad."""
T_BASE_OPTICAL = np.array(
    [
        # the optical z axis is body x, turned down: cos and -sin of 0.2
        [0.0, -np.sin(0.2), np.cos(0.2), 0.3],
        [-1.0, 0.0, 0.0, 0.05],
        [0.0, -np.cos(0.2), -np.sin(0.2), 0.8],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def scene(kind: str = "light") -> Scene:
    height, width = SIZE
    return make_scene(kind, 3, height=height, width=width, frames=FRAMES)


def write(root: Path, kind: str, drawn: Scene) -> Path:
    """Write a bag of ``FRAMES`` frames; its transforms come first."""
    writer = bags.Writer(root, kind)
    fixed = writer.tf(
        writer.transform(BASE, LINK, MOUNT_XYZ, MOUNT_XYZW),
        writer.transform(LINK, OPTICAL, (0, 0, 0), OPTICAL_XYZW),
    )
    writer.write("/tf_static", fixed, bags.START - 100_000_000)
    camera = drawn.camera
    k = (camera.fx, camera.fy, camera.cx, camera.cy)
    for i in range(FRAMES):
        time = bags.stamp(i)
        frame = drawn.render(i)
        depth = np.where(np.isfinite(frame.depth), 1000 * frame.depth, 0)
        millimetres = depth.clip(0, 65000).astype(np.uint16)
        info = writer.info(k, SIZE, OPTICAL)
        writer.write(bags.INFO, info, time)
        image = writer.image(frame.rgb, "rgb8", time, OPTICAL)
        writer.write(bags.RGB, image, time + 1)
        image = writer.image(millimetres, "16UC1", time, OPTICAL)
        writer.write(bags.DEPTH, image, time + 2)
    return writer.close()
