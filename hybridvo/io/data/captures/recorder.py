"""The reader of ``color/``, ``depth/`` and intrinsics in JSON: Open3D's recorder, RealSense."""

from __future__ import annotations

from pathlib import Path

from hybridvo.core.errors import InputError
from hybridvo.io.data.camera_file import (
    RECORDER_FILES,
    Calibration,
    is_unfilled,
    read_camera_file,
)
from hybridvo.io.data.folder import FolderSequence

IMAGE_FOLDERS = ("color", "colour")
"""What the folder of the images is called."""
MILLIMETRES = 1000.0
"""Units per metre where the file of the camera states none: Open3D's and RealSense's own."""


class RecorderSequence(FolderSequence):
    """What Open3D's recorders write, and examples of RealSense after ``rs.align``.

    ``color/*.jpg``, ``depth/*.png`` on the same pixels, and the intrinsics as Open3D or RealSense
    writes them.
    """

    kind = "recorder"
    depth_source = "sensor"
    depth_scale = MILLIMETRES
    markers: tuple[tuple[str, ...], ...] = tuple(
        (folder, "depth") for folder in IMAGE_FOLDERS
    )

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder has images in ``color/`` and depth beside them."""
        has_images = any((folder / name).is_dir() for name in IMAGE_FOLDERS)
        is_own = (folder / "rgb").exists()
        return has_images and (folder / "depth").is_dir() and not is_own

    def _list_files(self) -> None:
        there = [name for name in IMAGE_FOLDERS if (self.root / name).is_dir()]
        self.image_folder = (there or IMAGE_FOLDERS)[0]
        super()._list_files()
        if self._given_scale is None and self._needs_depth:
            self._assume(
                f"depth is taken as {MILLIMETRES:g} units per metre; else give --depth-scale"
            )

    def _read_settings(self) -> Calibration | None:
        """Read the file of the camera; None where it is missing, and a camera is given."""
        path = self._camera_path()
        if self._given_camera is not None and (path is None or is_unfilled(path)):
            return None
        if path is None:
            # other programs write the same folders
            raise InputError(
                f"{self.root}: no file of the camera: expected one of {', '.join(RECORDER_FILES)} "
                "(ScanNet: intrinsic/intrinsic_color.txt), or give --camera fx,fy,cx,cy."
            )
        settings = read_camera_file(path, self.warnings)
        if self._given_scale is None:
            self._given_scale = settings.depth_scale
        return settings

    def _camera_path(self) -> Path | None:
        """The file of the camera."""
        paths = [self.root / name for name in RECORDER_FILES]
        return next((path for path in paths if path.is_file()), None)
