"""Ray casting of textured boxes, ellipsoids and cylinders, which gives exact depth.

A ray is (x, y, 1) t in the camera frame: its parameter t is the depth, and an
affine map does not change it. P solids are given by ``shapes`` (P,) int64, maps
``A`` (P, 3, 4) from the unit shape to the camera frame, metres, and their inverses
``B``; ``K`` (3, 3) are the intrinsics.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit

BOX, ELLIPSOID, CYLINDER = range(3)
"""The unit shapes: the cube [-1, 1]^3, which is a room when viewed from
inside; the unit sphere; and the cylinder of radius 1 about the y axis
with caps at y = -1 and 1."""
NEAR = 0.05
"""Depth below which the camera sees nothing, metres."""


class Hits(NamedTuple):
    """What the rays through the pixels' centres meet first."""

    depth: np.ndarray  # (H, W) metres, inf where a ray meets nothing
    # (H, W) int32 index of the solid, -1 where a ray meets nothing
    solid: np.ndarray


def cast(
    shapes: np.ndarray,
    A: np.ndarray,
    B: np.ndarray,
    K: np.ndarray,
    size: tuple[int, int],
) -> Hits:
    """Find the nearest solid on the ray of every pixel of an
    image of ``size`` (H, W).
    """
    bounds = _pixel_bounds(A, K, size)
    return Hits(*_cast(shapes, B, bounds, K, *size))


