"""A window of key frames: motions over longer strides, joined in a small pose graph.

Chaining neighbours adds up their errors. A key frame is kept until the camera has moved on, and
every new frame is registered to it directly, started from the chained motion; a new key frame is
registered to older ones as well, over strides of 1, 2 and 4 key frames. All of these motions are
edges of one graph, each with its covariance and a robust weight, and the newest pose is read from
it. Nothing is delayed and no pose that was handed out is revised: the pose of a frame is the best
one at its time. Memory is that of the key frames kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hybridvo.calibration import CORRECTION_LIMIT
from hybridvo.geometry import invert, project, se3_log
from hybridvo.options import TrackOptions
from hybridvo.results import MotionPrior, Reason, RelativePose, State, Status
from hybridvo.tracking.pose_graph import Edge, adjoint, chi2, compose_covariance, solve_graph
from hybridvo.types import Frame

STANDSTILL = 1e-12 * np.eye(6)
"""Covariance of no motion at all; a pose graph can still invert it."""
MAX_SPREAD_PX = 8.0
"""Uncertainty of the predicted motion in the image above which it is no start for a registration;
the motion is then sought without one."""
STRIDES = (2, 4)
"""Key frames back to which a new key frame is registered, beside the newest one."""
GRID_COLUMNS = 128
"""Cells in a row of the coarse grid on which static pixels and overlap are known."""
HIDDEN = 0.03
"""Relative difference of depth from which a pixel is taken for hidden or moved."""


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """A frame that others are registered to.

    Args:
        T_world_cam: (4, 4) where the graph has it now.
        static: (h, w) bool on the coarse grid, pixels of the world; None until the motion of the
            next frame has told.
        depth_noise: standard deviation of log depth, from the same motion.
    """

    frame: Frame
    T_world_cam: np.ndarray
    static: np.ndarray | None = None
    depth_noise: float = 0.0


def static_cells(frame: Frame, motion: RelativePose) -> np.ndarray:
    """(h, w) bool on the coarse grid of a frame: where the pixels follow the motion from it."""
    height, width = frame.camera.shape
    cell = _cell(width)
    if motion.weights is None:
        return np.ones((-(-height // cell), -(-width // cell)), np.bool_)
    return np.asarray(_cells(motion.weights, cell) > 0.5)


def _cell(width: int) -> int:
    return max(4, -(-width // GRID_COLUMNS))


def _cells(image: np.ndarray, cell: int) -> np.ndarray:
    """(h, w) mean of each cell; cells at the border repeat the last row and column."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % cell), (0, -width % cell)), mode="edge")
    return padded.reshape(padded.shape[0] // cell, cell, -1, cell).mean(axis=(1, 3))


class View:
    """What of a key frame a frame sees under a motion."""

    def __init__(self, key: KeyFrame, T: np.ndarray, curr: Frame) -> None:
        height, width = key.frame.camera.shape
        self.cell = cell = _cell(width)
        rows = np.minimum(np.arange(-(-height // cell)) * cell + cell // 2, height - 1)
        columns = np.minimum(np.arange(-(-width // cell)) * cell + cell // 2, width - 1)
        z = np.asarray(key.frame.depth)[np.ix_(rows, columns)].astype(np.float64)
        valid = np.isfinite(z) & (z > 0)
        if key.static is not None:
            valid &= key.static
        camera = key.frame.camera
        u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
        ray = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1
        )
        moved = ray * np.where(valid, z, 1.0)[..., None] @ T[:3, :3].T + T[:3, 3]
        depth = moved[..., 2]
        x, y = np.moveaxis(project(moved, curr.camera), -1, 0)
        with np.errstate(invalid="ignore"):
            seen = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5) & valid
        i = np.clip(np.where(seen, np.rint(y), 0).astype(np.intp), 0, height - 1)
        j = np.clip(np.where(seen, np.rint(x), 0).astype(np.intp), 0, width - 1)
        if curr.mask is not None:
            seen &= curr.mask[i, j]
        if curr.depth is not None:
            there = curr.depth[i, j]
            known = np.isfinite(there) & (there > 0) & seen
            ratio = np.where(known, there, 1.0) / np.where(known, depth, 1.0)
            seen &= np.abs(ratio - 1.0) < HIDDEN
        self.seen = seen
        count = max(int(np.count_nonzero(valid)), 1)
        self.overlap = float(np.count_nonzero(seen)) / count
        shift = np.hypot(x - u, y - v)[seen]
        self.motion = float(np.median(shift)) / width if shift.size else 1.0

    def weights(self, shape: tuple[int, int]) -> np.ndarray:
        """(H, W) float32, 1 where a pixel is static and seen."""
        fine = self.seen.astype(np.float32).repeat(self.cell, 0).repeat(self.cell, 1)
        return np.ascontiguousarray(fine[: shape[0], : shape[1]])


def spread_px(key: KeyFrame, covariance: np.ndarray) -> float:
    """How far a (6, 6) covariance lets the image of a key frame move, px, at its median depth."""
    camera, z = key.frame.camera, np.asarray(key.frame.depth)[::8, ::8]
    z = z[np.isfinite(z) & (z > 0)]
    depth = float(np.median(z)) if z.size else 1.0
    variance = np.trace(covariance[:3, :3]) / depth**2 + np.trace(covariance[3:, 3:])
    return float(0.5 * (camera.fx + camera.fy) * np.sqrt(max(variance, 0.0)))


Register = Callable[[KeyFrame, Frame, MotionPrior | None, np.ndarray], RelativePose]
"""(key frame, frame, predicted T_frame_key or None, (H, W) weights) -> motion."""


@dataclass(frozen=True, eq=False)
class Window:
    """Key frames (oldest first), the edges among them, and the last frame's place.

    Args:
        T_last_key, covariance: newest key frame to the last frame.
        found: edges of the last frame, with their status.
    """

    keys: tuple[KeyFrame, ...]
    edges: tuple[Edge, ...] = ()
    T_last_key: np.ndarray = field(default_factory=lambda: np.eye(4))
    covariance: np.ndarray = field(default_factory=lambda: STANDSTILL)
    found: tuple[Edge, ...] = ()

    def moved(self, D: np.ndarray) -> Window:
        """The same window in a world moved by (4, 4) ``D``."""
        keys = tuple(replace(key, T_world_cam=D @ key.T_world_cam) for key in self.keys)
        return replace(self, keys=keys)


class Located(NamedTuple):
    """The window after a frame, the frame's pose (4, 4), its motion from the pose before, and
    whether a motion over a longer stride took part.
    """

    window: Window
    T_world_cam: np.ndarray
    motion: RelativePose
    used: bool


def locate(
    window: Window,
    motion: RelativePose,
    prev: Frame,
    curr: Frame,
    register: Register,
    size: int,
    options: TrackOptions,
) -> Located:
    """Place a frame among the key frames.

    ``motion`` leads from ``prev``, the last frame, to ``curr``; a failed one holds what the tracker
    put in its place, with its covariance.
    """
    window = _with_static(window, motion, prev)
    key, before = window.keys[-1], window.covariance
    inflated = motion.covariance * (options.inflation if motion.usable else 1.0)
    T_key = motion.T_curr_prev @ window.T_last_key
    C_key = compose_covariance(before, motion.T_curr_prev, inflated)
    edges = [Edge(key.frame.index, curr.index, T_key, C_key, motion.status, "chain")]
    T = key.T_world_cam @ invert(T_key)
    view = View(key, T_key, curr)
    sure = spread_px(key, C_key) < MAX_SPREAD_PX
    at_key = prev.index == key.frame.index
    if not at_key or not motion.usable:
        if sure and view.overlap < options.min_overlap:
            direct = RelativePose.failed(Reason.LOW_INLIERS, "too little of the key frame is seen")
        else:
            prior = MotionPrior(T_key, C_key) if sure else None
            direct = register(key, curr, prior, view.weights(key.frame.camera.shape))
        edges.append(_edge(key, curr, direct, "stride" if sure else "search", options))
        T, edges = _placed(window, edges)
    # beside a key frame there is no longer stride from it: the one before it is asked; and where
    # two contradict each other, a third
    for stride in range(2, len(window.keys) + 1):
        if len(edges) > 1 and all(e.ok for e in edges if e.status.usable):
            break
        older = _older(window, stride, curr, T, C_key, register, options)
        if older is None:
            break
        T, edges = _placed(window, [*edges, older])
    used = any(e.ok and e.kind != "chain" for e in edges)
    if used and not (sure and edges[0].ok):
        view = View(key, invert(T) @ key.T_world_cam, curr)
    moved_on = view.overlap < options.keyframe_overlap or view.motion > options.keyframe_motion
    # where the next motion works again but no key frame is found, a new walk begins
    broken = motion.usable and not at_key and not used and not sure
    covariance = _joint(edges, key.frame.index)
    found = (motion.usable or used) and curr.rgb is not None and curr.depth is not None
    if found and (moved_on or broken):
        T, after = _promote(window, curr, T, edges, register, size, options)
    else:
        T_last = invert(T) @ key.T_world_cam if used else T_key
        after = replace(window, T_last_key=T_last, covariance=covariance, found=tuple(edges))
    if used:
        # both poses were read from one key frame: their errors add up
        A = adjoint(motion.T_curr_prev)
        T_prev = key.T_world_cam @ invert(window.T_last_key)
        motion = _corrected(motion, invert(T) @ T_prev, covariance + A @ before @ A.T, edges)
    return Located(after, T, motion, used)


def _with_static(window: Window, motion: RelativePose, prev: Frame) -> Window:
    """The window once the newest key frame's static pixels are known."""
    key = window.keys[-1]
    if key.static is not None or key.frame.index != prev.index or not motion.usable:
        return window
    static = static_cells(prev, motion)
    key = replace(key, static=static, depth_noise=motion.depth_noise)
    return replace(window, keys=(*window.keys[:-1], key))


def _edge(
    key: KeyFrame, curr: Frame, found: RelativePose, kind: str, options: TrackOptions
) -> Edge:
    covariance = options.inflation * found.covariance
    return Edge(key.frame.index, curr.index, found.T_curr_prev, covariance, found.status, kind)


def _older(
    window: Window,
    stride: int,
    curr: Frame,
    T_world_cam: np.ndarray,
    covariance: np.ndarray,
    register: Register,
    options: TrackOptions,
) -> Edge | None:
    """The edge from the key frame ``stride`` key frames back, where there is one in sight."""
    if len(window.keys) < stride or window.keys[-stride].static is None:
        return None
    key = window.keys[-stride]
    prior = MotionPrior(invert(T_world_cam) @ key.T_world_cam, covariance)
    view = View(key, prior.T_curr_prev, curr)
    if view.overlap < options.min_overlap:
        return None
    found = register(key, curr, prior, view.weights(key.frame.camera.shape))
    return _edge(key, curr, found, "stride", options)


def _placed(window: Window, edges: Sequence[Edge]) -> tuple[np.ndarray, list[Edge]]:
    """(pose of least robust cost with the key frames held, its edges with their weights)."""
    held = {key.frame.index: key.T_world_cam for key in window.keys}
    curr, usable = edges[0].curr, [e for e in edges if e.status.usable]
    best = None
    for edge in usable:
        start = held | {curr: held[edge.prev] @ invert(edge.T)}
        answer = solve_graph(start, edges, free=(curr,))
        if best is None or answer.cost < best.cost:
            best = answer
        if all(e.ok for e in answer.edges if e.status.usable):
            break
    if best is None:
        T = held[edges[0].prev] @ invert(edges[0].T)
        return T, [replace(e, weight=0.0) for e in edges]
    T, kept = best.T_world_cam[curr], [e for e in best.edges if e.ok]
    if kept and len(kept) < len(usable):
        T = solve_graph(best.T_world_cam, kept, free=(curr,)).T_world_cam[curr]
    return T, list(best.edges)


def _joint(edges: Sequence[Edge], key: int) -> np.ndarray:
    """(6, 6) of the motion from the newest key frame, by the edges that lead from it."""
    parts = [
        min(e.weight, 1.0) * np.linalg.inv(e.covariance) for e in edges if e.prev == key and e.ok
    ]
    if not parts:
        return edges[0].covariance
    covariance = np.linalg.inv(np.sum(parts, axis=0))
    return 0.5 * (covariance + covariance.T)


def _corrected(
    motion: RelativePose, T_curr_prev: np.ndarray, covariance: np.ndarray, edges: Sequence[Edge]
) -> RelativePose:
    """The motion of a step whose pose comes from the key frames, with covariance and status."""
    key = next(e.prev for e in edges if e.ok and e.kind != "chain")
    status, reason = motion.status, Reason.AMBIGUOUS_MOTION
    between = T_curr_prev @ invert(motion.T_curr_prev)
    jumps = motion.usable and chi2(between, covariance + motion.covariance) > CORRECTION_LIMIT
    if jumps:
        jump = se3_log(between)
        covariance = covariance + np.outer(jump, jump)
    if not motion.usable:
        text = f"{status.message}; taken over key frame {key}"
        status = Status.degraded(status.reason, text)
    elif not edges[0].ok:
        text = "the motion from the previous frame contradicts that from key frame"
        status = Status.degraded(reason, f"{text} {key}, which was taken")
    elif jumps and status.state is State.OK:
        size = np.linalg.norm(jump[:3])
        status = Status.degraded(
            reason, f"corrects the poses before by {size:.3g} m, by key frames"
        )
    terms = (*motion.terms, "window")
    return motion.replace(
        T_curr_prev=T_curr_prev, covariance=covariance, status=status, terms=terms
    )


def _promote(
    window: Window,
    curr: Frame,
    T: np.ndarray,
    edges: list[Edge],
    register: Register,
    size: int,
    options: TrackOptions,
) -> tuple[np.ndarray, Window]:
    """(pose, window) with the frame as the newest key frame, and the graph solved."""
    known = {e.prev for e in edges if e.kind != "chain"}
    for stride in STRIDES:
        if stride <= len(window.keys) and window.keys[-stride].frame.index not in known:
            older = _older(window, stride, curr, T, edges[0].covariance, register, options)
            edges = edges if older is None else [*edges, older]
    poses = {key.frame.index: key.T_world_cam for key in window.keys} | {curr.index: T}
    oldest = window.keys[0].frame.index
    answer = solve_graph(
        poses, [*window.edges, *edges], free=tuple(i for i in poses if i != oldest)
    )
    keys = [replace(k, T_world_cam=answer.T_world_cam[k.frame.index]) for k in window.keys]
    keys = [*keys, KeyFrame(curr, answer.T_world_cam[curr.index])][-size:]
    kept = {key.frame.index for key in keys}
    links = tuple(e for e in answer.edges if e.status.usable and e.prev in kept and e.curr in kept)
    found = tuple(e for e in answer.edges if e.curr == curr.index)
    return answer.T_world_cam[curr.index], Window(tuple(keys), links, found=found)
