"""Whether depth lies on the pixels of the image, by the edges of both."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.types import Frame
from hybridvo.run.calibration import (
    CERTAIN_REGISTRATION_STDS,
    CERTAIN_ZOOM_STDS,
    NEEDED_REGISTRATION_GAIN,
    NORMAL_REGISTRATION_SHIFT,
)
from hybridvo.run.commands.diagnosis.answer import Diagnosis
from hybridvo.run.commands.diagnosis.inspection import (
    MAX_EDGE_DISPLACEMENT,
    edge_agreement,
)

ZOOMS = (0.88, 0.9, 0.92, 0.94, 0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08, 1.1, 1.12)
"""Factors by which depth is enlarged about the centre of the image, and compared with it."""
ZOOM_FRAMES = 10
"""Frames that are enlarged, at most."""
REMEDY = (
    "register depth to colour (RealSense: rs.align; ROS: depth_image_proc/register)"
)


class Shift(NamedTuple):
    """A displacement in an image, pixels."""

    right: int
    down: int


def registration(maps: list[np.ndarray]) -> Diagnosis:
    """Answer whether the edges of depth lie on those of the images.

    Args:
        maps: Of some frames, as :func:`edge_agreement` returns them.
    """
    if not maps:
        return Diagnosis(None, "no frame has both an image and depth")
    agreement = np.mean(np.stack(maps), axis=0)
    best = _best_shift(agreement)
    if best is None:
        causes = "too few or too soft, or depth is not registered to colour"
        return Diagnosis(
            None,
            f"no shift brings the edges of depth onto those of the images: {causes}",
        )
    text = f"edges of depth lie {_in_words(best)} of those in the images"
    m, n = (size // 2 for size in agreement.shape)
    longer_side = max(m, n) / MAX_EDGE_DISPLACEMENT
    limit = NORMAL_REGISTRATION_SHIFT * longer_side
    is_near = np.hypot(best.right, best.down) <= limit
    radius = round(limit)
    near = agreement[m - radius : m + radius + 1, n - radius : n + radius + 1]
    is_better = agreement.max() >= NEEDED_REGISTRATION_GAIN * near.max()
    if is_near:
        if best == Shift(0, 0):
            return Diagnosis(False, "edges of depth lie on those of the images")
        # edges of depth are wide
        return Diagnosis(False, f"{text}, within the {radius} px that are usual")
    if not is_better:
        text = (
            "edges of depth fit to those of the images nearly as well where they are as "
            f"{_in_words(best)} of there"
        )
        return Diagnosis(False, text)
    return Diagnosis(True, f"{text}: {REMEDY}, or crop and scale both alike")


def _in_words(shift: Shift) -> str:
    """Describe a displacement, as 14 px left and 2 px down."""
    column = "left" if shift.right < 0 else "right"
    row = "up" if shift.down < 0 else "down"
    return f"{abs(shift.right)} px {column} and {abs(shift.down)} px {row}"


def _best_shift(agreement: np.ndarray) -> Shift | None:
    """Return the displacement with the best agreement of edges; None where it is not clear.

    Args:
        agreement: As :func:`edge_agreement` returns it.
    """
    shift = _highest(agreement)
    m, n = (size // 2 for size in agreement.shape)
    is_at_border = abs(shift.right) == n or abs(shift.down) == m
    limit = CERTAIN_REGISTRATION_STDS * agreement.std()
    if agreement.max() < limit or is_at_border:
        return None
    return shift


def _highest(agreement: np.ndarray) -> Shift:
    """Return the displacement with the best agreement of edges."""
    m, n = (size // 2 for size in agreement.shape)
    y, x = np.unravel_index(int(agreement.argmax()), agreement.shape)
    return Shift(right=int(x) - n, down=int(y) - m)


# -- depth of another focal length -------------------------------------------------------


def zoomed_registration(sequence: Any) -> Diagnosis | None:
    """Answer whether depth is that of a camera with another focal length.

    Such depth agrees with the image nowhere but in its middle, and no shift helps.

    Args:
        sequence: The sequence, whose edges agree at no shift.

    Returns:
        That it differs; None where no factor brings the edges together.
    """
    frames = _distributed_frames(sequence)
    if not frames:
        return None
    clarity = {zoom: _clarity(frames, zoom) for zoom in ZOOMS}
    zoom = max(ZOOMS, key=lambda each: clarity[each])
    needed = max(CERTAIN_ZOOM_STDS, NEEDED_REGISTRATION_GAIN * clarity[1.0])
    if clarity[zoom] < needed:
        return None
    width = frames[0].camera.width
    border_px = abs(zoom - 1) / zoom * width / 2
    size = "large" if zoom < 1 else "small"
    text = (
        f"depth fits to the images if it is scaled by {zoom:g}: it is that of a camera "
        f"with another focal length, too {size} by up to {border_px:.0f} px at the border"
    )
    return Diagnosis(True, f"{text}: {REMEDY}")


def _distributed_frames(sequence: Any) -> list[Frame]:
    """Read frames with image and depth, evenly distributed."""
    last = len(sequence) - 1
    count = min(ZOOM_FRAMES, last + 1)
    places = np.linspace(0, last, count).round().astype(int)
    frames = []
    for index in np.unique(places).tolist():
        try:
            frame = sequence.frame(index)
        except (InputError, OSError):
            continue
        if frame.is_rgbd:
            frames.append(frame)
    return frames


def _clarity(frames: list[Frame], zoom: float) -> float:
    """How far the best agreement of enlarged depth stands out, standard deviations."""
    maps = []
    for frame in frames:
        assert frame.rgb is not None
        assert frame.depth is not None
        depth = _enlarged(frame.depth, zoom)
        maps.append(edge_agreement(frame.rgb, depth))
    agreement = np.mean(np.stack(maps), axis=0)
    return float(agreement.max() / max(agreement.std(), 1e-12))


def _enlarged(depth: np.ndarray, zoom: float) -> np.ndarray:
    """Enlarge a depth map (H, W) about its centre; what comes from outside is 0."""
    if zoom == 1:
        return depth
    height, width = depth.shape
    centre = ((width - 1) / 2, (height - 1) / 2)
    matrix = cv2.getRotationMatrix2D(centre, 0, zoom)
    size = (width, height)
    return cv2.warpAffine(depth, matrix, size, flags=cv2.INTER_NEAREST)
