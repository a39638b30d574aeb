"""Meshes of RGB-D frames, drawn with a z-buffer as another camera sees them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.core.geometry import backproject
from hybridvo.core.types import Camera, Frame
from hybridvo_lab.synthetic.sensors import depth_jump

TEAR = 0.06
"""Relative change of depth between neighbours above which no surface joins them."""
MEASURED_JUMP = 2 * TEAR
"""The same above which a frame's own depth does not count as measured."""
EXPOSURES = 7
"""Images whose mean is a motion-blurred one."""
MIN_VERTEX_DEPTH = 1e-3
"""Depth below which a point counts as behind the camera, metres."""
FAR_OUTSIDE_PX = -1e4
"""Where such a point is projected to."""


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
        inside = self.points[self.inside] if self.inside.any() else self.points[0]
        return inside.mean(axis=0)


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
        """Draw a surface in place; the nearest surface wins.

        Args:
            surface: the mesh, with its colours.
            points: (h, w, 3) where its vertices are now,
                metres in this view's frame.
            moving: (h, w) whether each vertex moves by itself.
            camera: the camera of this view.
        """
        channels = [surface.image, surface.measured, moving]
        values = np.dstack(channels).astype(np.float32)
        out = np.dstack([self.image, self.measured, self.moving]).astype(np.float32)
        depth_before = self.depth.copy()
        h, w = points.shape[:2]
        uv = image_points(points, camera).reshape(h * w, 2)
        z = points[..., 2].astype(np.float32).reshape(h * w)
        values = values.reshape(h * w, -1)
        inside = surface.inside.reshape(h * w)
        _rasterise(h, w, uv, z, values, inside, self.depth, out)

        # pixels at a silhouette mix both surfaces
        drawn = (self.depth != depth_before).astype(np.float32)
        alpha = cv2.GaussianBlur(drawn, (3, 3), 0.7) * drawn
        self.image += alpha[..., None] * (out[..., :3] - self.image)
        self.measured = out[..., 3]
        self.moving = out[..., 4]

    def roll(self, turn: np.ndarray, camera: Camera, exposure: float = 0.0) -> None:
        """Look through a rolling shutter, in place.

        Args:
            turn: (3,) rotation of the camera while the rows are read, rad.
            camera: the camera of this view.
            exposure: how long a row is exposed, in units of the time that reading
                all rows takes; the image is blurred by the rotation in this time.
        """
        rays = backproject(np.ones(camera.shape), camera)
        row_time = np.linspace(-0.5, 0.5, camera.height)[:, None, None]
        places = []
        for instant in np.linspace(-0.5, 0.5, EXPOSURES):
            time = row_time + exposure * instant
            rotated = rays + time * np.cross(turn, rays)
            places.append(cv2.split(image_points(rotated, camera)))

        def look_up(picture: np.ndarray, u: Any, v: Any, mode: int) -> np.ndarray:
            return cv2.remap(picture, u, v, mode, None, cv2.BORDER_REPLICATE)

        blurred = [look_up(self.image, u, v, cv2.INTER_LINEAR) for u, v in places]
        self.image = np.mean(blurred, axis=0)
        # depth is measured in the middle of the exposure
        u, v = places[EXPOSURES // 2]
        self.depth = look_up(self.depth, u, v, cv2.INTER_NEAREST)
        self.moving = look_up(self.moving, u, v, cv2.INTER_NEAREST)
        self.measured = look_up(self.measured, u, v, cv2.INTER_NEAREST)


def image_points(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Project points (h, w, 3) to pixels (h, w, 2).

    Those behind the camera land far outside.
    """
    z = points[..., 2]
    in_front = z > MIN_VERTEX_DEPTH
    inverse = 1.0 / np.where(in_front, z, 1.0)
    u = camera.fx * points[..., 0] * inverse + camera.cx
    v = camera.fy * points[..., 1] * inverse + camera.cy
    u = np.where(in_front, u, FAR_OUTSIDE_PX)
    return np.dstack([u, v]).astype(np.float32)


@njit(error_model="numpy", cache=True, nogil=True)
def _rasterise(h, w, uv, z, values, inside, depth, out):
    """Draw the mesh of h x w vertices with a z-buffer, in place.

    Values linear in the image.
    """
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


class FilledDepth(NamedTuple):
    """A depth map whose holes are filled."""

    depth: np.ndarray  # (H, W) metres
    known: np.ndarray  # (H, W) bool, where the depth was measured


def filled_depth(depth: np.ndarray) -> FilledDepth:
    """Fill the holes of a depth map (H, W), metres, with the nearest values."""
    known = np.isfinite(depth) & (depth > 0)
    _, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.ones(labels.max() + 1, np.float32)
    of_label[labels[known]] = depth[known]
    return FilledDepth(of_label[labels], known)


@functools.lru_cache(maxsize=128)
def surface_of(frame: Frame) -> Surface:
    """Make a mesh of an entire frame.

    At jumps of depth it is drawn but not measured.
    """
    assert frame.depth is not None and frame.rgb is not None
    depth, known = filled_depth(frame.depth)
    measured = known & (depth_jump(depth) < MEASURED_JUMP * depth)
    points = backproject(depth, frame.camera).astype(np.float32)
    return Surface(
        points,
        frame.rgb.astype(np.float32),
        measured.astype(np.float32),
        inside=np.ones(depth.shape, np.bool_),
    )


def transformed(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Move points (h, w, 3) by a motion (4, 4), in single precision."""
    R = T[:3, :3].astype(np.float32)
    t = T[:3, 3].astype(np.float32)
    return points @ R.T + t
