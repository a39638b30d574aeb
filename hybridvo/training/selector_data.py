"""Training samples of the selector: the motions that the real search finds, and which are right.

A sample is the coarse grid of a pair, the motions that the search found on it (its failures
included), and ground truth: the motion, the depth and who moves. Samples come from the ``wide``
preset with its degraded flow and depth, and from rendered scenes with true, noisy and DIS flow.
Shards are written atomically, so that a training can read them while others are being made.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.flow import dis_flow
from hybridvo.geometry import invert, se3_exp
from hybridvo.hypotheses.generate import HypothesisSet, generate
from hybridvo.options import Options
from hybridvo.refinement import kernels
from hybridvo.results import RelativePose
from hybridvo.synthetic.diverse import DiverseOptions, diverse_sample
from hybridvo.synthetic.draws import log_uniform
from hybridvo.synthetic.semi_real import Recording, draw_pair
from hybridvo.synthetic.sensors import SensorOptions, degrade_depth
from hybridvo.synthetic.training_scenes import training_scene
from hybridvo.training.rendered import MOVING, STATIC, UNKNOWN
from hybridvo.types import Camera, Frame, FramePair

PER_SHARD = 64
MAX_MOTIONS = 5
"""Motions of a sample."""
SIZES = ((160, 320), (160, 320), (128, 256), (192, 256), (120, 400), (218, 512))
"""(height, width) of the samples."""


@dataclass(frozen=True, eq=False)
class _Truth:
    """T_curr_prev (4, 4), depth (H, W), moving (H, W) bool, known (H, W) bool."""

    T_curr_prev: np.ndarray
    depth: np.ndarray
    moving: np.ndarray
    known: np.ndarray


def draw_samples(seed: int, recordings: Sequence[Recording] = ()) -> list[dict[str, Any]]:
    """Samples of one seed: semi-real ones, or one of the diverse preset, or two of a rendered pair.

    Pairs that the search settles alone are left out: the selector is never asked about them.

    Args:
        seed: of everything drawn at random.
        recordings: for semi-real pairs; none: the others.
    """
    rng = np.random.default_rng([0x6A64, seed])
    height, width = SIZES[int(rng.integers(len(SIZES)))]
    if recordings:
        pairs = [_semi_real_pair(rng, recordings)]
    elif rng.random() < 0.5:
        pairs = [_diverse_pair(rng, min(height, 160), min(width, 320))]
    else:
        pairs = _rendered_pairs(rng, seed, height, width)
    samples = []
    for pair, truth, log_depth_curr, source in pairs:
        T_prior = _last_motion(rng, truth.T_curr_prev)
        starts = [np.eye(4)]
        if T_prior is not None and rng.random() < 0.7:
            starts.append(T_prior)
        found = generate(pair, np.stack(starts), Options(), int(rng.integers(1 << 30)))
        height, width = pair.prev.camera.shape
        if isinstance(found, RelativePose) or not found.is_ambiguous:
            continue
        if found.grid.box != (0, height, 0, width):
            continue
        samples.append(_record(pair, found, truth, T_prior, log_depth_curr, source))
    return samples


def _last_motion(rng: np.random.Generator, T: np.ndarray) -> np.ndarray | None:
    """A motion as it may have been one frame earlier; sometimes quite another one."""
    kind = rng.random()
    if kind < 0.5:
        return None
    t = max(float(np.linalg.norm(T[:3, 3])), 1e-3)
    if kind < 0.88:
        spread = log_uniform(rng, (0.03, 0.6)) * np.array([t, t, t, 0.01, 0.01, 0.01])
    else:
        spread = np.array([2 * t, 2 * t, 2 * t, 0.04, 0.04, 0.04])
    return se3_exp(spread * rng.standard_normal(6)) @ T


def _noisy(rng: np.random.Generator, flow: np.ndarray) -> np.ndarray:
    """White noise and gross errors, as in the benchmark's cells but of any strength."""
    flow = flow + np.float32(log_uniform(rng, (0.02, 1.0))) * rng.standard_normal(
        flow.shape, dtype=np.float32
    )
    if rng.random() < 0.5:
        bad = rng.random(flow.shape[:2]) < rng.uniform(0, 0.3)
        reach = 0.06 * flow.shape[1]
        flow[bad] += rng.uniform(-reach, reach, (int(bad.sum()), 2)).astype(np.float32)
    return flow


def _diverse_pair(rng: np.random.Generator, height: int, width: int) -> tuple[Any, ...]:
    sample = diverse_sample(rng, DiverseOptions(height=height, width=width))
    K = sample.K.astype(float)
    camera = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], height, width)
    flow = np.ascontiguousarray(sample.flow)
    if rng.random() < 0.15:
        flow = _noisy(rng, flow)
    prev = Frame(None, np.ascontiguousarray(sample.depth_prev), camera)
    pair = FramePair(prev, Frame(None, None, camera), flow)
    with np.errstate(divide="ignore"):
        log_depth = np.where(sample.depth_curr > 0, np.log(sample.depth_curr), np.nan)
    if rng.random() < 0.1:
        log_depth = np.full_like(log_depth, np.nan)
    truth = _Truth(
        sample.T_curr_prev.astype(float),
        sample.depth_true,
        sample.moving,
        sample.depth_true > 0,
    )
    return pair, truth, log_depth.astype(np.float32), "diverse"


