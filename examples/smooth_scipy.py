"""Smooth poses by least squares in scipy, as one would in Ceres: robust, with a loop."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo.lab.synthetic.scenes import make_scene


class Between(NamedTuple):
    """A motion from pose i to pose j."""

    i: int
    j: int
    motion: hvo.RelativePose


def smooth(poses: list[np.ndarray], factors: list[Between]) -> list[np.ndarray]:
    """The poses that fit all motions best; the first one is held.

    The covariance is of d in ``Exp(d) T_curr_prev``, which makes d the residual.
    """
    factor_roots = [np.linalg.cholesky(f.motion.covariance) for f in factors]

    def moved(x: np.ndarray) -> list[np.ndarray]:
        deltas = x.reshape(-1, 6)
        free = zip(poses[1:], deltas, strict=True)
        return [poses[0], *(T @ se3_exp(delta) for T, delta in free)]

    def residuals(x: np.ndarray) -> np.ndarray:
        T = moved(x)
        parts = []
        for factor, root in zip(factors, factor_roots, strict=True):
            T_j_i = invert(T[factor.j]) @ T[factor.i]
            delta = se3_log(T_j_i @ factor.motion.T_prev_curr)
            parts.append(np.linalg.solve(root, delta))
        return np.concatenate(parts)

    start = np.zeros(6 * (len(poses) - 1))
    return moved(least_squares(residuals, start, loss="soft_l1", x_scale="jac").x)


if __name__ == "__main__":
    scene = make_scene("static", 3, height=96, width=160, frames=4)
    walk = [scene.render(k) for k in (0, 1, 2, 3, 2, 1)]
    frames = [replace(f, index=k, timestamp=k / 24) for k, f in enumerate(walk)]
    tracker = hvo.Odometry()
    steps = [tracker.track(frame) for frame in frames]
    factors = [Between(s.prev_index, s.index, s.motion) for s in steps[1:]]
    factors.append(Between(0, len(frames) - 1, hvo.estimate(frames[0], frames[-1])))
    for T_world_cam in smooth([s.T_world_cam for s in steps], factors):
        print(T_world_cam[:3, 3].round(4))
