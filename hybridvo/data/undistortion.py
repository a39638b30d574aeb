"""Lens distortion of RGB-D images, taken out once per camera."""

from __future__ import annotations

import cv2
import numpy as np

from hybridvo.types import Camera

__all__ = ["Undistorter", "rectify"]


class Undistorter:
    """Remaps images of a distorted camera to a pinhole camera with the same intrinsics.

    Args:
        camera: intrinsics of the distorted and of the resulting image.
        distortion: Brown coefficients k1 k2 p1 p2 k3, as OpenCV orders them.
    """

    def __init__(self, camera: Camera, distortion: tuple[float, ...]) -> None:
        size = (camera.width, camera.height)
        coefficients = np.array(distortion, dtype=np.float64)
        self._u, self._v = cv2.initUndistortRectifyMap(
            camera.K, coefficients, np.eye(3), camera.K, size, cv2.CV_32FC1
        )
        inside = (self._u >= 0) & (self._u <= camera.width - 1)
        self.mask: np.ndarray = inside & (self._v >= 0) & (self._v <= camera.height - 1)
        """(H, W) bool, False where the pinhole image sees beyond the distorted one."""

    def rgb(self, rgb: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 image, bilinear; black outside."""
        return cv2.remap(rgb, self._u, self._v, cv2.INTER_LINEAR)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """(H, W) float32 depth, nearest value (no mixing across edges); 0 (invalid) outside."""
        return cv2.remap(depth, self._u, self._v, cv2.INTER_NEAREST)


def rectify(
    lens: Undistorter | None, rgb: np.ndarray | None, depth: np.ndarray | None
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """(image, depth, mask) without distortion; as they are, and no mask, where there is no lens."""
    if lens is None:
        return rgb, depth, None
    rgb = None if rgb is None else lens.rgb(rgb)
    return rgb, None if depth is None else lens.depth(depth), lens.mask
