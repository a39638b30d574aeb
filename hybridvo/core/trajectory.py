"""Camera trajectories, read from and written to text files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from hybridvo.core.checks import as_rigid, rotation_error, to_numpy
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import Rows, atomic_write, read_rows
from hybridvo.core.geometry import invert, ned_to_camera

COLUMNS = {
    "tum": "timestamp tx ty tz qx qy qz qw",
    "kitti": "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz",
    "tartanair": "tx ty tz qx qy qz qw",
}
"""Columns of the text files of poses that can be read."""
FILE_TOLERANCE = 1e-2
"""How far the rotation in a file may be from a true one. Files carry about six
digits; a wrong column is off by far more than this."""
EXACT_ROTATION = 1e-9
"""Error of a rotation matrix above which it is made orthonormal."""
CLOCK_SECONDS = (1e9, 4.2e9)
"""Seconds since 1970 on a clock between the years 2001 and 2103."""
NANOSECONDS_FROM = 1e14
"""Stamps above this, on whatever clock, are nanoseconds: in seconds, three million
years."""


class StampUnit(NamedTuple):
    """The unit of timestamps."""

    per_second: float
    name: str


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses over time. The arrays are read-only.

    Attributes:
        timestamps: (N,) seconds, strictly increasing, N >= 1.
        T_world_cam: (N, 4, 4) camera to world, metres.
        has_timestamps: False where the timestamps are frame numbers.
        warnings: sentences about what a reader changed.

    Raises:
        InputError: a pose is not rigid, or the stamps do not fit the poses.

    >>> path = Trajectory(np.array([0.0, 0.1]), np.stack([np.eye(4), np.eye(4)]))
    >>> len(path)
    2
    """

    timestamps: np.ndarray
    T_world_cam: np.ndarray
    has_timestamps: bool = True
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        stamps = to_numpy(self.timestamps, "Trajectory.timestamps")
        T = as_rigid(self.T_world_cam, "Trajectory.T_world_cam", many=True)
        is_number = stamps.dtype.kind in "fiu"
        if not len(T) or not is_number or stamps.shape != (len(T),):
            raise InputError(
                f"Trajectory: expected at least one pose, and a timestamp in seconds for "
                f"each; got {stamps.dtype} {stamps.shape} for {len(T)} poses."
            )
        stamps = stamps.astype(np.float64)
        check_increasing(stamps, "Trajectory")
        stamps.flags.writeable = False
        T.flags.writeable = False
        object.__setattr__(self, "timestamps", stamps)
        object.__setattr__(self, "T_world_cam", T)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        first, last = self.timestamps[[0, -1]]
        steps = np.diff(self.positions, axis=0)
        length = float(np.linalg.norm(steps, axis=1).sum())
        return f"Trajectory({len(self)} poses, {first:.6f} to {last:.6f} s, {length:.3g} m long)"

    @property
    def positions(self) -> np.ndarray:
        """The camera centres in the world frame, (N, 3), metres."""
        return self.T_world_cam[:, :3, 3]

    def transformed(self, T_new_world: np.ndarray) -> Trajectory:
        """Return the same path in another world frame.

        Args:
            T_new_world: (4, 4) old world frame to new one, metres.

        Returns:
            The path, with the same timestamps.

        Raises:
            InputError: for a matrix that is not rigid.
        """
        T = as_rigid(T_new_world, "T_new_world") @ self.T_world_cam
        return Trajectory(self.timestamps, T, self.has_timestamps, self.warnings)

    def of_frame(self, T_cam_frame: np.ndarray) -> Trajectory:
        """Return the path of another frame that is fixed to the camera, such as the robot's base.

        Args:
            T_cam_frame: (4, 4) points of that frame to the camera, metres.

        Returns:
            The path, with the same timestamps. Its world is related to that frame as the world
            before was to the camera: a path that began at the identity does so again.

        Raises:
            InputError: for a matrix that is not rigid.

        Example:
            >>> turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # about the camera's y axis
            >>> path = Trajectory(np.array([0.0, 0.1]), np.stack([np.eye(4), turn]))
            >>> behind = np.eye(4)
            >>> behind[2, 3] = -0.3
            >>> path.of_frame(behind).positions[1].tolist()
            [0.0, 0.0, 0.6]
        """
        T = as_rigid(T_cam_frame, "T_cam_frame")
        poses = invert(T) @ self.T_world_cam @ T
        return Trajectory(
            self.timestamps, poses, self.has_timestamps, self.warnings
        )

    @classmethod
    def load(cls, path: str | Path) -> Trajectory:
        """Read a text file of poses: TUM's, KITTI's or TartanAir's form, see :meth:`save`.

        Args:
            path: the file.

        Returns:
            The path. Stamps are in seconds; without any, frames are numbered.

        Raises:
            InputError: where there is no such file.
            FormatError: names the line that does not fit.

        Example:
            >>> Trajectory.load("runs/mine/trajectory.tum").positions  # doctest: +SKIP
        """
        return read_trajectory(path)

    def save(self, path: str | Path) -> None:
        """Write a file in KITTI's form if its name ends in ``.kitti``, else TUM's.

        Args:
            path: the file, which is replaced.

        Raises:
            OutputError: where it cannot be written.
        """
        if Path(path).suffix == ".kitti":
            rows = self.T_world_cam[:, :3].reshape(-1, 12)
        else:
            Rotation = scipy.spatial.transform.Rotation
            rotations = Rotation.from_matrix(self.T_world_cam[:, :3, :3])
            xyzw = rotations.as_quat(canonical=True)
            rows = np.column_stack([self.timestamps, self.positions, xyzw])
        with atomic_write(path) as file:
            np.savetxt(file, rows)


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a text file of poses in TUM's, KITTI's or TartanAir's form.

    The number of columns decides which form it is, see :data:`COLUMNS`. TartanAir's
    axes are turned into a camera's. Timestamps are converted to seconds; without
    them, frames are numbered.

    Raises:
        InputError: where there is no such file.
        FormatError: names the line that does not fit.
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
    has_timestamps = columns == column_count("tum")
    warnings: list[str] = []
    if has_timestamps:
        stamps = to_seconds(rows.numbers[:, 0], str(path), warnings)
    else:
        stamps = np.arange(len(T))
    rows.refuse(
        np.diff(stamps, prepend=-np.inf) <= 0,
        "increasing timestamps, without duplicates",
    )
    if columns == column_count("tartanair"):
        T = ned_to_camera(T)
    return Trajectory(stamps, T, has_timestamps, tuple(warnings))


