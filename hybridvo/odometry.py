"""The tracker that users make: the camera's path, and what else moves where that is asked."""

from __future__ import annotations

from dataclasses import replace

from hybridvo.core.checks import check_kind
from hybridvo.core.results import Step
from hybridvo.objects.followed import Things, after_step
from hybridvo.objects.motions import GridView
from hybridvo.tracking.tracker import Tracker
from hybridvo.tracking.tracker_state import TrackerState


class Odometry(Tracker):
    """A tracker that chains the motions of consecutive frames, in constant memory.

    A frame from which no motion can start (it has hardly any depth, or its own motion failed) is
    passed over: the next motion spans it. Where flow is computed from the images, motions are
    estimated from a keyframe some steps back and given between neighbouring frames. Where the
    path is lost, the motion is also sought from one of ten earlier places. No pose is revised;
    :meth:`loops` measures what revises poses in a pose graph.

    Args:
        network: ``default`` (pretrained), None for the classical refinement alone, the name or
            file of other PWVO weights, or Models.
        flow: a callable ``(prev, curr)`` that returns a FlowField or (H, W, 2) px; None: OpenCV's
            DIS.
        method: None: ``hybrid``, or ``classical`` without a network.
        options: the option tree.
        seed: of the search.

    Raises:
        InputError: for values of another type, and for an unknown method or network.

    Example:
        >>> import hybridvo as hvo
        >>> vo = hvo.Odometry(network=None)
        >>> steps = [vo.track(frame) for frame in hvo.example_frames()]
        >>> [(step.prev_index, str(step.status)) for step in steps]
        [(None, 'ok'), (0, 'ok'), (1, 'ok')]
    """

    def reset(self) -> None:
        """Forget everything: the next frame is the first one, at the identity."""
        super().reset()
        self.things = Things()

    def resume(self, state: TrackerState, things: Things | None = None) -> None:
        """Go on where another tracker stopped.

        Args:
            state: the ``state`` of that tracker.
            things: its ``things``: what else moves; None: nothing is known.

        Raises:
            InputError: for a value of another type.
        """
        check_kind("Odometry.resume: things", things, Things, type(None))
        super().resume(state)
        self.things = things or Things()

    @property
    def _known(self) -> tuple[TrackerState, Things]:
        return self.state, self.things

    def _finished(
        self, before: TrackerState, after: TrackerState, step: Step
    ) -> Step:
        """A step with what else moves from the frame before on, where that is sought."""
        things = self.things
        view = None
        if self.options.track.objects == "auto":
            view = GridView.after(before, after, step)
        if view is not None:
            passed = before.count - before.known_reference.count
            things, seen = after_step(things, view, passed, self.options, self.seed)
            step = replace(step, objects=seen)
        if step.scale_change != 1:
            things = things.rescaled(step.scale_change)
        self.things = things
        return step
