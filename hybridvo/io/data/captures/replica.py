"""The reader of Replica as NICE-SLAM renders it, and of what is written like it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import MAX_YAML_LENGTH, parse_yaml, read_rows, read_text
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import Calibration
from hybridvo.io.data.image_io import as_pose
from hybridvo.io.data.sequence import Sequence

CAMERA = "cam_params.json"
"""The file of the camera, in the folder of the scene or beside it."""
KEYS = ("fx", "fy", "cx", "cy", "h", "w", "scale")
"""What it states: pixels, and units of depth per metre."""


class ReplicaSequence(Sequence):
    """A scene such as ``Replica/room0``: ``results/frame000000.jpg``, ``depth000000.png``.

    ``traj.txt`` has a matrix, camera to world, in each row.
    """

    kind = "replica"
    depth_source = "true"
    markers = (("results/frame*", "results/depth*"),)

    def files(self) -> list[Path]:
        """Return images and maps, the poses and the camera."""
        return sorted({*super().files(), *(p for p in [self._file()] if p)})

    def _list_files(self) -> None:
        results = self.root / "results"
        rgb = lists.numbered_files(results, r"frame(\d+)\.(?:jpg|png)")
        depth = lists.numbered_files(results, r"depth(\d+)\.png")
        numbers = self._list_numbered(rgb, depth)
        self._stated = self._read_camera()
        if self._stated is not None and self._given_scale is None:
            self._given_scale = self._stated["scale"]
        path = self.root / "traj.txt"
        if path.is_file():
            stored = _read_poses(path)
            self.poses = lists.numbered_poses(numbers, stored)

    def _file(self) -> Path | None:
        """The file of the camera."""
        places = [self.root / CAMERA, self.root.parent / CAMERA]
        return next((path for path in places if path.is_file()), None)

    def _read_camera(self) -> dict[str, float] | None:
        """What the file of the camera states; None without one."""
        path = self._file()
        if path is None:
            return None
        content = parse_yaml(read_text(path, MAX_YAML_LENGTH), str(path))
        inside = content.get("camera") if isinstance(content, dict) else None
        values = inside if isinstance(inside, dict) else {}
        numbers = {key: as_number(values.get(key)) for key in KEYS}
        if not all(np.isfinite(number) for number in numbers.values()):
            raise FormatError(
                f"{path}: expected 'camera' with the numbers {', '.join(KEYS)}."
            )
        return numbers

    def _calibration(self) -> Calibration:
        stated = self._stated
        if stated is None:
            raise InputError(
                f"{self.root}: no {CAMERA}, which Replica has beside its scenes: copy it into "
                "the folder, or give --camera fx,fy,cx,cy and --depth-scale 6553.5."
            )
        height = int(stated["h"])
        width = int(stated["w"])
        focal_lengths = stated["fx"], stated["fy"]
        centre = stated["cx"], stated["cy"]
        with format_errors(self._file()):
            return Calibration(
                Camera(*focal_lengths, *centre, height=height, width=width)
            )


def _read_poses(path: Path) -> np.ndarray:
    """Read T_world_cam (N, 4, 4), of rows of 16 numbers."""
    names = " ".join(f"m{row}{column}" for row in range(4) for column in range(4))
    rows = read_rows(path, names).numbers
    poses = [
        as_pose(row.reshape(4, 4)[:3], f"{path}: pose {k}")
        for k, row in enumerate(rows)
    ]
    return np.array(poses).reshape(-1, 4, 4)
