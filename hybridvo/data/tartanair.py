"""TartanAir V1 and V2: simulated flights with true depth, camera flow and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.file_sequence import (
    FileSequence,
    gap_notice,
    numbered_files,
    poses_from_rows,
    read_rows,
)
from hybridvo.data.image_io import (
    read_depth_rgba_png,
    read_flow_tartanair_png,
    read_mask_png,
    read_npy,
)
from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import ned_to_camera
from hybridvo.types import Camera

__all__ = ["TartanAirSequence"]

FRAMES_PER_SECOND = 10.0
VERSIONS = {"V1": ("left", "flow"), "V2": ("lcam_front", "flow_lcam_front")}
"""Version -> (camera name in folders and files, folder of the flow)."""


class TartanAirSequence(FileSequence):
    """One TartanAir trajectory, such as ``P000``; the version is seen from the folder names.

    The flow files hold the flow that the camera alone causes. Depth of the sky is about 1e4 m and
    kept. Poses are turned from north-east-down to camera axes here, once. Stamps count 10 frames a
    second: the data has none.

    Args:
        path: trajectory folder, or one of its image, depth or flow folders.
        strict: trailing bytes in a file are errors.
        allow_outside: accepted for symmetry; no list file names paths here.

    Raises:
        InputError: no frames. FormatError: a damaged pose file.
    """

    kind = "tartanair"
    depth_source = "true"
    flow_is_true = True
    looks_for = (
        "tartanair: image_left or depth_left (V1), image_lcam_front or depth_lcam_front (V2)"
    )

    def __init__(self, path: Path, *, strict: bool = False, allow_outside: bool = False) -> None:
        path = Path(path).absolute()
        root = _trajectory_folder(path)
        if root is None:
            raise InputError(f"{path}: expected a folder with {self.looks_for.split(': ')[1]}.")
        self.version = "V2" if _folders(root, "V2") else "V1"
        camera, flow_folder = VERSIONS[self.version]
        rgb = numbered_files(root / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)")
        depth = numbered_files(root / f"depth_{camera}", rf"(\d+)_{camera}_depth\.(?:npy|png)")
        numbers = sorted(set(rgb) | set(depth))
        if not numbers:
            raise InputError(
                f"{root}: no frames matched NUMBER_{camera}.png in image_{camera} or "
                f"NUMBER_{camera}_depth.npy/.png in depth_{camera}."
            )
        flow = [
            _flow_file(root / flow_folder, n) if following == n + 1 else None
            for n, following in zip(numbers, [*numbers[1:], None], strict=True)
        ]
        pose_file = root / f"pose_{camera}.txt"
        masks = [p for p in map(_mask_file, flow) if p is not None]
        name = "_".join(root.parts[-3:]) if root.parent.name in ("Easy", "Hard") else root.name
        poses, notices = _read_poses(pose_file, numbers)
        super().__init__(
            root,
            name,
            rgb=[rgb.get(n) for n in numbers],
            depth=[depth.get(n) for n in numbers],
            flow=flow,
            timestamps=(np.array(numbers) - numbers[0]) / FRAMES_PER_SECOND,
            poses=poses,
            sources=[pose_file, *masks],
            notices=gap_notice(name, numbers) + notices,
            strict=strict,
        )
        # Field of view 90 degrees over the width: 320 px at 640, c = (size - 1) / 2 because our
        # pixel (0, 0) is a centre where TartanAir publishes the corner convention's 320.
        focal = self.width / 2
        self._camera = Camera(
            focal, focal, (self.width - 1) / 2, (self.height - 1) / 2, self.height, self.width
        )
        if self.width != 640:
            self._notices.append(
                f"{name}: images are {self.width} pixels wide, TartanAir ships 640: the focal "
                f"length is scaled to {focal} px, which is right if they were resized as a whole."
            )
        self._notice_depth_units()

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a TartanAir trajectory."""
        return _trajectory_folder(path.absolute()) is not None

    def camera(self, index: int) -> Camera:
        """The one camera of TartanAir, fx = fy = 320 px at 640 pixels of width."""
        self._check_index(index)
        return self._camera

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        if path.suffix == ".npy":
            return _as_float(read_npy(path, strict=self.strict), path, "depth in metres")
        return read_depth_rgba_png(path)

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        if path.suffix == ".png":
            return read_flow_tartanair_png(path)
        array = read_npy(path, channels=2, strict=self.strict)
        flow = _as_float(array, path, "flow in pixels")
        mask = _mask_file(path)
        if mask is None:
            return flow, None
        occluded = read_mask_png(mask) if mask.suffix == ".png" else read_npy(mask) != 0
        self._check_shape(occluded, mask, "a mask")
        return flow, ~occluded


def _as_float(array: np.ndarray, path: Path, what: str) -> np.ndarray:
    if array.dtype != np.float32:
        raise FormatError(f"{path}: expected {what} as floating point, got {array.dtype}.")
    return array


def _folders(root: Path, version: str) -> list[Path]:
    camera, _ = VERSIONS[version]
    candidates = (root / f"image_{camera}", root / f"depth_{camera}")
    return [folder for folder in candidates if folder.is_dir()]


def _trajectory_folder(path: Path) -> Path | None:
    names = {f"{what}_{c}" for c, _ in VERSIONS.values() for what in ("image", "depth", "flow")}
    candidates = (path, path.parent) if path.name in names | {"flow"} else (path,)
    return next((c for c in candidates if _folders(c, "V1") or _folders(c, "V2")), None)


def _flow_file(folder: Path, number: int) -> Path | None:
    for suffix in (".npy", ".png"):
        path = folder / f"{number:06d}_{number + 1:06d}_flow{suffix}"
        if path.exists():
            return path
    return None


def _mask_file(flow: Path | None) -> Path | None:
    """Mask beside a V1 flow file (000000_000001_mask.npy; 0 is valid)."""
    if flow is None or flow.suffix != ".npy":
        return None
    stem = flow.name.removesuffix("_flow.npy")
    paths = (flow.with_name(f"{stem}_mask.npy"), flow.with_name(f"{stem}_mask.png"))
    return next((p for p in paths if p.exists()), None)


def _read_poses(path: Path, numbers: list[int]) -> tuple[np.ndarray | None, list[str]]:
    """Poses in camera axes of the frames with these numbers: line i belongs to frame i."""
    if not path.exists():
        return None, []
    rows = np.array(read_rows(path, "tx ty tz qx qy qz qw"), dtype=np.float64).reshape(-1, 7)
    poses = np.full((len(numbers), 4, 4), np.nan)
    known = np.array(numbers) < len(rows)
    converted = ned_to_camera(poses_from_rows(rows, str(path)))
    if not known.any() and len(rows) == len(numbers):
        return converted, [f"{path}: frames start at {numbers[0]}; pose lines are taken in order."]
    poses[known] = converted[np.array(numbers)[known]]
    notices = []
    if not known.all():
        notices.append(
            f"{path}: {len(rows)} poses, but frame {numbers[-1]} needs line {numbers[-1] + 1}: "
            f"{int((~known).sum())} frames have no truth."
        )
    return poses, notices
