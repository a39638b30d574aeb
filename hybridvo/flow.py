"""Optical flow for a pair of frames: from files, from OpenCV's DIS, or from any callable.

A provider never raises on bad images: where no flow can be had it is None.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from hybridvo.calibration import (
    DIS_NOISE,
    FLOW_CONTRADICTION,
    FULL_RESOLUTION_MAX_PIXELS,
    MIN_TEXTURED,
)
from hybridvo.errors import InputError
from hybridvo.types import Frame, FramePair

# in the order of OpenCV's numbers, from 0
DIS_PRESETS = ("ultrafast", "fast", "medium")
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FlowField:
    """The optical flow of a pair, as a flow provider returns it.

    Attributes:
        flow: (H, W, 2) pixels (u, v), previous to current, on the previous grid; None: there is
            none.
        variance: (H, W) px^2 of a component, or None.
        valid: (H, W) bool, False where the flow is known to be wrong, or None.
        source: file, dis, or the name of a callable.
        is_true: whether it is ground truth: an oracle.
    """

    flow: np.ndarray | None
    variance: np.ndarray | None = None
    valid: np.ndarray | None = None
    source: str = "unknown"
    is_true: bool = False


# (previous, current) -> their flow
FlowProvider = Callable[[Frame, Frame], FlowField]


def dis_flow(preset: str = "medium") -> FlowProvider:
    """Return a provider of OpenCV's DIS flow on grey images (Kroeger et al., ECCV 2016).

    Flow is computed in both directions, whose disagreement gives variance and validity; it is None
    where an image has no texture. ``preset`` is the effort: ``ultrafast``, ``fast`` or ``medium``.
    """
    if preset not in DIS_PRESETS:
        raise InputError(
            f"DIS preset: expected {', '.join(DIS_PRESETS)}, got {preset!r}."
        )
    return _Dis(preset)


@dataclass(frozen=True)
class _Dis:
    preset: str
    source = "dis"

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        none = FlowField(None, source="dis")
        if prev.rgb is None or curr.rgb is None or prev.rgb.shape != curr.rgb.shape:
            return none
        first, second = (
            cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in (prev.rgb, curr.rgb)
        )
        if not (_textured(first) and _textured(second)):
            return none
        whole = self.preset == "medium" and first.size <= FULL_RESOLUTION_MAX_PIXELS
        forward = _calc_dis(self.preset, first, second, whole)
        backward = _calc_dis(self.preset, second, first, whole)
        if forward is None or backward is None:
            return none
        return FlowField(
            forward, *forward_backward_check(forward, backward, whole), "dis"
        )


def _calc_dis(
    preset: str, first: np.ndarray, second: np.ndarray, whole: bool = False
) -> np.ndarray | None:
    """(H, W, 2) flow of grey images, down to their own pixels if ``whole``; None if too small."""
    height, width = first.shape
    # below 32 rows DIS chooses its coarsest level by the width alone, and where that leaves fewer
    # rows than a patch has, it ends the process
    if height < 32 and width > 2 * height:
        return None
    # a new one in each call: threads may not share one, and it keeps the scales of a small image
    dis: Any = cv2.DISOpticalFlow.create(DIS_PRESETS.index(preset))
    if whole:
        dis.setFinestScale(0)
        dis.setPatchStride(4)
    try:
        return np.asarray(dis.calc(first, second, None))
    except cv2.error:  # smaller than its patches
        return None


def _textured(gray: np.ndarray) -> bool:
    """Whether some of an image changes along every direction, above the noise of a dark sensor."""
    if min(gray.shape) < 2:
        return False
    # shrunk to 120 pixels or more on the shorter side, which averages a sensor's noise out
    factor = max(1, min(gray.shape) // 120)
    small = cv2.resize(
        gray, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA
    )
    small = cv2.blur(small.astype(np.float32), (3, 3))
    gradient = np.stack(np.gradient(small), axis=-1).reshape(-1, 2)
    weaker = np.linalg.eigh(gradient.T @ gradient)[1][:, 0]
    # grey levels a pixel
    return bool(np.mean(np.abs(gradient @ weaker) > 1.0) > MIN_TEXTURED)


def forward_backward_check(
    forward: np.ndarray, backward: np.ndarray, whole: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return a flow's variance (H, W), px^2, and validity (H, W) by the flow backward.

    Flow is valid where |F(x) + B(x + F(x))| is at most 1.5 px or 5 % of its length. ``whole``:
    DIS went down to the image's own pixels, and is half as noisy where both agree.
    """
    du, dv = cv2.split(np.nan_to_num(forward, nan=1e9, posinf=1e9, neginf=-1e9))
    u, v, inside = _targets(du, dv)
    back = cv2.remap(
        backward, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    squared = (du + back[..., 0]) ** 2 + (dv + back[..., 1]) ** 2
    valid = (squared <= np.maximum(1.5**2, 0.05**2 * (du * du + dv * dv))) & inside
    base = np.float32(DIS_NOISE[0] / (2 if whole else 1))
    factor = np.float32(DIS_NOISE[1])
    return np.minimum(base**2 + factor**2 * squared, np.float32(5.0**2)), valid


def _targets(
    du: np.ndarray, dv: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The columns and rows (H, W) to which a flow leads, and whether they are in the image."""
    height, width = du.shape
    u = du + np.arange(width, dtype=np.float32)
    v = dv + np.arange(height, dtype=np.float32)[:, None]
    return u, v, (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)


def file_flow(
    sequence: Any, *, strict: bool = True, otherwise: FlowProvider | None = None
) -> FlowProvider:
    """Return a provider of a sequence's flow files, which asks ``otherwise`` where there is none.

    A damaged file raises an error if ``strict``; else it is logged and counts as none.
    """

    def provide(prev: Frame, curr: Frame) -> FlowField:
        flow = valid = None
        if curr.index == prev.index + 1:
            try:
                flow, valid = sequence.flow(prev.index)
            except FileNotFoundError:
                pass
            except (InputError, OSError) as error:
                if strict:
                    raise
                _logger.warning("flow of frame %d: %s", prev.index, error)
        if flow is None and otherwise is not None:
            return otherwise(prev, curr)
        return FlowField(flow, None, valid, "file", sequence.flow_is_true)

    return provide


class MeasuredFlow:
    """A provider that keeps the last field, and the milliseconds spent since the last reset."""

    def __init__(self, provider: FlowProvider) -> None:
        self._provider = provider
        self.source = getattr(provider, "source", "")
        self.reset()

    def reset(self) -> None:
        """Forget the last field and the time."""
        self.last = FlowField(None, source="")
        self.ms = 0.0

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        """Ask the provider, and keep what it returns."""
        started = time.perf_counter()
        self.last = self._provider(prev, curr)
        self.ms += 1e3 * (time.perf_counter() - started)
        return self.last


def with_flow(
    pair: FramePair,
    provider: Callable[[Frame, Frame], Any] | None,
    source: str = "callable",
) -> FramePair:
    """Return the pair with the flow of a provider, or of a callable that returns an array.

    A pair that has flow already is returned as it is.
    """
    if pair.flow is not None or provider is None:
        return pair
    field = provider(pair.prev, pair.curr)
    field = (
        field if isinstance(field, FlowField) else FlowField(field, source=source)
    )
    known = field.flow, field.variance, field.valid, field.source, field.is_true
    return FramePair(pair.prev, pair.curr, *known, pair.depth_source)


def contradiction(pair: FramePair) -> str | None:
    """Return why the flow of a pair cannot be that of its images, or None.

    A flow with the wrong sign, direction, unit or pair warps one image onto the other no better
    than no flow does. Without images or with too little texture this cannot be told; DIS flow,
    which comes from the images, is not checked.
    """
    rgb_prev = pair.prev.rgb
    rgb_curr = pair.curr.rgb
    flow = pair.flow
    if (
        rgb_prev is None
        or rgb_curr is None
        or flow is None
        or pair.flow_source == "dis"
    ):
        return None
    height, width = flow.shape[:2]
    # at 100 pixels and more, details do not matter
    factor = max(1, min(height, width) // 100)
    size = (width // factor, height // factor)
    first, second = (
        cv2.blur(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), (3, 3))
        for gray in (
            cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in (rgb_prev, rgb_curr)
        )
    )
    own = _calc_dis("fast", first, second)
    if own is None:
        return None
    # the flow on the coarser grid, in its pixels, smoothed: single wrong pixels do not matter
    rows, columns = (
        slice(factor // 2, factor * n, factor) for n in (size[1], size[0])
    )
    small = flow[rows, columns] / np.float32(factor)
    seen = np.asarray(np.isfinite(small).all(axis=2))
    if pair.flow_valid is not None:
        seen &= pair.flow_valid[rows, columns]
    small = np.where(seen[..., None], small, np.float32(0))
    small = np.dstack(
        [cv2.blur(cv2.medianBlur(x, 5), (5, 5)) for x in cv2.split(small)]
    )
    du = cv2.Sobel(first, cv2.CV_32F, 1, 0) / 8
    dv = cv2.Sobel(first, cv2.CV_32F, 0, 1) / 8
    # grey levels a pixel: where a shift can be seen
    seen &= cv2.magnitude(du, dv) > 2.0
    ways = [
        _targets(x[..., 0], x[..., 1]) for x in (small, own, np.zeros_like(own))
    ]
    seen &= ways[0][2] & ways[1][2]
    if np.count_nonzero(seen) < 200:
        return None
    # median grey levels between the first image and the second one warped onto it
    warped = (
        cv2.remap(second.astype(np.float32), u, v, cv2.INTER_LINEAR)
        for u, v, _ in ways
    )
    given, best, still = (
        float(np.median(np.abs(image - first)[seen])) for image in warped
    )
    fits, is_decidable = FLOW_CONTRADICTION
    if given < fits * still or still < is_decidable * best + 1:
        return None
    return (
        f"the flow ({pair.flow_source}) warps the previous image onto the current one hardly "
        f"better than no flow ({given:.1f} and {still:.1f} grey levels; DIS: {best:.1f}). Expected "
        f"pixels, (u, v), from the previous frame to the current one: check its sign, its "
        f"direction, its unit and which pair it belongs to."
    )
