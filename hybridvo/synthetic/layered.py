"""A scene of surfaces laid over each other, in inverse depth on the rays of one camera.

The background is a room, a street or a slanted surface; every further layer is a curved piece of
surface that hides what is behind it. Each layer may have a motion of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from hybridvo.geometry import euler_deg_to_matrix
from hybridvo.synthetic.sensors import log_uniform, smooth_field

if TYPE_CHECKING:
    from hybridvo.synthetic.diverse import WideOptions


SKY_INVERSE_DEPTH = 1.0 / 2000.0
"""Surfaces farther than two kilometres are sky."""


class LayeredScene:
    """Inverse depth, owner and motion of every pixel while layers are laid over each other."""

    def __init__(self, rng: np.random.Generator, options: WideOptions) -> None:
        o, self.rng, self.options = options, rng, options
        half_angle = np.deg2rad(log_uniform(rng, o.field_of_view_deg)) / 2
        self.fx = float(o.width / 2 / np.tan(half_angle))
        self.fy = self.fx * log_uniform(rng, o.aspect)
        shift = o.centre_shift * rng.uniform(-1, 1, 2)
        self.cx = (o.width - 1) / 2 + shift[0] * o.width
        self.cy = (o.height - 1) / 2 + shift[1] * o.height
        self.x = ((np.arange(o.width) - self.cx) / self.fx).astype(np.float32)
        self.y = ((np.arange(o.height) - self.cy) / self.fy).astype(np.float32)[:, None]
        self.scale = log_uniform(rng, o.scene_depth)
        self.rho = self._background()
        self.owner = np.full((o.height, o.width), -1, np.int16)
        self.motions: list[np.ndarray | None] = []
        self.bends: list[np.ndarray | None] = []

    def _background(self) -> np.ndarray:
        """(H, W) inverse depth of walls, ground or one slanted surface; 0 is sky."""
        o, rng = self.options, self.rng
        kind = rng.random()
        yaw, pitch, roll = rng.uniform(-40, 40), rng.normal(0, 10), rng.normal(0, 4)
        R = euler_deg_to_matrix(np.array([pitch, yaw, roll]))
        size = self.scale
        planes: list[tuple[np.ndarray, float]] = []
        floor = (np.array([0.0, 1.0, 0.0]), size * rng.uniform(0.25, 0.7))
        if kind < o.room_probability:
            planes = [
                floor,
                (np.array([0.0, -1.0, 0.0]), size * rng.uniform(0.25, 0.9)),
                (np.array([1.0, 0.0, 0.0]), size * rng.uniform(0.3, 2.0)),
                (np.array([-1.0, 0.0, 0.0]), size * rng.uniform(0.3, 2.0)),
                (np.array([0.0, 0.0, 1.0]), size * rng.uniform(0.7, 3.0)),
            ]
        elif kind < o.room_probability + o.outdoor_probability:
            planes = [floor]
            for side in (1.0, -1.0):
                if rng.random() < 0.4:
                    planes.append((np.array([side, 0.0, 0.0]), size * rng.uniform(0.3, 4.0)))
            if rng.random() < 0.4:
                planes.append((np.array([0.0, 0.0, 1.0]), size * rng.uniform(1.0, 20.0)))
        else:
            tilt = rng.uniform(-0.9, 0.9, 2)
            normal = np.array([tilt[0], tilt[1], 1.0])
            planes = [(normal / np.linalg.norm(normal), size * rng.uniform(0.6, 1.5))]
            R = np.eye(3)
        rho = np.zeros((o.height, o.width), np.float32)
        for normal, distance in planes:
            n = (R.T @ normal / distance).astype(np.float32)
            np.maximum(rho, n[0] * self.x + (n[1] * self.y + n[2]), out=rho)
        if kind >= o.room_probability + o.outdoor_probability:
            # A single surface has no sky: it bends away instead.
            np.maximum(rho, np.float32(0.05 / size), out=rho)
        relief = o.relief * rng.random() ** 2
        rho *= np.exp(relief * smooth_field(rng, o.height, o.width, int(rng.integers(3, 12))))
        rho[rho < SKY_INVERSE_DEPTH] = 0.0
        return np.minimum(rho, np.float32(5.0))

    def add(
        self,
        mask: np.ndarray,
        in_front: bool,
        inverse_depth: float | None = None,
    ) -> tuple[int, np.ndarray] | None:
        """Lay a curved, slanted piece of surface over the picture.

        Args:
            mask: (H, W) uint8.
            in_front: nearer than everything under it; else at any depth, possibly hidden.
            inverse_depth: 1 / metres, or None to draw it.

        Returns:
            Its number and the point (3,) in metres at its middle, or None if nothing of it is seen.
        """
        rng = self.rng
        left, top, width, height = cv2.boundingRect(mask)
        if not width * height:
            return None
        box = np.s_[top : top + height, left : left + width]
        inside = mask[box] > 0
        under = self.rho[box]
        if inverse_depth is None:
            most = max(float(np.quantile(under[::2, ::2], 0.9)), 0.1 / self.scale)
            factor = rng.uniform(0.05, 1.2) if in_front else rng.uniform(-0.9, 1.4)
            inverse_depth = min(most * float(np.exp(factor)), 5.0)
        dx = np.linspace(-1, 1, width, dtype=np.float32)
        dy = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
        slope = rng.uniform(-0.15, 0.15, 2).astype(np.float32)
        bulge = np.float32(rng.uniform(0, 0.2))
        shape = 1 + slope[0] * dx + slope[1] * dy + bulge * (1 - dx**2 - dy**2)
        rho = np.float32(inverse_depth) * np.maximum(shape, 0.3)
        shown = inside & (rho > under)
        count = int(shown.sum())
        if count < 4:
            return None
        number = len(self.motions)
        under[shown] = rho[shown]
        self.owner[box][shown] = number
        self.motions.append(None)
        self.bends.append(None)
        rows, columns = np.nonzero(shown)
        u, v = left + columns.mean(), top + rows.mean()
        ray = np.array([(u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0])
        return number, ray / inverse_depth

    def new_mask(self) -> np.ndarray:
        """Empty (H, W) uint8 mask."""
        return np.zeros((self.options.height, self.options.width), np.uint8)
