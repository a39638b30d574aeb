"""A user's own data: camera.yaml, rgb/, depth/, and optionally flow/, mask/ and poses.txt."""

from __future__ import annotations

import itertools
from pathlib import Path
from statistics import mode

import numpy as np

from hybridvo.data.base import Files, Sequence
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
from hybridvo.trajectory import stamp_unit


class FolderSequence(Sequence):
    """The layout that is easiest to write; docs/own-data.md describes it.

    Stamps come from ``timestamps.txt``, else from ``poses.txt`` where it has a line for each frame,
    else from file names that are stamps, else from ``fps``. Colour and depth go together by equal
    names, else by stamps within 0.02 s (colour without depth is left out), else by order.
    """

    kind = "folder"
    depth_source = "file"
    markers = ((CAMERA_FILE,),)

    @classmethod
    def looks_for(cls) -> str:
        """What a folder of this kind holds, for messages."""
        return f"folder: {CAMERA_FILE} (hybridvo init DIR writes one) with rgb/ and depth/"

    def _list_files(self) -> None:
        root, settings = self.root, self.root / CAMERA_FILE
        self._settings = read_camera_file(settings) if settings.exists() else None
        if self._settings is None and self._given_camera is None:
            raise InputError(
                f"{root}: no {CAMERA_FILE}, and no camera is given. Write one with 'hybridvo init "
                f"{root}' and fill it in, or give --camera fx,fy,cx,cy or --camera FILE."
            )
        rgb = sorted_files(root / "rgb", IMAGES)
        depth = sorted_files(root / "depth", (".png", ".npy", ".dpt"))
        flow = sorted_files(root / "flow", (".flo", ".npy", ".png"))
        self._check_found(rgb, depth, flow)
        if self._mask_folder is None and (root / "mask").is_dir():
            self._mask_folder = root / "mask"
        frames = rgb or depth
        matched_flow = self._match_flow(frames, flow)
        matched = self._match_depth(rgb, depth) if rgb else dict(enumerate(depth))
        kept = list(matched)
        self.rgb_files = [rgb[i] if rgb else None for i in kept]
        self.depth_files = [*matched.values()]
        self.flow_files = [matched_flow[i] if i + 1 in matched else None for i in kept]
        stamps, poses = self._stamps_and_poses(frames)
        self.timestamps, self.poses = stamps[kept], None if poses is None else poses[kept]
        lists = (CAMERA_FILE, "timestamps.txt", "depth_timestamps.txt", "poses.txt")
        self._sources = [root / name for name in lists]
        self.warnings = list(dict.fromkeys(self.warnings))

    def _calibration(self) -> Calibration | None:
        return self._settings

    def _check_found(self, rgb: list[Path], depth: list[Path], flow: list[Path]) -> None:
        """Refuse what no frame can be made of, before anything is matched."""
        root, settings = self.root, self._settings
        if not depth:
            what = "no depth" if rgb else "no frames"
            raise InputError(
                f"{root / 'depth'}: {what}: expected a 16-bit PNG, .npy or .dpt for each PNG or "
                f"JPEG in rgb/. hybridvo needs metric depth, from a sensor, stereo or a network."
            )
        has_scale = self._given_scale or (settings is not None and settings.depth_scale)
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

    def _match_depth(self, frames: list[Path], files: list[Path]) -> dict[int, Path | None]:
        """Index of each frame that is kept -> its depth."""
        root, told = self.root, self.warnings
        stems = {path.stem for path in frames}
        stray = [path.name for path in files if path.stem not in stems]
        if len(stray) == len(files):
            stamps = self._stamps(root / "timestamps.txt", frames)
            depth_stamps = self._stamps(root / "depth_timestamps.txt", files)
            if stamps is not None and depth_stamps is not None:
                return {i: files[j] for i, j in depth_at(stamps, depth_stamps, root, told)}
        elif stray:
            left_out = f"{len(stray)} depth files without an image are left out"
            told.append(f"{root.name}: {left_out}: {shown(stray, 4)}.")
        hint = "Give both the same names, or their stamps: as names, or in (depth_)timestamps.txt."
        return dict(enumerate(match_files(frames, files, root / "depth", hint)))

    def _match_flow(self, frames: list[Path], files: list[Path]) -> Files:
        """Flow by equal names, else by order; one that led to a missing image is left out."""
        if not files:
            return [None] * len(frames)
        last = len(frames) - (len(files) == len(frames) - 1)  # none starts at the last image
        hint = "Give both the same names."
        matched = match_files(frames[:last], files, self.root / "flow", hint)
        matched += [None] * (len(frames) - last)
        is_numbered = all(path.stem.isascii() and path.stem.isdigit() for path in (*frames, *files))
        if not is_numbered or not {path.stem for path in frames} & {path.stem for path in files}:
            return matched
        numbers = [int(path.stem) for path in frames]
        usual = mode([b - a for a, b in itertools.pairwise(numbers)] or [1])
        # a flow file between two images, or an unusual step: an image is missing there
        known = sorted({*numbers, *(int(path.stem) for path in files)})
        follows = dict(itertools.pairwise(known))
        lost = [
            k
            for k, (a, b) in enumerate(itertools.pairwise(numbers))
            if matched[k] is not None and not follows[a] == b == a + usual
        ]
        for k in lost:
            matched[k] = None
        if lost:
            self.warnings.append(
                f"{self.name}: images are missing after {shown([frames[k].name for k in lost], 4)}"
                f": the flow files of these lead to the missing ones and are not used."
            )
        return matched

    def _stamps_and_poses(self, frames: list[Path]) -> tuple[np.ndarray, np.ndarray | None]:
        """Seconds of all frames and their ground-truth poses, where poses.txt has them."""
        told, pose_file, listed = self.warnings, self.root / "poses.txt", "timestamps.txt"
        truth = read_timed_poses(pose_file, told) if pose_file.exists() else None
        if truth and len(truth[1]) == len(frames) and not (self.root / listed).exists():
            return truth
        stamps = self._stamps(self.root / listed, frames)
        if stamps is None:
            fps = self._settings.fps if self._settings else None
            if fps is None:
                told.append(
                    f"{self.name}: no time stamps ({listed}, one a line); "
                    f"{self.frames_per_second:g} frames a second assumed."
                )
            stamps = np.arange(len(frames)) / (fps or self.frames_per_second)
        return stamps, truth and poses_at(stamps, *truth, str(pose_file), told)

    def _stamps(self, path: Path, files: list[Path]) -> np.ndarray | None:
        """Seconds from a list, else from file names that are stamps, where either has them."""
        if path.exists():
            stamps, _ = read_stamps(path, self.warnings)
            if len(stamps) != len(files):
                raise InputError(f"{path}: {len(stamps)} stamps for {len(files)} files.")
            return stamps
        try:
            values = np.array([float(file.stem) for file in files])
        except ValueError:
            return None
        # counters are no stamps
        is_stamp = all("." in file.stem for file in files) or stamp_unit(values)[0] != 1
        if not is_stamp or not np.isfinite(values).all():
            return None
        return to_seconds(values, f"{files[0].parent.name}/ (file names)", self.warnings)
