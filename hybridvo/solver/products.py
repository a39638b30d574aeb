"""Sums of the weighted products of rows: normal equations."""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver.calibration import ROBUST_CURVATURE
from hybridvo.solver.kernels import BLOCK, FASTMATH, ZERO
from hybridvo.solver.newton import Linearization


@njit(fastmath=FASTMATH, error_model="numpy", cache=True, nogil=True)
def add_products(rows, weights, scale, sums):
    """Add ``scale rows diag(weights) rows^T`` to ``sums``.

    Args:
        rows: (M, N) float32.
        weights: (N,) float32.
        scale: a factor.
        sums: (M, M) or larger; changed.
    """
    for start in range(0, len(weights), BLOCK):
        end = min(len(weights), start + BLOCK)
        for p in range(len(rows)):
            for q in range(p + 1):
                total = ZERO
                x = rows[p]
                y = rows[q]
                for k in range(start, end):
                    total += weights[k] * x[k] * y[k]
                sums[p, q] += scale * total
                if q < p:
                    sums[q, p] += scale * total


def weighted_products(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sums (M, M) of the weighted products of rows (M, N)."""
    sums = np.zeros((len(rows), len(rows)))
    add_products(rows, weights, 1.0, sums)
    return sums


def robust_linearization(sums: np.ndarray, cost: float) -> Linearization:
    """Return the normal equations of residuals under a robust kernel.

    Args:
        sums: (1 + N, 1 + N) sums of the weighted products of residuals and their derivatives in
            N unknowns; the residuals come first.
        cost: of all residuals.
    """
    H = np.ascontiguousarray(sums[1:, 1:])
    g = -sums[1:, 0]
    return Linearization(H, g, cost, (1 - ROBUST_CURVATURE) * H)
