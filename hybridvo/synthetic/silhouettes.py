"""Procedural silhouettes: unions and differences of superellipses, polygons, stars and thin bars.

They stand in for the chair photographs that the paper cut its object masks from: closed outlines of
every degree of concavity, with holes and thin parts, at no download and of unlimited number.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

KINDS = ("superellipse", "polygon", "star", "bar")


def outline(rng: np.random.Generator, kind: str) -> np.ndarray:
    """(N, 2) closed outline around the origin, within the unit circle, turned by a random angle.

    ``superellipse``: round to square to pinched; ``polygon``: 3 to 9 corners, convex or not;
    ``star``: smooth or spiked radial function; ``bar``: thin rectangle.
    """
    if kind == "superellipse":
        angle = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
        exponent = 2.0 / np.exp(rng.uniform(np.log(0.7), np.log(6.0)))
        cos, sin = np.cos(angle), np.sin(angle)
        points = np.stack(
            [np.sign(cos) * np.abs(cos) ** exponent, np.sign(sin) * np.abs(sin) ** exponent], axis=1
        )
        points[:, 1] *= rng.uniform(0.3, 1.0)
    elif kind == "polygon":
        corners = int(rng.integers(3, 10))
        angle = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.35, 0.35, corners)) / corners
        points = rng.uniform(0.45, 1.0, corners)[:, None] * np.stack(
            [np.cos(angle), np.sin(angle)], axis=1
        )
    elif kind == "star":
        angle = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
        radius = np.ones_like(angle)
        for k in range(2, 8):
            amplitude = rng.uniform(0.0, 0.7) / k
            radius += amplitude * np.cos(k * angle + rng.uniform(0.0, 2 * np.pi))
        radius = np.maximum(radius, 0.15)
        points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        half = rng.uniform(0.03, 0.18)
        points = np.array([[-1.0, -half], [1.0, -half], [1.0, half], [-1.0, half]])
    points /= np.sqrt((points**2).sum(axis=1).max())
    turn = rng.uniform(0.0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s], [-s, c]])


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Filled outlines in unit coordinates, painted one after the other.

    Args:
        parts: (outline (N, 2), adds) pairs; an outline that does not add cuts a hole.
    """

    parts: tuple[tuple[np.ndarray, bool], ...]

    def draw(
        self,
        mask: np.ndarray,
        centre: tuple[float, float],
        radius: float,
        stretch: float = 1.0,
    ) -> None:
        """Paint into an (H, W) uint8 mask, in place.

        A hole is painted as 0, so give each silhouette a mask of its own. ``centre``: (u, v) of the
        origin and ``radius`` of one unit in pixels; ``stretch``: horizontal over vertical scale.
        """
        limit = 8 * max(mask.shape)
        scale = np.array([radius * np.sqrt(stretch), radius / np.sqrt(stretch)])
        for points, adds in self.parts:
            pixels = np.clip(points * scale + centre, -limit, limit)
            sixteenths = np.round(pixels * 16).astype(np.int32)
            cv2.fillPoly(mask, [sixteenths], int(adds), cv2.LINE_8, 4)

    def draw_coverage(
        self,
        height: int,
        width: int,
        centre: tuple[float, float],
        share: float,
        stretch: float = 1.0,
    ) -> tuple[np.ndarray, float]:
        """Paint with the radius at which a share of the picture is covered.

        Returns the (H, W) uint8 mask and the radius in pixels. The share, in (0, 1), is met to
        about 1 % where the shape can reach it, else the largest share below it.
        """
        low, high = 0.0, 4.0 * float(np.hypot(height, width))
        best = np.zeros((height, width), np.uint8)
        radius = low
        for _ in range(12):
            middle = 0.5 * (low + high)
            mask = np.zeros((height, width), np.uint8)
            self.draw(mask, centre, middle, stretch)
            covered = cv2.countNonZero(mask) / mask.size
            if covered <= share:
                low = radius = middle
                best = mask
                if covered > share - 0.01:
                    break
            else:
                high = middle
        return best, radius


def random_silhouette(rng: np.random.Generator, hole_probability: float = 0.4) -> Silhouette:
    """Union of one to four outlines, from which holes and notches may be cut.

    Args:
        rng: source of randomness.
        hole_probability: chance that one or two smaller outlines are subtracted.
    """
    first = KINDS[int(rng.choice(4, p=[0.35, 0.3, 0.3, 0.05]))]
    parts: list[tuple[np.ndarray, bool]] = [(outline(rng, first), True)]
    for _ in range(int(rng.integers(0, 4))):
        kind = KINDS[int(rng.integers(4))]
        size = rng.uniform(0.7, 1.3) if kind == "bar" else rng.uniform(0.3, 0.8)
        parts.append((size * outline(rng, kind) + rng.uniform(-0.6, 0.6, 2), True))
    if rng.random() < hole_probability:
        for _ in range(int(rng.integers(1, 3))):
            kind = KINDS[int(rng.integers(3))]
            points = rng.uniform(0.12, 0.4) * outline(rng, kind) + rng.uniform(-0.6, 0.6, 2)
            parts.append((points, False))
    return Silhouette(tuple(parts))


def silhouette_mask(rng: np.random.Generator, size: int) -> np.ndarray:
    """(h, w) bool mask of a random silhouette that fills a square of ``size`` px, cropped to it."""
    while True:
        shape = random_silhouette(rng)
        added = np.concatenate([points for points, adds in shape.parts if adds])
        low, high = added.min(axis=0), added.max(axis=0)
        radius = size / float((high - low).max())
        centre = (size - 1) / 2 - radius * (low + high) / 2
        mask = np.zeros((size, size), np.uint8)
        shape.draw(mask, (float(centre[0]), float(centre[1])), radius)
        left, top, width, height = cv2.boundingRect(mask)
        # A hole can swallow a small shape; a mover without pixels would be none.
        if width * height and cv2.countNonZero(mask) > 0.02 * mask.size:
            return mask[top : top + height, left : left + width].astype(bool)
