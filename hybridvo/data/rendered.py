"""Rendered data sets, whose depth and flow are exact: MPI Sintel and TartanAir."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data import image_io
from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.lists import numbered_files, numbered_poses
from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import invert, ned_to_camera
from hybridvo.trajectory import COLUMNS, read_poses
from hybridvo.types import Camera

IMAGE_PASSES = ("final", "clean", "albedo")
ENDINGS = {
    **dict.fromkeys(IMAGE_PASSES, "(?:png|jpg|jpeg)"),
    **{"flow": "flo", "depth": "dpt", "camdata_left": "cam", "invalid": "png", "occlusions": "png"},
}


class SintelSequence(Sequence):
    """One Sintel scene, such as ``training/clean/alley_1``, or ``alley_1`` beside ``clean``.

    Images are those of the path, else of the final pass, else of the clean one.
    """

    kind = "sintel"
    frames_per_second = 24.0
    depth_source = "true"
    flow_is_true = True
    markers = ((".../{clean,final,flow,depth,camdata_left}/NAME", "frame_0001.*"),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder, which itself need not be there, stands for a scene."""
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
        self._read_poses(self._cameras, lambda path: invert(image_io.read_cam(path)[1]))

    def camera(self, index: int) -> Camera:
        """Return the camera of a frame, for Sintel zooms; FileNotFoundError where it has none."""
        if self._camera is not None:
            return self._camera
        path = self._cameras[index]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no .cam file.")
        try:
            return Camera.from_matrix(image_io.read_cam(path)[0], self.height, self.width)
        except InputError as error:
            raise FormatError(f"{path}: {error}") from None

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        flow, valid = image_io.read_flow(path)
        if mask := self._invalid[index]:
            known = ~image_io.read_mask_png(mask)
            valid = known if valid is None else valid & known
        return flow, valid


def _files(scene: Path, part: str) -> dict[int, Path]:
    """Files of a part of a scene by number; the zips may have been unpacked apart."""
    base, name = scene.parent.parent, scene.name
    folder = base / part / name
    if not folder.is_dir() and base.name == "training":
        # MPI-Sintel-complete/training beside MPI-Sintel-depth-training/training
        apart = sorted(base.parent.parent.glob(f"*/training/{part}/{name}"))
        folder = apart[0] if apart else folder
    return numbered_files(folder, rf"frame_(\d+)\.{ENDINGS[part]}")


class TartanAirSequence(Sequence):
    """One TartanAir trajectory, such as ``P000``; its flow is that of the camera alone."""

    kind = "tartanair"
    frames_per_second = 10.0
    depth_source = "true"
    flow_is_true = True
    markers = (
        *(("image_left",), ("depth_left",)),  # V1
        *(("image_lcam_front",), ("depth_lcam_front",)),  # V2
    )

    def _list_files(self) -> None:
        root = self.root
        is_v2 = any((root / f"{what}_lcam_front").is_dir() for what in ("image", "depth"))
        camera, flow_folder = ("lcam_front", "flow_lcam_front") if is_v2 else ("left", "flow")
        if root.parent.name in ("Easy", "Hard"):
            self.name = "_".join(root.parts[-3:])
        numbers = self._list_numbered(
            numbered_files(root / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)"),
            numbered_files(root / f"depth_{camera}", rf"(\d+)_{camera}_depth\.(?:npy|png)"),
            numbered_files(root / flow_folder, r"(\d+)_\d+_flow\.(?:npy|png)"),
        )
        pose_file = root / f"pose_{camera}.txt"
        if pose_file.exists():
            poses = ned_to_camera(read_poses(pose_file, COLUMNS["tartanair"])[1])
            self.poses = numbered_poses(numbers, poses)

    def _calibration(self) -> Calibration:
        # a field of view of 90 degrees over the width; TartanAir publishes a centre of 320 px at a
        # width of 640, where pixel (0, 0) is a corner: here it is the centre of the first pixel
        height, width = self.height, self.width
        centre = (width - 1) / 2, (height - 1) / 2
        return Calibration(Camera(width / 2, width / 2, *centre, height, width))

    def _read_depth(self, path: Path) -> np.ndarray:
        if path.suffix != ".png":
            return super()._read_depth(path)
        # the four bytes of a little-endian float
        image = image_io.read_png(path, np.uint8, 4, "a float32 depth PNG of TartanAir V2")
        return np.ascontiguousarray(image).view("<f4")[:, :, 0].astype(np.float32)

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        if path.suffix == ".png":  # u, v, mask in OpenCV's order, not in KITTI's
            flow, occluded = image_io.read_flow_png(path, (0, 1, 2))
            return flow, occluded == 0
        mask = path.with_name(path.name.removesuffix("_flow.npy") + "_mask.npy")  # 0 is valid
        return image_io.read_flow(path)[0], image_io.read_npy(mask) == 0 if mask.exists() else None
