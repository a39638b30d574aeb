"""Camera trajectories: chained from relative poses, read from and written to text files.

A trajectory holds ``T_world_cam`` (camera to world, as TUM, KITTI and evo store it) in camera axes
(x right, y down, z forward). evo writes the files. They are read here: evo names neither the line
of a mistake nor accepts tabs and Windows line ends.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.checks import as_number, to_numpy
from hybridvo.errors import FormatError, InputError
from hybridvo.files import atomic_write
from hybridvo.geometry import invert, ned_to_camera, xyzw_to_wxyz
from hybridvo.units import MAX_SECONDS, stamp_unit

Format = Literal["auto", "tum", "kitti", "tartanair"]
Axes = Literal["auto", "camera", "ned"]

_COLUMNS = {
    "tum": "timestamp tx ty tz qx qy qz qw".split(),
    "kitti": "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz".split(),
    "tartanair": "tx ty tz qx qy qz qw".split(),
}
# Text files carry six digits or so: a rotation may be off by that much, a wrong column is far more.
_FILE_ROTATION_TOLERANCE = 1e-2
_QUATERNION_NORM_TOLERANCE = 0.1
_ROTATION_TOLERANCE = 1e-6

_logger = logging.getLogger(__name__)


def _orthonormality_error(R: np.ndarray) -> np.ndarray:
    """(...,) largest entry of |R^T R - I| of (..., 3, 3); 2 or more for a reflection."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
        error = np.where(np.linalg.det(R) > 0, error, error + 2.0)
    return np.nan_to_num(error, nan=np.inf)


