"""The paper's five steps of drawing a training pair (section 3.4), and
what every pair consists of.

The steps: 1. intrinsics; 2. a background and five objects, each at one depth; 3.
motions of the camera and the objects; 4. the rigid flow of each; 5. composition,
the nearest surface in front. An object's own flow is **added** to the camera's.
Surfaces are kept as inverse depth: the sky is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import (
    euler_deg_to_matrix,
    make_transform,
    matrix_to_euler_deg,
    pixel_grid,
)
from hybridvo.core.options import Fraction, Positive, option_group
from hybridvo.core.types import FramePair
from hybridvo_lab.synthetic.draws import draw_mask, log_uniform
from hybridvo_lab.synthetic.sensors import degrade_depth, noisy_flow

MIN_DEPTH_RATIO = 1e-6
"""Smallest |z' / z|, so that the flow of a point in the image plane is finite."""
MAX_SLOPE = 0.02
"""Relative change of inverse depth a pixel above which a depth edge is no slope."""
MAX_DRAWS = 10_000
"""Draws of a number after which its limits count as unreachable."""
OUTLIER_REACH = 0.06
"""Largest gross error of a degraded pair's flow, as a fraction of the width."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One training pair, all on the pixel grid of frame t: float32, px,
    metres; depth 0 is invalid.

    A network is given ``flow``, ``depth_prev`` and ``depth_curr``.
    """

    flow: np.ndarray  # (H, W, 2)
    ego_flow: np.ndarray  # (H, W, 2) of the camera motion alone
    depth_prev: np.ndarray  # (H, W)
    depth_curr: np.ndarray  # (H, W) depth of t+1 at x + flow
    depth_true: np.ndarray  # (H, W) depth of t without noise or holes
    # (H, W) depth of t+1 that the loss L^D expects; only the paper's steps let
    # objects move in it
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
    # path of the recording that shows the static scene; "rendered", or empty, if
    # there is none
    static_source: str = ""


# --- rigid flow -------------------------------------------------------------------


class RigidFlow(NamedTuple):
    """The flow of a rigid motion."""

    flow: np.ndarray  # (..., 2) px
    # (...) z' / z, the depth after the motion over that before
    depth_ratio: np.ndarray


def camera_flow(K: np.ndarray, depth: np.ndarray, T: np.ndarray) -> RigidFlow:
    """Return the ego flow of an entire depth map.

    Args:
        K: (3, 3) intrinsics of both frames.
        depth: (H, W) metres; 0 is infinitely far away.
        T: (4, 4) T_curr_prev.
    """
    rho = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0)
    return rigid_flow(K, rho.astype(np.float32), T)


