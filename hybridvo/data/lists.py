"""Lists on disk: numbered files, stamps, poses, and what belongs together by time."""

from __future__ import annotations

import re
from collections.abc import Sequence as Many
from pathlib import Path

import numpy as np

from hybridvo.errors import InputError
from hybridvo.files import read_rows
from hybridvo.trajectory import COLUMNS, check_increasing, read_poses, to_seconds

IMAGES = (".png", ".jpg", ".jpeg")
MAX_STAMP_DIFFERENCE_S = 0.02  # between stamps that belong together: the TUM tools' value


def sorted_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of a folder with one of the suffixes, ``frame_9`` before ``frame_10``."""
    inside = folder.iterdir() if folder.is_dir() else ()
    found = (p for p in inside if p.suffix.lower() in suffixes and not p.name.startswith("."))
    padded = lambda path: re.sub(r"[0-9]+", lambda digits: digits[0].zfill(20), path.name)  # noqa: E731
    return sorted(found, key=padded)


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Files whose whole name matches a regular expression, by the number in its first group."""
    inside = sorted(folder.iterdir()) if folder.is_dir() else ()
    matches = ((re.fullmatch(pattern, path.name), path) for path in inside)
    return {int(match[1]): path for match, path in matches if match}


def match_files(
    frames: Many[Path | None], files: list[Path], where: Path, hint: str
) -> list[Path | None]:
    """File of each frame: by equal names, else by order where the counts agree."""
    by_stem = {path.stem: path for path in files}
    found = [by_stem.get(frame.stem) if frame else None for frame in frames]
    if any(found):
        return found
    if len(files) != len(frames):
        counts = f"{len(files)} files for {len(frames)} frames"
        raise InputError(f"{where}: {counts}, and no name agrees. {hint}")
    return [*files]


def shown(names: Many[object], most: int = 8) -> str:
    """The first names of a list, for a message."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def read_stamps(
    path: Path, told: list[str], columns: str = "stamp", words: int = 0
) -> tuple[np.ndarray, list[list[str]]]:
    """Stamps in seconds of a list, and the words after each."""
    rows = read_rows(path, columns, words=words)
    return to_seconds(rows.numbers[:, 0], path.name, told), rows.words


def numbered_poses(numbers: Many[int], stored: np.ndarray) -> np.ndarray:
    """(N, 4, 4) stored pose of each frame number, NaN beyond the last."""
    padded = np.concatenate([stored, np.full((1, 4, 4), np.nan)])
    return padded[np.minimum(numbers, len(stored)).astype(int)]


def read_timed_poses(path: Path, told: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N,) in seconds and poses (N, 4, 4) of a list ``timestamp tx .. qw``."""
    rows, poses = read_poses(path, COLUMNS["tum"])
    return to_seconds(rows.numbers[:, 0], path.name, told), poses


def poses_at(stamps: np.ndarray, pose_stamps: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """(N, 4, 4) pose of the nearest stamp in seconds, NaN where none is near."""
    matched = np.full((len(stamps), 4, 4), np.nan)
    for i, j in associate(stamps, pose_stamps):
        matched[i] = poses[j]
    return matched


def depth_at(
    stamps: np.ndarray, depth_stamps: np.ndarray, where: Path, told: list[str]
) -> list[tuple[int, int]]:
    """Pairs (i, j) of colour and depth of one time; colour without depth is left out."""
    check_increasing(stamps[np.isfinite(stamps)], str(where))
    pairs = associate(stamps, depth_stamps)
    count, limit = len(stamps), MAX_STAMP_DIFFERENCE_S
    if count and not pairs:
        what = f"none of {count} colour stamps has a depth stamp within {limit} s"
        raise InputError(f"{where}: no frames: {what}. Of the same unit and the same clock?")
    if len(pairs) < count:
        left_out = f"{count - len(pairs)} of {count} colour images have no depth within {limit} s"
        told.append(f"{where.name}: {left_out} and are left out.")
    return pairs


def associate(
    first: np.ndarray, second: np.ndarray, tolerance: float = MAX_STAMP_DIFFERENCE_S
) -> list[tuple[int, int]]:
    """Pairs (i, j) of stamps in seconds that belong together, one to one, sorted by i.

    Greedy by the smallest difference, below ``tolerance``, as the TUM tools do it.
    """
    order = np.argsort(second, kind="stable")
    low, high = (np.searchsorted(second, first + d, sorter=order) for d in (-tolerance, tolerance))
    spans = enumerate(zip(low, high, strict=True))
    near = [(abs(first[i] - second[j]), i, int(j)) for i, (a, b) in spans for j in order[a:b]]
    partners: tuple[dict[int, int], dict[int, int]] = {}, {}
    for difference, i, j in sorted(near):
        if difference < tolerance and i not in partners[0] and j not in partners[1]:
            partners[0][i], partners[1][j] = j, i
    return sorted(partners[0].items())
