"""The base class of all readers: it lists files and reads checked frames from them."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict
from numbers import Integral
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.checks import brief
from hybridvo.core.depth_units import (
    depth_unit_fix,
    scale_is_unknown,
    typical_depth,
)
from hybridvo.core.errors import FormatError, InputError, format_errors, printable
from hybridvo.core.imu import ImuSamples, rising
from hybridvo.core.trajectory import check_increasing
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.camera_file import Calibration, parse_camera
from hybridvo.io.data.image_io import (
    image_size,
    read_depth,
    read_flow,
    read_header,
    read_mask_png,
    read_rgb,
)
from hybridvo.io.data.lists import (
    ABBREVIATED_COUNT,
    IMAGES,
    abbreviated,
    match_files,
    sorted_files,
)

SATURATED = 65535
"""The largest number of 16 bits, by which depth files mark pixels without depth."""
Files = list[Path | None]
"""A file for each frame, None where a frame has none."""
Image = np.ndarray | None
"""An image or a map, None where a frame has none."""


class UndistortionMaps(NamedTuple):
    """Where each pixel of an undistorted image lies in the distorted one."""

    columns: np.ndarray  # (H, W) float32, pixels
    rows: np.ndarray  # (H, W) float32, pixels


class Sequence:
    """Frames in the order of time, each read from disk when it is used.

    ``len(sequence)`` is the number of frames, ``sequence[i]`` reads one, and iteration reads all.
    A reader overrides :meth:`_list_files`, which fills in files, time stamps and poses,
    :meth:`_calibration`, and the methods that read a file where its format is its own. A missing
    image or depth map is a warning, and None in its frame; a frame that lacks both cannot be read.

    Attributes:
        root: The folder.
        name: The name of the sequence, for messages and output folders.
        rgb_files: The image of each frame, None where it has none.
        depth_files: The depth map of each frame, likewise.
        flow_files: The flow from each frame to the next one, likewise.
        mask_files: The mask of each frame, likewise.
        timestamps: (N,) seconds, strictly increasing.
        depth_timestamps: (N,) seconds, of the depth maps; None where they have no stamps of
            their own.
        poses: (N, 4, 4) true T_world_cam, metres, NaN where unknown; None without any.
        imu_samples: (M, 7) of an inertial sensor: stamp, s, of the clock of the frames; rates about
            its axes, rad/s; accelerations along them, m/s^2; None without one.
        R_cam_imu: (3, 3) rotation from its axes to those of the camera, likewise.
        T_cam_frame: (4, 4) place of another frame of reference, such as ``base_link``, in the
            camera's, m; None where the user asks for none.
        chosen: What the user chose that only some kinds of sequences have: ``choices``.
        warnings: Sentences about what the user should know.
        height: Rows of every image, pixels.
        width: Columns of every image, pixels.
    """

    kind = "sequence"
    """Name of the reader in ``READERS``."""
    markers: tuple[tuple[str, ...], ...] = ()
    """Groups of file names, with wildcards. A folder that has all names of one group belongs to
    this reader."""
    choices: tuple[str, ...] = ()
    """Names of the keyword arguments of ``open_sequence`` that only some readers take."""
    depth_source = "sensor"
    """``sensor``, ``stereo``, ``file``, or ``true``: depth of a renderer, which is an oracle."""
    flow_is_true = False
    """Whether the flow files are ground truth, which is an oracle."""
    depth_scale: float | None = None
    """Stored units per metre of depth maps that hold whole numbers."""
    frames_per_second = 30.0
    """Frame rate where the files have no time stamps."""
    assumed: tuple[str, ...] = ()
    """Sentences about assumptions that no file confirms. They are in ``warnings`` as well."""

    def __init__(
        self,
        root: Path,
        camera: str | Path | Camera | None = None,
        depth_scale: float | None = None,
        mask: str | Path | None = None,
        needs_depth: bool = True,
        **chosen: str,
    ) -> None:
        self._begin(root, root.name, camera, depth_scale, mask)
        self._needs_depth = needs_depth
        self.chosen = chosen
        self._list_files()
        self._check_frames()
        self._check_depth_offset()
        self.mask_files = self._list_masks()
        self._take_size()
        self._take_camera()
        self._take_depth_scale()
        self._check_depth()
        self._warn_of_missing_files()
        self._warn_of_links()
        self._clean_texts()

    def _take_over(self, original: Sequence) -> None:
        """Take over what another sequence, which this one is made of, states of itself."""
        self.__dict__.update(vars(original))
        # attributes of its class
        self.kind = original.kind
        self.depth_source = original.depth_source
        self.flow_is_true = original.flow_is_true
        self.depth_scale = original.depth_scale

    def _begin(
        self,
        root: Path,
        name: str,
        camera: str | Path | Camera | None,
        depth_scale: float | None,
        mask: str | Path | None,
    ) -> None:
        """Set every attribute of a sequence of which nothing has been read."""
        self.root = root
        self.name = name
        self.rgb_files: Files = []
        self.depth_files: Files = []
        self.flow_files: Files = []
        self.mask_files = []
        self.timestamps = np.zeros(0)
        self.depth_timestamps: np.ndarray | None = None
        self.poses: np.ndarray | None = None
        self.imu_samples: np.ndarray | None = None
        self.R_cam_imu: np.ndarray | None = None
        self.T_cam_frame: np.ndarray | None = None
        self.chosen = {}
        self.warnings: list[str] = []
        self._camera: Camera | None = None
        self._lens: UndistortionMaps | None = None
        self._mask_folder = None if mask is None else Path(mask)
        self._given_camera = camera
        self._given_scale = depth_scale
        # (height, width) of all images, once the first one was looked at
        self._size: tuple[int, int] | None = None
        # False where a network predicts it
        self._needs_depth = True

    def _clean_texts(self) -> None:
        """Make texts printable: names of folders and files may come from strangers."""
        self.name = printable(self.name)
        self.warnings = [printable(text) for text in self.warnings]

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a folder is a sequence of this kind."""
        # a path that the system refuses, such as one with a null character, is no folder
        if not folder.is_dir():
            return False
        for group in cls.markers:
            if all(any(folder.glob(name)) for name in group):
                return True
        return False

    def imu(self, start: float, end: float) -> ImuSamples | None:
        """Return what the IMU of the camera measured between two times, seconds.

        Returns:
            The samples; None where the recording has none for that time.
        """
        samples = self.imu_samples
        if samples is None or self.R_cam_imu is None:
            return None
        first = int(np.searchsorted(samples[:, 0], start, "right")) - 1
        last = int(np.searchsorted(samples[:, 0], end, "left"))
        chosen = samples[max(first, 0) : last]
        if not len(chosen):
            return None
        # a recorder of the gyroscope alone leaves them at 0
        accelerations = chosen[:, 4:7] if chosen[:, 4:7].any() else None
        return ImuSamples(
            chosen[:, 0], chosen[:, 1:4], self.R_cam_imu, accelerations
        )

    def _by_colours_clock(self, depth_stamps: np.ndarray) -> np.ndarray:
        """Return stamps of depth maps, seconds, without the offset that the user states."""
        return depth_stamps - float(self.chosen.get("depth_offset_ms", 0)) / 1000

    def _check_depth_offset(self) -> None:
        """Refuse an offset of stamps by which nothing was matched."""
        if "depth_offset_ms" in self.chosen and self.depth_timestamps is None:
            raise InputError(
                f"--depth-offset-ms: {self.root}: depth has no stamps of its own: it is matched by "
                "names or by order. Of depth that is measured later than its image state "
                "--depth-lag-ms."
            )

    def _take_imu(self, samples: np.ndarray, R_cam_imu: np.ndarray) -> None:
        """Keep the samples (M, 7) of an inertial sensor that are finite and rise in time."""
        usable = rising(samples)
        if len(usable):
            self.imu_samples = usable
            self.R_cam_imu = R_cam_imu

    @property
    def has_flow(self) -> bool:
        """Whether there is at least one flow file."""
        return any(path is not None for path in self.flow_files)

    def check_flow(self, stride: int = 1) -> None:
        """Check that flow files can give the flow between frames that are ``stride`` apart.

        Raises:
            InputError: There are no flow files, or none that leads over the stride.
        """
        if not self.has_flow:
            problem = "there are no flow files"
        elif stride != 1:
            problem = f"flow files do not lead over a stride of {stride}"
        else:
            return
        remedy = "--flow dis, or iter_pairs(sequence, hybridvo.dis_flow())"
        raise InputError(f"{self.name}: {problem}; compute it: {remedy}.")

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Frame:
        if not isinstance(index, Integral):
            got = "a slice" if isinstance(index, slice) else brief(index)
            raise InputError(
                f"sequence[...]: expected the number of one frame, got {got}."
            )
        return self.frame(range(len(self))[index])

    def camera(self, index: int) -> Camera:
        """Return the pinhole camera of a frame."""
        # A reader whose frames have cameras of their own overrides this method.
        assert self._camera is not None
        return self._camera

    def frame(self, index: int) -> Frame:
        """Read a frame; its image or its depth is None where the file is missing.

        Raises:
            FileNotFoundError: Neither the image nor the depth map is there.
            FormatError: A file is damaged, or its content does not fit.
        """
        rgb_file = self.rgb_files[index]
        depth_file = self.depth_files[index]
        rgb = self._read(rgb_file, read_rgb)
        depth = _read_existing(depth_file, self._read_depth)
        mask = self._read(self.mask_files[index], read_mask_png)
        where = f"{self.name}: frame {index} ({rgb_file}, {depth_file})"
        if rgb is None and depth is None:
            raise FileNotFoundError(f"{where}: neither image nor depth is there.")
        if self._lens is not None:
            rgb, depth, mask = undistort(self._lens, rgb, depth, mask)
        camera = self.camera(index)
        stamp = float(self.timestamps[index])
        with format_errors(where):
            return Frame(rgb, depth, camera, stamp, index, mask=mask)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read the flow from a frame to the next one.

        Returns:
            The flow (H, W, 2), pixels, and where it is valid, (H, W) bool or None.

        Raises:
            IndexError: The frame is the last one.
            FileNotFoundError: The frame has no flow file.
            FormatError: The file is damaged.
        """
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
        paths: set[Path | None] = set(self.root.glob("*"))
        paths.update(self.rgb_files)
        paths.update(self.depth_files)
        paths.update(self.flow_files[:-1])
        paths.update(self.mask_files)
        return sorted(path for path in paths if path and path.is_file())

    def opened_with(self) -> dict[str, Any]:
        """Return the settings that decide how the files are read, JSON-ready."""
        camera = self._camera
        mask = self._mask_folder
        lens = None
        if self._lens is not None:
            content = b"".join(part.tobytes() for part in self._lens)
            lens = hashlib.sha256(content).hexdigest()
        return {
            "kind": self.kind,
            "camera": None if camera is None else asdict(camera),
            "lens": lens,
            "depth_scale": self._given_scale or self.depth_scale,
            "mask": None if mask is None else os.path.relpath(mask, self.root),
            **self.chosen,
        }

    # -- what a reader overrides -------------------------------------------------------

    def _list_files(self) -> None:
        """Fill in files, time stamps, poses, name and sources."""
        raise NotImplementedError

    def _calibration(self) -> Calibration | None:
        """Return the camera of all frames; None if ``camera`` is overridden."""
        return None

    def _read_depth(self, path: Path) -> np.ndarray:
        """Read depth (H, W), float32 metres; 0, negative and not finite values are invalid."""
        stored = read_depth(path, self._size)
        scale = self._given_scale
        if scale is None:
            # Floating-point depth is in metres, whatever the data set's unit is.
            is_whole = stored.dtype.kind == "u"
            scale = self.depth_scale if is_whole else 1.0
        if scale is None:
            where = "'depth_scale' in camera.yaml"
            raise InputError(f"{path}: {scale_is_unknown(stored, where)}")
        return in_metres(stored, scale)

    def _read_flow(
        self, path: Path, index: int
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Read the flow that starts at a frame, and where it is valid."""
        return read_flow(path, self._size)

    # -- helpers of the readers --------------------------------------------------------

    def _read(self, path: Path | None, read: Callable[..., np.ndarray]) -> Image:
        """Read an image of the size of all others; None where there is none."""
        return _read_existing(path, lambda existing: read(existing, self._size))

    def _list_numbered(
        self,
        rgb: dict[int, Path],
        depth: dict[int, Path],
        flow: dict[int, Path] | None = None,
    ) -> list[int]:
        """Fill in files that have frame numbers, and time stamps at the frame rate.

        Args:
            rgb: Images by frame number.
            depth: Depth maps by frame number.
            flow: Flow from the frame with the number to the next one.

        Returns:
            The numbers of all frames with an image or depth, sorted.
        """
        flow = flow or {}
        known = {*rgb, *depth}
        numbers = sorted(known)
        first = min(numbers, default=0)
        self.rgb_files = [rgb.get(n) for n in numbers]
        self.depth_files = [depth.get(n) for n in numbers]
        self.flow_files = [flow.get(n) if n + 1 in known else None for n in numbers]
        self.timestamps = (np.array(numbers) - first) / self.frames_per_second
        if missing := _first_missing(numbers):
            self._warn(
                f"frame numbers {abbreviated(missing)} are missing; the stamps keep the gap"
            )
        return numbers

    def _read_poses(self, files: Files, read: Callable[[Path], np.ndarray]) -> None:
        """Read the poses of frames that each have a pose file of their own."""
        unknown = np.full((4, 4), np.nan)
        poses = [unknown if path is None else read(path) for path in files]
        self.poses = np.array(poses).reshape(-1, 4, 4)

    def _warn(self, text: str) -> None:
        """Add a warning."""
        self.warnings.append(f"{self.name}: {text}.")

    def _assume(self, text: str) -> None:
        """Add a warning about an assumption that no file confirms."""
        self._warn(text)
        self.assumed = (*self.assumed, printable(self.warnings[-1]))

    # -- what happens when a sequence is opened ----------------------------------------

    def _check_frames(self) -> None:
        """Refuse a sequence of which no frame can be tracked."""
        if not self.rgb_files:
            names = ", or ".join(" and ".join(group) for group in self.markers)
            raise InputError(
                f"{self.root}: no frames. Looked for {self.kind}: {names}."
            )
        # Flow files stand in for images.
        if not _any_exists(self.rgb_files) and not _any_exists(self.flow_files):
            self._refuse_without("image", self.rgb_files)
        if self._needs_depth and not _any_exists(self.depth_files):
            self._refuse_without("depth", self.depth_files)
        check_increasing(self.timestamps, str(self.root))

    def _refuse_without(self, what: str, files: Files) -> None:
        """Raise the error of a sequence of which no frame has an image, or depth."""
        text = f"no frames: none of {len(self)} has {what}"
        listed = [path for path in files if path is not None]
        if listed:
            text += f": {listed[0]} is not there"
        raise InputError(f"{self.root}: {text}.")

    def _list_masks(self) -> Files:
        """Return the mask of each frame, from the folder of masks if there is one."""
        folder = self._mask_folder
        if folder is None:
            return [None] * len(self)
        frames = [
            rgb or depth
            for rgb, depth in zip(self.rgb_files, self.depth_files, strict=True)
        ]
        hint = "Expected PNG or JPEG, 0 where pixels must not be used, named like the images."
        return match_files(frames, sorted_files(folder, IMAGES), folder, hint)

    def _take_size(self) -> None:
        """Take the size of all images from the first one that can be read."""
        _, size = _first_readable(self.rgb_files, image_size)
        if size is None:
            _, size = _first_readable(self.depth_files, image_size)
        self.height, self.width = size

    def _take_camera(self) -> None:
        """Take the camera that the user gave, else the data set's own."""
        size = (self.height, self.width)
        given = self._given_camera
        if given is None:
            calibration = self._calibration()
        else:
            calibration = parse_camera(given, size, self.warnings)
        if calibration is None:
            return
        camera = calibration.camera
        if camera.shape != size:
            raise InputError(
                f"{self.root}: images are {self.width}x{self.height}, the camera is for "
                f"{camera.width}x{camera.height} pixels: give theirs "
                "(--camera fx,fy,cx,cy or FILE)."
            )
        self._camera = camera
        if any(calibration.distortion):
            self._lens = undistortion_maps(camera, calibration.distortion)
        if self._given_scale is None:
            self._given_scale = calibration.depth_scale

    def _take_depth_scale(self) -> None:
        """Check the given units per metre; accept RealSense's metres per unit too."""
        scale = self._given_scale
        if scale is None:
            return
        if not scale > 0:
            raise InputError(
                f"{self.name}: depth_scale: expected units per metre, got {scale}."
            )
        if scale < 1:
            # six digits: single precision prints RealSense's 0.001 as 0.0010000000474974513
            units = float(f"{1 / scale:.6g}")
            self._given_scale = units
            self._warn(
                f"depth_scale {scale:g}: taken as RealSense's, {units:g} units per metre"
            )

    def _check_depth(self) -> None:
        """Check the size and the unit of the first depth map."""
        size = (self.height, self.width)
        if not self._needs_depth:
            # predicted depth replaces what there is
            self.depth_files = [None] * len(self)
            self._size = size
            return
        path, depth_size = _first_readable(self.depth_files, image_size)
        if depth_size != size:
            height, width = depth_size
            raise InputError(
                f"{path}: depth is {width}x{height}, colour "
                f"{self.width}x{self.height} pixels: depth must be registered to colour, not "
                f"resized (RealSense: rs.align(rs.stream.color); ROS: aligned_depth_to_color)."
            )
        self._size = size
        try:
            path, depth = _first_readable(self.depth_files, self._read_depth)
        except FormatError as error:
            if self._are_swapped():
                raise FormatError(
                    f"{error} Are the images and the depth maps swapped?"
                ) from None
            raise
        self._check_depth_unit(path, depth)

    def _check_depth_unit(self, path: Path, depth: np.ndarray) -> None:
        """Warn where a depth map has no values, or its values cannot be metres."""
        median = typical_depth(depth)
        if median is None:
            self.warnings.append(f"{path}: the first depth map has no valid value.")
            return
        advice = depth_unit_fix(median, self.depth_scale)
        if advice:
            problem = f"a median depth of {median:.4g} cannot be metres"
            options = "by --depth-scale, or depth_scale in camera.yaml"
            self.warnings.append(
                f"{path}: {problem}. Perhaps {advice} ({options})."
            )

    def _are_swapped(self) -> bool:
        """Return whether the first image looks like depth: one channel of 16 bits."""
        with contextlib.suppress(InputError, OSError):
            _, header = _first_readable(self.rgb_files, read_header)
            return header is not None and header.bits == 16 and header.channels == 1
        return False

    def _warn_of_links(self) -> None:
        """Warn of links to files outside of the folder, which a stranger may have put there."""
        files = (
            *self.rgb_files,
            *self.depth_files,
            *self.flow_files,
            *self.mask_files,
        )
        inside = os.path.realpath(self.root)
        outside = []
        for path in files:
            if path is None or not path.is_symlink():
                continue
            # not Path.resolve, which raises an error where links form a ring
            target = Path(os.path.realpath(path))
            if not target.is_relative_to(inside):
                outside.append((path, target))
        if outside:
            path, target = outside[0]
            self._warn(
                f"{len(outside)} files are links to outside of the folder, "
                f"such as {path} to {target}"
            )

    def _warn_of_missing_files(self) -> None:
        """Warn of frames without an image, depth, a mask or a true pose."""
        self._warn_of_missing("image", self.rgb_files)
        if self._needs_depth:
            self._warn_of_missing("depth", self.depth_files)
        if any(self.mask_files):
            self._warn_of_missing("mask", self.mask_files)
        if self.poses is None:
            return
        unknown = int(np.isnan(self.poses[:, 0, 0]).sum())
        if unknown:
            self._warn(f"{unknown} of {len(self)} frames have no true pose")

    def _warn_of_missing(self, what: str, files: Files) -> None:
        """Warn of frames whose file is missing."""
        missing = [
            i for i, path in enumerate(files) if path is None or not path.exists()
        ]
        if not missing:
            return
        text = f"{len(missing)} frames without {what}: {abbreviated(missing)}"
        first = files[missing[0]]
        if first is not None:
            text += f", such as {first}"
        self._warn(text)


