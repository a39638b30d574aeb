"""Optical flow for a pair of frames: from files, OpenCV's DIS, or any callable.

A provider never raises on bad images: where there is no flow, it returns None for
it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, in_two_threads
from hybridvo.core.checks import check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.stages import stage
from hybridvo.core.types import Frame, FramePair
from hybridvo.flow.calibration import (
    DIS_NOISE,
    FLOW_CONTRADICTION,
    FLOW_TEXTURE_GRADIENT,
    FULL_RESOLUTION_MAX_PIXELS,
    MIN_TEXTURED,
    SHIFT_GRADIENT,
    TEXTURE_OVER_NOISE,
)
from hybridvo.flow.frame_images import grey_bytes
from hybridvo.flow.kernels import check_rows

# Distance of the patches of DIS (medium), px: as many answers are right as with 3, in three
# quarters of the time.
DIS_PATCH_STRIDE = 4
# Shorter side to which images are shrunk to measure their texture, px: that averages the noise of
# a sensor out. By hand; ``make golden`` shows the effect of a change.
TEXTURE_SIDE_PX = 120
# Shorter side to which a pair is shrunk to compare it with its flow, px: details do not matter
# there.
COMPARED_SIDE_PX = 100
# Such pixels of a pair of that size, below which a flow is not compared with its images.
MIN_COMPARED_PIXELS = 200

# in the order of OpenCV's numbers, from 0
DIS_PRESETS = ("ultrafast", "fast", "medium")
# of the flow from the current image to the previous one, by which wrong flow is found
BACKWARD_PRESET = "fast"
# second differences along both axes, which leave of an image little but its noise, and
# their standard deviation where that of the noise is 1 (Immerkaer, CVIU 1996)
NOISE_MASK = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
NOISE_GAIN = 6.0
# median of the absolute value of a standard normal number
MEDIAN_ABSOLUTE_NORMAL = 0.6745
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class FlowField:
    """The optical flow of a pair, as a flow provider returns it.

    Attributes:
        flow: (H, W, 2) pixels (u, v), previous to current, on the previous grid;
            None: there is none.
        variance: (H, W) px^2 of a component, or None.
        valid: (H, W) bool, False where the flow is known to be wrong, or None.
        source: file, dis, or the name of a callable.
        is_true: whether it is ground truth: an oracle.

    >>> field = FlowField(np.zeros((60, 80, 2), np.float32), source="my network")
    >>> field.variance is None
    True
    """

    flow: np.ndarray | None
    variance: np.ndarray | None = None
    valid: np.ndarray | None = None
    source: str = "unknown"
    is_true: bool = False


FlowProvider = Callable[[Frame, Frame], FlowField]
"""Previous and current frame -> their flow."""


class Targets(NamedTuple):
    """Where a flow leads."""

    u: np.ndarray  # (H, W) columns
    v: np.ndarray  # (H, W) rows
    inside: np.ndarray  # (H, W) bool: inside the image


# -- DIS ---------------------------------------------------------------------------


def dis_flow(preset: str = "medium") -> FlowProvider:
    """Return a provider of OpenCV's DIS flow (Kroeger et al., ECCV 2016).

    Flow is computed in both directions, whose disagreement gives variance and
    validity; it is None where an image has no texture.

    Args:
        preset: the effort: ``ultrafast``, ``fast`` or ``medium``.

    Returns:
        A callable of the previous and the current frame that returns a FlowField.

    Raises:
        InputError: the preset is unknown.

    >>> import hybridvo as hvo
    >>> prev, curr, _ = hvo.example_frames()
    >>> field = dis_flow()(prev, curr)
    >>> field.flow.shape, field.source
    ((120, 160, 2), 'dis')
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
        check_kind("dis_flow()(prev, curr): prev", prev, Frame)
        check_kind("dis_flow()(prev, curr): curr", curr, Frame)
        no_flow = FlowField(None, source="dis")
        if prev.rgb is None or curr.rgb is None or prev.rgb.shape != curr.rgb.shape:
            return no_flow
        if not have_texture(prev, curr):
            return no_flow
        grey_prev = grey_bytes(prev)
        grey_curr = grey_bytes(curr)
        is_small = grey_prev.size <= FULL_RESOLUTION_MAX_PIXELS
        full_resolution = self.preset == "medium" and is_small
        forward = _calc_dis(self.preset, grey_prev, grey_curr, full_resolution)
        is_reduced = self.preset == "medium" and not full_resolution
        back = BACKWARD_PRESET if is_reduced else self.preset
        backward = _calc_dis(back, grey_curr, grey_prev, full_resolution)
        if forward is None or backward is None:
            return no_flow
        variance, valid = forward_backward_check(forward, backward, full_resolution)
        return FlowField(forward, variance, valid, "dis")


