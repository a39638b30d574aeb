"""A pose graph in GTSAM: a factor for every usable step, and a loop closure.

pip install "hybridvo[graph]" && python examples/pose_graph_gtsam.py
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import gtsam
import numpy as np

import hybridvo as hvo
from hybridvo.synthetic.scenes import make_scene


class PoseGraph:
    """Poses, and the motions between them, each with its covariance."""

    def __init__(self) -> None:
        self.graph = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()

    def add_pose(self, index: int, T_world_cam: np.ndarray) -> None:
        pose = gtsam.Pose3(T_world_cam)
        if self.values.size() == 0:
            held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
            self.graph.add(gtsam.PriorFactorPose3(index, pose, held))
        self.values.insert(index, pose)

    def add_motion(self, i: int, j: int, motion: hvo.RelativePose) -> None:
        # GTSAM wants the rotation first, and the error on the other side
        covariance = hvo.to_gtsam_covariance(motion.covariance)
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        pose = gtsam.Pose3(motion.T_prev_curr)
        self.graph.add(gtsam.BetweenFactorPose3(i, j, pose, noise))

    def optimise(self) -> dict[int, np.ndarray]:
        found = gtsam.LevenbergMarquardtOptimizer(
            self.graph, self.values
        ).optimize()
        return {key: found.atPose3(key).matrix() for key in found.keys()}


def build(frames: Iterable[hvo.Frame], tracker: hvo.Odometry) -> PoseGraph:
    """Track frames; a degraded step is a factor too, a failed one is none."""
    graph = PoseGraph()
    for frame in frames:
        step = tracker.track(frame)
        prev = step.prev_index
        # after two failures in a row nothing joins what follows to what was
        if step.usable and (prev is None or graph.values.exists(prev)):
            graph.add_pose(step.index, step.T_world_cam)
            if prev is not None:
                graph.add_motion(prev, step.index, step.motion)
    return graph


if __name__ == "__main__":
    scene = make_scene("static", 3, height=96, width=160, frames=4)
    walk = [scene.render(k) for k in (0, 1, 2, 3, 2, 1)]
    frames = [replace(f, index=k, timestamp=k / 24) for k, f in enumerate(walk)]
    graph = build(frames, hvo.Odometry())
    loop = hvo.estimate(frames[0], frames[-1])
    if loop.ok:  # a wrong loop closure bends the whole walk
        graph.add_motion(0, len(frames) - 1, loop)
    for index, T_world_cam in graph.optimise().items():
        print(index, T_world_cam[:3, 3].round(4))
