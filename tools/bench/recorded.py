"""The benchmark's tracked frames: ours beside the odometry of others, pair by pair.

Every pair of consecutive frames is tracked by ``hybrid`` and ``hybrid-flow``, then registered by
OpenCV's RGB-D odometry and by small_gicp; its DIS flow is computed once more, alone. So all of
them meet the same load of the machine. RGB-D odometry is called through its own function, with
the depth prepared before: no flow, no covariance and no check of ours is in its time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from known_pairs import rendered
from measuring import digits, methods_here, proportion, timed

from hybridvo import Frame, FramePair, Odometry, open_sequence
from hybridvo.flow.providers import dis_flow
from hybridvo_lab import baselines
from hybridvo_lab.baselines.correspondences import depth_in_range
from hybridvo_lab.baselines.images import PairImages, align_opencv

RECORDINGS = (
    "tripod/corridor",
    "tripod/lab_close",
    "tum/rgbd_dataset_freiburg1_rpy_100",
    "tum/redwood_livingroom_5",
    "real_static/rooms_110",
    "tartanair_v2/P000",
)
"""Below the data folder; people move in the first two."""
STATIC = "static"
"""The rendered scene in which nothing moves but the camera."""
STATIC_SIZE = (480, 640)
STATIC_FRAMES = 20
OURS = ("hybrid", "hybrid-flow")
"""The methods that track."""
RGBD = "opencv-rgbd"
CLOUDS = "small-gicp"
DIS = "dis alone"
FIRST = 1
"""The pairs that do not count: the first one pays for what is done once."""
BEYOND_M = 1.0
"""How much farther than the farthest point OpenCV may look, metres."""

Work = Callable[[], Any]


class Run(NamedTuple):
    """One run over a recording."""

    ms: dict[str, list[float]]  # of each pair, by the name of what was timed
    ok: dict[str, list[bool]]  # of each motion, by our method


def recorded(data: Path, repeats: int) -> dict[str, Any]:
    """Times of each recording that is there, and of the static scene.

    Args:
        data: the folder of the recordings.
        repeats: runs over each of them, of which the median counts.
    """
    rows = {}
    for name in RECORDINGS:
        if (data / name).is_dir():
            rows[name] = row(list(open_sequence(data / name)), repeats)
    scene = rendered(STATIC, 0, STATIC_SIZE, STATIC_FRAMES)
    rows[STATIC] = row(list(scene), repeats)
    return rows


def row(frames: list[Frame], repeats: int) -> dict[str, Any]:
    """Figures of a recording over several runs."""
    ready = methods_here((RGBD, CLOUDS)).ready
    runs = [run(frames, ready) for _ in range(repeats)]
    size = list(frames[0].camera.shape)
    return {"frames": len(frames), "size": size} | figures(runs)


def run(frames: list[Frame], ready: list[str]) -> Run:
    """Track frames once; ``ready``: the methods of others that can run here."""
    # new ones, of which nothing is known from the run before
    fresh = [replace(frame) for frame in frames]
    trackers = {method: Odometry(method=method) for method in OURS}
    for tracker in trackers.values():
        tracker.warm_up()
        tracker.track(fresh[0])
    clouds = Clouds()
    found = Run({}, {})
    for prev, curr in pairwise(fresh):
        for method, tracker in trackers.items():
            step, ms = timed(partial(tracker.track, curr))
            found.ms.setdefault(method, []).append(ms)
            found.ok.setdefault(method, []).append(step.ok)
        works = {RGBD: by_images, CLOUDS: clouds.register}
        works = {name: works[name] for name in ready} | {DIS: flow}
        for name, prepare in works.items():
            _, ms = timed(prepare(prev, curr))
            found.ms.setdefault(name, []).append(ms)
    return found


def figures(runs: list[Run]) -> dict[str, Any]:
    """Median and 95th percentile of the times, each the median over the runs.

    ``against_rgbd``: how many times as fast as OpenCV's RGB-D odometry ``hybrid`` is.
    """
    ms = {}
    for name in runs[0].ms:
        times = [one.ms[name][FIRST:] for one in runs]
        medians = [np.median(each) for each in times]
        late = [np.percentile(each, 95) for each in times]
        ms[name] = {
            "median": digits(np.median(medians)),
            "p95": digits(np.median(late)),
        }
    # answers do not differ from run to run
    ok = runs[-1].ok
    result: dict[str, Any] = {
        "ok": {name: proportion(sum(each), len(each)) for name, each in ok.items()},
        "ms": ms,
    }
    if RGBD in ms:
        ratio = ms[RGBD]["median"] / ms[OURS[0]]["median"]
        result["against_rgbd"] = digits(ratio)
    return result


# --- the odometry of others -------------------------------------------------------


def by_images(prev: Frame, curr: Frame) -> Work:
    """OpenCV's RGB-D odometry of a pair, ready to be called."""
    images = PairImages(
        [prev.rgb, curr.rgb], [known_depth(prev), known_depth(curr)]
    )
    farthest = float(np.nanmax(images.depth[0]))
    return partial(align_opencv, images, prev.camera, farthest + BEYOND_M)


def known_depth(frame: Frame) -> np.ndarray:
    """The depth (H, W) of a frame, metres, NaN where it is unknown."""
    is_known = depth_in_range(frame.depth)
    return np.where(is_known, frame.depth, np.nan).astype(np.float32)


def flow(prev: Frame, curr: Frame) -> Work:
    """The DIS flow of a pair, there and back, ready to be called."""
    return partial(dis_flow(), prev, curr)


class Clouds:
    """small_gicp from pair to pair, each from the motion before."""

    def __init__(self) -> None:
        self.T_last: np.ndarray | None = None

    def register(self, prev: Frame, curr: Frame) -> Work:
        """The registration of a pair, ready to be called."""
        return partial(self._register, FramePair(prev, curr, None))

    def _register(self, pair: FramePair) -> None:
        motion = baselines.estimate(CLOUDS, pair, start=self.T_last)
        self.T_last = motion.T_curr_prev if motion.usable else None
