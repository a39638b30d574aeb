"""The base class of all readers: lists of files in, checked frames out."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.data.camera_file import IMAGES, Calibration, Lens, parse_camera, units_per_metre
from hybridvo.data.image_io import read_depth, read_flow, read_mask_png, read_rgb
from hybridvo.data.lists import check_increasing, match_files, shown, sorted_files, warn_of_gaps
from hybridvo.errors import FormatError, InputError
from hybridvo.types import Camera, Frame
from hybridvo.units import depth_advice, typical_depth


@dataclass(frozen=True)
class Given:
    """What a user says of a sequence: see :func:`hybridvo.data.sequence.open_sequence`."""

    camera: str | os.PathLike[str] | Camera | Calibration | None = None
    depth_scale: float | None = None
    mask: str | os.PathLike[str] | None = None


@dataclass
class Listing:
    """What a reader has found on disk; lists hold an entry for each frame, None where none is.

    Stamps are seconds, ``poses`` (N, 4, 4) T_world_cam with NaN where unknown; ``sources`` are the
    other files that were read (lists, calibration, ground truth).
    """

    rgb: list[Path | None]
    depth: list[Path | None]
    timestamps: np.ndarray
    flow: list[Path | None] = field(default_factory=list)
    poses: np.ndarray | None = None
    sources: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def numbered_listing(
    name: str,
    rgb: dict[int, Path],
    depth: dict[int, Path],
    frames_per_second: float,
    flow: dict[int, Path] | None = None,
) -> tuple[list[int], Listing]:
    """Numbers of all frames with an image or depth, and their listing; stamps count from 0."""
    frames = {*rgb, *depth}
    numbers = sorted(frames)
    flow = flow or {}
    listing = Listing(
        rgb=[rgb.get(n) for n in numbers],
        depth=[depth.get(n) for n in numbers],
        flow=[flow.get(n) if n + 1 in frames else None for n in numbers],  # none across a gap
        timestamps=(np.array(numbers) - min(numbers, default=0)) / frames_per_second,
    )
    warn_of_gaps(name, numbers, listing.warnings)
    return numbers, listing


class Sequence:
    """Frames in time order, read when asked for: ``len``, ``sequence[i]``, ``for frame in``.

    A reader fills in a :class:`Listing` and says which camera belongs to it; where its files need
    more than their ending says, it overrides ``_read_depth`` and ``_read_flow``.

    Attributes:
        kind: sintel, tartanair, tum, 7scenes, kitti or folder.
        name: what reports call it. root: its folder.
        timestamps: (N,) float64 seconds, strictly increasing.
        poses: (N, 4, 4) T_world_cam in camera axes, NaN rows where unknown, or None.
        depth_source: ``true`` (synthetic, an oracle), ``sensor``, ``stereo`` or ``file``.
        flow_is_true: whether its flow files are ground truth (an oracle).
        warnings: what the user should know: converted stamps, gaps, missing files, doubtful units.

    Raises:
        InputError: no frames, stamps that do not increase, depth of another size than colour.
        FormatError: no image can be read at all.
    """

    kind = "sequence"
    looks_for = ""
    depth_source = "sensor"
    flow_is_true = False
    depth_scale: float | None = None
    """Stored units per metre of the data set's depth; None: metres."""

    def __init__(self, root: Path, name: str, listing: Listing, given: Given) -> None:
        self.root, self.name = root, name
        self.rgb_files, self.depth_files = listing.rgb, listing.depth
        count = len(listing.rgb)
        self.flow_files = (listing.flow + [None] * count)[:count]
        self.timestamps = np.asarray(listing.timestamps, dtype=np.float64)
        self.poses, self._sources = listing.poses, listing.sources
        self.warnings = listing.warnings
        if count == 0:
            raise InputError(f"{root}: no frames. Looked for {self.looks_for}")
        check_increasing(self.timestamps, str(root))
        self._given_scale = units_per_metre(given.depth_scale, self.name, self.warnings)
        self.height, self.width = self._find_size()
        if given.camera is None:
            calibration = self._calibration()
        else:
            calibration = parse_camera(given.camera, (self.height, self.width))
        self._camera = self._lens = None
        if calibration is not None:
            self._camera = camera = calibration.camera
            if camera.shape != (self.height, self.width):
                raise InputError(
                    f"{root}: images are {self.width}x{self.height}, the camera is for "
                    f"{camera.width}x{camera.height} pixels. Intrinsics belong to one image size: "
                    f"give those of these images (--camera fx,fy,cx,cy or --camera FILE)."
                )
            self.warnings += calibration.warnings
            if any(calibration.distortion):
                self._lens = Lens(calibration.camera, calibration.distortion)
            self._given_scale = self._given_scale or calibration.depth_scale
        self.mask_files = self._find_masks(given.mask)
        self._warn_of_missing_files()
        self._warn_of_depth_unit()

    @property
    def has_flow(self) -> bool:
        """Whether there is at least one flow file."""
        return any(path is not None for path in self.flow_files)

    def check_flow(self, stride: int = 1) -> None:
        """Refuse to take flow files that are not there, or that do not lead over a stride."""
        if self.has_flow and stride == 1:
            return
        why = "there are no flow files"
        if self.has_flow:
            why = f"flow files lead from one frame to the next, not over a stride of {stride}"
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
        self._check_index(index)
        if self._camera is None:
            raise InputError(f"{self.name}: no camera is known for frame {index}.")
        return self._camera

    def frame(self, index: int) -> Frame:
        """Frame ``index``; ``rgb`` or ``depth`` is None where its file is missing.

        Raises:
            IndexError: no such index. FileNotFoundError: neither image nor depth is there.
            FormatError: a file cannot be decoded or has another size.
        """
        index = self._check_index(index)
        camera = self.camera(index)
        rgb_path, depth_path = self.rgb_files[index], self.depth_files[index]
        rgb = depth = mask = None
        if rgb_path is not None and rgb_path.exists():
            rgb = read_rgb(rgb_path)
            self._check_shape(rgb, rgb_path, "an image")
        if depth_path is not None and depth_path.exists():
            depth = self._read_depth(depth_path, index, rgb)
            self._check_shape(depth, depth_path, "depth")
        if rgb is None and depth is None:
            raise FileNotFoundError(
                f"{self.name}: frame {index}: neither image nor depth is there "
                f"({rgb_path or 'no image path'}, {depth_path or 'no depth path'})."
            )
        if (path := self.mask_files[index]) is not None:
            mask = read_mask_png(path)
            self._check_shape(mask, path, "a mask")
        if self._lens is not None:
            rgb = None if rgb is None else self._lens.smooth(rgb)
            depth = None if depth is None else self._lens.nearest(depth)
            mask = self._lens.mask & (mask is None or self._lens.nearest(mask.view(np.uint8)) > 0)
        variance = None if depth is None else self._depth_variance(depth)
        return Frame(rgb, depth, camera, float(self.timestamps[index]), index, variance, mask)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Flow from frame ``index`` to the next: (H, W, 2) float32 px, and (H, W) bool or None.

        Raises:
            IndexError: no such pair. FileNotFoundError: no flow file for it.
            FormatError: the file cannot be decoded or has another size.
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
        self._check_shape(flow, path, "flow")
        return flow, valid

    def files(self) -> list[Path]:
        """Every existing file that the sequence reads, sorted: what a fingerprint covers."""
        frames = (self.rgb_files, self.depth_files, self.flow_files[:-1], self.mask_files)
        found = {path for paths in (self._sources, *frames) for path in paths if path is not None}
        return sorted(path for path in found if path.is_file())

    def _calibration(self) -> Calibration | None:
        """Camera of all frames; None where each frame has its own (``camera`` is overridden)."""
        raise NotImplementedError

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        """(H, W) float32 metres; 0, negative and not finite are invalid."""
        return self._metres(read_depth(path))

    def _metres(self, stored: np.ndarray) -> np.ndarray:
        """Stored depth in metres. Unless a scale is given, only integers are in the set's unit."""
        usual = self.depth_scale if stored.dtype.kind == "u" else None
        return stored.astype(np.float32) / np.float32(self._given_scale or usual or 1.0)

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        return read_flow(path)

    def _depth_variance(self, depth: np.ndarray) -> np.ndarray | None:
        """Variance of log depth, where the source allows to state one."""
        return None

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

    def _find_size(self) -> tuple[int, int]:
        """(height, width) of the first image that can be read, which its depth must have too."""
        problems: list[Exception] = []

        def first(paths: list[Path | None], read: Callable[[Path, int], np.ndarray]) -> Any:
            for index, path in enumerate(paths):
                try:
                    if path is not None:
                        return read(path, index).shape[:2]
                except (FormatError, OSError) as error:
                    problems.append(error)
            return None

        # a right image of a stereo pair is no depth: frames check its size
        depth_files = [] if self.depth_source == "stereo" else self.depth_files
        rgb = first(self.rgb_files, lambda path, _: read_rgb(path))
        depth = first(depth_files, lambda path, index: self._read_depth(path, index, None))
        if rgb is None and depth is None:
            why = problems[0] if problems else "no file is listed"
            raise FormatError(f"{self.root}: no frames: none can be read. First problem: {why}")
        if rgb is not None and depth is not None and rgb != depth:
            raise InputError(
                f"{self.root}: depth images are {depth[1]}x{depth[0]}, colour images {rgb[1]}x"
                f"{rgb[0]} pixels (width x height): depth must be registered to colour, so that "
                f"both have one size and camera (RealSense: rs.align(rs.stream.color); ROS: "
                f"depth_registered or aligned_depth_to_color). Resizing does not register it."
            )
        return rgb or depth

    def _find_masks(self, folder: str | os.PathLike[str] | None) -> list[Path | None]:
        """Mask of each frame."""
        if folder is None:
            return [None] * len(self)
        frames = [rgb or depth for rgb, depth in zip(self.rgb_files, self.depth_files, strict=True)]
        hint = "Expected PNG or JPEG, 0 where pixels must not be used, named like the images."
        return match_files(frames, sorted_files(Path(folder), IMAGES), Path(folder), hint)

    def _warn_of_missing_files(self) -> None:
        listed = {"image": self.rgb_files, "depth": self.depth_files, "mask": self.mask_files}
        for what, paths in listed.items():
            missing = [i for i, path in enumerate(paths) if path is None or not path.exists()]
            if len(missing) == len(paths) and what != "mask":
                like = next((f", such as {path}" for path in paths if path is not None), "")
                self.warnings.append(f"{self.name}: there are no {what} files{like}.")
            elif missing and any(paths):
                self.warnings.append(
                    f"{self.name}: {len(missing)} frames without {what}: {shown(missing)}."
                )

    def _warn_of_depth_unit(self) -> None:
        """Look at the first depth map that can be read, and say so if its unit is doubtful."""
        if self.depth_source == "stereo":
            return
        for index, path in enumerate(self.depth_files):
            try:
                if path is None:
                    continue
                median = typical_depth(self._read_depth(path, index, None))
            except (InputError, OSError):
                continue
            if median is None:
                self.warnings.append(f"{path}: the first depth map has no valid value.")
            elif advice := depth_advice(median, self.depth_scale):
                self.warnings.append(
                    f"{path}: the median depth is {median:.4g} m, which cannot be metres. "
                    f"Probable remedy: {advice} (by --depth-scale, or depth_scale in camera.yaml)."
                )
            return