def in_metres(stored: np.ndarray, units: float) -> np.ndarray:
    """Return depth (H, W) as float32 metres; it is stored in units per metre."""
    depth = stored.astype(np.float32) / np.float32(units)
    depth[stored == SATURATED] = 0.0
    return depth


def _read_existing(path: Path | None, read: Callable[[Path], np.ndarray]) -> Image:
    """Read a file; None where it is not there."""
    if path is None or not path.exists():
        return None
    return read(path)


def _any_exists(files: Iterable[Path | None]) -> bool:
    """Return whether one of the files is there."""
    return any(path is not None and path.exists() for path in files)


def _first_missing(numbers: list[int]) -> list[int]:
    """Return the first numbers that sorted numbers leave out, as many as a message needs."""
    neighbours = itertools.pairwise(numbers)
    missing = itertools.chain.from_iterable(
        range(number + 1, following) for number, following in neighbours
    )
    # One more than a message shows, so that it ends in dots. A gap may be huge.
    return list(itertools.islice(missing, ABBREVIATED_COUNT + 1))


def _first_readable(files: Files, read: Callable[[Path], Any]) -> tuple[Any, Any]:
    """Return the first file that can be read, and its content.

    Both are None where no file is there. Where every file is damaged, the error of the first one
    is raised.
    """
    existing = [path for path in files if path is not None and path.exists()]
    if not existing:
        return None, None
    for path in existing:
        with contextlib.suppress(InputError, OSError):
            return path, read(path)
    return existing[0], read(existing[0])