def _pixel_bounds(
    A: np.ndarray, K: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Boxes (P, 4) of pixels around the solids: left, top, right,
    bottom, the last exclusive.

    A solid that reaches behind the camera gets the entire image.
    """
    cube = np.array(list(itertools.product((-1.0, 1.0), repeat=3))).T
    corners = A[:, :, :3] @ cube + A[:, :, 3:]
    z = corners[:, 2]
    projected = K[:2] @ (corners / np.maximum(z, NEAR)[:, None])
    low = projected.min(axis=2) - 1
    high = projected.max(axis=2) + 2
    low, high = np.clip([low, high], 0, size[::-1]).astype(int)
    reaches_behind = (z <= NEAR).any(axis=1)
    low[reaches_behind] = 0
    high[reaches_behind] = size[::-1]
    return np.hstack([low, high])


@njit(cache=True, nogil=True)
def _cast(
    shapes, B_body_cam, bounds, K, height, width
):  # pragma: no cover - compiled
    depth = np.full((height, width), np.inf)
    index = np.full((height, width), -1, dtype=np.int32)
    for p in range(shapes.shape[0]):
        left, top, right, bottom = bounds[p]
        for v in range(top, bottom):
            for u in range(left, right):
                x = (u - K[0, 2]) / K[0, 0]
                y = (v - K[1, 2]) / K[1, 1]
                t = _hit(shapes[p], B_body_cam[p], x, y)
                if t < depth[v, u]:
                    depth[v, u] = t
                    index[v, u] = p
    return depth, index


@njit(cache=True, nogil=True)
def _slab(o, d, first, last):  # pragma: no cover - compiled
    """Part of the interval [first, last] of t where |o + d t| <= 1.

    (inf, -inf): none.
    """
    if d == 0.0:
        return (first, last) if abs(o) <= 1.0 else (np.inf, -np.inf)
    a = (-1.0 - o) / d
    b = (1.0 - o) / d
    return max(first, min(a, b)), min(last, max(a, b))


@njit(cache=True, nogil=True)
def _ball(a, b, c):  # pragma: no cover - compiled
    """Interval of t where a t^2 + 2 b t + c <= 0, without cancellation.

    (inf, -inf): none.
    """
    if a == 0.0:
        return (-np.inf, np.inf) if c <= 0.0 else (np.inf, -np.inf)
    disc = b * b - a * c
    if disc < 0.0:
        return np.inf, -np.inf
    q = -(b + math.copysign(math.sqrt(disc), b))
    if q == 0.0:
        return 0.0, 0.0
    return min(q / a, c / q), max(q / a, c / q)


@njit(cache=True, nogil=True)
def _hit(shape, B, x, y):  # pragma: no cover - compiled
    """Depth where the ray (x, y, 1) meets a solid.

    B (3, 4) maps the camera to the unit shape.
    """
    ox = B[0, 3]
    oy = B[1, 3]
    oz = B[2, 3]
    dx = B[0, 0] * x + B[0, 1] * y + B[0, 2]
    dy = B[1, 0] * x + B[1, 1] * y + B[1, 2]
    dz = B[2, 0] * x + B[2, 1] * y + B[2, 2]
    first = -np.inf
    last = np.inf
    if shape == ELLIPSOID:
        first, last = _ball(
            dx * dx + dy * dy + dz * dz,
            ox * dx + oy * dy + oz * dz,
            ox * ox + oy * oy + oz * oz - 1.0,
        )
    else:
        if shape == BOX:
            first, last = _slab(ox, dx, first, last)
            first, last = _slab(oz, dz, first, last)
        else:
            first, last = _ball(
                dx * dx + dz * dz, ox * dx + oz * dz, ox * ox + oz * oz - 1.0
            )
        first, last = _slab(oy, dy, first, last)
    if first > last or last <= NEAR:
        return np.inf
    return first if first > NEAR else last


@njit(cache=True, nogil=True)
def _lattice(i, j, k):  # pragma: no cover - compiled
    """Pseudo-random value in [-0.5, 0.5) of an integer lattice point."""
    h = np.uint32(
        np.uint32(i) * np.uint32(0x8DA6B343)
        + np.uint32(j) * np.uint32(0xD8163841)
        + np.uint32(k) * np.uint32(0xCB1AB31F)
    )
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    return h * (1.0 / 4294967296.0) - 0.5


@njit(cache=True, nogil=True)
def _noise(x, y, z):  # pragma: no cover - compiled
    """Value noise in [-0.5, 0.5) with lattice step 1 and a
    continuous first derivative.
    """
    i = math.floor(x)
    j = math.floor(y)
    k = math.floor(z)
    a = x - i
    b = y - j
    c = z - k
    a = a * a * (3 - 2 * a)
    b = b * b * (3 - 2 * b)
    c = c * c * (3 - 2 * c)
    i = int(i)
    j = int(j)
    k = int(k)
    total = 0.0
    for dk in range(2):
        wk = c if dk else 1 - c
        for dj in range(2):
            low = _lattice(i, j + dj, k + dk)
            high = _lattice(i + 1, j + dj, k + dk)
            total += wk * (b if dj else 1 - b) * (low + a * (high - low))
    return total


@njit(cache=True, nogil=True)
def _normal(shape, body, normal):  # pragma: no cover - compiled
    """Write the outward direction at a point of a unit shape into ``normal``."""
    x = abs(body[0])
    y = abs(body[1])
    z = abs(body[2])
    for i in range(3):
        normal[i] = body[i]
    if shape == BOX:
        # the face of the largest coordinate
        normal[0] *= x >= y and x >= z
        normal[1] *= y > x and y >= z
        normal[2] *= z > x and z > y
    elif shape == CYLINDER and y * y > x * x + z * z:
        normal[0] = normal[2] = 0.0
    elif shape == CYLINDER:
        normal[1] = 0.0


@njit(cache=True, nogil=True)
def _texture(body, scale, offset, pixels):  # pragma: no cover - compiled
    """Sum of seven octaves of noise at a point, and the second octave alone.

    ``pixels``: length of a lattice step of the first octave in the image.
    """
    value = 0.0
    coarse = 0.0
    amplitude = 1.0
    frequency = 1.0
    for octave in range(7):
        # octaves finer than about three pixels fade out, so that the image does not
        # alias
        fade = min(max((pixels / frequency - 1.5) / 2.0, 0.0), 1.0)
        if fade <= 0.0:
            break
        n = _noise(
            (body[0] * scale[0] + offset[0]) * frequency + 17.3 * octave,
            (body[1] * scale[1] + offset[1]) * frequency + 5.1 * octave,
            (body[2] * scale[2] + offset[2]) * frequency + 9.7 * octave,
        )
        if octave == 1:
            coarse = n * fade
        value += amplitude * fade * n
        amplitude *= 0.8
        frequency *= 2.0
    return value, coarse


@njit(cache=True, nogil=True)
def shade(  # pragma: no cover - compiled
    shapes, B_body_cam, depth, index, K, scale, offset, colours, light_cam
):
    """Return colours (H, W, 3) in [0, 1]: noise of many octaves on each
    solid, in diffuse light.

    ``scale`` (P, 3): lattice steps of the coarsest octave per unit of the unit
    shape. ``offset`` (P, 3): start of the noise. ``colours`` (P, 2, 3).
    ``light_cam`` (3,): direction to the light.
    """
    height, width = depth.shape
    image = np.zeros((height, width, 3))
    body = np.empty(3)
    normal = np.empty(3)
    n_cam = np.empty(3)
    for v in range(height):
        y = (v - K[1, 2]) / K[1, 1]
        for u in range(width):
            p = index[v, u]
            if p < 0:
                continue
            x = (u - K[0, 2]) / K[0, 0]
            z = depth[v, u]
            B = B_body_cam[p]
            for i in range(3):
                body[i] = (B[i, 0] * x + B[i, 1] * y + B[i, 2]) * z + B[i, 3]
            _normal(shapes[p], body, normal)
            for i in range(3):
                n_cam[i] = (
                    B[0, i] * normal[0] + B[1, i] * normal[1] + B[2, i] * normal[2]
                )
            length = math.sqrt(n_cam[0] ** 2 + n_cam[1] ** 2 + n_cam[2] ** 2)
            towards = (n_cam[0] * x + n_cam[1] * y + n_cam[2]) / length
            side = -1.0 if towards > 0 else 1.0
            cosine = abs(towards) / math.sqrt(x * x + y * y + 1.0)
            lit = (
                n_cam[0] * light_cam[0]
                + n_cam[1] * light_cam[1]
                + n_cam[2] * light_cam[2]
            ) * (side / length)
            # metres per pixel on the surface, in lattice steps of the coarsest
            # octave
            step = z / (K[0, 0] * max(cosine, 0.1))
            stretch = 0.0
            for i in range(3):
                row = math.sqrt(B[i, 0] ** 2 + B[i, 1] ** 2 + B[i, 2] ** 2)
                stretch = max(stretch, row * scale[p, i])
            value, coarse = _texture(
                body, scale[p], offset[p], 1.0 / (step * stretch)
            )
            brightness = min(max(0.68 + 0.62 * value, 0.05), 1.25)
            brightness *= 0.82 + 0.18 * lit
            mix = min(max(0.5 + 1.4 * coarse, 0.0), 1.0)
            for c in range(3):
                colour = colours[p, 0, c] + mix * (
                    colours[p, 1, c] - colours[p, 0, c]
                )
                image[v, u, c] = min(brightness * colour, 1.0)
    return image
