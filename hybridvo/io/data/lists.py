"""Lists of files, time stamps and poses, and which of their entries belong together."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import read_rows
from hybridvo.core.trajectory import (
    COLUMNS,
    check_increasing,
    read_poses,
    stamp_unit,
    to_seconds,
)
from hybridvo.io.calibration import MAX_STAMP_DIFFERENCE_S

IMAGES = (".png", ".jpg", ".jpeg")
"""Endings of the images that are read."""
PICTURES = (
    *IMAGES,
    ".bmp",
    ".tif",
    ".tiff",
    ".ppm",
    ".pgm",
    ".webp",
    ".heic",
    ".exr",
)
"""Endings of images, most of which are not read."""
RATE_IS_ASSUMED = "frames a second assumed"
"""What a warning says of a sequence without time stamps."""
ASSUMED_FPS = 30.0
"""That rate, unless a data set states another."""
MAX_FRAME_NUMBER = 10**12
"""Largest frame number in the name of a file."""
SORTED_DIGITS = 20
"""Digits to which numbers in names are padded, so that they sort by value."""
ABBREVIATED_COUNT = 8
"""Names that a message lists before it ends in dots."""
MAX_OTHER_FOLDERS = 3
"""Folders with images that a message names beside the one that was expected."""


def sorted_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """List the files of a folder with one of the suffixes, ``frame_9`` before ``frame_10``."""
    files = []
    for path in _entries(folder):
        is_hidden = path.name.startswith(".")
        if path.suffix.lower() in suffixes and not is_hidden:
            files.append(path)
    return sorted(files, key=by_number)


def by_number(path: Path) -> str:
    """Return a sort key of a file name, by which numbers in it sort by value."""
    return re.sub(
        "[0-9]+", lambda digits: digits[0].zfill(SORTED_DIGITS), path.name
    )


def _entries(folder: Path) -> Iterator[Path]:
    """Yield what lies in a folder; nothing if it is not there."""
    if folder.is_dir():
        yield from folder.iterdir()


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """List the files whose name matches a pattern, by the number in its first group.

    Args:
        folder: The folder, which may be missing.
        pattern: A regular expression for the whole name.

    Returns:
        The files by their number.

    Raises:
        InputError: A number is too large for a frame number.
    """
    files = {}
    for path in sorted(_entries(folder)):
        if match := re.fullmatch(pattern, path.name):
            files[int(match[1])] = path
    largest = max(files, default=0)
    if largest > MAX_FRAME_NUMBER:
        expected = f"a frame number of at most {MAX_FRAME_NUMBER}"
        raise InputError(f"{files[largest]}: expected {expected}.")
    return files


def listed_file(folder: Path, name: str, listed_in: object) -> Path:
    """Return the path of a file that a list names, if it lies below the sequence's folder.

    Links are followed first. The folder itself and the folders in it may be links to elsewhere, as
    whole data sets are linked; a file that is a link must stay inside.

    Args:
        folder: The folder of the sequence.
        name: The name of the file in the list, relative to the folder.
        listed_in: The list, for messages: its path, or ``path:line``.

    Raises:
        FormatError: The name is absolute or climbs by ``..``, a link leads outside, or no file
            can have such a name.
    """
    path = folder / name
    try:
        is_inside = _lies_below(folder, path)
    # absolute names, empty ones, NUL characters, links in a ring
    except (OSError, RuntimeError, ValueError, IndexError):
        is_inside = False
    if not is_inside:
        expected = "a file below the sequence's folder (links: whole folders only)"
        raise FormatError(f"{listed_in}: expected {expected}, got {name[:200]!r}.")
    return path


def _lies_below(folder: Path, path: Path) -> bool:
    """Return whether a path leads into a folder, or into a folder that is linked in it."""
    parts = path.relative_to(folder).parts
    if ".." in parts:
        return False
    allowed = [folder.resolve()]
    subfolder = folder / parts[0]
    if subfolder.is_dir():
        allowed.append(subfolder.resolve())
    resolved = path.resolve()
    return any(resolved.is_relative_to(place) for place in allowed)


def match_files(
    frames: Sequence[Path | None], files: list[Path], where: Path, hint: str
) -> list[Path | None]:
    """Find the file of each frame by equal names, else by order where the counts agree.

    Args:
        frames: The file that names each frame; None where a frame has none.
        files: The files to distribute.
        where: Their folder, for a message.
        hint: The remedy, for a message.

    Returns:
        A file for each frame, None where a frame has none.

    Raises:
        InputError: No name agrees, and the counts differ.
    """
    by_stem = {path.stem: path for path in files}
    matched = [by_stem.get(frame.stem) if frame else None for frame in frames]
    if any(matched):
        return matched
    if len(files) != len(frames):
        counts = f"{len(files)} files for {len(frames)} frames"
        raise InputError(f"{where}: {counts}, and no name agrees. {hint}")
    return [*files]


def images_elsewhere(root: Path, wanted: str) -> str:
    """Describe where a folder has its images, for a message that misses them.

    Args:
        root: The folder of the sequence.
        wanted: The name of the folder in it in which images are expected.
    """
    used = {wanted, "rgb", "depth", "mask", "flow"}
    others = []
    for path in sorted(root.iterdir()):
        if path.is_dir() and path.name not in used and _has_images(path):
            others.append(f"there is {path.name}/ with images")
    if _has_images(root):
        others.append(f"{root.name}/ itself holds images")
    content = _content_of(root / wanted)
    return "; ".join((content, *others[:MAX_OTHER_FOLDERS]))


def _content_of(folder: Path) -> str:
    """Count the files of a folder by their endings, for a message."""
    if not folder.is_dir():
        return f"there is no {folder.name}/"
    endings = Counter(
        path.suffix.lower() for path in folder.iterdir() if path.is_file()
    )
    if not endings:
        return f"{folder.name}/ is empty"
    kinds = [
        f"{count} {ending or 'nameless'}"
        for ending, count in endings.most_common(3)
    ]
    return f"{folder.name}/ holds {' and '.join(kinds)} files"


def _has_images(folder: Path) -> bool:
    """Return whether a folder holds images of any kind."""
    return any(path.suffix.lower() in PICTURES for path in folder.iterdir())


def abbreviated(names: Sequence[object]) -> str:
    """Return the first names of a list, for a message.

    Example:
        >>> abbreviated(["rgb", "depth"])
        'rgb, depth'
        >>> abbreviated(range(20))
        '0, 1, 2, 3, 4, 5, 6, 7, ...'
    """
    text = ", ".join(map(str, names[:ABBREVIATED_COUNT]))
    return f"{text}, ..." if len(names) > ABBREVIATED_COUNT else text


def assumed_rate(rate: float) -> str:
    """Describe a rate that takes the place of time stamps, for a warning.

    Args:
        rate: Frames a second.

    Returns:
        Words without a full stop, which name the remedy.
    """
    return f"{rate:.4g} {RATE_IS_ASSUMED}; else give --fps"


def read_stamps_of(
    files: Sequence[Any] | np.ndarray, path: Path, warnings: list[str]
) -> np.ndarray:
    """Read a list of time stamps, one for each of some files or frames.

    Args:
        files: The files, in the order of the list.
        path: The list.
        warnings: Gets a sentence if the stamps are not in seconds.

    Returns:
        (N,) stamps, seconds.

    Raises:
        InputError: There are more stamps than files, or fewer.
    """
    stamps, _ = read_stamps(path, warnings)
    if len(stamps) != len(files):
        raise InputError(
            f"{path}: {len(stamps)} stamps for {len(files)} files: expected a line for each."
        )
    return stamps


def known_stamps(
    files: Sequence[Path], path: Path, warnings: list[str]
) -> np.ndarray | None:
    """Return the stamps of files, s, from a list if it exists, else from their names.

    Returns:
        (N,) seconds; None where there is no list, and the names only count the files.
    """
    if path.exists():
        return read_stamps_of(files, path, warnings)
    names = np.array([as_number(file.stem) for file in files])
    if not np.isfinite(names).all():
        return None
    has_points = all("." in file.stem for file in files)
    if not has_points and stamp_unit(names)[0] == 1:
        return None
    return to_seconds(names, f"{files[0].parent.name}/ (file names)", warnings)


def stamps_of_files(
    root: Path, files: Sequence[Path], fps: float | None, warnings: list[str]
) -> np.ndarray:
    """Return the stamps of files, s: of ``timestamps.txt``, of their names, or counted.

    Args:
        root: The folder in which ``timestamps.txt`` may be.
        files: The files in their order.
        fps: Files a second where nothing states their times; by default 30, with a warning.
        warnings: Gets sentences about what was assumed.
    """
    stamps = known_stamps(files, root / "timestamps.txt", warnings)
    if stamps is not None:
        return stamps
    if fps is None:
        fps = ASSUMED_FPS
        warnings.append(f"{root.name}: no time stamps; {assumed_rate(fps)}.")
    return np.arange(len(files)) / fps


def read_stamps(
    path: Path, warnings: list[str], columns: str = "stamp", words: int = 0
) -> tuple[np.ndarray, list[list[str]]]:
    """Read a list whose first column holds time stamps.

    Args:
        path: The file.
        warnings: Gets a sentence if the stamps are not in seconds.
        columns: The names of its columns, separated by spaces.
        words: How many of the last columns hold text.

    Returns:
        The stamps (N,), seconds, and the texts of each row.
    """
    rows = read_rows(path, columns, words=words)
    stamps = to_seconds(rows.numbers[:, 0], path.name, warnings)
    return stamps, rows.words


def numbered_poses(numbers: Sequence[int], stored: np.ndarray) -> np.ndarray:
    """Return the stored pose of each frame number, NaN beyond the last one.

    Args:
        numbers: N frame numbers.
        stored: (M, 4, 4) the pose of frame 0, 1, and so on.

    Returns:
        (N, 4, 4) the pose of each frame.
    """
    unknown = np.full((1, 4, 4), np.nan)
    padded = np.concatenate([stored, unknown])
    places = np.minimum(numbers, len(stored)).astype(int)
    return padded[places]


def read_timed_poses(
    path: Path, warnings: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Read stamps (N,), seconds, and poses (N, 4, 4) from a list ``timestamp tx .. qw``."""
    rows, poses = read_poses(path, COLUMNS["tum"])
    return to_seconds(rows.numbers[:, 0], path.name, warnings), poses


