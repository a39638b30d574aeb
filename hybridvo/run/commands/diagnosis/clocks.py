"""Whether the stamps of colour and depth are of one clock, by the motion that both show.

The image of colour and the map of inverse depth move alike over the pixels. Each gives a curve of
velocities over its own stamps; the time by which one has to be shifted onto the other is the
offset of the clocks.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from hybridvo.core.errors import InputError
from hybridvo.core.types import Frame
from hybridvo.io.data.sequence import Sequence
from hybridvo.run.calibration import (
    CLOCK_SMOOTHING,
    MAX_CLOCK_OFFSET_S,
    MAX_CLOCK_STD_S,
    MIN_CLOCK_CORRELATION,
)
from hybridvo.run.commands.diagnosis.answer import Diagnosis

# pairs in a row from which the clocks are compared: half a second
MIN_CLOCK_PAIRS = 15
# standard deviations by which an offset must differ from 0
CLOCK_SIGMAS = 3.0

WORKING_WIDTH = 320
"""Width to which images are reduced, pixels."""
SAMPLES = 8
"""Samples of a curve from one frame to the next."""
LAG_RATIO = 0.25
"""Largest offset that is looked for, in the length of the recording."""
WHOLE_FRAME = 0.3
"""What is added to an offset, in frames, before it is rounded down: one that is too small leaves a
lag, one that is too large takes maps from the future. By hand: where depth of fr1_rpy is stamped
100 ms late, 120 ms are found (3.6 frames); the path is 4.5 cm off by three frames, 8.4 by four."""
NEAREST_M = 0.3
"""Depth that is drawn white, metres."""


class Curve(NamedTuple):
    """Motion of an image over its pixels."""

    stamps: np.ndarray  # (N + 1,) seconds
    steps: np.ndarray  # (N, 2) pixels, right and down, from each frame to the next


class Offset(NamedTuple):
    """By how much one curve comes later than another."""

    seconds: float
    std: float  # seconds
    correlation: float  # of the two curves, at this offset


def one_clock(sequence: Any, pairs: int) -> Diagnosis:
    """Answer whether the stamps of colour and depth are of one clock.

    Args:
        sequence: The :class:`~hybridvo.io.data.sequence.Sequence`, or what is used like one.
        pairs: How many pairs of neighbours in a row are looked at, at most.
    """
    measured = image_motions(sequence, pairs)
    if measured is None:
        count = MIN_CLOCK_PAIRS + 1
        return Diagnosis(None, f"fewer than {count} frames in a row have both")
    colour, depth = measured
    remedy = "turn the camera to and fro while you record"
    offset = find_offset(colour, depth)
    if offset is None or offset.correlation < MIN_CLOCK_CORRELATION:
        text = "colour and depth do not move alike: too little motion of the camera"
        return Diagnosis(None, f"{text}, or too much of other things: {remedy}")
    ms = 1000 * offset.seconds
    std_ms = 1000 * offset.std
    text = f"depth comes {abs(ms):.0f} +- {std_ms:.0f} ms "
    text += "after" if ms > 0 else "before"
    text += " colour, by the stamps"
    if offset.std > MAX_CLOCK_STD_S:
        return Diagnosis(None, f"{text}, too uncertain: {remedy}, at a higher rate")
    is_far = abs(offset.seconds) > MAX_CLOCK_OFFSET_S
    is_certain = abs(offset.seconds) > CLOCK_SIGMAS * offset.std
    if not (is_far and is_certain):
        return Diagnosis(False, text)
    option = _remedy(sequence, ms)
    return Diagnosis(
        True,
        f"{text}: pass {' '.join(option)}, or let the camera synchronise the two",
        option,
    )


def _remedy(sequence: Any, ms: float) -> tuple[str, str]:
    """The option that removes an offset of the clocks, ms.

    Maps of depth can be matched anew by whole frames alone: by a part of one, some images would get
    an earlier map and some a later one, which is worse than a lag that is always the same.
    """
    stamps = getattr(sequence, "depth_timestamps", None)
    # a live camera hands out both at once, and so does a folder that is matched by names
    if isinstance(sequence, Sequence) and stamps is not None:
        frame_ms = 1000 * float(np.median(np.diff(stamps)))
        frames = np.sign(ms) * np.floor(abs(ms) / frame_ms + WHOLE_FRAME)
        if frames:
            return "--depth-offset-ms", f"{frames * frame_ms:.0f}"
    # a map that comes late shows what was there before
    return "--depth-lag-ms", f"{-ms:.0f}"


# -- the motion of images ----------------------------------------------------------------


def image_motions(sequence: Any, pairs: int) -> tuple[Curve, Curve] | None:
    """Measure how the images and the depth maps of a sequence move, in its middle.

    Args:
        sequence: The sequence.
        pairs: How many pairs of neighbours in a row, at most.

    Returns:
        The curves of colour and of depth; None where too few frames in a row have both.
    """
    count = min(pairs, len(sequence) - 1)
    if count < MIN_CLOCK_PAIRS:
        return None
    first = (len(sequence) - 1 - count) // 2
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    colour_steps = []
    depth_steps = []
    for prev, curr in itertools.pairwise(middle_frames(sequence, pairs)):
        colour_steps.append(_median_flow(flow, prev.rgb, curr.rgb, _grey))
        depth_steps.append(_median_flow(flow, prev.depth, curr.depth, _nearness))
    found = len(colour_steps)
    if found < MIN_CLOCK_PAIRS:
        return None
    used = slice(first, first + found + 1)
    depth_stamps = getattr(sequence, "depth_timestamps", None)
    if depth_stamps is None:
        depth_stamps = sequence.timestamps
    colour = Curve(sequence.timestamps[used], np.array(colour_steps))
    depth = Curve(depth_stamps[used], np.array(depth_steps))
    return colour, depth


def complete_frame(sequence: Any, index: int) -> Frame | None:
    """Read a frame; None where it is broken, or has no image or no depth.

    Args:
        sequence: The sequence, or what is used like one.
        index: Of the frame.
    """
    try:
        frame = sequence.frame(index)
    except (InputError, OSError):
        return None
    return frame if frame.is_rgbd else None


def middle_frames(sequence: Any, pairs: int) -> Iterator[Frame]:
    """Read frames in a row in the middle of a sequence, up to the first that is broken.

    Args:
        sequence: The sequence, or what is used like one.
        pairs: Of neighbours, at most.
    """
    count = min(pairs, len(sequence) - 1)
    first = (len(sequence) - 1 - count) // 2
    for index in range(first, first + count + 1):
        frame = complete_frame(sequence, index)
        if frame is None:
            return
        yield frame


def _median_flow(
    flow: Any,
    prev: np.ndarray | None,
    curr: np.ndarray | None,
    picture: Callable[[Any], np.ndarray],
) -> np.ndarray:
    """Median motion (2,) between two images, pixels of the reduced size."""
    field = flow.calc(picture(prev), picture(curr), None)
    return np.median(field.reshape(-1, 2), axis=0)


def _grey(rgb: np.ndarray) -> np.ndarray:
    """Reduce an image (H, W, 3) to grey values (h, w) uint8."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return _reduced(grey, cv2.INTER_AREA)


