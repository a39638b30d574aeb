"""A frame whose pixels were measured at several times, as it would be if all were of one time.

A rolling shutter exposes the rows of an image one after the other, and many cameras measure depth
with a sensor of its own, somewhat before or after the image. In a turn of 150 degrees a second
the depth map of ten milliseconds later lies 1.5 degrees beside the image.

Where each pixel has to be read is worked out on a coarse grid; images and maps are read once.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from hybridvo.core.geometry import cross_matrix, se3_log, valid_depth
from hybridvo.core.types import Camera, Frame
from hybridvo.evidence.calibration import NEGLIGIBLE_SHIFT_PX

# pixels between the nodes of the grid
SPACING = 16
# terms of the series of a motion: what is left out of a turn of 15 degrees is a tenth of a pixel
TERMS = 3
# rows may move by so large a fraction of what the readout passes meanwhile
MAX_OVERTAKING = 0.5
# guards divisions where the camera would pass a point
NEAREST_M = 1e-3


def at_image_time(
    frame: Frame,
    T_curr_prev: np.ndarray,
    duration_s: float,
    moves_rows: bool = True,
) -> Frame:
    """Bring the rows and the depth map of a frame to the time of its middle row.

    A depth map that states a lag was measured by a sensor of its own, at one time. Without a lag
    its rows are those of the image.

    Args:
        frame: its camera states ``readout_ms``, ``depth_lag_ms`` or both.
        T_curr_prev: (4, 4) how the camera moves about then: a motion, metres.
        duration_s: how long that motion takes, seconds.
        moves_rows: whether the rows of the image are moved; else its camera states them as before.

    Returns:
        The frame as a camera would have taken it that measures all at one time, which is what its
        camera then states; the same frame where that is so already or the duration is unknown.
    """
    camera = frame.camera
    readout_ms = camera.readout_ms if moves_rows else 0.0
    is_of_one_time = readout_ms == 0 and camera.depth_lag_ms == 0
    if is_of_one_time or duration_s <= 0:
        return frame
    velocity = se3_log(T_curr_prev) / duration_s
    if frame.depth is None:
        # how far away things are is unknown: as if the camera only turned
        velocity[:3] = 0
    grid = _Grid.of(frame, velocity)
    rolling = grid.read(_Delay(0.0, readout_ms / 1000))
    lagging = grid.read(_Delay(camera.depth_lag_ms / 1000, 0.0))
    of_depth = rolling if camera.depth_lag_ms == 0 else lagging
    return replace(
        frame,
        rgb=_read_image(frame.rgb, rolling),
        depth=_read_depth(frame.depth, of_depth),
        depth_variance=_read_variance(frame.depth_variance, of_depth),
        mask=_read_mask(frame.mask, rolling),
        camera=replace(
            camera, readout_ms=camera.readout_ms - readout_ms, depth_lag_ms=0.0
        ),
    )


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
        first = SPACING // 2
        v, u = np.mgrid[
            first : camera.height : SPACING, first : camera.width : SPACING
        ]
        z = np.ones(v.shape)
        if frame.depth is not None:
            depth = frame.depth[v, u]
            is_valid = valid_depth(depth)
            typical = np.median(depth[is_valid]) if is_valid.any() else 1.0
            z = np.where(is_valid, depth, typical)
        return cls(camera, v, _rays(camera, u, v) * z[..., None], velocity)

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
        ends = _projected(moved, self.camera)
        longest = max(self.camera.shape)
        shift = ends - _projected(self.points, self.camera)
        return np.clip(shift, -longest, longest)

    def read(self, delay: _Delay) -> _Reading | None:
        """Where a map with a delay is to be read; None where the delay makes no difference."""
        if delay == (0.0, 0.0) or not self.velocity.any():
            return None
        camera = self.camera
        late = self.late(delay)
        moved = _moved(self.points, self.velocity, late)
        shift = self.shift(moved)
        if np.max(np.abs(shift)) < NEGLIGIBLE_SHIFT_PX:
            return None
        shifts = _at_pixels(shift, camera.shape)
        where = cv2.add(_places(camera.shape), shifts, dst=shifts)
        turn = np.concatenate([np.zeros(3), self.velocity[3:]])
        rays = moved / np.maximum(moved[..., 2:], NEAREST_M)
        factor = _moved(rays, turn, -late)[..., 2]
        offset = _moved(np.zeros_like(rays), self.velocity, -late)[..., 2]
        return _Reading(where, factor, offset)

    def _rows_a_second(self) -> np.ndarray:
        """(h, w) by how many rows a second the points move down."""
        y = self.points[..., 1]
        z = self.points[..., 2]
        speed = self.points @ cross_matrix(self.velocity[3:]).T + self.velocity[:3]
        return self.camera.fy * (speed[..., 1] - y / z * speed[..., 2]) / z


def _rays(camera: Camera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(..., 3) points of some pixels at a depth of one."""
    x = (u - camera.cx) / camera.fx
    y = (v - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _projected(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(..., 2) px of points in front of the camera."""
    z = np.maximum(points[..., 2], NEAREST_M)
    u = camera.fx * points[..., 0] / z + camera.cx
    v = camera.fy * points[..., 1] / z + camera.cy
    return np.stack([u, v], axis=-1)


def _moved(
    points: np.ndarray, velocity: np.ndarray, times: np.ndarray
) -> np.ndarray:
    """(..., 3) points (..., 3) after times (...), s, of a constant motion, by its series."""
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
    return cv2.remap(  # type: ignore[call-overload]
        rgb,
        reading.where,
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _read_depth(
    depth: np.ndarray | None, reading: _Reading | None
) -> np.ndarray | None:
    """A depth map at one time; 0 where none was measured."""
    if depth is None or reading is None:
        return depth
    read = _read_nearest(depth.astype(np.float32, copy=False), reading)
    is_known = (read > 0).view(np.uint8)
    scaled = cv2.multiply(read, _at_pixels(reading.depth_factor, depth.shape))
    offset = _at_pixels(reading.depth_offset, depth.shape)
    return cv2.add(scaled, offset, dst=np.zeros_like(read), mask=is_known)


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
