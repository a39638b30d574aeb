"""A window of key frames: motions over longer strides, joined in a small pose graph.

Chaining neighbours adds up their errors. A key frame is kept until the camera has moved on, and
every new frame is registered to it directly, started from the chained motion; a new key frame is
registered to older ones as well, over strides of 1, 2 and 4 key frames. All of these motions are
edges of one graph, each with its covariance and a robust weight, and the newest pose is read from
it. Nothing is delayed and no pose that was handed out is revised: the pose of a frame is the best
one at its time. Memory is that of the key frames kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hybridvo.geometry import invert, se3_log
from hybridvo.options import TrackOptions
from hybridvo.results import Reason, RelativePose, State, Status
from hybridvo.tracking.keyframes import KeyFrame, View, spread_px, static_cells
from hybridvo.tracking.pose_graph import (
    CHI2_LIMIT,
    Edge,
    adjoint,
    chi2,
    compose_covariance,
    solve_graph,
)
from hybridvo.types import Frame

Register = Callable[["KeyFrame", Frame, np.ndarray, np.ndarray, np.ndarray], RelativePose]
"""(key frame, frame, predicted T_frame_key, its covariance, (H, W) weights) -> motion."""

AS_SURE = 1.5
"""Standard deviations, of the chain's, up to which others may overrule it."""
CORRECTION_LIMIT = 100.0
"""Chi-square of ten standard deviations, beyond which a step's motion is no measurement: up to 36
where the walk holds, 450 and more after a frame of another place (rendered sequences)."""
NO_MOTION = 1e-12 * np.eye(6)


MAX_SPREAD_PX = 8.0
"""Uncertainty of the predicted motion in the image above which it is no start for a registration;
the flow is asked then."""
STRIDES = (1, 2, 4)
"""Key frames back to which a new key frame is registered."""


@dataclass(frozen=True, eq=False)
class Window:
    """State of the window: key frames, the edges among them, and the last frame's place.

    Args:
        keys: oldest first, at most the window's length.
        edges: among the key frames.
        T_last_key: (4, 4) newest key frame to the last frame.
        covariance: (6, 6) of it.
        found: edges of the last frame, with their status.
    """

    keys: tuple[KeyFrame, ...] = ()
    edges: tuple[Edge, ...] = ()
    T_last_key: np.ndarray = field(default_factory=lambda: np.eye(4))
    covariance: np.ndarray = field(default_factory=lambda: NO_MOTION)
    found: tuple[Edge, ...] = ()

    @classmethod
    def start(cls, frame: Frame, T_world_cam: np.ndarray) -> Window:
        """A window whose only key frame is ``frame``."""
        return cls((KeyFrame(frame, T_world_cam),))

    def moved(self, D: np.ndarray) -> Window:
        """The same window in a world moved by (4, 4) ``D``."""
        keys = tuple(replace(key, T_world_cam=D @ key.T_world_cam) for key in self.keys)
        return replace(self, keys=keys)


@dataclass(frozen=True, eq=False)
class Located:
    """A frame placed by the window.

    Args:
        window: the window after it.
        T_world_cam: (4, 4) its pose.
        covariance: (6, 6) of its motion from the previous frame.
        status: of that motion.
        used: whether a motion over a longer stride took part.
    """

    window: Window
    T_world_cam: np.ndarray
    covariance: np.ndarray
    status: Status
    used: bool