def _nearness(depth: np.ndarray) -> np.ndarray:
    """Draw inverse depth as a picture (h, w) uint8; black where there is none."""
    small = _reduced(depth, cv2.INTER_NEAREST)
    is_valid = np.isfinite(small) & (small > 0)
    inverse = NEAREST_M / np.where(is_valid, small, np.inf)
    return np.clip(255 * inverse, 0, 255).astype(np.uint8)


def _reduced(image: np.ndarray, interpolation: int) -> np.ndarray:
    """Reduce an image (H, W) to the working width, if it is wider."""
    height, width = image.shape
    factor = WORKING_WIDTH / width
    if factor >= 1:
        return image
    size = (WORKING_WIDTH, round(factor * height))
    return cv2.resize(image, size, interpolation=interpolation)


# -- the offset of two curves ------------------------------------------------------------


def find_offset(colour: Curve, depth: Curve) -> Offset | None:
    """Find by how much the motion of depth comes after that of colour.

    Args:
        colour: The motion of the images.
        depth: The motion of the depth maps.

    Returns:
        The offset; None where no offset is better than its neighbours.

    Example:
        >>> stamps = np.arange(60) / 30
        >>> waves = np.sin(stamps[:, None] * [5.0, 3.0])
        >>> first = Curve(stamps, np.diff(waves, axis=0))
        >>> second = Curve(stamps + 0.05, np.diff(waves, axis=0))
        >>> round(find_offset(first, second).seconds, 3)
        0.05
    """
    frame_s = float(np.median(np.diff(colour.stamps)))
    start = max(colour.stamps[0], depth.stamps[0]) + frame_s / 2
    end = min(colour.stamps[-1], depth.stamps[-1]) - frame_s / 2
    step_s = frame_s / SAMPLES
    times = np.arange(start, end, step_s)
    longest = int(LAG_RATIO * len(times))
    if longest < 2:
        return None
    of_colour = _velocities(colour, times, frame_s)
    of_depth = _velocities(depth, times, frame_s)
    lags = np.arange(-longest, longest + 1)
    correlations = [_correlation(of_colour, of_depth, lag) for lag in lags.tolist()]
    best = int(np.argmax(correlations))
    if best in (0, len(lags) - 1):
        return None
    before, peak, after = correlations[best - 1 : best + 2]
    # a parabola through the best one and its neighbours
    curvature = 2 * peak - before - after
    if curvature <= 0:
        return None
    place = lags[best] + (after - before) / (2 * curvature)
    # frames that the smoothing leaves independent of each other
    independent = len(times) / (SAMPLES * 2 * np.sqrt(np.pi) * CLOCK_SMOOTHING)
    variance = (1 - peak**2) / (curvature * max(independent, 1.0))
    std_s = float(np.sqrt(max(variance, 0.0)) * step_s)
    return Offset(float(place * step_s), std_s, float(peak))


def _velocities(curve: Curve, times: np.ndarray, frame_s: float) -> np.ndarray:
    """The smoothed motion (n, 2) of a curve within a frame about some times, pixels."""
    places = np.vstack([np.zeros(2), np.cumsum(curve.steps, axis=0)])
    path = CubicSpline(curve.stamps, places)
    moved = path(times + frame_s / 2) - path(times - frame_s / 2)
    return gaussian_filter1d(moved, CLOCK_SMOOTHING * SAMPLES, axis=0)


def _correlation(first: np.ndarray, second: np.ndarray, lag: int) -> float:
    """Correlate a curve (n, 2) with another one that is ``lag`` samples later."""
    count = len(first) - abs(lag)
    early = first[max(0, -lag) :][:count]
    late = second[max(0, lag) :][:count]
    a = early - early.mean(axis=0)
    b = late - late.mean(axis=0)
    size = np.sqrt((a**2).sum() * (b**2).sum())
    return float((a * b).sum() / max(size, 1e-12))
