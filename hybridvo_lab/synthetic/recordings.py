"""Recordings of static scenes, from which pairs are made: their frames, and the motions that are
known between them.

The poses of most data sets are wrong by pixels, so each motion is refined on flow and depth, and
used only where it then explains the pair and agrees with what was stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import invert, rotation_angle
from hybridvo.core.results import StageFailed
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo.io.data.open import open_sequence
from hybridvo.io.data.resize import resize_frame
from hybridvo.solver.refine_flow import Selection, refine_pair

MIN_INLIER_RATIO = 0.5
"""Inlier ratio from which a recorded motion that was refined is used."""
MAX_ROTATION_DIFFERENCE_DEG = 1.0
"""Largest rotation between recorded and refined motion of a pair that is used."""


@dataclass(frozen=True)
class Source:
    """Frames ``start`` to ``stop`` of a recording below the data folder."""

    path: str
    start: int = 0
    stop: int | None = None
    # between the two frames of a pair; none: single frames only
    strides: tuple[int, ...] = ()
    # whether it serves as a static scene; moving objects are cut from all sources
    is_static: bool = True


SPLITS = {
    "train": {
        "rooms, begin": (Source("real_static/rooms_110", 0, 45, (1,)),),
        "rooms, middle": (Source("real_static/rooms_110", 45, 90, (1,)),),
        "living room": (Source("tum/redwood_livingroom_5", strides=(1, 2, 3)),),
        "desk, turning": (
            Source("tum/rgbd_dataset_freiburg1_rpy_100", strides=(1, 2)),
        ),
        "house": (Source("tartanair_v2/P000", strides=(1,)),),
    },
    "development": {
        "rooms, end": (Source("real_static/rooms_110", 93, 110, (1,)),),
        "desk": (
            Source("tum/rgbd_dataset_freiburg1_xyz_first10", strides=(1, 2, 3, 4)),
        ),
    },
    "test": {
        "street": (Source("real_dynamic/kitti06_stereo", strides=(1,)),),
        "scanned room": (Source("devices/scannet_sensreader", strides=(1,)),),
        "studio": (Source("real_dynamic/adt_slam_left"),),
        "people": (Source("real_dynamic/jvosf_two_people_moving"),),
        "robot": (Source("real_dynamic/jvosf_robot"),),
        "door": (Source("real_dynamic/jvosf_opening_door", is_static=False),),
        "cars": (Source("real_dynamic/kitti02_stereo", is_static=False),),
    },
}
"""The recordings of each place, by what they may be used for. No frame serves in two parts."""


class KnownMotion(NamedTuple):
    """Two frames of a recording, by their index, and the motion between them."""

    prev: int
    curr: int
    T_curr_prev: np.ndarray  # (4, 4)


@dataclass(frozen=True, eq=False)
class Recording:
    """The frames of a source, and the pairs of them whose motion is known."""

    source: Source
    frames: tuple[Frame, ...]
    pairs: tuple[KnownMotion, ...]


def load_recording(
    folder: Path, source: Source, pixels: int, margin: float = 1.0
) -> Recording:
    """Read a recording and refine its motions.

    Args:
        folder: the data folder.
        source: which frames.
        pixels: number of pixels of the images that are drawn from it.
        margin: fraction of each side of a frame that is drawn.

    Raises:
        InputError: it has no poses.
    """
    sequence = open_sequence(folder / source.path)
    poses = sequence.poses
    if poses is None:
        raise InputError(
            f"{source.path}: expected a recording with ground truth, got none."
        )
    stop = len(sequence) if source.stop is None else source.stop
    indices = range(source.start, stop)
    frames = [_resized(sequence.frame(i), pixels, margin) for i in indices]
    pairs = []
    for stride in source.strides:
        for i in range(len(frames) - stride):
            j = i + stride
            stated = invert(poses[indices[j]]) @ poses[indices[i]]
            T = _refined_motion(frames[i], frames[j], stated)
            if T is not None:
                pairs.append(KnownMotion(i, j, T))
    return Recording(source, tuple(frames), tuple(pairs))


def _resized(frame: Frame, pixels: int, margin: float) -> Frame:
    """A frame of which the middle, without its margin, has so many pixels."""
    height, width = frame.camera.shape
    scale = np.sqrt(pixels / (height * width)) / margin
    return resize_frame(
        frame, round(scale * height / 2) * 2, round(scale * width / 2) * 2
    )


def _refined_motion(
    prev: Frame, curr: Frame, T_stated: np.ndarray
) -> np.ndarray | None:
    """Refine a recorded motion, which is often wrong by pixels.

    None where both disagree.
    """
    pair = with_flow(FramePair(prev, curr, None), dis_flow())
    try:
        refined = refine_pair(pair, Selection(T_stated))
    except StageFailed:
        return None
    if not refined.usable or refined.inlier_ratio < MIN_INLIER_RATIO:
        return None
    difference = invert(T_stated) @ refined.T_curr_prev
    max_length = 0.02 + 0.15 * np.linalg.norm(T_stated[:3, 3])
    max_angle = np.radians(MAX_ROTATION_DIFFERENCE_DEG)
    if np.linalg.norm(difference[:3, 3]) > max_length:
        return None
    if rotation_angle(difference[:3, :3]) > max_angle:
        return None
    return refined.T_curr_prev
