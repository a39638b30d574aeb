"""Pictures of the pairs on which methods are worst: frame, flow, and where the motion is wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.checks import make_folder
from hybridvo.comparison.job import Job, flow_label, true_motion
from hybridvo.comparison.results import Segments, file_stem
from hybridvo.configuration import RunOptions
from hybridvo.data.sequence import Sequence as FrameSequence
from hybridvo.errors import InputError
from hybridvo.evaluation.maps import error_map, flow_colours, longest_flow
from hybridvo.evaluation.report_data import one_line
from hybridvo.files import atomic_write
from hybridvo.flow import FlowField
from hybridvo.run import flow_provider
from hybridvo.types import Frame

__all__ = ["picture_worst"]

PANEL_WIDTH = 256
"""Width of each of the three panels, px: a report holds a hundred of these pictures."""
JPEG_QUALITY = 80
_CAPTION_PX = 18
_UNKNOWN = (128, 128, 128)


def picture_worst(
    out: Path,
    worst: Iterable[Mapping[str, Any]],
    jobs: Sequence[Job],
    sequences: Sequence[FrameSequence],
    segments: Segments,
) -> list[dict[str, Any]]:
    """Entries of ``worst_pairs`` with ``status``, ``message``, ``picture`` and ``picture_reason``.

    Frames are read again, each pair once for all methods that are worst on it.

    Args:
        out: output folder; pictures go to its folder ``worst``.
        worst: entries without pictures.
        jobs: of the comparison.
        sequences: one for each job.
        segments: what the jobs gave.

    Raises:
        OutputError: a picture cannot be written.
    """
    found = [dict(entry) for entry in worst]
    wanted: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for entry in found:
        wanted.setdefault((entry["sequence"], entry["index"]), []).append(entry)
    if found:
        make_folder(out / "worst")
    for number, (job, sequence) in enumerate(zip(jobs, sequences, strict=True)):
        if not any(name == job.name for name, _ in wanted):
            continue
        for segment in segments.of(number):
            for pair in segment["pairs"]:
                entries = wanted.get((job.name, pair["index"]), [])
                if entries:
                    stem = f"{file_stem(number, job.name)}_{pair['index']:06d}"
                    _picture_pair(out, stem, job, sequence, pair, entries)
    return found


def _picture_pair(
    out: Path,
    stem: str,
    job: Job,
    sequence: FrameSequence,
    pair: Mapping[str, Any],
    entries: Sequence[dict[str, Any]],
) -> None:
    """Pictures of one pair for the methods in ``entries``, which are completed."""
    flows = {flow_label(flow, sequence): flow for flow in job.flows}
    results = {(r["method"], r["flow"]): r for r in pair["results"]}
    fields: dict[str, FlowField] = {}
    try:
        prev, curr = sequence.frame(pair["index"]), sequence.frame(pair["next"])
        for flow in {flows[entry["flow_source"]] for entry in entries}:
            provider = flow_provider(sequence, RunOptions(flow=flow, stride=job.stride))
            fields[flow] = provider(prev, curr)
        reason = None
    except (InputError, OSError) as error:
        reason = f"the pair cannot be read again: {error}"
    for entry in entries:
        flow = flows[entry["flow_source"]]
        result = results[entry["method"], flow]
        entry |= {
            "status": result["status"],
            "message": one_line(result["message"]),
            "picture": None,
            "picture_reason": reason,
        }
        if reason is not None:
            continue
        T_est = np.array(result["T_curr_prev"]).reshape(4, 4)
        T_true = true_motion(sequence, prev.index, curr.index)
        image = _three_panels(prev, curr, fields[flow], T_est, T_true)
        entry["picture"] = f"worst/{stem}_{entry['method']}_{flow}.jpg"
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        with atomic_write(out / entry["picture"], "wb") as file:
            file.write(cv2.imencode(".jpg", image[..., ::-1], options)[1].tobytes())


def _three_panels(
    prev: Frame, curr: Frame, field: FlowField, T_est: np.ndarray, T_true: np.ndarray | None
) -> np.ndarray:
    """(H, W, 3) uint8 RGB: previous frame, flow, and distance of the two ego flows."""
    panels = [_panel(prev.rgb, f"frame {prev.index}" if prev.rgb is not None else "no image", prev)]
    if field.flow is None:
        panels.append(_panel(None, "no flow", prev))
    else:
        flow = field.flow
        if field.valid is not None:
            flow = np.where(field.valid[..., None], flow, np.nan)
        longest = longest_flow(flow)
        panels.append(_panel(flow_colours(flow, longest), f"flow, to {longest:.3g} px", prev))
    if T_true is None or prev.depth is None:
        panels.append(_panel(None, "error unknown", prev))
    else:
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            error = error_map(T_est, T_true, prev.depth, prev.camera, curr.camera)
        known = np.isfinite(error)
        largest = max(float(np.percentile(error[known], 99)), 1e-6) if known.any() else 1.0
        grey = np.clip(255 * np.where(known, error, 0.0) / largest, 0, 255).astype(np.uint8)
        heat = cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1].copy()
        heat[~known] = _UNKNOWN
        panels.append(_panel(heat, f"error, to {largest:.3g} px", prev))
    return np.concatenate(panels, axis=1)


def _panel(image: np.ndarray | None, caption: str, frame: Frame) -> np.ndarray:
    """Picture of the common width with a line of text below."""
    height, width = frame.camera.shape
    size = PANEL_WIDTH, max(1, round(PANEL_WIDTH * height / width))
    if image is None:
        small = np.full((size[1], size[0], 3), _UNKNOWN, np.uint8)
    else:
        shrunk = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA)
        small = np.asarray(shrunk, np.uint8)
    strip = np.full((_CAPTION_PX, PANEL_WIDTH, 3), 255, np.uint8)
    cv2.putText(
        strip, caption, (4, _CAPTION_PX - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1,
        cv2.LINE_AA,
    )  # fmt: skip
    return np.concatenate([small, strip])
