"""The poses of several frames from all flow between them: one problem with shared poses.

Every pair of frames with flow is an edge. Its normal equations at the motion between its two frames
are those of :mod:`hybridvo.solver.torch.factors`; summed over the edges, with the first frame held,
they are the normal equations of the window. With C the pose of a frame and T = C_curr C_prev^-1 the
motion of an edge, perturbations from the left give

    Exp(d_curr) C_curr (Exp(d_prev) C_prev)^-1 = Exp(d_curr - Ad(T) d_prev + ...) T.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.checks import brief, check_kind
from hybridvo.core.errors import InputError
from hybridvo.core.options import RefineOptions
from hybridvo.core.results import Reason, RelativePose, Status
from hybridvo.core.torch_geometry import left_update, pp, to_matrix
from hybridvo.core.types import PairBatch
from hybridvo.solver.calibration import (
    BATCH_STEP_TOLERANCE_STD,
    WINDOW_STEPS,
)
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.backend import given_noise, kernel_model, refine_batch
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.factors import Pixels, ResidualModel
from hybridvo.solver.torch.tools import checked_batch, uncompiled


@dataclass(frozen=True, eq=False)
class WindowPoses:
    """Poses of the F frames of a window.

    Attributes:
        SE3: pypose SE3 (F, 7) of ``T_frame_first``: points of the first camera into that of each
            frame, metres; the first one is the identity. It carries the gradient.
        covariance: (6 (F - 1), 6 (F - 1)) of the left perturbations (translation, rotation) of all
            frames but the first, in each frame's camera; m^2, m rad, rad^2; float64.
        status: of the window.
        converged: whether the last step was shorter than what the noise lets one see.
        iterations: steps of the window.
        edges: the motion of every edge alone, as :func:`hybridvo.refine` gives it.
        used: (K,) bool, the edges that take part: those whose own motion did not fail.
        disagreement: (K,) squared distance of an edge's own motion from that of the window, in
            standard deviations of the edge: about 6 where it fits; NaN where it was not used.
    """

    SE3: pp.LieTensor
    covariance: torch.Tensor
    status: Status
    converged: bool
    iterations: int
    edges: BatchedPose
    used: torch.Tensor
    disagreement: torch.Tensor

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


@uncompiled
def refine_window(
    batch: PairBatch,
    edges: Any,
    T_init: Any = None,
    weights: Any = None,
    *,
    noise: Any = None,
    kernel: str = "geman-mcclure",
    options: RefineOptions | None = None,
    min_probability: float = MIN_PROBABILITY,
) -> WindowPoses:
    """Estimate the poses of several frames from the flow of all pairs of them.

    Args:
        batch: K pairs of frames with flow.
        edges: (K, 2) numbers of the previous and the current frame of each pair, from 0.
        T_init: (K, 4, 4) T_curr_prev from which each edge starts, metres; None: the identity.
        weights: (K, H, W) factors on the information of each pixel.
        noise: standard deviations of flow, px, and of log depth, as (2,) or (K, 2); None:
            estimated for each edge, and held constant for the gradient.
        kernel: the robust kernel, see :func:`hybridvo.refine`.
        options: of the refinement.
        min_probability: the probability below which the motion of an edge is degraded.

    Returns:
        The poses, relative to frame 0.

    Raises:
        InputError: A value has another shape or type, or the edges do not join all frames.
    """
    options = RefineOptions() if options is None else options
    check_kind("refine_window.batch", batch, PairBatch)
    numbers = _checked_edges(edges, len(batch.flow))
    alone = refine_batch(
        batch,
        T_init,
        weights,
        noise=noise,
        kernel=kernel,
        options=options,
        min_probability=min_probability,
    )
    batch, weights = checked_batch(batch, weights)
    with torch.autocast(batch.flow.device.type, enabled=False):
        pixels = factors.gather_pixels(batch, weights)
        stated = given_noise(noise, batch.flow)
        if stated is None:
            stated = alone.noise
        model = kernel_model(kernel, options)._replace(noise=stated)
        window = _Window(pixels, numbers, alone, model)
        poses = window.starts()
        if poses is None:
            return window.failed("the flow that is usable does not join all frames")
        return window.solve(poses)


def _checked_edges(edges: Any, count: int) -> np.ndarray:
    """The edges (K, 2), which join all frames."""
    try:
        numbers = np.asarray(edges)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    is_valid = (
        numbers.shape == (count, 2)
        and np.issubdtype(numbers.dtype, np.integer)
        and bool((numbers >= 0).all())
        and bool((numbers[:, 0] != numbers[:, 1]).all())
    )
    if not is_valid:
        raise InputError(
            f"refine_window.edges: expected ({count}, 2) numbers of two different frames, from 0, "
            f"got {brief(edges)}."
        )
    frames = int(numbers.max()) + 1
    reached = {frame for frame, *_ in _outwards(numbers, np.ones(count, bool))}
    missing = sorted(set(range(1, frames)) - reached)
    if missing:
        raise InputError(
            f"refine_window.edges: expected edges that join all of {frames} frames to frame 0, got "
            f"none that lead to {missing}. Number the frames without gaps, or add an edge."
        )
    return numbers


def _outwards(
    numbers: np.ndarray, used: np.ndarray
) -> Iterator[tuple[int, int, bool]]:
    """Yield each frame that edges lead to from frame 0, nearest first.

    Yields:
        The frame, the edge that leads to it, and whether it is the edge's current frame.
    """
    known = {0}
    while True:
        found: list[tuple[int, int, bool]] = []
        for edge in np.flatnonzero(used):
            prev = int(numbers[edge, 0])
            curr = int(numbers[edge, 1])
            if (prev in known) != (curr in known):
                found.append(
                    (curr if prev in known else prev, int(edge), prev in known)
                )
        if not found:
            return
        for link in found:
            if link[0] not in known:
                known.add(link[0])
                yield link


class _Edges(NamedTuple):
    """Normal equations of the edges of a window at its poses; n = 6 (F - 1)."""

    J: torch.Tensor  # (K, 6, n) how the motions follow the poses
    H: torch.Tensor  # (K, 6, 6)
    g: torch.Tensor  # (K, 6)

    def summed(self, matrices: torch.Tensor) -> torch.Tensor:
        """The sum (n, n) of matrices (K, 6, 6) of the edges, each brought to the poses."""
        return torch.einsum("kia,kij,kjb->ab", self.J, matrices, self.J)

    @property
    def right_side(self) -> torch.Tensor:
        """The sum (n,) of the edges' gradients."""
        return torch.einsum("kia,ki->a", self.J, self.g)


