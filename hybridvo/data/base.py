"""The base class of all readers: lists of files in, checked frames out."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from hybridvo.data.camera_file import IMAGES, Calibration, Lens, parse_camera, units_per_metre
from hybridvo.data.image_io import read_depth, read_flow, read_mask_png, read_rgb
from hybridvo.data.lists import match_files, shown, sorted_files
from hybridvo.errors import FormatError, InputError
from hybridvo.trajectory import check_increasing
from hybridvo.types import Camera, Frame, depth_advice, typical_depth

INNER_FOLDER = re.compile(r"(rgb|depth|flow|image)(_\w+)?")
"""Names of the folders inside a sequence, for which all of it may be meant."""
Files = list[Path | None]
"""A file for each frame, None where it has none."""


class Sequence:
    """Frames in time order, read when asked for: ``len``, ``sequence[i]``, ``for frame in``.

    A reader overrides ``_list_files``, which fills in files and stamps, and ``_calibration``; where
    its files need more than their ending says, ``_read_depth`` and ``_read_flow``.

    Attributes:
        kind: sintel, tartanair, tum, 7scenes, kitti or folder.
        name: what reports call it. root: its folder.
        timestamps: (N,) float64 seconds, strictly increasing.
        poses: (N, 4, 4) T_world_cam in camera axes, NaN rows where unknown, or None.
        depth_source: ``true`` (synthetic, an oracle), ``sensor``, ``stereo`` or ``file``.
        flow_is_true: whether its flow files are ground truth (an oracle).
        warnings: what the user should know: converted stamps, gaps, missing files, doubtful units.
    """

    kind = "sequence"
    markers: tuple[tuple[str, ...], ...] = ()
    """Groups of names (``glob``); a folder with all of one group is of this kind."""
    depth_source = "sensor"
    flow_is_true = False
    depth_scale: float | None = None
    """Stored units per metre of the data set's depth; None: metres."""
    frames_per_second = 30.0
    """Where the files have no stamps."""

    def __init__(
        self,
        root: Path,
        camera: str | os.PathLike[str] | Camera | Calibration | None = None,
        depth_scale: float | None = None,
        mask: str | os.PathLike[str] | None = None,
    ) -> None:
        self.root, self.name = root, root.name
        self.rgb_files: Files = []
        self.depth_files: Files = []
        self.flow_files: Files = []
        self.timestamps = np.zeros(0)
        self.poses: np.ndarray | None = None
        self.warnings: list[str] = []
        self._sources: list[Path | None] = []  # the other files that were read
        self._mask_folder = None if mask is None else Path(mask)
        self._given_camera = camera
        self._given_scale = units_per_metre(depth_scale, self.name, self.warnings)
        self._list_files()
        if not self.rgb_files:
            raise InputError(f"{root}: no frames. Looked for {self.looks_for()}")
        check_increasing(self.timestamps, str(root))
        self.flow_files = (self.flow_files + [None] * len(self))[: len(self)]
        self.mask_files: Files = [None] * len(self)
        if self._mask_folder is not None:
            frames = [a or b for a, b in zip(self.rgb_files, self.depth_files, strict=True)]
            hint = "Expected PNG or JPEG, 0 where pixels must not be used, named like the images."
            masks = sorted_files(self._mask_folder, IMAGES)
            self.mask_files = match_files(frames, masks, self._mask_folder, hint)
        self._camera: Camera | None = None
        self._lens: Lens | None = None
        self._look_at_first_images()
        self._warn_of_missing_files()

    @classmethod
    def root_of(cls, folder: Path) -> Path | None:
        """The sequence that a folder is, or is a part of; None where it is of another kind."""
        inner = INNER_FOLDER.fullmatch(folder.name)
        for place in (folder, folder.parent) if inner else (folder,):
            if any(all(any(place.glob(name)) for name in group) for group in cls.markers):
                return place.absolute()
        return None

    @classmethod
    def looks_for(cls) -> str:
        """What a folder of this kind holds."""
        return f"{cls.kind}: " + ", or ".join(" and ".join(group) for group in cls.markers)

    @property
    def has_flow(self) -> bool:
        """Whether there is at least one flow file."""
        return any(path is not None for path in self.flow_files)

    def check_flow(self, stride: int = 1) -> None:
        """Refuse to take flow files that are not there, or that do not lead over a stride."""
        over = f"flow files lead from one frame to the next, not over a stride of {stride}"
        if not self.has_flow or stride != 1:
            why = over if self.has_flow else "there are no flow files"
            remedy = "compute it: --flow dis, or iter_pairs(sequence, hybridvo.dis_flow())"
            raise InputError(f"{self.name}: {why}; {remedy}.")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        return f"<{self.kind} sequence {self.name!r}: {len(self)} frames>"

    def __getitem__(self, index: int) -> Frame:
        return self.frame(index + len(self) if index < 0 else index)

    def __iter__(self) -> Iterator[Frame]:
        return map(self.frame, range(len(self)))

    def camera(self, index: int) -> Camera:
        """Pinhole camera of frame ``index``."""
        assert self._camera is not None  # else this is overridden
        return self._camera

    def frame(self, index: int) -> Frame:
        """Frame ``index``; ``rgb`` or ``depth`` is None where its file is missing.

        Raises:
            FileNotFoundError: neither is there. FormatError: a file that cannot be decoded or has
                another size.
        """
        index = self._check_index(index)
        camera = self.camera(index)
        files = self.rgb_files[index], self.depth_files[index]
        rgb = self._read(files[0], "an image", read_rgb)
        depth = self._read(files[1], "depth", lambda path: self._read_depth(path, rgb))
        mask = self._read(self.mask_files[index], "a mask", read_mask_png)
        if rgb is None and depth is None:
            there = ", ".join(str(path) for path in files if path is not None)
            raise FileNotFoundError(
                f"{self.name}: frame {index}: neither image nor depth is there ({there})."
            )
        if self._lens is not None:
            rgb, depth, mask = self._lens.straighten(rgb, depth, mask)
        variance = None if depth is None else self._depth_variance(depth)
        return Frame(rgb, depth, camera, float(self.timestamps[index]), index, variance, mask)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Flow from frame ``index`` to the next: (H, W, 2) float32 px, and (H, W) bool or None.

        Raises:
            FileNotFoundError: no flow file for it. FormatError: as :meth:`frame`.
        """
        index = self._check_index(index)
        if index == len(self) - 1:
            raise IndexError(f"{self.name}: frame {index} is the last, no flow starts there.")
        path = self.flow_files[index]
        if path is None:
            raise FileNotFoundError(
                f"{self.name}: there is no flow file from frame {index} to {index + 1}."
            )
        flow, valid = self._read_flow(path, index)
        for array in (flow,) if valid is None else (flow, valid):
            self._check_shape(array, path, "flow")
        return flow, valid

    def files(self) -> list[Path]:
        """Every existing file that the sequence reads, sorted: what a fingerprint covers."""
        frames = (self.rgb_files, self.depth_files, self.flow_files[:-1], self.mask_files)
        found = {path for paths in (self._sources, *frames) for path in paths if path is not None}
        return sorted(path for path in found if path.is_file())

    def _list_files(self) -> None:
        """Fill in files, stamps, poses, name and sources."""
        raise NotImplementedError

    def _calibration(self) -> Calibration | None:
        """Camera of all frames; None where each frame has its own (``camera`` is overridden)."""
        raise NotImplementedError

    def _read_depth(self, path: Path, rgb: np.ndarray | None) -> np.ndarray:
        """(H, W) float32 metres; 0, negative and not finite are invalid."""
        return self._metres(read_depth(path))

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        return read_flow(path)

    def _depth_variance(self, depth: np.ndarray) -> np.ndarray | None:
        """Variance of log depth, where the source allows to state one."""
        return None

    def _metres(self, stored: np.ndarray) -> np.ndarray:
        """Stored depth in metres. Unless a scale is given, only integers are in the set's unit."""
        usual = self.depth_scale if stored.dtype.kind == "u" else None
        return stored.astype(np.float32) / np.float32(self._given_scale or usual or 1.0)

    def _list_numbered(
        self, rgb: dict[int, Path], depth: dict[int, Path], flow: dict[int, Path] | None = None
    ) -> list[int]:
        """Take files by frame number, stamped from 0; the numbers with an image or depth."""
        frames, flow = {*rgb, *depth}, flow or {}
        numbers = sorted(frames)
        self.rgb_files = [rgb.get(n) for n in numbers]
        self.depth_files = [depth.get(n) for n in numbers]
        self.flow_files = [flow.get(n) if n + 1 in frames else None for n in numbers]
        self.timestamps = (np.array(numbers) - min(numbers, default=0)) / self.frames_per_second
        gaps = [(a + 1, b - 1) for a, b in itertools.pairwise(numbers) if b - a > 1]
        if spans := [f"{a}" if a == b else f"{a} to {b}" for a, b in gaps]:
            self.warnings.append(
                f"{self.name}: frame numbers {shown(spans)} are missing; the stamps keep the gap."
            )
        return numbers

    def _read(
        self, path: Path | None, what: str, read: Callable[[Path], np.ndarray]
    ) -> np.ndarray | None:
        """An image of the right size, None where its file is missing."""
        if path is None or not path.exists():
            return None
        array = read(path)
        self._check_shape(array, path, what)
        return array

    def _check_shape(self, array: np.ndarray, path: Path, what: str) -> None:
        if array.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{path}: expected {what} of {self.width}x{self.height} pixels as the first frame "
                f"has, got {array.shape[1]}x{array.shape[0]}."
            )

    def _check_index(self, index: int) -> int:
        if not 0 <= int(index) < len(self):
            raise IndexError(f"{self.name}: expected a frame 0 to {len(self) - 1}, got {index}.")
        return int(index)

    def _first(
        self, files: Files, read: Callable[[Path], np.ndarray]
    ) -> tuple[Path | None, np.ndarray | None, object]:
        """The first file that can be read, and what it holds; else why the first cannot."""
        problem = None
        for path in files:
            try:
                if path is not None:
                    return path, read(path), None
            except (InputError, OSError) as error:
                problem = problem or error
        return None, None, problem

    def _look_at_first_images(self) -> None:
        """Take the size of the images, and the camera; look at the size and the unit of depth."""
        _, image, why = self._first(self.rgb_files, read_rgb)
        # a right image of a stereo pair is no depth: frames check its size
        files = [] if self.depth_source == "stereo" else self.depth_files
        if image is None:
            _, image, other = self._first(files, lambda path: self._read_depth(path, None))
            why = why or other or "no file is listed"
        if image is None:
            raise FormatError(f"{self.root}: no frames: none can be read. First problem: {why}")
        self.height, self.width = size = image.shape[:2]
        self._calibrate()
        path, depth, _ = self._first(files, lambda path: self._read_depth(path, None))
        if depth is None:
            return
        if depth.shape != size:
            raise InputError(
                f"{self.root}: depth images are {depth.shape[1]}x{depth.shape[0]}, colour images "
                f"{size[1]}x{size[0]} pixels: depth must be registered to colour, not resized "
                f"(RealSense: rs.align(rs.stream.color); ROS: aligned_depth_to_color)."
            )
        median = typical_depth(depth)
        if median is None:
            self.warnings.append(f"{path}: the first depth map has no valid value.")
        elif advice := depth_advice(median, self.depth_scale):
            self.warnings.append(
                f"{path}: the median depth is {median:.4g} m, which cannot be metres. Probable "
                f"remedy: {advice} (by --depth-scale, or depth_scale in camera.yaml)."
            )

    def _calibrate(self) -> None:
        """Take the camera that is given, else that of the data set."""
        size = self.height, self.width
        given = self._given_camera
        calibration = self._calibration() if given is None else parse_camera(given, size)
        if calibration is None:
            return
        self._camera = camera = calibration.camera
        if camera.shape != size:
            raise InputError(
                f"{self.root}: images are {self.width}x{self.height}, the camera is for "
                f"{camera.width}x{camera.height} pixels. Give the intrinsics of these images "
                f"(--camera fx,fy,cx,cy or --camera FILE)."
            )
        self.warnings += calibration.warnings
        if any(calibration.distortion):
            self._lens = Lens(camera, calibration.distortion)
        self._given_scale = self._given_scale or calibration.depth_scale

    def _warn_of_missing_files(self) -> None:
        listed = {"image": self.rgb_files, "depth": self.depth_files, "mask": self.mask_files}
        for what, paths in listed.items():
            missing = [i for i, path in enumerate(paths) if path is None or not path.exists()]
            text = f"{len(missing)} frames without {what}: {shown(missing)}"
            if len(missing) == len(paths) and what != "mask":
                like = next((f", such as {path}" for path in paths if path is not None), "")
                text = f"there are no {what} files{like}"
            if missing and (any(paths) or what != "mask"):
                self.warnings.append(f"{self.name}: {text}.")
