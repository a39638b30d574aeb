"""Depth of a camera of its own, as in the colour camera.

Two sensors look from different places: depth has to be moved, not resized.
"""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import as_contiguous, njit
from hybridvo.core.checks import as_rigid, to_numpy
from hybridvo.core.errors import InputError
from hybridvo.core.types import Camera

# pixels of colour, along a row or a column, that one pixel of depth may cover:
# sensors have 1 to 8, a damaged map would cover the whole image
MAX_FOOTPRINT_PX = 32


def register_depth(
    depth: np.ndarray,
    depth_camera: Camera,
    T_colour_depth: np.ndarray,
    colour_camera: Camera,
) -> np.ndarray:
    """Return depth on the pixels of the colour image.

    Each pixel of depth is a small square that faces its camera. Its corners are projected into the
    colour image, and it covers the pixels whose centres lie in their bounding box; where several
    cover a pixel the nearest counts (a z-buffer). What colour sees and depth does not is 0.

    Args:
        depth: (H, W) metres along the optical axis of the depth camera, without distortion; 0,
            negative and not finite values are invalid.
        depth_camera: Its intrinsics.
        T_colour_depth: (4, 4) maps points of the depth camera into the colour camera, metres.
        colour_camera: The intrinsics of the colour image, without distortion.

    Returns:
        (h, w) float32, metres along the optical axis of the colour camera, 0 where unknown.

    Raises:
        InputError: Depth is not of the size of its camera, or the transform is not rigid.

    Example:
        >>> import numpy as np
        >>> from hybridvo import Camera
        >>> camera = Camera(fx=10.0, fy=10.0, cx=1.0, cy=0.0, height=1, width=3)
        >>> to_the_left = np.eye(4)
        >>> to_the_left[0, 3] = 0.2  # points lie 0.2 m further right: 1 px at 2 m
        >>> register_depth(np.float32([[2.0, 2.0, 0.0]]), camera, to_the_left, camera).tolist()
        [[0.0, 2.0, 2.0]]
    """
    depth = to_numpy(depth, "register_depth: depth")
    if depth.shape != depth_camera.shape:
        raise InputError(
            f"register_depth: depth: expected shape {depth_camera.shape}, as its camera has, "
            f"got {depth.shape}."
        )
    T = as_rigid(T_colour_depth, "register_depth: T_colour_depth", 1e-3)
    registered = np.full(colour_camera.shape, np.inf, np.float32)
    _splat(
        as_contiguous(depth, np.float32),
        as_contiguous(np.linalg.inv(depth_camera.K), np.float64),
        as_contiguous(colour_camera.K @ T[:3, :3], np.float64),
        as_contiguous(colour_camera.K @ T[:3, 3], np.float64),
        MAX_FOOTPRINT_PX,
        registered,
    )
    registered[np.isinf(registered)] = 0.0
    return registered


@njit(nogil=True, fastmath=False)
def _splat(depth, K_inverse, KR, Kt, largest, registered):
    """Write the nearest depth of each pixel of colour into ``registered``, which holds inf.

    A point of depth z at the pixel x of the depth camera lies at ``z KR K_inverse x + Kt`` in
    homogeneous pixels of colour; the third of these is its depth there.
    """
    height, width = depth.shape
    rows, columns = registered.shape
    H = KR @ K_inverse
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if not 0.0 < z < np.inf:
                continue
            new_z = z * (H[2, 0] * u + H[2, 1] * v + H[2, 2]) + Kt[2]
            if not new_z > 0.0:
                continue
            left = np.inf
            right = -np.inf
            top = np.inf
            bottom = -np.inf
            in_front = True
            for corner in range(4):
                x = u - 0.5 + corner % 2
                y = v - 0.5 + corner // 2
                w = z * (H[2, 0] * x + H[2, 1] * y + H[2, 2]) + Kt[2]
                if not w > 0.0:
                    in_front = False
                    break
                column = (z * (H[0, 0] * x + H[0, 1] * y + H[0, 2]) + Kt[0]) / w
                row = (z * (H[1, 0] * x + H[1, 1] * y + H[1, 2]) + Kt[1]) / w
                left = min(left, column)
                right = max(right, column)
                top = min(top, row)
                bottom = max(bottom, row)
            if not in_front:
                continue
            if right < 0.0 or left > columns or bottom < 0.0 or top > rows:
                continue
            if right - left > largest or bottom - top > largest:
                continue
            # half open: a centre on the border of two squares belongs to one of them
            first_column = max(int(np.ceil(left)), 0)
            last_column = min(int(np.ceil(right)), columns)
            first_row = max(int(np.ceil(top)), 0)
            last_row = min(int(np.ceil(bottom)), rows)
            for row in range(first_row, last_row):
                for column in range(first_column, last_column):
                    registered[row, column] = min(registered[row, column], new_z)
