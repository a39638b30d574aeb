"""Training samples of PWVO: pairs of many makers, the motions that the real search finds,
and which are right.

A sample is the coarse grid of a pair, the motions that the search found on it (its
failures included), and ground truth: the motion, the depth and the moving pixels.
Shards are written atomically: a training can read them while others are written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hybridvo.core.files import atomic_write
from hybridvo.core.geometry import se3_exp
from hybridvo.core.options import Options
from hybridvo.core.results import StageFailed
from hybridvo.core.types import FramePair
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.refit import fit_in_mask
from hybridvo.hypotheses.search import REFERENCE_WIDTH
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.grid_maps import grid_maps
from hybridvo.solver.pixels import grid_stride
from hybridvo_lab.synthetic.draws import log_uniform
from hybridvo_lab.synthetic.flow_sources import (
    draw_disturbed_flow,
    draw_estimated_flow,
)
from hybridvo_lab.synthetic.paper_samples import KnownPair, camera_flow
from hybridvo_lab.synthetic.semi_real import Recording, draw_clip
from hybridvo_lab.synthetic.sensors import degrade_depth
from hybridvo_lab.synthetic.training_scenes import (
    render_pair,
    training_scene,
    undetermined_pair,
)
from hybridvo_lab.synthetic.turned_windows import (
    TripodRecording,
    draw_turned_window,
)
from hybridvo_lab.synthetic.two_recordings import (
    USUAL,
    compose,
    draw_two_recordings,
)
from hybridvo_lab.training.validation import allowed_error_px

PER_SHARD = 64
"""Seeds of a shard."""
MAX_MOTIONS = 8
"""Motions of a sample."""
UNDETERMINED_FRACTION = 0.1
"""Fraction of the drawn scenes in which no motion is the camera's."""
MANY_OBJECTS_FRACTION = 0.5
"""Fraction of the other drawn scenes with four to ten moving objects."""
CONVEYOR_FRACTION = 0.15
"""Fraction of the rendered scenes with an escalator or a conveyor."""
RENDERED_FRACTION = 0.5
"""Fraction of the semi-real samples with a rendered static scene."""
ROLLING_FRACTION = 0.4
"""Fraction of the semi-real samples with a rolling shutter."""
START_FRACTION = 0.35
"""Fraction of the samples whose search has an expected motion as a second start."""
SIZES = [(160, 320), (160, 320), (128, 256), (192, 256), (120, 400), (218, 512)]
SIZES += [(320, 640), (320, 640), (360, 480), (256, 720), (436, 1024)]
"""(height, width) of the samples; DIS follows the last five at half their size."""
MOVING = 0
"""Label of a pixel that moves by itself."""
STATIC = 1
"""Label of a pixel of the static scene."""
UNKNOWN = 255
"""Label of a pixel without true depth."""


class Shares(NamedTuple):
    """Which makers the samples are of; what is left is rendered."""

    tripod: float = 0.1  # of the samples: from recordings of a tripod
    semi_real: float = 0.4  # from other recordings, in which pieces move
    of_kind: float = 0.6  # of these: objects of one of ``semi_real.OBJECT_KINDS``
    two_recordings: float = (
        0.2  # of the samples: part of a place before another one
    )


class Makers(NamedTuple):
    """Recordings from which pairs are made."""

    static: Sequence[Recording] = ()  # static scenes, and things that are cut out
    tripod: Sequence[TripodRecording] = ()  # people before a camera that stands
    # by place, the static scenes whose motions are known
    places: Mapping[str, Sequence[Recording]] = {}
    shares: Shares = Shares()


def draw_samples(seed: int, makers: Makers) -> list[dict[str, Any]]:
    """Samples of one seed: of one semi-real or recorded pair, or two of a view."""
    rng = np.random.default_rng([0x50570, seed])
    samples = []
    for drawn in _draw_pairs(rng, makers):
        starts = [np.eye(4)]
        if rng.random() < START_FRACTION:
            starts.append(expected_motion(rng, drawn.T_curr_prev)[0])
        search_seed = int(rng.integers(1 << 30))
        try:
            found = generate(drawn.pair, np.stack(starts), Options(), search_seed)
        except StageFailed:
            continue
        coarse_pixels = Options().refine.coarse_pixels
        if found.grid.shape[2] != grid_stride(found.grid.size, coarse_pixels):
            continue  # pairs with few usable pixels have a finer grid
        samples.append(_record(drawn, found))
    return samples


def _draw_pairs(rng: np.random.Generator, makers: Makers) -> list[KnownPair]:
    """Pairs of one maker that is drawn."""
    estimate_flow = partial(draw_estimated_flow, rng)
    shares = makers.shares
    kind = rng.random()
    if makers.tripod and kind < shares.tripod:
        return [draw_turned_window(rng, makers.tripod, estimate_flow)]
    if makers.static and kind < shares.tripod + shares.semi_real:
        return draw_clip(
            rng,
            makers.static,
            rendered=RENDERED_FRACTION,
            rolling=ROLLING_FRACTION,
            of_kind=shares.of_kind,
            flow=estimate_flow,
        )
    part = shares.tripod + shares.semi_real + shares.two_recordings
    if makers.places and kind < part:
        parts = draw_two_recordings(rng, makers.places, layout=USUAL)
        clips = [
            compose(each, estimate_flow) for each in (parts, parts.exchanged())
        ]
        return [clip.pairs[0] for clip in clips]
    height, width = SIZES[int(rng.integers(len(SIZES)))]
    if rng.random() < UNDETERMINED_FRACTION:
        return [undetermined_pair(rng, height, width)]
    return _rendered_pairs(rng, height, width)


