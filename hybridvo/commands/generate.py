"""``hybridvo generate``: draw training samples into a folder, and show some of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from hybridvo.errors import InputError
from hybridvo.evaluation.plots import flow_colours
from hybridvo.files import atomic_write
from hybridvo.synthetic.dataset import PRESETS, Preset, load_preset, read_sample, write_samples
from hybridvo.synthetic.layered import Sample

TITLES = (
    "1 rays of K",
    "2 depth of t",
    "3 what moves",
    "4 camera's flow",
    "4 objects' flow",
    "5 total flow",
    "5 depth of t+1",
)
LINE_PX = 18
"""Height of the line of text."""


def generate(
    preset: str,
    count: int,
    out: str | Path,
    *,
    seed: int = 0,
    size: Sequence[int] | None = None,
    workers: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> Path:
    """Draw samples, and a contact sheet of the first; goes on where it was interrupted.

    ``preset`` is ``paper``, ``diverse`` or a file such as ``configs/data_paper.yaml``, ``size``
    (height, width) instead of its own; ``report`` is called with the samples done and asked for.
    """
    for done in write_samples(_preset(preset, size), count, out, seed, workers):
        if report is not None:
            report(done, count)
    sheet = Path(out) / "contact_sheet.png"
    write_sheet([read_sample(out, i) for i in range(min(6, count))], sheet)
    return sheet


def _preset(name: str, size: Sequence[int] | None) -> Preset:
    if name in PRESETS:
        options = PRESETS[name]()
        if size is None:
            return options
        return cast(Preset, dataclasses.replace(cast(Any, options), height=size[0], width=size[1]))
    if not Path(name).is_file():
        known = ", ".join(PRESETS)
        raise InputError(f"--preset: expected {known} or a YAML file, got {name!r}.")
    return load_preset(name, size=None if size is None else (size[0], size[1]))


def write_sheet(samples: Sequence[Sample], path: str | Path) -> None:
    """Write a PNG with the five steps of each sample in a row.

    Flow is coloured by direction, and the more the longer up to the sample's 98 % quantile; depth
    is bright where near.
    """
    width = samples[0].moving.shape[1]
    header = np.full((LINE_PX, len(TITLES) * width, 3), 255, np.uint8)
    for k, title in enumerate(TITLES):
        place, font = (k * width + 2, 13), cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(header, title, place, font, 0.38, (0, 0, 0), 1, cv2.LINE_AA)
    sheet = np.concatenate([header, *(np.hstack(_steps(sample)) for sample in samples)])
    with atomic_write(path, "wb") as file:
        file.write(cv2.imencode(".png", sheet[..., ::-1])[1].tobytes())


def _steps(sample: Sample) -> list[np.ndarray]:
    """Images (H, W, 3) under :data:`TITLES`."""
    height, width = sample.moving.shape
    x = (np.arange(width) - sample.K[0, 2]) / sample.K[0, 0]
    y = (np.arange(height) - sample.K[1, 2]) / sample.K[1, 1]
    rays = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
    longest = max(float(np.quantile(np.linalg.norm(sample.flow, axis=-1), 0.98)), 1e-3)
    return [
        flow_colours(rays, 1.0),
        _depth_gray(sample.depth_prev),
        np.repeat(np.where(sample.moving, 255, 40).astype(np.uint8)[..., None], 3, axis=2),
        flow_colours(sample.ego_flow, longest),
        flow_colours(sample.flow - sample.ego_flow, longest),
        flow_colours(sample.flow, longest),
        _depth_gray(sample.depth_curr),
    ]


def _depth_gray(depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: bright is near on a logarithmic scale, black is invalid."""
    known = depth > 0
    log = np.log(np.where(known, depth, 1.0))
    low, high = (log[known].min(), log[known].max()) if known.any() else (0.0, 1.0)
    gray = np.where(known, 255 - 200 * (log - low) / max(high - low, 1e-6), 0)
    return np.repeat(gray.astype(np.uint8)[..., None], 3, axis=2)
