"""Whether depth and image show the same thing at the same pixel: the offset between the two.

At the edges of near things a depth map that is shifted against its image gives pixels the depth
of what lies beside them, and under the camera's motion they land in the wrong place. For every
shift of a small grid the photometric cost of the pixels near depth edges is measured, with the
motion held; the costs of many pairs add up, and the least one says how the depth map is shifted.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import ego_flow
from hybridvo.options import PhotometricOptions
from hybridvo.refinement import photometric_kernels as kernels
from hybridvo.refinement.photometric_images import Level, blurred, grey_image, match_blur
from hybridvo.refinement.photometric_problem import Problem, State
from hybridvo.types import FramePair, RelativePose

MAX_PX = 4
"""Largest shift looked at, px."""
LAGS = np.arange(-8, 9) / 4.0
"""Delays of the depth map, and of the last row of an image after the first, looked at, frames."""
MAX_LAG_PX = 24
"""Longest motion of the depth map under a delay that is looked at, px."""
EDGE = 0.05
"""Change of log depth within reach that makes an edge."""
MIN_STATIC = 0.5
"""Mean weight in the neighbourhood of a pixel that may be used."""
NEIGHBOURHOOD = 15
PIXELS = 3000
MIN_PIXELS = 100


@dataclass(frozen=True, eq=False)
class OffsetCost:
    """Photometric cost of the pixels at depth edges under shifts of the depth map.

    Args:
        cost: (2 n + 1, 2 n + 1) summed robust costs, rows down, columns right, n =
            :data:`MAX_PX`; pixels count at most as much as an outlier.
        pixels: how many took part, older pairs counting less. 0: nothing is known.
    """

    cost: np.ndarray
    pixels: float

    def __add__(self, other: OffsetCost) -> OffsetCost:
        """Both pairs together."""
        return OffsetCost(self.cost + other.cost, self.pixels + other.pixels)

    @classmethod
    def nothing(cls) -> OffsetCost:
        """Of no pair."""
        return cls(np.zeros((2 * MAX_PX + 1,) * 2), 0)

    @property
    def offset_px(self) -> np.ndarray:
        """(2,) right, down: where a thing is in the depth map less where it is in the image."""
        row, column = np.unravel_index(np.argmin(self.cost), self.cost.shape)
        return np.array(
            [
                column + _vertex(self.cost[row], int(column)) - MAX_PX,
                row + _vertex(self.cost[:, column], int(row)) - MAX_PX,
            ]
        )

    @property
    def gain(self) -> float:
        """How much the cost per pixel falls from no shift to the best one."""
        if not self.pixels:
            return 0.0
        return float(self.cost[MAX_PX, MAX_PX] - self.cost.min()) / self.pixels


def _vertex(values: np.ndarray, k: int) -> float:
    """Place of the minimum of a parabola through three values, relative to the middle one."""
    if not 0 < k < len(values) - 1:
        return 0.0
    before, here, after = values[k - 1 : k + 2]
    bend = before - 2 * here + after
    return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend > 0 else 0.0


def depth_offset_cost(
    pair: FramePair, pose: RelativePose, options: PhotometricOptions | None = None
) -> OffsetCost:
    """Cost of shifts of the previous depth map against its image.

    Args:
        pair: both frames with images, the previous one with depth.
        pose: the motion found, with its weights.
        options: of the photometric refinement: blur, cutoff.

    Raises:
        InputError: weights of another shape than the image.
    """
    found = _edges(pair, pose, options or PhotometricOptions())
    return OffsetCost.nothing() if found is None else found.offset_cost()


def depth_costs(
    pair: FramePair, pose: RelativePose, options: PhotometricOptions | None = None
) -> tuple[OffsetCost, np.ndarray, float]:
    """Costs of shifts and of delays of the previous depth map against its image.

    A depth map that is late shows things where they were: it is displaced along the flow. Under a
    delay of L frames the depth of a pixel with flow f stands at x - L f in the map. A rolling
    shutter, of the image and not of the depth, is a delay that grows from row to row.

    Args:
        pair: as for :func:`depth_offset_cost`.
        pose: the motion found, with its weights.
        options: of the photometric refinement.

    Returns:
        The cost of shifts; (2, L) the cost per pixel of each delay of :data:`LAGS`, less that of
        none, of the whole map and of its last row against its first; and the root mean square of
        the motion of the pixels that it was looked at on, px (0: nothing is known).

    Raises:
        InputError: weights of another shape than the image.
    """
    found = _edges(pair, pose, options or PhotometricOptions())
    if found is None:
        return OffsetCost.nothing(), np.zeros((2, len(LAGS))), 0.0
    lags, motion = found.lag_cost(pose)
    return found.offset_cost(), lags, motion


@dataclass(frozen=True, eq=False)
class _Edges:
    """Pixels at depth edges, with the motion and the light held."""

    problem: Problem
    level: Level
    state: State
    depth: np.ndarray

    def cost(self, shift: np.ndarray) -> float:
        """Cost under depths taken from pixels moved by ``shift`` (2,) or (N, 2), rows, columns."""
        place = self.problem.index + shift
        height, width = self.depth.shape
        rows, columns = np.clip(place[:, 0], 0, height - 1), np.clip(place[:, 1], 0, width - 1)
        z = self.depth[rows, columns]
        # a hole under a moved pixel says nothing: its own depth is as good
        good = (z > kernels.MIN_DEPTH) & (z < kernels.MAX_VALUE)
        own = self.depth[self.problem.index[:, 0], self.problem.index[:, 1]]
        self.problem.buffer[kernels.Z] = np.where(good, z, own)
        return self.problem.project(self.level, self.state)

    def offset_cost(self) -> OffsetCost:
        """See :func:`depth_offset_cost`."""
        side = 2 * MAX_PX + 1
        cost = np.empty((side, side))
        for row in range(side):
            for column in range(side):
                shift = np.array([row - MAX_PX, column - MAX_PX], np.int32)
                cost[row, column] = self.cost(shift)
        good = np.isfinite(cost).all()
        return OffsetCost(cost, self.problem.n) if good else OffsetCost.nothing()

    def lag_cost(self, pose: RelativePose) -> tuple[np.ndarray, float]:
        """See :func:`depth_costs`."""
        pair, index = self.problem.pair, self.problem.index
        flow = ego_flow(self.depth, pose.T_curr_prev, pair.prev.camera, pair.curr.camera)
        # of the pixels around: at an edge the pixel's own depth may be another thing's
        flow = cv2.blur(np.nan_to_num(flow).astype(np.float32), (NEIGHBOURHOOD,) * 2)
        motion = flow[index[:, 0], index[:, 1], ::-1]
        longest = MAX_LAG_PX / np.abs(LAGS).max()
        motion = motion * np.minimum(1.0, longest / np.maximum(np.abs(motion).max(), 1e-9))
        rows = (index[:, :1] + 0.5) / self.depth.shape[0] - 0.5
        cost = np.array(
            [
                [self.cost(np.rint(-lag * along).astype(np.int32)) for lag in LAGS]
                for along in (motion, rows * motion)
            ]
        )
        if not np.isfinite(cost).all():
            return np.zeros((2, len(LAGS))), 0.0
        size = float(np.sqrt(np.mean(np.sum(motion**2, axis=1))))
        return (cost - cost[:, len(LAGS) // 2, None]) / self.problem.n, size


def _edges(pair: FramePair, pose: RelativePose, options: PhotometricOptions) -> _Edges | None:
    """Pixels at depth edges of a pair, None where there are not enough of them."""
    prev, curr = pair.prev, pair.curr
    if prev.rgb is None or curr.rgb is None or prev.depth is None:
        return None
    if not pose.usable or pose.weights is None or pose.weights_stride != 1:
        return None
    if pose.weights.shape != prev.camera.shape:
        raise InputError(
            f"depth_offset_cost: expected weights of shape {prev.camera.shape}, "
            f"got {pose.weights.shape}."
        )
    level = blurred(match_blur(Level(grey_image(prev.rgb), grey_image(curr.rgb))), 1.0)
    depth = np.ascontiguousarray(prev.depth)
    index = _edge_pixels(level.prev, depth, pose.weights)
    if len(index) < MIN_PIXELS:
        return None
    problem = Problem(pair, pose, index, np.eye(6), options)
    problem.gather(level)
    problem.buffer[kernels.W] = 1.0
    state = State(pose.T_curr_prev, 1.0, 0.0)
    problem.project(level, state)
    return _Edges(problem, level, problem.settle(state, 3), depth)


def _edge_pixels(grey: np.ndarray, depth: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, 2) int32 rows and columns of textured pixels near depth edges of the static world."""
    valid = np.isfinite(depth) & (depth > kernels.MIN_DEPTH) & (depth < kernels.MAX_VALUE)
    log = np.log(np.where(valid, depth, 1.0), dtype=np.float32)
    reach = np.ones((2 * MAX_PX + 1,) * 2, np.uint8)
    edges = cv2.dilate(log, reach) - cv2.erode(log, reach) > EDGE
    edges &= cv2.erode(valid.astype(np.uint8), reach) > 0
    static = cv2.blur(np.ascontiguousarray(weights, dtype=np.float32), (NEIGHBOURHOOD,) * 2)
    usable = edges & (static > MIN_STATIC)
    border = MAX_PX + kernels.MARGIN
    usable[:border] = usable[-border:] = False
    usable[:, :border] = usable[:, -border:] = False
    rows, columns = np.nonzero(usable)
    if len(rows) == 0:
        return np.zeros((0, 2), np.int32)
    gx = grey[rows, columns + 1] - grey[rows, columns - 1]
    gy = grey[rows + 1, columns] - grey[rows - 1, columns]
    strength = gx * gx + gy * gy
    strong = strength > max(float(np.median(strength)), 16.0)
    rows, columns = rows[strong], columns[strong]
    step = max(1, len(rows) // PIXELS)
    return np.stack([rows[::step], columns[::step]], axis=1).astype(np.int32)
