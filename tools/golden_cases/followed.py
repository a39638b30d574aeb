"""Golden cases of what a tracker knows from earlier frames: memory, objects, sensors, places.

The frames are rendered at video rate, or with steps five times as long, with the noise of
structured light.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from bench.objects import MIN_OVERLAP, Seen, rendered

from golden_cases.figures import Record, labelled, record
from golden_cases.scenes import walk

FRAMES = 8
OBJECT_FRAMES = 6
SEED = 9001
"""Of the scenes."""
MOVERS = (
    ("heavy_two", "slow"),
    ("heavy_rigid", "slow"),
    ("escalator", "slow"),
    ("heavy_ten", "fast"),
)
OBJECTS = (("heavy_ten", "slow"), ("heavy_ten", "fast"), ("light", "fast"))
GYRO_HZ = 200.0
GYRO_BIAS = np.array([0.03, -0.02, 0.01])
"""Of the rates that are made, rad/s."""
GYRO_NOISE = 0.005
"""Their standard deviation, rad/s."""
GRAVITY = np.array([0.0, -9.81, 0.0])
"""What an accelerometer at rest reads in the world frame, whose y points down, m/s^2."""
DARK = 60
"""Divisor of the grey levels of images that show nothing."""
SHAKEN = 0.3
"""Standard deviation of its other readings, m/s^2."""
SCALES = (1.0, 1.04, 0.97, 1.02, 0.95, 1.03, 1.0, 0.98)
"""Factors on the depth of frames by a network."""
KIDNAPPED = (0, 1, 2, 3, 24, 25, 26, 2, 3, 4)
"""Frames of a walk: the camera is elsewhere for three, and comes back."""


def cases() -> dict[str, Callable[[int], list[Record]]]:
    """The cases, by their names."""
    runs: dict[str, Callable[[int], list[Record]]] = {}
    for family, rate in MOVERS:
        runs[f"movers_{family}_{rate}/hybrid"] = partial(movers, family, rate)
    for family, rate in OBJECTS:
        runs[f"objects_{family}_{rate}/hybrid"] = partial(objects, family, rate)
    runs["gyroscope/hybrid"] = with_gyroscope
    runs["gravity/hybrid"] = gravity
    runs["network_depth/hybrid"] = with_scales
    runs["kidnapped/hybrid"] = kidnapped
    return runs


@functools.cache
def scene(family: str, rate: str, frames: int) -> tuple[Seen, ...]:
    """The frames of a scene."""
    return tuple(rendered(family, rate, SEED, frames))


def movers(family: str, rate: str, seed: int) -> list[Record]:
    """Records of the steps of a tracker before a scene most of which moves."""
    from hybridvo import Odometry
    from hybridvo.core.geometry import invert

    seen = scene(family, rate, FRAMES)
    poses = [np.eye(4)]
    for each in seen[1:]:
        assert each.T_curr_prev is not None
        poses.append(poses[-1] @ invert(each.T_curr_prev))
    frames = [each.frame for each in seen]
    still = [static_depth(each) for each in seen]
    tracker = Odometry(seed=seed)
    steps = [tracker.track(replace(frame)) for frame in frames]
    return records(steps, frames, poses, still)


def static_depth(seen: Seen) -> np.ndarray:
    """(H, W) depth of a frame, 0 where something moves."""
    depth = np.array(seen.frame.depth)
    for known in seen.known.values():
        depth[known.mask] = 0
    return depth


def records(
    steps: Iterable[Any],
    frames: Sequence[Any],
    poses: Sequence[np.ndarray],
    depths: Sequence[Any],
) -> list[Record]:
    """Records of the motions of steps against the true poses (4, 4)."""
    from hybridvo import FramePair
    from hybridvo.core.geometry import invert

    numbers = {frame.index: k for k, frame in enumerate(frames)}
    found = []
    for k, step in enumerate(steps):
        if step.prev_index is None:
            continue
        start = numbers[step.prev_index]
        T_true = invert(poses[k]) @ poses[start]
        pair = FramePair(frames[start], frames[k], None)
        motion = step.motion.replace(T_curr_prev=step.T_curr_prev)
        found.append(record(motion, T_true, depths[start], pair))
    return found


def objects(family: str, rate: str, seed: int) -> list[Record]:
    """A record for each object of each frame; those that are not there count as well."""
    from bench.objects import WITH_OBJECTS

    from hybridvo import Odometry

    tracker = Odometry(options=WITH_OBJECTS, seed=seed)
    found = []
    for seen in scene(family, rate, OBJECT_FRAMES):
        step = tracker.track(replace(seen.frame))
        things = [thing for thing in step.objects if thing.is_seen]
        taken = set()
        for known in seen.known.values():
            overlaps = [overlap(thing.mask, known.mask) for thing in things]
            best = int(np.argmax(overlaps)) if overlaps else -1
            if best < 0 or overlaps[best] < MIN_OVERLAP:
                found.append(labelled("lost", error=1.0))
                continue
            taken.add(best)
            found.append(of_thing(things[best], overlaps[best]))
        others = [k for k in range(len(things)) if k not in taken]
        found += [labelled("false", error=1.0) for _ in others]
        hidden = len(step.objects) - len(things)
        found += [labelled("hidden") for _ in range(hidden)]
    return found


def overlap(mask: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks (H, W)."""
    return float(np.sum(mask & other) / max(np.sum(mask | other), 1))


