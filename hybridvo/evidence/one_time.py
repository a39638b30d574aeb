"""A frame whose pixels were measured at several times, as it would be if all were of one time.

A rolling shutter exposes the rows of an image one after the other, and many cameras measure depth
with a sensor of its own, somewhat before or after the image. In a turn of 150 degrees a second
the depth map of ten milliseconds later lies 1.5 degrees beside the image.

Where each pixel has to be read is worked out on a coarse grid; images and maps are read once.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import (
    backproject,
    cross_matrix,
    nearest_pixels,
    project,
    se3_log,
    valid_depth,
)
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import MotionPrior
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.evidence.calibration import NEGLIGIBLE_SHIFT_PX
from hybridvo.solver.coarse_images import follow_roughly

# about how many nodes the grid has in a row of the image; with 10 rendered pairs err twice as much
NODES = 40
# terms of the series of a motion: what is left out of a turn of 15 degrees is a tenth of a pixel
TERMS = 3
# rows may move by so large a fraction of what the readout passes meanwhile
MAX_OVERTAKING = 0.5
# guards divisions where the camera would pass a point
NEAREST_M = 1e-3
# a pixel takes at most so many times the time between two frames to move
LONGEST_FLOW = 2.0


def is_of_one_time(pair: FramePair) -> bool:
    """Whether the cameras of a pair state no times, or the time between its frames is unknown."""
    between_s = pair.curr.timestamp - pair.prev.timestamp
    cameras = (pair.prev.camera, pair.curr.camera)
    return between_s <= 0 or not any(states_times(each) for each in cameras)


def states_times(camera: Camera) -> bool:
    """Whether the pixels of a camera's frames were measured at several times."""
    return camera.readout_ms != 0 or camera.depth_lag_ms != 0


def pair_at_image_times(pair: FramePair, T_curr_prev: np.ndarray) -> FramePair:
    """Bring each frame of a pair to the time of its middle row, and the flow to both.

    Args:
        pair: two frames; flow is that of the rows as they were exposed.
        T_curr_prev: (4, 4) motion from one to the other, roughly.

    Returns:
        The pair that a camera would have taken that measures all of a frame at one time; the same
        pair where that is so already, or the time between the frames is unknown.
    """
    if is_of_one_time(pair):
        return pair
    between_s = pair.curr.timestamp - pair.prev.timestamp
    velocity = se3_log(T_curr_prev) / between_s
    in_time = replace(
        pair,
        prev=at_image_time(pair.prev, velocity),
        curr=at_image_time(pair.curr, velocity),
    )
    if pair.flow is None:
        return in_time
    return replace(in_time, flow=_flow_between_frames(pair, between_s))


def rough_motion(
    taken: FramePair,
    expected: MotionPrior | None,
    options: RefineOptions,
    find: Callable[[FramePair], np.ndarray | None],
) -> np.ndarray:
    """Return how the camera moved, to a few per cent: enough to bring frames to one time.

    It is what is expected, as reduced images correct it. Where nothing is expected, it is what is
    found in the frames as they are.

    Args:
        taken: the frames as they were taken.
        expected: the motion that is expected, or None.
        options: of the refinement.
        find: the motion T_curr_prev (4, 4) of frames that state no times; None: none is usable.

    Returns:
        (4, 4) T_curr_prev, metres; no motion where nothing is expected and none is found.
    """
    if expected is not None:
        return follow_roughly(taken, expected, options)
    unmoved = np.eye(4)
    found = find(pair_at_image_times(taken, unmoved))
    return unmoved if found is None else found


def at_image_time(frame: Frame, velocity: np.ndarray) -> Frame:
    """Bring the rows and the depth map of a frame to the time of its middle row.

    A depth map that states a lag was measured by a sensor of its own, at one time. Without a lag
    its rows are those of the image.

    Args:
        frame: its camera states ``readout_ms``, ``depth_lag_ms`` or both.
        velocity: (6,) roughly how the camera moves then: log of ``T_curr_prev`` a second, metres
            and radians.

    Returns:
        The frame as a camera would have taken it that measures all at one time, which is what its
        camera then states; the same frame where that is so already.
    """
    camera = frame.camera
    if not states_times(camera):
        return frame
    of_image, of_depth = _readings(frame, velocity)
    return replace(
        frame,
        rgb=_read_image(frame.rgb, of_image),
        depth=_read_depth(frame.depth, of_depth),
        depth_variance=_read_variance(frame.depth_variance, of_depth),
        mask=_read_mask(frame.mask, of_image),
        camera=replace(camera, readout_ms=0.0, depth_lag_ms=0.0),
    )


