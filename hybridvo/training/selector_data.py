"""Training samples of the selector: the motions that the real search finds, and which are right.

A sample is the coarse grid of a pair, the motions that the search found on it (its failures
included), and ground truth: the motion, the depth and who moves. Shards are written atomically: a
training can read them while others are being made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.files import atomic_write
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, invert, se3_exp
from hybridvo.hypotheses.generate import HypothesisSet, generate
from hybridvo.network.inputs import NETWORK_SIZE
from hybridvo.network.normalization import predict
from hybridvo.network.prediction import static_probability
from hybridvo.network.selection import fitted_motion, on_grid_of
from hybridvo.options import Options
from hybridvo.refinement.pixels import grid_stride
from hybridvo.results import PixelwisePrediction, RelativePose
from hybridvo.synthetic.dataset import MOVING, SOURCES, STATIC, UNKNOWN, grid_sample
from hybridvo.synthetic.diverse import DiverseOptions
from hybridvo.synthetic.draws import log_uniform
from hybridvo.synthetic.semi_real import KnownPair, Recording, draw_pair
from hybridvo.synthetic.sensors import SensorOptions, degrade_depth
from hybridvo.synthetic.training_scenes import training_scene
from hybridvo.training.validation import collate
from hybridvo.types import Camera, Frame, FramePair

PER_SHARD = 64
"""Seeds of a shard."""
MAX_MOTIONS = 5
"""Motions of a sample."""
SIZES = ((160, 320), (160, 320), (128, 256), (192, 256), (120, 400), (218, 512))
"""(height, width) of the samples."""


def draw_samples(seed: int, recordings: Sequence[Recording] = ()) -> list[dict[str, Any]]:
    """Samples of one seed: semi-real, one of the diverse preset, or two of a rendered pair.

    Pairs that the search settles alone are left out: the selector is never asked about them.
    """
    rng = np.random.default_rng([0x6A64, seed])
    height, width = SIZES[int(rng.integers(len(SIZES)))]
    if recordings:
        pairs = {"semi-real": draw_pair(rng, recordings)}
    elif rng.random() < 0.5:
        pairs = {"diverse": _diverse_pair(rng, min(height, 160), min(width, 320))}
    else:
        pairs = _rendered_pairs(rng, seed, height, width)
    samples = []
    for source, drawn in pairs.items():
        T_prior = _last_motion(rng, drawn.T_curr_prev)
        starts = [np.eye(4)]
        if T_prior is not None and rng.random() < 0.7:
            starts.append(T_prior)
        found = generate(drawn.pair, np.stack(starts), Options(), int(rng.integers(1 << 30)))
        usual = grid_stride(drawn.depth.shape, Options().refine.coarse_pixels)
        if (
            isinstance(found, RelativePose)
            or not found.is_ambiguous
            or found.grid.shape[2] != usual
        ):
            continue
        samples.append(_record(drawn, found, T_prior) | {"source": SOURCES.index(source)})
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


def _diverse_pair(rng: np.random.Generator, height: int, width: int) -> KnownPair:
    sample = DiverseOptions(height=height, width=width).sample(rng)
    camera = Camera.from_matrix(sample.K, height, width)
    flow = np.ascontiguousarray(sample.flow)
    if rng.random() < 0.15:
        flow = _noisy(rng, flow)
    prev = Frame(None, np.ascontiguousarray(sample.depth_prev), camera)
    pair = FramePair(prev, Frame(None, None, camera), flow)
    known = (sample.depth_curr > 0) & (rng.random() >= 0.1)
    log_depth = np.log(np.where(known, sample.depth_curr, np.float32(np.nan)))
    T = sample.T_curr_prev.astype(float)
    return KnownPair(pair, T, sample.depth_true, sample.moving, log_depth_curr=log_depth)


def _rendered_pairs(
    rng: np.random.Generator, seed: int, height: int, width: int
) -> dict[str, KnownPair]:
    """The same scene with true and with DIS flow."""
    scene = training_scene(seed, height, width)
    frames = [scene.render(k) for k in (0, 1)]
    flow, _, moving = scene.flow(0)
    camera = scene.cameras[0]
    T = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    depth = [np.where(np.isfinite(f.depth), f.depth, 0).astype(np.float32) for f in frames]
    # of the movers' pixels those whose flow the camera alone does not explain
    own = np.nan_to_num(flow) - np.nan_to_num(ego_flow(depth[0], T, camera, camera))
    moving &= np.square(own).sum(axis=2) > (0.5 * camera.width / 1024) ** 2
    truth = T, depth[0], moving
    if rng.random() < 0.5:
        depth = degrade_depth(rng, depth, SensorOptions())
    second = rng.random() > 0.1
    if rng.random() < 0.3:
        flow = _noisy(rng, flow)
    prev = Frame(frames[0].rgb, depth[0], camera)
    curr = Frame(frames[1].rgb, depth[1] if second else None, camera)
    pairs = {"rendered": KnownPair(FramePair(prev, curr, np.ascontiguousarray(flow)), *truth)}
    field = dis_flow()(prev, curr)
    if field.flow is not None:
        estimated = FramePair(prev, curr, field.flow, field.variance, field.valid)
        pairs["dis"] = KnownPair(estimated, *truth)
    return pairs


def _record(drawn: KnownPair, found: HypothesisSet, T_prior: np.ndarray | None) -> dict[str, Any]:
    """Everything about a sample: the maps of its grid, the motions found, and ground truth."""
    stride, maps = found.grid.shape[2], found.maps()
    pick = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    if drawn.log_depth_curr is not None:
        maps = replace(maps, log_depth_curr=drawn.log_depth_curr[pick])
    label = np.where(drawn.moving, MOVING, STATIC)
    label = np.where(drawn.depth > 0, label, UNKNOWN)[pick]
    count = min(len(found.poses), MAX_MOTIONS)
    empty = (0, MAX_MOTIONS - count)
    return vars(maps) | {
        "depth_true": np.minimum(drawn.depth[pick], 6e4).astype(np.float16),
        "label": label.astype(np.uint8),
        "poses": np.pad(found.poses[:count], (empty, (0, 0), (0, 0))),
        "facts": np.pad(found.facts[:count], (empty, (0, 0))),
        "count": count,
        "T": drawn.T_curr_prev[:3],
        "T_prior": (np.eye(4) if T_prior is None else T_prior)[:3],
        "has_prior": T_prior is not None,
    }


def write_shard(
    folder: Path, first_seed: int, seeds: int = PER_SHARD, recordings: Sequence[Recording] = ()
) -> int:
    """Write the samples of some seeds, in one file for each grid shape; returns their number."""
    by_shape: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for seed in range(first_seed, first_seed + seeds):
        for sample in draw_samples(seed, recordings):
            by_shape.setdefault(sample["label"].shape, []).append(sample)
    for (h, w), samples in by_shape.items():
        arrays = {key: np.stack([p[key] for p in samples]) for key in samples[0]}
        _write(folder / f"{first_seed:08d}_{h}x{w}.npz", arrays)
    return sum(len(p) for p in by_shape.values())


def _write(path: Path, arrays: dict[str, Any]) -> None:
    with atomic_write(path, "wb") as file:
        np.savez(file, **arrays)


def write_proposals(folder: Path, network: torch.nn.Module) -> int:
    """Write a PWVO's answers (motion, static world) into all shards; the number of samples."""
    total = 0
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            shard = dict(file)
        count = len(shard["source"])
        said = [_proposal({k: x[i] for k, x in shard.items()}, network) for i in range(count)]
        proposal, static = (np.stack(x) for x in zip(*said, strict=True))
        _write(path, shard | {"proposal": proposal, "static": static})
        total += count
    return total


@torch.inference_mode()
def _proposal(p: dict[str, np.ndarray], network: torch.nn.Module) -> tuple[np.ndarray, np.ndarray]:
    """Motion (3, 4) and static probability (h, w) of a sample."""
    inputs = collate([grid_sample(p, NETWORK_SIZE)]).inputs
    output = predict(network, inputs)
    assert isinstance(output, PixelwisePrediction) and output.log_scale_rotation is not None
    scale = output.log_scale_rotation
    static = static_probability(scale, on_grid_of(scale, inputs).valid)[:, None]
    static = F.interpolate(static, p["label"].shape, mode="bilinear", align_corners=False)
    motion = fitted_motion(output, inputs)[0, :3]
    return motion.double().numpy(), static[0, 0].half().numpy()
