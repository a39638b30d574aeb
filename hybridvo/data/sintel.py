"""MPI Sintel: true depth, flow and a camera per frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybridvo.data.file_sequence import FileSequence, gap_notice, numbered_files
from hybridvo.data.image_io import read_cam, read_dpt, read_flo, read_mask_png
from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import invert
from hybridvo.types import Camera

__all__ = ["SintelSequence"]

FRAMES_PER_SECOND = 24.0
IMAGE_PASSES = ("final", "clean", "albedo")
FOLDERS = (*IMAGE_PASSES, "flow", "depth", "camdata_left", "occlusions", "invalid")
UNKNOWN_FLOW = 1e9
"""Middlebury's mark: flow beyond this is unknown."""


class SintelSequence(FileSequence):
    """One Sintel scene, such as ``training/clean/alley_1``.

    ``flow`` marks pixels of the ``invalid`` masks. Occluded pixels keep their true flow: ask
    ``occlusion`` for them. Stamps count 24 frames a second from the first frame.

    Args:
        path: ``.../training/FOLDER/NAME`` with FOLDER one of clean, final, albedo, flow, depth,
            camdata_left, occlusions, invalid; the siblings are found from there, also where the
            zip files were unpacked into neighbouring folders.
        images: which render pass to read; the one in ``path`` by default, else final, else clean.
        strict: trailing bytes in a file are errors.
        allow_outside: accepted for symmetry; no list file names paths here.

    Raises:
        InputError: no frames, or no camera data.
    """

    kind = "sintel"
    depth_source = "true"
    flow_is_true = True
    looks_for = "sintel: .../{clean,final,flow,depth,camdata_left}/NAME with frame_0001.*"

    def __init__(
        self,
        path: Path,
        *,
        images: str | None = None,
        strict: bool = False,
        allow_outside: bool = False,
    ) -> None:
        path = Path(path).absolute()
        name, base = path.name, path.parent.parent
        if images is not None and images not in IMAGE_PASSES:
            raise InputError(f"images: expected one of {IMAGE_PASSES}, got {images!r}.")
        found = {folder: _find(base, folder, name) for folder in FOLDERS}
        given = path.parent.name if path.parent.name in IMAGE_PASSES else None
        passes = [images] if images else [given] if given else list(IMAGE_PASSES)
        chosen = next((found[p] for p in passes if p and found[p]), None)
        if images is not None and chosen is None:
            raise InputError(f"{base}: there is no folder {images}/{name}.")
        numbered = {
            folder: numbered_files(found[folder], rf"frame_(\d+)\.{suffix}")
            for folder, suffix in (
                ("flow", "flo"),
                ("depth", "dpt"),
                ("camdata_left", "cam"),
                ("occlusions", "png"),
                ("invalid", "png"),
            )
        }
        rgb = numbered_files(chosen, r"frame_(\d+)\.(?:png|jpg|jpeg)")
        numbers = sorted(set(rgb) | set(numbered["depth"]))
        if not numbers:
            raise InputError(
                f"{path}: no frames matched frame_*.png or frame_*.dpt in {chosen or base} "
                f"and {found['depth'] or base / 'depth' / name}."
            )
        if not numbered["camdata_left"]:
            raise InputError(
                f"{base}: no frames matched frame_*.cam in camdata_left/{name}. The camera data "
                f"comes with Sintel's depth download; it exists for the training scenes only."
            )
        self._cameras = [numbered["camdata_left"].get(n) for n in numbers]
        self._occlusions = [numbered["occlusions"].get(n) for n in numbers]
        self._invalid = [numbered["invalid"].get(n) for n in numbers]
        # frame_0003.flo leads to frame 4: across a gap it is not the flow of this pair
        flow = [
            numbered["flow"].get(n) if following == n + 1 else None
            for n, following in zip(numbers, [*numbers[1:], None], strict=True)
        ]
        masks = [p for p in self._invalid + self._occlusions if p is not None]
        super().__init__(
            _root(path, base),
            name,
            rgb=[rgb.get(n) for n in numbers],
            depth=[numbered["depth"].get(n) for n in numbers],
            flow=flow,
            timestamps=(np.array(numbers) - numbers[0]) / FRAMES_PER_SECOND,
            sources=[p for p in self._cameras if p is not None] + masks,
            notices=gap_notice(name, numbers),
            strict=strict,
        )
        self.poses = self._read_poses()
        self._notice_depth_units()

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
        """Camera of this very frame: Sintel zooms.

        Raises:
            FileNotFoundError: no ``.cam`` file for this frame. FormatError: a damaged one.
        """
        return self._read_camera(self._check_index(index))[0]

    def occlusion(self, index: int) -> np.ndarray:
        """(H, W) bool, True where a pixel of frame ``index`` cannot be seen in the next one.

        Raises:
            FileNotFoundError: no occlusion mask for this frame. FormatError: a damaged one.
        """
        path = self._occlusions[self._check_index(index)]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no occlusion mask.")
        return read_mask_png(path)

    def _read_cam(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        path = self._cameras[index]
        if path is None:
            raise FileNotFoundError(f"{self.name}: frame {index} has no .cam file.")
        return read_cam(path, strict=self.strict)

    def _read_camera(self, index: int) -> tuple[Camera, np.ndarray]:
        """Camera and T_cam_world of a frame."""
        K, T_cam_world = self._read_cam(index)
        try:
            return Camera.from_matrix(K, self.height, self.width), T_cam_world
        except InputError as error:
            raise FormatError(f"{self._cameras[index]}: {error}") from None

    def _read_poses(self) -> np.ndarray:
        """Poses of the frames that have a camera: the others are not scored."""
        poses = np.full((len(self), 4, 4), np.nan)
        for index in range(len(self)):
            try:
                poses[index] = invert(self._read_camera(index)[1])
            except (FormatError, FileNotFoundError) as error:
                self._notices.append(f"no camera for frame {index}: {error}")
        return poses

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        return read_dpt(path, strict=self.strict)

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        flow = read_flo(path, strict=self.strict)
        self._check_shape(flow, path, "flow")
        with np.errstate(invalid="ignore"):
            known = (np.abs(flow) < UNKNOWN_FLOW).all(axis=2)
        mask = self._invalid[index]
        if mask is None or not mask.exists():
            return flow, None if known.all() else known
        invalid = read_mask_png(mask)
        self._check_shape(invalid, mask, "a mask")
        return flow, known & ~invalid


def _find(base: Path, folder: str, name: str) -> Path | None:
    """``base/folder/name``, or the same under a neighbour of ``base`` (zips unpacked apart)."""
    direct = base / folder / name
    if direct.is_dir():
        return direct
    # MPI-Sintel-complete/training beside MPI-Sintel-depth-training/training
    if base.name != "training":
        return None
    return next(iter(sorted(base.parent.parent.glob(f"*/training/{folder}/{name}"))), None)


def _root(path: Path, base: Path) -> Path:
    return path if path.is_dir() else base
