"""A small pose graph: motions with covariances between frames, joined by robust least squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hybridvo.geometry import invert, pose_matrix, se3_exp, se3_log
from hybridvo.refinement.photometric_problem import small_log
from hybridvo.results import Status

CHI2_LIMIT = 22.5
"""Squared Mahalanobis distance that 0.1 % of right motions exceed (chi-square, 6 degrees)."""
FREEDOM = 4.0
"""Of Student's kernel: covariances are estimates, and some motions are wrong."""
ITERATIONS = 10
TOLERANCE = 1e-3
"""Of a step, in standard deviations."""


@dataclass(frozen=True, eq=False)
class Edge:
    """A motion between two frames of the graph.

    Args:
        prev: index of one frame. curr: index of the other one.
        T: (4, 4) T_curr_prev.
        covariance: (6, 6) of ``Exp(delta) T``, translation first.
        status: of its estimate; a failed one has no weight.
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


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses of a graph.

    Args:
        T_world_cam: (4, 4) of each frame. edges: with their weights. cost: robust cost.
    """

    T_world_cam: dict[int, np.ndarray]
    edges: tuple[Edge, ...]
    cost: float


def adjoint(T: np.ndarray) -> np.ndarray:
    """(6, 6) with ``T Exp(d) = Exp(adjoint(T) d) T``, translation first."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    skew = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    out[:3, 3:] = skew @ R
    return out


def compose_covariance(first: np.ndarray, T: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(6, 6) covariance of ``T @ T_first`` from that of ``T_first`` and of ``T``."""
    A = adjoint(T)
    return A @ first @ A.T + second


def chi2(T_error: np.ndarray, covariance: np.ndarray) -> float:
    """Squared Mahalanobis length of a small transform."""
    error = _log(T_error)
    return float(error @ np.linalg.solve(covariance, error))


def solve_graph(
    T_world_cam: Mapping[int, np.ndarray], edges: Sequence[Edge], free: Sequence[int]
) -> Solution:
    """Gauss-Newton with Student's weights.

    Args:
        T_world_cam: (4, 4) of each frame to start from.
        edges: between them.
        free: frames that may move; the others are held.
    """
    Y = {name: invert(T) for name, T in T_world_cam.items()}
    used = [e for e in edges if e.status.usable]
    information = [np.linalg.inv(e.covariance) for e in used]
    maps = [adjoint(e.T) for e in used]
    column = {name: 6 * k for k, name in enumerate(free)}
    n = 6 * len(free)

    def lengths(Y: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        errors = np.array([_log(e.T @ Y[e.prev] @ invert(Y[e.curr])) for e in used])
        return errors, np.einsum("ei,eij,ej->e", errors, np.array(information), errors)

    cost = 0.0
    squared = np.zeros(0)
    if used:
        errors, squared = lengths(Y)
        cost = _cost(squared)
    for _ in range(ITERATIONS if used else 0):
        H, g = np.zeros((n, n)), np.zeros(n)
        weights = (FREEDOM + 6) / (FREEDOM + squared)
        for e, A, W, error, weight in zip(used, maps, information, errors, weights, strict=True):
            # the error changes by A d_prev - d_curr
            WA = weight * W
            a, b = column.get(e.prev), column.get(e.curr)
            if b is not None:
                H[b : b + 6, b : b + 6] += WA
                g[b : b + 6] += WA @ error
            if a is not None:
                H[a : a + 6, a : a + 6] += A.T @ WA @ A
                g[a : a + 6] -= A.T @ WA @ error
            if a is not None and b is not None:
                H[a : a + 6, b : b + 6] -= A.T @ WA
                H[b : b + 6, a : a + 6] -= WA @ A
        step, length = _solve(H, g)
        if length < TOLERANCE**2:
            break
        moved = dict(Y)
        for name, k in column.items():
            moved[name] = se3_exp(step[k : k + 6]) @ Y[name]
        new_errors, new_squared = lengths(moved)
        new_cost = _cost(new_squared)
        if not new_cost <= cost:
            break
        Y, errors, squared, cost = moved, new_errors, new_squared, new_cost
    distances = iter(squared)
    rated = []
    for e in edges:
        d2 = float(next(distances)) if e.status.usable else np.inf
        weight = (FREEDOM + 6) / (FREEDOM + d2) if d2 < CHI2_LIMIT else 0.0
        rated.append(replace(e, weight=weight))
    poses = {name: pose_matrix(invert(T)[:3]) for name, T in Y.items()}
    poses |= {name: T for name, T in T_world_cam.items() if name not in column}
    return Solution(poses, tuple(rated), cost)


def _log(T: np.ndarray) -> np.ndarray:
    """``se3_log``; below a right angle without scipy, whose 0.3 ms a call would be most of it."""
    return small_log(T) if np.trace(T[:3, :3]) > 1.0 else se3_log(T)


def _cost(squared: np.ndarray) -> float:
    return float(0.5 * (FREEDOM + 6) * np.log1p(squared / FREEDOM).sum())


def _solve(H: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, float]:
    """Step and its squared length in deviations; zero where the graph does not hold together."""
    scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-30))
    try:
        step = scale * np.linalg.solve(H * np.outer(scale, scale), scale * g)
    except np.linalg.LinAlgError:
        return np.zeros_like(g), 0.0
    if not np.isfinite(step).all():
        return np.zeros_like(g), 0.0
    return step, float(step @ g)
