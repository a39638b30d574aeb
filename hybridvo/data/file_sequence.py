"""What all readers of sequences on disk share: lists of files in, checked frames out."""

from __future__ import annotations

import contextlib
import itertools
import math
import re
from collections.abc import Iterator
from collections.abc import Sequence as Many
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.checks import stamp_unit
from hybridvo.data.image_io import image_size, read_rgb, read_text
from hybridvo.errors import FormatError, InputError
from hybridvo.types import Camera, Frame

__all__ = [
    "FileSequence",
    "associate",
    "check_pose",
    "depth_unit_notice",
    "gap_notice",
    "natural_key",
    "numbered_files",
    "poses_from_rows",
    "read_rows",
    "resolve_inside",
    "sorted_files",
    "to_seconds",
]

ASSOCIATION_TOLERANCE = 0.02
"""Largest difference in seconds between stamps that belong together (the TUM tools' value)."""
MOST_CANDIDATES = 64
"""Partners within the tolerance that a stamp may have on average: truth at 3 kHz has fewer."""
LARGEST_POSITION = 1e12
"""Metres; no position is larger, and squares of it are finite."""
PLAUSIBLE_DEPTH = (0.1, 200.0)
SKY_DEPTH = 1000.0


class FileSequence:
    """Frames that lie in files; a reader says which files, and how depth and flow are decoded.

    A subclass fills in the lists and overrides ``camera`` and the ``_read_*`` methods. Files are
    opened when a frame is asked for, and only the headers of the images before.

    Args:
        root: folder of the sequence. name: what reports call it.
        rgb, depth: one path or None per frame. flow: one path or None per frame (index to index+1).
        timestamps: (N,) seconds. poses: (N, 4, 4) T_world_cam, NaN rows unknown, or None.
        sources: further files that were read (lists, calibration, truth).
        notices: what the user should know.
        strict: trailing bytes in a file are errors.

    Raises:
        InputError: no frames, stamps that do not increase, frames of different sizes.
        FormatError: no image can be read at all.
    """

    kind = "files"
    depth_source = "sensor"
    flow_is_true = False

    def __init__(
        self,
        root: Path,
        name: str,
        *,
        rgb: Many[Path | None],
        depth: Many[Path | None],
        flow: Many[Path | None] = (),
        timestamps: np.ndarray,
        poses: np.ndarray | None = None,
        sources: Many[Path] = (),
        notices: Many[str] = (),
        strict: bool = False,
    ) -> None:
        self.root = Path(root)
        self.name = name
        self.strict = strict
        self.rgb_files = list(rgb)
        self.depth_files = list(depth)
        self.flow_files = (list(flow) + [None] * len(self.rgb_files))[: len(self.rgb_files)]
        self.timestamps = np.asarray(timestamps, dtype=np.float64)
        self.poses = poses
        self.sources = [Path(path) for path in sources]
        self._notices = list(notices)
        self._check_timestamps()
        self.height, self.width = self._check_sizes()
        self._notices += self._missing_notices()

    @property
    def notices(self) -> tuple[str, ...]:
        """Things the user should know: converted stamps, gaps, missing files, doubtful units."""
        return tuple(self._notices)

    @property
    def has_flow(self) -> bool:
        """Whether there is at least one flow file."""
        return any(path is not None for path in self.flow_files)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        return f"<{self.kind} sequence {self.name!r}: {len(self)} frames>"

    def camera(self, index: int) -> Camera:
        """Pinhole camera of frame ``index``."""
        raise NotImplementedError

    def frame(self, index: int) -> Frame:
        """Frame ``index``; ``rgb`` or ``depth`` is None where its file is missing.

        Raises:
            IndexError: no such index. FileNotFoundError: neither image nor depth is there.
            FormatError: a file cannot be decoded. InputError: an image of another size.
        """
        index = self._check_index(index)
        camera = self.camera(index)
        rgb_path, depth_path = self.rgb_files[index], self.depth_files[index]
        rgb = self._read_or_none(rgb_path, index, None)
        depth = self._read_or_none(depth_path, index, rgb, depth=True)
        if rgb is None and depth is None:
            raise FileNotFoundError(
                f"{self.name}: frame {index}: neither image nor depth is there "
                f"({rgb_path or 'no image path'}, {depth_path or 'no depth path'})."
            )
        for array, path in ((rgb, rgb_path), (depth, depth_path)):
            if array is not None and array.shape[:2] != camera.shape:
                raise InputError(
                    f"{path}: frame {index} of {self.name}: expected {camera.width}x"
                    f"{camera.height} pixels as in the other frames, got {array.shape[1]}x"
                    f"{array.shape[0]}. Resize the sequence to one size."
                )
        rgb, depth, mask = self._rectify(rgb, depth)
        variance = None if depth is None else self._depth_variance(depth)
        return Frame(rgb, depth, camera, float(self.timestamps[index]), index, variance, mask)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Flow from frame ``index`` to the next: (H, W, 2) float32 px, and (H, W) bool or None.

        Raises:
            IndexError: no such pair. FileNotFoundError: no flow file for it.
            FormatError: the file cannot be decoded or has another size.
        """
        index = self._check_index(index)
        path = self.flow_files[index]
        if index == len(self) - 1:
            raise IndexError(f"{self.name}: frame {index} is the last, no flow starts there.")
        if path is None:
            raise FileNotFoundError(
                f"{self.name}: there is no flow file from frame {index} to {index + 1}."
            )
        flow, valid = self._read_flow(path, index)
        self._check_shape(flow, path, "flow")
        return flow, valid

    def files(self) -> list[Path]:
        """Every existing file that the sequence reads, sorted: what an input hash covers."""
        lists = (self.sources, self.rgb_files, self.depth_files, self.flow_files[:-1])
        found = {path for paths in lists for path in paths if path is not None}
        return sorted(path for path in found if path.is_file())  # no pipe: hashing it would block

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        raise NotImplementedError

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        raise NotImplementedError

    def _rectify(
        self, rgb: np.ndarray | None, depth: np.ndarray | None
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Image, depth and mask without lens distortion; nothing to do for pinhole data."""
        return rgb, depth, None

    def _depth_variance(self, depth: np.ndarray) -> np.ndarray | None:
        """Variance of log depth, where the source allows to state one."""
        return None

    def _read_or_none(
        self, path: Path | None, index: int, rgb: np.ndarray | None, depth: bool = False
    ) -> np.ndarray | None:
        if path is None:
            return None
        try:
            return self._read_depth(path, index, rgb) if depth else read_rgb(path)
        except FileNotFoundError:
            return None

    def _check_shape(self, array: np.ndarray, path: Path, what: str) -> None:
        if array.shape[:2] != (self.height, self.width):
            raise FormatError(
                f"{path}: expected {what} of {self.width}x{self.height} pixels as the frames have, "
                f"got {array.shape[1]}x{array.shape[0]}. Resize the whole sequence to one size."
            )

    def _check_index(self, index: int) -> int:
        if not 0 <= int(index) < len(self):
            raise IndexError(f"{self.name}: expected a frame 0 to {len(self) - 1}, got {index}.")
        return int(index)

    def _check_timestamps(self) -> None:
        if len(self.timestamps) == 0:
            raise InputError(f"{self.root}: no frames.")
        if not np.isfinite(self.timestamps).all():
            bad = int(np.flatnonzero(~np.isfinite(self.timestamps))[0])
            raise InputError(f"{self.root}: the timestamp of frame {bad} is not finite.")
        steps = np.diff(self.timestamps)
        if (steps <= 0).any():
            i = int(np.flatnonzero(steps <= 0)[0])
            raise InputError(
                f"{self.root}: timestamps must increase: frame {i} has "
                f"{float(self.timestamps[i])!r}, frame {i + 1} has "
                f"{float(self.timestamps[i + 1])!r}. Sort the list and remove duplicates; hybridvo "
                f"does not guess which order was meant."
            )

    def _check_sizes(self) -> tuple[int, int]:
        """(height, width) from the headers; an unreadable file is left for ``frame`` to report."""
        first: tuple[int, tuple[int, int]] | None = None
        error: Exception | None = None
        for index, (rgb, depth) in enumerate(zip(self.rgb_files, self.depth_files, strict=True)):
            path = rgb if rgb is not None and rgb.exists() else depth
            if path is None:
                continue
            try:
                size = image_size(path)
            except (FormatError, OSError) as problem:
                error = error or problem
                continue
            if first is None:
                first = (index, size)
            elif size != first[1]:
                raise InputError(
                    f"{path}: frame {index} is {size[1]}x{size[0]}, frame {first[0]} is "
                    f"{first[1][1]}x{first[1][0]} pixels (width x height). All frames of a "
                    f"sequence must have one size; resize them first."
                )
        if first is None:
            raise FormatError(f"{self.root}: no frame can be read. First problem: {error}")
        return first[1]

    def _missing_notices(self) -> list[str]:
        notices = []
        for what, paths in (("image", self.rgb_files), ("depth", self.depth_files)):
            missing = [i for i, path in enumerate(paths) if path is None or not path.exists()]
            if len(missing) == len(paths):
                named = next((path for path in paths if path is not None), None)
                like = f", such as {named}" if named else ""
                notices.append(f"{self.name}: there are no {what} files{like}.")
            elif missing:
                shown = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
                notices.append(f"{self.name}: {len(missing)} frames without {what}: {shown}.")
        return notices

    def _notice_depth_units(self) -> None:
        """Look at the first depth map that can be read, and say so if its units are doubtful."""
        for index, path in enumerate(self.depth_files):
            if path is not None and path.exists():
                try:
                    depth = self._read_depth(path, index, None)
                except (FormatError, OSError):
                    return
                notice = depth_unit_notice(depth)
                if notice:
                    self._notices.append(f"{path}: {notice}")
                return