def of_thing(thing: Any, overlap_of_it: float) -> Record:
    """The record of an object that was found."""
    std_mm = 1e3 * np.sqrt(max(np.trace(thing.covariance[:3, :3]), 0.0))
    confidence = min(max(thing.confidence, 1e-4), 1 - 1e-4)
    return labelled(
        f"{thing.status}, {thing.id}",
        error=1 - overlap_of_it,
        std=float(std_mm),
        log_odds=float(np.log(confidence / (1 - confidence))),
        inliers=float(thing.inlier_ratio),
    )


# -- sensors, networks, places -------------------------------------------------------------


def with_gyroscope(seed: int) -> list[Record]:
    """Records of a walk with a gyroscope, whose images show nothing in half of the frames."""
    path = walk("light", 6)
    frames = [
        replace(frame, rgb=np.asarray(frame.rgb) // DARK) if k % 4 > 1 else frame
        for k, frame in enumerate(path.frames)
    ]
    steps = steps_with_imu(frames, path.T_world_cam, seed)
    depths = [frame.depth for frame in path.exact]
    return records(steps, frames, path.T_world_cam, depths)


def gravity(seed: int) -> list[Record]:
    """Records of which way is down, after each frame of the same walk."""
    path = walk("light", 6)
    found = []
    frames = [replace(frame) for frame in path.frames]
    for k, step in enumerate(steps_with_imu(frames, path.T_world_cam, seed)):
        if step.gravity is None:
            continue
        true_down = path.T_world_cam[0][:3, :3].T @ np.array([0.0, 1.0, 0.0])
        cosine = float(np.clip(step.gravity.direction @ true_down, -1, 1))
        error = float(np.degrees(np.arccos(cosine)))
        found.append(
            labelled(f"frame {k}", error=error, std=1e3 * step.gravity.std)
        )
    return found


def steps_with_imu(
    frames: Sequence[Any], poses: np.ndarray, seed: int
) -> Iterator[Any]:
    """Track frames with samples of a gyroscope and an accelerometer that fit their poses."""
    from hybridvo import ImuSamples, Odometry
    from hybridvo.core.geometry import invert, se3_log

    rng = np.random.default_rng(seed)
    tracker = Odometry(seed=seed)
    for k, frame in enumerate(frames):
        samples = None
        if k:
            before = frames[k - 1].timestamp
            passed = frame.timestamp - before
            count = max(int(passed * GYRO_HZ), 1)
            turn = invert(poses[k - 1]) @ poses[k]
            rate = se3_log(turn)[3:] / passed + GYRO_BIAS
            rates = rate + GYRO_NOISE * rng.normal(size=(count, 3))
            upwards = poses[k][:3, :3].T @ GRAVITY
            pushed = upwards + SHAKEN * rng.normal(size=(count, 3))
            stamps = before + passed * np.arange(count) / count
            samples = ImuSamples(stamps, rates, accelerations=pushed)
        yield tracker.track(frame, imu=samples)


def with_scales(seed: int) -> list[Record]:
    """Records of a walk whose depth has another scale in each frame."""
    from hybridvo import Odometry, Options
    from hybridvo.core.options import DepthOptions

    path = walk("light", 10)
    frames = [
        replace(frame, depth=np.asarray(frame.depth) * factor)
        for frame, factor in zip(path.frames, SCALES, strict=False)
    ]
    options = Options(depth=DepthOptions(scale_per_frame="on"))
    tracker = Odometry(options=options, seed=seed)
    steps = [tracker.track(frame) for frame in frames]
    depths = [frame.depth for frame in path.exact]
    found = records(steps, path.frames, path.T_world_cam, depths)
    scales = [
        labelled(
            "scale", error=abs(np.log(step.depth_scale)), std=step.scale_change
        )
        for step in steps
    ]
    return found + scales


def kidnapped(seed: int) -> list[Record]:
    """Records of a walk that goes on elsewhere for three frames, and then where it was."""
    from hybridvo import Odometry

    path = walk("light", 6)
    count = len(path.frames)
    chosen = [min(k, count - 1) for k in KIDNAPPED]
    frames = [
        replace(path.frames[k], index=index, timestamp=index / 30.0)
        for index, k in enumerate(chosen)
    ]
    tracker = Odometry(seed=seed)
    steps = [tracker.track(frame) for frame in frames]
    poses = [path.T_world_cam[k] for k in chosen]
    depths = [path.exact[k].depth for k in chosen]
    return records(steps, frames, poses, depths)
