"""A user's own data: camera.yaml, rgb/, depth/, and optionally flow/, mask/ and poses.txt."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybridvo.data.base import Given, Listing, Sequence
from hybridvo.data.camera_file import CAMERA_FILE, IMAGES, Calibration, read_camera_file
from hybridvo.data.lists import (
    depth_at,
    match_files,
    poses_at,
    read_stamps,
    read_timed_poses,
    shown,
    sorted_files,
    to_seconds,
)
from hybridvo.errors import InputError
from hybridvo.units import stamp_unit

INNER_FOLDERS = ("rgb", "depth", "flow")


class FolderSequence(Sequence):
    """The layout that is easiest to write; docs/own-data.md describes it.

    Stamps come from ``timestamps.txt``, else from ``poses.txt`` where it has a line for each frame,
    else from file names that are stamps, else from ``fps``. Colour and depth go together by equal
    names, else by stamps within 0.02 s (colour without depth is left out), else by order.
    """

    kind = "folder"
    depth_source = "file"
    looks_for = "folder: camera.yaml (hybridvo init DIR writes one) with rgb/ and depth/"

    def __init__(self, path: Path, given: Given) -> None:
        path = path.absolute()
        root = path.parent if path.name in INNER_FOLDERS else path
        settings = root / CAMERA_FILE
        self._settings: Calibration | None = None
        if settings.exists():
            self._settings = read_camera_file(settings)
        elif given.camera is None:
            raise InputError(
                f"{root}: no {CAMERA_FILE}, and no camera is given. Write one with 'hybridvo init "
                f"{root}' and fill it in, or give --camera fx,fy,cx,cy or --camera FILE."
            )
        rgb = sorted_files(root / "rgb", IMAGES)
        depth = sorted_files(root / "depth", (".png", ".npy", ".dpt"))
        flow = sorted_files(root / "flow", (".flo", ".npy", ".png"))
        self._check_found(root, rgb, depth, flow, given)
        fps = self._settings.fps if self._settings else None
        listing = _match(root, rgb, depth, flow, fps)
        listing.sources.append(settings)
        if given.mask is None and (root / "mask").is_dir():
            given = replace(given, mask=root / "mask")
        super().__init__(root, root.name, listing, given)

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder holds a camera.yaml (or is a part of one that does)."""
        inner = path.name in INNER_FOLDERS and (path.parent / CAMERA_FILE).is_file()
        return (path / CAMERA_FILE).is_file() or inner

    def _calibration(self) -> Calibration | None:
        return self._settings

    def _check_found(
        self, root: Path, rgb: list[Path], depth: list[Path], flow: list[Path], given: Given
    ) -> None:
        """Refuse what no frame can be made of, before anything is matched."""
        settings = self._settings
        if not depth:
            what = "no depth" if rgb else "no frames"
            raise InputError(
                f"{root / 'depth'}: {what}: expected a 16-bit PNG, .npy or .dpt for each PNG or "
                f"JPEG in rgb/. hybridvo needs metric depth, from a sensor, stereo or a network."
            )
        has_scale = given.depth_scale or (settings is not None and settings.depth_scale)
        if not has_scale and any(path.suffix.lower() == ".png" for path in depth):
            raise InputError(
                f"{root / CAMERA_FILE}: depth/ holds PNG files: 'depth_scale' (units per metre, "
                f"1000 for millimetres) must be given, there or with --depth-scale."
            )
        if flow and settings is not None and any(settings.distortion):
            raise InputError(
                f"{root}: flow/ was computed on distorted images, and {CAMERA_FILE} gives a "
                f"distortion. Undistort the images first and compute flow on those, or remove "
                f"flow/ and let hybridvo compute it."
            )


def _match(
    root: Path, rgb: list[Path], depth: list[Path], flow: list[Path], fps: float | None
) -> Listing:
    """Which depth, flow, stamp and pose belong to which image."""
    frames = rgb or depth
    told: list[str] = []
    matched_flow = _match_flow(frames, flow, root, told)
    matched = _match_depth(rgb, depth, root, told) if rgb else dict(enumerate(depth))
    stamps, poses = _stamps_and_poses(root, frames, fps, told)
    kept = list(matched)
    following = [*kept[1:], None]
    sources = [root / name for name in ("timestamps.txt", "depth_timestamps.txt", "poses.txt")]
    return Listing(
        rgb=[frames[i] if rgb else None for i in kept],
        depth=list(matched.values()),
        flow=[
            matched_flow[i] if j == i + 1 else None for i, j in zip(kept, following, strict=True)
        ],
        timestamps=stamps[kept],
        poses=None if poses is None else poses[kept],
        sources=sources,
        warnings=list(dict.fromkeys(told)),
    )


