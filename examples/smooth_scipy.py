"""Smooth poses by least squares in scipy, as one would in Ceres: robust, with a loop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_exp, se3_log
from hybridvo_lab.synthetic.scenes import make_scene


def smooth(
    poses: list[np.ndarray], factors: list[tuple[int, hvo.Edge]]
) -> list[np.ndarray]:
    """The poses that fit all motions best; the first one is held.

    A factor is the number of a pose and a motion that ends there. The covariance is of d
    in ``Exp(d) T_curr_start``, which makes d the residual.
    """
    roots = [np.linalg.cholesky(edge.covariance) for _, edge in factors]

    def moved(x: np.ndarray) -> list[np.ndarray]:
        deltas = x.reshape(-1, 6)
        free = zip(poses[1:], deltas, strict=True)
        return [poses[0], *(T @ se3_exp(delta) for T, delta in free)]

    def residuals(x: np.ndarray) -> np.ndarray:
        T = moved(x)
        parts = []
        for (index, edge), root in zip(factors, roots, strict=True):
            T_curr_start = invert(T[index]) @ T[edge.start]
            delta = se3_log(T_curr_start @ edge.T_start_curr)
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
    factors = [(step.index, step.edge) for step in steps[1:]]
    loop = hvo.estimate(frames[0], frames[-1])
    factors.append(
        (len(frames) - 1, hvo.Edge(0, loop.T_curr_prev, loop.covariance))
    )
    for T_world_cam in smooth([s.T_world_cam for s in steps], factors):
        print(T_world_cam[:3, 3].round(4))
