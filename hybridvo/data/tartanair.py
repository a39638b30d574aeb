"""TartanAir V1 and V2: simulated flights with true depth, camera flow and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Sequence, numbered_listing
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import (
    read_depth_rgba_png,
    read_flow,
    read_flow_tartanair_png,
    read_mask_png,
    read_npy,
)
from hybridvo.data.lists import numbered_files, numbered_poses
from hybridvo.errors import InputError
from hybridvo.geometry import ned_to_camera
from hybridvo.trajectory import COLUMNS, read_poses
from hybridvo.types import Camera

VERSIONS = {"V1": ("left", "flow"), "V2": ("lcam_front", "flow_lcam_front")}
"""Version -> (camera name in folders and files, folder of the flow)."""


class TartanAirSequence(Sequence):
    """One TartanAir trajectory, such as ``P000``; the version is seen from the folder names.

    The flow files hold the flow that the camera alone causes. Depth of the sky is about 1e4 m and
    kept. Poses are turned from north-east-down to camera axes here, once. Stamps count 10 frames a
    second: the data has none.
    """

    kind = "tartanair"
    frames_per_second = 10.0
    depth_source = "true"
    flow_is_true = True
    looks_for = (
        "tartanair: image_left or depth_left (V1), image_lcam_front or depth_lcam_front (V2)"
    )

    def __init__(self, path: Path, given: Given) -> None:
        path = path.absolute()
        root = _trajectory_folder(path)
        if root is None:
            raise InputError(f"{path}: expected a folder with {self.looks_for.split(': ')[1]}.")
        self.version = "V2" if _has_frames(root, "V2") else "V1"
        camera, flow_folder = VERSIONS[self.version]
        rgb = numbered_files(root / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)")
        depth = numbered_files(root / f"depth_{camera}", rf"(\d+)_{camera}_depth\.(?:npy|png)")
        flow = numbered_files(root / flow_folder, r"(\d+)_\d+_flow\.(?:npy|png)")
        pose_file = root / f"pose_{camera}.txt"
        name = "_".join(root.parts[-3:]) if root.parent.name in ("Easy", "Hard") else root.name
        numbers, listing = numbered_listing(name, rgb, depth, self.frames_per_second, flow)
        if pose_file.exists() and numbers:
            poses = ned_to_camera(read_poses(pose_file, COLUMNS["tartanair"])[1])
            listing.poses = numbered_poses(numbers, poses, pose_file, listing.warnings)
        masks = [_mask_file(path) for path in flow.values()]
        listing.sources = [pose_file, *(path for path in masks if path is not None)]
        super().__init__(root, name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a TartanAir trajectory."""
        return _trajectory_folder(path.absolute()) is not None

    def _calibration(self) -> Calibration:
        # Field of view 90 degrees over the width: 320 px at 640, c = (size - 1) / 2 because our
        # pixel (0, 0) is a centre where TartanAir publishes the corner convention's 320.
        height, width = self.height, self.width
        camera = Camera(width / 2, width / 2, (width - 1) / 2, (height - 1) / 2, height, width)
        told = f"{self.name}: images are {width} pixels wide, TartanAir's 640: focal length scaled."
        return Calibration(camera, warnings=() if width == 640 else (told,))

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        if path.suffix == ".png":
            return read_depth_rgba_png(path)
        return super()._read_depth(path, index, rgb)

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        if path.suffix == ".png":
            return read_flow_tartanair_png(path)
        mask = _mask_file(path)
        if mask is None:
            return read_flow(path)
        occluded = read_mask_png(mask) if mask.suffix == ".png" else read_npy(mask) != 0
        self._check_shape(occluded, mask, "a mask")
        return read_flow(path)[0], ~occluded


def _has_frames(root: Path, version: str) -> bool:
    camera, _ = VERSIONS[version]
    return (root / f"image_{camera}").is_dir() or (root / f"depth_{camera}").is_dir()


def _trajectory_folder(path: Path) -> Path | None:
    names = {f"{what}_{c}" for c, _ in VERSIONS.values() for what in ("image", "depth", "flow")}
    candidates = (path, path.parent) if path.name in names | {"flow"} else (path,)
    return next((c for c in candidates if any(_has_frames(c, v) for v in VERSIONS)), None)


def _mask_file(flow: Path) -> Path | None:
    """Mask beside a V1 flow file (000000_000001_mask.npy; 0 is valid)."""
    stem = flow.name.removesuffix("_flow.npy")
    paths = (flow.with_name(f"{stem}_mask.npy"), flow.with_name(f"{stem}_mask.png"))
    return next((p for p in paths if p.exists()), None)