def _rendered_pairs(
    rng: np.random.Generator, height: int, width: int
) -> list[KnownPair]:
    """A rendered pair with estimated flow, and with its true flow, disturbed or exact."""
    scene = training_scene(
        rng, height, width, MANY_OBJECTS_FRACTION, CONVEYOR_FRACTION
    )
    rendered = render_pair(scene)
    depth = list(rendered.depth)
    if rng.random() < 0.5:
        depth = degrade_depth(rng, depth)
    has_second_depth = rng.random() > 0.1
    prev = replace(rendered.images[0], depth=depth[0])
    curr = replace(rendered.images[1], depth=depth[1] if has_second_depth else None)

    field = draw_estimated_flow(rng, prev, curr)
    pairs = []
    if field.flow is not None:
        pairs.append(FramePair(prev, curr, field.flow, field.variance, field.valid))
    if rng.random() < 0.3:
        # as for users who have flow and depth, but no images
        prev = replace(prev, rgb=None)
        curr = replace(curr, rgb=None)
    pairs.append(FramePair(prev, curr, draw_disturbed_flow(rng, rendered.flow)))
    T = rendered.T_curr_prev
    return [
        KnownPair(pair, T, rendered.depth[0], rendered.moving) for pair in pairs
    ]


def expected_motion(
    rng: np.random.Generator, T: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Draw a motion prior near a true motion T (4, 4):
    good, wrong or overconfident.

    Returns the expected motion (4, 4) and the standard deviations (6,)
    that it states, m and rad.
    """
    length = max(float(np.linalg.norm(T[:3, 3])), 1e-3)
    std_m = log_uniform(rng, (0.02, 0.6)) * length
    std_rad = log_uniform(rng, (3e-4, 1e-2))
    std = np.repeat((std_m, std_rad), 3) * np.exp(0.5 * rng.standard_normal(6))
    stated = std * log_uniform(rng, (0.5, 2.0))
    # the camera was pushed, which the motions before did not show
    if rng.random() < 0.12:
        std = np.repeat([2 * length, 0.04], 3)
    return se3_exp(std * rng.standard_normal(6)) @ T, stated


def _record(drawn: KnownPair, found: HypothesisSet) -> dict[str, Any]:
    """The arrays of a sample: the maps of its grid, the motions
    found, and ground truth.
    """
    stride = found.grid.shape[2]
    pick = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    label = np.where(drawn.moving, MOVING, STATIC)
    label = np.where(drawn.depth > 0, label, UNKNOWN)[pick]
    limit = allowed_error_px(0.0)
    static = (label == STATIC).astype(np.float32)
    if static.any():
        start = drawn.T_curr_prev[:3]
        cutoff = Options().refine.cutoff
        pose = fit_in_mask(
            found.grid.samples, static, found.grid.K, start, cutoff
        ).pose
        K = drawn.pair.prev.camera.K
        flow, truth = (
            camera_flow(K, drawn.depth, T)[0] for T in (pose, drawn.T_curr_prev)
        )
        is_static = (drawn.depth > 0) & ~drawn.moving
        error = np.linalg.norm(flow - truth, axis=2)[is_static].mean()
        error *= REFERENCE_WIDTH / drawn.depth.shape[1]
        limit = allowed_error_px(float(np.nan_to_num(error)))
    count = min(len(found.motions), MAX_MOTIONS)
    noise = np.array([motion.noise for motion in found.motions[:count]])
    empty = (0, MAX_MOTIONS - count)
    return vars(grid_maps(found)) | {
        "depth_true": np.minimum(drawn.depth[pick], 6e4).astype(np.float16),
        "label": label.astype(np.uint8),
        "poses": np.pad(found.poses[:count], (empty, (0, 0), (0, 0))),
        "noise": np.pad(noise, (empty, (0, 0))),
        "count": count,
        "T": drawn.T_curr_prev[:3],
        "limit": limit,
    }


def write_shard(
    folder: Path, first_seed: int, makers: Makers, seeds: int = PER_SHARD
) -> int:
    """Write the samples of some seeds, in one file for each grid shape.

    Returns their number.
    """
    by_shape: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for seed in range(first_seed, first_seed + seeds):
        for sample in draw_samples(seed, makers):
            by_shape.setdefault(sample["label"].shape, []).append(sample)
    for (h, w), samples in by_shape.items():
        arrays: dict[str, Any] = {
            key: np.stack([p[key] for p in samples]) for key in samples[0]
        }
        with atomic_write(folder / f"{first_seed:08d}_{h}x{w}.npz", "wb") as file:
            np.savez(file, **arrays)
    return sum(len(p) for p in by_shape.values())
