"""A user's own data: camera.yaml, rgb/, depth/, and optionally flow/, mask/ and poses.txt."""

from __future__ import annotations

import itertools
from bisect import bisect
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Listing, Sequence
from hybridvo.data.camera_file import CAMERA_FILE, Calibration, read_camera_file
from hybridvo.data.lists import (
    MAX_STAMP_DIFFERENCE_S,
    associate,
    poses_at,
    read_poses,
    read_rows,
    shown,
    sorted_files,
    to_seconds,
)
from hybridvo.errors import InputError
from hybridvo.units import stamp_unit

DEFAULT_FPS = 30.0
IMAGES = (".png", ".jpg", ".jpeg")


class FolderSequence(Sequence):
    """A folder in the layout that is easiest to write.

    - ``camera.yaml``: see :func:`hybridvo.data.camera_file.read_camera_file`; ``hybridvo init``
      writes one to fill in. Not needed where the camera is given otherwise.
    - ``rgb/``: PNG or JPEG. ``depth/``: 16-bit PNG (``depth_scale`` units per metre), ``.npy`` or
      ``.dpt`` in metres, registered to colour.
    - ``flow/``: ``.flo``, ``.npy`` or KITTI PNG; file i leads from frame i to i + 1.
    - ``mask/``: PNG or JPEG, 0 where pixels must not be used.
    - ``poses.txt``: ``timestamp tx ty tz qx qy qz qw``, ground truth.

    Stamps come from ``timestamps.txt`` (one a line), else from ``poses.txt`` where it has a line
    for each frame, else from file names that are stamps, else from ``fps``. Colour and depth go
    together by equal names, else by stamps within 0.02 s (names that are stamps, or
    ``timestamps.txt`` and ``depth_timestamps.txt``; colour without depth is left out), else by
    order where the counts agree.

    Args:
        path: the folder, or its rgb, depth or flow folder.
        given: what the user says about camera, unit and masks.

    Raises:
        InputError: no frames, no depth, lists that do not fit together. FormatError: damaged files.
    """

    kind = "folder"
    depth_source = "file"
    looks_for = "folder: camera.yaml (hybridvo init DIR writes one) with rgb/ and depth/"

    def __init__(self, path: Path, given: Given) -> None:
        path = path.absolute()
        root = path.parent if path.name in ("rgb", "depth", "flow") else path
        settings = root / CAMERA_FILE
        self._settings: Calibration | None = None
        if settings.exists():
            self._settings = read_camera_file(settings)
        elif given.camera is None:
            raise InputError(
                f"{root}: no {CAMERA_FILE}, and no camera is given. Write one with 'hybridvo init "
                f"{root}' and fill it in, or give --camera fx,fy,cx,cy or --camera FILE."
            )
        found = _Found(
            sorted_files(root / "rgb", IMAGES),
            sorted_files(root / "depth", (".png", ".npy", ".dpt")),
            sorted_files(root / "flow", (".flo", ".npy", ".png")),
        )
        self._check_found(root, found, given)
        listing = _match(root, found, self._settings.fps if self._settings else None)
        if self._settings is not None:
            listing.sources.append(settings)
        if given.mask is None and (root / "mask").is_dir():
            given = replace(given, mask=root / "mask")
        super().__init__(root, root.name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder holds a camera.yaml (or is a part of one that does)."""
        inner = path.name in ("rgb", "depth", "flow") and (path.parent / CAMERA_FILE).is_file()
        return (path / CAMERA_FILE).is_file() or inner

    def _calibration(self) -> Calibration | None:
        found = self._settings
        if found is not None and found.camera.shape != (self.height, self.width):
            raise InputError(
                f"{self.root}: images are {self.width}x{self.height}, {CAMERA_FILE} says "
                f"{found.camera.width}x{found.camera.height}. Intrinsics belong to one image size."
            )
        return found

    def _check_found(self, root: Path, found: _Found, given: Given) -> None:
        """Refuse what no frame can be made of, before anything is matched."""
        if not found.rgb and not found.depth:
            raise InputError(
                f"{root}: no frames matched *.png, *.jpg in rgb or *.png, *.npy, *.dpt in depth."
            )
        if not found.depth:
            raise InputError(
                f"{root / 'depth'}: no depth: expected a 16-bit PNG, .npy or .dpt for each image "
                f"in rgb/. hybridvo needs metric depth, from a sensor, stereo or a network."
            )
        settings = self._settings
        has_scale = given.depth_scale or (settings is not None and settings.depth_scale)
        if not has_scale and any(p.suffix.lower() == ".png" for p in found.depth):
            raise InputError(
                f"{root / CAMERA_FILE}: depth/ holds PNG files: 'depth_scale' (units per metre, "
                f"1000 for millimetres) must be given, there or with --depth-scale."
            )
        if found.flow and settings is not None and any(settings.distortion):
            raise InputError(
                f"{root}: flow/ was computed on distorted images, and {CAMERA_FILE} gives a "
                f"distortion. Undistort the images first and compute flow on those, or remove "
                f"flow/ and let hybridvo compute it."
            )


@dataclass
class _Found:
    """Files of the three folders, in natural order."""

    rgb: list[Path]
    depth: list[Path]
    flow: list[Path]


def _match(root: Path, found: _Found, fps: float | None) -> Listing:
    """Which depth, flow, stamp and pose belong to which image."""
    frames = found.rgb or found.depth
    told = []
    if frames != sorted(frames):
        told.append(f"{root.name}: natural order, {frames[0].name} to {frames[-1].name}.")
    flow = _match_flow(frames, found.flow, root, told)
    if not found.rgb:
        kept: list[tuple[int, Path | None]] = list(enumerate(found.depth))
    else:
        kept = _match_depth(frames, found.depth, root, told)
    sources = [root / name for name in ("timestamps.txt", "depth_timestamps.txt", "poses.txt")]
    stamps, poses = _stamps_and_poses(root, frames, fps, told)
    indices = [i for i, _ in kept]
    following = [*indices[1:], len(frames)]
    return Listing(
        rgb=[frames[i] if found.rgb else None for i in indices],
        depth=[path for _, path in kept],
        flow=[flow[i] if j == i + 1 else None for i, j in zip(indices, following, strict=True)],
        timestamps=stamps[indices],
        poses=None if poses is None else poses[indices],
        sources=[path for path in sources if path.exists()],
        warnings=told,
    )


def _match_depth(
    frames: list[Path], files: list[Path], root: Path, told: list[str]
) -> list[tuple[int, Path | None]]:
    """Frames that are kept, with their depth."""
    by_stem = {path.stem: path for path in files}
    matched = [by_stem.get(frame.stem) for frame in frames]
    if any(matched):
        stray = sorted(by_stem.keys() - {frame.stem for frame in frames})
        if stray:
            told.append(
                f"{root.name}: {len(stray)} depth files without an image are left out: "
                f"{shown([by_stem[stem].name for stem in stray], 4)}."
            )
        return list(enumerate(matched))
    stamps = _own_stamps(root / "timestamps.txt", frames, told)
    depth_stamps = _own_stamps(root / "depth_timestamps.txt", files, told)
    if stamps is not None and depth_stamps is not None:
        pairs = associate(stamps, depth_stamps)
        if not pairs:
            raise InputError(
                f"{root}: no frames: none of {len(frames)} colour stamps has a depth stamp within "
                f"{MAX_STAMP_DIFFERENCE_S} s. Are both of the same clock?"
            )
        if len(pairs) < len(frames):
            told.append(
                f"{root.name}: {len(frames) - len(pairs)} of {len(frames)} colour images have no "
                f"depth within {MAX_STAMP_DIFFERENCE_S} s and are left out."
            )
        return [(i, files[j]) for i, j in pairs]
    if len(files) == len(frames):
        return list(enumerate(files))
    raise InputError(
        f"{root / 'depth'}: {len(files)} files for {len(frames)} images, and no file name agrees "
        f"({files[0].name} against {frames[0].name}). Give both the same names, or their stamps: "
        f"as file names, or one a line in timestamps.txt and depth_timestamps.txt."
    )


def _match_flow(
    frames: list[Path], files: list[Path], root: Path, told: list[str]
) -> list[Path | None]:
    """Flow by equal names, else by order; one that led to a missing image is left out."""
    by_stem = {path.stem: path for path in files}
    matched = [by_stem.get(frame.stem) for frame in frames]
    if not any(matched):
        if files and len(files) not in (len(frames), len(frames) - 1):
            raise InputError(
                f"{root / 'flow'}: {len(files)} files for {len(frames)} images, and no file name "
                f"agrees ({files[0].name} against {frames[0].name}). Give both the same names."
            )
        return [*files, *[None] * (len(frames) - len(files))]
    if not all(path.stem.isascii() and path.stem.isdigit() for path in (*frames, *files)):
        return matched
    numbers = [int(path.stem) for path in frames]
    without_image = sorted({int(path.stem) for path in files} - {*numbers})
    steps = Counter(b - a for a, b in itertools.pairwise(numbers))
    usual = steps.most_common(1)[0][0] if steps else 1
    lost = [
        k
        for k, (a, b) in enumerate(itertools.pairwise(numbers))
        if matched[k] is not None
        and (b - a != usual or bisect(without_image, a) != bisect(without_image, b))
    ]
    for k in lost:
        matched[k] = None
    if lost:
        told.append(
            f"{root.name}: images are missing after {shown([frames[k].name for k in lost], 4)}: "
            f"the flow files of these lead to the missing ones and are not used."
        )
    return matched


def _stamps_and_poses(
    root: Path, frames: list[Path], fps: float | None, told: list[str]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Seconds of all frames and their true poses, where poses.txt has them."""
    pose_file = root / "poses.txt"
    stamps = _listed_stamps(root / "timestamps.txt", frames, told)
    if not pose_file.exists():
        return (_assumed_stamps(root, frames, fps, told) if stamps is None else stamps), None
    pose_stamps, poses = read_poses(pose_file)
    pose_stamps, converted = to_seconds(pose_stamps, pose_file.name)
    told += converted
    if stamps is None and len(poses) == len(frames):
        return pose_stamps, poses
    if stamps is None:
        stamps = _assumed_stamps(root, frames, fps, told)
    matched, missing = poses_at(stamps, pose_stamps, poses, str(pose_file))
    told += missing
    return stamps, matched


def _assumed_stamps(
    root: Path, frames: list[Path], fps: float | None, told: list[str]
) -> np.ndarray:
    """Seconds from the file names, else from a frame rate."""
    if fps is None and (named := _stamps_in_names(frames, told)) is not None:
        return named
    if all(path.stem.isascii() and path.stem.isdigit() for path in frames):
        steps = {int(b.stem) - int(a.stem) for a, b in itertools.pairwise(frames)}
        if len(steps) > 1:
            told.append(
                f"{root.name}: the numbers of the images jump, the time stamps do not: "
                f"{len(frames)} images, {frames[0].name} to {frames[-1].name}. Give the stamps in "
                f"timestamps.txt."
            )
    if fps is None:
        told.append(
            f"{root.name}: no time stamps (timestamps.txt, one a line); {DEFAULT_FPS:g} frames a "
            f"second assumed."
        )
    with np.errstate(over="ignore"):  # of an fps of almost zero: refused as stamps
        return np.arange(len(frames)) / (fps or DEFAULT_FPS)


def _own_stamps(path: Path, files: list[Path], told: list[str]) -> np.ndarray | None:
    """Seconds from a list, else from file names, where either has them."""
    listed = _listed_stamps(path, files, told)
    return _stamps_in_names(files, told) if listed is None else listed


def _listed_stamps(path: Path, files: list[Path], told: list[str]) -> np.ndarray | None:
    if not path.exists():
        return None
    stamps, converted = to_seconds([r.numbers[0] for r in read_rows(path, "stamp")], path.name)
    if len(stamps) != len(files):
        raise InputError(f"{path}: {len(stamps)} stamps for {len(files)} files.")
    told += [warning for warning in converted if warning not in told]
    return stamps


def _stamps_in_names(files: list[Path], told: list[str]) -> np.ndarray | None:
    """Seconds where every file name is a number of seconds or parts of one; counters are none."""
    try:
        values = np.array([float(path.stem) for path in files])
    except ValueError:
        return None
    is_stamp = all("." in path.stem for path in files) or stamp_unit(values)[0] != 1
    if not is_stamp or not np.isfinite(values).all():
        return None
    stamps, converted = to_seconds(values, f"{files[0].parent.name}/ (file names)")
    told += [warning for warning in converted if warning not in told]
    return stamps
