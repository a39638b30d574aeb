"""The base class of all readers: lists of files in, checked frames out."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.data.camera_file import Calibration, parse_camera
from hybridvo.data.image_io import (
    image_size,
    read_depth,
    read_flow,
    read_header,
    read_mask_png,
    read_rgb,
)
from hybridvo.data.lists import IMAGES, match_files, shown, sorted_files
from hybridvo.depth_units import depth_unit_fix, typical_depth
from hybridvo.errors import FormatError, InputError, printable
from hybridvo.trajectory import check_increasing
from hybridvo.types import Camera, Frame

# the largest number of 16 bits, by which files mark pixels without depth
SATURATED = 65535
Files = list[Path | None]  # a file for each frame, None where it has none
Image = np.ndarray | None


class Sequence:
    """Frames in the order of time, read when asked for: ``len``, ``sequence[i]``, iteration.

    A reader overrides ``_list_files`` (files, stamps, poses), ``_calibration``, and how it reads.
    """

    kind = "sequence"  # the reader's name in READERS
    # a folder belongs to the reader if it has all names (with wildcards) of one of the groups
    markers: tuple[tuple[str, ...], ...] = ()
    depth_source = "sensor"  # or stereo, file, true (of a renderer: an oracle)
    flow_is_true = False  # whether the flow files are ground truth: an oracle
    # stored units per metre, of depth in whole numbers
    depth_scale: float | None = None
    frames_per_second = 30.0  # where the files have no stamps
    # sentences about what the answer rests on although no file says so; also in ``warnings``
    assumed: tuple[str, ...] = ()

    def __init__(
        self,
        root: Path,
        camera: str | Path | Camera | None = None,
        depth_scale: float | None = None,
        mask: str | Path | None = None,
    ) -> None:
        self.root = root
        self.name = root.name
        self.rgb_files: Files = []
        self.depth_files: Files = []
        self.flow_files: Files = []
        self.timestamps = np.zeros(0)  # (N,) seconds, strictly increasing
        # (N, 4, 4) T_world_cam, NaN where unknown
        self.poses: np.ndarray | None = None
        self.warnings: list[str] = []  # sentences about what the user should know
        self._mask_folder = None if mask is None else Path(mask)
        self._given_camera = camera
        self._given_scale = depth_scale
        # of all images, once the first is known
        self._size: tuple[int, int] | None = None
        self._list_files()
        if not self.rgb_files:
            names = ", or ".join(" and ".join(group) for group in self.markers)
            raise InputError(f"{root}: no frames. Looked for {self.kind}: {names}.")
        self._check_there()
        check_increasing(self.timestamps, str(root))
        self.mask_files: Files = [None] * len(self)
        if folder := self._mask_folder:
            frames = [
                a or b
                for a, b in zip(self.rgb_files, self.depth_files, strict=True)
            ]
            hint = "Expected PNG or JPEG, 0 where pixels must not be used, named like the images."
            self.mask_files = match_files(
                frames, sorted_files(folder, IMAGES), folder, hint
            )
        self._take_camera()
        self._check_depth()
        self._warn_of_what_is_missing()
        self._warn_of_links()
        # the names of folders and files are made by others
        self.name = printable(self.name)
        self.warnings = [printable(text) for text in self.warnings]

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder is a sequence of this kind."""
        return any(
            all(any(folder.glob(name)) for name in group) for group in cls.markers
        )

    @property
    def has_flow(self) -> bool:
        """Whether there is at least one flow file."""
        return any(path is not None for path in self.flow_files)

    def check_flow(self, stride: int = 1) -> None:
        """Raise an InputError where there are no flow files, or none that leads over a stride."""
        if not self.has_flow or stride != 1:
            why = f"flow files do not lead over a stride of {stride}"
            why = why if self.has_flow else "there are no flow files"
            remedy = "--flow dis, or iter_pairs(sequence, hybridvo.dis_flow())"
            raise InputError(f"{self.name}: {why}; compute it: {remedy}.")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Frame:
        if isinstance(index, slice):
            raise InputError(
                "sequence[...]: expected the number of one frame, got a slice."
            )
        return self.frame(range(len(self))[index])

    def camera(self, index: int) -> Camera:
        """Return the pinhole camera of a frame."""
        assert self._camera is not None  # else a reader overrides this
        return self._camera

    def frame(self, index: int) -> Frame:
        """Read a frame; image or depth is None where missing, a FileNotFoundError if both are."""
        rgb_file = self.rgb_files[index]
        depth_file = self.depth_files[index]
        rgb = self._read(rgb_file, read_rgb)
        depth = _if_there(depth_file, self._read_depth)
        mask = self._read(self.mask_files[index], read_mask_png)
        where = f"{self.name}: frame {index} ({rgb_file}, {depth_file})"
        if rgb is None and depth is None:
            raise FileNotFoundError(f"{where}: neither image nor depth is there.")
        if self._lens is not None:
            rgb, depth, mask = straighten(*self._lens, rgb, depth, mask)
        camera = self.camera(index)
        stamp = float(self.timestamps[index])
        try:
            return Frame(rgb, depth, camera, stamp, index, mask=mask)
        except InputError as error:
            raise FormatError(f"{where}: {error}") from None

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read the flow to the next frame, (H, W, 2) px, and where it is valid, (H, W) or None."""
        if index >= len(self) - 1:
            raise IndexError(
                f"{self.name}: no flow starts at frame {index} of {len(self)}."
            )
        path = self.flow_files[index] if self.flow_files else None
        if path is None:
            raise FileNotFoundError(
                f"{self.name}: there is no flow file from frame {index} on."
            )
        return self._read_flow(path, index)

    def files(self) -> list[Path]:
        """Return every file that is read: those of the frames, and those in the root folder."""
        frames = (
            *self.rgb_files,
            *self.depth_files,
            *self.flow_files[:-1],
            *self.mask_files,
        )
        return sorted(
            path
            for path in {*frames, *self.root.glob("*")}
            if path and path.is_file()
        )

    def opened_with(self) -> dict[str, Any]:
        """Return what decides how the files are read beside themselves, JSON-ready."""
        camera = self._camera
        lens = self._lens
        mask = self._mask_folder
        maps = b"" if lens is None else b"".join(part.tobytes() for part in lens)
        return {
            "kind": self.kind,
            "camera": None if camera is None else asdict(camera),
            "lens": hashlib.sha256(maps).hexdigest() if maps else None,
            "depth_scale": self._given_scale or self.depth_scale,
            "mask": None if mask is None else os.path.relpath(mask, self.root),
        }

    def _list_files(self) -> None:
        """Fill in files, stamps, poses, name and sources; every reader has its own."""
        raise NotImplementedError

    def _calibration(self) -> Calibration | None:
        """The camera of all frames; None where each has its own, and ``camera`` is overridden."""
        return None

    def _read_depth(self, path: Path) -> np.ndarray:
        """Depth (H, W), float32 metres; 0, negative and not finite values are invalid."""
        stored = read_depth(path, self._size)
        # unless the user says otherwise, only whole numbers are in the data set's unit
        scale = self._given_scale or (
            self.depth_scale if stored.dtype.kind == "u" else 1.0
        )
        if scale is None:
            needed = "'depth_scale' in camera.yaml, or --depth-scale: units per metre, 1000 for mm"
            raise InputError(
                f"{path}: depth is of whole numbers: expected {needed}."
            )
        depth = stored.astype(np.float32) / np.float32(scale)
        depth[stored == SATURATED] = 0.0
        return depth

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        return read_flow(path, self._size)

    def _read(self, path: Path | None, read: Callable[..., np.ndarray]) -> Image:
        """An image of the size of all others, None where there is none."""
        return _if_there(path, lambda there: read(there, self._size))

    def _list_numbered(
        self,
        rgb: dict[int, Path],
        depth: dict[int, Path],
        flow: dict[int, Path] | None = None,
    ) -> list[int]:
        """Take files by frame number, with stamps; returns the numbers with an image or depth."""
        frames = {*rgb, *depth}
        flow = flow or {}
        numbers = sorted(frames)
        first = min(numbers, default=0)
        self.rgb_files = [rgb.get(n) for n in numbers]
        self.depth_files = [depth.get(n) for n in numbers]
        self.flow_files = [
            flow.get(n) if n + 1 in frames else None for n in numbers
        ]
        self.timestamps = (np.array(numbers) - first) / self.frames_per_second
        if missing := _first_missing(numbers):
            self._warn(
                f"frame numbers {shown(missing)} are missing; the stamps keep the gap"
            )
        return numbers

    def _warn(self, text: str) -> None:
        self.warnings.append(f"{self.name}: {text}.")

    def _assume(self, text: str) -> None:
        """Tell what the answer rests on although no file says so."""
        self._warn(text)
        self.assumed = (*self.assumed, printable(self.warnings[-1]))

    def _check_there(self) -> None:
        """Refuse a sequence of which no frame can be tracked."""
        listed = {"image": self.rgb_files, "depth": self.depth_files}
        for what, paths in listed.items():
            if _any_there(paths) or (
                what == "image" and _any_there(self.flow_files)
            ):
                continue
            such = next(
                (f": {path} is not there" for path in paths if path is not None), ""
            )
            text = f"no frames: none of {len(self)} has {what}{such}"
            raise InputError(f"{self.root}: {text}.")

    def _read_poses(self, files: Files, read: Callable[[Path], np.ndarray]) -> None:
        """Take the poses, of which every frame has a file of its own."""
        poses = [
            np.full((4, 4), np.nan) if path is None else read(path)
            for path in files
        ]
        self.poses = np.array(poses).reshape(-1, 4, 4)

    def _take_camera(self) -> None:
        """Take the size of the images from the first one, the camera, and the unit of depth."""
        _, size = _first(self.rgb_files, image_size)
        if size is None:
            _, size = _first(self.depth_files, image_size)
        self.height, self.width = size
        given = self._given_camera
        found = (
            self._calibration()
            if given is None
            else parse_camera(given, size, self.warnings)
        )
        self._camera = self._lens = None
        if found is not None:
            camera = self._camera = found.camera
            if camera.shape != size:
                text = f"images are {self.width}x{self.height}, the camera is for {camera.width}x"
                text += f"{camera.height} pixels: give theirs (--camera fx,fy,cx,cy or FILE)"
                raise InputError(f"{self.root}: {text}.")
            if any(found.distortion):
                whole = camera.K, np.array(found.distortion), np.eye(3), camera.K
                self._lens = cv2.initUndistortRectifyMap(
                    *whole, size[::-1], cv2.CV_32FC1
                )
            if self._given_scale is None:
                self._given_scale = found.depth_scale
        scale = self._given_scale
        if scale is not None and not scale > 0:
            raise InputError(
                f"{self.name}: depth_scale: expected units per metre, got {scale}."
            )
        # RealSense's; 0.001 as single precision prints it
        if scale is not None and scale < 1:
            self._given_scale = units = float(f"{1 / scale:.6g}")
            self._warn(
                f"depth_scale {scale:g}: taken as RealSense's, {units:g} units per metre"
            )

    def _check_depth(self) -> None:
        """Look at the size and the unit of the first depth map."""
        path, size = _first(self.depth_files, image_size)
        if size != (self.height, self.width):
            raise InputError(
                f"{path}: depth is {size[1]}x{size[0]}, colour "
                f"{self.width}x{self.height} pixels: depth must be registered to colour, not "
                f"resized (RealSense: rs.align(rs.stream.color); ROS: aligned_depth_to_color)."
            )
        self._size = size
        try:
            path, depth = _first(self.depth_files, self._read_depth)
        except FormatError as error:
            if self._are_swapped():
                raise FormatError(
                    f"{error} Are the images and the depth maps swapped?"
                ) from None
            raise
        median = typical_depth(depth)
        if median is None:
            self.warnings.append(f"{path}: the first depth map has no valid value.")
        elif advice := depth_unit_fix(median, self.depth_scale):
            what = (
                f"a median depth of {median:.4g} cannot be metres. Perhaps {advice}"
            )
            how = "by --depth-scale, or depth_scale in camera.yaml"
            self.warnings.append(f"{path}: {what} ({how}).")

    def _are_swapped(self) -> bool:
        """Whether the first image looks like depth: one channel of 16 bits."""
        with contextlib.suppress(InputError, OSError):
            _, header = _first(self.rgb_files, read_header)
            return header is not None and header.bits == 16 and header.channels == 1
        return False

    def _warn_of_links(self) -> None:
        """Tell of files that are links to elsewhere, which a folder of a stranger may hold."""
        files = (
            *self.rgb_files,
            *self.depth_files,
            *self.flow_files,
            *self.mask_files,
        )
        links = [path for path in files if path is not None and path.is_symlink()]
        # not Path.resolve, which raises an error where links lead in a ring
        ends = [Path(os.path.realpath(path)) for path in links]
        inside = os.path.realpath(self.root)
        out = [k for k, end in enumerate(ends) if not end.is_relative_to(inside)]
        if out:
            such = f"{links[out[0]]} to {ends[out[0]]}"
            self._warn(
                f"{len(out)} files are links to outside of the folder, such as {such}"
            )

    def _warn_of_what_is_missing(self) -> None:
        listed = {
            "image": self.rgb_files,
            "depth": self.depth_files,
            "mask": self.mask_files,
        }
        for what, paths in listed.items():
            missing = [
                i
                for i, path in enumerate(paths)
                if path is None or not path.exists()
            ]
            if missing and (any(paths) or what != "mask"):
                such = f", such as {paths[missing[0]]}" if paths[missing[0]] else ""
                self._warn(
                    f"{len(missing)} frames without {what}: {shown(missing)}{such}"
                )
        lost = 0 if self.poses is None else int(np.isnan(self.poses[:, 0, 0]).sum())
        if lost:
            self._warn(f"{lost} of {len(self)} frames have no true pose")


def _if_there(path: Path | None, read: Callable[[Path], np.ndarray]) -> Image:
    return read(path) if path is not None and path.exists() else None


def _any_there(files: Iterable[Path | None]) -> bool:
    return any(path is not None and path.exists() for path in files)


def _first_missing(numbers: list[int]) -> list[int]:
    """The first few of the numbers that sorted numbers leave out, however many these are."""
    steps = itertools.pairwise(numbers)
    gaps = itertools.chain.from_iterable(range(a + 1, b) for a, b in steps)
    return [*itertools.islice(gaps, 9)]  # one more than a message shows


def _first(files: Files, read: Callable[[Path], Any]) -> tuple[Any, Any]:
    """The first file that can be read, and what it holds; None where none is there."""
    there = [path for path in files if path is not None and path.exists()]
    for path in there:
        with contextlib.suppress(InputError, OSError):
            return path, read(path)
    # the error of the first
    return (there[0], read(there[0])) if there else (None, None)


def straighten(
    u: np.ndarray, v: np.ndarray, rgb: Image, depth: Image, mask: Image
) -> tuple[Image, Image, np.ndarray]:
    """Look image, depth and mask up at columns u and rows v; what lies outside is masked."""
    height, width = u.shape
    inside: np.ndarray = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    if rgb is not None:
        rgb = cv2.remap(rgb, u, v, cv2.INTER_LINEAR)
    if depth is not None:  # neighbours are never mixed
        depth = cv2.remap(depth, u, v, cv2.INTER_NEAREST)
    if mask is not None:
        inside &= cv2.remap(mask.view(np.uint8), u, v, cv2.INTER_NEAREST) > 0
    return rgb, depth, inside