def _semi_real_pair(rng: np.random.Generator, recordings: Sequence[Recording]) -> tuple[Any, ...]:
    drawn = draw_pair(rng, recordings)
    truth = _Truth(drawn.T_curr_prev, drawn.depth, drawn.moving, drawn.depth > 0)
    return drawn.pair, truth, None, "semi-real"


def _rendered_pairs(
    rng: np.random.Generator, seed: int, height: int, width: int
) -> list[tuple[Any, ...]]:
    scene = training_scene(seed, height, width)
    frames = [scene.render(k) for k in (0, 1)]
    flow, _, _ = scene.flow(0)
    camera = scene.camera(0)
    T = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    depth = [np.where(np.isfinite(f.depth), f.depth, 0).astype(np.float32) for f in frames]
    known = frames[0].object_id >= 0
    moving = _moving(flow, T, camera, depth[0], frames[0].object_id > 0)
    truth = _Truth(T, depth[0], moving, known)
    if rng.random() < 0.5:
        depth = degrade_depth(rng, depth, SensorOptions())
    second = rng.random() > 0.1
    if rng.random() < 0.3:
        flow = _noisy(rng, flow)
    prev = Frame(frames[0].rgb, depth[0], camera)
    curr = Frame(frames[1].rgb, depth[1] if second else None, camera)
    pairs = [(FramePair(prev, curr, np.ascontiguousarray(flow)), truth, None, "true")]
    field = dis_flow()(prev, curr)
    if field.flow is not None:
        estimated = FramePair(prev, curr, field.flow, field.variance, field.valid)
        pairs.append((estimated, truth, None, "dis"))
    return pairs


def _moving(
    flow: np.ndarray, T: np.ndarray, camera: Camera, depth: np.ndarray, mover: np.ndarray
) -> np.ndarray:
    """(H, W) bool, pixels of movers whose flow the camera alone does not explain.

    A mover that happens to stand still helps the fit; half a pixel at a width of 1024 counts.
    """
    from hybridvo.geometry import ego_flow

    with np.errstate(invalid="ignore"):
        own = np.nan_to_num(flow) - np.nan_to_num(ego_flow(depth, T, camera, camera))
    return mover & (np.square(own).sum(axis=2) > (0.5 * camera.width / 1024) ** 2)


def _record(
    pair: FramePair,
    found: HypothesisSet,
    truth: _Truth,
    T_prior: np.ndarray | None,
    log_depth_curr: np.ndarray | None,
    source: str,
) -> dict[str, Any]:
    """Everything about a sample, as small arrays."""
    h, w, stride = found.grid.shape
    pick = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    maps = found.maps()
    log_depth = maps.log_depth_curr
    if log_depth_curr is not None:
        log_depth = log_depth_curr[pick]
    label = np.where(truth.moving, MOVING, STATIC)
    label = np.where(truth.known, label, UNKNOWN)[pick]
    n = found.grid.count
    rows = found.grid.samples[:, :n]
    poses = np.zeros((MAX_MOTIONS, 3, 4))
    facts = np.zeros((MAX_MOTIONS, found.facts.shape[1]))
    poses[: len(found.poses)], facts[: len(found.poses)] = found.poses, found.facts
    exact = [kernels.XN, kernels.YN, kernels.Z, kernels.MU, kernels.MV]
    return {
        "exact": rows[exact].reshape(5, h, w),
        "coarse": rows[[kernels.PF, kernels.PD, kernels.W]].reshape(3, h, w).astype(np.float16),
        "log_depth": log_depth.astype(np.float16),
        "images": np.stack([maps.image_prev, maps.image_curr]).astype(np.uint8),
        "log_depth_seen": maps.log_depth_seen.astype(np.float16),
        "seen": maps.seen,
        "depth_true": np.minimum(truth.depth[pick], 6e4).astype(np.float16),
        "label": label.astype(np.uint8),
        "poses": poses,
        "facts": facts,
        "count": len(found.poses),
        "T": truth.T_curr_prev[:3],
        "T_prior": (np.eye(4) if T_prior is None else T_prior)[:3],
        "has_prior": T_prior is not None,
        "K": found.grid.pixels.K,
        "width": pair.prev.camera.width,
        "stride": stride,
        "source": ("diverse", "true", "dis", "semi-real").index(source),
    }


def write_shard(
    path: str | os.PathLike[str],
    first_seed: int,
    seeds: int = PER_SHARD,
    recordings: Sequence[Recording] = (),
) -> int:
    """Write the samples of some seeds, in one file for each grid shape.

    Returns:
        Number of samples written.
    """
    folder = Path(path)
    by_shape: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for seed in range(first_seed, first_seed + seeds):
        for sample in draw_samples(seed, recordings):
            by_shape.setdefault(sample["label"].shape, []).append(sample)
    for (h, w), samples in by_shape.items():
        arrays: dict[str, Any] = {key: np.stack([p[key] for p in samples]) for key in samples[0]}
        target = folder / f"{first_seed:08d}_{h}x{w}.npz"
        temporary = target.with_suffix(".tmp")
        with open(temporary, "wb") as file:
            np.savez(file, **arrays)
        os.replace(temporary, target)
    return sum(len(p) for p in by_shape.values())