def poses_at(
    stamps: np.ndarray,
    pose_stamps: np.ndarray,
    poses: np.ndarray,
    where: Path,
    warnings: list[str],
) -> np.ndarray:
    """Return the pose with the nearest stamp for each frame.

    Args:
        stamps: (N,) seconds, of the frames.
        pose_stamps: (M,) seconds, of the poses.
        poses: (M, 4, 4) T_world_cam.
        where: The file of the poses, for a warning.
        warnings: Gets a sentence where no pose belongs to a frame.

    Returns:
        (N, 4, 4) T_world_cam, NaN where no stamp is within ``MAX_STAMP_DIFFERENCE_S``.
    """
    matched = np.full((len(stamps), 4, 4), np.nan)
    pairs = associate(stamps, pose_stamps)
    for i, j in pairs:
        matched[i] = poses[j]
    known = pose_stamps[np.isfinite(pose_stamps)]
    if len(known) and len(stamps) and not pairs:
        reason = _why_unmatched(stamps, known)
        warnings.append(f"{where}: no pose belongs to a frame: {reason}.")
    return matched


def _why_unmatched(stamps: np.ndarray, pose_stamps: np.ndarray) -> str:
    """Explain why no pose has the stamp of a frame."""
    first = stamps.min()
    last = stamps.max()
    first_pose = pose_stamps.min()
    last_pose = pose_stamps.max()
    distance = max(first_pose - last, first - last_pose)
    if distance <= 0:
        nearest = np.abs(stamps[:, None] - pose_stamps[None]).min()
        return f"the nearest is {nearest:.3g} s away, {MAX_STAMP_DIFFERENCE_S} s are allowed"
    return (
        f"the stamps do not overlap, they are {distance:.6g} s apart "
        f"(frames from {first:.9g} to {last:.9g} s, "
        f"poses from {first_pose:.9g} to {last_pose:.9g} s). Of the same clock and unit?"
    )


