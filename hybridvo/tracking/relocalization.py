"""Places: a few earlier frames, far apart, from which a lost path is found again.

After a fast turn or a covered lens no motion to the frame before can be found. A few earlier
frames are kept as places, and the motion is sought from the one that resembles the frame best.
This is no map: no pose is revised, and the memory is constant.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hybridvo.core.geometry import invert, mean_flow
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.types import Frame
from hybridvo.tracking.calibration import ALIKE_PLACES, MIN_LIKENESS, PLACE_DISTANCE
from hybridvo.tracking.keyframes import Keyframe

# columns of the small images that are compared
WIDTH = 40
# part of a small image that is sought in another one, along each side
CORE = 0.6


def with_place(
    places: Sequence[Keyframe], keyframe: Keyframe, most: int
) -> tuple[Keyframe, ...]:
    """Add a keyframe to the places if it is far from each of them.

    Args:
        places: oldest first.
        keyframe: a frame whose motion was sure.
        most: so many are kept.

    Returns:
        The places; the oldest one makes room.
    """
    T_cam_world = invert(keyframe.T_world_cam)
    for place in places:
        flow = mean_flow(place.frame, T_cam_world @ place.T_world_cam)
        if flow < PLACE_DISTANCE:
            return tuple(places)
    return (*places, keyframe)[-most:]


def similar_places(places: Sequence[Keyframe], frame: Frame) -> list[Keyframe]:
    """Return the places that resemble a frame.

    Args:
        places: with images.
        frame: with an image.

    Returns:
        At most :data:`ALIKE_PLACES`, the one that resembles it best first.
    """
    if frame.rgb is None:
        return []
    small = small_image(frame)
    likeness = {
        place.count: similarity(small_image(place.frame), small) for place in places
    }
    alike = [place for place in places if likeness[place.count] > MIN_LIKENESS]
    alike.sort(key=lambda place: -likeness[place.count])
    return alike[:ALIKE_PLACES]


def are_apart(frame: Frame, T_world_cam: np.ndarray, T_other: np.ndarray) -> bool:
    """Return whether two poses of a frame are as far from each other as two places.

    Args:
        frame: what is visible there.
        T_world_cam: (4, 4) one pose.
        T_other: (4, 4) the other one.
    """
    return mean_flow(frame, invert(T_other) @ T_world_cam) >= PLACE_DISTANCE


def similarity(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of two small images where they match best, from -1 to 1.

    The core of one is sought in the other, so that a shift by a fifth of the width does no harm.
    """
    height, width = a.shape
    rows = round(height * (1 - CORE) / 2)
    columns = round(width * (1 - CORE) / 2)
    core = np.ascontiguousarray(a[rows : height - rows, columns : width - columns])
    if core.std() == 0 or b.std() == 0:
        return 0.0
    found = cv2.matchTemplate(b, core, cv2.TM_CCOEFF_NORMED)
    return float(np.nan_to_num(found, nan=0.0, posinf=0.0, neginf=0.0).max())


@kept_with_frame
def small_image(frame: Frame) -> np.ndarray:
    """(h, w) float32 grey values of a frame, :data:`WIDTH` columns wide."""
    assert frame.rgb is not None
    height, width = frame.camera.shape
    rows = max(1, round(WIDTH * height / width))
    small = cv2.resize(frame.rgb, (WIDTH, rows), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
