"""Whether frames come as often as they should, and evenly."""

from __future__ import annotations

import numpy as np

from hybridvo.run.calibration import (
    MAX_JITTER,
    MAX_LATE_SHARE,
    STAMP_GAP_FACTOR,
)
from hybridvo.run.commands.diagnosis.answer import Diagnosis
from hybridvo.run.commands.diagnosis.capture import Captured

# of the rate of a live camera to the one requested, from which it holds
MIN_RATE_RATIO = 0.9
MILLISECONDS = (5.0, 1000.0)
"""Intervals of stamps, s, that nobody tracks, but that are usual in milliseconds."""


def seems_in_milliseconds(stamps: np.ndarray) -> bool:
    """Return whether time stamps (N,), which should be seconds, seem to be milliseconds.

    Example:
        >>> seems_in_milliseconds(np.arange(9) * 33.3), seems_in_milliseconds(np.arange(9) / 30)
        (True, False)
    """
    intervals = np.diff(stamps)
    if not len(intervals):
        return False
    low, high = MILLISECONDS
    return low <= float(np.median(intervals)) <= high


def gaps(stamps: np.ndarray) -> Diagnosis:
    """Answer whether frames were dropped, by their time stamps (N,), seconds."""
    intervals = np.diff(stamps)
    if len(intervals) < 2:
        return Diagnosis(None, "fewer than three frames")
    usual = float(np.median(intervals))
    if seems_in_milliseconds(stamps):
        fps = f"{1000 / usual:.4g}"
        return Diagnosis(
            True,
            f"{1 / usual:.2g} frames a second: stamps seem to be milliseconds, expected seconds: "
            f"divide them by 1000, or pass --fps {fps}",
            ("--fps", fps),
        )
    is_gap = intervals > STAMP_GAP_FACTOR * usual
    text = (
        f"{1 / usual:.3g} frames a second; "
        f"{is_gap.sum()} of {len(is_gap)} intervals are gaps"
    )
    if not is_gap.any():
        return Diagnosis(False, text)
    dropped = int((np.rint(intervals[is_gap] / usual) - 1).sum())
    longest = int(np.argmax(intervals))
    text += f" ({dropped} frames)"
    text += f", the longest {intervals[longest]:.3g} s after frame {longest}"
    if is_gap.mean() <= MAX_LATE_SHARE:
        return Diagnosis(False, text)
    remedy = "record slower, smaller, or to a faster disk"
    return Diagnosis(True, f"{text}: frames were dropped; {remedy}")


def jitter(stamps: np.ndarray) -> Diagnosis:
    """Answer whether frames come evenly, by their time stamps (N,), seconds."""
    intervals = np.diff(stamps)
    if len(intervals) < 2:
        return Diagnosis(None, "fewer than three frames")
    usual = float(np.median(intervals))
    whole = np.maximum(np.rint(intervals / usual), 1)
    away = intervals - whole * usual
    std_s = float(np.sqrt(np.mean(away**2)))
    text = f"intervals are {1000 * usual:.3g} ms or whole numbers of it, +- {1000 * std_s:.1f} ms"
    if std_s <= MAX_JITTER * usual:
        return Diagnosis(False, text)
    remedy = "take the stamps of the camera, not the times of arrival"
    return Diagnosis(True, f"{text}: {remedy}")


def camera_rate(captured: Captured) -> Diagnosis:
    """Answer whether a live camera keeps the rate that was requested."""
    count = len(captured)
    if count < 2:
        return Diagnosis(None, "fewer than two frames")
    stamps = captured.timestamps
    rate = (count - 1) / float(stamps[-1] - stamps[0])
    text = f"{rate:.3g} frames a second"
    if captured.lost:
        text += f"; {captured.lost} never came, by the camera's own count"
    if captured.asked_fps is None:
        return Diagnosis(False, text)
    text += f"; {captured.asked_fps:g} requested"
    if rate >= MIN_RATE_RATIO * captured.asked_fps:
        return Diagnosis(False, text)
    remedy = "USB 3, a smaller image, a fixed exposure, fewer programs beside"
    return Diagnosis(True, f"{text}: {remedy}")
