"""Three small frames that come with the package: to try a call, and to warm a tracker up."""

from __future__ import annotations

from pathlib import Path

import cv2

from hybridvo.core.types import Camera, Frame

FRAMES = 3
FOCAL_PX = 180.383
DEPTH_UNITS_PER_M = 2500.0
HZ = 24.0
HERE = Path(__file__).parent


def example_frames() -> list[Frame]:
    """Read the frames: a rendered room in which nothing moves.

    Returns:
        Three frames of 160x120 px, with depth.

    Example:
        >>> import hybridvo as hvo
        >>> [frame.camera.shape for frame in hvo.example_frames()]
        [(120, 160), (120, 160), (120, 160)]
    """
    return [_frame(index) for index in range(FRAMES)]


def _frame(index: int) -> Frame:
    """Read one frame."""
    bgr = cv2.imread(str(HERE / f"rgb_{index}.png"), cv2.IMREAD_COLOR)
    units = cv2.imread(str(HERE / f"depth_{index}.png"), cv2.IMREAD_UNCHANGED)
    # they come with the package
    assert bgr is not None
    assert units is not None
    height, width = units.shape
    camera = Camera(
        FOCAL_PX,
        FOCAL_PX,
        (width - 1) / 2,
        (height - 1) / 2,
        height=height,
        width=width,
    )
    depth = units.astype("float32") / DEPTH_UNITS_PER_M
    return Frame(bgr[..., ::-1].copy(), depth, camera, index / HZ, index)
