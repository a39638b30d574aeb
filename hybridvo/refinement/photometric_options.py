"""Options and report of the photometric polish."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hybridvo.errors import InputError

__all__ = ["PhotometricOptions", "PolishReport"]


@dataclass(frozen=True)
class PhotometricOptions:
    """Options of :func:`hybridvo.refinement.photometric.polish_photometric`.

    Args:
        blur_px: standard deviations of the Gaussian blur, coarse to fine. The finest also decides
            how much of the interpolation error is left.
        iterations: most Gauss-Newton steps under each of them.
        pixels: about how many pixels are used, the strongest gradients of evenly spread cells.
        least_weight: robust weight in the refinement below which a pixel is not used.
        cutoff: c of the Geman-McClure kernel, in standard deviations.
        flow_inflation: factor on the flow's covariance. The errors of estimated flow are alike over
            distances far beyond the blocks of its sandwich covariance: with DIS the squared error,
            in units of that covariance, has a median of 8 to 10 where 5.4 is expected, and a long
            tail. With less than this the polish errs more on development sequences.
        image_inflation: the same for the images, beyond their own tiles (interpolation, shading).
        freedom: degrees of freedom of the Student prior around the flow's motion: how well its
            covariance is known.
        largest_shift: longest shift from the flow's motion, in its inflated standard deviations.
        least_gain: share of the flow's information that the images must add in some direction.
        least_correlation: of the two pictures over the pixels used; below it they do not match.
        least_pixels: fewer usable pixels are not enough.
        least_seen: share of the weight that must fall inside the current picture.
    """

    blur_px: tuple[float, ...] = (2.0, 1.0)
    iterations: int = 5
    pixels: int = 16000
    least_weight: float = 0.25
    cutoff: float = 3.0
    flow_inflation: float = 8.0
    image_inflation: float = 4.0
    freedom: float = 6.0
    largest_shift: float = 9.0
    least_gain: float = 0.1
    least_correlation: float = 0.5
    least_pixels: int = 200
    least_seen: float = 0.3

    def __post_init__(self) -> None:
        if not self.blur_px or not all(0 < value < 100 for value in self.blur_px):
            raise InputError(
                f"PhotometricOptions.blur_px: expected positive numbers below 100, coarse to fine, "
                f"got {self.blur_px!r}."
            )
        for name in (
            *(
                "iterations",
                "pixels",
                "least_weight",
                "cutoff",
                "flow_inflation",
                "image_inflation",
            ),
            *("freedom", "largest_shift", "least_pixels"),
        ):
            if not getattr(self, name) > 0:
                raise InputError(
                    f"PhotometricOptions.{name}: expected a positive number, "
                    f"got {getattr(self, name)!r}."
                )


@dataclass(frozen=True, eq=False)
class PolishReport:
    """What the images said of one pair.

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
        gain, offset: of the current picture over the previous one; offset in grey levels.
        noise_grey: standard deviation of the residual, grey levels.
        correlation: of the two pictures over the pixels used.
        pixels: how many were used.
        agreement: factor in (0, 1] on the information of the images by which the parts of the
            picture, held against each other, lowered it.
        uneven_light: whether gain and offset had to vary over the picture.
        depth_shift_px: (2,) shift (right, down) of the depth map against the picture that would
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
