"""Whether the rows of an image are exposed at one time."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hybridvo.core.types import Frame
from hybridvo.run.commands.diagnosis.answer import Diagnosis
from hybridvo.run.commands.diagnosis.clocks import middle_frames
from hybridvo.tracking.camera_drift import CAMERA_SIGMAS
from hybridvo.tracking.passes import find_times

REMEDY = "turn the camera to and fro, also in the plane of the image, or pass more --pairs"


def rolling_shutter(sequence: Any, pairs: int) -> Diagnosis:
    """Answer whether the rows of an image are exposed at one time, or as the camera states.

    Args:
        sequence: The :class:`~hybridvo.io.data.sequence.Sequence`, or what is used like one.
        pairs: How many pairs of neighbours in a row are tracked, at most.
    """
    frames = [_untold(frame) for frame in middle_frames(sequence, pairs)]
    times = find_times(frames)
    shown = times.readout
    if shown is None or not times.readout_is_known:
        return Diagnosis(
            None, f"too few quick turns of the camera show it: {REMEDY}"
        )
    text = f"{shown.pairs} turns fit a readout of {shown.error:.0f} +- {shown.std:.0f} ms"
    stated_ms = sequence.frame(0).camera.readout_ms
    if abs(shown.error - stated_ms) < CAMERA_SIGMAS * shown.std:
        fitting = "stated" if stated_ms else "or none"
        return Diagnosis(False, f"{text}, {fitting}")
    if shown.error < -CAMERA_SIGMAS * shown.std:
        return Diagnosis(
            None,
            f"{text}, as if the last row was exposed first: are the images upside down?",
        )
    remedy = f"state --readout-ms {max(shown.error, 0.0):.0f}"
    if not stated_ms:
        # passes find what is not stated
        remedy += ", or --passes 3"
    return Diagnosis(None, f"{text}: {remedy}")


def _untold(frame: Frame) -> Frame:
    """A frame whose camera states no readout."""
    return replace(frame, camera=replace(frame.camera, readout_ms=0.0))
