"""The reader of Virtual KITTI 2: a rendered drive with exact depth, flow and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import read_text
from hybridvo.core.geometry import invert
from hybridvo.core.types import Camera
from hybridvo.io.data import image_io, lists
from hybridvo.io.data.camera_file import Calibration
from hybridvo.io.data.sequence import SATURATED, Sequence

CAMERA = "Camera_0"
"""The left one of two cameras."""
INTRINSIC = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"
EXTRINSIC = "frame cameraID r1,1 r1,2 r1,3 t1 ... 0 0 0 1"


class VirtualKittiSequence(Sequence):
    """One variation of a scene, such as ``Scene01/clone``; the left camera is read.

    The archives of images, depth, flow and text may be unpacked into one folder, or each into a
    folder of its name, such as ``vkitti_2.0.3_depth``, beside the others.
    """

    kind = "vkitti2"
    frames_per_second = 10.0
    depth_source = "true"
    depth_scale = 100.0
    flow_is_true = True
    markers = ((f"frames/rgb/{CAMERA}",), (f"frames/depth/{CAMERA}",))

    def files(self) -> list[Path]:
        """Return the images and maps, and the cameras beside them."""
        beside = [self._found(name) for name in ("intrinsic.txt", "extrinsic.txt")]
        inside = [path for path in beside if path.is_file()]
        return sorted({*super().files(), *inside})

    def _list_files(self) -> None:
        self.name = f"{self.root.parent.name}_{self.root.name}"
        rgb = self._part("rgb", r"rgb_(\d+)\.(?:jpg|png)")
        depth = self._part("depth", r"depth_(\d+)\.png")
        flow = self._part("forwardFlow", r"flow_(\d+)\.png")
        numbers = self._list_numbered(rgb, depth, flow)
        path = self._found("extrinsic.txt")
        if not path.is_file():
            return
        poses = np.full((len(numbers), 4, 4), np.nan)
        rows = _table(path, EXTRINSIC, 16)
        for k, number in enumerate(numbers):
            if number in rows:
                stored = rows[number].reshape(4, 4)[:3]
                poses[k] = invert(image_io.as_pose(stored, str(path)))
        self.poses = poses

    def _part(self, name: str, pattern: str) -> dict[int, Path]:
        """The files of a part by frame number."""
        folder = self._found(f"frames/{name}/{CAMERA}")
        return lists.numbered_files(folder, pattern)

    def _found(self, name: str) -> Path:
        """Where a part lies: in the folder, else in that of another archive."""
        own = self.root / name
        if own.exists():
            return own
        variation = "/".join(self.root.parts[-2:])
        others = self.root.parent.parent.parent.glob(f"vkitti*/{variation}/{name}")
        return min(others, default=own)

    def _calibration(self) -> Calibration:
        path = self._found("intrinsic.txt")
        if not path.is_file():
            raise InputError(
                f"{path}: not there: unpack vkitti_2.0.3_textgt.tar.gz, or give the published "
                "one: --camera 725.0087,725.0087,620.5,187."
            )
        rows = _table(path, INTRINSIC, 4)
        if not rows:
            raise FormatError(f"{path}: expected '{INTRINSIC}', got no row.")
        fx, fy, cx, cy = rows[min(rows)].tolist()
        with format_errors(path):
            return Calibration(
                Camera(fx, fy, cx, cy, height=self.height, width=self.width)
            )

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Read flow that is stored as a fraction of the image's size, from -1 to 1."""
        what = "a 16-bit flow PNG of Virtual KITTI 2"
        bgr = image_io.read_png(path, np.uint16, 3, what, self._size)
        fractions = bgr[:, :, [2, 1]].astype(np.float32) * (2 / SATURATED) - 1
        height, width = bgr.shape[:2]
        flow = fractions * np.array([width - 1, height - 1])
        return flow.astype(np.float32), bgr[:, :, 0] > 0


def _table(path: Path, columns: str, count: int) -> dict[int, np.ndarray]:
    """The last ``count`` numbers of the rows of the left camera, by frame number."""
    rows: dict[int, np.ndarray] = {}
    for line, text in enumerate(read_text(path).split("\n"), start=1):
        words = text.split()
        if not words or words[0] == "frame":
            continue
        values = np.array([as_number(word) for word in words])
        if len(values) != 2 + count or not np.isfinite(values).all():
            raise FormatError(
                f"{path}:{line}: expected '{columns}', got {text.strip()[:80]!r}."
            )
        if values[1] == 0:
            rows[int(values[0])] = values[2:]
    return rows
