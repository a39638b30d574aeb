"""Training pairs with what the real world adds to the paper's five steps.

Rooms, streets and slanted planes with relief; static occluders; movers that are articulated or
bend, one of which may cover most of the image; motions **composed** (T_cam T_object); sky; hidden
points; any lens and crop; cameras that follow a mover; inputs as sensors deliver them.
"""

from __future__ import annotations

from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from hybridvo.geometry import euler_deg_to_matrix, make_transform
from hybridvo.options import Positive, Share, option_group
from hybridvo.synthetic.draws import (
    Range,
    Silhouette,
    about,
    covering_mask,
    direction,
    log_uniform,
    outline,
    random_silhouette,
    silhouette_mask,
    smooth_field,
)
from hybridvo.synthetic.layered import Layers, Sample, visibility
from hybridvo.synthetic.sensors import SensorOptions, degrade_depth, degrade_flow, sample_at

SKY_INVERSE_DEPTH = 1.0 / 2000.0
"""Surfaces farther than two kilometres are sky."""

Pixels = Annotated[int, Field(ge=16)]
Counts = tuple[Annotated[int, Field(ge=0)], int]
Law = tuple[Positive, Positive, Positive]
"""Median, spread of the logarithm, and largest value of a log-normal distribution."""


@option_group
class DiverseOptions:
    """Options of the diverse preset; units and reasons stand in ``configs/data_diverse.yaml``."""

    height: Pixels = 128
    width: Pixels = 256
    field_of_view_deg: Range = (35.0, 105.0)
    aspect: Range = (0.45, 1.8)
    centre_shift: Share = 0.1
    scene_depth: Range = (1.0, 60.0)
    room_probability: Share = 0.4
    outdoor_probability: Share = 0.35
    relief: Annotated[float, Field(ge=0)] = 0.25
    sky_far_probability: Share = 0.5
    static_layers: Counts = (0, 7)
    movers: Counts = (0, 3)
    mover_radius: Range = (0.04, 0.25)
    still_probability: Share = 0.08
    large_mover_probability: Share = 0.5
    large_coverage: Range = (0.4, 0.87)
    articulated_probability: Share = 0.35
    nonrigid_probability: Share = 0.3
    bend: Range = (0.002, 0.03)
    follow_probability: Share = 0.35
    follow_residual: Range = (0.02, 0.6)
    camera_rotation_deg: Law = (0.5, 1.1, 12.0)
    camera_translation: Law = (0.02, 1.1, 0.3)
    camera_translation_limit: Positive = 3.0
    forward_probability: Share = 0.3
    object_rotation_deg: Law = (1.5, 1.0, 15.0)
    object_translation: Law = (0.03, 0.9, 0.25)
    limb_rotation_deg: Law = (4.0, 0.7, 25.0)
    moving_threshold_px: Positive = 0.5
    flow_limit: Positive = 0.35
    degradation: SensorOptions = SensorOptions()
    preset: Literal["diverse"] = "diverse"

    def sample(self, rng: np.random.Generator) -> Sample:
        """One pair."""
        while True:
            scene = _Scene(rng, self)
            T = scene.populate()
            ego_flow, ego_ratio, flow, ratio = scene.flows(T, added=False)
            if self._plausible(flow, ratio) and self._plausible(ego_flow, ego_ratio):
                break
        rho = scene.rho
        depth = np.divide(1.0, rho, out=np.zeros_like(rho), where=rho > 0)
        own = np.square(flow - ego_flow)
        hidden, depth_curr = visibility(flow, rho / ratio, rho > 0)
        measured, depth_prev = flow, depth
        if rng.random() < self.sky_far_probability and not rho.all():
            far = np.float32(rng.uniform(1e3, 1e4))
            depth_prev = np.where(rho > 0, depth, far)
            depth_curr = np.where((rho > 0) | hidden | (depth_curr > 0), depth_curr, far)
        if rng.random() >= self.degradation.exact_flow_probability:
            measured = degrade_flow(rng, flow, hidden, self.degradation)
            depth_curr = sample_at(depth_curr, measured - flow)
        if rng.random() >= self.degradation.exact_depth_probability:
            depth_prev, depth_curr = degrade_depth(rng, [depth_prev, depth_curr], self.degradation)
        return Sample(
            flow=measured,
            ego_flow=ego_flow,
            depth_prev=depth_prev,
            depth_curr=depth_curr,
            depth_true=depth,
            depth_target=np.maximum(depth * ego_ratio, 0.0),
            K=scene.K.astype(np.float32),
            T_curr_prev=T.astype(np.float32),
            moving=own[..., 0] + own[..., 1] > self.moving_threshold_px**2,
        )

    def _plausible(self, flow: np.ndarray, ratio: np.ndarray) -> bool:
        """Nothing is swept through the image plane, and flow could follow the motion."""
        limit = self.flow_limit * self.width
        # Component by component: numpy reduces an axis of two values very slowly.
        large = (np.abs(flow[..., 0]) > limit) | (np.abs(flow[..., 1]) > limit)
        return bool(ratio.min() > 0.15) and np.count_nonzero(large) <= 0.01 * large.size


