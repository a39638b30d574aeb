"""Track a live camera, and print where it is.

python examples/live_camera.py                # a rendered walk plays the camera
python examples/live_camera.py realsense      # or oak, orbbec, opencv:0
python examples/live_camera.py drive.bag      # a recording, at its own rate
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import hybridvo as hvo
from hybridvo.io.cameras.base import LiveCamera
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.live import LiveStep, Patience, stream
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene

SIZE = {"height": 96, "width": 160}


def rendered_camera(frames: int = 10) -> FolderCamera:
    """A camera that shows a rendered room."""
    scene = make_scene("static", 3, frames=frames, **SIZE)
    return FolderCamera(SyntheticSequence(scene))


def follow(
    camera: LiveCamera, patience: Patience | None = None
) -> Iterator[LiveStep]:
    """The steps of a camera, until it ends or the loop is left."""
    tracker = hvo.Odometry()
    # compile before the first frame comes, or frames are dropped meanwhile
    tracker.warm_up()
    yield from stream(camera, tracker, patience=patience)


def main(arguments: list[str]) -> int:
    """Follow a camera and print every pose."""
    camera = choose_camera(arguments[0]) if arguments else rendered_camera()
    poses = 0
    for live in follow(camera):
        poses += 1
        x, y, z = live.step.T_world_cam[:3, 3]
        age_ms = 1e3 * live.age_s
        state = live.step.status
        print(f"x {x:+.3f} y {y:+.3f} z {z:+.3f} m  {state}  age {age_ms:.0f} ms")
    # a frame older than half a second is dropped, which a slow computer does with all
    print(f"{poses} poses")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
