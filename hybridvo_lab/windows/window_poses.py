"""What the refinement of a window of frames returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hybridvo.core.errors import InputError
from hybridvo.core.results import Status
from hybridvo.core.torch_geometry import pp
from hybridvo.solver.torch.batched_pose import BatchedPose


@dataclass(frozen=True, eq=False)
class WindowPoses:
    """Poses of the F frames of a window, and what else it solves for.

    Attributes:
        SE3: pypose SE3 (F, 7) of ``T_frame_first``: points of the first camera into that of each
            frame, metres; the first one is the identity. It carries the gradient.
        covariance: (n, n) of all unknowns, float64. First the left perturbations (translation,
            rotation) of all frames but the first, in each frame's camera, 6 (F - 1); m^2, m rad,
            rad^2. Then ``log_focal``, and the F ``log_depth_scale``, as far as they are unknown.
            The depths of single pixels are marginalised.
        status: of the window.
        converged: whether the last step was shorter than what the noise lets one see.
        iterations: steps of the window.
        edges: the motion of every edge alone, as :func:`hybridvo.refine` gives it.
        used: (K,) bool, the edges that take part: those whose own motion did not fail.
        disagreement: (K,) squared distance of an edge's own motion from that of the window, in
            standard deviations of the edge: about 6 where it fits; NaN where it was not used.
        log_focal: log of the factor on the focal lengths of all frames; None: they are known. It
            carries the gradient, as the two that follow.
        log_depth_scale: (F,) log of the factor on the depth of each frame; 0, as the prior has
            it, where no pair with flow begins. None: the scales are known.
        depth: (K, H, W) depth of the previous frame of each pair with its scale, and moved to
            where the flow of all pairs puts it; None: depth is as it was measured.
    """

    SE3: pp.LieTensor
    covariance: torch.Tensor
    status: Status
    converged: bool
    iterations: int
    edges: BatchedPose
    used: torch.Tensor
    disagreement: torch.Tensor
    log_focal: torch.Tensor | None = None
    log_depth_scale: torch.Tensor | None = None
    depth: torch.Tensor | None = None

    @property
    def T_frame_first(self) -> torch.Tensor:
        """Transforms (F, 4, 4) of points of the first camera into each camera, metres."""
        return self.SE3.matrix().to(self.edges.weights.dtype)

    def covariance_of(self, frame: int) -> torch.Tensor:
        """Return the covariance (6, 6) of the pose of a frame; that of the first is zero.

        Args:
            frame: its number.
        """
        count = len(self.SE3)
        if not -count <= frame < count:
            raise InputError(
                f"covariance_of: expected a frame of 0 to {count - 1}, got {frame}."
            )
        first = 6 * (frame % count - 1)
        if first < 0:
            return self.covariance.new_zeros(6, 6)
        return self.covariance[first : first + 6, first : first + 6]
