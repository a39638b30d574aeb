"""The solution of a window of frames, its covariance and its gradient.

Every pair of frames with flow is an edge. Its normal equations at the motion between its two frames
are those of :mod:`hybridvo.solver.torch.factors`; summed over the edges, with the first frame held,
they are the normal equations of the window. With C the pose of a frame and T = C_curr C_prev^-1 the
motion of an edge, perturbations from the left give

    Exp(d_curr) C_curr (Exp(d_prev) C_prev)^-1 = Exp(d_curr - Ad(T) d_prev + ...) T.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from hybridvo.core.checks import brief
from hybridvo.core.errors import InputError
from hybridvo.core.results import Reason, RelativePose, Status
from hybridvo.core.torch_geometry import left_update, pp, to_matrix
from hybridvo.solver.robust_fit import SCALE_PER_RESIDUAL
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.batched_pose import BatchedPose
from hybridvo.solver.torch.factors import Pixels, ResidualModel
from hybridvo.solver.torch.newton import Rest, Rested, newton
from hybridvo.solver.torch.solve import BATCH_SCALE_RATIO, BATCH_STEP_TOLERANCE_STD
from hybridvo_lab.windows.window_equations import (
    POSE,
    EdgeSums,
    WindowEquations,
    edge_inflation,
    edge_jacobians,
    edge_scores,
    edge_sums,
)
from hybridvo_lab.windows.window_poses import WindowPoses
from hybridvo_lab.windows.window_unknowns import (
    Edges,
    Unknowns,
    WindowState,
    camera_columns,
    moved_pixels,
)

# Gauss-Newton steps: each at least halves the distance to the solution, and a
# gradient needs it to the precision of the numbers
WINDOW_STEPS = 40
# standard deviations, of the last step of a window with more unknowns than poses:
# what it leaves may be as long as it
WINDOW_STEP_TOLERANCE_STD = 0.1
# steps that bring each edge to the focal length and scales of its window, before
# both are compared
WINDOW_EDGE_STEPS = 5

# Smallest second derivative of the cost by the depth of a pixel, of which its prior alone has 1:
# numerical guard, a robust cost may bend the other way beside its minimum.
SMALLEST_CURVATURE = 0.05
# Smallest relative variance of a log depth: numerical guard, the root of zero has no derivative.
SMALLEST_VARIANCE = 1e-12


def outwards(
    numbers: np.ndarray, used: np.ndarray
) -> Iterator[tuple[int, int, bool]]:
    """Yield each frame that edges lead to from frame 0, nearest first.

    Args:
        numbers: (K, 2) frames of the edges.
        used: (K,) which edges count.

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


def checked_edges(edges: Any, count: int) -> np.ndarray:
    """Return the edges (K, 2) of K pairs, which must join all frames."""
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
    reached = {frame for frame, *_ in outwards(numbers, np.ones(count, bool))}
    missing = sorted(set(range(1, frames)) - reached)
    if missing:
        raise InputError(
            f"refine_window.edges: expected edges that join all of {frames} frames to frame 0, got "
            f"none that lead to {missing}. Number the frames without gaps, or add an edge."
        )
    return numbers