def _calc_dis(
    preset: str,
    grey_prev: np.ndarray,
    grey_curr: np.ndarray,
    full_resolution: bool = False,
) -> np.ndarray | None:
    """(H, W, 2) flow of grey images; None where they are too small.

    With ``full_resolution`` DIS goes down to the images' own pixels.
    """
    height, width = grey_prev.shape
    # below 32 rows DIS chooses its coarsest level by the width alone, and where
    # that leaves fewer rows than a patch has, it ends the process
    if height < 32 and width > 2 * height:
        return None
    # a new one in each call: threads may not share one, and it keeps the scales of
    # a small image
    dis: Any = cv2.DISOpticalFlow.create(DIS_PRESETS.index(preset))
    if full_resolution:
        dis.setFinestScale(0)
    if preset == "medium":
        dis.setPatchStride(DIS_PATCH_STRIDE)
    try:
        return np.asarray(dis.calc(grey_prev, grey_curr, None))
    except cv2.error:  # smaller than its patches
        return None


@kept_with_frame
def has_texture(frame: Frame) -> bool:
    """Return whether an image changes along every direction by more than its noise.

    An image without texture, as that of a covered lens or of a bare wall, looks the same
    wherever the camera went.

    Args:
        frame: any; without an image it has no texture.

    >>> import hybridvo as hvo
    >>> seen = hvo.example_frames()[0]
    >>> has_texture(seen), has_texture(replace(seen, rgb=0 * seen.rgb))
    (True, False)
    """
    if frame.rgb is None:
        return False
    grey = grey_bytes(frame)
    if min(grey.shape) < 2:
        return False
    factor = max(1, min(grey.shape) // TEXTURE_SIDE_PX)
    small = cv2.resize(
        grey, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA
    )
    small = small.astype(np.float32)
    noise = _image_noise(small)
    smooth = cv2.blur(small, (3, 3))
    down, across = np.gradient(smooth)
    mixed = np.sum(down * across)
    products = [[np.sum(down * down), mixed], [mixed, np.sum(across * across)]]
    _, directions = np.linalg.eigh(products)
    weakest_down, weakest_across = directions[:, 0]
    along_weakest = np.abs(down * weakest_down + across * weakest_across)
    limit = max(FLOW_TEXTURE_GRADIENT, TEXTURE_OVER_NOISE * noise)
    return bool(np.mean(along_weakest > limit) > MIN_TEXTURED)


def have_texture(prev: Frame, curr: Frame) -> bool:
    """Whether both images of a pair show more than noise."""
    return has_texture(prev) and has_texture(curr)


def _image_noise(grey: np.ndarray) -> float:
    """Standard deviation of the noise of an image, grey levels."""
    lengths = np.abs(cv2.filter2D(grey, -1, NOISE_MASK))
    return float(np.median(lengths)) / (NOISE_GAIN * MEDIAN_ABSOLUTE_NORMAL)


def forward_backward_check(
    forward: np.ndarray, backward: np.ndarray, full_resolution: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return variance and validity of a flow by the flow backward.

    The difference of both directions is ``|F(x) + B(x + F(x))|``.

    Args:
        forward: (H, W, 2) F, px, from the previous to the current image.
        backward: (H, W, 2) B, from the current to the previous one.
        full_resolution: whether DIS went down to the image's own pixels: it is half
            as noisy where both agree.

    Returns:
        The variance (H, W) of a component, px^2, and where the flow is valid (H,
        W): it ends inside the image, and the difference is small.
    """
    height, width = forward.shape[:2]
    variance = np.empty((height, width), np.float32)
    valid = np.empty((height, width), bool)
    base_std, factor = DIS_NOISE
    if full_resolution:
        base_std = base_std / 2
    flows = as_contiguous(forward, np.float32), as_contiguous(backward, np.float32)
    noise = np.float32(base_std**2), np.float32(factor**2)
    in_two_threads(
        lambda first, last: check_rows(*flows, noise, first, last, variance, valid),
        height,
    )
    return variance, valid


def _targets(du: np.ndarray, dv: np.ndarray) -> Targets:
    """Where a flow, as columns and rows (H, W), leads."""
    height, width = du.shape
    u = du + np.arange(width, dtype=np.float32)
    v = dv + np.arange(height, dtype=np.float32)[:, None]
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    return Targets(u, v, inside)


# -- other providers ---------------------------------------------------------------


def file_flow(
    sequence: Any, *, strict: bool = True, otherwise: FlowProvider | None = None
) -> FlowProvider:
    """Return a provider of a sequence's flow files.

    Args:
        sequence: an open sequence; its files lead from each frame to the next.
        strict: whether a damaged file raises an error; else it is logged, and
            counts as missing.
        otherwise: the provider for pairs without a file; None: they have no flow.
    """

    def provide(prev: Frame, curr: Frame) -> FlowField:
        flow = None
        valid = None
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
    """A provider that keeps its last field and the time since the last reset.

    Attributes:
        last: what the provider returned last.
        ms: milliseconds spent in it.
        source: the provider's own source, or empty.
    """

    def __init__(self, provider: FlowProvider) -> None:
        self._provider = provider
        self.source = getattr(provider, "source", "")
        self.reset()

    def reset(self) -> None:
        """Forget the last field and the time."""
        self.last = FlowField(None, source="")
        self.ms = 0.0

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        """Call the provider, and keep what it returns."""
        started = time.perf_counter()
        self.last = self._provider(prev, curr)
        self.ms += 1e3 * (time.perf_counter() - started)
        return self.last


class FlowAhead:
    """A provider that computes the flow of one pair beside other work, on a second core.

    Args:
        provider: it must not mind being called from another thread.
        prev: previous frame.
        curr: current frame.
    """

    def __init__(self, provider: FlowProvider, prev: Frame, curr: Frame) -> None:
        self._provider = provider
        self._frames = (prev, curr)
        self._pool = ThreadPoolExecutor(1)
        self._flow = self._pool.submit(provider, prev, curr)
        self.source = getattr(provider, "source", "")

    def __call__(self, prev: Frame, curr: Frame) -> FlowField:
        """Wait for the flow of that pair; compute that of any other one."""
        if prev is self._frames[0] and curr is self._frames[1]:
            return self._flow.result()
        return self._provider(prev, curr)

    def __enter__(self) -> FlowAhead:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()


def with_flow(
    pair: FramePair,
    provider: Callable[[Frame, Frame], Any] | None,
    source: str = "callable",
) -> FramePair:
    """Return a pair with the flow of a provider, unless it has flow already.

    Args:
        pair: two frames.
        provider: called with both frames; returns a FlowField, or a flow (H, W, 2)
            alone.
        source: name of a provider that returns an array.

    Raises:
        InputError: for flow that does not fit the frames.
    """
    if pair.flow is not None or provider is None:
        return pair
    with stage("flow"):
        field = provider(pair.prev, pair.curr)
    if not isinstance(field, FlowField):
        field = FlowField(field, source=source)
    return replace(
        pair,
        flow=field.flow,
        flow_variance=field.variance,
        flow_valid=field.valid,
        flow_source=field.source,
        flow_is_true=field.is_true,
    )


# -- a flow against its images -----------------------------------------------------


class WarpErrors(NamedTuple):
    """Median differences between a warped image and its target, grey levels."""

    given: float  # warped by the given flow
    dis: float  # warped by DIS flow of the same images
    still: float  # not warped


def contradiction(pair: FramePair) -> str | None:
    """Return why the flow of a pair cannot be that of its images, or None.

    A flow with the wrong sign, direction, unit or pair warps one image onto the
    other no better than no flow does. Without images or with too little texture
    this cannot be decided; DIS flow, which comes from the images, is not checked.
    """
    if pair.flow is None or pair.flow_source == "dis":
        return None
    errors = _warp_errors(pair)
    if errors is None:
        return None
    fits, is_decidable = FLOW_CONTRADICTION
    given_fits = errors.given < fits * errors.still
    dis_fits = errors.still >= is_decidable * errors.dis + 1
    if given_fits or not dis_fits:
        return None
    return (
        f"the flow ({pair.flow_source}) warps the previous image onto the current one "
        f"hardly better than no flow ({errors.given:.1f} and {errors.still:.1f} grey "
        f"levels; DIS: {errors.dis:.1f}). Expected pixels, (u, v), from the previous "
        f"frame to the current one: check its sign, its direction, its unit and which "
        f"pair it belongs to."
    )


def _warp_errors(pair: FramePair) -> WarpErrors | None:
    """How well three flows warp a pair's images; None where undecidable."""
    if not pair.has_images:
        return None
    factor = max(1, min(pair.prev.camera.shape) // COMPARED_SIDE_PX)
    grey_prev = _shrunk_grey(pair.prev, factor)
    grey_curr = _shrunk_grey(pair.curr, factor)
    dis = _calc_dis("fast", grey_prev, grey_curr)
    if dis is None:
        return None
    given, known = _shrunk_flow(pair, factor)
    given_targets = _targets(given[..., 0], given[..., 1])
    dis_targets = _targets(dis[..., 0], dis[..., 1])
    no_flow = np.zeros(grey_prev.shape, np.float32)
    compared = known & _shows_shift(grey_prev)
    compared &= given_targets.inside & dis_targets.inside
    if np.count_nonzero(compared) < MIN_COMPARED_PIXELS:
        return None

    def error(targets: Targets) -> float:
        warped = cv2.remap(
            grey_curr.astype(np.float32), targets.u, targets.v, cv2.INTER_LINEAR
        )
        return float(np.median(np.abs(warped - grey_prev)[compared]))

    return WarpErrors(
        given=error(given_targets),
        dis=error(dis_targets),
        still=error(_targets(no_flow, no_flow)),
    )


def _shrunk_grey(frame: Frame, factor: int) -> np.ndarray:
    """(h, w) uint8 grey image at 1 / ``factor`` of the size, blurred."""
    grey = grey_bytes(frame)
    height, width = grey.shape
    size = (width // factor, height // factor)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.blur(small, (3, 3)))


def _shrunk_flow(pair: FramePair, factor: int) -> tuple[np.ndarray, np.ndarray]:
    """Flow at 1 / ``factor`` of the size, in its pixels, and where it is known.

    The flow is smoothed, because single wrong pixels do not matter.
    """
    assert pair.flow is not None
    height, width = pair.prev.camera.shape
    first = factor // 2
    rows = slice(first, factor * (height // factor), factor)
    columns = slice(first, factor * (width // factor), factor)
    flow = pair.flow[rows, columns] / np.float32(factor)
    known = np.asarray(np.isfinite(flow).all(axis=2))
    if pair.flow_valid is not None:
        known = known & pair.flow_valid[rows, columns]
    flow = np.where(known[..., None], flow, np.float32(0))
    components = [
        cv2.blur(cv2.medianBlur(component, 5), (5, 5))
        for component in cv2.split(flow)
    ]
    return np.dstack(components), known


def _shows_shift(grey: np.ndarray) -> np.ndarray:
    """(h, w) where an image has so much gradient that a shift of it is visible."""
    # Sobel's kernel of 3x3 sums up to eight times the gradient
    du = cv2.Sobel(grey, cv2.CV_32F, 1, 0) / 8
    dv = cv2.Sobel(grey, cv2.CV_32F, 0, 1) / 8
    return np.asarray(cv2.magnitude(du, dv) > SHIFT_GRADIENT)
