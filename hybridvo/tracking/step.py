"""A frame in, the tracker's next state and the frame's step out.

Read this file after :mod:`hybridvo.pipeline`: the two hold all that decides. :func:`follow` says by
which of its parts a frame is followed, :mod:`hybridvo.tracking.search` finds the motion to it, and
:func:`keep` says what follows from the motion: the pose, keyframes, what was static; or what is
done where there is none.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hybridvo.core.geometry import chain, invert, se3_exp, se3_log
from hybridvo.core.results import (
    Edge,
    Motion,
    MotionPrior,
    Reason,
    RelativePose,
    Status,
    Step,
    Term,
)
from hybridvo.core.types import Frame, FramePair
from hybridvo.core.unchecked import changed
from hybridvo.evidence.one_time import (
    at_image_time,
    is_of_one_time,
    pair_at_image_times,
    rough_motion,
)
from hybridvo.flow.providers import has_texture
from hybridvo.judge.verdict import believed
from hybridvo.solver.coarse_images import follow_roughly
from hybridvo.solver.depth_alone import DepthEvidence
from hybridvo.tracking.calibration import (
    HARDLY_HIDDEN,
    MAX_HIDDEN_FRAMES,
    MOSTLY_HIDDEN,
)
from hybridvo.tracking.camera_drift import MAX_EVEN_MS
from hybridvo.tracking.depth_scale import ScaleFilter, divided, measured_scale
from hybridvo.tracking.hidden_world import by_scene_behind, hidden_by
from hybridvo.tracking.keyframes import (
    Keyframe,
    between_frames,
    has_enough_depth,
    is_near,
)
from hybridvo.tracking.memory import Memory, faded, memory_after
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.relocalization import with_place
from hybridvo.tracking.repeated import (
    is_as_good_as_new,
    motion_without_image,
    repeat_of,
)
from hybridvo.tracking.search import Arrival, Estimate, Setup, find
from hybridvo.tracking.tracker_state import TrackerState, unknown_covariance

# covariance of no motion, which a pose graph can still invert
FIRST_FRAME_COVARIANCE = 1e-12 * np.eye(6)


def follow(
    setup: Setup, state: TrackerState, arrival: Arrival
) -> tuple[TrackerState, Step]:
    """Return the state of a tracker after a frame, and the frame's step.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        arrival: the frame, as it was taken, and what is known of it.
    """
    if state.reference is None:
        return _first(setup, state, arrival.frame)
    state, arrival = _at_one_time(setup, state, arrival)
    followed = None
    if arrival.repeat.colour:
        followed = _without_image(setup, state, arrival)
    elif arrival.repeat.depth:
        followed = _with_old_depth(setup, state, arrival)
    if followed is not None:
        return followed
    if setup.has_own_scale(arrival.frame):
        return _in_common_scale(setup, state, arrival)
    estimate = find(setup, state, arrival)
    behind = by_scene_behind(setup, state, arrival, estimate)
    if behind is not None:
        state = state.of_another_scene(behind.start)
        estimate = behind
    return keep(setup, state, arrival, estimate)


def keep(
    setup: Setup, state: TrackerState, arrival: Arrival, estimate: Estimate
) -> tuple[TrackerState, Step]:
    """Say what follows from a motion that was sought.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        arrival: the frame, from which later motions may start.
        estimate: the motion to it.

    Returns:
        The next state, and the step of the frame.
    """
    frame = arrival.frame
    found = estimate.motion
    if estimate.start is state.failed:
        state = state.after_gap()
    if found.is_by_depth_alone:
        return _carried_by_depth(state, frame, estimate)
    # flow from elsewhere leads from each frame to the next one
    leads = arrival.flow is not None or becomes_reference(
        setup, frame, found, state.gap
    )
    hidden = hidden_by(state, arrival.frame, estimate)
    if hidden >= MOSTLY_HIDDEN:
        return _behind_something(setup, state, arrival, estimate)
    if not found.usable:
        return _held(setup, state, arrival, estimate, leads)
    origin = origin_of(state, estimate)
    motion = found
    measured = None
    if origin.count != estimate.start.count:
        motion = between_frames(found, estimate.start, origin)
        start = estimate.start.frame.index
        measured = Edge(start, found.T_curr_prev, found.covariance)
    new = Keyframe(
        frame,
        estimate.T_world_cam,
        state.count,
        estimate.start.count,
        found.covariance,
        found.ok,
    )
    # waited for in vain: it may have been no scene
    world = None if state.hidden >= MAX_HIDDEN_FRAMES else state.world
    after = replace(known_path(state, estimate), hidden=0, world=world)
    is_sure = leads and found.ok and setup.spans_frames
    if is_sure and frame.rgb is not None and has_enough_depth(frame):
        after = replace(
            after,
            keyframes=(*after.keyframes, new),
            places=with_place(after.places, new, setup.options.track.places),
        )
    else:
        new = replace(state.unsure(frame, new.T_world_cam), is_sure=found.ok)
    after = replace(
        after,
        motion_model=velocity_after(state, estimate, origin, motion),
        memory=learned(setup, state, frame, estimate),
    )
    memory = after.memory
    is_seen = found.ok and hidden < HARDLY_HIDDEN
    if is_seen and memory is not None and memory.belief.is_ready:
        after = replace(after, world=memory)
    after = after.advanced(new.T_world_cam, new if leads else None, motion.terms)
    step = step_of(frame, new.T_world_cam, motion, origin.frame.index)
    return after, replace(step, measured=measured)


def _first(
    setup: Setup, state: TrackerState, frame: Frame
) -> tuple[TrackerState, Step]:
    """What follows from the first frame: no motion."""
    T = state.T_world_last
    motion = RelativePose(
        covariance=FIRST_FRAME_COVARIANCE.copy(), method=setup.method
    )
    first = Keyframe(frame, T, state.count, state.count, unknown_covariance())
    keyframes: tuple[Keyframe, ...] = ()
    if setup.spans_frames and frame.rgb is not None and has_enough_depth(frame):
        keyframes = (first,)
    after = TrackerState(
        first,
        keyframes,
        places=keyframes,
        T_world_last=T,
        count=state.count + 1,
    )
    return after, step_of(frame, T, motion, None)


def step_of(
    frame: Frame,
    T_world_cam: np.ndarray,
    motion: RelativePose,
    prev_index: int | None,
) -> Step:
    """The step of a frame, with a copy of its pose (4, 4)."""
    return Step(
        frame.index, frame.timestamp, T_world_cam.copy(), motion, prev_index
    )


# -- what follows from a motion that was found -----------------------------------------------


def becomes_reference(
    setup: Setup, frame: Frame, found: RelativePose, gap: int
) -> bool:
    """Whether the next motion starts from this frame: it has depth, and it was matched."""
    if not has_enough_depth(frame):
        return False
    if frame.rgb is None and found.status.reason is Reason.NO_FLOW:
        return False
    # the frame before is what cannot be used
    is_unusable = found.status.reason in (
        Reason.NO_VALID_DEPTH,
        Reason.DEPTH_UNIT,
    )
    matched = found.usable or is_unusable
    # after two failures the camera may be far away; flow from files cannot span a frame
    return matched or gap > 0 or not setup.computes_flow


def origin_of(state: TrackerState, estimate: Estimate) -> Keyframe:
    """The frame that the step starts from: the one before, if its pose is believed."""
    reference = state.known_reference
    is_earlier = estimate.start.count < reference.count
    is_sure = reference.is_sure and not estimate.is_relocalized
    return reference if is_earlier and is_sure else estimate.start


def velocity_after(
    state: TrackerState, estimate: Estimate, origin: Keyframe, motion: RelativePose
) -> MotionModel:
    """What is expected of the next motion, after one from the origin of the step."""
    model = state.motion_model
    if estimate.is_relocalized:
        # the velocity is unknown
        return replace(model, T_last=None, failed=0)
    spanned = state.count - origin.count
    one_frame = motion.T_curr_prev
    if spanned > 1:
        one_frame = se3_exp(se3_log(one_frame) / spanned)
    return model.observed(one_frame, neighbours=spanned == 1 and not model.failed)


def known_path(state: TrackerState, estimate: Estimate) -> TrackerState:
    """The state with the keyframes and places whose poses are known relative to the frame."""
    after = replace(state, keyframes=estimate.keyframes)
    if estimate.start.count >= state.part:
        return after
    # poses since the path was lost are relative to an unknown one
    return replace(
        after,
        keyframes=tuple(k for k in after.keyframes if k.count < state.part),
        places=tuple(p for p in after.places if p.count < state.part),
        part=0,
    )


def learned(
    setup: Setup, state: TrackerState, frame: Frame, estimate: Estimate
) -> Memory | None:
    """What is remembered after a frame, on the oldest keyframe in use; None: nothing."""
    if not setup.remembers or (estimate.is_relocalized and not state.hidden):
        return None
    home = min(
        (*estimate.keyframes, state.known_reference),
        key=lambda keyframe: keyframe.count,
    )
    if not home.frame.is_rgbd:
        return state.memory
    T_curr_home = invert(estimate.T_world_cam) @ home.T_world_cam
    motion = estimate.motion.replace(T_curr_prev=T_curr_home)
    return memory_after(state.memory, home, frame, motion)


# -- where depth alone found it, or nothing did ----------------------------------------------


def _carried_by_depth(
    state: TrackerState, frame: Frame, estimate: Estimate
) -> tuple[TrackerState, Step]:
    """What follows from a frame whose image shows nothing, by depth.

    Later motions start from the frame before it as long as that is near, so that the errors
    of such steps do not add up and images are followed again as soon as there are some.
    """
    T_world_cam = estimate.T_world_cam
    last = invert(T_world_cam) @ state.T_world_last
    is_far = not is_near(state.known_reference, T_world_cam, state.count)
    leads = has_enough_depth(frame) and (is_far or has_texture(frame))
    after = replace(
        state,
        motion_model=replace(state.motion_model, T_last=last, failed=0),
        keyframes=estimate.keyframes,
    )
    new = state.unsure(frame, T_world_cam)
    terms = estimate.motion.terms
    after = after.advanced(T_world_cam, new if leads else None, terms)
    index = estimate.start.frame.index
    return after, step_of(frame, T_world_cam, estimate.motion, index)


def _behind_something(
    setup: Setup, state: TrackerState, arrival: Arrival, estimate: Estimate
) -> tuple[TrackerState, Step]:
    """What follows from a frame in which something nearer hides the static scene.

    Later motions start from where the scene was last seen.
    """
    frame = arrival.frame
    T_world_cam, motion = fallback(setup, state, estimate.motion, arrival.given)
    how = "is held"
    if arrival.given is not None:
        how = "is as given"
    elif setup.options.track.on_failure == "constant_velocity":
        how = "goes on with constant velocity"
    text = f"something nearer hides what was seen to stand; the path {how}"
    motion = believed(
        Motion(
            motion.T_curr_prev,
            motion.covariance,
            Status.degraded(Reason.HIDDEN_WORLD, text),
            evidence=DepthEvidence(),
            terms=(Term.EXPECTED,),
        )
    ).replace(method=setup.method)
    world = state.world
    assert world is not None
    model = state.motion_model
    after = replace(
        state,
        motion_model=replace(model, failed=model.failed + 1),
        keyframes=(world.keyframe,),
        memory=world,
        hidden=state.hidden + 1,
    )
    index = state.known_reference.frame.index
    return after.advanced(T_world_cam), step_of(frame, T_world_cam, motion, index)


def _held(
    setup: Setup,
    state: TrackerState,
    arrival: Arrival,
    estimate: Estimate,
    leads: bool,
) -> tuple[TrackerState, Step]:
    """What follows from a motion that failed."""
    frame = arrival.frame
    T_world_cam, motion = fallback(setup, state, estimate.motion, arrival.given)
    is_cut = leads and arrival.given is None
    model = state.motion_model
    after = replace(
        state,
        motion_model=replace(model, failed=model.failed + 1),
        part=state.count if is_cut else state.part,
        keyframes=estimate.keyframes,
        memory=None if state.memory is None else faded(state.memory),
    )
    new = state.unsure(frame, T_world_cam)
    after = after.advanced(T_world_cam, new if leads else None)
    if not leads and arrival.given is None and has_enough_depth(frame):
        after = replace(after, failed=new)
    origin = state.known_reference.frame.index
    return after, step_of(frame, T_world_cam, motion, origin)


def fallback(
    setup: Setup,
    state: TrackerState,
    failed: RelativePose,
    given: MotionPrior | None,
) -> tuple[np.ndarray, RelativePose]:
    """The pose and motion where none was found: as given, or by ``track.on_failure``."""
    T_world_ref = state.known_reference.T_world_cam
    if given is not None:
        T_world_cam = chain(T_world_ref, given.T_curr_prev)
        return T_world_cam, failed.replace(
            T_curr_prev=given.T_curr_prev, covariance=given.covariance
        )
    T_world_cam = state.T_world_last
    T_curr_prev = np.eye(4)
    covariance = failed.covariance
    model = state.motion_model
    ahead = model.predict(state.gap + 1, model.failed)
    if setup.options.track.on_failure == "hold" or ahead is None:
        if state.gap:
            T_curr_prev = invert(T_world_cam) @ T_world_ref
    else:
        T_curr_prev = ahead.T_curr_prev
        covariance = ahead.covariance
        T_world_cam = chain(T_world_ref, T_curr_prev)
    return T_world_cam, failed.replace(
        T_curr_prev=T_curr_prev, covariance=covariance
    )


# -- frames that are not what they seem ------------------------------------------------------


def _at_one_time(
    setup: Setup, state: TrackerState, arrival: Arrival
) -> tuple[TrackerState, Arrival]:
    """Bring a frame, and after a first motion the reference, to the time of its middle row.

    Flow that is not computed from the images leads between the rows as they were exposed: such
    frames stay, and each of their pairs is brought to one time.
    """
    if arrival.flow is not None or not setup.computes_flow:
        return state, arrival
    reference = state.known_reference
    taken = FramePair(reference.frame, arrival.frame, None)
    if is_of_one_time(taken):
        return state, arrival

    def found_in(as_they_are: FramePair) -> np.ndarray | None:
        of_prev = state.starting_with(as_they_are.prev)
        of_curr = arrival._replace(frame=as_they_are.curr)
        found = find(setup, of_prev, of_curr)
        if not found.motion.usable:
            return None
        return invert(found.T_world_cam) @ reference.T_world_cam

    expected = arrival.given or state.expected()
    if expected is not None and arrival.repeat.colour:
        # a repeated image corrects nothing of what is expected
        T_near = expected.T_curr_prev
    else:
        T_near = rough_motion(taken, expected, setup.options.refine, found_in)
    in_time = pair_at_image_times(taken, T_near)
    curr = in_time.curr
    velocity = _velocity_between(setup, state, arrival, T_near)
    if velocity is not None:
        curr = at_image_time(arrival.frame, velocity)
    return (
        state.starting_with(in_time.prev),
        arrival._replace(frame=curr, near=T_near),
    )


def _velocity_between(
    setup: Setup, state: TrackerState, arrival: Arrival, T_near: np.ndarray
) -> np.ndarray | None:
    """The velocity (6,) at a frame, by the frames before and after it; None: that is not known.

    The motion to a frame alone tells of the time before it.
    """
    frame = arrival.frame
    following = arrival.following
    expected = state.expected()
    if following is None or expected is None:
        return None
    until = following.timestamp - frame.timestamp
    since = frame.timestamp - state.known_reference.frame.timestamp
    is_old = arrival.repeat.colour or repeat_of(frame, following).colour
    if is_old or not 0 < until <= MAX_EVEN_MS / 1000:
        return None
    next_pair = FramePair(frame, following, None)
    as_before = changed(expected, T_curr_prev=T_near)
    T_next = follow_roughly(next_pair, as_before, setup.options.refine)
    return se3_log(T_next @ T_near) / (since + until)


def _without_image(
    setup: Setup, state: TrackerState, arrival: Arrival
) -> tuple[TrackerState, Step] | None:
    """What follows from a frame by its depth, where that is fresh, or by what is expected.

    None where the camera may as well have stood still. No later motion starts from such a
    frame: image and depth do not belong together.
    """
    frame = arrival.frame
    depth_is_fresh = not (arrival.repeat.depth or setup.has_own_scale(frame))
    motion = motion_without_image(
        state, frame, arrival.given, arrival.repeat, depth_is_fresh
    )
    if motion is None:
        return None
    reference = state.known_reference
    T_world_cam = chain(reference.T_world_cam, motion.T_curr_prev)
    motion = motion.replace(method=setup.method)
    step = step_of(frame, T_world_cam, motion, reference.frame.index)
    return state.advanced(T_world_cam), step


def _with_old_depth(
    setup: Setup, state: TrackerState, arrival: Arrival
) -> tuple[TrackerState, Step] | None:
    """What follows from a frame whose depth is an old one, by its image.

    None where that depth is what the frame must show, as where the camera stands.
    """
    without_depth = arrival.without_depth
    estimate = find(setup, state, without_depth)
    if not estimate.motion.usable:
        return _without_image(setup, state, arrival)
    step = invert(estimate.T_world_cam) @ state.T_world_last
    if is_as_good_as_new(arrival.frame, step):
        return None
    estimate = estimate._replace(motion=arrival.repeat.marked(estimate.motion))
    # flow from elsewhere leads from each frame to the next one
    next_start = without_depth if arrival.flow is None else arrival
    return keep(setup, state, next_start, estimate)


def _in_common_scale(
    setup: Setup, state: TrackerState, arrival: Arrival
) -> tuple[TrackerState, Step]:
    """What follows from a frame whose depth has a scale of its own.

    The first motion comes from the earlier frame's depth alone, in whose scale it is. With the
    scale that the static pixels then show, both depth maps take part in the second one.
    """
    frame = arrival.frame
    estimate = find(setup, state, arrival.without_depth)
    scale = measured_scale(estimate.start.frame, frame, estimate.motion)
    if scale is not None:
        frame = divided(frame, scale)
        again = find(setup, state, arrival._replace(frame=frame))
        more = measured_scale(again.start.frame, frame, again.motion)
        # unless two depth maps of one scale make it less sure
        if more is not None and again.motion.ok >= estimate.motion.ok:
            estimate = again
            scale *= more
            frame = divided(frame, more)
    before = state.sensors.scale
    state, step = keep(setup, state, arrival._replace(frame=frame), estimate)
    if scale is None:
        # the next motion may start from this frame, in its own scale
        return state.with_scale(ScaleFilter()), step
    change = scale**before.gain
    state = state.rescaled(change).with_scale(before.observed())
    return state, replace(step, depth_scale=scale, scale_change=change)
