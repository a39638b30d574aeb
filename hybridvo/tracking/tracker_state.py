"""What a tracker knows after a frame."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybridvo.core.geometry import invert
from hybridvo.core.gravity import Gravity
from hybridvo.core.results import MotionPrior, Term
from hybridvo.core.types import Frame
from hybridvo.core.unchecked import changed
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


@dataclass(frozen=True, eq=False)
class Sensors:
    """What is known of a camera and its sensors, beside where it is.

    Attributes:
        last: the last frame, as it came.
        clock: whether the stamps of the frames rise.
        scale: how well the scale of all depths is known, where each frame has its own.
        gyroscope: where samples were handed in.
        accelerometer: where they had accelerations.
    """

    last: Frame | None = None
    clock: Clock = field(default_factory=Clock)
    scale: ScaleFilter = field(default_factory=ScaleFilter)
    gyroscope: Gyroscope | None = None
    accelerometer: Accelerometer | None = None


@dataclass(frozen=True, eq=False)
class TrackerState:
    """The state of a tracker after a frame, with which another tracker can go on.

    Attributes:
        reference: from which the next motion starts; None before the first frame.
        keyframes: oldest first.
        places: from which a lost path is found again.
        failed: the frame before where no motion to it was found, with the pose that is held.
        part: number of the first frame that leads here: no motion is known from earlier ones.
        memory: which parts of the view are static.
        motion_model: what is expected of the next motion.
        T_world_last: (4, 4) pose of the last step.
        count: frames so far.
        found_by: what the last motion is based on; nothing where it failed.
        world: what was believed static when hardly any of it was hidden.
        hidden: frames since something nearer hides it; 0: nothing does.
        sensors: what is known of the camera beside that.
    """

    reference: Keyframe | None = None
    keyframes: tuple[Keyframe, ...] = ()
    places: tuple[Keyframe, ...] = ()
    failed: Keyframe | None = None
    part: int = 0
    memory: Memory | None = None
    motion_model: MotionModel = field(default_factory=MotionModel)
    T_world_last: np.ndarray = field(default_factory=lambda: np.eye(4))
    count: int = 0
    found_by: tuple[Term, ...] = ()
    world: Memory | None = None
    hidden: int = 0
    sensors: Sensors = field(default_factory=Sensors)

    @property
    def known_reference(self) -> Keyframe:
        """The reference, of a tracker that has seen a frame."""
        assert self.reference is not None
        return self.reference

    @property
    def frame(self) -> Frame | None:
        """The frame from which the next motion starts."""
        return None if self.reference is None else self.reference.frame

    @property
    def gap(self) -> int:
        """How many frames were passed over since the reference."""
        return (
            0 if self.reference is None else self.count - self.reference.count - 1
        )

    @property
    def is_by_depth(self) -> bool:
        """Whether the last step was by depth alone."""
        found_by = {Term.IMAGES, Term.FLOW} & set(self.found_by)
        return Term.DEPTH in self.found_by and not found_by

    @property
    def starts(self) -> dict[int, Frame]:
        """The frames from which the next motion may start, by their index."""
        held = [*self.places, *self.keyframes]
        held += [each for each in (self.reference, self.failed) if each is not None]
        return {each.frame.index: each.frame for each in held}

    @property
    def nearest_starts(self) -> list[Frame]:
        """The reference and the keyframes: the next motion starts from one of them."""
        held = [each.frame for each in self.keyframes]
        return held if self.frame is None else [*held, self.frame]

    @property
    def gravity(self) -> Gravity | None:
        """Which way is down; None where no accelerometer has shown it."""
        accelerometer = self.sensors.accelerometer
        return None if accelerometer is None else accelerometer.gravity()

    def expected(self) -> MotionPrior | None:
        """What is expected of the motion from the reference to the next frame.

        The velocity goes on from the last pose; None where it is not known.
        """
        one = self.motion_model.predict()
        all_since = self.motion_model.predict(self.gap + 1)
        if one is None or all_since is None:
            return None
        T = one.T_curr_prev @ self.T_last_reference
        return changed(all_since, T_curr_prev=T)

    @property
    def T_last_reference(self) -> np.ndarray:
        """(4, 4) motion from the reference to the last frame."""
        return invert(self.T_world_last) @ self.known_reference.T_world_cam

    def unsure(self, frame: Frame, T_world_cam: np.ndarray) -> Keyframe:
        """The next frame as a reference whose motion is not sure."""
        count = self.count
        unknown = unknown_covariance()
        return Keyframe(frame, T_world_cam, count, count, unknown, is_sure=False)

    def advanced(
        self,
        T_world_cam: np.ndarray,
        reference: Keyframe | None = None,
        found_by: tuple[Term, ...] = (),
    ) -> TrackerState:
        """Return the state after a frame.

        Args:
            T_world_cam: (4, 4) its pose.
            reference: the frame, where the next motion starts from it.
            found_by: what its motion is based on.
        """
        return replace(
            self,
            T_world_last=T_world_cam,
            count=self.count + 1,
            reference=reference or self.reference,
            failed=None,
            found_by=found_by,
        )

    def after_gap(self) -> TrackerState:
        """Return the state in which the path goes on from the frame that failed.

        How that lies to the frames before it is not known.
        """
        assert self.failed is not None
        return replace(
            self,
            reference=self.failed,
            keyframes=(),
            part=self.failed.count,
            memory=None,
        )

    def of_another_scene(self, start: Keyframe) -> TrackerState:
        """Return the state in which what was taken for the scene is forgotten.

        Args:
            start: the frame from which the scene is followed.
        """
        return replace(
            self,
            reference=start,
            keyframes=(),
            places=(),
            memory=None,
            world=None,
            hidden=0,
        )

    def without_velocity(self) -> TrackerState:
        """Return the state that expects nothing of the next motion."""
        model = replace(self.motion_model, T_last=None)
        return replace(self, motion_model=model)

    def with_scale(self, scale: ScaleFilter) -> TrackerState:
        """Return the state with what is known of the scale of all depths."""
        return replace(self, sensors=replace(self.sensors, scale=scale))

    def starting_with(self, frame: Frame) -> TrackerState:
        """Return the state with another frame in the place of the reference."""
        was = self.frame

        def changed(keyframe: Keyframe) -> Keyframe:
            is_it = keyframe.frame is was
            return replace(keyframe, frame=frame) if is_it else keyframe

        return replace(
            self,
            reference=changed(self.known_reference),
            keyframes=tuple(map(changed, self.keyframes)),
            places=tuple(map(changed, self.places)),
        )

    def moved(self, T_world_cam: np.ndarray) -> TrackerState:
        """Return the state in a world in which the camera is elsewhere, (4, 4).

        Reference and keyframes keep their places relative to the last pose.
        """
        T_new_old = T_world_cam @ invert(self.T_world_last)
        reference = self.reference
        if reference is not None:
            reference = reference.moved(T_new_old)
            if not self.gap:
                reference = replace(reference, T_world_cam=T_world_cam)
        sensors = self.sensors
        if sensors.accelerometer is not None:
            turned = sensors.accelerometer.moved(T_new_old)
            sensors = replace(sensors, accelerometer=turned)
        return replace(
            self,
            T_world_last=T_world_cam,
            reference=reference,
            keyframes=tuple(each.moved(T_new_old) for each in self.keyframes),
            places=tuple(each.moved(T_new_old) for each in self.places),
            failed=None if self.failed is None else self.failed.moved(T_new_old),
            memory=None if self.memory is None else self.memory.moved(T_new_old),
            world=None if self.world is None else self.world.moved(T_new_old),
            sensors=sensors,
        )

    def rescaled(self, factor: float) -> TrackerState:
        """Return the state after all lengths grew by a factor; the last pose stays."""
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

        def recalled(memory: Memory | None) -> Memory | None:
            if memory is None:
                return None
            return replace(memory, keyframe=rescaled(memory.keyframe))

        return replace(
            self,
            reference=rescaled(self.known_reference),
            motion_model=model,
            keyframes=tuple(map(rescaled, self.keyframes)),
            places=tuple(map(rescaled, self.places)),
            failed=None if self.failed is None else rescaled(self.failed),
            memory=recalled(self.memory),
            world=recalled(self.world),
        )


def unknown_covariance() -> np.ndarray:
    """(6, 6) zeros: of the motion of a frame that is no keyframe none is kept."""
    return np.zeros((6, 6))
