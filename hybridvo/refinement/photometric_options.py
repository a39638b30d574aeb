"""Report of the photometric refinement."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, eq=False)
class PhotometricReport:
    """What the images add to the motion of one pair.

    Args:
        taken: whether the motion was changed.
        reason: why not, one word: ``no_images``, ``no_estimate``, ``no_texture``, ``no_match``,
            ``out_of_view``, ``outside_flow``, ``higher_cost``, ``no_gain``, ``not_finite``; empty
            where taken.
        message: the same for people.
        shift: (6,) left tangent from the flow's motion to that of the images and the flow.
        shift_sigma: its length in standard deviations of the flow (inflated).
        image_information: (6, 6) of the images alone; flow_information: (6, 6) of the flow alone,
            both as they were added up.
        gain, offset: of the current image over the previous one; offset in grey levels.
        noise_grey: standard deviation of the residual, grey levels.
        correlation: of the two images over the pixels used.
        pixels: how many were used.
        agreement: factor in (0, 1] on the information of the images by which the parts of the
            image, held against each other, lowered it.
        uneven_light: whether gain and offset had to vary over the image.
        depth_shift_px: (2,) shift (right, down) of the depth map against the image that would
            explain the residuals best, px.
        depth_shift_information: (2, 2) of it.
    """

    taken: bool
    reason: str = ""
    message: str = ""
    shift: np.ndarray = field(default_factory=lambda: np.zeros(6))
    shift_sigma: float = 0.0
    image_information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    flow_information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    gain: float = 1.0
    offset: float = 0.0
    noise_grey: float = 0.0
    correlation: float = 0.0
    pixels: int = 0
    agreement: float = 1.0
    uneven_light: bool = False
    depth_shift_px: np.ndarray = field(default_factory=lambda: np.zeros(2))
    depth_shift_information: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