class _Window:
    """The normal equations of a window, and their solution.

    Args:
        pixels: of all edges, with their gradient.
        numbers: (K, 2) frames of the edges.
        alone: the motions of the edges alone.
        model: noise of the edges, and the robust kernel.
    """

    def __init__(
        self,
        pixels: Pixels,
        numbers: np.ndarray,
        alone: BatchedPose,
        model: ResidualModel,
    ) -> None:
        self.pixels = pixels
        self.fixed = pixels.map(torch.Tensor.detach)
        self.alone = alone
        self.model = model
        self.numbers = numbers
        self.used = ~alone.failed
        self.needs_gradient = torch.is_grad_enabled() and any(
            x.requires_grad for x in (*pixels, model.noise)
        )
        self.frames = int(numbers.max()) + 1
        device = pixels.weight.device
        self.prev = torch.as_tensor(numbers[:, 0].copy(), device=device)
        self.curr = torch.as_tensor(numbers[:, 1].copy(), device=device)

    def starts(self) -> torch.Tensor | None:
        """Poses (F, 4, 4) by the fewest edges from frame 0; None where some cannot be reached."""
        T = self.alone.SE3.detach().matrix().double()
        poses = torch.eye(4).to(T).repeat(self.frames, 1, 1)
        reached = 1
        for frame, edge, is_ahead in _outwards(
            self.numbers, self.used.cpu().numpy()
        ):
            prev, curr = self.numbers[edge]
            if is_ahead:
                poses[frame] = T[edge] @ poses[prev]
            else:
                poses[frame] = torch.linalg.inv(T[edge]) @ poses[curr]
            reached += 1
        return poses if reached == self.frames else None

    def solve(self, poses: torch.Tensor) -> WindowPoses:
        """The window from its starts (F, 4, 4)."""
        C = pp.mat2SE3(poses, check=False)
        converged = False
        steps = 0
        with torch.no_grad():
            while steps < WINDOW_STEPS and not converged:
                edges = self._linearized(C)
                H = edges.summed(edges.H)
                step, info = torch.linalg.solve_ex(H, edges.right_side)
                if int(info) or not bool(torch.isfinite(step).all()):
                    return self.failed(
                        "the flow leaves a direction of the poses open"
                    )
                C = self._moved(C, step)
                steps += 1
                converged = bool(step @ H @ step < self._tolerance)
            edges = self._linearized(C)
            inverse = torch.linalg.inv(edges.summed(edges.H))
            # each edge's gradient varies as its own covariance states, whatever the others do
            meat = edges.H @ self.alone.covariance.double() @ edges.H
            covariance = inverse @ edges.summed(meat) @ inverse
            disagreement = self._disagreement(C)
        if self.needs_gradient:
            C = self._with_gradient(C)
        status = Status()
        if not converged:
            text = f"the window did not come to rest in {WINDOW_STEPS} steps"
            status = Status.degraded(Reason.SOLVER_DIVERGED, text)
        elif not bool(self.used.all()):
            text = f"{int((~self.used).sum())} of {len(self.used)} edges failed"
            status = Status.degraded(Reason.LOW_INLIERS, text)
        return WindowPoses(
            C,
            covariance,
            status,
            converged,
            steps,
            self.alone,
            self.used,
            disagreement,
        )

    def failed(self, text: str) -> WindowPoses:
        """The status of a window without poses."""
        device = self.pixels.weight.device
        status = Status.failed(Reason.SOLVER_DIVERGED, text)
        unknown = RelativePose.failed(status.reason, text).covariance
        blocks = [torch.as_tensor(unknown, device=device)] * (self.frames - 1)
        return WindowPoses(
            pp.identity_SE3(self.frames, dtype=torch.float64, device=device),
            torch.block_diag(*blocks),
            status,
            False,
            0,
            self.alone,
            self.used,
            torch.full((len(self.used),), torch.nan, dtype=torch.float64),
        )

    @property
    def _tolerance(self) -> float:
        """Squared length of the last step, in standard deviations of the poses."""
        if self.needs_gradient:
            return float(torch.finfo(self.pixels.weight.dtype).eps)
        return BATCH_STEP_TOLERANCE_STD**2

    def _moved(self, C: pp.LieTensor, step: torch.Tensor) -> pp.LieTensor:
        """The poses after a step (6 (F - 1),) of all frames but the first."""
        held = torch.zeros_like(step[:6])
        return left_update(torch.cat([held, step]).reshape(-1, 6), C)

    def _motions(self, C: torch.Tensor) -> torch.Tensor:
        """T_curr_prev (K, 4, 4) of the edges at poses (F, 4, 4)."""
        return C[self.curr] @ torch.linalg.inv(C[self.prev])

    def _jacobians(self, T: torch.Tensor) -> torch.Tensor:
        """How the motions (K, 4, 4) of the edges follow the poses: (K, 6, 6 (F - 1))."""
        count = len(T)
        edge = torch.arange(count, device=T.device)
        J = T.new_zeros(count, self.frames, 6, 6)
        J = J.index_put((edge, self.curr), torch.eye(6).to(T).expand(count, 6, 6))
        J = J.index_put((edge, self.prev), -_adjoint(T))
        return J[:, 1:].transpose(1, 2).flatten(2) * self.used[:, None, None]

    def _linearized(self, C: pp.LieTensor) -> _Edges:
        """The normal equations of every edge at poses (F, 7)."""
        T = self._motions(to_matrix(C).double())
        at = factors.linearize(self.fixed, pp.mat2SE3(T, check=False), self.model)
        return _Edges(self._jacobians(T), at.H, at.g)

    def _disagreement(self, C: pp.LieTensor) -> torch.Tensor:
        """(K,) squared distance of the edges' own motions from those of the window."""
        T = pp.mat2SE3(self._motions(to_matrix(C).double()), check=False)
        own = pp.SE3(self.alone.SE3.detach().tensor().double())
        away = (own @ T.Inv()).Log().tensor()
        information = torch.linalg.inv(self.alone.covariance.double())
        distance2 = torch.einsum("ki,kij,kj->k", away, information, away)
        return torch.where(self.used, distance2, torch.nan)

    def _with_gradient(self, C: pp.LieTensor) -> pp.LieTensor:
        """The poses with the gradient of the solution, by the implicit function theorem."""
        poses = to_matrix(C).double()
        none = poses.new_zeros(6 * (self.frames - 1), requires_grad=True)
        A = -_jacobian(self._total_score(poses, none, self.fixed), none)
        g = self._total_score(poses, none.detach(), self.pixels)
        step = factors.implicit_step(g, torch.linalg.inv(A))
        return self._moved(C, step)

    def _total_score(
        self, poses: torch.Tensor, away: torch.Tensor, pixels: Pixels
    ) -> torch.Tensor:
        """The sum of the edges' scores (n,), which is zero at the solution.

        Args:
            poses: (F, 4, 4).
            away: (n,) perturbation of all frames but the first; of the first order.
            pixels: of the edges.
        """
        held = torch.zeros_like(away[:6])
        d = torch.cat([held, away]).reshape(-1, 6)
        turned = pp.vec2skew(d[:, 3:])
        top = torch.cat([turned, d[:, :3, None]], dim=2)
        generator = torch.cat([top, torch.zeros_like(top[:, :1])], dim=1)
        T = self._motions(poses + generator @ poses)
        scores = factors.total_score(pixels, T, self.model).double()
        return torch.einsum("kia,ki->a", self._jacobians(T), scores)


def _jacobian(y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """The derivative (m, n) of y (m,) by x (n,)."""
    rows = [
        torch.autograd.grad(each, x, retain_graph=True)[0] for each in y.unbind()
    ]
    return torch.stack(rows)


def _adjoint(T: torch.Tensor) -> torch.Tensor:
    """(K, 6, 6) with ``T Exp(d) = Exp(adjoint(T) d) T``."""
    R = T[:, :3, :3]
    cross = pp.vec2skew(T[:, :3, 3])
    top = torch.cat([R, cross @ R], dim=2)
    bottom = torch.cat([torch.zeros_like(R), R], dim=2)
    return torch.cat([top, bottom], dim=1)
