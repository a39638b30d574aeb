"""Shards of the selector's samples, and its rendered pairs as samples of the pixel-wise networks.

What DIS makes of a crowd of movers cannot be imitated by a noise model, and rendering a pair costs
a hundred times what a training step on it does.
"""

from __future__ import annotations

import functools
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import matrix_to_euler_deg
from hybridvo.options import option_group
from hybridvo.synthetic.dataset import StoredSamples
from hybridvo.synthetic.layered import Layers, Sample

MOVING, STATIC, UNKNOWN = 0, 1, 255
"""Labels of the pixels in a shard."""
FIRST_RENDERED = 1
"""Sources from this number on are rendered; 0 is the diverse preset, which is drawn afresh."""
NAMES = (
    *("ray", "depth", "target", "usable", "log_depth_curr", "K", "stride"),
    *("depth_true", "label", "T", "source"),
)
"""What a sample of the pixel-wise networks is made of."""


@option_group
class RenderedOptions(StoredSamples):
    """Rendered samples of a folder of shards as samples of one size, mirrored at random."""

    height: Annotated[int, Field(ge=2)] = 128
    width: Annotated[int, Field(ge=2)] = 256

    def sample(self, rng: np.random.Generator) -> Sample:
        """One sample, mirrored or not."""
        groups = _rendered(self.folder)
        sizes = np.cumsum([len(group["source"]) for group in groups])
        choice = int(rng.integers(sizes[-1]))
        number = int(np.searchsorted(sizes, choice, side="right"))
        index = choice - int(sizes[number - 1] if number else 0)
        mirrored = (rng.random(2) < 0.5).tolist()
        arrays = {name: array[index] for name, array in groups[number].items()}
        return grid_sample(arrays, (self.height, self.width), mirrored)


def read_shards(
    paths: Iterable[Path], names: Sequence[str] = (), first_source: int = 0
) -> list[dict[str, np.ndarray]]:
    """Samples of shards, one stack for every shape of grid.

    ``names``: these arrays alone; ``first_source``: samples of this source and those after it.

    Raises:
        FormatError: a file that is no shard.
    """
    by_shape: dict[tuple[int, ...], list[dict[str, np.ndarray]]] = {}
    for path in paths:
        try:
            with np.load(path) as file:
                keep = file["source"] >= first_source
                shard = {name: file[name][keep] for name in names or file.files}
            count, *shape = shard["label"].shape
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise FormatError(f"{path}: not a shard of samples ({error}).") from None
        if not names:  # where no network was asked
            shard.setdefault("proposal", np.full((count, 3, 4), np.nan))
            shard.setdefault("static", np.full((count, *shape), 0.5, np.float16))
        by_shape.setdefault(tuple(shape), []).append(shard)
    return [
        {name: np.concatenate([shard[name] for shard in some]) for name in some[0]}
        for some in by_shape.values()
    ]


@functools.cache
def _rendered(folder: str) -> list[dict[str, np.ndarray]]:
    found = read_shards(sorted(Path(folder).glob("*.npz")), NAMES, FIRST_RENDERED)
    if not any(len(group["source"]) for group in found):
        raise InputError(
            f"{folder or '(no folder)'}: no shards of rendered samples; make some with "
            f"tools/train.py selector-data."
        )
    return found


def grid_sample(
    p: Mapping[str, np.ndarray], size: tuple[int, int], mirrored: Sequence[bool] = (False, False)
) -> Sample:
    """A sample of a size (height, width) from the arrays of one of a shard, by the nearest pixel.

    The rays are those of the pixels that were taken, so that flow and depth stay exact; ground
    truth belongs to the sample's own pixels. ``mirrored``: left to right, top to bottom.
    """
    H, W = size
    h, w = p["label"].shape
    stride = int(p["stride"])
    fx, fy, cx, cy = (float(k) for k in p["K"])
    scale = np.array([W / (w * stride), H / (h * stride)])
    focal = scale * (fx, fy)
    centre = scale * (cx + 0.5, cy + 0.5) - 0.5
    rows = np.minimum((np.arange(H) + 0.5) * h / H, h - 1).astype(int)
    columns = np.minimum((np.arange(W) + 0.5) * w / W, w - 1).astype(int)

    def take(x: np.ndarray) -> np.ndarray:
        return x[..., rows[:, None], columns]

    z, usable, T = take(p["depth"]), take(p["usable"]), p["T"].astype(np.float64)
    ray, target = (np.moveaxis(take(p[name]), 0, -1) for name in ("ray", "target"))
    flow = ((target - (cx, cy)) / (fx, fy) - ray) * focal
    planes = [take(p["log_depth_curr"]), take(p["depth_true"]).astype(np.float32)]
    moving = take(p["label"]) == MOVING
    for axis, (turn, side) in enumerate(zip(mirrored, (1, 0), strict=True)):
        if not turn:
            continue
        M = np.eye(3)
        M[axis, axis] = -1.0
        T = np.column_stack([M @ T[:, :3] @ M, M @ T[:, 3]])
        centre[axis] = (W, H)[axis] - 1 - centre[axis]
        flow, ray = np.flip(flow, side).copy(), np.flip(ray, side).copy()
        flow[..., axis] *= -1
        ray[..., axis] *= -1
        z, usable, moving = (np.flip(a, side) for a in (z, usable, moving))
        planes = [np.flip(a, side) for a in planes]
    log_depth, depth_true = planes
    depth_true = np.where(np.isfinite(depth_true), depth_true, 0.0)
    known = depth_true > 0
    inverse = np.where(known, 1.0 / np.where(known, depth_true, 1.0), 0.0).astype(np.float32)
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    ego_flow, ratio, *_ = Layers(K, inverse).flows(T, added=False)
    return Sample(
        flow=np.where(usable[..., None], flow, np.nan).astype(np.float32),
        ego_flow=ego_flow,
        depth_prev=np.where(usable, z, 0.0).astype(np.float32),
        depth_curr=np.exp(np.nan_to_num(log_depth, nan=-np.inf)).astype(np.float32),
        depth_true=depth_true.astype(np.float32),
        depth_target=np.maximum(depth_true * ratio, 0.0).astype(np.float32),
        K=K.astype(np.float32),
        T_curr_prev=np.vstack([T, [0, 0, 0, 1]]).astype(np.float32),
        rotation_deg=matrix_to_euler_deg(T[:, :3]).astype(np.float32),
        translation=T[:, 3].astype(np.float32),
        moving=np.ascontiguousarray(moving),
        rays=ray.astype(np.float32),
    )
