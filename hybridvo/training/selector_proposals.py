"""What a pixel-wise network says of the samples: a motion, and where the world stands still.

Kept beside the shards, in their folder ``proposals``, so that they can be made anew when the
network has learned more.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from hybridvo.network.inputs import NETWORK_SIZE
from hybridvo.network.normalization import predict
from hybridvo.network.prediction import static_probability
from hybridvo.network.weighted_fit import fitted_motion, on_grid_of
from hybridvo.results import PixelwisePrediction
from hybridvo.training.rendered import grid_sample
from hybridvo.training.stream import collate

FOLDER = "proposals"
AT_ONCE = 16


def write_proposals(folder: str | os.PathLike[str], network: torch.nn.Module) -> int:
    """Ask a network about the samples of all shards of a folder.

    Args:
        folder: of the shards.
        network: a PWVO with uncertainty.

    Returns:
        Number of samples.
    """
    folder = Path(folder)
    (folder / FOLDER).mkdir(exist_ok=True)
    total = 0
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            shard = dict(file)
        count = len(shard["source"])
        said = [
            _proposals(shard, range(k, min(k + AT_ONCE, count)), network)
            for k in range(0, count, AT_ONCE)
        ]
        arrays: dict[str, Any] = {
            "proposal": np.concatenate([s[0] for s in said]),
            "static": np.concatenate([s[1] for s in said]).astype(np.float16),
        }
        target = folder / FOLDER / path.name
        temporary = target.with_suffix(".tmp")
        with open(temporary, "wb") as out:
            np.savez(out, **arrays)
        os.replace(temporary, target)
        total += count
    return total


def read_proposals(path: Path, shape: tuple[int, int, int]) -> dict[str, np.ndarray]:
    """``proposal``, ``static`` and ``proposed`` of the samples of a shard; False if not asked.

    Args:
        path: of the shard.
        shape: (samples, rows, columns) of what it holds.
    """
    beside = path.parent / FOLDER / path.name
    if not beside.exists():
        return {
            "proposal": np.tile(np.eye(4)[:3], (shape[0], 1, 1)),
            "static": np.full(shape, 0.5, np.float16),
            "proposed": np.zeros(shape[0], bool),
        }
    with np.load(beside) as file:
        said = dict(file)
    return {**said, "proposed": np.isfinite(said["proposal"]).all((1, 2))}


def _proposals(
    shard: dict[str, np.ndarray], index: range, network: torch.nn.Module
) -> tuple[np.ndarray, np.ndarray]:
    """Motions (n, 3, 4) and static probabilities (n, h, w) of some samples."""
    samples = [grid_sample({k: v[i] for k, v in shard.items()}, NETWORK_SIZE) for i in index]
    with torch.inference_mode():
        inputs = collate(samples).inputs
        output = predict(network, inputs)
        assert isinstance(output, PixelwisePrediction) and output.log_scale_rotation is not None
        scale = output.log_scale_rotation
        valid = on_grid_of(scale, inputs).valid
        static = static_probability(scale, valid)[:, None]
        size = shard["label"].shape[1:]
        static = F.interpolate(static, size, mode="bilinear", align_corners=False)[:, 0]
        motion = fitted_motion(output, inputs)[:, :3]
    return motion.double().numpy(), static.numpy()
