"""Microsoft 7-Scenes: a Kinect in seven rooms, poses from KinectFusion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.file_sequence import FileSequence, check_pose, gap_notice, numbered_files
from hybridvo.data.image_io import read_png16, read_text
from hybridvo.errors import FormatError, InputError
from hybridvo.types import Camera

__all__ = ["SevenScenesSequence"]

DEPTH_PER_METRE = 1000.0
INVALID_DEPTH = 65535
FRAMES_PER_SECOND = 30.0
IMAGE_PATTERN = r"frame-(\d+)\.(?:color|rgb)\.(?:png|jpg|jpeg)"


class SevenScenesSequence(FileSequence):
    """One sequence such as ``chess/seq-01``: ``frame-000000.{color.png,depth.png,pose.txt}``.

    Depth is in millimetres, 0 and 65535 are invalid. K = 585 585 320 240 is the data set's own
    convention for colour and depth. Stamps count 30 frames a second: the data has none.

    Args:
        path: folder with the frames.
        camera: intrinsics to use instead of 585 585 320 240.
        strict: a damaged pose file is an error, not a frame without truth.
        allow_outside: accepted for symmetry; no list file names paths here.

    Raises:
        InputError: no frames, or images of another size than 640x480 without ``camera``.
    """

    kind = "7scenes"
    looks_for = "7scenes: frame-000000.color.png, .depth.png, .pose.txt"

    def __init__(
        self,
        path: Path,
        *,
        camera: Camera | None = None,
        strict: bool = False,
        allow_outside: bool = False,
    ) -> None:
        root = Path(path).absolute()
        rgb = numbered_files(root, IMAGE_PATTERN)
        depth = numbered_files(root, r"frame-(\d+)\.depth\.png")
        pose_files = numbered_files(root, r"frame-(\d+)\.pose\.txt")
        numbers = sorted(set(rgb) | set(depth))
        if not numbers:
            raise InputError(
                f"{root}: no frames matched frame-NUMBER.color.png or frame-NUMBER.depth.png."
            )
        name = f"{root.parent.name}_{root.name}" if root.name.startswith("seq-") else root.name
        poses = np.full((len(numbers), 4, 4), np.nan)
        notices = gap_notice(name, numbers)
        for i, n in enumerate(numbers):
            if n not in pose_files:
                continue
            try:
                poses[i] = _read_pose(pose_files[n])
            except FormatError as error:
                if strict:
                    raise
                notices.append(f"no truth for frame {i}: {error}")
        super().__init__(
            root,
            name,
            rgb=[rgb.get(n) for n in numbers],
            depth=[depth.get(n) for n in numbers],
            timestamps=(np.array(numbers) - numbers[0]) / FRAMES_PER_SECOND,
            poses=poses if pose_files else None,
            sources=[pose_files[n] for n in numbers if n in pose_files],
            notices=notices,
            strict=strict,
        )
        if camera is None and (self.height, self.width) != (480, 640):
            raise InputError(
                f"{root}: images are {self.width}x{self.height}, 7-Scenes ships 640x480. "
                f"Pass camera=Camera(fx, fy, cx, cy, {self.height}, {self.width}); on the command "
                f"line, describe it as a folder with camera.yaml."
            )
        self._camera = camera or Camera(585.0, 585.0, 320.0, 240.0, 480, 640)
        self._notice_depth_units()

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a 7-Scenes sequence."""
        patterns = (IMAGE_PATTERN, r"frame-(\d+)\.depth\.png")
        return any(numbered_files(path, pattern) for pattern in patterns)

    def camera(self, index: int) -> Camera:
        """The one camera of 7-Scenes."""
        self._check_index(index)
        return self._camera

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        units = read_png16(path)
        depth = units.astype(np.float32) / np.float32(DEPTH_PER_METRE)
        depth[units == INVALID_DEPTH] = 0.0
        return depth


def _read_pose(path: Path) -> np.ndarray:
    """(4, 4) T_world_cam; NaN where tracking was lost (the file then holds inf or nan)."""
    words = read_text(path, limit=2**16).split()
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise FormatError(f"{path}: expected 16 numbers of a 4x4 matrix, got text.") from None
    if values.size != 16:
        raise FormatError(f"{path}: expected 16 numbers of a 4x4 matrix, got {values.size}.")
    T = values.reshape(4, 4)
    if not np.isfinite(T).all():
        return np.full((4, 4), np.nan)
    check_pose(T, str(path))
    # The files carry seven digits: bring the rotation back onto the manifold.
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T = T.copy()
    T[:3, :3] = U @ Vt
    T[3] = (0.0, 0.0, 0.0, 1.0)
    return T