def natural_key(path: Path | str) -> list[str | int]:
    """Sort key under which ``frame_9`` comes before ``frame_10``."""
    name = path.name if isinstance(path, Path) else path
    parts = re.split(r"([0-9]+)", name)  # text, digits, text, ...
    return [int(part) if k % 2 else part for k, part in enumerate(parts)]


def sorted_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of a folder with one of the suffixes, in natural order; empty if there is no folder."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file()]
    return sorted((p for p in found if not p.name.startswith(".")), key=natural_key)


def numbered_files(folder: Path | None, pattern: str) -> dict[int, Path]:
    """Files whose whole name matches a regular expression, by the number in its first group.

    Raises:
        InputError: two files of one number.
    """
    if folder is None or not folder.is_dir():
        return {}
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if match := re.fullmatch(pattern, path.name):
            other = found.setdefault(int(match[1]), path)
            if other is not path:
                raise InputError(
                    f"{folder}: {other.name} and {path.name} are two files of one frame. Keep one."
                )
    return found


def gap_notice(name: str, numbers: Many[int]) -> list[str]:
    """Notice of frame numbers that are missing between the first and the last."""
    spans = [
        f"{a + 1}" if b - a == 2 else f"{a + 1} to {b - 1}"
        for a, b in itertools.pairwise(numbers)
        if b - a > 1
    ]
    if not spans:
        return []
    shown = ", ".join(spans[:8]) + (", ..." if len(spans) > 8 else "")
    return [f"{name}: frame numbers {shown} are missing; the time stamps keep the gap."]


