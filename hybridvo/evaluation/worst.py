"""The worst pairs of a comparison: which they are, and a strip of images of each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from hybridvo.data.sequence import open_sequence
from hybridvo.errors import InputError
from hybridvo.estimation import estimate
from hybridvo.evaluation.maps import error_map, flow_colours, longest_flow, uncertainty_maps
from hybridvo.evaluation.pair_errors import true_motion
from hybridvo.evaluation.saliency import last_pass
from hybridvo.evaluation.scores import FACTORS, PAIR_ERRORS, is_failed, known_number
from hybridvo.evaluation.sequence_job import Job, open_flow
from hybridvo.files import atomic_write
from hybridvo.network.layers import KINDS
from hybridvo.network.models import Models
from hybridvo.pipeline import networks_of
from hybridvo.results import PixelwisePrediction
from hybridvo.types import FramePair

THUMBNAIL_WIDTH = 256
"""Width of each panel of a worst pair, px: a report holds a hundred of them."""
ERROR_RANGE_PX = (0.01, 10.0)
"""Ends of the colours of every error map of the worst pairs, px, logarithmic."""


def worst_pairs(pairs: pd.DataFrame, count: int = 3) -> list[dict[str, Any]]:
    """The worst pairs of each method and flow source, worst first.

    Pairs without a known error come last, and only if their estimate failed.

    Args:
        pairs: table of all pairs and methods.
        count: pairs of each method and flow source.
    """
    columns = ["sequence", "index", "status", "message", *PAIR_ERRORS, *FACTORS]
    found = []
    for (method, flow), group in pairs.groupby(["method", "flow_source"], sort=False):
        known = group[group["epe_l2_px"].notna() | is_failed(group)]
        worst = known.sort_values("epe_l2_px", ascending=False, kind="stable").head(count)
        for rank, row in enumerate(worst[columns].to_dict("records"), 1):
            values = {k: known_number(v) if isinstance(v, float) else v for k, v in row.items()}
            found.append({"method": method, "flow_source": flow, "rank": rank, **values})
    return found


def draw_worst(
    out: Path,
    stem: str,
    job: Job,
    entries: Iterable[dict[str, Any]],
    rows: Iterable[Mapping[str, Any]],
) -> None:
    """Draw worst pairs of one sequence, with the motion that the comparison found.

    Args:
        out: folder of the comparison.
        stem: of the names of the images in it.
        job: the sequence and the methods.
        entries: get ``picture`` (a path), or None and ``picture_reason``.
        rows: of the sequence, with ``prev``, ``next`` and ``T_curr_prev``.
    """
    sequence, models = open_sequence(job.path, job.dataset), Models(job.device, job.weights)
    flows = dict(open_flow(name, sequence) for name in job.flows)
    found = {(row["index"], row["method"], row["flow_source"]): row for row in rows}
    for entry in entries:
        method, label = entry["method"], entry["flow_source"]
        row = found[entry["index"], method, label]
        entry |= {"picture": None, "picture_reason": None}
        try:
            prev, curr = sequence.frame(row["prev"]), sequence.frame(row["next"])
        except (InputError, OSError) as error:
            entry["picture_reason"] = f"the pair cannot be read: {error}"
            continue
        field = flows[label](prev, curr)
        pair = FramePair(prev, curr, field.flow, field.variance, field.valid)
        panels = _worst_panels(pair, row, true_motion(sequence, prev.index, curr.index))
        if not entry["status"].startswith("failed"):
            panels += _weight_panels(pair, method, models)
        image = np.concatenate([_panel(*panel, prev.camera.shape) for panel in panels], axis=1)
        entry["picture"] = f"{stem}_{entry['index']:06d}_{method}_{label.split()[0]}.jpg"
        encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
        with atomic_write(out / entry["picture"], "wb") as file:
            file.write(encoded[1].tobytes())


def _worst_panels(
    pair: FramePair, row: Mapping[str, Any], T_gt: np.ndarray | None
) -> list[tuple[np.ndarray | None, str]]:
    """(image, caption) of the previous frame, the flow, and the distance of the two ego flows."""
    prev = pair.prev
    panels = [(prev.rgb, f"frame {prev.index}" if prev.rgb is not None else "no image")]
    if pair.flow is None:
        panels.append((None, "no flow"))
    else:
        longest = longest_flow(pair.flow)
        panels.append((flow_colours(pair.flow, longest), f"flow, to {longest:.3g} px"))
    if T_gt is None or prev.depth is None:
        return [*panels, (None, "error unknown")]
    T_est = np.array(row["T_curr_prev"]).reshape(4, 4)
    low, high = ERROR_RANGE_PX
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        error = error_map(T_est, T_gt, prev.depth, prev.camera, pair.curr.camera)
        heat = _heat(np.log(error / low) / np.log(high / low), np.isfinite(error))
    return [*panels, (heat, f"error {low:g} to {high:g} px, log")]


def _weight_panels(
    pair: FramePair, method: str, models: Models
) -> list[tuple[np.ndarray | None, str]]:
    """(image, caption) of the pixels' weights and of the uncertainty that a network predicts.

    Both are of the pair on its own: without what a tracker knows from the frames before.
    """
    motion = estimate(pair, method=method, models=models)
    panels: list[tuple[np.ndarray | None, str]] = []
    if motion.weights is not None:
        known = np.isfinite(motion.weights)
        panels.append((_heat(motion.weights, known), "weights, 0 to 1"))
    for name in networks_of(method):
        network = models.network(name)
        if getattr(network, "options", None) is None or network.options.kind not in KINDS:
            continue
        output = last_pass(network, pair)[0]
        if isinstance(output, PixelwisePrediction) and output.log_scale_rotation is not None:
            scale = uncertainty_maps(output)[0]
            top = max(float(np.percentile(scale, 99)), 1e-12)
            heat = _heat(scale / top, np.isfinite(scale))
            panels.append((heat, f"{name}: rotation, 1 sigma, to {top:.2g} deg"))
    return panels


def _heat(relative: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 RGB colours of values in [0, 1]; grey where nothing is known."""
    grey = np.clip(255 * np.nan_to_num(relative, nan=0.0), 0, 255).astype(np.uint8)
    heat = cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1].copy()
    heat[~known] = 128
    return heat


def _panel(image: np.ndarray | None, caption: str, shape: tuple[int, int]) -> np.ndarray:
    """Image of the common width with a line of text below."""
    size = THUMBNAIL_WIDTH, max(1, round(THUMBNAIL_WIDTH * shape[0] / shape[1]))
    small = np.full((size[1], size[0], 3), 128, np.uint8)
    if image is not None:
        small[:] = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
    strip = np.full((18, THUMBNAIL_WIDTH, 3), 255, np.uint8)
    place, font = (4, 13), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(strip, caption, place, font, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([small, strip])
