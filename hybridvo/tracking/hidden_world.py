"""How much of the static scene, as it was known, is hidden by what is nearer.

What fills the view is easily taken for the scene. But the scene was known before: under the
camera's motion what stands is seen again, or out of view, or hidden by what stands as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hybridvo import pipeline
from hybridvo.core.calibration import KNOWN_LOG_ODDS
from hybridvo.core.geometry import invert, transform_points
from hybridvo.core.types import Frame, FramePair
from hybridvo.solver.calibration import HIDDEN_SIGMAS
from hybridvo.solver.points import points_of
from hybridvo.solver.visibility import visibility
from hybridvo.tracking.calibration import MAX_HIDDEN_FRAMES, MIN_WORLD_IN_VIEW
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import Memory
from hybridvo.tracking.search import Arrival, Estimate, Setup
from hybridvo.tracking.tracker_state import TrackerState


def hidden_by(state: TrackerState, frame: Frame, estimate: Estimate) -> float:
    """Return which fraction of the static scene a frame hides, if a motion to it is the camera's.

    Once it is hidden it stays so until a motion is sure: what is left of it shows little. After
    :data:`~hybridvo.tracking.calibration.MAX_HIDDEN_FRAMES` what is seen is taken for the scene.

    Args:
        state: of the tracker before the frame.
        frame: the current one.
        estimate: the motion to it.
    """
    world = state.world
    if world is None or state.hidden >= MAX_HIDDEN_FRAMES:
        return 0.0
    if state.hidden and not estimate.motion.ok:
        return 1.0
    if not (estimate.motion.usable and frame.is_rgbd):
        return 0.0
    return hidden_fraction(world, frame, estimate.T_world_cam)


def by_scene_behind(
    setup: Setup, state: TrackerState, arrival: Arrival, found: Estimate
) -> Estimate | None:
    """Return the motion by a scene that comes out from behind what was taken for it.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        arrival: the frame.
        found: the motion by what was taken for the scene.

    Returns:
        The motion that a look at the pair alone is sure of; None where there is none, or nothing
        hides the scene.
    """
    if arrival.flow is not None or not setup.remembers:
        return None
    if not found.motion.usable or not hides_what_moves(state.memory, state.places):
        return None
    start = min((*found.keyframes, found.start), key=lambda each: each.count)
    context = setup.context.looking
    pair = FramePair(start.frame, arrival.frame, None)
    motion = pipeline.run_method(
        context.evidence(pair), setup.method, context, arrival.deadline
    )
    return Estimate(start, motion, (start,)) if motion.ok else None


def hides_what_moves(memory: Memory | None, places: Sequence[Keyframe]) -> bool:
    """Return whether what seems to move was hidden at first by what was taken for the scene.

    A lorry that filled the first view was taken for the scene. When it drives off, the scene comes
    out from behind it, and seems to move.

    Args:
        memory: of a tracker.
        places: of the tracker, the first one first.
    """
    if memory is None or not places or not memory.belief.something_moves:
        return False
    known = memory.keyframe
    first = places[0]
    points = points_of(known.frame)
    moves = memory.belief.log_odds[points.cells] < -KNOWN_LOG_ODDS
    T_first_known = invert(first.T_world_cam) @ known.T_world_cam
    there = visibility(
        transform_points(T_first_known, points.xyz[moves]), first.frame, 0.0
    )
    return int(np.sum(there.is_hidden)) > 0.5 * int(np.sum(there.inside))


def hidden_fraction(world: Memory, frame: Frame, T_world_cam: np.ndarray) -> float:
    """Return which fraction of what was believed static is hidden, of what is in view.

    Args:
        world: what was believed static.
        frame: the current one, with depth.
        T_world_cam: (4, 4) its pose.

    Returns:
        The fraction; 0 where little of it is in view.
    """
    known = world.keyframe
    points = points_of(known.frame)
    stands = world.belief.log_odds[points.cells] > KNOWN_LOG_ODDS
    T_cam_known = invert(T_world_cam) @ known.T_world_cam
    moved = transform_points(T_cam_known, points.xyz[stands])
    there = visibility(moved, frame, 0.0)
    hidden = int(np.sum(there.is_hidden))
    seen = np.abs(there.distance) <= HIDDEN_SIGMAS
    in_view = hidden + int(np.sum(there.is_measured & seen))
    if in_view < MIN_WORLD_IN_VIEW * len(points.xyz):
        return 0.0
    return hidden / in_view