def resolve_inside(root: Path, name: str, allow_outside: bool, source: str) -> Path:
    """Path of a file that a list names, which must lie under the sequence's own folder.

    Raises:
        InputError: the resolved path (symbolic links followed) leaves ``root`` and
            ``allow_outside`` is False, or the name cannot be a path.
    """
    try:
        path = root / name
        resolved = path.resolve()
        inside = resolved.is_relative_to(root.resolve())
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            path.stat()  # raises for a loop of links, and for a name that the system cannot hold
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{source}: {name!r} is not a usable file name ({error}).") from None
    if not inside and not allow_outside:
        raise InputError(
            f"{source}: {name!r} leads out of the sequence folder {root}. "
            f"If that is meant, open the sequence with allow_outside=True."
        )
    return path


def read_rows(path: Path, columns: str, *, text_columns: int = 0) -> list[tuple]:
    """Rows of a list file: numbers, then ``text_columns`` strings; ``#`` starts a comment line.

    Args:
        path: file to read.
        columns: names of the columns, for the error message; their number is what a row must have.
        text_columns: how many of the last columns are text (the last may contain spaces).

    Raises:
        FormatError: a row of another length or a number that cannot be read, with its line number.
    """
    names = columns.split()
    rows: list[tuple] = []
    for number, line in enumerate(_lines(read_text(path)), start=1):
        line = line.replace(",", " ").strip() if not text_columns else line.strip()
        if not line or line.startswith("#"):
            continue
        parts = line.split(maxsplit=len(names) - 1) if text_columns else line.split()
        if len(parts) != len(names):
            raise FormatError(
                f"{path}:{number}: expected {len(names)} columns '{columns}', got {len(parts)}."
            )
        split = len(names) - text_columns
        try:
            rows.append((*map(float, parts[:split]), *parts[split:]))
        except ValueError:
            raise FormatError(
                f"{path}:{number}: expected numbers for '{' '.join(names[:split])}', "
                f"got {line[:80]!r}."
            ) from None
    return rows


def _lines(text: str) -> Iterator[str]:
    """Lines one at a time: a list of all would take thirty times the file's size."""
    start = 0
    while start <= len(text):
        end = text.find("\n", start)
        end = len(text) if end < 0 else end
        yield text[start:end]
        start = end + 1


def to_seconds(stamps: Many[float] | np.ndarray, name: str) -> tuple[np.ndarray, list[str]]:
    """Stamps in seconds, other units converted with a notice; what is not finite becomes NaN."""
    values = np.array(stamps, dtype=np.float64)
    values[~np.isfinite(values)] = np.nan
    factor, unit = stamp_unit(values)
    told = [f"{name}: stamps are {unit}; converted to seconds."]
    return values / factor, told if factor != 1 else []