def locate(
    window: Window,
    motion: RelativePose,
    prev: Frame,
    curr: Frame,
    register: Register,
    search: Register,
    size: int,
    options: TrackOptions,
) -> Located:
    """Place a frame among the key frames.

    Args:
        window: the state before it.
        motion: from ``prev``, the last frame, to ``curr``; a failed one holds what the tracker put
            in its place, with its covariance.
        prev: the last frame.
        curr: the new frame.
        register: motion from a key frame, started from a predicted one.
        search: the same without belief in the prediction.
        size: most key frames.
        options: see :class:`TrackOptions`.
    """
    window = _told(window, motion, prev)
    before = window.covariance
    inflated = motion.covariance * (options.inflation if motion.usable else 1.0)
    key = window.keys[-1]
    chain = Edge(
        key.frame.index,
        curr.index,
        motion.T_curr_prev @ window.T_last_key,
        compose_covariance(window.covariance, motion.T_curr_prev, inflated),
        motion.status,
        "chain",
    )
    edges, asked = [chain], 1
    view = View(key, chain.T, curr)
    at_key = prev.index == key.frame.index
    if not at_key or not motion.usable:
        direct, view = _register(key, curr, chain, view, register, search, options)
        edges.append(direct)
    T, edges = _vote(window, edges)
    # beside a key frame there is no longer stride from it: the one before it is asked; and where
    # two contradict each other, a third
    while asked < len(window.keys) and (len(edges) == 1 or _contradicted(edges)):
        asked += 1
        older = _older(window, asked, curr, T, chain.covariance, register, options)
        if older is None:
            break
        T, edges = _vote(window, [*edges, older])
    used = any(e.ok and e.kind != "chain" for e in edges)
    lost = not motion.usable and not used
    if edges[0].weight == 0 and used:
        view = View(key, _relative(T, key.T_world_cam), curr)
    moved_on = view.overlap < options.keyframe_overlap or view.motion > options.keyframe_motion
    # where the next motion works again but no key frame is found, a new walk begins
    far = spread_px(key, chain.covariance) > MAX_SPREAD_PX
    broken = motion.usable and not at_key and not used and far
    usable = curr.rgb is not None and curr.depth is not None
    covariance = _joint(edges, key.frame.index)
    T_key = _relative(T, key.T_world_cam) if used else chain.T
    if usable and not lost and (moved_on or broken):
        T, after = _promote(window, curr, T, edges, register, size, options)
    else:
        after = replace(window, T_last_key=T_key, covariance=covariance, found=tuple(edges))
    # both poses were read from one key frame: their errors add up
    A = adjoint(motion.T_curr_prev)
    step = covariance + A @ before @ A.T if used else inflated
    return Located(after, T, step, _status(motion, edges), used)


def _told(window: Window, motion: RelativePose, prev: Frame) -> Window:
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


def _failed(key: KeyFrame, curr: Frame, T: np.ndarray, message: str) -> Edge:
    status = Status.failed(Reason.LOW_INLIERS, message)
    return Edge(key.frame.index, curr.index, T, 1e4 * np.eye(6), status, "stride")


def _register(
    key: KeyFrame,
    curr: Frame,
    start: Edge,
    view: View,
    register: Register,
    search: Register,
    options: TrackOptions,
) -> tuple[Edge, View]:
    """The edge from a key frame, and what is seen of it."""
    shape = key.frame.camera.shape
    sure = spread_px(key, start.covariance) < MAX_SPREAD_PX
    if sure and view.overlap < options.min_overlap:
        return _failed(key, curr, start.T, "too little of the key frame is seen"), view
    ask = register if sure else search
    found = ask(key, curr, start.T, start.covariance, view.weights(shape))
    edge = _edge(key, curr, found, "stride" if sure else "search", options)
    return edge, view if sure or not found.usable else View(key, found.T_curr_prev, curr)


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
    T = _relative(T_world_cam, key.T_world_cam)
    view = View(key, T, curr)
    if view.overlap < options.min_overlap:
        return None
    found = register(key, curr, T, covariance, view.weights(key.frame.camera.shape))
    return _edge(key, curr, found, "stride", options)


def _relative(T_world_curr: np.ndarray, T_world_key: np.ndarray) -> np.ndarray:
    """T_curr_key."""
    return invert(T_world_curr) @ T_world_key


def _contradicted(edges: list[Edge]) -> bool:
    """Whether a motion was found, and lost the vote."""
    return any(e.status.usable and e.weight == 0 for e in edges)


