"""Lists of files, stamps and poses, and which of them belong together."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybridvo.errors import FormatError, InputError
from hybridvo.files import read_rows
from hybridvo.trajectory import COLUMNS, check_increasing, read_poses, to_seconds

IMAGES = (".png", ".jpg", ".jpeg")
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
# between stamps that belong together: the TUM tools' value
MAX_STAMP_DIFFERENCE_S = 0.02
LARGEST_NUMBER = 10**12  # of a frame, in a file's name


def sorted_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """List the files of a folder with one of the suffixes, ``frame_9`` before ``frame_10``."""
    inside = folder.iterdir() if folder.is_dir() else ()
    found = (
        p
        for p in inside
        if p.suffix.lower() in suffixes and not p.name.startswith(".")
    )
    return sorted(
        found,
        key=lambda p: re.sub("[0-9]+", lambda digits: digits[0].zfill(20), p.name),
    )


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """List the files whose name matches a pattern, by the number in the pattern's first group."""
    inside = sorted(folder.iterdir()) if folder.is_dir() else ()
    matches = ((re.fullmatch(pattern, path.name), path) for path in inside)
    found = {int(match[1]): path for match, path in matches if match}
    if found and (largest := max(found)) > LARGEST_NUMBER:
        expected = f"a frame number of at most {LARGEST_NUMBER}"
        raise InputError(f"{found[largest]}: expected {expected}.")
    return found


def listed_file(folder: Path, name: str, listed_in: Path) -> Path:
    """Return the path of a file that a list names, if it lies below the sequence's folder.

    Links are followed first. The folder itself and the folders in it may be links to elsewhere, as
    whole data sets are linked; a file that is a link must stay inside.

    Raises:
        FormatError: The name is absolute or climbs by ``..``, a link leads outside, or no file
            can have such a name.
    """
    path = folder / name
    try:
        inside = [folder.resolve()]
        if (own := folder / path.relative_to(folder).parts[0]).is_dir():
            inside.append(own.resolve())
        climbs = ".." in path.relative_to(folder).parts
        resolved = path.resolve()
    # absolute, empty, NUL, links in a ring
    except (OSError, RuntimeError, ValueError, IndexError):
        climbs = True
    if climbs or not any(resolved.is_relative_to(place) for place in inside):
        expected = "a file below the sequence's folder (links: whole folders only)"
        raise FormatError(f"{listed_in}: expected {expected}, got {name[:200]!r}.")
    return path


def match_files(
    frames: Sequence[Path | None], files: list[Path], where: Path, hint: str
) -> list[Path | None]:
    """Find the file of each frame by equal names, else by order where the counts agree."""
    by_stem = {path.stem: path for path in files}
    found = [by_stem.get(frame.stem) if frame else None for frame in frames]
    if any(found):
        return found
    if len(files) != len(frames):
        counts = f"{len(files)} files for {len(frames)} frames"
        raise InputError(f"{where}: {counts}, and no name agrees. {hint}")
    return [*files]


def images_elsewhere(root: Path, wanted: str) -> str:
    """Say where a folder has its images, if not in the folder that is wanted: for a message."""
    folder = root / wanted
    if folder.is_dir():
        endings = Counter(
            path.suffix.lower() for path in folder.iterdir() if path.is_file()
        )
        kinds = [
            f"{count} {ending or 'nameless'}"
            for ending, count in endings.most_common(3)
        ]
        own = (
            f"{wanted}/ holds {' and '.join(kinds)} files"
            if kinds
            else f"{wanted}/ is empty"
        )
    else:
        own = f"there is no {wanted}/"
    taken = {wanted, "rgb", "depth", "mask", "flow"}
    others = [
        path
        for path in sorted(root.iterdir())
        if path.is_dir() and path.name not in taken
    ]
    found = [
        f"there is {path.name}/ with images" for path in others if _has_images(path)
    ]
    found += [f"{root.name}/ itself holds images"] if _has_images(root) else []
    return "; ".join((own, *found[:3]))


def _has_images(folder: Path) -> bool:
    return any(path.suffix.lower() in PICTURES for path in folder.iterdir())


def shown(names: Sequence[object]) -> str:
    """Return the first eight names of a list, for a message."""
    return ", ".join(map(str, names[:8])) + (", ..." if len(names) > 8 else "")


