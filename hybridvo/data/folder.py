"""A user's own data: camera.yaml, rgb/, depth/, and optionally flow/, mask/ and poses.txt."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from hybridvo.checks import as_number
from hybridvo.data import lists
from hybridvo.data.base import Files, Sequence
from hybridvo.data.camera_file import CAMERA_FILE, Calibration, read_camera_file
from hybridvo.data.foreign import recognised
from hybridvo.errors import InputError
from hybridvo.trajectory import stamp_unit, to_seconds


class FolderSequence(Sequence):
    """A user's own recording, in the layout that docs/own-data.md describes."""

    kind = "folder"
    depth_source = "file"
    markers = ((CAMERA_FILE,),)

    def _list_files(self) -> None:
        root = self.root
        settings = root / CAMERA_FILE
        self._settings = (
            read_camera_file(settings, self.warnings) if settings.exists() else None
        )
        if self._settings is None and self._given_camera is None:
            remedy = f"write one with 'hybridvo init {root}', or give --camera fx,fy,cx,cy or FILE"
            raise InputError(
                f"{root}: no {CAMERA_FILE}, and no camera is given: {remedy}."
            )
        if self._settings is not None and self._given_scale is None:
            self._given_scale = self._settings.depth_scale
        rgb = lists.sorted_files(root / "rgb", lists.IMAGES)
        depth = lists.sorted_files(root / "depth", (".png", ".npy", ".dpt"))
        flow = lists.sorted_files(root / "flow", (".flo", ".npy", ".png"))
        if not rgb:
            there = recognised(root) or lists.images_elsewhere(root, "rgb")
            told = f"no PNG or JPEG in rgb/; {there}"
            if not flow:
                raise InputError(f"{root}: no frames: {told}.")
            self._warn(f"{told}. Flow and depth alone are used")
        if not depth:
            expected = (
                "a 16-bit PNG, .npy or .dpt of metric depth for each image in rgb/"
            )
            there = lists.images_elsewhere(root, "depth")
            raise InputError(
                f"{root / 'depth'}: no frames: {there}; expected {expected}."
            )
        if flow and self._settings is not None and any(self._settings.distortion):
            raise InputError(
                f"{root}: flow/ is of distorted images: undistort them, or remove it."
            )
        if self._mask_folder is None and (root / "mask").is_dir():
            self._mask_folder = root / "mask"
        frames = rgb or depth
        flow_of = self._match_flow(frames, flow)
        stamps, poses = self._stamps_and_poses(frames)
        depth_of = self._match_depth(rgb, depth) if rgb else dict(enumerate(depth))
        kept = list(depth_of)
        self.rgb_files = [rgb[i] if rgb else None for i in kept]
        self.depth_files = [*depth_of.values()]
        self.flow_files = [flow_of[i] if i + 1 in depth_of else None for i in kept]
        self.timestamps = stamps[kept]
        self.poses = None if poses is None else poses[kept]
        self.warnings = list(dict.fromkeys(self.warnings))

    def _calibration(self) -> Calibration | None:
        return self._settings

    def _match_depth(
        self, frames: list[Path], files: list[Path]
    ) -> dict[int, Path | None]:
        """The depth of each frame that is kept, by the frame's index."""
        if not {path.stem for path in frames} & {path.stem for path in files}:
            stamps = self._stamps("timestamps.txt", frames)
            depth_stamps = self._stamps("depth_timestamps.txt", files)
            if stamps is not None and depth_stamps is not None:
                pairs = lists.depth_at(
                    stamps, depth_stamps, self.root, self.warnings
                )
                return {i: files[j] for i, j in pairs}
        hint = "Give both the same names, or their stamps: as names, or in (depth_)timestamps.txt."
        return dict(
            enumerate(lists.match_files(frames, files, self.root / "depth", hint))
        )

    def _match_flow(self, frames: list[Path], files: list[Path]) -> Files:
        """Flow by equal names, else by order, without flow that led to an image now missing."""
        if not files:
            return [None] * len(frames)
        where = self.root / "flow"
        hint = "Give both the same names."
        if len(files) == len(frames) - 1:  # none starts at the last image
            matched = [*lists.match_files(frames[:-1], files, where, hint), None]
        else:
            matched = lists.match_files(frames, files, where, hint)
        known = {path.stem for path in (*frames, *files)}
        if len(known) < len(frames) + len(files) and all(
            x.isdecimal() for x in known
        ):
            step = min(np.diff(sorted(map(int, known))), default=1)
            for k, (a, b) in enumerate(
                itertools.pairwise(int(path.stem) for path in frames)
            ):
                if matched[k] is not None and b - a != step:
                    matched[k] = None
                    self._warn(
                        f"the flow from {a} led to a missing image and is not used"
                    )
        return matched

    def _stamps_and_poses(
        self, frames: list[Path]
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """The stamps of all frames, s, and their true poses where poses.txt has them."""
        pose_file = self.root / "poses.txt"
        truth = (
            lists.read_timed_poses(pose_file, self.warnings)
            if pose_file.exists()
            else None
        )
        if (
            truth
            and len(truth[1]) == len(frames)
            and not (self.root / "timestamps.txt").exists()
        ):
            return truth
        stamps = self._stamps("timestamps.txt", frames)
        if stamps is None:
            fps = None if self._settings is None else self._settings.fps
            if fps is None:
                fps = self.frames_per_second
                self._warn(f"no time stamps; {fps:g} frames a second assumed")
            stamps = np.arange(len(frames)) / fps
        if truth is None:
            return stamps, None
        return stamps, lists.poses_at(stamps, *truth, pose_file, self.warnings)

    def _stamps(self, name: str, files: list[Path]) -> np.ndarray | None:
        """Stamps, s, from a list, else from file names; None where neither has them."""
        path = self.root / name
        if path.exists():
            stamps, _ = lists.read_stamps(path, self.warnings)
            if len(stamps) != len(files):
                raise InputError(
                    f"{path}: {len(stamps)} stamps for {len(files)} files."
                )
            return stamps
        values = np.array([as_number(file.stem) for file in files])
        # file names that only count frames are no stamps
        is_stamp = (
            all("." in file.stem for file in files) or stamp_unit(values)[0] != 1
        )
        if not is_stamp or not np.isfinite(values).all():
            return None
        return to_seconds(
            values, f"{files[0].parent.name}/ (file names)", self.warnings
        )
