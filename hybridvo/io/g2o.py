"""Pose graphs as ``.g2o`` files, which g2o, GTSAM and Ceres read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_rigid
from hybridvo.core.errors import InputError
from hybridvo.core.files import write_lines
from hybridvo.core.results import Edge
from hybridvo.tracking.chains import to_g2o_information

UPPER = np.triu_indices(6)


def write_g2o(
    path: str | Path,
    poses: Mapping[int, np.ndarray],
    edges: Iterable[tuple[int, Edge]],
) -> None:
    """Write a pose graph as a ``.g2o`` file: poses, motions, and loops.

    The first pose is held. GTSAM's ``readG2o`` takes the rotational information for that of
    angles, though it is that of half angles, and gives turns four times their weight: for GTSAM
    make factors with :func:`hybridvo.to_gtsam_covariance`.

    Args:
        path: of the file; what is there is replaced.
        poses: ``T_world_cam`` (4, 4), metres, by the index of its frame: where optimising starts.
        edges: motions as they were measured, each after the index of the frame where it ends:
            ``(step.index, step.edge)``, and ``(step.index, loop)`` for each of ``vo.loops(step)``.

    Raises:
        InputError: there is no pose, one is not rigid, an edge joins a frame without a pose, or
            its covariance is not definite.
        OutputError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> ahead = np.eye(4)
        >>> ahead[2, 3] = 0.5  # half a metre forward: points come closer
        >>> edge = Edge(0, np.linalg.inv(ahead), 0.25 * np.eye(6))
        >>> file = Path(tempfile.mkdtemp()) / "graph.g2o"
        >>> write_g2o(file, {0: np.eye(4), 1: ahead}, [(1, edge)])
        >>> print(file.read_text().splitlines()[-1][:51])
        EDGE_SE3:QUAT 0 1 0.0 0.0 0.5 0.0 0.0 0.0 1.0 4.0 0
    """
    if not poses:
        raise InputError("write_g2o: expected at least one pose, got none.")
    lines = [
        f"VERTEX_SE3:QUAT {index} {_numbers(pose, f'write_g2o: pose {index}')}"
        for index, pose in poses.items()
    ]
    lines.append(f"FIX {next(iter(poses))}")
    for end, edge in edges:
        joined = f"{edge.start} {end}"
        if edge.start not in poses or end not in poses:
            raise InputError(
                f"write_g2o: edge {joined}: expected two frames that have poses."
            )
        measured = _numbers(edge.T_start_curr, f"write_g2o: edge {joined}")
        information = to_g2o_information(edge.covariance)[UPPER].tolist()
        upper = " ".join(map(repr, information))
        lines.append(f"EDGE_SE3:QUAT {joined} {measured} {upper}")
    write_lines(path, lines)


def _numbers(T: np.ndarray, where: str) -> str:
    """The numbers x y z qx qy qz qw of a pose (4, 4)."""
    T = as_rigid(T, where)
    xyzw = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return " ".join(map(repr, [*T[:3, 3].tolist(), *xyzw.tolist()]))
