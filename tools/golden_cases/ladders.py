"""Golden cases in which an input gets worse rung by rung, until an estimator says so.

A limit of ``hybridvo/calibration.py`` lies between two rungs of its ladder. Where the
limit moves by a third, another rung is the first that is flagged.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from golden_cases.figures import Record, labelled, record
from golden_cases.recordings import RECORDINGS
from golden_cases.scenes import (
    SIZE,
    Known,
    made_pair,
    made_scene,
    motion,
    scene_pair,
    scene_pairs,
    still_pair,
)

Run = Callable[[int], list[Record]]


def answered(pairs: Sequence[Known], method: str, seed: int) -> list[Record]:
    """Return a record of every rung, with the flow that its pair has."""
    from hybridvo import estimate

    found = []
    for known in pairs:
        answer = estimate(known.pair, method=method, seed=seed)
        found.append(record(answer, known.T_curr_prev, known.depth, known.pair))
    return found


# -- flow that is not that of the images ---------------------------------------

BASELINE = "pnp-ransac-tuned"
LATE_NOISE = 0.01
"""Noise of the late depth, relative."""
LATE_STEPS = np.arange(0.2, 3.0, 0.12)
"""Steps by which a depth map is taken later than its image."""
SPOTS = tuple(range(5, 20))
"""White pixels of an image that is grey elsewhere."""
FLOW_SCALES = (0.05, 0.12, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
SLOW_SHIFTS_PX = tuple(np.arange(0.3, 1.1, 0.06))
FAST_SHIFTS_PX = tuple(np.arange(0.5, 3.0, 0.15))
"""How far a flow leads away from the images of a slow and of a fast camera."""


@functools.cache
def moving_pairs() -> tuple[Known, ...]:
    """Pairs of static scenes from a camera that moves clearly."""
    return static_pair(900, 1.0), static_pair(901, 1.0)


def scaled_flow(seed: int) -> list[Record]:
    """A flow of an ever larger part of its length: the lower rungs are none of the images."""
    pairs = []
    for known in moving_pairs():
        for scale in FLOW_SCALES:
            flow = np.float32(scale) * known.pair.flow
            pairs.append(known._replace(pair=replace(known.pair, flow=flow)))
    return answered(pairs, "classical", seed)


def grey_noise_of_negated_flow(seed: int) -> list[Record]:
    """A negated flow between images that get noisier: the last rungs cannot tell any more."""
    pairs = []
    for known in moving_pairs():
        flow = -known.pair.flow
        for std in (5, 8, 12, 16, 20, 25, 30, 36, 44, 54, 66, 80):
            pair = with_grey_noise(known.pair, std)
            pairs.append(known._replace(pair=replace(pair, flow=flow)))
    return answered(pairs, "classical", seed)


def with_grey_noise(pair: Any, std: float) -> Any:
    """Return a pair with noisier images; only the strength differs from rung to rung."""
    from hybridvo_lab.synthetic.slow_scenes import noisy_image

    rng = np.random.default_rng(5)
    prev, curr = (
        replace(frame, rgb=noisy_image(frame.rgb, rng, std))
        for frame in (pair.prev, pair.curr)
    )
    return replace(pair, prev=prev, curr=curr)


def turned_flow(
    steps: float, shifts_px: Sequence[float], seed: int
) -> list[Record]:
    """A flow of a camera that turns ever farther away from that of the images."""
    known = static_pair(901, steps)
    pairs = [turned(known, shift) for shift in shifts_px]
    return answered(pairs, "classical", seed)


@functools.cache
def static_pair(seed: int, steps: float) -> Known:
    """Return a pair of a static scene from a camera that goes some of the scene's steps."""
    scene, ways = static_scene(seed, (0.0, steps))
    return with_true_flow(scene.render(0), scene.render(1), ways[1])


def static_scene(seed: int, steps: Sequence[float]) -> tuple[Any, list[np.ndarray]]:
    """Return a static scene seen after some of its steps, and the motions (4, 4) there."""
    from hybridvo.core.geometry import se3_exp, se3_log

    scene = made_scene("static", seed, 2, SIZE)
    step = se3_log(motion(scene.T_world_cam, 0, 1))
    ways = [se3_exp(length * step) for length in steps]
    poses = [scene.T_world_cam[0] @ np.linalg.inv(T) for T in ways]
    return replace(scene, T_world_cam=np.array(poses)), ways


def turned(known: Known, shift_px: float) -> Known:
    """Return a pair whose flow is that of a camera that turns farther by some pixels."""
    from hybridvo.core.geometry import ego_flow, se3_exp

    pair = known.pair
    camera = pair.prev.camera
    turn = se3_exp(np.array([0, 0, 0, 0, shift_px / camera.fx, 0]))
    T = turn @ known.T_curr_prev
    flow = ego_flow(known.depth, T, camera, camera)
    return known._replace(pair=replace(pair, flow=flow.astype(np.float32)))


