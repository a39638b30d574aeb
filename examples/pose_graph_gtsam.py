"""A pose graph in GTSAM: a factor for every motion as it was measured, and a loop closure.

pip install "hybridvo[graph]" && python examples/pose_graph_gtsam.py
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import gtsam

import hybridvo as hvo
from hybridvo_lab.synthetic.scenes import make_scene


def between(edge: hvo.Edge, index: int) -> gtsam.BetweenFactorPose3:
    """The factor of a motion; GTSAM wants the rotation first, and another side."""
    covariance = hvo.to_gtsam_covariance(edge.covariance)
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    T_start_curr = gtsam.Pose3(edge.T_start_curr)
    return gtsam.BetweenFactorPose3(edge.start, index, T_start_curr, noise)


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
        edge = step.edge
        if edge is None:
            graph.add(gtsam.PriorFactorPose3(step.index, pose, held))
        elif step.usable and values.exists(edge.start):
            graph.add(between(edge, step.index))
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
        closure = hvo.Edge(0, loop.T_curr_prev, loop.covariance)
        graph.add(between(closure, len(frames) - 1))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    for index in found.keys():
        print(index, found.atPose3(index).translation().round(4))
