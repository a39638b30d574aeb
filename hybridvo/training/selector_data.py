"""Training samples of the selector: the motions that the real search
finds, and which are right.

A sample is the coarse grid of a pair, the motions that the search found on it (its
failures included), and ground truth: the motion, the depth and the moving pixels.
Shards are written atomically: a training can read them while others are written.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hybridvo.files import atomic_write
from hybridvo.geometry import se3_exp
from hybridvo.hypotheses.generate import generate
from hybridvo.hypotheses.refit import fit_in_mask
from hybridvo.hypotheses.search import REFERENCE_WIDTH
from hybridvo.hypotheses.types import HypothesisSet
from hybridvo.network.grid_maps import grid_maps
from hybridvo.network.prediction import propose_motion
from hybridvo.options import Options
from hybridvo.refinement.depth import without_sky
from hybridvo.refinement.pixels import grid_stride
from hybridvo.results import MotionPrediction, StageFailed
from hybridvo.synthetic.draws import log_uniform
from hybridvo.synthetic.paper_samples import KnownPair, camera_flow
from hybridvo.synthetic.semi_real import Recording, draw_clip
from hybridvo.synthetic.training_scenes import scene_pairs, undetermined_pair
from hybridvo.training.validation import allowed_error_px

PER_SHARD = 64
"""Seeds of a shard."""
MAX_MOTIONS = 8
"""Motions of a sample."""
UNDETERMINED_SHARE = 0.1
"""Share of the drawn scenes in which no motion is the camera's."""
CROWD_SHARE = 0.5
"""Share of the other drawn scenes with four to ten moving objects."""
RENDERED_SHARE = 0.5
"""Share of the semi-real samples with a rendered static scene."""
ROLLING_SHARE = 0.4
"""Share of the semi-real samples with a rolling shutter."""
START_SHARE = 0.35
"""Share of the samples whose search has an expected motion as a second start."""
SIZES = [(160, 320), (160, 320), (128, 256), (192, 256), (120, 400), (218, 512)]
SIZES += [(320, 640), (320, 640), (360, 480), (256, 720), (436, 1024)]
"""(height, width) of the samples; DIS follows the last five at half their size."""
MOVING = 0
"""Label of a pixel that moves by itself."""
STATIC = 1
"""Label of a pixel of the static scene."""
UNKNOWN = 255
"""Label of a pixel without true depth."""


def draw_samples(
    seed: int, network: torch.nn.Module, recordings: Sequence[Recording] = ()
) -> list[dict[str, Any]]:
    """Samples of one seed: one semi-real, or two of a rendered pair.

    Pairs with one clear motion are left out: the selector is not used for
    them. The motion and the static mask that ``network``, a PWVO, predicts
    are kept with the samples.
    """
    rng = np.random.default_rng([0x6A64, seed])
    height, width = SIZES[int(rng.integers(len(SIZES)))]
    if recordings:
        pairs = draw_clip(
            rng, recordings, rendered=RENDERED_SHARE, rolling=ROLLING_SHARE
        )
    elif rng.random() < UNDETERMINED_SHARE:
        pairs = [undetermined_pair(rng, height, width)]
    else:
        drawn_pairs = scene_pairs(rng, height, width, crowd_share=CROWD_SHARE)
        pairs = list(drawn_pairs.values())
    samples = []
    for drawn in pairs:
        starts = [np.eye(4)]
        if rng.random() < START_SHARE:
            starts.append(expected_motion(rng, drawn.T_curr_prev)[0])
        pair = without_sky(drawn.pair)
        search_seed = int(rng.integers(1 << 30))
        try:
            found = generate(pair, np.stack(starts), Options(), search_seed)
        except StageFailed:
            continue
        if not found.is_ambiguous:
            continue
        if found.grid.shape[2] != grid_stride(
            found.grid.size, Options().refine.coarse_pixels
        ):
            continue  # pairs with few usable pixels have a finer grid
        sample = _record(drawn, found)
        nothing = MotionPrediction(np.full((4, 4), np.nan), np.full((1, 1), 0.5))
        proposal = propose_motion(network, pair) or nothing
        sample["proposal"] = proposal.T_curr_prev[:3]
        sample["static"] = found.grid.resample(proposal.static_probability).astype(
            np.float16
        )
        samples.append(sample)
    return samples


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
        pose, _ = fit_in_mask(
            found.grid.samples, static, found.grid.K, start, cutoff
        )
        K = drawn.pair.prev.camera.K
        flow, truth = (
            camera_flow(K, drawn.depth, T)[0] for T in (pose, drawn.T_curr_prev)
        )
        error = np.linalg.norm(flow - truth, axis=2)[drawn.depth > 0].mean()
        error *= REFERENCE_WIDTH / drawn.depth.shape[1]
        limit = allowed_error_px(float(np.nan_to_num(error)))
    count = min(len(found.motions), MAX_MOTIONS)
    noise = np.array([motion.stats.noise for motion in found.motions[:count]])
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
    folder: Path,
    first_seed: int,
    network: torch.nn.Module,
    recordings: Sequence[Recording] = (),
    seeds: int = PER_SHARD,
) -> int:
    """Write the samples of some seeds, in one file for each grid shape.

    Returns their number.
    """
    by_shape: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for seed in range(first_seed, first_seed + seeds):
        for sample in draw_samples(seed, network, recordings):
            by_shape.setdefault(sample["label"].shape, []).append(sample)
    for (h, w), samples in by_shape.items():
        arrays: dict[str, Any] = {
            key: np.stack([p[key] for p in samples]) for key in samples[0]
        }
        with atomic_write(folder / f"{first_seed:08d}_{h}x{w}.npz", "wb") as file:
            np.savez(file, **arrays)
    return sum(len(p) for p in by_shape.values())
