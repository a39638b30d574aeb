"""What a tracker knows after a frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridvo.core.geometry import invert
from hybridvo.core.gravity import Gravity
from hybridvo.core.results import MotionPrior, RelativePose, Step
from hybridvo.core.types import Frame
from hybridvo.tracking.accelerometer import Accelerometer
from hybridvo.tracking.depth_scale import (
    ScaleFilter,
    divided,
    lengthened,
    rescaled_about,
)
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo.tracking.keyframes import Keyframe
from hybridvo.tracking.memory import Memory
from hybridvo.tracking.motion_model import MotionModel
from hybridvo.tracking.stamps import Clock

if TYPE_CHECKING:
    from hybridvo.tracking.objects import Objects, Things


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The state of a tracker after a frame, with which another tracker can go on."""

    frame: Frame | None = None  # the reference, from which the next motion starts
    # pose of the reference
    T_world_cam: np.ndarray = field(default_factory=lambda: np.eye(4))
    # pose of the last step
    T_world_last: np.ndarray = field(default_factory=lambda: np.eye(4))
    motion_model: MotionModel = field(default_factory=MotionModel)
    gap: int = 0  # frames passed over since the reference
    failed: int = 0  # motions that failed since the last one that was found
    count: int = 0  # frames so far
    is_sure: bool = True  # whether the motion of the reference was ok
    by_depth: bool = False  # whether the last step was by depth alone
    used_flow: bool = False  # whether the last motion needed flow
    # number of the first frame that leads here: no motion is known from earlier ones
    part: int = 0
    keyframes: tuple[Keyframe, ...] = ()  # oldest first
    places: tuple[Keyframe, ...] = ()  # from which a lost path is found again
    memory: Memory | None = None  # which parts of the view are static
    things: Things | None = None  # what else moves, where that is sought
    # how well the scale of all depths is known, where each frame has its own
    scale: ScaleFilter = field(default_factory=ScaleFilter)
    gyroscope: Gyroscope | None = None  # where samples were handed in
    accelerometer: Accelerometer | None = None  # where they had accelerations
    last: Frame | None = None  # the last frame, as it came
    clock: Clock = field(default_factory=Clock)

    @property
    def starts(self) -> dict[int, Frame]:
        """The frames from which the next motion may start, by their index."""
        held = [each.frame for each in (*self.places, *self.keyframes)]
        if self.frame is not None:
            held.append(self.frame)
        return {frame.index: frame for frame in held}

    @property
    def nearest_starts(self) -> list[Frame]:
        """The reference and the keyframes: the next motion starts from one of them."""
        held = [each.frame for each in self.keyframes]
        return held if self.frame is None else [*held, self.frame]

    @property
    def gravity(self) -> Gravity | None:
        """Which way is down; None where no accelerometer has shown it."""
        return None if self.accelerometer is None else self.accelerometer.gravity()

    @property
    def T_last_reference(self) -> np.ndarray:
        """(4, 4) motion from the reference to the last frame."""
        return invert(self.T_world_last) @ self.T_world_cam

    def expected(self) -> MotionPrior | None:
        """What is expected of the motion from the reference to the next frame.

        The velocity goes on from the last pose; None where it is not known.
        """
        one = self.motion_model.predict()
        all_since = self.motion_model.predict(self.gap + 1)
        if one is None or all_since is None:
            return None
        T = one.T_curr_prev @ self.T_last_reference
        return MotionPrior(T, all_since.covariance)

    def without_velocity(self) -> TrackerState:
        """Return the state that expects nothing of the next motion."""
        model = replace(self.motion_model, T_last=None)
        return replace(self, motion_model=model)

    def starting_with(self, frame: Frame) -> TrackerState:
        """Return the state with another frame in the place of the reference."""
        was = self.frame

        def changed(keyframe: Keyframe) -> Keyframe:
            return (
                replace(keyframe, frame=frame)
                if keyframe.frame is was
                else keyframe
            )

        return replace(
            self,
            frame=frame,
            keyframes=tuple(map(changed, self.keyframes)),
            places=tuple(map(changed, self.places)),
        )

    def rescaled(self, factor: float) -> TrackerState:
        """Return the state after all lengths grew by a factor; the last pose stays."""
        frame = None if self.frame is None else divided(self.frame, 1 / factor)
        model = self.motion_model
        if model.T_last is not None:
            T_last = lengthened(model.T_last, factor)
            model = replace(model, T_last=T_last)

        here = self.T_world_last

        def rescaled(keyframe: Keyframe) -> Keyframe:
            return replace(
                keyframe,
                frame=divided(keyframe.frame, 1 / factor),
                T_world_cam=rescaled_about(keyframe.T_world_cam, here, factor),
            )

        memory = self.memory
        if memory is not None:
            memory = replace(memory, keyframe=rescaled(memory.keyframe))
        return replace(
            self,
            frame=frame,
            T_world_cam=rescaled_about(self.T_world_cam, here, factor),
            motion_model=model,
            keyframes=tuple(map(rescaled, self.keyframes)),
            places=tuple(map(rescaled, self.places)),
            memory=memory,
            things=None if self.things is None else self.things.rescaled(factor),
        )


class Outcome(NamedTuple):
    """What follows from a frame."""

    state: TrackerState
    step: Step


def advanced(
    state: TrackerState,
    frame: Frame,
    T_world_cam: np.ndarray,
    leads: bool,
    is_sure: bool,
) -> TrackerState:
    """Return a state that counts a frame, and makes it the reference if it leads."""
    state = replace(
        state, T_world_last=T_world_cam, count=state.count + 1, by_depth=False
    )
    if not leads:
        return replace(state, gap=state.gap + 1)
    return replace(
        state, frame=frame, T_world_cam=T_world_cam, gap=0, is_sure=is_sure
    )


def step_of(
    frame: Frame,
    T_world_cam: np.ndarray,
    motion: RelativePose,
    prev_index: int | None,
    objects: Objects | None = None,
) -> Step:
    """The step of a frame, with a copy of its pose (4, 4)."""
    seen = () if objects is None else objects.seen
    return Step(
        frame.index,
        frame.timestamp,
        T_world_cam.copy(),
        motion,
        prev_index,
        objects=seen,
    )