def poses_from_rows(rows: np.ndarray, source: str) -> np.ndarray:
    """(N, 4, 4) transforms from (N, 7) rows ``tx ty tz qx qy qz qw``; NaN rows stay NaN.

    Raises:
        FormatError: a quaternion whose norm is not 1 to within 1 %, or a position beyond 1e12 m.
    """
    rows = np.asarray(rows, dtype=np.float64).reshape(-1, 7)
    poses = np.full((len(rows), 4, 4), np.nan)
    finite = np.isfinite(rows).all(axis=1)
    far = finite & (np.abs(rows[:, :3]) > LARGEST_POSITION).any(axis=1)
    if far.any():
        i = int(np.flatnonzero(far)[0])
        raise FormatError(f"{source}: pose {i}: expected metres, got {rows[i, :3]}.")
    norms = np.linalg.norm(rows[:, 3:].clip(-2, 2), axis=1)
    wrong = finite & ~(np.abs(norms - 1) < 0.01)
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise FormatError(
            f"{source}: pose {i}: expected a unit quaternion qx qy qz qw, got {rows[i, 3:]} "
            f"of norm {norms[i]:.4g}."
        )
    if finite.any():
        poses[finite] = np.eye(4)
        poses[finite, :3, :3] = Rotation.from_quat(rows[finite, 3:]).as_matrix()
        poses[finite, :3, 3] = rows[finite, :3]
    return poses


def check_pose(T: np.ndarray, where: str) -> None:
    """Refuse a (4, 4) T_world_cam of a file whose rotation is none to 1 %, or that lies too far.

    Raises:
        FormatError: such a pose.
    """
    R = T[:3, :3]
    if np.abs(R).max() > 2 or np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise FormatError(f"{where}: expected a rotation, got {R.tolist()}.")
    if np.abs(T[:3, 3]).max() > LARGEST_POSITION:
        raise FormatError(f"{where}: expected a position in metres, got {T[:3, 3].tolist()}.")


def associate(
    first: np.ndarray, second: np.ndarray, tolerance: float = ASSOCIATION_TOLERANCE
) -> list[tuple[int, int]]:
    """Pairs (i, j) of stamps in seconds that belong together, one to one, sorted by i.

    Greedy by the smallest difference, which must be below ``tolerance``, as the TUM tools do it.
    Neither list needs to be sorted; stamps that are not finite have no partner.

    Raises:
        InputError: stamps so close together, or so often repeated, that nearly all fit all.
    """
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    rows, columns = np.flatnonzero(np.isfinite(first)), np.flatnonzero(np.isfinite(second))
    columns = columns[np.argsort(second[columns], kind="stable")]
    low = np.searchsorted(second[columns], first[rows] - tolerance, side="left")
    high = np.searchsorted(second[columns], first[rows] + tolerance, side="right")
    count = np.maximum(high - low, 0)
    if count.sum() > MOST_CANDIDATES * (len(first) + len(second)):
        raise InputError(
            f"{count.sum()} pairs of stamps lie within {tolerance} s of each other, for "
            f"{len(first)} and {len(second)} stamps: expected few. Are the stamps seconds, and is "
            f"each there once?"
        )
    i = np.repeat(rows, count)
    j = columns[np.arange(len(i)) + np.repeat(low - np.cumsum(count) + count, count)]
    difference = np.abs(first[i] - second[j])
    near = np.flatnonzero(difference < tolerance)
    near = near[np.lexsort((j[near], i[near], difference[near]))]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for row, column in zip(i[near].tolist(), j[near].tolist(), strict=True):
        if row not in pairs and column not in taken:
            pairs[row] = column
            taken.add(column)
    return sorted(pairs.items())


def depth_unit_notice(depth: np.ndarray) -> str:
    """Sentence for the user when the median depth cannot be metres, with the probable factor.

    Values above 1000 m count as sky unless there is nothing else. An empty string means plausible.
    """
    values = depth[np.isfinite(depth) & (depth > 0)]
    near = values[values <= SKY_DEPTH]
    values = near if near.size else values
    if values.size == 0:
        return "the first depth map has no valid value."
    median = float(np.median(values))
    low, high = PLAUSIBLE_DEPTH
    if low <= median <= high:
        return ""
    # The factor that brings the median nearest to an everyday 3 m, among those that occur.
    factors = (1 / 5000, 1 / 1000, 1 / 256, 1 / 100, 5, 100, 1000, 5000)
    factor = min(factors, key=lambda f: abs(math.log(median * f / 3.0)))
    advice = f"divide by {round(1 / factor)}" if factor < 1 else f"multiply by {round(factor)}"
    return (
        f"median depth {median:.4g} m is outside {low} to {high} m; depth must be in metres. "
        f"Probable remedy: {advice}{' (millimetres)' if factor == 1 / 1000 else ''}."
    )