def turned_flow_of_noisy_images(seed: int) -> list[Record]:
    """Images that contradict a flow, noisier from rung to rung: they stop to lead away."""
    pairs = []
    for known in moving_pairs():
        wrong = turned(known, 1.2)
        for std in np.geomspace(6.0, 80.0, 14):
            pair = with_grey_noise(wrong.pair, std)
            pairs.append(wrong._replace(pair=pair))
    return answered(pairs, "classical", seed)


# -- depth that is not that of the motion --------------------------------------


def late_noisy_depth(seed: int) -> list[Record]:
    """A second depth map, noisy, that is taken later and later than its image."""
    rng = np.random.default_rng(1)
    known = []
    for late in late_pairs():
        curr = late.pair.curr
        factor = 1 + LATE_NOISE * rng.standard_normal(curr.depth.shape)
        depth = (curr.depth * factor).astype(np.float32)
        pair = replace(late.pair, curr=replace(curr, depth=depth))
        known.append(late._replace(pair=pair))
    return answered(known, "classical", seed)


@functools.cache
def late_pairs() -> list[Known]:
    """Return pairs whose second depth map is taken later than its image."""
    known = static_pair(900, 1.0)
    scene, _ = static_scene(900, 1.0 + LATE_STEPS)
    found = []
    for index in range(len(LATE_STEPS)):
        curr = replace(known.pair.curr, depth=scene.depth(index))
        found.append(known._replace(pair=replace(known.pair, curr=curr)))
    return found


def with_true_flow(prev: Any, curr: Any, T: np.ndarray) -> Known:
    """Return two frames of a static scene with their true flow."""
    from hybridvo import FramePair
    from hybridvo.core.geometry import ego_flow

    flow = ego_flow(prev.depth, T, prev.camera, curr.camera)
    pair = FramePair(prev, curr, flow.astype(np.float32), flow_source="file")
    return Known(pair, T, prev.depth)


def noisy_depth_of_frozen_images(seed: int) -> list[Record]:
    """Images handed out twice, beside depth maps that get noisier: the last tell nothing."""
    from hybridvo_lab.synthetic.slow_scenes import structured_light

    pairs = []
    for scene_seed in (900, 901):
        known = static_pair(scene_seed, 0.8)
        prev = known.pair.prev
        curr = known.pair.curr
        for strength in np.geomspace(0.0001, 0.01, 16):
            # only the strength of the noise differs from rung to rung
            rng = np.random.default_rng(7)
            depths = [
                structured_light(frame.depth, rng, strength)
                for frame in (prev, curr)
            ]
            pair = with_true_flow(
                replace(prev, depth=depths[0]),
                replace(curr, depth=depths[1], rgb=prev.rgb),
                np.eye(4),
            ).pair
            pairs.append(known._replace(pair=pair))
    return answered(pairs, "classical", seed)


def depth_spread(seed: int) -> list[Record]:
    """A second depth map that differs at random, more from rung to rung."""
    known = still_pair(1, 0.2)
    curr = known.pair.curr
    pairs = []
    for spread in (0.06, 0.085, 0.125, 0.18, 0.22, 0.28, 0.4, 0.52):
        rng = np.random.default_rng(8)
        # median absolute deviation of a normal distribution: 0.6745 of its std
        noise = spread / 0.6745 * rng.standard_normal(curr.depth.shape)
        depth = (curr.depth * np.exp(noise)).astype(np.float32)
        pair = replace(known.pair, curr=replace(curr, depth=depth))
        pairs.append(known._replace(pair=pair))
    return answered(pairs, "classical", seed)


def depth_scale(seed: int) -> list[Record]:
    """A second depth map in another unit, farther off from rung to rung."""
    known = still_pair(2, 0.2)
    curr = known.pair.curr
    pairs = []
    for log_ratio in (0.05, 0.085, 0.12, 0.175, 0.23):
        depth = curr.depth * np.float32(np.exp(log_ratio))
        pair = replace(known.pair, curr=replace(curr, depth=depth))
        pairs.append(known._replace(pair=pair))
    return answered(pairs, "classical", seed)


# -- few pixels, weak geometry -------------------------------------------------


