"""Meshes of RGB-D frames, drawn with a z-buffer onto views of another place."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.geometry import backproject, njit
from hybridvo.synthetic.sensors import depth_jump
from hybridvo.types import Camera, Frame

TEAR = 0.06
"""Change of depth between neighbours, over depth, above which no surface joins them."""


@dataclass(eq=False)
class Surface:
    """A mesh of pixels: points (h, w, 3), image (h, w, 3), measured (h, w), inside (h, w) bool."""

    points: np.ndarray
    image: np.ndarray
    measured: np.ndarray
    inside: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """(3,) mean of the points inside."""
        return (self.points[self.inside] if self.inside.any() else self.points[0]).mean(axis=0)


@dataclass(eq=False)
class Canvas:
    """An image (H, W, 3), its depth without holes, what of it a sensor measures, what moves."""

    image: np.ndarray
    depth: np.ndarray
    measured: np.ndarray
    moving: np.ndarray

    def draw(
        self, surface: Surface, points: np.ndarray, moving: np.ndarray, camera: Camera
    ) -> None:
        """Add a surface with its points where they are now, nearest wins."""
        mesh = np.dstack([surface.image, surface.measured, moving]).astype(np.float32)
        out = np.dstack([self.image, self.measured, self.moving]).astype(np.float32)
        before, (h, w) = self.depth.copy(), points.shape[:2]
        vertices = image_points(points, camera), points[..., 2].astype(np.float32), mesh
        flat = (x.reshape(h * w, *x.shape[2:]) for x in (*vertices, surface.inside))
        _rasterise(h, w, *flat, self.depth, out)
        # silhouettes are mixed pixels
        drawn = (self.depth != before).astype(np.float32)
        alpha = cv2.GaussianBlur(drawn, (3, 3), 0.7) * drawn
        self.image += alpha[..., None] * (out[..., :3] - self.image)
        self.measured, self.moving = out[..., 3], out[..., 4]


def image_points(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(h, w, 2) float32 px of points (h, w, 3); far outside behind the camera."""
    z = points[..., 2]
    front = z > 1e-3
    inverse = 1.0 / np.where(front, z, 1.0)
    u = np.where(front, camera.fx * points[..., 0] * inverse + camera.cx, -1e4)
    return np.dstack([u, camera.fy * points[..., 1] * inverse + camera.cy]).astype(np.float32)


@njit(error_model="numpy", cache=True, nogil=True)
def _rasterise(h, w, uv, z, values, inside, depth, out):
    """Draw the mesh of h x w vertices with a z-buffer, in place; values linear in the image."""
    H, W = depth.shape
    for r in range(h - 1):
        for c in range(w - 1):
            for half in range(2):  # triangles 0 1 2 and 1 2 3 of the quad
                i = r * w + c + half
                j, k = (r + half) * w + c + 1 - half, i + w
                if not (inside[i] and inside[j] and inside[k]):
                    continue
                u0, v0 = uv[i]
                u1, v1 = uv[j]
                u2, v2 = uv[k]
                z0, z1, z2 = z[i], z[j], z[k]
                area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
                if min(z0, z1, z2) < 0.05 or abs(area) < 1e-6 or abs(area) > 1e4:
                    continue
                left = max(0, int(np.ceil(min(u0, u1, u2))))
                right = min(W - 1, int(np.floor(max(u0, u1, u2))))
                top = max(0, int(np.ceil(min(v0, v1, v2))))
                bottom = min(H - 1, int(np.floor(max(v0, v1, v2))))
                for y in range(top, bottom + 1):
                    for x in range(left, right + 1):
                        a = ((u1 - x) * (v2 - y) - (u2 - x) * (v1 - y)) / area
                        b = ((u2 - x) * (v0 - y) - (u0 - x) * (v2 - y)) / area
                        e = 1.0 - a - b
                        if a < -1e-6 or b < -1e-6 or e < -1e-6:
                            continue
                        near = 1.0 / (a / z0 + b / z1 + e / z2)
                        if near < depth[y, x]:
                            depth[y, x] = near
                            for q in range(out.shape[2]):
                                v = a * values[i, q] + b * values[j, q] + e * values[k, q]
                                out[y, x, q] = v


def filled_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth with its holes filled by the nearest value, and where it was measured."""
    known = np.isfinite(depth) & (depth > 0)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.ones(labels.max() + 1, np.float32)
    of_label[labels[known]] = depth[known]
    return of_label[labels], known


@functools.lru_cache(maxsize=128)
def surface_of(frame: Frame) -> Surface:
    """Everything that a frame shows, as a mesh that is torn nowhere but measured only on planes."""
    assert frame.depth is not None and frame.rgb is not None
    depth, known = filled_depth(frame.depth)
    measured = known & (depth_jump(depth) < 2 * TEAR * depth)
    points = backproject(depth, frame.camera).astype(np.float32)
    inside = np.ones(depth.shape, np.bool_)
    return Surface(points, frame.rgb.astype(np.float32), measured.astype(np.float32), inside)


def transformed(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 points after a motion (4, 4)."""
    return points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
