"""The paper's five steps of drawing a training pair (section 3.4), and what every pair consists of.

The steps: 1. intrinsics; 2. a background and five objects, each at one depth; 3. motions of the
camera and the objects; 4. the rigid flow of each; 5. composition, the nearest in front, where an
object's own flow is **added** to the camera's. Surfaces are kept as inverse depth: the sky is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from hybridvo.errors import InputError
from hybridvo.geometry import (
    euler_deg_to_matrix,
    make_transform,
    matrix_to_euler_deg,
    pixel_grid,
)
from hybridvo.options import Positive, Share, option_group
from hybridvo.synthetic.draws import cut_out, log_uniform
from hybridvo.synthetic.sensors import degrade_depth, noisy_flow
from hybridvo.types import FramePair

# smallest |z' / z|, so that the flow of a point in the image plane is finite
MIN_RATIO = 1e-6


@dataclass(frozen=True, eq=False)
class Sample:
    """One training pair, all on the pixel grid of frame t: float32, px, metres; depth 0 is invalid.

    A network is given ``flow``, ``depth_prev`` and ``depth_curr``.
    """

    flow: np.ndarray  # (H, W, 2)
    ego_flow: np.ndarray  # (H, W, 2) of the camera motion alone
    depth_prev: np.ndarray  # (H, W)
    depth_curr: np.ndarray  # (H, W) depth of t+1 at x + flow
    depth_true: np.ndarray  # (H, W) depth of t without noise or holes
    # (H, W) depth of t+1 that the loss L^D expects; only the paper's steps let objects move in it
    depth_target: np.ndarray
    K: np.ndarray  # (3, 3) of both frames
    T_curr_prev: np.ndarray  # (4, 4)
    moving: np.ndarray  # (H, W) bool, where the true flow differs from the ego flow

    @property
    def rotation_deg(self) -> np.ndarray:
        """The Euler angles X-Y-Z of T_curr_prev, (3,), where R = Rx Ry Rz."""
        return matrix_to_euler_deg(self.T_curr_prev[:3, :3]).astype(np.float32)

    @property
    def translation(self) -> np.ndarray:
        """The translation of T_curr_prev, (3,), metres."""
        return self.T_curr_prev[:3, 3]


@dataclass(frozen=True, eq=False)
class KnownPair:
    """A pair with its true motion, true depth and the pixels that move."""

    pair: FramePair
    T_curr_prev: np.ndarray
    # (H, W) metres, of the previous frame, without errors; 0 where unknown
    depth: np.ndarray
    moving: np.ndarray  # (H, W) bool
    # path of the recording that shows the static scene, if it is one
    world: str = ""


def camera_flow(
    K: np.ndarray, depth: np.ndarray, T: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return :func:`rigid_flow` of a whole depth map (H, W), metres, under the camera motion."""
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    return rigid_flow(K, inverse.astype(np.float32), T)