def covered_tiles(seed: int) -> list[Record]:
    """Depth in a rectangle that grows tile by tile."""
    from hybridvo.core.options import RefineOptions
    from hybridvo.solver.newton import tile_size

    known = still_pair(3, 0.5, 0.02)
    side = tile_size(known.depth.shape, RefineOptions.tiles)
    pairs = []
    for rows, columns in ((2, 6), (2, 8), (3, 6), (4, 5), (4, 7), (5, 6), (5, 7)):
        inside = np.zeros(known.depth.shape, bool)
        inside[side : (rows + 1) * side, side : (columns + 1) * side] = True
        depth = np.where(inside, known.pair.prev.depth, np.float32(np.nan))
        prev = replace(known.pair.prev, depth=depth)
        curr = replace(known.pair.curr, depth=None)
        pairs.append(known._replace(pair=replace(known.pair, prev=prev, curr=curr)))
    return answered(pairs, "classical", seed)


def narrow_view_of_a_plane(seed: int) -> list[Record]:
    """A frontal plane seen under an ever smaller angle: turning looks like moving."""
    pairs = [frontal_plane(degrees) for degrees in np.geomspace(11, 24, 18)]
    return answered(pairs, "classical", seed)


def frontal_plane(degrees: float) -> Known:
    """Return a pair of a plane 5 m ahead; ``degrees``: the width of the view."""
    from hybridvo import Camera, Frame, FramePair
    from hybridvo.core.geometry import ego_flow, se3_exp

    height, width = 180, 240
    focal = 0.5 * width / np.tan(0.5 * np.radians(degrees))
    camera = Camera(focal, focal, 119.5, 89.5, height=height, width=width)
    depth = np.full((height, width), 5.0, np.float32)
    T = se3_exp(np.array([0.02, -0.01, 0.03, 0.001, 0.002, 0.001]))
    flow = ego_flow(depth, T, camera, camera)
    rng = np.random.default_rng(9)
    flow += 0.02 * rng.standard_normal(flow.shape)
    frame = Frame(None, depth, camera)
    bare = Frame(None, None, camera)
    pair = FramePair(frame, bare, flow.astype(np.float32), flow_source="file")
    return Known(pair, T, depth)


def frames_with_little_depth(seed: int) -> list[Record]:
    """Frames with ever less depth: from the last no motion starts, they are passed over."""
    from hybridvo import Odometry

    known = still_pair(4, 0.0, 0.0, (120, 160))
    rng = np.random.default_rng(10)
    order = rng.permutation(known.depth.size).reshape(known.depth.shape)
    found = []
    for share in (0.004, 0.0029, 0.0023, 0.0017, 0.0011):
        few = order < share * order.size
        odometry = Odometry(method="classical", flow=no_flow, seed=seed)
        depths = (known.depth, np.where(few, known.depth, np.nan), known.depth)
        for index, depth in enumerate(depths):
            frame = replace(
                known.pair.prev,
                depth=depth.astype(np.float32),
                index=index,
                timestamp=float(index),
            )
            step = odometry.track(frame)
        found.append(labelled(f"from {step.prev_index}"))
    return found


def no_flow(prev: Any, curr: Any) -> np.ndarray:
    """Return the flow between two frames of a camera that stands still."""
    return np.zeros((*prev.camera.shape, 2), np.float32)


# -- what a moving object hides ------------------------------------------------


def patches_in_a_static_scene(seed: int) -> list[Record]:
    """A piece of the image that moves by itself, larger from rung to rung."""
    from hybridvo import estimate

    found = []
    for known in moving_pairs():
        for share in np.geomspace(0.02, 0.3, 14):
            pair = with_moving_patch(known.pair, share)
            answer = estimate(pair.prev, pair.curr, method="hybrid", seed=seed)
            found.append(record(answer, known.T_curr_prev, known.depth, known.pair))
    return found


def with_moving_patch(pair: Any, share: float) -> Any:
    """Return a pair in whose second image a square piece stands 4 px aside."""
    height, width = pair.prev.camera.shape
    side = int(np.sqrt(share * height * width))
    top = (height - side) // 2
    left = (width - side) // 2
    rows = slice(top, top + side)
    rgb = pair.curr.rgb.copy()
    depth = pair.curr.depth.copy()
    for image in (rgb, depth):
        image[rows, left : left + side] = image[rows, left + 4 : left + side + 4]
    return replace(pair, curr=replace(pair.curr, rgb=rgb, depth=depth))


def prior_of_an_object(seed: int) -> list[Record]:
    """A prior that says the motion of an object, less sure from rung to rung."""
    from hybridvo import MotionPrior, estimate

    found = []
    for known in scene_pairs("heavy_rigid")[:2]:
        alone = estimate(known.pair, method="classical", seed=seed)
        other = alone.hypotheses[1].T_curr_prev
        for std_m in np.geomspace(0.03, 0.4, 24):
            variance = [std_m**2] * 3 + [(0.2 * std_m) ** 2] * 3
            prior = MotionPrior(other, np.diag(variance))
            answer = estimate(
                known.pair, method="classical", prior=prior, seed=seed
            )
            same = np.allclose(answer.T_curr_prev, alone.T_curr_prev, atol=0.003)
            found.append(labelled("as without" if same else "as the prior"))
    return found