class _Scene(Layers):
    """A room, a street or a slanted surface, and what is laid over it."""

    def __init__(self, rng: np.random.Generator, options: DiverseOptions) -> None:
        o, self.rng, self.options = options, rng, options
        size = np.array([o.width, o.height])
        fx = o.width / 2 / np.tan(np.deg2rad(log_uniform(rng, o.field_of_view_deg)) / 2)
        fy = fx * log_uniform(rng, o.aspect)
        cx, cy = (size - 1) / 2 + o.centre_shift * rng.uniform(-1, 1, 2) * size
        self.scale = log_uniform(rng, o.scene_depth)
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        super().__init__(K, np.zeros((o.height, o.width), np.float32))
        self._build()

    def _build(self) -> None:
        """Walls, ground or one slanted surface; what is left is sky."""
        o, rng, rho = self.options, self.rng, self.rho
        kind = rng.random()
        yaw, pitch, roll = rng.uniform(-40, 40), rng.normal(0, 10), rng.normal(0, 4)
        R = euler_deg_to_matrix(np.array([pitch, yaw, roll]))
        size = self.scale
        down, right, forward = np.eye(3)[[1, 0, 2]]
        planes = [(down, size * rng.uniform(0.25, 0.7))]
        if kind < o.room_probability:
            planes += [
                (-down, size * rng.uniform(0.25, 0.9)),
                (right, size * rng.uniform(0.3, 2.0)),
                (-right, size * rng.uniform(0.3, 2.0)),
                (forward, size * rng.uniform(0.7, 3.0)),
            ]
        elif kind < o.room_probability + o.outdoor_probability:
            for side in (1.0, -1.0):
                if rng.random() < 0.4:
                    planes.append((side * right, size * rng.uniform(0.3, 4.0)))
            if rng.random() < 0.4:
                planes.append((forward, size * rng.uniform(1.0, 20.0)))
        else:
            tilt = rng.uniform(-0.9, 0.9, 2)
            normal = np.array([tilt[0], tilt[1], 1.0])
            planes = [(normal / np.linalg.norm(normal), size * rng.uniform(0.6, 1.5))]
            R = np.eye(3)
        for normal, distance in planes:
            n = (R.T @ normal / distance).astype(np.float32)
            np.maximum(rho, n[0] * self.x + (n[1] * self.y + n[2]), out=rho)
        if kind >= o.room_probability + o.outdoor_probability:
            # A single surface has no sky: it bends away instead.
            np.maximum(rho, np.float32(0.05 / size), out=rho)
        relief = o.relief * rng.random() ** 2
        rho *= np.exp(relief * smooth_field(rng, rho.shape, int(rng.integers(3, 12))))
        rho[rho < SKY_INVERSE_DEPTH] = 0.0
        np.minimum(rho, 5.0, out=rho)

    def add(
        self, mask: np.ndarray, in_front: bool, inverse_depth: float | None = None
    ) -> tuple[int, np.ndarray] | None:
        """Lay a curved, slanted surface over the image; its number and middle (3,), or None."""
        rng = self.rng
        left, top, width, height = cv2.boundingRect(mask)
        if not width * height:
            return None
        box = np.s_[top : top + height, left : left + width]
        inside, under = mask[box] > 0, self.rho[box]
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
        if np.count_nonzero(inside & (rho > under)) < 4:
            return None
        rows, columns = np.nonzero(self.lay(box, inside, rho))
        return len(self.motions) - 1, self.ray(
            left + columns.mean(), top + rows.mean()
        ) / inverse_depth

    def ray(self, u: float, v: float) -> np.ndarray:
        """(3,) K^-1 (u, v, 1)."""
        return np.linalg.solve(self.K, (u, v, 1.0))

    def magnitude(self, law: Law) -> float:
        """One draw of a log-normal law."""
        median, spread, largest = law
        return min(median * float(np.exp(spread * self.rng.standard_normal())), largest)

    def turn(self, law: Law) -> np.ndarray:
        """(3, 3) rotation of a drawn size about a drawn axis (small angles: as Euler angles)."""
        return euler_deg_to_matrix(self.magnitude(law) * direction(self.rng))

    def camera(self, follow: bool) -> np.ndarray:
        """(4, 4) T_curr_prev."""
        o, rng = self.options, self.rng
        angles = self.magnitude(o.camera_rotation_deg) * direction(rng)
        seen = self.rho[::2, ::2]
        seen = seen[seen > 0]
        if not seen.size:
            seen = np.array([1.0 / self.scale])
        nearest, near = float(seen.max()), 1.0 / float(np.quantile(seen, 0.8))
        towards = direction(rng)
        if rng.random() < o.forward_probability:
            towards = towards * 0.2 + np.array([0.0, 0.0, rng.choice([-1.0, -1.0, -1.0, 1.0])])
            towards /= np.linalg.norm(towards)
        size = self.magnitude(o.camera_translation) * near * (1.5 if follow else 1.0)
        size = min(size, o.camera_translation_limit, 0.4 / nearest)
        return make_transform(euler_deg_to_matrix(angles), size * towards)

    def add_mover(
        self, shape: Silhouette, mask: np.ndarray, radius: float, T_cam: np.ndarray, follow: float
    ) -> None:
        """Lay a mover over the scene; ``follow``: motion left where the camera follows, else 0."""
        o, rng = self.options, self.rng
        added = self.add(mask, in_front=True)
        if added is None:
            return
        number, centre = added
        depth = float(centre[2])
        R = self.turn(o.object_rotation_deg)
        t = self.magnitude(o.object_translation) * depth * direction(rng) * (1.0, 0.6, 0.8)
        total = T_cam @ about(R, centre, t)
        if follow:
            total = about(euler_deg_to_matrix(follow * 3.0 * direction(rng)), centre, follow * t)
        self.motions[number] = total
        if rng.random() < o.nonrigid_probability:
            amplitude = np.float32(log_uniform(rng, o.bend) * depth)
            field = smooth_field(rng, self.rho.shape, int(rng.integers(3, 8)), 3)
            self.bends[number] = amplitude * field
        if rng.random() < o.articulated_probability:
            points = shape[0][0]
            middle = (self.K @ centre)[:2] / depth
            for _ in range(int(rng.integers(1, 6))):
                limb_radius = radius * rng.uniform(0.3, 0.8)
                limb = outline(rng, "bar" if rng.random() < 0.6 else "superellipse")
                joint = middle + radius * points[int(rng.integers(len(points)))] * 0.8
                place = joint + limb_radius * limb[int(rng.integers(len(limb)))]
                limb_mask = silhouette_mask([(limb, True)], self.rho.shape, place, limb_radius)
                part = self.add(limb_mask, True, 1.02 / depth)
                if part is not None:
                    own = self.turn(o.limb_rotation_deg)
                    self.motions[part[0]] = total @ about(own, self.ray(*joint) * depth)

    def small(self, shape: Silhouette, radius: float, highest: float) -> np.ndarray:
        """Mask of an outline somewhere, stretched by 0.4 to ``highest``."""
        place = self.rng.uniform(0, self.rho.shape[1]), self.rng.uniform(0, self.rho.shape[0])
        stretch = log_uniform(self.rng, (0.4, highest))
        return silhouette_mask(shape, self.rho.shape, place, radius, stretch)

    def occlude(self, count: int) -> None:
        """Lay things that stand still over the scene."""
        for _ in range(count):
            radius = self.rho.shape[1] * log_uniform(self.rng, self.options.mover_radius)
            self.add(self.small(random_silhouette(self.rng), radius, 2.5), in_front=False)

    def populate(self) -> np.ndarray:
        """Occluders and movers; returns the camera's T_curr_prev."""
        o, rng = self.options, self.rng
        still = rng.random() < o.still_probability
        large = not still and rng.random() < o.large_mover_probability
        follow = 0.0
        if not still and rng.random() < o.follow_probability:
            follow = log_uniform(rng, o.follow_residual)
        self.occlude(int(rng.integers(o.static_layers[0], o.static_layers[1] + 1)))
        T_cam = self.camera(follow > 0)
        if large:
            centre = rng.uniform(-0.1, 1.1) * o.width, rng.uniform(0.1, 1.1) * o.height
            share = rng.uniform(*o.large_coverage)
            shape, stretch = random_silhouette(rng, 0.15), log_uniform(rng, (0.5, 1.6))
            mask, radius = covering_mask(shape, self.rho.shape, centre, share, stretch)
            self.add_mover(shape, mask, radius, T_cam, follow)
        if not still:
            count = int(rng.integers(o.movers[0], o.movers[1] + 1))
            for index in range(count if large else max(count, 1)):
                shape = random_silhouette(rng)
                radius = o.width * log_uniform(rng, o.mover_radius)
                followed = 0.0 if index or large else follow
                self.add_mover(shape, self.small(shape, radius, 2.0), radius, T_cam, followed)
        if rng.random() < 0.4:
            self.occlude(int(rng.integers(1, 3)))
        return T_cam
