"""The likely cause of a motion that is not sure, by what its two frames show at little cost."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybridvo.core.geometry import rotation_angle
from hybridvo.core.results import Reason, Step
from hybridvo.core.types import Frame
from hybridvo.run.calibration import (
    MIN_FOCUS,
    MIN_TEXTURE,
    MIN_VALID_DEPTH,
)
from hybridvo.run.commands.diagnosis.inspection import sharpness, valid_fraction

# px by which depth lies beside the image from which the clocks are a likely cause
CLOCK_SHIFT_PX = 2.0

REPEATED = "repeated_frame"
UNIT = "depth_unit"
NO_IMAGE = "no_image"
FEW_DEPTH = "little_depth"
FEW_TEXTURE = "little_texture"
BLUR = "blur"
CLOCKS = "clocks"
CAUSES = {
    REPEATED: (
        "image or depth is that of the frame before, byte for byte: the camera repeats frames, as "
        "many do in the dark"
    ),
    UNIT: "depth is not in metres: --depth-scale",
    NO_IMAGE: "the file of the image is missing: see that it was copied",
    FEW_DEPTH: "few pixels have depth: distance, sunlight, glass, dark surfaces",
    FEW_TEXTURE: "few pixels have texture: more light, or another view",
    BLUR: "the image is blurred: a shorter exposure, or the focus",
    CLOCKS: (
        "colour and depth are not of the same moment while the camera turns: hybridvo doctor "
        "measures by how much"
    ),
}
"""Causes that two frames show, with their remedy."""


def likely_cause(
    step: Step, prev: Frame | None, curr: Frame, depth_delay_s: float = 0.0
) -> str:
    """Return the likely cause of a motion that is not ``ok``: a key of ``CAUSES``, or empty.

    It is what is unusual about the frames. That they are unusual does not prove that the motion is
    unsure for that.

    Args:
        step: what the tracker returned.
        prev: the frame from which the motion starts; None of the first one.
        curr: the frame that was tracked.
        depth_delay_s: by how much its depth is younger than its image, by the stamps, seconds.
    """
    if step.ok or prev is None:
        return ""
    if step.status.reason is Reason.DEPTH_UNIT:
        return UNIT
    has_images = prev.rgb is not None and curr.rgb is not None
    if step.status.reason is Reason.NO_FLOW and not has_images:
        return NO_IMAGE
    if _is_same(prev.rgb, curr.rgb) or _is_same(prev.depth, curr.depth):
        return REPEATED
    depths = [frame.depth for frame in (prev, curr) if frame.depth is not None]
    if any(valid_fraction(depth) < MIN_VALID_DEPTH for depth in depths):
        return FEW_DEPTH
    images = [frame.rgb for frame in (prev, curr) if frame.rgb is not None]
    measured = [sharpness(image) for image in images]
    if any(each.textured < MIN_TEXTURE for each in measured):
        return FEW_TEXTURE
    if any(each.focus < MIN_FOCUS for each in measured):
        return BLUR
    if _shift_px(step, prev, curr, depth_delay_s) > CLOCK_SHIFT_PX:
        return CLOCKS
    return ""


def depth_delay(sequence: Any, index: int) -> float:
    """Return by how much a frame's depth is younger than its image, seconds; 0 if unknown.

    Args:
        sequence: the sequence.
        index: of the frame.
    """
    stamps = getattr(sequence, "depth_timestamps", None)
    if stamps is None or index >= len(stamps):
        return 0.0
    delay = float(stamps[index] - sequence.timestamps[index])
    return delay if np.isfinite(delay) else 0.0


def _is_same(first: np.ndarray | None, second: np.ndarray | None) -> bool:
    """Whether two images, or two depth maps, are one."""
    if first is None or second is None:
        return False
    return np.array_equal(first, second, equal_nan=first.dtype.kind == "f")


def _shift_px(step: Step, prev: Frame, curr: Frame, depth_delay_s: float) -> float:
    """By how many pixels depth lies beside the image, for the camera has turned meanwhile."""
    passed = abs(curr.timestamp - prev.timestamp)
    if not step.usable or passed <= 0:
        return 0.0
    angle = float(rotation_angle(step.T_curr_prev[:3, :3]))
    return curr.camera.fx * angle * abs(depth_delay_s) / passed