class Window:
    """The normal equations of a window, and their solution.

    Args:
        pixels: of all edges, with their gradient.
        numbers: (K, 2) frames of the edges.
        alone: the motions of the edges alone.
        model: noise of the edges, and the robust kernel.
        unknowns: what is unknown beside the poses.
        depth: (K, H, W) depth of the previous frames, with its gradient.
    """

    def __init__(
        self,
        pixels: Pixels,
        numbers: np.ndarray,
        alone: BatchedPose,
        model: ResidualModel,
        unknowns: Unknowns,
        depth: torch.Tensor,
    ) -> None:
        self.pixels = pixels
        self.fixed = pixels.map(torch.Tensor.detach)
        self.alone = alone
        self.model = model
        self.numbers = numbers
        self.unknowns = unknowns
        self.depth = depth
        self.needs_gradient = torch.is_grad_enabled() and any(
            x.requires_grad for x in (*pixels, model.noise)
        )
        device = pixels.weight.device
        self.edges = Edges(
            prev=torch.as_tensor(numbers[:, 0].copy(), device=device),
            curr=torch.as_tensor(numbers[:, 1].copy(), device=device),
            used=~alone.failed,
            frames=int(numbers.max()) + 1,
        )
        self.poses_size = POSE * (self.edges.frames - 1)
        self.stds = unknowns.stds(pixels.weight)

    def starts(self) -> WindowState | None:
        """Poses by the fewest edges from frame 0; None where some frames cannot be reached."""
        T = self.alone.SE3.detach().matrix().double()
        poses = torch.eye(4).to(T).repeat(self.edges.frames, 1, 1)
        reached = 1
        used = self.edges.used.cpu().numpy()
        for frame, edge, is_ahead in outwards(self.numbers, used):
            prev, curr = self.numbers[edge]
            if is_ahead:
                poses[frame] = T[edge] @ poses[prev]
            else:
                poses[frame] = torch.linalg.inv(T[edge]) @ poses[curr]
            reached += 1
        if reached < self.edges.frames:
            return None
        return self._state_at(pp.mat2SE3(poses, check=False))

    def solve(self, state: WindowState) -> WindowPoses:
        """Return the window from its starts."""
        with torch.no_grad():
            rested = self._rested(state)
            if not rested.solved:
                return self.failed("the flow leaves a direction of the poses open")
            state = rested.state
            converged = bool(rested.converged)
            steps = int(rested.iterations)
            covariance = self._covariance(state)
            disagreement = self._disagreement(state)
        if self.needs_gradient:
            state = self._with_gradient(state)
        status = Status()
        if not converged:
            text = f"the window did not come to rest in {WINDOW_STEPS} steps"
            status = Status.degraded(Reason.SOLVER_DIVERGED, text)
        elif not bool(self.edges.used.all()):
            failed = int((~self.edges.used).sum())
            text = f"{failed} of {len(self.edges.used)} edges failed"
            status = Status.degraded(Reason.LOW_INLIERS, text)
        return self._result(
            state, covariance, status, converged, steps, disagreement
        )

    def failed(self, text: str) -> WindowPoses:
        """Return the status of a window without poses."""
        device = self.pixels.weight.device
        status = Status.failed(Reason.SOLVER_DIVERGED, text)
        unknown = RelativePose.failed(status.reason, text).covariance
        blocks = [torch.as_tensor(unknown, device=device)] * (self.edges.frames - 1)
        blocks += [torch.diag(self.stds**2)] if len(self.stds) else []
        identity = pp.identity_SE3(
            self.edges.frames, dtype=torch.float64, device=device
        )
        count = len(self.edges.used)
        nothing = torch.full((count,), torch.nan, dtype=torch.float64)
        state = self._state_at(identity)
        return self._result(
            state, torch.block_diag(*blocks), status, False, 0, nothing
        )

    def _rested(self, state: WindowState) -> Rested[WindowState]:
        """Where the window comes to rest, from a state."""
        wide = list(self._first_widths(state))
        if wide:
            first = newton(
                lambda number, state: self._equations(state, wide[number]),
                self._after,
                state,
                len(wide),
            )
            if not first.solved:
                return first
            state = first.state
        return newton(
            lambda _, state: self._equations(state, self.model),
            self._after,
            state,
            WINDOW_STEPS,
            Rest(self._tolerance),
        )

    def _after(
        self, state: WindowState, step: torch.Tensor, at: WindowEquations
    ) -> WindowState:
        """The state after a step (1, n)."""
        return self._moved(state, step[0], at.depth_step(step[0]))

    def _result(
        self,
        state: WindowState,
        covariance: torch.Tensor,
        status: Status,
        converged: bool,
        steps: int,
        disagreement: torch.Tensor,
    ) -> WindowPoses:
        """The window at a state."""
        unknowns = self.unknowns
        log_focal = log_scales = depth = None
        if unknowns.has_focal:
            log_focal = self.edges.log_focal(unknowns, state.others)
        if unknowns.has_scales:
            log_scales = self.edges.log_scales(unknowns, state.others)
        if unknowns.has_scales or unknowns.shared_depth:
            depth = self._depth_at(state)
        return WindowPoses(
            SE3=state.C,
            covariance=covariance,
            status=status,
            converged=converged,
            iterations=steps,
            edges=self.alone,
            used=self.edges.used,
            disagreement=disagreement,
            log_focal=log_focal,
            log_depth_scale=log_scales,
            depth=depth,
        )

    @property
    def _tolerance(self) -> float:
        """Squared length of the last step, in standard deviations of the unknowns."""
        if self.needs_gradient:
            return float(torch.finfo(self.pixels.weight.dtype).eps)
        if self.unknowns.any:
            return WINDOW_STEP_TOLERANCE_STD**2
        return BATCH_STEP_TOLERANCE_STD**2

    # --- a state --------------------------------------------------------------------

    def _state_at(self, C: pp.LieTensor) -> WindowState:
        """The state at poses (F, 7), with all other unknowns as their priors have them."""
        pixels = self.fixed.weight.shape[1] if self.unknowns.shared_depth else 0
        depths = self.fixed.weight.new_zeros(self.edges.frames, pixels)
        return WindowState(C, torch.zeros_like(self.stds), depths)

    def _moved(
        self, state: WindowState, step: torch.Tensor, depths: torch.Tensor
    ) -> WindowState:
        """The state after a step (n,) and one of the depths (F, N)."""
        poses = step[: self.poses_size]
        held = torch.zeros_like(step[:POSE])
        return WindowState(
            C=left_update(torch.cat([held, poses]).reshape(-1, POSE), state.C),
            others=state.others + step[self.poses_size :],
            depths=state.depths + depths,
        )

    def _motions(self, C: torch.Tensor) -> torch.Tensor:
        """T_curr_prev (K, 4, 4) of the edges at poses (F, 4, 4)."""
        return C[self.edges.curr] @ torch.linalg.inv(C[self.edges.prev])

    def _motions_at(self, state: WindowState) -> torch.Tensor:
        """T_curr_prev (K, 4, 4) of the edges."""
        return self._motions(to_matrix(state.C).double())

    def _depth_std(self, pixels: Pixels, model: ResidualModel) -> torch.Tensor:
        """Standard deviation (K, N) of the log depth of the pixels, one noise for each frame."""
        used = self.edges.used.to(model.noise)
        total = self.edges.sum_by_frame(used * model.noise[:, 1])
        count = self.edges.sum_by_frame(used).clamp(min=1)
        of_frame = (total / count)[self.edges.prev]
        variance = pixels.depth_variance.clamp(min=SMALLEST_VARIANCE)
        return of_frame[:, None] * variance.sqrt()

    def _log_depth(
        self, pixels: Pixels, model: ResidualModel, depths: torch.Tensor
    ) -> torch.Tensor:
        """What is added (K, N) to the log depth of the pixels."""
        return self._depth_std(pixels, model) * depths[self.edges.prev]

    def _depth_at(self, state: WindowState) -> torch.Tensor:
        """Depth (K, H, W) of the previous frames."""
        longer = self.edges.log_scales(self.unknowns, state.others)
        longer = longer[self.edges.prev, None]
        if self.unknowns.shared_depth:
            longer = longer + self._log_depth(self.pixels, self.model, state.depths)
        factor = longer.exp().to(self.depth)
        per_pixel = factor.expand(-1, self.depth[0].numel())
        return self.depth * per_pixel.reshape(self.depth.shape)

    # --- equations ------------------------------------------------------------------

    def _first_widths(self, state: WindowState) -> Iterator[ResidualModel]:
        """Yield models whose kernel narrows to the noise, from as wide as the residuals are.

        Where scales or the focal length are off, edges contradict each other at the start.
        """
        if len(self.stds) == 0:
            return
        pixels = moved_pixels(self.fixed, self.edges, self.unknowns, state.others)
        T = pp.mat2SE3(self._motions_at(state), check=False)
        noise = self.model.noise.detach()
        narrow = noise[:, 0]
        typical = factors.typical_residual(pixels, T).to(noise)
        width = torch.maximum(SCALE_PER_RESIDUAL * typical, narrow)
        while bool((width > narrow).any()):
            wide = torch.stack([width, noise[:, 1]], dim=1)
            yield self.model._replace(noise=wide)
            width = torch.maximum(width * BATCH_SCALE_RATIO, narrow)

    def _equations(
        self, state: WindowState, model: ResidualModel
    ) -> WindowEquations:
        """The normal equations at a state."""
        T = self._motions_at(state)
        if self.unknowns.shared_depth:
            std = self._depth_std(self.fixed, model)
            shift = self._log_depth(self.fixed, model, state.depths)
            sums = self._edge_sums(state, _without_depth_noise(model), shift, std)
        else:
            sums = self._edge_sums(state, model)
        J = edge_jacobians(T, self.edges, self.unknowns)
        return WindowEquations(J, sums, self.edges, state.others, state.depths)

    def _edge_sums(
        self,
        state: WindowState,
        model: ResidualModel,
        log_depth: torch.Tensor | None = None,
        depth_std: torch.Tensor | None = None,
    ) -> EdgeSums:
        """What the pixels of the edges sum to; without ``depth_std`` each edge for itself."""
        T = self._motions_at(state)
        if not self.unknowns.any:
            at = factors.linearize(self.fixed, pp.mat2SE3(T, check=False), model)
            none = at.H[:, :, :0]
            return EdgeSums(at.H, at.g, none, none[:, 0], none[:, 0])
        pixels = moved_pixels(
            self.fixed, self.edges, self.unknowns, state.others, log_depth
        )
        return edge_sums(pixels, T, model, self.edges, self.unknowns, depth_std)

    # --- what is known of the solution ------------------------------------------------

    def _covariance(self, state: WindowState) -> torch.Tensor:
        """The covariance (n, n) of the unknowns.

        Each edge's gradient varies as its own covariance states, whatever the others do.
        """
        equations = self._equations(state, self.model)
        inverse = torch.linalg.inv(equations.matrix(equations.J))
        alone = self.alone.covariance.double()
        if not self.unknowns.any:
            H = equations.sums.H
            meat = equations.summed(H @ alone @ H)
            return inverse @ meat @ inverse
        H = self._edge_sums(state, self.model).H
        unit = torch.eye(H.shape[1]).to(H)
        used = self.edges.used[:, None, None]
        S = edge_inflation(
            torch.where(used, H, unit),
            torch.where(used, alone, unit[:POSE, :POSE]),
        )
        meat = equations.matrix(S.mT @ equations.J)
        before = self.stds.new_ones(self.poses_size)
        scale = torch.cat([before, self.stds])
        return scale[:, None] * (inverse @ meat @ inverse) * scale

    def _disagreement(self, state: WindowState) -> torch.Tensor:
        """(K,) squared distance of the edges' own motions from those of the window."""
        T = pp.mat2SE3(self._motions_at(state), check=False)
        away = (self._own_motions(state) @ T.Inv()).Log().tensor()
        information = torch.linalg.inv(self.alone.covariance.double())
        distance2 = torch.einsum("ki,kij,kj->k", away, information, away)
        return torch.where(self.edges.used, distance2, torch.nan)

    def _own_motions(self, state: WindowState) -> pp.LieTensor:
        """The motions (K, 7) of the edges alone, at the window's focal length and scales."""
        own = self.alone.SE3.detach().tensor().double()
        if len(self.stds) == 0:
            return pp.SE3(own)
        scale = self.edges.log_scales(self.unknowns, state.others).exp()
        t = own[:, :3] * scale[self.edges.prev, None]
        own = pp.SE3(torch.cat([t, own[:, 3:]], dim=1))
        pixels = moved_pixels(self.fixed, self.edges, self.unknowns, state.others)
        return factors.gauss_newton(
            pixels, own, lambda *_: self.model, WINDOW_EDGE_STEPS
        )

    # --- the gradient ---------------------------------------------------------------

    def _with_gradient(self, state: WindowState) -> WindowState:
        """The state with the gradient of the solution, by the implicit function theorem.

        The depths are eliminated as in the step: with A = -d(g, g_u) / d(x, u),

            (A_xx - A_xu A_uu^-1 A_ux) dx = dg - A_xu A_uu^-1 dg_u.
        """
        count = self.poses_size + len(self.stds)
        away = self.stds.new_zeros(count, requires_grad=True)
        deeper = torch.zeros_like(state.depths, requires_grad=True)
        score, pulls = self._total_scores(state, away, deeper, self.fixed)
        A = -_jacobian(score, away)
        g, pulls_now = self._total_scores(
            state, away.detach(), deeper.detach(), self.pixels
        )
        if not self.unknowns.shared_depth:
            step = factors.implicit_step(g, torch.linalg.inv(A))
            return self._moved(state, step, torch.zeros_like(deeper))
        mixed = -_jacobian(score, deeper).flatten(1).double()
        (bend,) = torch.autograd.grad(pulls.sum(), deeper)
        curvature = (-bend).double().clamp(min=SMALLEST_CURVATURE).flatten()
        eased = mixed / curvature
        A = A - eased @ mixed.mT
        g = g - eased @ pulls_now.double().flatten()
        step = factors.implicit_step(g, torch.linalg.inv(A))
        own = factors.implicit_step(
            pulls_now.flatten()[:, None], 1 / curvature[:, None, None]
        )
        # both have the value zero: what follows is their gradient
        depths = own[:, 0] - step @ eased
        return self._moved(state, step, depths.reshape(deeper.shape).to(deeper))

    def _total_scores(
        self,
        state: WindowState,
        away: torch.Tensor,
        deeper: torch.Tensor,
        pixels: Pixels,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The scores (n,) of the unknowns and (F, N) of the depths, zero at the solution.

        Args:
            state: of the window.
            away: (n,) perturbation of the unknowns; of the first order.
            deeper: (F, N) perturbation of the depths.
            pixels: of the edges.
        """
        poses = to_matrix(state.C).double()
        held = torch.zeros_like(away[:POSE])
        d = torch.cat([held, away[: self.poses_size]]).reshape(-1, POSE)
        turned = pp.vec2skew(d[:, 3:])
        top = torch.cat([turned, d[:, :3, None]], dim=2)
        generator = torch.cat([top, torch.zeros_like(top[:, :1])], dim=1)
        T = self._motions(poses + generator @ poses)
        if not self.unknowns.any:
            scores = factors.total_score(pixels, T, self.model).double()
            J = edge_jacobians(T, self.edges, self.unknowns)
            return torch.einsum("kia,ki->a", J, scores), deeper
        others = state.others + away[self.poses_size :]
        depths = state.depths + deeper
        model = self.model
        log_depth = None
        if self.unknowns.shared_depth:
            log_depth = self._log_depth(pixels, model, depths)
            model = _without_depth_noise(model)
        moved = moved_pixels(pixels, self.edges, self.unknowns, others, log_depth)
        at = factors.weigh(moved, T, model)
        columns = camera_columns(at, moved, T, self.edges, self.unknowns)
        scores = edge_scores(at, columns).double()
        J = edge_jacobians(T, self.edges, self.unknowns)
        prior = torch.cat([others.new_zeros(self.poses_size), others])
        total = torch.einsum("kia,ki->a", J, scores) - prior
        if not self.unknowns.shared_depth:
            return total, deeper
        std = self._depth_std(pixels, self.model)
        pulls = std * (at.q * at.right).sum(dim=1)
        return total, self.edges.sum_by_frame(pulls) - depths


def _without_depth_noise(model: ResidualModel) -> ResidualModel:
    """The model around depths that are unknowns themselves."""
    flow = model.noise[:, :1]
    return model._replace(noise=torch.cat([flow, torch.zeros_like(flow)], dim=1))


def _jacobian(y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """The derivative (m, ...) of y (m,) by x (...)."""
    rows = [
        torch.autograd.grad(each, x, retain_graph=True)[0] for each in y.unbind()
    ]
    return torch.stack(rows)
