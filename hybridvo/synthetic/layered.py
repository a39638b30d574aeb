"""Surfaces laid over each other in inverse depth: what every generator of training pairs builds on.

Everything is computed in inverse depth on normalised rays, so that sky is exact (0) and single
precision suffices.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MIN_RATIO = np.float32(1e-6)
"""Added to |z' / z|: the flow of a point in the image plane stays finite."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One training pair on the pixel grid of t.

    Args:
        flow: (H, W, 2) float32 px, total flow as the network is given it.
        ego_flow: (H, W, 2) float32 px, flow of the camera motion alone, without noise.
        depth_prev: (H, W) float32 metres as the network is given it; 0 is invalid.
        depth_curr: (H, W) float32 metres of t+1 **on the grid of t** (what lies at x + flow); 0 is
            invalid.
        depth_true: (H, W) float32 metres of t without noise or holes; 0 where there is none (sky).
        depth_target: (H, W) float32 metres, what L^D compares with; 0 where there is none. It
            includes the object's own motion in the paper's five steps, not in the diverse preset.
        K: (3, 3) float32 intrinsics of both frames.
        T_curr_prev: (4, 4) float32, points of the previous camera into the current one.
        rotation_deg, translation: (3,) float32, the same motion as Euler angles X-Y-Z in degrees
            (R = Rx Ry Rz) and metres.
        moving: (H, W) bool, pixels whose true flow differs from the ego flow.
        rays: (H, W, 2) float32, first two components of K^-1 x of the points that were measured,
            where they are not the pixels' centres; or None.
    """

    flow: np.ndarray
    ego_flow: np.ndarray
    depth_prev: np.ndarray
    depth_curr: np.ndarray
    depth_true: np.ndarray
    depth_target: np.ndarray
    K: np.ndarray
    T_curr_prev: np.ndarray
    rotation_deg: np.ndarray
    translation: np.ndarray
    moving: np.ndarray
    rays: np.ndarray | None = None


class Layers:
    """Inverse depth, owner and motion of every pixel while surfaces are laid over each other.

    Args:
        K: (3, 3) intrinsics of the sample.
        rho: (H, W) float32 inverse depth of the background, 0 for sky; is changed in place.
    """

    def __init__(self, K: np.ndarray, rho: np.ndarray) -> None:
        height, width = rho.shape
        self.K, self.rho = K, rho
        self.x, self.y = normalized_grid(K, height, width)
        self.owner = np.full((height, width), -1, np.int16)
        self.motions: list[np.ndarray | None] = []
        self.bends: list[np.ndarray | None] = []

    def lay(
        self, box: tuple[slice, slice], inside: np.ndarray, rho: np.ndarray | float
    ) -> np.ndarray:
        """Add a surface that does not move yet; its number is that of the layers before it.

        Args:
            box: rows and columns of the image that it may touch.
            inside: (h, w) bool, its outline in the box.
            rho: inverse depth there.

        Returns:
            (h, w) bool, where it is in front of what was there.
        """
        shown = inside & (rho > self.rho[box])
        self.owner[box][shown] = len(self.motions)
        self.rho[box][shown] = rho[shown] if isinstance(rho, np.ndarray) else rho
        self.motions.append(None)
        self.bends.append(None)
        return shown

    def flows(
        self, T_curr_prev: np.ndarray, added: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Flow of the camera alone, and with the motions of the layers.

        Args:
            T_curr_prev: (4, 4) motion of the camera.
            added: layers' motions are their own, and their flow is added to the camera's (as the
                paper does); else they contain the camera's and replace it.

        Returns:
            (H, W, 2) ego flow and (H, W) its ratio of new depth to old, total flow and its ratio.
        """
        focal = (float(self.K[0, 0]), float(self.K[1, 1]))
        T = T_curr_prev
        t = T[:3, 3].astype(np.float32)
        u, v, ego_ratio = rigid_flow(self.x, self.y, self.rho, T[:3, :3], t, focal)
        ego_flow = np.stack([u, v], axis=-1)
        flow, ratio = ego_flow.copy(), ego_ratio.copy()
        for number, motion in enumerate(self.motions):
            mask = (self.owner == number).astype(np.uint8)
            left, top, width, height = cv2.boundingRect(mask)
            if motion is None or not width * height:
                continue
            box = np.s_[top : top + height, left : left + width]
            inside = mask[box] > 0
            t = motion[:3, 3].astype(np.float32)
            bend = self.bends[number]
            if bend is not None:
                t = np.moveaxis(t + bend[box], -1, 0)
            u, v, change = rigid_flow(
                self.x[box[1]], self.y[box[0]], self.rho[box], motion[:3, :3], t, focal
            )
            own = np.stack([u, v], axis=-1)
            if added:
                flow[box][inside] += own[inside]
                ratio[box][inside] += change[inside] - 1.0
            else:
                flow[box][inside] = own[inside]
                ratio[box][inside] = change[inside]
        return ego_flow, ego_ratio, flow, ratio


