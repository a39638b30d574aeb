"""How a tracker goes on to a frame: by which of its parts the motion to it is found."""

from __future__ import annotations

from dataclasses import dataclass, replace

from hybridvo.core.geometry import invert
from hybridvo.core.types import Frame
from hybridvo.tracking.depth_scale import (
    ScaleFilter,
    divided,
    measured_scale,
)
from hybridvo.tracking.estimates import Estimate
from hybridvo.tracking.fallbacks import bridged
from hybridvo.tracking.one_time import frames_at_one_time
from hybridvo.tracking.repeated import (
    Repeat,
    is_as_good_as_new,
    motion_without_image,
)
from hybridvo.tracking.setup import Setup
from hybridvo.tracking.tracker import Query, find, keep, of_first_frame
from hybridvo.tracking.tracker_state import Outcome, TrackerState


def outcome_of(
    setup: Setup, state: TrackerState, query: Query, repeat: Repeat
) -> Outcome:
    """Return the state of a tracker after a frame, and the frame's step.

    Args:
        setup: of the tracker.
        state: of the tracker before the frame.
        query: the frame, as it was taken, and what is known of it.
        repeat: which parts of it are those of the frame before.
    """
    in_time = frames_at_one_time(setup, state, query, repeat)
    return _Following(setup, in_time.state).outcome(in_time.query, repeat)


@dataclass(frozen=True, eq=False)
class _Following:
    """How a tracker goes on to a frame.

    Attributes:
        setup: of the tracker.
        state: of the tracker before the frame.
    """

    setup: Setup
    state: TrackerState

    def outcome(self, query: Query, repeat: Repeat) -> Outcome:
        """The outcome of a frame, of which ``repeat`` is that of the frame before."""
        if self.state.frame is None:
            return of_first_frame(self.setup, self.state, query.frame)
        outcome = None
        if repeat.colour:
            outcome = self._without_image(query, repeat)
        elif repeat.depth:
            outcome = self._with_old_depth(query, repeat)
        if outcome is not None:
            return outcome
        if self.setup.has_own_scale(query.frame):
            return self._in_common_scale(query)
        estimate = self._estimate(query)
        return self._after(query, query.frame, estimate)

    def _estimate(self, query: Query) -> Estimate:
        """The motion to a frame."""
        return find(self.setup, self.state, query)

    def _after(self, query: Query, frame: Frame, estimate: Estimate) -> Outcome:
        """The outcome of an estimate; ``frame`` is what later motions start from."""
        return keep(self.setup, self.state, frame, estimate, query.flow is not None)

    def _without_image(self, query: Query, repeat: Repeat) -> Outcome | None:
        """The outcome of a frame by its depth, where that is fresh, or by what is expected.

        None where the camera may as well have stood still. No later motion starts from such a
        frame: image and depth do not belong together.
        """
        depth_is_fresh = not (repeat.depth or self.setup.has_own_scale(query.frame))
        motion = motion_without_image(
            self.state, query.frame, query.given, repeat, depth_is_fresh
        )
        if motion is None:
            return None
        return bridged(
            self.state, query.frame, motion.replace(method=self.setup.method)
        )

    def _with_old_depth(self, query: Query, repeat: Repeat) -> Outcome | None:
        """The outcome of a frame whose depth is an old one, by its image.

        None where that depth is what the frame must show, as where the camera stands.
        """
        frame = query.frame
        without_depth = query.without_depth
        estimate = self._estimate(without_depth)
        if not estimate.motion.usable:
            return self._without_image(query, repeat)
        step = invert(estimate.T_world_cam) @ self.state.T_world_last
        if is_as_good_as_new(frame, step):
            return None
        estimate = estimate._replace(motion=repeat.marked(estimate.motion))
        # flow from elsewhere leads from each frame to the next one
        next_start = without_depth.frame if query.flow is None else frame
        return self._after(query, next_start, estimate)

    def _in_common_scale(self, query: Query) -> Outcome:
        """The outcome of a frame whose depth has a scale of its own.

        The first motion comes from the earlier frame's depth alone, in whose scale it is. With the
        scale that the static pixels then show, both depth maps take part in the second one.
        """
        frame = query.frame
        estimate = self._estimate(query.without_depth)
        scale = measured_scale(estimate.start.frame, frame, estimate.motion)
        if scale is not None:
            frame = divided(frame, scale)
            again = self._estimate(query._replace(frame=frame))
            more = measured_scale(again.start.frame, frame, again.motion)
            # unless two depth maps of one scale make it less sure
            if more is not None and again.motion.ok >= estimate.motion.ok:
                estimate = again
                scale *= more
                frame = divided(frame, more)
        before = self.state.scale
        state, step = self._after(query, frame, estimate)
        if scale is None:
            # the next motion may start from this frame, in its own scale
            return Outcome(replace(state, scale=ScaleFilter()), step)
        change = scale**before.gain
        state = replace(state.rescaled(change), scale=before.observed())
        step = replace(step, depth_scale=scale, scale_change=change)
        return Outcome(state, step)
