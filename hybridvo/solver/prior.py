"""A motion that is known without the pixels of a pair, as a factor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hybridvo.compiled.numba_tools import njit
from hybridvo.core.geometry import invert
from hybridvo.solver.calibration import PRIOR_FREEDOM
from hybridvo.solver.newton import Linearization, MotionState
from hybridvo.solver.rows import MOTION_TERMS

# of the weights of the prior, which its Hessian leaves out
NO_CURVATURE = np.zeros((MOTION_TERMS, MOTION_TERMS))


class Prior(NamedTuple):
    """A motion with its covariance, under Student's kernel."""

    T_prev_curr: np.ndarray  # (4, 4) its inverse
    information: np.ndarray  # (6, 6) of its left tangent

    @classmethod
    def around(cls, T_curr_prev: np.ndarray, information: np.ndarray) -> Prior:
        """Return the prior of a motion (4, 4) with an information (6, 6)."""
        return cls(invert(T_curr_prev), information)

    def linearize(self, state: MotionState) -> Linearization:
        """Return the normal equations at a state, whose H is its information there."""
        H, g, cost = prior_terms(
            self.T_prev_curr, self.information, state.T_curr_prev
        )
        return Linearization(H, g, cost, NO_CURVATURE)


@njit(error_model="numpy", cache=True, nogil=True)
def tangent_from(T_prev_curr, T):
    """Return the left tangent (6,) from a motion, given its inverse, to ``T``.

    It is exact to second order in the angle, which suffices near the prior.
    """
    E = T @ T_prev_curr
    phi = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    t = E[:3, 3].copy()
    return np.concatenate((t - 0.5 * np.cross(phi, t), phi))


@njit(error_model="numpy", cache=True, nogil=True)
def prior_terms(T_prev_curr, information, T):
    """Return information, negative gradient and cost of a prior at a motion.

    Args:
        T_prev_curr: (4, 4) inverse of the prior motion.
        information: (6, 6) of the prior.
        T: (4, 4) the motion.
    """
    xi = tangent_from(T_prev_curr, T)
    distance2 = xi @ information @ xi
    robust = (PRIOR_FREEDOM + 6) / (PRIOR_FREEDOM + distance2)
    cost = 0.5 * (PRIOR_FREEDOM + 6) * np.log1p(distance2 / PRIOR_FREEDOM)
    H = robust * information
    return H, -(H @ xi), cost
