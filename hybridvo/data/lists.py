"""Lists on disk: numbered files, stamps, poses, and what belongs together by time."""

from __future__ import annotations

import re
from collections.abc import Iterable
from collections.abc import Sequence as Many
from pathlib import Path

import numpy as np

from hybridvo.errors import InputError
from hybridvo.files import read_rows
from hybridvo.trajectory import check_increasing, read_poses, stamp_unit

MAX_STAMP_DIFFERENCE_S = 0.02
"""Largest difference in seconds between stamps that belong together (the TUM tools' value)."""


def sorted_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of a folder with one of the suffixes, ``frame_9`` before ``frame_10``."""
    if not folder.is_dir():
        return []
    found = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.is_file()]
    # text, digits, text, ...
    parts = {p: re.split(r"([0-9]+)", p.name) for p in found if not p.name.startswith(".")}
    key = {p: [int(x) if k % 2 else x for k, x in enumerate(split)] for p, split in parts.items()}
    return list(_one_each((path.stem, path) for path in sorted(key, key=lambda p: key[p])).values())


def numbered_files(folder: Path | None, pattern: str) -> dict[int, Path]:
    """Files whose whole name matches a regular expression, by the number in its first group."""
    if folder is None or not folder.is_dir():
        return {}
    names = ((re.fullmatch(pattern, path.name), path) for path in sorted(folder.iterdir()))
    return _one_each((int(match[1]), path) for match, path in names if match)


def _one_each(files: Iterable[tuple]) -> dict:
    """Key -> file, where each key may have one file only."""
    found: dict = {}
    for key, path in files:
        if (other := found.setdefault(key, path)) is not path:
            raise InputError(
                f"{path.parent}: {other.name} and {path.name} are two files of one frame. Keep one."
            )
    return found


def match_files(
    frames: Many[Path | None], files: list[Path], where: Path, hint: str
) -> list[Path | None]:
    """File of each frame: by equal names, else by order where the counts agree."""
    by_stem = {path.stem: path for path in files}
    found = [by_stem.get(frame.stem) if frame is not None else None for frame in frames]
    if not any(found) and len(files) == len(frames):
        found = [*files]
    if not any(found):
        raise InputError(
            f"{where}: {len(files)} files for {len(frames)} frames, and no name agrees. {hint}"
        )
    return found


def shown(names: Many[object], most: int = 8) -> str:
    """The first names of a list, for a message."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def to_seconds(stamps: Many[float] | np.ndarray, name: str, told: list[str]) -> np.ndarray:
    """Stamps in seconds, other units converted with a warning; what is not finite becomes NaN."""
    values = np.array(stamps, dtype=np.float64)
    values[~np.isfinite(values)] = np.nan
    factor, unit = stamp_unit(values)
    if factor != 1:
        told.append(f"{name}: stamps are {unit}; converted to seconds.")
    return values / factor


def read_stamps(
    path: Path, told: list[str], columns: str = "stamp", words: int = 0
) -> tuple[np.ndarray, list[tuple[str, ...]]]:
    """Stamps in seconds of a list, and the words after each."""
    rows = read_rows(path, columns, words=words)
    stamps = to_seconds([row.numbers[0] for row in rows], path.name, told)
    return stamps, [row.words for row in rows]


def numbered_poses(
    numbers: Many[int], stored: np.ndarray, path: Path, told: list[str]
) -> np.ndarray:
    """(N, 4, 4) stored pose of each frame number, NaN beyond the last."""
    rows, poses = np.array(numbers, int), np.full((len(numbers), 4, 4), np.nan)
    poses[rows < len(stored)] = stored[rows[rows < len(stored)]]
    if lost := int(np.isnan(poses[:, 0, 0]).sum()):
        told.append(f"{path}: {len(stored)} poses: {lost} frames have no ground truth.")
    return poses


def read_timed_poses(path: Path, told: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N,) in seconds and poses (N, 4, 4) of a list ``timestamp tx .. qw``."""
    rows, poses = read_poses(path, "tum")
    return to_seconds([row.numbers[0] for row in rows], path.name, told), poses


def poses_at(
    stamps: np.ndarray, pose_stamps: np.ndarray, poses: np.ndarray, name: str, told: list[str]
) -> np.ndarray:
    """(N, 4, 4) pose of the nearest stamp in seconds, NaN where none is near."""
    matched = np.full((len(stamps), 4, 4), np.nan)
    for i, j in associate(stamps, pose_stamps):
        matched[i] = poses[j]
    if missing := int(np.isnan(matched[:, 0, 0]).sum()):
        limit = MAX_STAMP_DIFFERENCE_S
        told.append(f"{name}: {missing} of {len(stamps)} frames have no pose within {limit} s.")
    return matched


def depth_at(
    stamps: np.ndarray, depth_stamps: np.ndarray, where: Path, told: list[str]
) -> list[tuple[int, int]]:
    """Pairs (i, j) of colour and depth of one time; colour without depth is left out."""
    check_increasing(stamps[np.isfinite(stamps)], str(where))
    pairs = associate(stamps, depth_stamps)
    count, limit = len(stamps), MAX_STAMP_DIFFERENCE_S
    if count and not pairs:
        raise InputError(
            f"{where}: no frames: none of {count} colour stamps has a depth stamp within {limit} "
            f"s. Are both in the same unit and of the same clock?"
        )
    if len(pairs) < count:
        left_out = f"{count - len(pairs)} of {count} colour images have no depth within {limit} s"
        told.append(f"{where.name}: {left_out} and are left out.")
    return pairs


def associate(
    first: np.ndarray, second: np.ndarray, tolerance: float = MAX_STAMP_DIFFERENCE_S
) -> list[tuple[int, int]]:
    """Pairs (i, j) of stamps in seconds that belong together, one to one, sorted by i.

    Greedy by the smallest difference, which must be below ``tolerance``, as the TUM tools do it.
    Neither list needs to be sorted; stamps that are not finite have no partner.
    """
    order = np.argsort(second, kind="stable")
    low, high = (np.searchsorted(second, first + d, sorter=order) for d in (-tolerance, tolerance))
    candidates = [
        (abs(first[i] - second[j]), i, int(j))
        for i in range(len(first))
        for j in order[low[i] : high[i]]
    ]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for difference, i, j in sorted(candidates):
        if difference < tolerance and i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return sorted(pairs.items())