def column_count(form: str) -> int:
    """Return the number of columns of one of :data:`COLUMNS`."""
    return len(COLUMNS[form].split())


def read_poses(path: Path, *columns: str) -> tuple[Rows, np.ndarray]:
    """Read a list of poses.

    Args:
        path: a text file.
        columns: the values of :data:`COLUMNS` that the list may have.

    Returns:
        Its rows, and the poses (N, 4, 4), NaN where a row is not finite.

    Raises:
        FormatError: names the line that does not fit.
    """
    rows = read_rows(path, *columns)
    finite = np.isfinite(rows.numbers).all(axis=1)
    T = np.tile(np.eye(4), (len(finite), 1, 1))
    if rows.numbers.shape[1] == column_count("kitti"):
        T[:, :3] = _matrices(rows, finite)
    elif finite.any():
        T[finite] = poses_of_quaternions(rows, finite)
    T[~finite] = np.nan
    return rows, T


def _matrices(rows: Rows, finite: np.ndarray) -> np.ndarray:
    """(N, 3, 4) poses of rows of matrix elements; the identity where not finite."""
    poses = np.tile(np.eye(4)[:3], (len(finite), 1, 1))
    poses[finite] = rows.numbers[finite].reshape(-1, 3, 4)
    R = poses[:, :, :3]
    error = rotation_error(R)
    rows.refuse(error > FILE_TOLERANCE, "a rotation in columns 1-3, 5-7 and 9-11")
    if error.max(initial=0) > EXACT_ROTATION:
        Rotation = scipy.spatial.transform.Rotation
        poses[:, :, :3] = Rotation.from_matrix(R).as_matrix()
    return poses


def poses_of_quaternions(rows: Rows, finite: np.ndarray) -> np.ndarray:
    """Return the poses (n, 4, 4) of the finite rows, which end in tx ty tz qx qy qz qw.

    Args:
        rows: of a list.
        finite: (N,) bool, which of them are finite.

    Raises:
        FormatError: names the line of a quaternion whose length is not 1.
    """
    xyzw = rows.numbers[:, -4:]
    # far from a unit quaternion is as wrong as very far: squares must not overflow
    length = np.linalg.norm(xyzw.clip(-2, 2), axis=1)
    is_wrong = finite & (np.abs(length - 1) > FILE_TOLERANCE)
    rows.refuse(is_wrong, "a unit quaternion qx qy qz qw")
    T = np.tile(np.eye(4), (int(np.count_nonzero(finite)), 1, 1))
    Rotation = scipy.spatial.transform.Rotation
    T[:, :3, :3] = Rotation.from_quat(xyzw[finite]).as_matrix()
    T[:, :3, 3] = rows.numbers[finite, -7:-4]
    return T


def check_increasing(stamps: np.ndarray, where: str) -> None:
    """Raise an InputError that names the first stamp which does not increase.

    Args:
        stamps: (N,) seconds.
        where: name of the argument, for the message.
    """
    good = np.isfinite(stamps) & (np.diff(stamps, prepend=-np.inf) > 0)
    if good.all():
        return
    k = int(np.argmin(good))
    got = repr(float(stamps[k]))
    if k > 0:
        got += f" after {float(stamps[k - 1])!r}"
    raise InputError(
        f"{where}: timestamps must be finite and increase: frame {k} has {got}. "
        f"Sort them and remove duplicates."
    )


def to_seconds(stamps: np.ndarray, name: str, warnings: list[str]) -> np.ndarray:
    """Convert stamps of any unit to seconds.

    Args:
        stamps: (N,) in whatever unit.
        name: of the file, for the warning.
        warnings: a sentence is appended where the unit is not seconds.

    Returns:
        (N,) seconds, NaN where not finite.
    """
    unit = stamp_unit(stamps)
    if unit.per_second != 1:
        warnings.append(
            f"{name}: timestamps are {unit.name}; converted to seconds."
        )
    return np.where(np.isfinite(stamps), stamps, np.nan) / unit.per_second


def stamp_unit(stamps: np.ndarray) -> StampUnit:
    """Guess the unit of stamps (N,) from the size of their median.

    >>> stamp_unit(np.array([1.7e12])).name
    'milliseconds'
    """
    finite = np.abs(stamps[np.isfinite(stamps)])
    typical = np.median(finite) if finite.size else 0.0
    earliest, latest = CLOCK_SECONDS
    for unit in (StampUnit(1e3, "milliseconds"), StampUnit(1e6, "microseconds")):
        if earliest <= typical / unit.per_second <= latest:
            return unit
    if typical > NANOSECONDS_FROM:
        return StampUnit(1e9, "nanoseconds")
    return StampUnit(1.0, "seconds")
