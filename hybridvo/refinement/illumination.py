"""Light that is not the same all over the image: vignette, lamps, the camera's tone curve.

One gain and one offset a pair cannot follow it, and what they leave pulls at the motion. Where it
explains much of the residual, gain and offset become smooth fields over the image, bilinear
between the nodes of a coarse grid, fitted to the residuals and put into the grey values of the
previous image. Gradients have no preferred sign within a cell, so that the field leaves the
motion alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hybridvo.compilation import njit
from hybridvo.refinement.photometric_kernels import GREY, GX, GY, ONE, ZERO

if TYPE_CHECKING:
    from hybridvo.refinement.photometric_problem import Problem, State

ROWS, COLUMNS = 5, 7
"""Nodes of the fields."""
NODES = ROWS * COLUMNS
EXPLAINED = 0.15
"""Share of the weighted squared residuals that the fields must explain to be used. Of rendered
pairs with even light they explain 0.02 to 0.12, with a vignette of 30 % in the corners, a lamp or
a gamma of 0.6 from 0.26 on."""
LOOK = 4
"""One pixel in so many decides whether the fields are needed."""
SMOOTH = 0.01
"""Weight of the differences between neighbouring nodes, in shares of a node's typical weight."""
ANCHOR = 1e-4
"""Weight of no change at a node, for those that no pixel is near to."""


def even_light(problem: Problem, state: State, least: float = 0.0) -> bool:
    """Take smooth fields of gain and offset out of the residuals of the last projection.

    Args:
        problem: its grey values, gradients and residuals are changed.
        state: of the last projection; its own gain and offset stay what they are.
        least: the share of the squared residuals that the fields must explain to be applied.

    Returns:
        Whether they were.
    """
    height, width = problem.pair.prev.camera.shape
    steps = (ROWS - 1) / height, (COLUMNS - 1) / width
    if least > 0:
        field, gradient = _fit(problem, steps, LOOK)
        r = np.where(problem.w > 0, problem.r, 0)[::LOOK]
        power = float(problem.w[::LOOK] @ (r * r))
        if not field @ gradient >= least * power > 0:
            return False
    field, _ = _fit(problem, steps, 1)
    if not np.isfinite(field).all():
        return False
    _apply(problem, field.astype(np.float32).reshape(ROWS, COLUMNS, 2), np.float32(state.gain))
    return True


def local_correlation(
    index: np.ndarray, shape: tuple[int, int], a: np.ndarray, b: np.ndarray, weight: np.ndarray
) -> float:
    """Weighted correlation of two sets of grey values about their means in cells half as wide.

    The fields can bring the means of any two images together, but not what is within a cell.

    Args:
        index: (N, 2) rows and columns.
        shape: of the image.
        a: (N,).
        b: (N,).
        weight: (N,).
    """
    rows, columns = 2 * (ROWS - 1), 2 * (COLUMNS - 1)
    cell = (index[:, 0] * rows // shape[0]) * columns + index[:, 1] * columns // shape[1]
    total = np.maximum(np.bincount(cell, weight), 1e-12)
    a, b = (x - (np.bincount(cell, weight * x) / total)[cell] for x in (a, b))
    power = float(weight @ (a * a)) * float(weight @ (b * b))
    return float(weight @ (a * b)) / np.sqrt(power) if power > 0 else 0.0


def _fit(problem: Problem, steps: tuple[float, float], every: int) -> tuple[np.ndarray, np.ndarray]:
    """Fields ((2 NODES,): change of gain and offset of each node) and their gradient."""
    H, g = np.zeros((2 * NODES,) * 2), np.zeros(2 * NODES)
    field_equations(
        problem.index, problem.n, every, problem.buffer[GREY], problem.r, problem.w, *steps, H, g
    )
    weight = np.trace(H[1::2, 1::2]) / NODES
    power = np.trace(H[::2, ::2]) / NODES  # the same in squared grey levels
    H[::2, ::2] += SMOOTH * power * LAPLACE
    H[1::2, 1::2] += SMOOTH * weight * LAPLACE
    H[np.diag_indices(2 * NODES)] += ANCHOR * np.tile([power, weight], NODES) + 1e-12
    return np.linalg.solve(H, g), g


def _apply(problem: Problem, field: np.ndarray, gain: np.float32) -> None:
    """Grey values and gradients as under the fields (ROWS, COLUMNS, 2), residuals that follow.

    ``gain`` is the pair's own, by which the grey values are multiplied afterwards.
    """
    height, width = problem.pair.prev.camera.shape
    v = problem.index[:, 0] * np.float32((ROWS - 1) / height)
    u = problem.index[:, 1] * np.float32((COLUMNS - 1) / width)
    row, column = v.astype(np.intp), u.astype(np.intp)
    fv, fu = (v - row)[:, None], (u - column)[:, None]
    above = field[row, column] * (1 - fu) + field[row, column + 1] * fu
    below = field[row + 1, column] * (1 - fu) + field[row + 1, column + 1] * fu
    more, shift = (above * (1 - fv) + below * fv).T
    buffer = problem.buffer
    problem.r -= more * buffer[GREY] + shift
    factor = ONE + more / gain
    buffer[GREY] = factor * buffer[GREY] + shift / gain
    buffer[[GX, GY]] *= factor


def _laplace() -> np.ndarray:
    """(NODES, NODES) quadratic form of the differences between neighbouring nodes."""
    difference = np.zeros((NODES, NODES))
    for p in range(NODES):
        right = [p + 1] if (p + 1) % COLUMNS else []
        for q in [*right, *([p + COLUMNS] if p + COLUMNS < NODES else [])]:
            difference[[p, q], [p, q]] += 1.0
            difference[[p, q], [q, p]] -= 1.0
    return difference


LAPLACE = _laplace()


@njit(error_model="numpy", cache=True, nogil=True)
def field_equations(index, n, every, grey, r, w, step_v, step_u, H, g):
    """Normal equations of the fields from one pixel in ``every``."""
    nodes = np.empty(4, np.int64)
    share = np.empty(4)
    for k in range(0, n, every):
        if not w[k] > ZERO:
            continue
        v, u = index[k, 0] * step_v, index[k, 1] * step_u
        row, column = int(v), int(u)
        fv, fu = v - row, u - column
        first = row * COLUMNS + column
        nodes[0], nodes[1] = first, first + 1
        nodes[2], nodes[3] = first + COLUMNS, first + COLUMNS + 1
        share[0], share[1] = (1 - fv) * (1 - fu), (1 - fv) * fu
        share[2], share[3] = fv * (1 - fu), fv * fu
        a = grey[k]
        for i in range(4):
            p = 2 * nodes[i]
            s = w[k] * share[i]
            g[p] += s * a * r[k]
            g[p + 1] += s * r[k]
            for j in range(4):
                q = 2 * nodes[j]
                t = s * share[j]
                H[p, q] += t * a * a
                H[p, q + 1] += t * a
                H[p + 1, q] += t * a
                H[p + 1, q + 1] += t
