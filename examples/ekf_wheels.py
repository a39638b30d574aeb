"""A Kalman filter on wheels and camera: wheels bridge what the camera misses."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

import hybridvo as hvo
from hybridvo.core.geometry import chain, invert, se3_exp, se3_log
from hybridvo_lab.synthetic.scenes import make_scene

CHANGE = np.diag([4e-4] * 3 + [1e-4] * 3)  # of the motion, m^2 and rad^2 a frame
WHEELS = np.eye(6)[[2, 4]]  # wheels measure the way forward and the turn
WHEEL_STD = np.array([0.005, 0.002])  # m, rad


class MotionFilter:
    """The motion of a frame, in the tangent of ``T_curr_prev``, and its covariance."""

    motion = np.zeros(6)
    covariance = np.eye(6)

    def update(self, measured: np.ndarray, H: np.ndarray, R: np.ndarray) -> None:
        innovation = measured - H @ self.motion
        gain = self.covariance @ H.T @ np.linalg.inv(H @ self.covariance @ H.T + R)
        self.motion = self.motion + gain @ innovation
        self.covariance = (np.eye(6) - gain @ H) @ self.covariance


def fuse(steps: list[hvo.Step], wheels: list[np.ndarray]) -> list[np.ndarray]:
    """Poses from the steps of a tracker and what the wheels state, (2,) a frame."""
    ekf = MotionFilter()
    poses = [np.eye(4)]
    for step, turned in zip(steps[1:], wheels, strict=True):
        ekf.covariance = ekf.covariance + CHANGE
        ekf.update(turned, WHEELS, np.diag(WHEEL_STD**2))
        if step.usable and step.prev_index == step.index - 1:
            ekf.update(se3_log(step.T_curr_prev), np.eye(6), step.covariance)
        poses.append(chain(poses[-1], se3_exp(ekf.motion)))
    return poses


if __name__ == "__main__":
    scene = make_scene("static", 3, height=96, width=160, frames=8)
    motions = [invert(b) @ a for a, b in pairwise(scene.T_world_cam)]
    noise = WHEEL_STD * np.random.default_rng(0).normal(size=(len(motions), 2))
    wheels = [WHEELS @ se3_log(T) + e for T, e in zip(motions, noise, strict=True)]
    frames = [scene.render(k) for k in range(scene.frames)]
    for k in (4, 5):  # the camera is covered
        f = frames[k]
        frames[k] = replace(f, rgb=0 * f.rgb, depth=0 * f.depth)
    tracker = hvo.Odometry()
    steps = [tracker.track(frame) for frame in frames]
    for step, pose in zip(steps, fuse(steps, wheels), strict=True):
        print(step.index, step.status, pose[:3, 3].round(3))