def normalized_grid(K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """(W,) and (H, 1) float32: first two components of K^-1 x of the pixels."""
    x = ((np.arange(width) - K[0, 2]) / K[0, 0]).astype(np.float32)
    y = ((np.arange(height) - K[1, 2]) / K[1, 1]).astype(np.float32)
    return x, y[:, None]


def rigid_flow(
    x: np.ndarray,
    y: np.ndarray,
    inverse_depth: np.ndarray | float,
    R: np.ndarray,
    t: tuple[np.ndarray | float, np.ndarray | float, np.ndarray | float] | np.ndarray,
    focal: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flow of a rigid motion from normalised coordinates and inverse depth (paper, equation 8).

    Written as differences, so that single precision suffices, and in inverse depth, so that a
    point at infinity (0) is exact.

    Args:
        x: (W,) normalised horizontal coordinates of the pixels (or any shape that broadcasts).
        y: (H, 1) normalised vertical coordinates.
        inverse_depth: (H, W) 1/metres, or one number for a constant depth.
        R: (3, 3) rotation of the points.
        t: their translation in metres: three numbers or (H, W) arrays.
        focal: fx, fy in pixels.

    Returns:
        u and v flow in pixels and the ratio of the new depth to the old, each (H, W).
    """
    R = np.asarray(R, dtype=np.float32)
    ratio = (R[2, 0] * x + (R[2, 1] * y + R[2, 2])) + t[2] * inverse_depth
    # The published code takes |z'|: a point behind the camera keeps a bounded flow.
    scale = 1.0 / (np.abs(ratio) + MIN_RATIO)
    u = (((R[0, 0] * x + (R[0, 1] * y + R[0, 2])) + t[0] * inverse_depth) * scale - x) * focal[0]
    v = (((R[1, 0] * x + (R[1, 1] * y + R[1, 2])) + t[1] * inverse_depth) * scale - y) * focal[1]
    return u, v, ratio


def visibility(
    flow: np.ndarray, rho_curr: np.ndarray, solid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Who is hidden in the next frame, and the depth that is seen at x + flow.

    Args:
        flow: (H, W, 2) px, true.
        rho_curr: (H, W) inverse depth of each moved point.
        solid: (H, W) bool, not sky.

    Returns:
        (H, W) bool, hidden behind something nearer or outside of the picture, and (H, W) float32
        metres of t+1 on the grid of t; 0 outside and for sky.
    """
    height, width = rho_curr.shape
    u = np.rint(flow[..., 0] + np.arange(width, dtype=np.float32)).astype(np.int32)
    v = np.rint(flow[..., 1] + np.arange(height, dtype=np.float32)[:, None]).astype(np.int32)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = np.where(inside, v * width + u, 0)
    front = np.zeros(height * width, np.float32)
    np.maximum.at(front, index[inside], rho_curr[inside])
    seen = front[index]
    # A tenth: neighbours on a slanted surface share a pixel of the next frame.
    covered = inside & (seen > np.float32(1.1) * rho_curr)
    inverse = np.where(covered, seen, rho_curr)
    known = inside & (solid | covered)
    depth = np.where(known, 1.0 / np.maximum(inverse, np.float32(1e-5)), 0.0)
    return covered | ~inside, depth.astype(np.float32)
