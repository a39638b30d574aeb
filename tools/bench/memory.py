"""What a tracker's memory of what was static is worth, and how it errs.

    python tools/benchmark.py memory --out docs/results/memory.json

``standing``: people before a camera on a tripod; frames that need flow, the largest error of a
position, processor time. ``clips``: steps of a camera that moves among things that move. A step
is wrong where its ego flow over the static pixels errs by more than 1.5 px, by more than a tenth
of the true ego flow, and by more than 2.5 times as much as a fit inside the true static mask.
``inverted``: what was believed static and what was believed to move change places after three
frames. Each with the memory and without.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from measuring import (
    digits,
    ego_flow_error,
    parser_of,
    provenance,
    ready_tracker,
    store,
)

from hybridvo import Frame, FramePair, open_sequence, refine
from hybridvo.core.belief import Belief
from hybridvo.core.geometry import invert
from hybridvo.core.options import TrackOptions
from hybridvo.flow.providers import dis_flow, with_flow
from hybridvo_lab.training.validation import area_under_curve

STANDING = ("corridor", "lab_close", "lab_far", "books", "boxes", "fruit")
"""Recordings below ``tripod`` of the data folder."""
CLIPS = ("kitchen", "box")
"""Recordings below ``semi_real_clips``: first words of the names of clips."""
MODES = ("off", "auto")
"""Values of ``track.memory``."""
LEAST_WRONG_PX = 1.5
WRONG_SHARE = 0.1
WRONG_TIMES = 2.5
MOST_REACHED_PX = 7.0
"""Limits of a wrong step; that by the fit inside the true mask is at most the last one."""
MOVES = 0.005
"""Fraction of the view from which something moves in a pair."""
EDGE_PX = 5
"""Width of what is left out around things that move, px."""
INVERTED_AT = 2
"""Frame after which the belief is inverted."""
FRAMES_AFTER = 5
"""Frames later in which a tracker must have found back."""
RECOVERED_CM = 1.0
"""Distance from the path without the inversion up to which it has."""
SURE = 7.0
"""Certainty of the inverted belief."""


class Tracked(NamedTuple):
    """Steps of a tracker, with the processor time of each."""

    steps: list[Any]
    ms: list[float]


def build_parser() -> argparse.ArgumentParser:
    parser = parser_of(__file__, __doc__)
    add = parser.add_argument
    add("--data", type=Path, default=Path("../shared/data"), metavar="DIR")
    add("--out", type=Path, metavar="FILE")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = build_parser().parse_args(argv)
    result = provenance("benchmark.py memory", argv)
    parts = {"standing": standing, "clips": clips, "inverted": inverted}
    for name, part in parts.items():
        result[name] = []
        for row in part(args.data):
            result[name].append(row)
            print(name, row, flush=True)
    store(args.out, result)
    return 0


def track(frames: list[Frame], mode: str, inverts: bool = False) -> Tracked:
    """Track frames; ``inverts``: the belief is turned into its opposite on the way."""
    odometry = ready_tracker(TrackOptions(memory=mode))
    tracked = Tracked([], [])
    for index, frame in enumerate(frames):
        started = time.process_time()
        tracked.steps.append(odometry.track(frame))
        tracked.ms.append(1e3 * (time.process_time() - started))
        memory = odometry.state.memory
        if inverts and index == INVERTED_AT and memory is not None:
            opposite = Belief(-memory.belief.log_odds, SURE)
            wrong = replace(memory, belief=opposite)
            odometry.state = replace(odometry.state, memory=wrong)
    return tracked


def uses_flow(step: Any) -> bool:
    """Whether the motion of a step rests on flow."""
    return "flow" in step.motion.terms


# -- a camera that stands ------------------------------------------------------------


def standing(data: Path) -> Iterator[dict[str, Any]]:
    """A row for each recording of a tripod and mode."""
    for name in STANDING:
        sequence = open_sequence(data / "tripod" / name)
        frames = [sequence.frame(k) for k in range(len(sequence))]
        for mode in MODES:
            tracked = track(frames, mode)
            poses = np.stack([step.T_world_cam for step in tracked.steps])
            distances = np.linalg.norm(poses[:, :3, 3], axis=1)
            steps = tracked.steps[1:]
            yield {
                "recording": name,
                "memory": mode,
                "steps": len(steps),
                "with_flow": sum(map(uses_flow, steps)),
                "not_ok": sum(not step.ok for step in steps),
                "worst_cm": digits(100 * distances.max()),
                "ms_median": digits(np.median(tracked.ms[1:])),
            }


# -- a camera that moves among things that move --------------------------------------


class Judged(NamedTuple):
    """A step of a clip, against the truth."""

    is_wrong: bool
    is_ok: bool
    has_flow: bool
    probability: float


def clips(data: Path) -> Iterator[dict[str, Any]]:
    """A row for each recording and mode, over all of its clips."""
    for name in CLIPS:
        for mode in MODES:
            steps = [
                step
                for folder in clip_folders(data, name)
                for step in judged_steps(folder, mode)
            ]
            yield {"recording": name, "memory": mode, **counted(steps)}


def clip_folders(data: Path, recording: str) -> list[Path]:
    """Folders of the clips of a recording."""
    cameras = (data / "semi_real_clips").glob(f"{recording}_*/camera.yaml")
    return sorted(camera.parent for camera in cameras)


def judged_steps(folder: Path, mode: str) -> Iterator[Judged]:
    """Steps of a clip in which something moves."""
    sequence = open_sequence(folder)
    assert sequence.poses is not None
    poses = np.asarray(sequence.poses)
    frames = [sequence.frame(k) for k in range(len(sequence))]
    return judged(
        frames, poses, lambda start, _: moving_pixels(folder, start), mode
    )


def judged(
    frames: list[Frame],
    poses: np.ndarray,
    moving_in: Callable[[int, int], np.ndarray | None],
    mode: str,
) -> Iterator[Judged]:
    """Steps of a tracker in which something moves, against the truth.

    Args:
        frames: of a camera.
        poses: (N, 4, 4) its true poses.
        moving_in: returns which pixels (H, W) of one frame show something that moves until another
            one, by their numbers; None where that is not known.
        mode: of the memory.
    """
    for index, step in enumerate(track(frames, mode).steps[1:], start=1):
        start = step.prev_index
        moving = moving_in(start, index)
        if moving is None or moving.mean() <= MOVES:
            continue
        T_true = invert(poses[index]) @ poses[start]
        pair = FramePair(frames[start], frames[index], None)
        limit = wrong_limit(pair, moving, T_true)
        error = static_error(pair, moving, invert(step.T_prev_curr), T_true)
        yield Judged(
            error > limit, step.ok, uses_flow(step), step.motion.probability
        )


def counted(steps: Sequence[Judged]) -> dict[str, Any]:
    """How many steps are wrong, and how surely that shows."""
    wrong = [step for step in steps if step.is_wrong]
    right = [step for step in steps if not step.is_wrong]
    probabilities = np.array([step.probability for step in steps])
    is_right = np.array([not step.is_wrong for step in steps])
    auroc = None
    if wrong and right:
        auroc = digits(area_under_curve(probabilities, is_right))
    return {
        "steps": len(steps),
        "wrong": len(wrong),
        "wrong_ok": sum(step.is_ok for step in wrong),
        "right_not_ok": sum(not step.is_ok for step in right),
        "with_flow": sum(step.has_flow for step in steps),
        "auroc": auroc,
    }


def moving_pixels(folder: Path, index: int) -> np.ndarray:
    """(H, W) which pixels of a frame show something that moves, by the truth."""
    image = cv2.imread(
        str(folder / "dynamic" / f"{index:04d}.png"), cv2.IMREAD_GRAYSCALE
    )
    return np.asarray(image) > 0


def static_error(
    pair: FramePair, moving: np.ndarray, T: np.ndarray, T_true: np.ndarray
) -> float:
    """Mean distance of two ego flows over the static pixels, px."""
    edges = np.ones((EDGE_PX, EDGE_PX), np.uint8)
    near = cv2.dilate(moving.astype(np.uint8), edges) > 0
    depth = np.where(near, 0, pair.prev.depth)
    return ego_flow_error(T, T_true, depth, pair)


def wrong_limit(pair: FramePair, moving: np.ndarray, T_true: np.ndarray) -> float:
    """Error from which the motion of a pair is wrong, px."""
    by_flow = with_flow(pair, dis_flow())
    fitted = refine(by_flow, weights=(~moving).astype(np.float32))
    reached = static_error(pair, moving, fitted.T_curr_prev, T_true)
    true_flow = static_error(pair, moving, np.eye(4), T_true)
    by_fit = min(WRONG_TIMES * reached, MOST_REACHED_PX)
    return max(LEAST_WRONG_PX, WRONG_SHARE * true_flow, by_fit)


# -- a belief that is wrong ----------------------------------------------------------


def inverted(data: Path) -> Iterator[dict[str, Any]]:
    """A row for each recording and clip: does the tracker find back?"""
    folders = [data / "tripod" / name for name in STANDING]
    for recording in CLIPS:
        folders += clip_folders(data, recording)
    for folder in folders:
        sequence = open_sequence(folder)
        count = min(len(sequence), INVERTED_AT + FRAMES_AFTER + 1)
        frames = [sequence.frame(k) for k in range(count)]
        plain = track(frames, "auto").steps[-1].T_world_cam
        steps = track(frames, "auto", inverts=True).steps
        apart = np.linalg.norm(steps[-1].T_world_cam[:3, 3] - plain[:3, 3])
        doubted = sum(not step.ok for step in steps[INVERTED_AT + 1 :])
        yield {
            "recording": folder.name,
            "apart_cm": digits(100 * apart),
            "not_ok": doubted,
            "recovers": bool(100 * apart <= RECOVERED_CM),
        }
