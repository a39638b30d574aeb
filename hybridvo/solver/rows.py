"""Rows of the arrays of the photometric kernels; columns are pixels or points."""

from __future__ import annotations

from enum import IntEnum


class PixelRow(IntEnum):
    """What is known of a pixel of the previous image before it is moved."""

    RAY_X = 0
    """x of the point at depth 1 m."""
    RAY_Y = 1
    DEPTH = 2
    """Metres."""
    GREY = 3
    """Grey level, less mid grey."""
    GRADIENT_X = 4
    """Grey levels per pixel."""
    GRADIENT_Y = 5
    DEPTH_VARIANCE = 6
    """Variance of log depth, relative to a typical pixel."""
    WEIGHT = 7
    """Static weight, from 0 to 1."""


class ImageRow(IntEnum):
    """Residual and derivatives of a pixel at a motion, a gain and an offset."""

    RESIDUAL = 0
    """Grey levels; 0 where the pixel is not visible."""
    MOTION = 1
    """First of six rows: derivatives in the left tangent (translation, rotation).
    """
    GAIN = 7
    OFFSET = 8
    LOG_DEPTH = 9
    """Derivative in the log depth."""
    U = 10
    """Column in the current image, px; negative where the pixel is not visible."""
    V = 11


class PlaneRow(IntEnum):
    """What a motion makes of a point of the previous depth map."""

    RESIDUAL = 0
    """Distance to the current surface along its normal, metres."""
    MOTION = 1
    """First of six rows: derivatives in the left tangent (translation, rotation).
    """
    SURFACE_DEPTH = 7
    """Depth of the current surface, metres; 0 where there is none."""
    ROBUST = 8
    """Robust factor, from 0 to 1."""
    U = 9
    """Column in the current image, px; negative where the point is behind the
    camera."""
    V = 10


PIXEL_ROWS = len(PixelRow)
IMAGE_ROWS = ImageRow.V + 1
PLANE_ROWS = PlaneRow.V + 1
IMAGE_TERMS = ImageRow.OFFSET + 1
"""Rows of an image's normal equations: residual, motion, gain, offset."""
PLANE_TERMS = int(PlaneRow.SURFACE_DEPTH)
"""Rows of a depth map's normal equations: residual, motion."""
MOTION_TERMS = 6
"""Of these, the motion's."""
