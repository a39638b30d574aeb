"""Camera trajectories: chained from relative poses, read from and written to text files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.checks import as_rigid, rotation_error, to_numpy
from hybridvo.errors import FormatError, InputError
from hybridvo.files import Rows, atomic_write, read_rows
from hybridvo.geometry import ned_to_camera

COLUMNS = {
    "tum": "timestamp tx ty tz qx qy qz qw",
    "kitti": "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz",
    "tartanair": "tx ty tz qx qy qz qw",
}
"""Columns of the text files of poses that can be read."""
FILE_TOLERANCE = 1e-2
"""How far the rotation in a file may be from a true one. Files carry about six digits, and a wrong
column is far more off than this."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses over time. The arrays are read-only; an InputError says what does not fit.

    Attributes:
        timestamps: (N,) seconds, strictly increasing, N >= 1.
        T_world_cam: (N, 4, 4) camera to world, metres.
        has_timestamps: False where the timestamps are frame numbers.
        warnings: sentences about what a reader changed.
    """

    timestamps: np.ndarray
    T_world_cam: np.ndarray
    has_timestamps: bool = True
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        stamps = to_numpy(self.timestamps, "Trajectory.timestamps")
        T = as_rigid(self.T_world_cam, "Trajectory.T_world_cam", many=True)
        if (
            not len(T)
            or stamps.shape != (len(T),)
            or stamps.dtype.kind not in "fiu"
        ):
            expected = "at least one pose, and a timestamp in seconds for each"
            got = f"{stamps.dtype} {stamps.shape} for {len(T)} poses"
            raise InputError(f"Trajectory: expected {expected}; got {got}.")
        stamps = stamps.astype(np.float64)
        check_increasing(stamps, "Trajectory")
        stamps.flags.writeable = T.flags.writeable = False
        object.__setattr__(self, "timestamps", stamps)
        object.__setattr__(self, "T_world_cam", T)

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def positions(self) -> np.ndarray:
        """The camera centres in the world, (N, 3), metres."""
        return self.T_world_cam[:, :3, 3]

    def transformed(self, T_new_world: np.ndarray) -> Trajectory:
        """Return the same path in another world frame."""
        T = as_rigid(T_new_world, "T_new_world") @ self.T_world_cam
        return Trajectory(self.timestamps, T, self.has_timestamps, self.warnings)

    def save(self, path: str | Path) -> None:
        """Write the trajectory in KITTI's form if the name ends in ``.kitti``, else in TUM's."""
        rows = self.T_world_cam[:, :3].reshape(-1, 12)
        if Path(path).suffix != ".kitti":
            xyzw = Rotation.from_matrix(self.T_world_cam[:, :3, :3]).as_quat(
                canonical=True
            )
            rows = np.column_stack([self.timestamps, self.positions, xyzw])
        with atomic_write(path) as file:
            np.savetxt(file, rows)


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a text file of camera-to-world poses in TUM's, KITTI's or TartanAir's form.

    The number of columns tells which form it is, see :data:`COLUMNS`. TartanAir's axes are turned
    into a camera's. Timestamps are converted to seconds; without them, frames are numbered.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: trajectory file cannot be read: no such file.")
    rows, T = read_poses(path, *COLUMNS.values())
    if not len(T):
        raise FormatError(f"{path}: expected at least one pose, got none.")
    rows.refuse(
        ~np.isfinite(rows.numbers).all(axis=1),
        "finite numbers: leave unknown poses out",
    )
    columns = rows.numbers.shape[1]
    stamps = np.arange(len(T))
    warnings = list[str]()
    if columns == 8:
        stamps = to_seconds(rows.numbers[:, 0], str(path), warnings)
    rows.refuse(
        np.diff(stamps, prepend=-np.inf) <= 0,
        "increasing timestamps, without duplicates",
    )
    if columns == 7:
        T = ned_to_camera(T)
    return Trajectory(stamps, T, columns == 8, tuple(warnings))


def read_poses(path: Path, *columns: str) -> tuple[Rows, np.ndarray]:
    """Read a list of poses; returns its rows, and the poses (N, 4, 4), NaN where not finite.

    ``columns`` are the values of :data:`COLUMNS` that the list may have.
    """
    rows = read_rows(path, *columns)
    known = np.isfinite(rows.numbers).all(axis=1)
    T = np.tile(np.eye(4), (len(known), 1, 1))
    if rows.numbers.shape[1] == 12:
        T[known, :3] = rows.numbers[known].reshape(-1, 3, 4)
        error = rotation_error(T[:, :3, :3])
        rows.refuse(
            error > FILE_TOLERANCE, "a rotation in columns 1-3, 5-7 and 9-11"
        )
        if error.max(initial=0) > 1e-9:
            T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    elif known.any():
        quaternions = rows.numbers[:, -4:]
        off = known & (
            np.abs(np.linalg.norm(quaternions.clip(-2, 2), axis=1) - 1)
            > FILE_TOLERANCE
        )
        rows.refuse(off, "a unit quaternion qx qy qz qw")
        T[known, :3, :3] = Rotation.from_quat(quaternions[known]).as_matrix()
        T[known, :3, 3] = rows.numbers[known, -7:-4]
    T[~known] = np.nan
    return rows, T


def check_increasing(stamps: np.ndarray, where: str) -> None:
    """Raise an InputError that names the first stamp which is not finite or does not increase."""
    good = np.isfinite(stamps) & (np.diff(stamps, prepend=-np.inf) > 0)
    if not good.all():
        k = int(np.argmin(good))
        got = f"{float(stamps[k])!r}" + (
            f" after {float(stamps[k - 1])!r}" if k else ""
        )
        what = f"timestamps must be finite and increase: frame {k} has {got}"
        raise InputError(f"{where}: {what}. Sort them and remove duplicates.")


def to_seconds(stamps: np.ndarray, name: str, warnings: list[str]) -> np.ndarray:
    """Convert stamps of any unit to seconds, NaN where not finite; adds a warning if it changes."""
    factor, unit = stamp_unit(stamps)
    if factor != 1:
        warnings.append(f"{name}: timestamps are {unit}; converted to seconds.")
    return np.where(np.isfinite(stamps), stamps, np.nan) / factor


def stamp_unit(stamps: np.ndarray) -> tuple[float, str]:
    """Guess the unit of stamps from their size; returns how many make a second, and its name."""
    known = np.abs(stamps[np.isfinite(stamps)])
    typical = np.median(known) if known.size else 0.0
    for factor, name in ((1e3, "milliseconds"), (1e6, "microseconds")):
        # seconds since 1970 on a clock between the years 2001 and 2103
        if 1e9 <= typical / factor <= 4.2e9:
            return factor, name
    return (1e9, "nanoseconds") if typical > 1e14 else (1.0, "seconds")