def rays(K: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Return the first two components of K^-1 x for every pixel x
    of (H, W), as (2, H, W).
    """
    height, width = size
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    y = (np.arange(height) - K[1, 2]) / K[1, 1]
    return np.stack(np.broadcast_arrays(x, y[:, None]))


def rigid_flow(
    K: np.ndarray, rho: np.ndarray, T: np.ndarray, ray: np.ndarray | None = None
) -> RigidFlow:
    """Return the flow that a rigid motion gives to points of known inverse depth.

    This is the paper's equation 8, written as differences so that single
    precision suffices. As in the published code |z'| is taken: a point behind the
    camera keeps a bounded flow.

    Args:
        K: (3, 3) intrinsics of both frames.
        rho: (...) inverse depth, 1 / m, of the pixels of
            ``ray``, or of an image (H, W).
        T: (4, 4) motion of the points in the camera's frame.
        ray: (2, ...) from :func:`rays`; None: those of an image.
    """
    directions = rays(K, rho.shape) if ray is None else ray
    x, y = directions.astype(rho.dtype)

    def moved(row: np.ndarray) -> np.ndarray:
        """One coordinate of the moved point, over the old depth."""
        a, b, c, d = row
        return a * x + (b * y + c) + d * rho

    u, v, depth_ratio = (moved(row) for row in T[:3].astype(rho.dtype))
    scale = 1.0 / np.abs(depth_ratio).clip(MIN_DEPTH_RATIO)
    flow_x = (u * scale - x) * float(K[0, 0])
    flow_y = (v * scale - y) * float(K[1, 1])
    return RigidFlow(np.stack([flow_x, flow_y], axis=-1), depth_ratio)


def splat(flow: np.ndarray, rho_curr: np.ndarray) -> np.ndarray:
    """Move inverse depth along a flow into the next frame.

    The nearest surface wins.

    Args:
        flow: (H, W, 2) px.
        rho_curr: (H, W) the new inverse depth, on the old grid.

    Returns:
        (H, W) the new inverse depth on the new grid; 0 where nothing lands.
    """
    height, width = rho_curr.shape
    place = np.rint(flow + pixel_grid(height, width)).astype(np.int64)
    inside = ((place >= 0) & (place < (width, height))).all(axis=-1)
    index = np.where(inside, place @ (1, width), 0)

    # the value at the centre of the pixel in which a point lands
    value = rho_curr.copy()
    off_centre = np.rint(flow) - flow
    for axis in (0, 1):
        slope = np.gradient(rho_curr, axis=1 - axis)
        slope[np.abs(slope) > MAX_SLOPE * rho_curr] = 0.0
        value += slope * off_centre[..., axis]

    front = np.zeros(rho_curr.size, rho_curr.dtype)
    np.maximum.at(front, index[inside], value[inside])
    return front.reshape(rho_curr.shape)


# --- random numbers and motions ---------------------------------------------------


@option_group
class TailSampler:
    """A number that is drawn from a narrow normal core or, less
    often, from a wide tail.

    A tail value v becomes sign(v) |v|^power; values outside of low to high are
    drawn again. ``configs/data_paper.yaml`` gives the sources of the numbers used.
    """

    mean: float
    tail_std: Positive
    power: Positive
    tail_probability: Fraction
    low: float
    high: float
    core_std: Positive

    def draw(self, rng: np.random.Generator, low: float | None = None) -> float:
        """Draw one value.

        ``low`` replaces the lower limit where the scene demands it.
        """
        low = self.low if low is None else low
        is_tail = rng.random() < self.tail_probability
        std = self.tail_std if is_tail else self.core_std
        for _ in range(MAX_DRAWS):
            value = self.mean + std * rng.standard_normal()
            if is_tail:
                value = np.sign(value) * abs(value) ** self.power
            if low <= value <= self.high:
                return float(value)
        raise InputError(
            f"None of {MAX_DRAWS} draws of {self} fell into [{low}, {self.high}]. "
            f"Choose wider limits or a larger standard deviation."
        )


ThreeSamplers = tuple[TailSampler, TailSampler, TailSampler]


@option_group
class MotionSamplers:
    """Samplers of one rigid motion (step 3), of the camera or an object.

    Rotations are Euler angles X, Y, Z in degrees, R = Rx Ry Rz; translations are in
    metres. The Z translation is at least minus ``backward_share`` of the object's
    depth, so that no object moves through the image plane.
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
    backward_share: Fraction = 0.2

    def draw(self, rng: np.random.Generator, depth: float) -> np.ndarray:
        """Draw the motion (4, 4) of an object at a depth, metres, or
        of the camera before it.
        """
        angles = np.array([sampler.draw(rng) for sampler in self.rotation_deg])
        x, y, z = self.translation
        low = max(z.low, -self.backward_share * depth)
        t = np.array([x.draw(rng), y.draw(rng), z.draw(rng, low)])
        return make_transform(euler_deg_to_matrix(angles), t)


Pixels = Annotated[int, Field(ge=2)]


@option_group
class PaperOptions:
    """Options of the paper's five steps.

    ``configs/data_paper.yaml`` explains every number.
    """

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
    background_far_probability: Fraction = 0.1
    background_far: Positive = 3200.0
    object_depth: TailSampler = TailSampler(0.6, 0.6, 1.5, 0.4, 0.0, 1.0, 0.2)
    object_near_divisor: Positive = 5200.0
    objects: Annotated[int, Field(ge=0, le=64)] = 5
    move_probability: Fraction = 0.6
    # fraction of the image's width that an object spans: mean, standard deviation,
    # lowest, highest
    object_size: tuple[float, Positive, Positive, Fraction] = (0.55, 0.2, 0.25, 0.7)
    canvas_margin: Annotated[float, Field(ge=0, le=4)] = 0.25
    motion: MotionSamplers = MotionSamplers()
    degraded_share: Fraction = 0.0
    preset: Literal["paper"] = "paper"

    def sample(self, rng: np.random.Generator) -> Sample:
        """Draw one pair by the five steps."""
        # 1. intrinsics
        focal = self._draw_focal(rng)
        K = self._intrinsics(focal)

        # 2. background and objects, each at one depth
        background = self._draw_background(rng)
        depths = self._draw_depths(rng, focal, background)
        size = (self.height, self.width)
        rho = np.full(size, 1.0 / background, np.float32)
        owner = np.zeros(size, np.uint8)
        for number, depth in enumerate(depths, start=1):
            nearness = np.float32(1.0 / depth)
            in_front = self._draw_object_mask(rng) & (nearness > rho)
            owner[in_front] = number
            rho[in_front] = nearness

        # 3. motions of the camera and of the objects that move
        nearest = min(depths, default=background)
        T = self.motion.draw(rng, nearest).astype(np.float32)
        motions = {
            number: self.motion.draw(rng, depth)
            for number, depth in enumerate(depths, start=1)
            if rng.random() < self.move_probability
        }

        # 4. and 5. the flow of each, added where an object is in front
        sample = self._compose(K, rho, owner, T, motions)
        if self.degraded_share and rng.random() < self.degraded_share:
            return self._degrade(rng, sample)
        return sample

    def _draw_focal(self, rng: np.random.Generator) -> float:
        """Focal length, px of the full image."""
        span = self.focal_high - self.focal_low
        return self.focal_low + self.focal.draw(rng) * span

    def _intrinsics(self, focal: float) -> np.ndarray:
        """K (3, 3) of the sample.

        The published code resizes corner to corner, hence fx != fy.
        """
        x = (self.width - 1) / 2
        y = (self.height - 1) / 2
        fx = 2 * focal * x / (self.full_width - 1)
        fy = 2 * focal * y / (self.full_height - 1)
        return np.array([[fx, 0, x], [0, fy, y], [0, 0, 1]], np.float32)

    def _draw_background(self, rng: np.random.Generator) -> float:
        """Depth of the background, metres."""
        if rng.random() < self.background_far_probability:
            return rng.uniform(self.background_high, self.background_far)
        span = self.background_high - self.background_low
        return self.background_low + self.background_depth.draw(rng) * span

    def _draw_depths(
        self, rng: np.random.Generator, focal: float, background: float
    ) -> list[float]:
        """Depths of the objects, metres, between the nearest
        possible one and the background.
        """
        nearest = focal / self.object_near_divisor
        if background <= nearest:
            return [background] * self.objects
        span = background - nearest
        return [
            nearest + self.object_depth.draw(rng) * span
            for _ in range(self.objects)
        ]

    def _compose(
        self,
        K: np.ndarray,
        rho: np.ndarray,
        owner: np.ndarray,
        T: np.ndarray,
        motions: dict[int, np.ndarray],
    ) -> Sample:
        """Make the pair from its surfaces and motions.

        Args:
            K: (3, 3) intrinsics.
            rho: (H, W) inverse depth of the nearest surface.
            owner: (H, W) number of the object at each pixel, 0 for the background.
            T: (4, 4) camera motion.
            motions: (4, 4) motions of the objects that move, by their number.
        """
        ray = rays(K, rho.shape).astype(np.float32)
        depth_prev = 1.0 / rho
        ego_flow, depth_ratio = rigid_flow(K, rho, T, ray)
        flow = ego_flow.copy()
        for number, motion in motions.items():
            mine = owner == number
            own = rigid_flow(K, rho[mine], motion, ray[:, mine])
            flow[mine] += own.flow
            depth_ratio[mine] += own.depth_ratio - 1.0
        depth_curr = np.maximum(depth_prev * depth_ratio, 0.0)
        return Sample(
            flow=flow,
            ego_flow=ego_flow,
            depth_prev=depth_prev,
            depth_curr=depth_curr,
            depth_true=depth_prev,
            depth_target=depth_curr,
            K=K,
            T_curr_prev=T,
            moving=np.isin(owner, list(motions)),
        )

    def _degrade(self, rng: np.random.Generator, sample: Sample) -> Sample:
        """Add noise and random masks (section 6, the paper's
        future): flow NaN, depth 0.
        """
        outliers = rng.uniform(0, 0.3) if rng.random() < 0.5 else 0.0
        noise_px = log_uniform(rng, (0.02, 1.0))
        reach_px = OUTLIER_REACH * self.width
        flow, _ = noisy_flow(rng, sample.flow, noise_px, outliers, reach_px)
        for _ in range(int(rng.integers(4))):
            flow[self._draw_object_mask(rng)] = np.nan
        prev, curr = degrade_depth(rng, [sample.depth_prev, sample.depth_curr])
        return replace(sample, flow=flow, depth_prev=prev, depth_curr=curr)

    def _draw_object_mask(self, rng: np.random.Generator) -> np.ndarray:
        """Where an object is visible, (H, W) bool: a random silhouette."""
        mean, std, low, high = self.object_size
        fraction = -np.inf
        while not low <= fraction <= high:
            fraction = mean + std * rng.standard_normal()
        mask = draw_mask(rng, max(int(self.width * fraction), 2))
        if rng.random() < 0.5:
            mask = mask[:, ::-1]

        # a canvas with margins, so that objects can hang over the border
        mask_height, mask_width = mask.shape
        margin_y = int(self.height * self.canvas_margin)
        margin_x = int(self.width * self.canvas_margin)
        canvas_height = max(self.height + 2 * margin_y, mask_height)
        canvas_width = max(self.width + 2 * margin_x, mask_width)
        canvas = np.zeros((canvas_height, canvas_width), bool)
        top = int(rng.integers(canvas_height - mask_height + 1))
        left = int(rng.integers(canvas_width - mask_width + 1))
        canvas[top : top + mask_height, left : left + mask_width] = mask
        return canvas[
            margin_y : margin_y + self.height, margin_x : margin_x + self.width
        ]
