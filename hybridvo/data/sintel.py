"""MPI Sintel: true depth, flow and a camera per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Sequence, numbered_listing
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import read_cam, read_flow, read_mask_png
from hybridvo.data.lists import numbered_files
from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import invert
from hybridvo.types import Camera

IMAGE_PASSES = ("final", "clean", "albedo")
SUFFIXES = {"flow": "flo", "depth": "dpt", "camdata_left": "cam", "invalid": "png"}
FOLDERS = (*IMAGE_PASSES, *SUFFIXES, "occlusions")


class SintelSequence(Sequence):
    """One Sintel scene, such as ``training/clean/alley_1``, or NAME under a sibling of clean.

    Siblings are found from there, also where the zip files were unpacked into neighbouring folders.
    Images are those of the path, else of the final pass, else of the clean one. ``flow`` marks the
    pixels of the ``invalid`` masks; occluded pixels keep their true flow. Stamps count 24 frames a
    second from the first frame.
    """

    kind = "sintel"
    frames_per_second = 24.0
    depth_source = "true"
    flow_is_true = True
    looks_for = "sintel: .../{clean,final,flow,depth,camdata_left}/NAME with frame_0001.*"

    def __init__(self, path: Path, given: Given) -> None:
        path = path.absolute()
        name, base = path.name, path.parent.parent
        given_pass = path.parent.name if path.parent.name in IMAGE_PASSES else None
        passes = (given_pass,) if given_pass else IMAGE_PASSES
        images = next((found for p in passes if (found := _find(base, p, name))), None)
        files = {
            folder: numbered_files(_find(base, folder, name), rf"frame_(\d+)\.{suffix}")
            for folder, suffix in SUFFIXES.items()
        }
        rgb = numbered_files(images, r"frame_(\d+)\.(?:png|jpg|jpeg)")
        numbers, listing = numbered_listing(
            name, rgb, files["depth"], self.frames_per_second, files["flow"]
        )
        if not files["camdata_left"]:
            raise InputError(
                f"{base}: no frames matched frame_*.cam in camdata_left/{name}. The camera data "
                f"comes with Sintel's depth download; it exists for the training scenes only."
            )
        self._cameras = [files["camdata_left"].get(n) for n in numbers]
        self._invalid = [files["invalid"].get(n) for n in numbers]
        sources = (*self._cameras, *self._invalid)
        listing.sources = [p for p in sources if p is not None]
        super().__init__(path if path.is_dir() else base, name, listing, given)
        self.poses = self._read_poses()

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder looks like a Sintel scene."""
        path = path.absolute()
        if path.parent.name not in FOLDERS:
            return False
        siblings = [_find(path.parent.parent, folder, path.name) for folder in FOLDERS]
        pattern = r"frame_(\d+)\.(?:png|jpg|jpeg|flo|dpt|cam)"
        return any(numbered_files(folder, pattern) for folder in siblings)

    def camera(self, index: int) -> Camera:
        """Camera of this very frame (Sintel zooms); FileNotFoundError where it has none."""
        index = self._check_index(index)
        return self._camera or self._read_camera(index)[0]

    def _calibration(self) -> Calibration | None:
        return None

    def _read_camera(self, index: int) -> tuple[Camera, np.ndarray]:
        """Camera and T_cam_world of a frame."""
        path = self._cameras[index]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no .cam file.")
        K, T_cam_world = read_cam(path)
        try:
            return Camera.from_matrix(K, self.height, self.width), T_cam_world
        except InputError as error:
            raise FormatError(f"{path}: {error}") from None

    def _read_poses(self) -> np.ndarray:
        """Poses of the frames that have a camera: the others are not scored."""
        poses = np.full((len(self), 4, 4), np.nan)
        for index in range(len(self)):
            try:
                poses[index] = invert(self._read_camera(index)[1])
            except (FormatError, FileNotFoundError) as error:
                self.warnings.append(f"no camera for frame {index}: {error}")
        return poses

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        flow, valid = read_flow(path)
        mask = self._invalid[index]
        if mask is None or not mask.exists():
            return flow, valid
        invalid = read_mask_png(mask)
        self._check_shape(flow, path, "flow")
        self._check_shape(invalid, mask, "a mask")
        return flow, ~invalid if valid is None else valid & ~invalid


def _find(base: Path, folder: str, name: str) -> Path | None:
    """``base/folder/name``, or the same under a neighbour of ``base`` (zips unpacked apart)."""
    direct = base / folder / name
    if direct.is_dir():
        return direct
    # MPI-Sintel-complete/training beside MPI-Sintel-depth-training/training
    if base.name != "training":
        return None
    return next(iter(sorted(base.parent.parent.glob(f"*/training/{folder}/{name}"))), None)
