"""What is true of a sequence whose poses are known."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from hybridvo.core import geometry
from hybridvo.core.trajectory import Trajectory
from hybridvo.io.data.sequence import Sequence


def true_motion(sequence: Sequence, prev: int, curr: int) -> np.ndarray | None:
    """Return the true T_curr_prev (4, 4) between two frames, or None where it is not known."""
    if sequence.poses is None:
        return None
    T_curr_world = geometry.invert(sequence.poses[curr])
    T_curr_prev = T_curr_world @ sequence.poses[prev]
    return T_curr_prev if np.isfinite(T_curr_prev).all() else None


def true_trajectory(
    sequence: Sequence, indices: Iterable[int]
) -> Trajectory | None:
    """Return the true poses of those frames that have one, or None where there are none."""
    poses = sequence.poses
    if poses is None:
        return None
    known = [i for i in indices if np.isfinite(poses[i]).all()]
    if not known:
        return None
    # Text files have six digits. A trajectory demands exact rotations.
    T_world_cam = np.stack([geometry.pose_matrix(poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T_world_cam)