def depth_at(
    stamps: np.ndarray, depth_stamps: np.ndarray, where: Path, warnings: list[str]
) -> list[tuple[int, int]]:
    """Match colour images and depth maps by time; colour without depth is left out.

    Args:
        stamps: (N,) seconds, of the colour images.
        depth_stamps: (M,) seconds, of the depth maps.
        where: The list of the colour images, for messages.
        warnings: Gets a sentence where images are left out.

    Returns:
        Pairs (i, j) of an image and its depth map, sorted by i.

    Raises:
        InputError: No image has a depth map, or the stamps do not increase.
    """
    check_increasing(stamps[np.isfinite(stamps)], str(where))
    pairs = associate(stamps, depth_stamps)
    count = len(stamps)
    limit = MAX_STAMP_DIFFERENCE_S
    if count and not pairs:
        problem = (
            f"none of {count} colour stamps has a depth stamp within {limit} s"
        )
        raise InputError(
            f"{where}: no frames: {problem}{_offset(stamps, depth_stamps)}. Of the same unit and "
            "the same clock?"
        )
    if len(pairs) < count:
        left_out = f"{count - len(pairs)} of {count} colour images have no depth within {limit} s"
        warnings.append(f"{where.name}: {left_out} and are left out.")
    return pairs


def _offset(stamps: np.ndarray, depth_stamps: np.ndarray) -> str:
    """State by how much depth comes after colour, for a message; empty without depth."""
    known = depth_stamps[np.isfinite(depth_stamps)]
    if not len(known):
        return ", there is none"
    offset = float(np.median(known) - np.median(stamps[np.isfinite(stamps)]))
    order = "after" if offset > 0 else "before"
    return f": depth comes {abs(offset):.4g} s {order} colour, by the medians of the stamps"