def _vote(window: Window, edges: list[Edge]) -> tuple[np.ndarray, list[Edge]]:
    """(pose of the new frame with the key frames held, its edges as they came out).

    Motions that agree by a chi-square test vote for one another. The chain is overruled only by
    two that agree and are about as sure as it is: one alone may be wrong as well, and where light
    or texture change with the distance all of them are, and say so by their covariance.
    """
    held = {key.frame.index: key.T_world_cam for key in window.keys}
    ok = [k for k, e in enumerate(edges) if e.status.usable]
    poses = {k: held[edges[k].prev] @ invert(edges[k].T) for k in ok}
    if not ok:
        T = held[edges[0].prev] @ invert(edges[0].T)
        return T, [replace(e, weight=0.0) for e in edges]

    def agree(i: int, j: int) -> bool:
        between = invert(poses[i]) @ poses[j]
        return i == j or chi2(between, edges[i].covariance + edges[j].covariance) < CHI2_LIMIT

    parties = [[j for j in ok if agree(i, j)] for i in ok]
    first = max(range(len(ok)), key=lambda k: (len(parties[k]), -k))
    if ok[0] == 0 and 0 not in parties[first]:
        others = [edges[k] for k in parties[first]]
        first = first if _as_sure(others, edges[0]) else 0
    party = parties[first]
    curr = edges[0].curr
    answer = solve_graph(held | {curr: poses[ok[first]]}, [edges[k] for k in party], free=(curr,))
    rated = dict(zip(party, answer.edges, strict=True))
    return answer.T_world_cam[curr], [
        rated.get(k, replace(e, weight=0.0)) for k, e in enumerate(edges)
    ]


def _as_sure(others: list[Edge], chain: Edge) -> bool:
    """Whether no direction of the motion is much less certain together than by the chain."""
    together = sum(np.linalg.inv(e.covariance) for e in others)
    shares = np.linalg.eigvals(np.linalg.inv(together) @ np.linalg.inv(chain.covariance)).real
    return bool(shares.max() <= AS_SURE**2)


def _joint(edges: list[Edge], key: int) -> np.ndarray:
    """(6, 6) of the motion from the newest key frame, by the edges that lead from it."""
    information = np.zeros((6, 6))
    for edge in edges:
        if edge.prev == key and edge.weight > 0:
            information += min(edge.weight, 1.0) * np.linalg.inv(edge.covariance)
    if not information.any():
        return edges[0].covariance
    covariance = np.linalg.inv(information)
    return 0.5 * (covariance + covariance.T)


def corrected(motion: RelativePose, located: Located, T_curr_prev: np.ndarray) -> RelativePose:
    """The motion of a step whose pose comes from the key frames.

    Where it holds a correction of the pose before, which the motion between the two frames
    contradicts, it is no measurement of that motion: its covariance takes the correction in, and
    its status says so.

    Args:
        motion: of the pair.
        located: the frame's place.
        T_curr_prev: (4, 4) from the pose before to that place.
    """
    covariance, status = located.covariance, located.status
    if motion.status.reason is Reason.AMBIGUOUS_MOTION and not status.ok:
        # a registration that started from this motion confirms it whichever it is
        covariance = covariance + motion.covariance
    between = T_curr_prev @ invert(motion.T_curr_prev)
    if motion.usable and chi2(between, covariance + motion.covariance) > CORRECTION_LIMIT:
        jump = se3_log(between)
        covariance = covariance + np.outer(jump, jump)
        if status.state is State.OK:
            status = Status.degraded(
                Reason.AMBIGUOUS_MOTION,
                f"corrects the poses before by {np.linalg.norm(jump[:3]):.3g} m, by key frames",
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
    for stride in STRIDES[1:]:
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
    after = Window(tuple(keys), links, found=found)
    return answer.T_world_cam[curr.index], after


def _status(motion: RelativePose, edges: list[Edge]) -> Status:
    """Of the motion from the previous frame, once longer strides have spoken."""
    confirmed = [e for e in edges if e.ok and e.kind != "chain"]
    if not motion.usable and confirmed:
        return Status.degraded(
            motion.status.reason,
            f"{motion.status.message}; taken over key frame {confirmed[0].prev}",
        )
    if motion.status.state is not State.FAILED and edges[0].weight == 0 and confirmed:
        return Status.degraded(
            Reason.AMBIGUOUS_MOTION,
            f"the motion from the previous frame contradicts that from key frame "
            f"{confirmed[0].prev}, which was taken",
        )
    return motion.status