def _check_transforms(T: Any, name: str, tolerance: float = _ROTATION_TOLERANCE) -> np.ndarray:
    """(N, 4, 4) float64 copy of rigid transforms, or InputError naming the first bad one."""
    T = np.array(to_numpy(T, name), dtype=np.float64)
    T = T.reshape(0, 4, 4) if T.size == 0 else T
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InputError(f"{name}: expected shape (N, 4, 4), got {T.shape}.")
    last_row = np.abs(T[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1)
    good = np.isfinite(T).all(axis=(1, 2)) & (last_row <= tolerance)
    good &= _orthonormality_error(T[:, :3, :3]) <= tolerance
    if not good.all():
        index = int(np.argmin(good))
        raise InputError(
            f"{name}[{index}]: expected a finite rigid transform (rotation to {tolerance:g}, last "
            f"row 0 0 0 1), got {np.array2string(T[index], precision=6, separator=', ')}."
        )
    return T


def _check_timestamps(timestamps: Any) -> np.ndarray:
    """(N,) float64 copy of strictly increasing, finite stamps in seconds, or InputError."""
    name = "Trajectory.timestamps"
    stamps = to_numpy(timestamps, name)
    if stamps.ndim != 1 or (stamps.size and stamps.dtype.kind not in "fiu"):
        raise InputError(
            f"{name}: expected seconds of shape (N,), got {stamps.dtype} {stamps.shape}."
        )
    stamps = stamps.astype(np.float64)
    rising = np.diff(stamps, prepend=-np.inf) > 0
    good = np.isfinite(stamps) & rising
    if not good.all():
        index = int(np.argmin(good))
        raise InputError(
            f"{name}[{index}]: expected a finite number above the one before, got "
            f"{stamps[max(index - 1, 0) : index + 1].tolist()}. Sort the poses, drop duplicates."
        )
    return stamps


def chain(T_world_prev: np.ndarray, T_curr_prev: np.ndarray) -> np.ndarray:
    """Next camera pose: ``T_world_curr = T_world_prev @ inv(T_curr_prev)``.

    One Newton step of the polar decomposition keeps the rotation orthonormal, so that rounding does
    not accumulate over long sequences.

    Args:
        T_world_prev: (4, 4) previous camera to world, orthonormal to 1e-6.
        T_curr_prev: (4, 4) points of the previous camera into the current one, orthonormal to 1e-6.

    Returns:
        (4, 4) current camera to world, orthonormal to 1e-12.
    """
    T_world_curr = T_world_prev @ invert(T_curr_prev)
    R = T_world_curr[:3, :3]
    T_world_curr[:3, :3] = R @ (1.5 * np.eye(3) - 0.5 * (R.T @ R))
    return T_world_curr


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera poses over time.

    Args:
        timestamps: (N,) seconds, strictly increasing; frame numbers where a file has no stamps.
        T_world_cam: (N, 4, 4) camera to world, metres, N >= 1; stored as read-only float64.
        has_timestamps: False where ``timestamps`` are frame numbers.
        warnings: what a reader changed, in sentences.

    Raises:
        InputError: no pose, shapes that do not match, values that are not finite, rotations that
            are not orthonormal to 1e-6, stamps that do not increase.
    """

    timestamps: np.ndarray
    T_world_cam: np.ndarray
    has_timestamps: bool = True
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        stamps = _check_timestamps(self.timestamps)
        T = _check_transforms(self.T_world_cam, "Trajectory.T_world_cam")
        if len(T) == 0:
            raise InputError("Trajectory: expected at least one pose, got none.")
        if len(stamps) != len(T):
            raise InputError(
                f"Trajectory: expected one timestamp per pose, got {len(stamps)} timestamps "
                f"for {len(T)} poses."
            )
        stamps.flags.writeable = T.flags.writeable = False
        object.__setattr__(self, "timestamps", stamps)
        object.__setattr__(self, "T_world_cam", T)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        return f"Trajectory({len(self)} poses, {self.length:.3g} m)"

    @property
    def positions(self) -> np.ndarray:
        """(N, 3) camera centres in the world, metres."""
        return self.T_world_cam[:, :3, 3]

    @property
    def length(self) -> float:
        """Length of the path, metres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @classmethod
    def from_relative(
        cls,
        T_curr_prev: Sequence[np.ndarray] | np.ndarray,
        timestamps: Sequence[float] | np.ndarray,
        T_world_first: np.ndarray | None = None,
        *,
        has_timestamps: bool = True,
    ) -> Trajectory:
        """Chain relative poses: ``T_world_curr = T_world_prev @ inv(T_curr_prev)``.

        Rotations stay orthonormal to 1e-12 over any number of steps (see :func:`chain`).

        Args:
            T_curr_prev: N - 1 transforms (4, 4), points of camera i into camera i + 1.
            timestamps: (N,) seconds, one for every frame.
            T_world_first: (4, 4) pose of the first camera; identity (world = first camera) if None.
            has_timestamps: False where ``timestamps`` are frame numbers.

        Raises:
            InputError: transforms that are not rigid (to 1e-3) or not finite, or counts that do not
                match.
        """
        relative = _check_transforms(T_curr_prev, "T_curr_prev", tolerance=1e-3)
        if len(np.atleast_1d(timestamps)) != len(relative) + 1:
            raise InputError(
                f"Trajectory.from_relative: expected {len(relative) + 1} timestamps for "
                f"{len(relative)} relative poses, got {len(np.atleast_1d(timestamps))}."
            )
        first = np.eye(4) if T_world_first is None else np.asarray(T_world_first)
        first = _check_transforms(first[None], "T_world_first", tolerance=1e-3)
        for T in (first, relative):
            T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
        T_world_cam = np.empty((len(relative) + 1, 4, 4))
        T_world_cam[0] = first[0]
        for i, T in enumerate(relative):
            T_world_cam[i + 1] = chain(T_world_cam[i], T)
        return cls(np.asarray(timestamps), T_world_cam, has_timestamps)

    def relative(self) -> np.ndarray:
        """(N - 1, 4, 4) ``T_curr_prev`` between neighbours; inverse of :meth:`from_relative`."""
        return invert(self.T_world_cam[1:]) @ self.T_world_cam[:-1]

    def transformed(self, T_new_world: np.ndarray, scale: float = 1.0) -> Trajectory:
        """The same path in another world: positions times ``scale``, then moved by ``T_new_world``.

        Args:
            T_new_world: (4, 4) rigid transform from the (scaled) old world into the new one.
            scale: factor on the positions; rotations do not change.

        Raises:
            InputError: ``T_new_world`` is no rigid transform, or ``scale`` is not finite.
        """
        T = self.T_world_cam.copy()
        T[:, :3, 3] *= scale
        T = _check_transforms(np.asarray(T_new_world)[None], "T_new_world", tolerance=1e-6)[0] @ T
        return Trajectory(self.timestamps, T, self.has_timestamps, self.warnings)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the trajectory: KITTI's form where the name ends in ``.kitti``, else TUM's.

        Raises:
            OutputError: the file cannot be written; an older file at ``path`` is then unchanged.
        """
        write = write_kitti if Path(path).suffix == ".kitti" else write_tum
        write(self, path)


def write_tum(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write ``timestamp tx ty tz qx qy qz qw`` lines (camera to world), see ``Trajectory.save``."""
    # imported when used: evo takes a second
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools.file_interface import write_tum_trajectory_file

    xyzw = Rotation.from_matrix(trajectory.T_world_cam[:, :3, :3]).as_quat(canonical=True)
    poses = PoseTrajectory3D(trajectory.positions, xyzw_to_wxyz(xyzw), trajectory.timestamps)
    with atomic_write(path) as file:
        write_tum_trajectory_file(file, poses)


def write_kitti(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write the first three rows of each camera-to-world pose, see ``Trajectory.save``."""
    from evo.core.trajectory import PosePath3D
    from evo.tools.file_interface import write_kitti_poses_file

    with atomic_write(path) as file:
        write_kitti_poses_file(file, PosePath3D(poses_se3=list(trajectory.T_world_cam)))


def _read_rows(path: Path, format: str) -> tuple[str, np.ndarray, list[int]]:
    """Format, (N, columns) finite numbers and the line number of each row."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(f"{path}: expected a text file of poses, got binary data.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: trajectory file cannot be read: {error}.") from None
    numbered = enumerate((line.split("#", 1)[0].split() for line in text.split("\n")), start=1)
    lines = {number: fields for number, fields in numbered if fields}
    if not lines:
        raise FormatError(f"{path}: expected at least one pose, got none.")
    if format == "auto":
        first, count = next((number, len(fields)) for number, fields in lines.items())
        format = next((name for name, names in _COLUMNS.items() if len(names) == count), "")
        if not format:
            raise FormatError(
                f"{path}:{first}: expected 8 numbers (TUM), 12 (KITTI) or 7 (TartanAir) separated "
                f"by spaces, got {count}."
            )
    names = _COLUMNS[format]
    rows = []
    for number, fields in lines.items():
        row = [as_number(field) for field in fields]
        if len(row) != len(names) or not np.isfinite(row).all():
            raise FormatError(
                f"{path}:{number}: expected {len(names)} finite numbers '{' '.join(names)}', got "
                f"{len(row)}: {' '.join(fields)[:80]!r}. A pose that is not known must not be in "
                f"the file."
            )
        rows.append(row)
    return format, np.array(rows), list(lines)


def _refuse(bad: np.ndarray, path: Path, lines: list[int], rows: np.ndarray, expected: str) -> None:
    """FormatError that names the first bad row."""
    if bad.any():
        k = int(np.argmax(bad))
        raise FormatError(f"{path}:{lines[k]}: expected {expected}, got {rows[k].tolist()}.")


def _to_seconds(path: Path, stamps: np.ndarray, lines: list[int]) -> tuple[np.ndarray, list[str]]:
    """Stamps in seconds, strictly increasing, and what was changed."""
    far = np.abs(stamps) > MAX_SECONDS
    one_unit = f"timestamps that do not mix units ({stamps[0]} before)"
    _refuse(far != far[0], path, lines, stamps, one_unit)
    late = np.diff(stamps, prepend=-np.inf) <= 0
    _refuse(late, path, lines, stamps, "increasing timestamps: sort the file, drop duplicates")
    factor, unit = stamp_unit(stamps)
    if factor == 1:
        return stamps, []
    warning = f"{path}: timestamps are {unit}; converted to seconds."
    _logger.warning(warning)
    return stamps / factor, [warning]


def read_trajectory(
    path: str | os.PathLike[str], format: Format = "auto", *, axes: Axes = "auto"
) -> Trajectory:
    """Read a trajectory of camera-to-world poses from a text file.

    ``#`` comments, empty lines, tabs, Windows line ends and a byte-order mark are accepted.

    Args:
        path: text file, one pose a line.
        format: ``tum`` (8 columns: timestamp tx ty tz qx qy qz qw), ``kitti`` (12 columns, first
            three rows of the matrix), ``tartanair`` (7 columns: tx ty tz qx qy qz qw), or ``auto``:
            by the number of columns.
        axes: axes of the file: ``camera`` (x right, y down, z forward) or ``ned`` (x forward,
            y right, z down; converted to camera axes). ``auto`` is NED for TartanAir's format.

    Returns:
        The trajectory in camera axes. Stamps in other units than seconds are converted
        (:mod:`hybridvo.units`), which ``warnings`` and the log say. KITTI and TartanAir files get
        frame numbers as stamps.

    Raises:
        InputError: no such file, an unknown option.
        FormatError: a wrong number of columns, text, NaN, a quaternion that is not of unit length,
            a matrix that is no rotation, stamps that do not increase; names file and line.
    """
    if format not in ("auto", *_COLUMNS):
        raise InputError(f"format: expected auto, {', '.join(_COLUMNS)}, got {format!r}.")
    if axes not in ("auto", "camera", "ned"):
        raise InputError(f"axes: expected auto, camera or ned, got {axes!r}.")
    path = Path(path)
    kind, rows, lines = _read_rows(path, format)
    stamps = np.arange(len(rows), dtype=np.float64)
    warnings: list[str] = []
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    if kind == "kitti":
        T[:, :3] = rows.reshape(-1, 3, 4)
        error = _orthonormality_error(T[:, :3, :3])
        expected = "a rotation in columns 1-3, 5-7 and 9-11"
        _refuse(error > _FILE_ROTATION_TOLERANCE, path, lines, rows, expected)
        if error.max() > 1e-9:
            T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    else:
        if kind == "tum":
            stamps, warnings = _to_seconds(path, rows[:, 0], lines)
        xyzw = rows[:, -4:]
        error = np.abs(np.linalg.norm(xyzw.clip(-2, 2), axis=1) - 1)
        expected = "a unit quaternion qx qy qz qw"
        _refuse(error > _QUATERNION_NORM_TOLERANCE, path, lines, xyzw, expected)
        T[:, :3, :3] = Rotation.from_quat(xyzw).as_matrix()
        T[:, :3, 3] = rows[:, -7:-4]
    if axes == "ned" or (axes == "auto" and kind == "tartanair"):
        T = ned_to_camera(T)
    return Trajectory(stamps, T, has_timestamps=kind == "tum", warnings=tuple(warnings))