def undistortion_maps(
    camera: Camera, distortion: tuple[float, ...]
) -> UndistortionMaps:
    """Compute where each pixel of the undistorted image lies in the distorted one.

    Args:
        camera: The camera of both images.
        distortion: Brown's k1 k2 p1 p2 [k3 [k4 k5 k6]], in OpenCV's order.

    Returns:
        Maps of the camera's size.
    """
    K = camera.K
    size = (camera.width, camera.height)
    columns, rows = cv2.initUndistortRectifyMap(
        K, np.array(distortion), np.eye(3), K, size, cv2.CV_32FC1
    )
    return UndistortionMaps(columns, rows)


def undistort(
    maps: UndistortionMaps, rgb: Image, depth: Image, mask: Image
) -> tuple[Image, Image, np.ndarray]:
    """Take the lens distortion out of an image, a depth map and a mask.

    Args:
        maps: Where each pixel of the result lies in the input.
        rgb: (H, W, 3) uint8, or None.
        depth: (H, W) metres, or None.
        mask: (H, W) bool, or None.

    Returns:
        The same without distortion. The mask is False where the input has no such pixel.
    """
    u = maps.columns
    v = maps.rows
    height, width = u.shape
    in_columns = (u >= 0) & (u <= width - 1)
    in_rows = (v >= 0) & (v <= height - 1)
    valid: np.ndarray = in_columns & in_rows
    if rgb is not None:
        rgb = cv2.remap(rgb, u, v, cv2.INTER_LINEAR)
    if depth is not None:
        # A mean of neighbours would invent depth between two surfaces.
        depth = cv2.remap(depth, u, v, cv2.INTER_NEAREST)
    if mask is not None:
        moved = cv2.remap(mask.view(np.uint8), u, v, cv2.INTER_NEAREST)
        valid &= moved > 0
    return rgb, depth, valid