def associate(
    first: np.ndarray, second: np.ndarray, tolerance: float = MAX_STAMP_DIFFERENCE_S
) -> list[tuple[int, int]]:
    """Match time stamps one to one, the smallest differences first, as the TUM tools do it.

    evo's association is not one to one: it would give two images the same depth map.

    Args:
        first: (N,) seconds.
        second: (M,) seconds.
        tolerance: Differences must be smaller than this, seconds.

    Returns:
        Pairs (i, j), sorted by i.

    Example:
        >>> associate(np.array([0.0, 1.0]), np.array([0.01, 0.5, 1.001]))
        [(0, 0), (1, 2)]
    """
    candidates = []
    for i, j in _near_pairs(first, second, tolerance):
        difference = abs(first[i] - second[j])
        if difference < tolerance:
            candidates.append((difference, i, j))
    partner_of_first: dict[int, int] = {}
    used_second: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in partner_of_first and j not in used_second:
            partner_of_first[i] = j
            used_second.add(j)
    return sorted(partner_of_first.items())


def _near_pairs(
    first: np.ndarray, second: np.ndarray, tolerance: float
) -> Iterator[tuple[int, int]]:
    """Yield the places of all pairs of stamps that differ by about the tolerance or less."""
    order = np.argsort(second, kind="stable")
    begins = np.searchsorted(second, first - tolerance, sorter=order)
    ends = np.searchsorted(second, first + tolerance, sorter=order)
    for i, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        for j in order[begin:end]:
            yield i, int(j)
