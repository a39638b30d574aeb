"""Numba kernels of the optical flow."""

from __future__ import annotations

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.flow.calibration import (
    CONSISTENT_FLOW_PX,
    CONSISTENT_FLOW_RATIO,
    MAX_FLOW_STD_PX,
)

ALLOWED2 = np.float32(CONSISTENT_FLOW_PX**2)
ALLOWED_RATIO2 = np.float32(CONSISTENT_FLOW_RATIO**2)
MAX_VARIANCE = np.float32(MAX_FLOW_STD_PX**2)


@njit(error_model="numpy", cache=True, nogil=True)
def check_rows(forward, backward, noise, first, last, variance, valid):
    """Fill variance and validity of a flow by the flow backward, in some rows.

    Args:
        forward: (H, W, 2) float32, px, from the previous to the current image.
        backward: (H, W, 2) float32, from the current to the previous one.
        noise: variance of a component where both agree, px^2, and factor on the
            squared difference of both directions.
        first: row to begin with.
        last: row before which to end.
        variance: (H, W) float32, px^2; filled.
        valid: (H, W) bool; filled.
    """
    height, width = variance.shape
    base, factor = noise
    for v in range(first, last):
        for u in range(width):
            du = forward[v, u, 0]
            dv = forward[v, u, 1]
            x = u + du
            y = v + dv
            variance[v, u] = MAX_VARIANCE
            valid[v, u] = False
            # False where the flow is not finite
            if not (x >= 0 and x <= width - 1 and y >= 0 and y <= height - 1):
                continue
            back_u, back_v = read_flow(backward, x, y)
            difference2 = (du + back_u) ** 2 + (dv + back_v) ** 2
            allowed2 = max(ALLOWED2, ALLOWED_RATIO2 * (du * du + dv * dv))
            valid[v, u] = difference2 <= allowed2
            variance[v, u] = min(base + factor * difference2, MAX_VARIANCE)


@njit(error_model="numpy", cache=True, nogil=True)
def read_flow(flow, x, y):
    """Read both components of a flow inside the image, linearly between pixels."""
    column = min(int(x), flow.shape[1] - 2)
    row = min(int(y), flow.shape[0] - 2)
    right = np.float32(x - column)
    down = np.float32(y - row)
    return (
        _read(flow, row, column, right, down, 0),
        _read(flow, row, column, right, down, 1),
    )


@njit(error_model="numpy", cache=True, nogil=True)
def _read(flow, row, column, right, down, component):
    """Read a component between four pixels, of which (row, column) is the first."""
    a = flow[row, column, component]
    b = flow[row, column + 1, component]
    c = flow[row + 1, column, component]
    d = flow[row + 1, column + 1, component]
    above = a + right * (b - a)
    below = c + right * (d - c)
    return above + down * (below - above)
