"""Drift over sub-paths, as KITTI's odometry benchmark and TartanAir's evaluator measure it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hybridvo.geometry import invert, rotation_angle

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Sub-path lengths of the KITTI odometry benchmark, metres."""
SHORT_LENGTHS = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
"""Sub-path lengths for indoor sequences, metres (TartanAir's evaluator)."""
NOT_FINITE = "the error is not a finite number: positions are too large"


@np.errstate(over="ignore", invalid="ignore")
def kitti_drift(
    T_world_cam_est: np.ndarray,
    T_world_cam_gt: np.ndarray,
    *,
    lengths: Sequence[float] = KITTI_LENGTHS,
) -> dict[str, Any]:
    """Drift as KITTI's odometry benchmark defines it (Geiger et al., CVPR 2012).

    From every frame and for every length L, the sub-path ends at the first frame whose distance
    along the true path exceeds L; translation and angle of its relative error are divided by L and
    averaged within each length, then over the lengths (as TartanAir's evaluator). Nothing is
    aligned or scaled.

    Args:
        T_world_cam_est: (N, 4, 4) estimated camera to world, metres.
        T_world_cam_gt: (N, 4, 4) true camera to world of the same frames, metres.
        lengths: of the sub-paths, metres.

    Returns:
        ``translation`` (fraction) and ``rotation_deg_per_m``, None with ``reasons`` where the path
        is shorter than every length; ``segments``, ``path_length_m``.
    """
    est, gt = np.asarray(T_world_cam_est), np.asarray(T_world_cam_gt)
    steps = np.linalg.norm(np.diff(gt[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    means, segments = [], 0
    for length in lengths:
        last = np.searchsorted(distance, distance + length, side="right")
        (first,) = np.nonzero(last < len(gt))
        if len(first):
            last = last[first]
            error = invert(invert(est[first]) @ est[last]) @ (invert(gt[first]) @ gt[last])
            translation = np.linalg.norm(error[:, :3, 3], axis=1).mean() / length
            rotation = np.degrees(rotation_angle(error[:, :3, :3])).mean() / length
            means.append((translation, rotation))
            segments += len(first)
    values = [float(x) for x in np.mean(means, axis=0)] if means else [np.nan, np.nan]
    report: dict[str, Any] = {
        "segments": segments,
        "path_length_m": float(distance[-1]) if np.isfinite(distance[-1]) else None,
        "reasons": {},
    }
    for name, value in zip(("translation", "rotation_deg_per_m"), values, strict=True):
        report[name] = value if np.isfinite(value) else None
        if report[name] is None:
            short = f"the true path of {distance[-1]:.4g} m is shorter than {min(lengths):g} m"
            report["reasons"][name] = NOT_FINITE if means else short
    return report
