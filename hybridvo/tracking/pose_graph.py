"""A small pose graph: motions with covariances between frames, joined by robust least squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hybridvo.geometry import invert, pose_matrix, se3_log, skew
from hybridvo.refinement.solver import Linearization, gauss_newton, student
from hybridvo.results import Status

CHI2_LIMIT = 22.5
"""Squared Mahalanobis distance that 0.1 % of right motions exceed (chi-square, 6 degrees)."""
FREEDOM = 4.0  # of Student's kernel: covariances are estimates, and some motions are wrong


@dataclass(frozen=True, eq=False)
class Edge:
    """A motion T_curr_prev between two frames, by their indices, and its covariance.

    Args:
        kind: ``chain``, through the frames between; ``stride``, found directly; ``search``, found
            without a start.
        weight: that the graph gave it: above 1 for one that fits well, 0 where the chi-square test
            or its status rules it out.
    """

    prev: int
    curr: int
    T: np.ndarray
    covariance: np.ndarray
    status: Status = field(default_factory=Status)
    kind: str = "chain"
    weight: float = 1.0

    @property
    def ok(self) -> bool:
        """Whether it took part."""
        return self.status.usable and self.weight > 0


class Solution(NamedTuple):
    """Poses of all frames, the edges with their weights, robust cost."""

    T_world_cam: dict[int, np.ndarray]
    edges: tuple[Edge, ...]
    cost: float


def adjoint(T: np.ndarray) -> np.ndarray:
    """(6, 6) with ``T Exp(d) = Exp(adjoint(T) d) T``, translation first."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = skew(t) @ R
    return out


def compose_covariance(first: np.ndarray, T: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(6, 6) covariance of ``T @ T_first`` from that of ``T_first`` and of ``T``."""
    A = adjoint(T)
    return A @ first @ A.T + second


def chi2(T_error: np.ndarray, covariance: np.ndarray) -> float:
    """Squared Mahalanobis length of a small transform."""
    error = se3_log(T_error)
    return float(error @ np.linalg.solve(covariance, error))


def solve_graph(
    T_world_cam: Mapping[int, np.ndarray], edges: Sequence[Edge], free: Sequence[int]
) -> Solution:
    """Gauss-Newton with Student's weights; only the ``free`` frames move."""
    names = list(free)
    graph = _EdgeFactor({k: invert(T) for k, T in T_world_cam.items()}, names, edges)
    found = gauss_newton([graph], np.stack([graph.held[k] for k in names]))
    d2 = graph.distances(graph.errors(found.T))
    rated = []
    for k, edge in enumerate(edges):
        used = edge.status.usable and d2[k] < CHI2_LIMIT
        rated.append(replace(edge, weight=float(student(d2[k], FREEDOM)[1]) if used else 0.0))
    moved = {k: pose_matrix(invert(T)[:3]) for k, T in zip(names, found.T, strict=True)}
    return Solution(dict(T_world_cam) | moved, tuple(rated), found.at.cost)


class _EdgeFactor:
    """All edges, as a factor of the free frames' (n, 4, 4) T_cam_world."""

    def __init__(
        self, held: dict[int, np.ndarray], free: Sequence[int], edges: Sequence[Edge]
    ) -> None:
        self.held, self.edges = held, edges
        self.place = {name: k for k, name in enumerate(free)}
        self.information = np.array([np.linalg.inv(e.covariance) for e in edges])

    def errors(self, T: np.ndarray) -> np.ndarray:
        """(E, 6) logarithm of what each edge says more than the poses."""
        at = self.held | {name: T[k] for name, k in self.place.items()}
        return np.array([se3_log(e.T @ at[e.prev] @ invert(at[e.curr])) for e in self.edges])

    def distances(self, errors: np.ndarray) -> np.ndarray:
        """(E,) squared Mahalanobis lengths."""
        return np.einsum("ei,eij,ej->e", errors, self.information, errors)

    def linearize(self, T: np.ndarray) -> Linearization:
        """See :class:`hybridvo.refinement.solver.Factor`."""
        n, total = len(self.place), 0.0
        H, g = np.zeros((n, 6, n, 6)), np.zeros((n, 6))
        errors = self.errors(T)
        costs, weights = student(self.distances(errors), FREEDOM)
        for k, edge in enumerate(self.edges):
            if not edge.status.usable:
                continue
            total += float(costs[k])
            information = weights[k] * self.information[k]
            # the error changes by adjoint(T) d_prev - d_curr
            ends = ((edge.prev, adjoint(edge.T)), (edge.curr, -np.eye(6)))
            blocks = [(self.place[name], A) for name, A in ends if name in self.place]
            for i, A in blocks:
                g[i] -= A.T @ information @ errors[k]
                for j, B in blocks:
                    H[i, :, j] += A.T @ information @ B
        return Linearization(H.reshape(6 * n, 6 * n), g.ravel(), total)
