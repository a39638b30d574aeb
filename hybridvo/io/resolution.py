"""Whether intrinsics can be those of the images, or are those of another resolution."""

from __future__ import annotations

from hybridvo.core.types import Camera
from hybridvo.io.calibration import CENTRAL_PRINCIPAL_POINT

FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2, 3, 4)
"""By which images are usually made larger or smaller."""
SIZES = (
    *((640, 480), (848, 480), (1280, 720), (1280, 800), (1280, 960), (1280, 1024)),
    *((1920, 1080), (1920, 1440), (2048, 1536), (2560, 1440), (3840, 2160)),
)
"""Sizes of images that cameras have, width and height, pixels."""
NEAR_CENTRE = 0.1
"""Distance from the centre, as a fraction of the size, to which a principal point belongs to it."""


def resolution_question(camera: Camera) -> str:
    """Return the question whether intrinsics are those of another resolution; empty if hardly.

    The principal point of nearly every camera lies near the centre of its images. Far from there
    are those of a cropped image, and of intrinsics that were calibrated at another size.

    Args:
        camera: as it was given.

    >>> resolution_question(Camera(1034.0, 1034.0, 637.0, 510.0, height=480, width=640))
    'the principal point (637, 510) is not near the centre of images of 640x480 pixels: are the \
intrinsics for 1280x960? Then scale them; or are the images cropped?'
    """
    at = ((camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height)
    low, high = CENTRAL_PRINCIPAL_POINT
    if all(low <= part <= high for part in at):
        return ""
    size = _fitting_size(camera)
    question = (
        f"are the intrinsics for {size}? Then scale them; or are" if size else "are"
    )
    return (
        f"the principal point ({camera.cx:.4g}, {camera.cy:.4g}) is not near the centre of "
        f"images of {camera.width}x{camera.height} pixels: {question} the images cropped?"
    )


def _fitting_size(camera: Camera) -> str:
    """The size of images in whose centre the principal point lies, as WxH; empty if unknown."""
    same_shape = [
        (round(factor * camera.width), round(factor * camera.height))
        for factor in FACTORS
    ]
    for sizes in (same_shape, SIZES):
        best = min(sizes, key=lambda size: _distance(camera, *size))
        if _distance(camera, *best) <= NEAR_CENTRE:
            return f"{best[0]}x{best[1]}"
    return ""


def _distance(camera: Camera, width: int, height: int) -> float:
    """How far the principal point is from the centre of images of a size, in their sizes."""
    from_column = abs((camera.cx + 0.5) / width - 0.5)
    from_row = abs((camera.cy + 0.5) / height - 0.5)
    return max(from_column, from_row)
