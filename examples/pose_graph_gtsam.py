"""A pose graph in GTSAM: a factor for every usable step, and a loop closure.

pip install "hybridvo[graph]" && python examples/pose_graph_gtsam.py
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import gtsam

import hybridvo as hvo
from hybridvo.lab.synthetic.scenes import make_scene


def between(i: int, j: int, motion: hvo.RelativePose) -> gtsam.BetweenFactorPose3:
    """The factor of a motion; GTSAM wants the rotation first, and another side."""
    covariance = hvo.to_gtsam_covariance(motion.covariance)
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(motion.T_prev_curr), noise)


def build(
    frames: Iterable[hvo.Frame], tracker: hvo.Odometry
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Track frames; a degraded step is a factor too, a failed one is none."""
    graph = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for frame in frames:
        step = tracker.track(frame)
        pose = gtsam.Pose3(step.T_world_cam)
        if step.prev_index is None:
            graph.add(gtsam.PriorFactorPose3(step.index, pose, held))
        elif step.usable and values.exists(step.prev_index):
            graph.add(between(step.prev_index, step.index, step.motion))
        else:  # after two failures nothing joins what follows to what was
            continue
        values.insert(step.index, pose)
    return graph, values


if __name__ == "__main__":
    scene = make_scene("static", 3, height=96, width=160, frames=4)
    walk = [scene.render(k) for k in (0, 1, 2, 3, 2, 1)]
    frames = [replace(f, index=k, timestamp=k / 24) for k, f in enumerate(walk)]
    graph, values = build(frames, hvo.Odometry())
    loop = hvo.estimate(frames[0], frames[-1])
    if loop.ok:  # a wrong loop closure bends the whole walk
        graph.add(between(0, len(frames) - 1, loop))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    for index in found.keys():
        print(index, found.atPose3(index).translation().round(4))
