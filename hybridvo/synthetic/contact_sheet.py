"""A picture of drawn samples: one row a sample, the paper's five steps from left to right."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from hybridvo.files import atomic_write
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
LINE_PX, GAP_PX = 18, 4
"""Height of a line of text, space between tiles."""


def write_contact_sheet(samples: Sequence[Sample], path: str | Path) -> None:
    """Write a PNG with the five steps of each sample.

    Flow is coloured by direction, and the more the longer up to the sample's 98 % quantile; depth
    is bright where near. Under each row stand the camera's motion and focal length.

    Raises:
        OutputError: it cannot be written.
    """
    rows = [_header(samples[0].flow.shape[1])]
    rows += [_row(sample) for sample in samples]
    data = cv2.imencode(".png", np.concatenate(rows))[1]
    with atomic_write(path, "wb") as file:
        file.write(data.tobytes())


def _header(width: int) -> np.ndarray:
    return _joined([_text(title, width) for title in TITLES])


def _row(sample: Sample) -> np.ndarray:
    height, width = sample.moving.shape
    x = (np.arange(width) - sample.K[0, 2]) / sample.K[0, 0]
    y = (np.arange(height) - sample.K[1, 2]) / sample.K[1, 1]
    rays = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
    longest = max(float(np.quantile(np.linalg.norm(sample.flow, axis=-1), 0.98)), 1e-3)
    tiles = [
        _flow_colour(rays, 1.0),
        _depth_gray(sample.depth_prev),
        np.repeat(np.where(sample.moving, 255, 40).astype(np.uint8)[..., None], 3, axis=2),
        _flow_colour(sample.ego_flow, longest),
        _flow_colour(sample.flow - sample.ego_flow, longest),
        _flow_colour(sample.flow, longest),
        _depth_gray(sample.depth_curr),
    ]
    image = _joined(tiles)
    angles, t = (
        " ".join(f"{v:+.2f}" for v in x) for x in (sample.rotation_deg, sample.translation)
    )
    line = f"rotation {angles} deg, translation {t} m, fx {sample.K[0, 0]:.0f} px"
    return np.concatenate([image, _text(line, image.shape[1])])


def _joined(tiles: list[np.ndarray]) -> np.ndarray:
    gap = np.full((tiles[0].shape[0], GAP_PX, 3), 255, np.uint8)
    return np.concatenate([part for tile in tiles for part in (tile, gap)], axis=1)


def _text(line: str, width: int) -> np.ndarray:
    image = np.full((LINE_PX, width, 3), 255, np.uint8)
    cv2.putText(image, line, (2, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 1, cv2.LINE_AA)
    return image


def _flow_colour(flow: np.ndarray, longest: float) -> np.ndarray:
    """(H, W, 3) uint8 BGR: hue is the direction, saturation the length."""
    length = np.clip(np.linalg.norm(flow, axis=-1) / longest, 0, 1)
    hue = (np.arctan2(flow[..., 1], flow[..., 0]) / np.pi + 1) * 90
    hsv = np.stack([hue % 180, 255 * length, np.full_like(length, 255)], axis=-1)
    return cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2BGR)


def _depth_gray(depth: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: bright is near on a logarithmic scale, black is invalid."""
    known = depth > 0
    log = np.log(np.where(known, depth, 1.0))
    low, high = (log[known].min(), log[known].max()) if known.any() else (0.0, 1.0)
    gray = np.where(known, 255 - 200 * (log - low) / max(high - low, 1e-6), 0)
    return np.repeat(gray.astype(np.uint8)[..., None], 3, axis=2)
