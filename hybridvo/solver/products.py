"""Sums of the weighted products of rows: normal equations."""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.solver.kernels import BLOCK, FASTMATH, ZERO


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


@njit(error_model="numpy", cache=True, nogil=True)
def entrywise_sum(A, B):
    """Return the sum of the products of the entries of two matrices of one shape.

    ``np.sum(A * B)`` is the same, bit for bit, and takes numba ten times as long to compile.
    """
    rows, columns = A.shape
    total = 0.0
    for i in range(rows):
        for j in range(columns):
            total += A[i, j] * B[i, j]
    return total


def weighted_products(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sums (M, M) of the weighted products of rows (M, N)."""
    sums = np.zeros((len(rows), len(rows)))
    add_products(rows, weights, 1.0, sums)
    return sums
