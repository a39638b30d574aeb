"""The normal equations of a window of frames, with the depths of its pixels eliminated.

The numbers that an edge depends on are the six of its motion, and as far as they are unknown the
log focal length and the log depth scale of its previous frame; with J how they follow the
unknowns x of the window, and for the depth of each pixel, which the edges from one frame share,

    H = sum J_k^T H_k J_k        c = sum J_k^T c_k        h = 1 + sum h_k

c_k = J^T W q and h_k = q^T W q over the pixels of an edge, q how they move with their depth, the
Schur complement and the step of the depths are

    (H - sum c c^T / h) dx = g - sum c g_u / h        du = (g_u - c^T dx) / h.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch

from hybridvo.core.torch_geometry import pp
from hybridvo.solver.torch import factors
from hybridvo.solver.torch.factors import (
    MAX_STEP_RATIO,
    Pixels,
    ResidualModel,
    Weighted,
)
from hybridvo_lab.windows.window_unknowns import Edges, Unknowns, camera_columns

POSE = 6
# Relative to the diagonal, by how much the factor of a matrix errs.
ROUNDING = 1e-12


class EdgeSums(NamedTuple):
    """What the pixels of each edge sum to; L numbers of an edge."""

    H: torch.Tensor  # (K, L, L) float64
    g: torch.Tensor  # (K, L) float64
    # of each pixel, for a standard deviation of its depth: c_k, h_k, and q^T W r
    by_depth: torch.Tensor  # (K, L, N)
    depth_weight: torch.Tensor  # (K, N)
    depth_pull: torch.Tensor  # (K, N)


def edge_sums(
    pixels: Pixels,
    T: torch.Tensor,
    model: ResidualModel,
    edges: Edges,
    unknowns: Unknowns,
    depth_std: torch.Tensor | None = None,
) -> EdgeSums:
    """Sum over the pixels of each edge.

    Args:
        pixels: moved to the state of the window.
        T: (K, 4, 4) motions.
        model: noise and robust kernel.
        edges: of the window.
        unknowns: which there are.
        depth_std: (K, N) standard deviation of the log depth of each pixel, where depths are
            unknown; None: they are not.
    """
    at = factors.weigh(pixels, T, model)
    columns = camera_columns(at, pixels, T, edges, unknowns)
    root = _rows(at, columns, *at.root())
    H = torch.einsum("rkin,rkjn->kij", root, root)
    g = edge_scores(at, columns)
    if depth_std is None:
        none = at.information[:, :0]
        return EdgeSums(H.double(), g.double(), none[:, None], none, none)
    q = depth_std[:, None] * at.q
    pushed = at.information[:, None] * q
    return EdgeSums(
        H.double(),
        g.double(),
        _rows(at, columns, *pushed.unbind(1)),
        (pushed * q).sum(dim=1),
        (q * at.right).sum(dim=1),
    )


def edge_scores(at: Weighted, columns: list[torch.Tensor]) -> torch.Tensor:
    """Return the scores (K, L) of the numbers of each edge, which sum to 0 at the solution."""
    return _rows(at, columns, *at.right.unbind(1)).sum(dim=-1)


def _rows(
    at: Weighted,
    columns: list[torch.Tensor],
    x: torch.Tensor,
    y: torch.Tensor,
) -> torch.Tensor:
    """Return the L rows of J^T (x, y) for x and y (..., K, N): (..., K, L, N)."""
    rows = list(at.jacobian_transpose(x, y))
    rows += [column[:, 0] * x + column[:, 1] * y for column in columns]
    return torch.stack(rows, dim=-2)


@dataclass(frozen=True, eq=False)
class WindowEquations:
    """The normal equations of a window at its state; n unknowns."""

    J: torch.Tensor  # (K, L, n) how the numbers of the edges follow the unknowns
    sums: EdgeSums
    edges: Edges
    # (m,) the unknowns that have a prior, in its standard deviations
    others: torch.Tensor
    depths: torch.Tensor  # (F, N) those of the pixels; (F, 0) where they are known
    # see :class:`hybridvo.solver.torch.newton.Equations`
    curvature: torch.Tensor | None = None
    max_step_ratio: float = MAX_STEP_RATIO

    def matrix(self, J: torch.Tensor) -> torch.Tensor:
        """Return the matrix (n, n) with the depths eliminated, with another J (K, L, n)."""
        total = self._summed(J, self.sums.H)
        for frame in self._frames_with_depths():
            column = self._depth_column(J, frame)
            total = total - (column / self._depth_weight(frame)) @ column.mT
        return total + torch.diag(self._prior_weight)

    def summed(self, matrices: torch.Tensor) -> torch.Tensor:
        """Sum matrices (K, L, L) of the edges, each brought to the unknowns: (n, n)."""
        return self._summed(self.J, matrices)

    def _summed(self, J: torch.Tensor, matrices: torch.Tensor) -> torch.Tensor:
        return torch.einsum("kia,kij,kjb->ab", J, matrices, J)

    @cached_property
    def H(self) -> torch.Tensor:
        """The matrix (1, n, n) with the depths eliminated."""
        return self.matrix(self.J)[None]

    @cached_property
    def g(self) -> torch.Tensor:
        """The right side (1, n) with the depths eliminated."""
        total = torch.einsum("kia,ki->a", self.J, self.sums.g)
        for frame in self._frames_with_depths():
            eased = self._depth_pull(frame) / self._depth_weight(frame)
            total = total - self._depth_column(self.J, frame) @ eased
        before = total.new_zeros(len(total) - len(self.others))
        return (total - torch.cat([before, self.others]))[None]

    @property
    def weight(self) -> torch.Tensor:
        """Infinite (1,): how far the image moves does not end the steps of a window."""
        return self.J.new_full((1,), torch.inf)

    def depth_step(self, step: torch.Tensor) -> torch.Tensor:
        """Return the step (F, N) of the depths that goes with a step (n,)."""
        steps = torch.zeros_like(self.depths)
        for frame in self._frames_with_depths():
            pull = self._depth_pull(frame) - step @ self._depth_column(
                self.J, frame
            )
            steps[frame] = (pull / self._depth_weight(frame)).to(steps)
        return steps

    @property
    def _prior_weight(self) -> torch.Tensor:
        """The diagonal (n,) that the priors add."""
        one = torch.ones_like(self.others)
        before = self.J.new_zeros(self.J.shape[2] - len(one))
        return torch.cat([before, one])

    def _frames_with_depths(self) -> list[int]:
        """Frames whose depths are unknown, and at which edges begin."""
        if self.depths.shape[1] == 0:
            return []
        return sorted(set(self.edges.prev.tolist()))

    def _depth_column(self, J: torch.Tensor, frame: int) -> torch.Tensor:
        """Return c (n, N) of the pixels of a frame."""
        mine = self.edges.prev == frame
        columns = self.sums.by_depth[mine].double()
        return torch.einsum("kia,kin->an", J[mine], columns)

    def _depth_weight(self, frame: int) -> torch.Tensor:
        """Return h (N,) of the pixels of a frame."""
        mine = self.edges.prev == frame
        return 1 + self.sums.depth_weight[mine].double().sum(dim=0)

    def _depth_pull(self, frame: int) -> torch.Tensor:
        """Return g_u (N,) of the pixels of a frame."""
        mine = self.edges.prev == frame
        pull = self.sums.depth_pull[mine].double().sum(dim=0)
        return pull - self.depths[frame].double()


def edge_inflation(H: torch.Tensor, covariance: torch.Tensor) -> torch.Tensor:
    """Return S (K, L, L) with which the gradients of edges vary as S H S^T instead of as H.

    Of the motion, that is H C H with the covariance C that the edge alone states. Of the other
    numbers, the part that follows the motion varies with it, and the rest as the mean of it.

    Args:
        H: (K, L, L) of the edges, the motion first.
        covariance: (K, 6, 6) of the motions alone.
    """
    motion = H[:, :POSE, :POSE]
    varies = motion @ covariance @ motion
    varies = 0.5 * (varies + varies.mT)
    of_motion = _cholesky(varies) @ torch.linalg.inv(_cholesky(motion))
    S = torch.zeros_like(H)
    S[:, :POSE, :POSE] = of_motion
    rest = H.shape[1] - POSE
    if rest > 0:
        mean = torch.einsum("kij,kji->k", motion, covariance) / POSE
        root = mean.clamp(min=0).sqrt()[:, None, None]
        follows = H[:, POSE:, :POSE] @ torch.linalg.inv(motion)
        S[:, POSE:, :POSE] = follows @ of_motion - root * follows
        S[:, POSE:, POSE:] = root * torch.eye(rest).to(H)
    return S


def _cholesky(A: torch.Tensor) -> torch.Tensor:
    """Return the lower factors (K, 6, 6) of matrices that are definite but for rounding."""
    scale = A.diagonal(dim1=1, dim2=2).clamp(min=torch.finfo(A.dtype).tiny).sqrt()
    outer = scale[:, :, None] * scale[:, None, :]
    unit = torch.eye(A.shape[1]).to(A)
    factor = torch.linalg.cholesky_ex(A / outer + ROUNDING * unit).L
    return scale[:, :, None] * factor


def edge_jacobians(
    T: torch.Tensor, edges: Edges, unknowns: Unknowns
) -> torch.Tensor:
    """Return how the numbers of the edges follow the unknowns, (K, L, n).

    Args:
        T: (K, 4, 4) motions of the edges.
        edges: of the window.
        unknowns: which there are.
    """
    count = len(T)
    index = torch.arange(count, device=T.device)
    J = T.new_zeros(count, edges.frames, POSE, POSE)
    J = J.index_put(
        (index, edges.curr), torch.eye(POSE).to(T).expand(count, POSE, POSE)
    )
    J = J.index_put((index, edges.prev), -_adjoint(T))
    J = J[:, 1:].transpose(1, 2).flatten(2)
    rows = []
    if unknowns.has_focal:
        rows.append(T.new_ones(count, 1))
    if unknowns.has_scales:
        rows.append(torch.nn.functional.one_hot(edges.prev, edges.frames).to(T))
    for row in rows:
        right = J.new_zeros(count, J.shape[1], row.shape[1])
        below = J.new_zeros(count, 1, J.shape[2])
        top = torch.cat([J, right], dim=2)
        bottom = torch.cat([below, row[:, None]], dim=2)
        J = torch.cat([top, bottom], dim=1)
    return J * edges.used[:, None, None]


def _adjoint(T: torch.Tensor) -> torch.Tensor:
    """(K, 6, 6) with ``T Exp(d) = Exp(adjoint(T) d) T``."""
    R = T[:, :3, :3]
    cross = pp.vec2skew(T[:, :3, 3])
    top = torch.cat([R, cross @ R], dim=2)
    bottom = torch.cat([torch.zeros_like(R), R], dim=2)
    return torch.cat([top, bottom], dim=1)
