"""A user's own data: camera.yaml, rgb/, depth/, and optionally flow/, mask/ and poses.txt."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import (
    CAMERA_FILE,
    Calibration,
    is_unfilled,
    read_camera_file,
)
from hybridvo.io.data.foreign import recognised
from hybridvo.io.data.sequence import Files, Sequence

DEPTH_SUFFIXES = (".png", ".npy", ".dpt")
FLOW_SUFFIXES = (".flo", ".npy", ".png")


class FolderSequence(Sequence):
    """A user's own recording, in the layout that docs/own-data.md describes."""

    kind = "folder"
    choices = ("depth_offset_ms",)
    depth_source = "file"
    markers: tuple[tuple[str, ...], ...] = ((CAMERA_FILE,),)
    image_folder = "rgb"
    """The folder of the images."""

    def _list_files(self) -> None:
        root = self.root
        self._settings = self._read_settings()
        rgb = lists.sorted_files(root / self.image_folder, lists.IMAGES)
        depth = lists.sorted_files(root / "depth", DEPTH_SUFFIXES)
        flow = lists.sorted_files(root / "flow", FLOW_SUFFIXES)
        self._check_content(rgb, depth, flow)
        if self._mask_folder is None and (root / "mask").is_dir():
            self._mask_folder = root / "mask"

        frames = rgb or depth
        flow_of = self._match_flow(frames, flow)
        stamps, poses = self._stamps_and_poses(frames)
        depth_of: dict[int, Path | None] = dict(enumerate(depth))
        if rgb and not depth:
            # a network predicts it
            depth_of = dict.fromkeys(range(len(rgb)))
        elif rgb:
            depth_of = self._match_depth(rgb, depth)

        kept = list(depth_of)
        self.rgb_files = [rgb[i] if rgb else None for i in kept]
        self.depth_files = list(depth_of.values())
        self.flow_files = [flow_of[i] if i + 1 in depth_of else None for i in kept]
        self.timestamps = stamps[kept]
        self.poses = None if poses is None else poses[kept]
        # Stamps may be read twice, and warn twice.
        self.warnings = list(dict.fromkeys(self.warnings))

    def _calibration(self) -> Calibration | None:
        return self._settings

    def _read_settings(self) -> Calibration | None:
        """Read camera.yaml; None where it is missing, or not filled in, and a camera is given."""
        path = self.root / CAMERA_FILE
        is_given = self._given_camera is not None
        if is_given and (not path.exists() or is_unfilled(path)):
            return None
        if not path.exists():
            remedy = (
                f"write one with 'hybridvo init {self.root}', "
                "or give --camera fx,fy,cx,cy or FILE"
            )
            raise InputError(
                f"{self.root}: no {CAMERA_FILE}, and no camera is given: {remedy}."
            )
        settings = read_camera_file(path, self.warnings)
        if self._given_scale is None:
            self._given_scale = settings.depth_scale
        return settings

    def _check_content(
        self, rgb: list[Path], depth: list[Path], flow: list[Path]
    ) -> None:
        """Refuse a folder without depth, or without images and flow."""
        root = self.root
        if not rgb:
            there = recognised(root) or lists.images_elsewhere(root, "rgb")
            problem = f"no PNG or JPEG in rgb/; {there}"
            if not flow:
                raise InputError(f"{root}: no frames: {problem}.")
            self._warn(f"{problem}. Flow and depth alone are used")
        if not depth and self._needs_depth:
            there = lists.images_elsewhere(root, "depth")
            expected = (
                "a 16-bit PNG, .npy or .dpt of metric depth for each image in rgb/"
            )
            raise InputError(
                f"{root / 'depth'}: no frames: {there}; expected {expected}."
            )
        settings = self._settings
        if flow and settings is not None and any(settings.distortion):
            raise InputError(
                f"{root}: flow/ is of distorted images: undistort them, or remove it."
            )

    def _match_depth(
        self, frames: list[Path], files: list[Path]
    ) -> dict[int, Path | None]:
        """Return the depth map of each frame that is kept, by the frame's place."""
        frame_names = {path.stem for path in frames}
        depth_names = {path.stem for path in files}
        if frame_names.isdisjoint(depth_names):
            known = lists.known_stamps
            stamps = known(frames, self.root / "timestamps.txt", self.warnings)
            depth_list = self.root / "depth_timestamps.txt"
            depth_stamps = known(files, depth_list, self.warnings)
            if stamps is not None and depth_stamps is not None:
                depth_stamps = self._by_colours_clock(depth_stamps)
                pairs = lists.depth_at(
                    stamps, depth_stamps, self.root, self.warnings
                )
                self.depth_timestamps = depth_stamps[[j for _, j in pairs]]
                return {i: files[j] for i, j in pairs}
        hint = "Give both the same names, or their stamps: as names, or in (depth_)timestamps.txt."
        where = self.root / "depth"
        return dict(enumerate(lists.match_files(frames, files, where, hint)))

    def _match_flow(self, frames: list[Path], files: list[Path]) -> Files:
        """Match flow by equal names, else by order.

        Flow that leads to an image which is missing is left out.
        """
        if not files:
            return [None] * len(frames)
        where = self.root / "flow"
        hint = "Give both the same names."
        if len(files) == len(frames) - 1:
            # No flow starts at the last image.
            matched = lists.match_files(frames[:-1], files, where, hint)
            matched.append(None)
        else:
            matched = lists.match_files(frames, files, where, hint)
        if _share_frame_numbers(frames, files):
            self._drop_flow_over_gaps(frames, files, matched)
        return matched

    def _drop_flow_over_gaps(
        self, frames: list[Path], files: list[Path], matched: Files
    ) -> None:
        """Drop the flow of frames whose successor is missing, by the frame numbers."""
        names = {path.stem for path in (*frames, *files)}
        numbers = sorted(int(name) for name in names)
        step = min(np.diff(numbers), default=1)
        neighbours = itertools.pairwise(int(path.stem) for path in frames)
        for k, (number, following) in enumerate(neighbours):
            if matched[k] is not None and following - number != step:
                matched[k] = None
                self._warn(
                    f"the flow from {number} led to a missing image and is not used"
                )

    def _stamps_and_poses(
        self, frames: list[Path]
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the stamps of all frames, seconds, and their true poses, if there are any."""
        pose_file = self.root / "poses.txt"
        if not pose_file.exists():
            return self._frame_stamps(frames), None
        pose_stamps, poses = lists.read_timed_poses(pose_file, self.warnings)
        has_stamps = (self.root / "timestamps.txt").exists()
        if len(poses) == len(frames) and not has_stamps:
            return pose_stamps, poses
        stamps = self._frame_stamps(frames)
        matched = lists.poses_at(
            stamps, pose_stamps, poses, pose_file, self.warnings
        )
        return stamps, matched

    def _frame_stamps(self, frames: list[Path]) -> np.ndarray:
        """Return the stamps of all frames, seconds, at a frame rate where none are known."""
        fps = None if self._settings is None else self._settings.fps
        return lists.stamps_of_files(self.root, frames, fps, self.warnings)


def _share_frame_numbers(frames: list[Path], files: list[Path]) -> bool:
    """Return whether images and flow have frame numbers as names, some of which agree."""
    names = {path.stem for path in (*frames, *files)}
    some_agree = len(names) < len(frames) + len(files)
    return some_agree and all(name.isdecimal() for name in names)