def _flow_between_frames(pair: FramePair, between_s: float) -> np.ndarray:
    """The flow (H, W, 2) of a pair over the time from frame to frame, px.

    A camera that moves at a constant rate makes the same motion in any interval of that length. A
    pixel that moves down took longer, by the time between its two rows. Where it would have been
    read before it was exposed, the flow is unknown.
    """
    assert pair.flow is not None
    camera = pair.curr.camera
    readout = min(camera.readout_ms / 1000 / between_s, 1.0)
    taken = 1 + readout / camera.height * pair.flow[..., 1]
    is_possible = (taken > 0) & (taken <= LONGEST_FLOW)
    taken = np.where(is_possible, taken, np.nan)
    return (pair.flow / taken[..., None]).astype(np.float32)


class _Delay(NamedTuple):
    """How much later than the middle row of the image the rows of a map are measured."""

    middle_s: float  # its middle row
    rows_s: float  # from its first row to the last


class _Reading(NamedTuple):
    """Where the pixels of a map at one time are read in the map as it was measured."""

    where: np.ndarray  # (H, W, 2) float32, column and row
    # (h, w) on the grid: depth of the one time = factor * depth read + offset
    depth_factor: np.ndarray
    depth_offset: np.ndarray


class _Readings(NamedTuple):
    """Where image and depth map of a frame are to be read; None where they stay."""

    of_image: _Reading | None
    of_depth: _Reading | None


def _readings(frame: Frame, velocity: np.ndarray) -> _Readings:
    """Where a frame is read to be of one time, by the velocity (6,) of the camera."""
    camera = frame.camera
    if frame.depth is None:
        # how far away things are is unknown: as if the camera only turned
        velocity = np.concatenate([np.zeros(3), velocity[3:]])
    grid = _Grid.of(frame, velocity)
    rolling = grid.read(_Delay(0.0, camera.readout_ms / 1000))
    if camera.depth_lag_ms == 0:
        return _Readings(rolling, rolling)
    return _Readings(rolling, grid.read(_Delay(camera.depth_lag_ms / 1000, 0.0)))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Some points of a frame, and how the camera moves past them.

    Attributes:
        camera: of the frame.
        rows: (h, w) of the nodes, px.
        points: (h, w, 3) of the nodes, metres.
        velocity: (6,) tangent, metres and radians a second.
    """

    camera: Camera
    rows: np.ndarray
    points: np.ndarray
    velocity: np.ndarray

    @classmethod
    def of(cls, frame: Frame, velocity: np.ndarray) -> _Grid:
        """The grid of a frame; where no depth is known, that of the median depth."""
        camera = frame.camera
        v, u, rays = _nodes(camera)
        z = np.ones(v.shape)
        if frame.depth is not None:
            depth = frame.depth[v, u]
            is_valid = valid_depth(depth)
            typical = np.median(depth[is_valid]) if is_valid.any() else 1.0
            z = np.where(is_valid, depth, typical)
        return cls(camera, v, rays * z[..., None], velocity)

    def late(self, delay: _Delay) -> np.ndarray:
        """(h, w) s, how much later than the middle row of the image a map shows the points."""
        per_row = delay.rows_s / self.camera.height
        middle = (self.camera.height - 1) / 2
        late = delay.middle_s + per_row * (self.rows - middle)
        # a point that moves down is met by a later row
        overtaken = per_row * self._rows_a_second()
        return late / (1 - np.clip(overtaken, -MAX_OVERTAKING, MAX_OVERTAKING))

    def shift(self, moved: np.ndarray) -> np.ndarray:
        """(h, w, 2) px from the points to where they have moved (h, w, 3) in the image."""
        camera = self.camera
        shift = project(moved, camera) - project(self.points, camera)
        longest = max(camera.shape)
        # a point that the camera has passed is far outside
        return np.clip(np.nan_to_num(shift, nan=longest), -longest, longest)

    def read(self, delay: _Delay) -> _Reading | None:
        """Where a map with a delay is to be read; None where the delay makes no difference."""
        if delay == (0.0, 0.0) or not self.velocity.any():
            return None
        camera = self.camera
        late = self.late(delay)
        moved = moved_on(self.points, self.velocity, late)
        shift = self.shift(moved)
        if np.max(np.abs(shift)) < NEGLIGIBLE_SHIFT_PX:
            return None
        shifts = _at_pixels(shift, camera.shape)
        where = cv2.add(_places(camera.shape), shifts, dst=shifts)
        turn = np.concatenate([np.zeros(3), self.velocity[3:]])
        rays = moved / np.maximum(moved[..., 2:], NEAREST_M)
        factor = moved_on(rays, turn, -late)[..., 2]
        offset = moved_on(np.zeros_like(rays), self.velocity, -late)[..., 2]
        return _Reading(where, factor, offset)

    def _rows_a_second(self) -> np.ndarray:
        """(h, w) by how many rows a second the points move down."""
        y = self.points[..., 1]
        z = self.points[..., 2]
        speed = self.points @ cross_matrix(self.velocity[3:]).T + self.velocity[:3]
        return self.camera.fy * (speed[..., 1] - y / z * speed[..., 2]) / z


class _Nodes(NamedTuple):
    """Pixels of the grid of a camera (h, w), and their points (h, w, 3) at a depth of one."""

    rows: np.ndarray
    columns: np.ndarray
    rays: np.ndarray


@functools.lru_cache(maxsize=2)
def _nodes(camera: Camera) -> _Nodes:
    """The grid of a camera."""
    side = max(1, camera.width // NODES)
    rows = nearest_pixels(camera.height, -(-camera.height // side))
    columns = nearest_pixels(camera.width, -(-camera.width // side))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    index = np.stack([v.ravel(), u.ravel()], axis=1)
    ones = np.broadcast_to(1.0, camera.shape)
    rays = backproject(ones, camera, index).reshape(*v.shape, 3)
    return _Nodes(v, u, rays)


def moved_on(
    points: np.ndarray, velocity: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """Return points after some time of a constant motion, by its series.

    Args:
        points: (..., 3) in the camera, metres.
        velocity: (6,) as of :func:`at_image_time`.
        times: (...) seconds, for each of the points.

    Returns:
        (..., 3) the points in the camera as it is then.
    """
    t = times[..., None]
    turning = cross_matrix(velocity[3:]).T
    term = t * (points @ turning + velocity[:3])
    moved = points + term
    for order in range(2, TERMS + 1):
        term = t / order * (term @ turning)
        moved = moved + term
    return moved


@functools.lru_cache(maxsize=2)
def _places(shape: tuple[int, int]) -> np.ndarray:
    """(H, W, 2) float32 column and row of each pixel."""
    rows, columns = np.indices(shape, dtype=np.float32)
    return np.stack([columns, rows], axis=-1)


def _at_pixels(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) or (H, W, 2) float32 of values on the grid."""
    return cv2.resize(
        values.astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR
    )