# -- errors of the flow that neighbours share ----------------------------------


def coherent_flow(seed: int) -> list[Record]:
    """Static pairs whose flow has a smooth error beside white noise."""
    from hybridvo_lab.synthetic.draws import smooth_field

    pairs = []
    for number in range(8):
        known = still_pair(20 + number, 0.1, 0.01)
        rng = np.random.default_rng([12, number])
        field = np.float32(0.05) * smooth_field(rng, known.depth.shape, 8, 2)
        pair = replace(known.pair, flow=known.pair.flow + field)
        curr = replace(pair.curr, depth=None)
        pairs.append(known._replace(pair=replace(pair, curr=curr)))
    return answered(pairs, "classical", seed)


def dis_flow_of(percentile: int, seed: int) -> list[Record]:
    """DIS flow beside the true flow; ``std`` is a percentile of what it states, 1e-3 px."""
    from hybridvo.flow.providers import dis_flow

    known = scene_pair(made_scene("light", 900, 2, (300, 400)), 0)
    found = dis_flow()(known.pair.prev, known.pair.curr)
    error = np.linalg.norm(found.flow - known.pair.flow, axis=2)
    std = np.sqrt(np.percentile(found.variance[found.valid], percentile))
    median = float(np.nanmedian(error[found.valid]))
    return [labelled("flow", error=median, std=1e3 * float(std))]


def little_texture(seed: int) -> list[Record]:
    """Grey images with ever more white pixels: the first have too little texture."""
    from hybridvo import Camera, Frame
    from hybridvo.flow.providers import dis_flow

    height, width = 200, 300
    camera = Camera(300.0, 300.0, 149.5, 99.5, height=height, width=width)
    depth = np.full((height, width), 3.0, np.float32)
    # so far apart, blurred spots do not touch each other
    rows = range(10, height - 10, 10)
    columns = range(10, width - 10, 10)
    places = [(row, column) for row in rows for column in columns]
    order = np.random.default_rng(13).permutation(len(places))
    found = []
    for spots in SPOTS:
        rgb = np.full((height, width, 3), 128, np.uint8)
        for number in order[:spots]:
            rgb[places[number]] = 255
        frame = Frame(rgb, depth, camera)
        flow = dis_flow()(frame, frame).flow
        found.append(labelled("none" if flow is None else "flow"))
    return found


# -- estimators of other libraries ---------------------------------------------


def stated_noise(scenario: str, variance: float | None, seed: int) -> list[Record]:
    """Pairs with flow noise, and what the flow states of it."""
    pairs = []
    for number in range(3):
        known = made_pair(scenario, number)
        pair = known.pair
        if variance is not None:
            stated = np.full(known.depth.shape, variance, np.float32)
            pair = replace(pair, flow_variance=stated)
        pairs.append(known._replace(pair=pair))
    return answered(pairs, BASELINE, seed)


LADDERS: dict[tuple[str, str], Run] = {
    ("scaled_flow", "classical"): scaled_flow,
    ("noisy_negated_flow", "classical"): grey_noise_of_negated_flow,
    ("turned_flow", "slow"): partial(turned_flow, 0.0, SLOW_SHIFTS_PX),
    ("turned_flow", "fast"): partial(turned_flow, 8.0, FAST_SHIFTS_PX),
    ("turned_flow", "noisy"): turned_flow_of_noisy_images,
    ("late_depth", "noisy"): late_noisy_depth,
    ("frozen_images", "noisy_depth"): noisy_depth_of_frozen_images,
    ("two_depths", "spread"): depth_spread,
    ("two_depths", "scale"): depth_scale,
    ("covered_tiles", "classical"): covered_tiles,
    ("narrow_view", "classical"): narrow_view_of_a_plane,
    ("little_depth", "classical"): frames_with_little_depth,
    ("moving_patch", "hybrid"): patches_in_a_static_scene,
    ("baseline_noise", "unstated"): partial(stated_noise, "noisy", None),
    ("baseline_noise", "half"): partial(stated_noise, "noisy", 0.25),
    ("baseline_noise", "tiny"): partial(stated_noise, "moving30", 0.01),
    ("prior_of_an_object", "classical"): prior_of_an_object,
    ("coherent_flow", "medium"): coherent_flow,
    ("dis_flow", "small_low"): partial(dis_flow_of, 10),
    ("dis_flow", "small_high"): partial(dis_flow_of, 90),
    ("little_texture", "flow"): little_texture,
}
"""Name of a ladder and of its variant -> what climbs it."""
LADDERS |= RECORDINGS
