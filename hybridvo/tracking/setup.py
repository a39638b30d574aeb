"""How a tracker finds motions: what stays the same from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass

from hybridvo import pipeline
from hybridvo.core.options import Options
from hybridvo.core.types import Frame

KEYFRAME_METHODS = ("hybrid", "hybrid-flow", "classical")
"""Methods whose motions may span several frames: those that search from an expected motion."""


@dataclass(frozen=True, eq=False)
class Setup:
    """A method, and what it needs for every frame.

    Attributes:
        method: one of :data:`hybridvo.pipeline.METHODS`.
        context: options, networks and flow.
    """

    method: str
    context: pipeline.Context

    @property
    def options(self) -> Options:
        """The option tree."""
        return self.context.options

    @property
    def computes_flow(self) -> bool:
        """Whether flow is computed from the images, as it can be between any two frames."""
        return getattr(self.context.flow, "source", "") == "dis"

    @property
    def spans_frames(self) -> bool:
        """Whether motions may be estimated over several frames."""
        return (
            self.computes_flow
            and self.method in KEYFRAME_METHODS
            and self.options.track.keyframes == "auto"
        )

    @property
    def remembers(self) -> bool:
        """Whether what was static is remembered."""
        is_wanted = self.options.track.memory == "auto"
        return is_wanted and self.method == "hybrid" and self.spans_frames

    def has_own_scale(self, frame: Frame) -> bool:
        """Whether a frame's depth has a scale of its own, unlike that of the trajectory."""
        mode = self.options.depth.scale_per_frame
        if mode == "auto":
            return frame.depth_source == "network"
        return mode == "on"
