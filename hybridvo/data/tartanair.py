"""TartanAir V1 and V2: simulated flights with true depth, camera flow and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.camera_file import Calibration
from hybridvo.data.image_io import read_flow, read_flow_png, read_npy, read_png
from hybridvo.data.lists import numbered_files, numbered_poses
from hybridvo.geometry import ned_to_camera
from hybridvo.trajectory import COLUMNS, read_poses


class TartanAirSequence(Sequence):
    """One TartanAir trajectory, such as ``P000``; the version is seen from the folder names.

    The flow files hold the flow that the camera alone causes. The data has no stamps.
    """

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
            self.poses = numbered_poses(
                numbers, ned_to_camera(read_poses(pose_file, COLUMNS["tartanair"])[1])
            )

    def _calibration(self) -> Calibration:
        # Field of view 90 degrees over the width: 320 px at 640, c = (size - 1) / 2 because our
        # pixel (0, 0) is a centre where TartanAir publishes the corner convention's 320.
        height, width = self.height, self.width
        return Calibration(width / 2, width / 2, (width - 1) / 2, (height - 1) / 2, height, width)

    def _read_depth(self, path: Path) -> np.ndarray:
        if path.suffix != ".png":
            return super()._read_depth(path)
        # the four bytes of a little-endian float
        image = read_png(path, np.uint8, 4, "a float32 depth PNG of TartanAir V2")
        return np.ascontiguousarray(image).view("<f4")[:, :, 0].astype(np.float32)

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        if path.suffix == ".png":  # u, v, mask in OpenCV's order, not in KITTI's
            flow, occluded = read_flow_png(path, (0, 1, 2))
            return flow, occluded == 0
        mask = _mask_file(path)
        return read_flow(path)[0], read_npy(mask) == 0 if mask.exists() else None


def _mask_file(flow: Path) -> Path:
    """Mask beside a V1 flow file (000000_000001_mask.npy; 0 is valid)."""
    return flow.with_name(flow.name.removesuffix("_flow.npy") + "_mask.npy")
