"""A pose graph in GTSAM: a factor for every motion as it was measured, and for every loop.

pip install "hybridvo[graph,lab]" && python examples/pose_graph_gtsam.py RECORDING
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import gtsam

import hybridvo as hvo

CAUCHY = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)


def between(edge: hvo.Edge, index: int, kernel=None) -> gtsam.BetweenFactorPose3:
    """The factor of a motion; GTSAM wants the rotation first, and another side."""
    covariance = hvo.to_gtsam_covariance(edge.covariance)
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    if kernel is not None:
        noise = gtsam.noiseModel.Robust.Create(kernel, noise)
    T_start_curr = gtsam.Pose3(edge.T_start_curr)
    return gtsam.BetweenFactorPose3(edge.start, index, T_start_curr, noise)


def build(
    frames: Iterable[hvo.Frame], tracker: hvo.Odometry, apart: int = 30
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Track frames; a degraded step is a factor too, a failed one is none."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    for frame in frames:
        step = tracker.track(frame)
        pose = gtsam.Pose3(step.T_world_cam)
        if step.edge is None:
            graph.add(gtsam.PriorFactorPose3(step.index, pose, held))
        elif step.usable and values.exists(step.edge.start):
            graph.add(between(step.edge, step.index))
        else:  # after two failures nothing joins what follows to what was
            continue
        values.insert(step.index, pose)
        for loop in tracker.loops(step, apart):
            graph.add(between(loop, step.index, CAUCHY))
    return graph, values


if __name__ == "__main__":
    sequence = hvo.open_sequence(sys.argv[1])
    truth = hvo.Trajectory(sequence.timestamps, sequence.poses)
    times = hvo.track_in_passes(sequence).times  # of a rolling shutter
    tracker = hvo.Odometry(options=hvo.Options(track={"places": 200}))
    graph, tracked = build(map(times.frame, sequence), tracker)
    found = gtsam.LevenbergMarquardtOptimizer(graph, tracked).optimize()
    for poses in (tracked, found):
        T = [poses.atPose3(index).matrix() for index in tracked.keys()]
        path = hvo.Trajectory(truth.timestamps[list(tracked.keys())], T)
        print(f"ATE {1000 * hvo.evaluate(path, truth)['ate_rmse']:.1f} mm")
