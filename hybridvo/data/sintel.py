"""MPI Sintel: true depth, flow and a camera per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.image_io import read_cam, read_flow, read_mask_png
from hybridvo.data.lists import numbered_files
from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import invert
from hybridvo.types import Camera

IMAGE_PASSES = ("final", "clean", "albedo")
ENDINGS = {
    **dict.fromkeys(IMAGE_PASSES, "(?:png|jpg|jpeg)"),
    **{"flow": "flo", "depth": "dpt", "camdata_left": "cam", "invalid": "png", "occlusions": "png"},
}


class SintelSequence(Sequence):
    """One Sintel scene, such as ``training/clean/alley_1``, or NAME under a sibling of clean.

    Siblings are found from there, also where the zip files were unpacked apart. Images are those of
    the path, else of the final pass, else of the clean one.
    """

    kind = "sintel"
    frames_per_second = 24.0
    depth_source = "true"
    flow_is_true = True
    markers = ((".../{clean,final,flow,depth,camdata_left}/NAME", "frame_0001.*"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Whether a folder, which may be one that was never downloaded, stands for a scene."""
        folder = folder.absolute()
        return folder.parent.name in ENDINGS and any(_files(folder, part) for part in ENDINGS)

    def _list_files(self) -> None:
        own = self.root.parent.name
        passes = (own,) if own in IMAGE_PASSES else IMAGE_PASSES
        rgb = next((found for p in passes if (found := _files(self.root, p))), {})
        parts = ("depth", "flow", "camdata_left", "invalid")
        depth, flow, cameras, invalid = (_files(self.root, part) for part in parts)
        numbers = self._list_numbered(rgb, depth, flow)
        if not cameras:
            where = self.root.parent.parent / "camdata_left" / self.name
            raise InputError(f"{where}: no frame_*.cam; they come with Sintel's training depth.")
        self._cameras = [cameras.get(n) for n in numbers]
        self._invalid = [invalid.get(n) for n in numbers]
        self._each_pose(self._cameras, lambda path: invert(read_cam(path)[1]))

    def _calibration(self) -> None:
        return None

    def camera(self, index: int) -> Camera:
        """Camera of this very frame (Sintel zooms); FileNotFoundError where it has none."""
        if self._camera is not None:
            return self._camera
        path = self._cameras[index]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no .cam file.")
        try:
            return Camera.from_matrix(read_cam(path)[0], self.height, self.width)
        except InputError as error:
            raise FormatError(f"{path}: {error}") from None

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        flow, valid = read_flow(path)
        mask = self._invalid[index]
        if mask is None or not mask.exists():
            return flow, valid
        known = ~read_mask_png(mask)
        return flow, known if valid is None else valid & known


def _files(scene: Path, part: str) -> dict[int, Path]:
    """Files of a part of a scene by number; the zips may be unpacked apart."""
    base, name = scene.parent.parent, scene.name
    folder = base / part / name
    if not folder.is_dir() and base.name == "training":
        # MPI-Sintel-complete/training beside MPI-Sintel-depth-training/training
        apart = sorted(base.parent.parent.glob(f"*/training/{part}/{name}"))
        folder = apart[0] if apart else folder
    return numbered_files(folder, rf"frame_(\d+)\.{ENDINGS[part]}")
