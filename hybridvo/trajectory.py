"""Camera trajectories: chained from relative poses, read from and written to text files.

A trajectory holds ``T_world_cam`` (camera to world, as TUM, KITTI and evo store it) in camera axes
(x right, y down, z forward). evo writes the files. They are read here: evo names neither the line
of a mistake nor accepts tabs and Windows line ends.
"""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import FormatError, InputError
from hybridvo.files import atomic_write
from hybridvo.geometry import invert, ned_to_camera, xyzw_to_wxyz
from hybridvo.units import MAX_SECONDS, stamp_unit

Format = Literal["auto", "tum", "kitti", "tartanair"]
Axes = Literal["auto", "camera", "ned"]

_COLUMNS: dict[str, tuple[int, str]] = {
    "tum": (8, "timestamp tx ty tz qx qy qz qw"),
    "kitti": (12, "r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz"),
    "tartanair": (7, "tx ty tz qx qy qz qw"),
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
    try:
        T = np.array(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an array of shape (N, 4, 4).") from None
    if T.size == 0:
        T = T.reshape(0, 4, 4)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise InputError(f"{name}: expected shape (N, 4, 4), got {T.shape}.")
    finite = np.isfinite(T).all(axis=(1, 2))
    if not finite.all():
        raise InputError(f"{name}[{int(np.argmin(finite))}]: expected finite values, got NaN/inf.")
    bad = (_orthonormality_error(T[:, :3, :3]) > tolerance) | (
        np.abs(T[:, 3] - (0.0, 0.0, 0.0, 1.0)).max(axis=1) > tolerance
    )
    if bad.any():
        index = int(np.argmax(bad))
        raise InputError(
            f"{name}[{index}]: expected a rigid transform (rotation to {tolerance:g}, last row "
            f"0 0 0 1), got {np.array2string(T[index], precision=6, separator=', ')}."
        )
    return T


def _check_timestamps(timestamps: Any) -> np.ndarray:
    """(N,) float64 copy of strictly increasing, finite stamps in seconds, or InputError."""
    name = "Trajectory.timestamps"
    try:
        stamps = np.array(timestamps, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected numbers in seconds.") from None
    if stamps.ndim != 1:
        raise InputError(f"{name}: expected shape (N,), got {stamps.shape}.")
    if not np.isfinite(stamps).all():
        raise InputError(
            f"{name}[{int(np.argmin(np.isfinite(stamps)))}]: expected a finite number."
        )
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if len(late):
        before, after = stamps[late[0] : late[0] + 2].tolist()
        raise InputError(
            f"{name}[{late[0] + 1}]: expected strictly increasing stamps, got {after} after "
            f"{before}. Sort the poses and drop duplicates."
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
    text = io.StringIO()
    write_tum_trajectory_file(
        text, PoseTrajectory3D(trajectory.positions, xyzw_to_wxyz(xyzw), trajectory.timestamps)
    )
    with atomic_write(path) as file:
        file.write(text.getvalue())


def write_kitti(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Write the first three rows of each camera-to-world pose, see ``Trajectory.save``."""
    from evo.core.trajectory import PosePath3D
    from evo.tools.file_interface import write_kitti_poses_file

    text = io.StringIO()
    write_kitti_poses_file(text, PosePath3D(poses_se3=list(trajectory.T_world_cam)))
    with atomic_write(path) as file:
        file.write(text.getvalue())


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(f"{path}: expected a text file of poses, got binary data.") from None
    except FileNotFoundError:
        raise InputError(f"{path}: no such trajectory file.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: trajectory file cannot be read: {error}.") from None


def _read_rows(path: Path, format: str) -> tuple[str, np.ndarray, list[int]]:
    """Format, (N, columns) finite numbers and the line number of each row."""
    by_count = {count: known for known, (count, _) in _COLUMNS.items()}
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(_read_text(path).split("\n"), start=1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        if format == "auto":
            if len(fields) not in by_count:
                raise FormatError(
                    f"{path}:{number}: expected 8 numbers (TUM), 12 (KITTI) or 7 (TartanAir) "
                    f"separated by spaces, got {len(fields)}."
                )
            format = by_count[len(fields)]
        count, names = _COLUMNS[format]
        expected = f"{path}:{number}: expected {count} numbers '{names}'"
        if len(fields) != count:
            raise FormatError(f"{expected}, got {len(fields)}.")
        try:
            row = [float(field) for field in fields]
        except ValueError:
            raise FormatError(f"{expected}, got {line.strip()[:80]!r}.") from None
        if not np.isfinite(row).all():
            raise FormatError(
                f"{path}:{number}: expected finite numbers '{names}', got NaN or inf. Remove the "
                f"line: a pose that is not known must not be in the file."
            )
        rows.append(row)
        lines.append(number)
    if not rows:
        raise FormatError(f"{path}: expected at least one pose, got none.")
    return format, np.array(rows), lines


def _quaternions_to_matrices(path: Path, xyzw: np.ndarray, lines: list[int]) -> np.ndarray:
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(xyzw, axis=1)
    bad = np.abs(norms - 1.0) > _QUATERNION_NORM_TOLERANCE
    if bad.any():
        index = int(np.argmax(bad))
        got = "all zeros" if norms[index] == 0 else f"norm {norms[index]:.6g}"
        raise FormatError(
            f"{path}:{lines[index]}: expected a unit quaternion qx qy qz qw, got {got}."
        )
    return Rotation.from_quat(xyzw).as_matrix()


def _to_seconds(path: Path, stamps: np.ndarray, lines: list[int]) -> tuple[np.ndarray, list[str]]:
    """Stamps in seconds, strictly increasing, and what was changed."""
    warnings = []
    far = np.abs(stamps) > MAX_SECONDS
    if far.any() and not far.all():
        line = lines[int(np.argmax(far != far[0]))]
        raise FormatError(f"{path}:{line}: timestamps mix seconds and nanoseconds.")
    factor, unit = stamp_unit(stamps)
    if factor != 1:
        stamps = stamps / factor
        warnings.append(f"{path}: timestamps are {unit}; converted to seconds.")
        _logger.warning(warnings[-1])
    steps = np.diff(stamps)
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0)) + 1
        kind = "repeats the one" if steps[index - 1] == 0 else "lies before that"
        raise FormatError(
            f"{path}:{lines[index]}: timestamp {float(stamps[index])!r} {kind} of line "
            f"{lines[index - 1]} ({float(stamps[index - 1])!r}). Stamps must increase: sort the "
            f"file and drop duplicates."
        )
    return stamps, warnings


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
    name, rows, lines = _read_rows(path, format)
    stamps = np.arange(len(rows), dtype=np.float64)
    warnings: list[str] = []
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    if name == "kitti":
        T[:, :3] = rows.reshape(-1, 3, 4)
        bad = _orthonormality_error(T[:, :3, :3]) > _FILE_ROTATION_TOLERANCE
        if bad.any():
            raise FormatError(
                f"{path}:{lines[int(np.argmax(bad))]}: expected a rotation in columns 1-3, 5-7 and "
                f"9-11, got a matrix that is not orthonormal to {_FILE_ROTATION_TOLERANCE:g}."
            )
        if _orthonormality_error(T[:, :3, :3]).max() > 1e-9:
            T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    else:
        if name == "tum":
            stamps, warnings = _to_seconds(path, rows[:, 0], lines)
        T[:, :3, :3] = _quaternions_to_matrices(path, rows[:, -4:], lines)
        T[:, :3, 3] = rows[:, -7:-4]
    if axes == "ned" or (axes == "auto" and name == "tartanair"):
        T = ned_to_camera(T)
    return Trajectory(stamps, T, has_timestamps=name == "tum", warnings=tuple(warnings))