def rays(K: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Return the first two components of K^-1 x for every pixel x, (2, H, W)."""
    x, y = (
        (np.arange(n) - K[i, 2]) / K[i, i] for i, n in enumerate(reversed(size))
    )
    return np.stack(np.broadcast_arrays(x, y[:, None]))


def rigid_flow(
    K: np.ndarray, rho: np.ndarray, T: np.ndarray, ray: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the flow (..., 2), px, of a rigid motion, and the ratio z' / z (...) of the depths.

    ``rho`` is the inverse depth of an image, or of the pixels of ``ray`` (2, ...). This is the
    paper's equation 8, written as differences so that single precision suffices.
    """
    x, y = (rays(K, rho.shape) if ray is None else ray).astype(rho.dtype)
    u, v, ratio = (
        a * x + (b * y + c) + d * rho for a, b, c, d in T[:3].astype(rho.dtype)
    )
    # the published code takes |z'|: a point behind the camera keeps a bounded flow
    scale = 1.0 / np.abs(ratio).clip(MIN_RATIO)
    flow = (u * scale - x) * float(K[0, 0]), (v * scale - y) * float(K[1, 1])
    return np.stack(flow, axis=-1), ratio


def splat(flow: np.ndarray, rho_curr: np.ndarray) -> np.ndarray:
    """Move inverse depth (H, W) along a flow into the next frame; 0 where nothing lands.

    The nearest surface wins. ``rho_curr`` is the new inverse depth on the old grid.
    """
    height, width = rho_curr.shape
    place = np.rint(flow + pixel_grid(height, width)).astype(np.int64)
    inside = ((place >= 0) & (place < (width, height))).all(axis=-1)
    index = np.where(inside, place @ (1, width), 0)
    value = rho_curr.copy()
    off = np.rint(flow) - flow
    for axis in (0, 1):
        slope = np.gradient(rho_curr, axis=1 - axis)
        slope[np.abs(slope) > 0.02 * rho_curr] = 0.0  # a depth edge is no slope
        value += slope * off[..., axis]
    front = np.zeros(rho_curr.size, rho_curr.dtype)
    np.maximum.at(front, index[inside], value[inside])
    return front.reshape(rho_curr.shape)


@option_group
class TailSampler:
    """A number drawn from a narrow normal core or, less often, from a wide tail.

    A tail value v is sign(v) |v|^power; values outside of low to high are drawn again.
    ``configs/data_paper.yaml`` gives the sources of the numbers used.
    """

    mean: float
    tail_std: Positive
    power: Positive
    tail_probability: Share
    low: float
    high: float
    core_std: Positive

    def draw(self, rng: np.random.Generator, low: float | None = None) -> float:
        """Draw one value; ``low`` replaces the lower limit where the scene demands it."""
        low = self.low if low is None else low
        tail = rng.random() < self.tail_probability
        spread = self.tail_std if tail else self.core_std
        for _ in range(10_000):
            value = self.mean + spread * rng.standard_normal()
            if tail:
                value = np.sign(value) * abs(value) ** self.power
            if low <= value <= self.high:
                return float(value)
        raise InputError(
            f"None of 10 000 draws of {self} fell into [{low}, {self.high}]."
        )


ThreeSamplers = tuple[TailSampler, TailSampler, TailSampler]


@option_group
class MotionSamplers:
    """Samplers of one rigid motion (step 3), of the camera or an object.

    Rotations are Euler angles X, Y, Z in degrees, R = Rx Ry Rz; translations are in metres. The Z
    translation is at least minus ``backward_share`` of the depth of what moves, so that nothing is
    carried through the image plane.
    """

    rotation_deg: ThreeSamplers = (
        TailSampler(0.0, 1.5, 2.5, 0.15, -9.0, 9.0, 0.2),
        TailSampler(0.0, 2.0, 2.0, 0.15, -9.0, 9.0, 0.2),
        TailSampler(0.0, 1.5, 2.5, 0.15, -8.0, 8.0, 0.2),
    )
    translation: ThreeSamplers = (
        TailSampler(0.0, 0.4, 2.5, 0.15, -0.7, 0.7, 0.03),
        TailSampler(0.0, 0.25, 2.0, 0.2, -0.4, 0.4, 0.025),
        TailSampler(0.0, 1.8, 2.5, 0.15, -5.0, 5.0, 0.02),
    )
    backward_share: Share = 0.2

    def draw(self, rng: np.random.Generator, depth: float) -> np.ndarray:
        """Draw the motion (4, 4) of something at a depth, metres."""
        angles = np.array([sampler.draw(rng) for sampler in self.rotation_deg])
        x, y, z = self.translation
        low = max(z.low, -self.backward_share * depth)
        t = np.array([x.draw(rng), y.draw(rng), z.draw(rng, low)])
        return make_transform(euler_deg_to_matrix(angles), t)


Pixels = Annotated[int, Field(ge=2)]


@option_group
class PaperOptions:
    """Options of the paper's five steps; ``configs/data_paper.yaml`` explains every number."""

    height: Pixels = 128
    width: Pixels = 256
    full_height: Pixels = 436
    full_width: Pixels = 1024
    focal: TailSampler = TailSampler(0.03, 0.5, 2.0, 0.4, 0.0, 1.0, 0.08)
    focal_low: Positive = 576.0
    focal_high: Positive = 3200.0
    background_depth: TailSampler = TailSampler(0.6, 0.2, 2.0, 0.5, 0.0, 1.0, 0.1)
    background_low: Positive = 1.0
    background_high: Positive = 80.0
    background_far_probability: Share = 0.1
    background_far: Positive = 3200.0
    object_depth: TailSampler = TailSampler(0.6, 0.6, 1.5, 0.4, 0.0, 1.0, 0.2)
    object_near_divisor: Positive = 5200.0
    objects: Annotated[int, Field(ge=0, le=64)] = 5
    move_probability: Share = 0.6
    # share of the image's width that an object spans: mean, spread, lowest, highest
    object_size: tuple[float, Positive, Positive, Share] = (0.55, 0.2, 0.25, 0.7)
    canvas_margin: Annotated[float, Field(ge=0, le=4)] = 0.25
    motion: MotionSamplers = MotionSamplers()
    degraded_share: Share = 0.0
    preset: Literal["paper"] = "paper"

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw one pair by the five steps."""
        # 1. intrinsics; the published code resizes corner to corner, hence fx != fy at 128x256
        f = self.focal_low + self.focal.draw(rng) * (
            self.focal_high - self.focal_low
        )
        x = (self.width - 1) / 2
        y = (self.height - 1) / 2
        fx = 2 * f * x / (self.full_width - 1)
        fy = 2 * f * y / (self.full_height - 1)
        K = np.array([[fx, 0, x], [0, fy, y], [0, 0, 1]], np.float32)

        # 2. background and objects, each at one depth
        if rng.random() < self.background_far_probability:
            background = rng.uniform(self.background_high, self.background_far)
        else:
            span = self.background_high - self.background_low
            background = (
                self.background_low + self.background_depth.draw(rng) * span
            )
        near = f / self.object_near_divisor
        depths = [
            near + self.object_depth.draw(rng) * (background - near)
            if background > near
            else background
            for _ in range(self.objects)
        ]
        rho = np.full((self.height, self.width), 1.0 / background, np.float32)
        owner = np.zeros(rho.shape, np.uint8)
        for number, depth in enumerate(depths, start=1):
            nearness = np.float32(1.0 / depth)
            shown = _place(rng, self) & (nearness > rho)
            owner[shown], rho[shown] = number, nearness

        # 3. motions of the camera and of the objects that move
        T = self.motion.draw(rng, min(depths, default=background)).astype(
            np.float32
        )
        motions = {
            number: self.motion.draw(rng, depth)
            for number, depth in enumerate(depths, start=1)
            if rng.random() < self.move_probability
        }

        # 4. and 5. the flow of each, added where an object is in front
        ray = rays(K, rho.shape).astype(np.float32)
        depth_prev = 1.0 / rho
        ego_flow, ratio = rigid_flow(K, rho, T, ray)
        flow = ego_flow.copy()
        for number, motion in motions.items():
            mine = owner == number
            added, change = rigid_flow(K, rho[mine], motion, ray[:, mine])
            flow[mine] += added
            ratio[mine] += change - 1.0
        depth_curr = np.maximum(depth_prev * ratio, 0.0)
        moving = np.isin(owner, list(motions))
        depths_of = depth_prev, depth_curr, depth_prev, depth_curr
        sample = Sample(flow, ego_flow, *depths_of, K, T, moving)
        if self.degraded_share and rng.random() < self.degraded_share:
            return _degraded(rng, self, sample)
        return sample


def _degraded(rng: np.random.Generator, o: PaperOptions, sample: Sample) -> Sample:
    """A pair with noise and random masks (section 6, the paper's future): flow NaN, depth 0."""
    gross = rng.uniform(0, 0.3) if rng.random() < 0.5 else 0.0
    flow = noisy_flow(
        rng, sample.flow, log_uniform(rng, (0.02, 1.0)), gross, 0.06 * o.width
    )[0]
    for _ in range(int(rng.integers(4))):
        flow[_place(rng, o)] = np.nan
    prev, curr = degrade_depth(rng, [sample.depth_prev, sample.depth_curr])
    return replace(sample, flow=flow, depth_prev=prev, depth_curr=curr)


def _place(rng: np.random.Generator, o: PaperOptions) -> np.ndarray:
    """Where an object is seen, (H, W) bool: a silhouette at a random place in or near the view."""
    size, (mean, spread, low, high) = (o.height, o.width), o.object_size
    share = -np.inf
    while not low <= share <= high:
        share = mean + spread * rng.standard_normal()
    mask = cut_out(rng, max(int(o.width * share), 2))
    if rng.random() < 0.5:
        mask = mask[:, ::-1]
    (height, width), margin = (
        mask.shape,
        [int(side * o.canvas_margin) for side in size],
    )
    canvas = np.zeros(
        np.maximum(np.add(size, np.multiply(2, margin)), mask.shape), bool
    )
    top, left = (
        int(rng.integers(room + 1))
        for room in np.subtract(canvas.shape, mask.shape)
    )
    canvas[top : top + height, left : left + width] = mask
    return canvas[margin[0] : margin[0] + size[0], margin[1] : margin[1] + size[1]]