def _match_depth(
    frames: list[Path], files: list[Path], root: Path, told: list[str]
) -> dict[int, Path | None]:
    """Index of each frame that is kept -> its depth."""
    stems = {path.stem for path in frames}
    stray = [path.name for path in files if path.stem not in stems]
    if len(stray) == len(files):
        stamps = _own_stamps(root / "timestamps.txt", frames, told)
        depth_stamps = _own_stamps(root / "depth_timestamps.txt", files, told)
        if stamps is not None and depth_stamps is not None:
            pairs = depth_at(stamps, depth_stamps, root, told)
            return {i: files[j] for i, j in pairs}
    elif stray:
        left_out = f"{len(stray)} depth files without an image are left out"
        told.append(f"{root.name}: {left_out}: {shown(stray, 4)}.")
    hint = "Give both the same names, or their stamps: as names, or in (depth_)timestamps.txt."
    return dict(enumerate(match_files(frames, files, root / "depth", hint)))


def _match_flow(
    frames: list[Path], files: list[Path], root: Path, told: list[str]
) -> list[Path | None]:
    """Flow by equal names, else by order; one that led to a missing image is left out."""
    if not files:
        return [None] * len(frames)
    last = len(frames) - (len(files) == len(frames) - 1)  # none starts at the last image
    hint = "Give both the same names."
    matched = match_files(frames[:last], files, root / "flow", hint)
    matched += [None] * (len(frames) - last)
    is_numbered = all(path.stem.isascii() and path.stem.isdigit() for path in (*frames, *files))
    if not is_numbered or not {path.stem for path in frames} & {path.stem for path in files}:
        return matched
    numbers = np.array([int(path.stem) for path in frames])
    steps = np.diff(numbers)
    usual = Counter(steps.tolist()).most_common(1)[0][0] if len(steps) else 1
    # a flow file between two images, or an unusual step: an image is missing there
    flow_numbers = np.sort([int(path.stem) for path in files])
    first = np.searchsorted(flow_numbers, numbers[:-1], side="right")
    is_gap = (first != np.searchsorted(flow_numbers, numbers[1:])) | (steps != usual)
    lost = [k for k in np.flatnonzero(is_gap) if matched[k] is not None]
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
    """Seconds of all frames and their ground-truth poses, where poses.txt has them."""
    pose_file, poses = root / "poses.txt", None
    pose_stamps = np.zeros(0)
    stamps = _listed_stamps(root / "timestamps.txt", frames, told)
    if pose_file.exists():
        pose_stamps, poses = read_timed_poses(pose_file, told)
        if stamps is None and len(poses) == len(frames):
            return pose_stamps, poses
    if stamps is None:
        stamps = _stamps_in_names(frames, told)
    if stamps is None:
        if fps is None:
            told.append(
                f"{root.name}: no time stamps (timestamps.txt, one a line); 30 frames a second "
                f"assumed."
            )
        stamps = np.arange(len(frames)) / (fps or 30.0)
    if poses is not None:
        poses = poses_at(stamps, pose_stamps, poses, str(pose_file), told)
    return stamps, poses


def _own_stamps(path: Path, files: list[Path], told: list[str]) -> np.ndarray | None:
    """Seconds from a list, else from file names, where either has them."""
    listed = _listed_stamps(path, files, told)
    return _stamps_in_names(files, told) if listed is None else listed


def _listed_stamps(path: Path, files: list[Path], told: list[str]) -> np.ndarray | None:
    if not path.exists():
        return None
    stamps = read_stamps(path, told)
    if len(stamps) != len(files):
        raise InputError(f"{path}: {len(stamps)} stamps for {len(files)} files.")
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
    return to_seconds(values, f"{files[0].parent.name}/ (file names)", told)
