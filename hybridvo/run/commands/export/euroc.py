"""A path as EuRoC's ``data.csv``: nanoseconds, place, and a quaternion with w first."""

from __future__ import annotations

from pathlib import Path

from scipy.spatial.transform import Rotation

from hybridvo.core.files import write_lines
from hybridvo.core.trajectory import Trajectory

HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],"
    "q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """Write poses that are camera to world.

    Raises:
        OutputError: The file cannot be written.
    """
    lines = [HEADER]
    rotations = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3])
    quaternions = rotations.as_quat(canonical=True, scalar_first=True)
    rows = zip(
        trajectory.timestamps.tolist(),
        trajectory.positions.tolist(),
        quaternions.tolist(),
        strict=True,
    )
    for stamp, place, wxyz in rows:
        values = ",".join(repr(value) for value in (*place, *wxyz))
        lines.append(f"{round(stamp * 10**9)},{values}")
    write_lines(path, lines)
