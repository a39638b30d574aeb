"""Meshes of RGB-D frames, drawn with a z-buffer as another camera sees them."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.geometry import backproject
from hybridvo.numba_tools import njit
from hybridvo.synthetic.sensors import depth_jump
from hybridvo.types import Camera, Frame

# change of depth between neighbours, relative, above which no surface joins them
TEAR = 0.06
EXPOSURES = 7  # pictures whose mean is a blurred one


@dataclass(eq=False)
class Surface:
    """A mesh whose vertices are the pixels of a frame, or of a part of one."""

    points: np.ndarray  # (h, w, 3) metres
    image: np.ndarray  # (h, w, 3) grey levels
    measured: np.ndarray  # (h, w) 1 where a sensor measures depth, else 0
    inside: np.ndarray  # (h, w) bool, the vertices that are drawn

    @property
    def centre(self) -> np.ndarray:
        """The mean (3,) of the points inside, metres."""
        return (
            self.points[self.inside] if self.inside.any() else self.points[0]
        ).mean(axis=0)


@dataclass(eq=False)
class Canvas:
    """A view onto which surfaces are drawn; all arrays are float32."""

    image: np.ndarray  # (H, W, 3) grey levels
    depth: np.ndarray  # (H, W) metres, without holes
    measured: np.ndarray  # (H, W) from 0 to 1, whether a sensor measures depth
    moving: np.ndarray  # (H, W) from 0 to 1, whether the pixel moves by itself

    def draw(
        self,
        surface: Surface,
        points: np.ndarray,
        moving: np.ndarray,
        camera: Camera,
    ) -> None:
        """Draw a surface whose points are now at ``points`` (h, w, 3); the nearest wins."""
        mesh = np.dstack([surface.image, surface.measured, moving]).astype(
            np.float32
        )
        out = np.dstack([self.image, self.measured, self.moving]).astype(np.float32)
        before, (h, w) = self.depth.copy(), points.shape[:2]
        vertices = (
            image_points(points, camera),
            points[..., 2].astype(np.float32),
            mesh,
        )
        flat = (x.reshape(h * w, *x.shape[2:]) for x in (*vertices, surface.inside))
        _rasterise(h, w, *flat, self.depth, out)
        # silhouettes are mixed pixels
        drawn = (self.depth != before).astype(np.float32)
        alpha = cv2.GaussianBlur(drawn, (3, 3), 0.7) * drawn
        self.image += alpha[..., None] * (out[..., :3] - self.image)
        self.measured = out[..., 3]
        self.moving = out[..., 4]

    def roll(self, turn: np.ndarray, camera: Camera, exposure: float = 0.0) -> None:
        """Look through a rolling shutter: the camera turns (3,), rad, while the rows are read.

        A row is exposed so many times as long as the reading takes: the image is blurred by that.
        """
        rays = backproject(np.ones(camera.shape), camera)
        rows = np.linspace(-0.5, 0.5, camera.height)[:, None, None]
        turns = [rows + exposure * t for t in np.linspace(-0.5, 0.5, EXPOSURES)]
        places = [
            cv2.split(image_points(rays + t * np.cross(turn, rays), camera))
            for t in turns
        ]
        blurred = [
            cv2.remap(
                self.image, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
            )
            for u, v in places
        ]
        self.image, (u, v) = np.mean(blurred, axis=0), places[EXPOSURES // 2]
        kept = (self.depth, self.moving, self.measured)
        self.depth, self.moving, self.measured = (
            cv2.remap(x, u, v, cv2.INTER_NEAREST, None, cv2.BORDER_REPLICATE)
            for x in kept
        )


def image_points(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Project points (h, w, 3) to pixels (h, w, 2); those behind the camera land far outside."""
    z = points[..., 2]
    front = z > 1e-3
    inverse = 1.0 / np.where(front, z, 1.0)
    u = np.where(front, camera.fx * points[..., 0] * inverse + camera.cx, -1e4)
    return np.dstack([u, camera.fy * points[..., 1] * inverse + camera.cy]).astype(
        np.float32
    )


@njit(error_model="numpy", cache=True, nogil=True)
def _rasterise(h, w, uv, z, values, inside, depth, out):
    """Draw the mesh of h x w vertices with a z-buffer, in place; values linear in the image."""
    H, W = depth.shape
    for r in range(h - 1):
        for c in range(w - 1):
            for half in range(2):  # triangles 0 1 2 and 1 2 3 of the quad
                i = r * w + c + half
                j = (r + half) * w + c + 1 - half
                k = i + w
                if not (inside[i] and inside[j] and inside[k]):
                    continue
                u0, v0 = uv[i]
                u1, v1 = uv[j]
                u2, v2 = uv[k]
                z0 = z[i]
                z1 = z[j]
                z2 = z[k]
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
                                v = (
                                    a * values[i, q]
                                    + b * values[j, q]
                                    + e * values[k, q]
                                )
                                out[y, x, q] = v


def filled_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill the holes of a depth map with the nearest values; returns also where it was known."""
    known = np.isfinite(depth) & (depth > 0)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.ones(labels.max() + 1, np.float32)
    of_label[labels[known]] = depth[known]
    return of_label[labels], known


@functools.lru_cache(maxsize=128)
def surface_of(frame: Frame) -> Surface:
    """Make a mesh of everything in a frame; at jumps of depth it is drawn but not measured."""
    assert frame.depth is not None and frame.rgb is not None
    depth, known = filled_depth(frame.depth)
    measured = known & (depth_jump(depth) < 2 * TEAR * depth)
    points = backproject(depth, frame.camera).astype(np.float32)
    inside = np.ones(depth.shape, np.bool_)
    return Surface(
        points, frame.rgb.astype(np.float32), measured.astype(np.float32), inside
    )


def transformed(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Move points (h, w, 3) by a motion (4, 4), in single precision."""
    return points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
