"""Training pairs from the selector's samples: rendered scenes with true, noisy and DIS flow.

``tools/train.py selector-data`` writes the samples (shards of npz files); here they become samples
of the pixel-wise networks. What DIS makes of a crowd of movers cannot be imitated by a noise model,
and rendering a pair costs a hundred times what a training step on it does.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybridvo.errors import FormatError, InputError
from hybridvo.geometry import matrix_to_euler_deg
from hybridvo.synthetic.layered import Sample, rigid_flow

MOVING, STATIC, UNKNOWN = 0, 1, 255
"""Labels of the pixels in a shard."""
FIRST_RENDERED = 1
"""Sources from this number on are rendered; 0 is the diverse preset, which is drawn afresh."""
NAMES = ("exact", "coarse", "log_depth", "depth_true", "label", "T", "K", "stride", "source")


@dataclass(frozen=True)
class RenderedOptions:
    """Samples of a folder as samples of one size, mirrored at random.

    Args:
        folder: of the shards, from the current folder.
        held_out: folder of shards of held-out seeds, for evaluations.
        height, width: size of the sample in pixels.

    Raises:
        InputError: a size below 2 px.
    """

    folder: str
    held_out: str = ""
    height: int = 128
    width: int = 256

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 2:
            raise InputError(
                f"RenderedOptions: expected 2 px at least, got {self.height}x{self.width}."
            )

    def for_evaluation(self) -> RenderedOptions:
        """The same of the held-out samples.

        Raises:
            InputError: none are named.
        """
        if not self.held_out:
            raise InputError("RenderedOptions.held_out: no folder of held-out samples is named.")
        return replace(self, folder=self.held_out)

    def sample(self, rng: np.random.Generator) -> Sample:
        """One sample as it would be at the sample's size.

        Raises:
            InputError: a folder without shards. FormatError: a shard that is not one.
        """
        groups = _samples(self.folder)
        sizes = np.cumsum([len(group["source"]) for group in groups])
        choice = int(rng.integers(sizes[-1]))
        number = int(np.searchsorted(sizes, choice, side="right"))
        index = choice - int(sizes[number - 1] if number else 0)
        mirrored = rng.random(2) < 0.5
        return grid_sample(
            {name: array[index] for name, array in groups[number].items()},
            (self.height, self.width),
            (bool(mirrored[0]), bool(mirrored[1])),
        )


@functools.cache
def _samples(folder: str) -> list[dict[str, np.ndarray]]:
    """Rendered samples of a folder, one stack for every shape of grid."""
    by_shape: dict[tuple[int, ...], list[dict[str, np.ndarray]]] = {}
    for path in sorted(Path(folder).glob("*.npz")):
        try:
            with np.load(path) as file:
                keep = file["source"] >= FIRST_RENDERED
                shard = {name: file[name][keep] for name in NAMES}
        except (OSError, ValueError, KeyError) as error:
            raise FormatError(f"{path}: not a shard of samples: {error}.") from error
        if keep.any():
            by_shape.setdefault(shard["label"].shape[1:], []).append(shard)
    if not by_shape:
        raise InputError(
            f"{folder or '(no folder)'}: no shards of rendered samples; make some with "
            f"tools/train.py selector-data."
        )
    return [
        {name: np.concatenate([shard[name] for shard in shards]) for name in NAMES}
        for shards in by_shape.values()
    ]


def grid_sample(
    p: Mapping[str, np.ndarray], size: tuple[int, int], mirrored: tuple[bool, bool] = (False, False)
) -> Sample:
    """The nearest of a sample's measured pixels for each of the sample's, seen in mirrors.

    The rays are those of the pixels that were taken, so that flow and depth stay exact; ground
    truth belongs to the sample's own pixels.

    Args:
        p: arrays of one sample.
        size: (height, width) of the sample.
        mirrored: left to right, top to bottom.
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

    ray_x, ray_y, z, mu, mv = take(p["exact"])
    usable = take(p["coarse"][2]) > 0
    T = p["T"].astype(np.float64)
    ray = np.stack([ray_x, ray_y], axis=-1)
    flow = (np.stack([(mu - cx) / fx, (mv - cy) / fy], axis=-1) - ray) * focal
    planes = [take(p["log_depth"]).astype(np.float32), take(p["depth_true"]).astype(np.float32)]
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
    x = ((np.arange(W) - centre[0]) / focal[0]).astype(np.float32)
    y = ((np.arange(H) - centre[1]) / focal[1]).astype(np.float32)[:, None]
    known = depth_true > 0
    inverse = np.where(known, 1.0 / np.where(known, depth_true, 1.0), 0.0).astype(np.float32)
    t = T[:, 3].astype(np.float32)
    u, v, ratio = rigid_flow(x, y, inverse, T[:, :3], t, (float(focal[0]), float(focal[1])))
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]], np.float32)
    return Sample(
        flow=np.where(usable[..., None], flow, np.nan).astype(np.float32),
        ego_flow=np.stack([u, v], axis=-1).astype(np.float32),
        depth_prev=np.where(usable, z, 0.0).astype(np.float32),
        depth_curr=np.exp(np.nan_to_num(log_depth, nan=-np.inf)).astype(np.float32),
        depth_true=depth_true.astype(np.float32),
        depth_target=np.maximum(depth_true * ratio, 0.0).astype(np.float32),
        K=K,
        T_curr_prev=np.vstack([T, [0, 0, 0, 1]]).astype(np.float32),
        rotation_deg=matrix_to_euler_deg(T[:, :3]).astype(np.float32),
        translation=t,
        moving=np.ascontiguousarray(moving),
        rays=ray.astype(np.float32),
    )