def read_stamps(
    path: Path, warnings: list[str], columns: str = "stamp", words: int = 0
) -> tuple[np.ndarray, list[list[str]]]:
    """Read the stamps of a list, in seconds, and the words after each."""
    rows = read_rows(path, columns, words=words)
    return to_seconds(rows.numbers[:, 0], path.name, warnings), rows.words


def numbered_poses(numbers: Sequence[int], stored: np.ndarray) -> np.ndarray:
    """Return the stored pose of each frame number, (N, 4, 4), NaN beyond the last one."""
    padded = np.concatenate([stored, np.full((1, 4, 4), np.nan)])
    return padded[np.minimum(numbers, len(stored)).astype(int)]


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
    """Return the pose of the nearest stamp, (N, 4, 4), NaN where none is within 0.02 s.

    Args:
        stamps: (N,) seconds, of the frames.
        pose_stamps: (M,) seconds, of the poses.
        poses: (M, 4, 4) T_world_cam.
        where: The file of the poses, for a warning.
        warnings: Gets a sentence where no pose belongs to a frame.

    Returns:
        (N, 4, 4) T_world_cam, NaN where unknown.
    """
    matched = np.full((len(stamps), 4, 4), np.nan)
    pairs = associate(stamps, pose_stamps)
    for i, j in pairs:
        matched[i] = poses[j]
    known = pose_stamps[np.isfinite(pose_stamps)]
    if len(known) and len(stamps) and not pairs:
        warnings.append(
            f"{where}: no pose belongs to a frame: {_apart(stamps, known)}."
        )
    return matched


def _apart(stamps: np.ndarray, pose_stamps: np.ndarray) -> str:
    """Why no pose has the stamp of a frame."""
    first = stamps.min()
    last = stamps.max()
    gap = max(pose_stamps.min() - last, first - pose_stamps.max())
    if gap <= 0:
        nearest = np.abs(stamps[:, None] - np.sort(pose_stamps)[None]).min()
        return f"the nearest is {nearest:.3g} s away, {MAX_STAMP_DIFFERENCE_S} s are allowed"
    frames = f"frames from {first:.9g} to {last:.9g} s"
    truth = f"poses from {pose_stamps.min():.9g} to {pose_stamps.max():.9g} s"
    clocks = "Of the same clock and unit?"
    return f"the stamps do not overlap, they are {gap:.6g} s apart ({frames}, {truth}). {clocks}"


def depth_at(
    stamps: np.ndarray, depth_stamps: np.ndarray, where: Path, warnings: list[str]
) -> list[tuple[int, int]]:
    """Match colour and depth by time, as pairs (i, j); colour without depth is left out."""
    check_increasing(stamps[np.isfinite(stamps)], str(where))
    pairs = associate(stamps, depth_stamps)
    count = len(stamps)
    limit = MAX_STAMP_DIFFERENCE_S
    if count and not pairs:
        what = f"none of {count} colour stamps has a depth stamp within {limit} s"
        raise InputError(
            f"{where}: no frames: {what}. Of the same unit and the same clock?"
        )
    if len(pairs) < count:
        left_out = f"{count - len(pairs)} of {count} colour images have no depth within {limit} s"
        warnings.append(f"{where.name}: {left_out} and are left out.")
    return pairs


def associate(
    first: np.ndarray, second: np.ndarray, tolerance: float = MAX_STAMP_DIFFERENCE_S
) -> list[tuple[int, int]]:
    """Match stamps in seconds one to one, as pairs (i, j) sorted by i.

    The smallest difference is matched first, up to ``tolerance``, as the TUM tools do it.
    """
    order = np.argsort(second, kind="stable")
    low, high = (
        np.searchsorted(second, first + d, sorter=order)
        for d in (-tolerance, tolerance)
    )
    spans = enumerate(zip(low, high, strict=True))
    near = [
        (abs(first[i] - second[j]), i, int(j))
        for i, (a, b) in spans
        for j in order[a:b]
    ]
    partners: tuple[dict[int, int], dict[int, int]] = {}, {}
    for difference, i, j in sorted(near):
        if difference < tolerance and i not in partners[0] and j not in partners[1]:
            partners[0][i], partners[1][j] = j, i
    return sorted(partners[0].items())