def _read_image(
    rgb: np.ndarray | None, reading: _Reading | None
) -> np.ndarray | None:
    """An image at one time."""
    if rgb is None or reading is None:
        return rgb
    # three channels are read faster from places in fixed point
    fixed = cv2.convertMaps(  # type: ignore[call-overload]
        reading.where, None, cv2.CV_16SC2
    )
    return cv2.remap(
        rgb,
        fixed[0],
        fixed[1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _read_depth(
    depth: np.ndarray | None, reading: _Reading | None
) -> np.ndarray | None:
    """A depth map at one time; 0 or not finite where none was measured."""
    if depth is None or reading is None:
        return depth
    read = _read_nearest(depth.astype(np.float32, copy=False), reading)
    is_known = read > 0
    # in place: fresh pages of memory cost more than the numbers in them
    read *= _at_pixels(reading.depth_factor, depth.shape)
    offset = _at_pixels(reading.depth_offset, depth.shape)
    offset *= is_known
    read += offset
    return read


def _read_nearest(values: np.ndarray, reading: _Reading) -> np.ndarray:
    """The nearest values of a map at one time; 0 outside."""
    return cv2.remap(  # type: ignore[call-overload]
        values, reading.where, None, cv2.INTER_NEAREST
    )


def _read_variance(
    variance: np.ndarray | None, reading: _Reading | None
) -> np.ndarray | None:
    """The variance of a depth map at one time."""
    if variance is None or reading is None:
        return variance
    return _read_nearest(variance, reading)


def _read_mask(
    mask: np.ndarray | None, reading: _Reading | None
) -> np.ndarray | None:
    """A mask at one time; nothing is valid outside."""
    if mask is None or reading is None:
        return mask
    return _read_nearest(mask.view(np.uint8), reading) > 0
