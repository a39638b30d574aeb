"""A user's own data: camera.yaml, rgb/, depth/, optional flow/ and poses.txt."""

from __future__ import annotations

import difflib
import itertools
from bisect import bisect
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.checks import stamp_unit
from hybridvo.data.file_sequence import (
    FileSequence,
    associate,
    poses_from_rows,
    read_rows,
    sorted_files,
    to_seconds,
)
from hybridvo.data.image_io import (
    read_dpt,
    read_flo,
    read_flow_kitti_png,
    read_npy,
    read_png16,
    read_text,
)
from hybridvo.data.plain_yaml import MAX_YAML_BYTES, plain_yaml
from hybridvo.data.undistortion import Undistorter, rectify
from hybridvo.errors import FormatError, InputError
from hybridvo.types import Camera

__all__ = ["FolderSequence"]

REQUIRED = ("fx", "fy", "cx", "cy", "width", "height")
OPTIONAL = ("distortion", "depth_scale", "fps")
DEFAULT_FPS = 30.0
LARGEST = 1e12
"""No setting is larger; NaN, infinity and integers beyond any float are not smaller."""


class FolderSequence(FileSequence):
    """A folder in the layout that is easiest to write.

    - ``camera.yaml``: fx, fy, cx, cy, width, height in pixels (pixel (0, 0) is a centre); optional
      ``distortion: [k1, k2, p1, p2, k3]``, ``depth_scale`` (units per metre, needed for PNG depth),
      ``fps``.
    - ``rgb/``: PNG or JPEG. ``depth/``: 16-bit PNG, ``.npy`` or ``.dpt`` in metres.
    - ``flow/``: ``.flo``, ``.npy`` or KITTI PNG; file i leads from frame i to i + 1.
    - ``timestamps.txt``: one stamp a line. ``poses.txt``: ``timestamp tx ty tz qx qy qz qw``.

    Files go together by equal names, else by natural order where the counts agree.

    Args:
        path: the folder, or its rgb, depth or flow folder.
        strict: trailing bytes in a file are errors.
        allow_outside: accepted for symmetry; no list file names paths here.

    Raises:
        InputError: no frames, lists that do not fit together. FormatError: damaged files.
    """

    kind = "folder"
    depth_source = "file"
    looks_for = "folder: camera.yaml with rgb/ and depth/"

    def __init__(self, path: Path, *, strict: bool = False, allow_outside: bool = False) -> None:
        path = Path(path).absolute()
        root = path if (path / "camera.yaml").exists() else path.parent
        settings = _read_settings(root / "camera.yaml")
        try:
            self._camera = Camera(**{key: settings[key] for key in REQUIRED})
        except InputError as error:
            raise FormatError(f"{root / 'camera.yaml'}: {error}") from None
        rgb = sorted_files(root / "rgb", (".png", ".jpg", ".jpeg"))
        depth = sorted_files(root / "depth", (".png", ".npy", ".dpt"))
        if not rgb and not depth:
            raise InputError(
                f"{root}: no frames matched *.png, *.jpg in rgb or *.png, *.npy, *.dpt in depth."
            )
        self._depth_scale = settings.get("depth_scale")
        if self._depth_scale is None and any(p.suffix.lower() == ".png" for p in depth):
            raise InputError(
                f"{root / 'camera.yaml'}: depth/ holds PNG files: 'depth_scale' (units per metre, "
                f"1000 for millimetres) must be given."
            )
        frames = rgb or depth
        notices = [f"{root.name}: frames in natural order, {frames[0].name} to {frames[-1].name}."]
        flow_files = sorted_files(root / "flow", (".flo", ".npy", ".png"))
        for files in (rgb, depth, flow_files):
            _refuse_twins(files)
        notices += _stray_notice(root.name, frames, depth)
        lens = settings.get("distortion", ())
        if flow_files and any(lens):
            raise InputError(
                f"{root}: flow/ was computed on distorted images, and camera.yaml gives a "
                f"distortion. Undistort the images first and compute flow on those, or remove "
                f"flow/ and let hybridvo compute it."
            )
        stamps, poses, sources = _read_times_and_poses(root, frames, settings.get("fps"), notices)
        super().__init__(
            root,
            root.name,
            rgb=rgb or [None] * len(depth),
            depth=_match_files(frames, depth, root / "depth"),
            flow=_match_flow(frames, flow_files, root / "flow", notices),
            timestamps=stamps,
            poses=poses,
            sources=[root / "camera.yaml", *sources],
            notices=notices,
            strict=strict,
        )
        if (self.height, self.width) != self._camera.shape:
            raise InputError(
                f"{root}: images are {self.width}x{self.height}, camera.yaml says "
                f"{self._camera.width}x{self._camera.height}. Intrinsics belong to one image size."
            )
        self._notices += _centre_notice(root.name, self._camera)
        self._undistorter = Undistorter(self._camera, lens) if any(lens) else None
        self._notice_depth_units()

    @staticmethod
    def matches(path: Path) -> bool:
        """Whether the folder holds a camera.yaml (or is a part of one that does)."""
        inner = path.name in ("rgb", "depth", "flow") and (path.parent / "camera.yaml").is_file()
        return (path / "camera.yaml").is_file() or inner

    def camera(self, index: int) -> Camera:
        """The camera of camera.yaml."""
        self._check_index(index)
        return self._camera

    def _read_depth(self, path: Path, index: int, rgb: np.ndarray | None) -> np.ndarray:
        suffix = path.suffix.lower()
        if suffix == ".png":
            return read_png16(path).astype(np.float32) / np.float32(self._depth_scale or 1.0)
        if suffix == ".dpt":
            return read_dpt(path, strict=self.strict)
        depth = read_npy(path, strict=self.strict)
        if depth.dtype != np.float32:
            raise FormatError(
                f"{path}: expected depth in metres as floating point, got {depth.dtype}."
            )
        return depth

    def _read_flow(self, path: Path, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        suffix = path.suffix.lower()
        if suffix == ".png":
            return read_flow_kitti_png(path)
        if suffix == ".flo":
            return read_flo(path, strict=self.strict), None
        flow = read_npy(path, channels=2, strict=self.strict)
        if flow.dtype != np.float32:
            raise FormatError(f"{path}: expected flow in floating point, got {flow.dtype}.")
        return flow, None

    def _rectify(
        self, rgb: np.ndarray | None, depth: np.ndarray | None
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        return rectify(self._undistorter, rgb, depth)


def _read_settings(path: Path) -> dict[str, Any]:
    """Checked content of camera.yaml."""
    content = plain_yaml(read_text(path, limit=MAX_YAML_BYTES), str(path))
    if not isinstance(content, dict):
        raise FormatError(f"{path}: expected 'key: value' lines, got a {type(content).__name__}.")
    known = REQUIRED + OPTIONAL
    for key in content:
        if not isinstance(key, str) or key not in known:
            shown = key if isinstance(key, str) else type(key).__name__
            close = difflib.get_close_matches(str(shown), known, n=1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            raise FormatError(
                f"{path}: unknown key '{shown[:40]}'{hint}; known: {', '.join(known)}."
            )
    missing = [key for key in REQUIRED if key not in content]
    if missing:
        raise FormatError(f"{path}: missing: {', '.join(missing)}.")
    for key in known:
        if key not in content:
            continue
        if key == "distortion":
            content[key] = _distortion(content[key], path)
            continue
        value = content[key]
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FormatError(f"{path}: {key}: expected a number, got a {type(value).__name__}.")
        if not abs(value) < LARGEST or (key not in ("cx", "cy") and value <= 0):
            raise FormatError(f"{path}: {key}: expected a positive finite number, got {value}.")
        if key in ("width", "height") and int(value) != value:
            raise FormatError(f"{path}: {key}: expected a whole number of pixels, got {value}.")
    return content


def _centre_notice(name: str, camera: Camera) -> list[str]:
    """Notice of a principal point far from the middle of the picture."""
    x, y = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    if abs(x - 0.5) < 0.25 and abs(y - 0.5) < 0.25:
        return []
    return [
        f"{name}: the principal point {camera.cx:g} {camera.cy:g} is far from the middle of "
        f"{camera.width}x{camera.height} pixels: are fx, fy, cx, cy those of another image size?"
    ]


def _distortion(value: Any, path: Path) -> tuple[float, ...]:
    numbers = isinstance(value, list) and all(
        isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < LARGEST for v in value
    )
    if not numbers or len(value) not in (4, 5):
        raise FormatError(f"{path}: distortion: expected a list of 5 numbers [k1, k2, p1, p2, k3].")
    return tuple(float(v) for v in value)


def _refuse_twins(files: list[Path]) -> None:
    """Refuse two files of one frame: as frames of their own they would be read one after another.

    Raises:
        InputError: files whose names differ in the ending alone.
    """
    seen: dict[str, Path] = {}
    for path in files:
        other = seen.setdefault(path.stem, path)
        if other is not path:
            raise InputError(
                f"{path.parent}: {other.name} and {path.name} are two files of one frame. Keep the "
                f"files of one kind."
            )


def _stray_notice(name: str, frames: list[Path], depth: list[Path]) -> list[str]:
    """Notice of depth files without an image."""
    stems = {path.stem for path in frames}
    stray = [path.name for path in depth if path.stem not in stems]
    if not stray or len(stray) == len(depth):  # the two folders have names of their own
        return []
    shown = ", ".join(stray[:4]) + (", ..." if len(stray) > 4 else "")
    return [f"{name}: {len(stray)} depth files without an image are left out: {shown}."]


def _jump_notice(name: str, frames: list[Path]) -> list[str]:
    """Notice of images whose numbers do not go on evenly, though their stamps will."""
    if not all(path.stem.isascii() and path.stem.isdigit() for path in frames):
        return []
    steps = {int(b.stem) - int(a.stem) for a, b in itertools.pairwise(frames)}
    if len(steps) < 2:
        return []
    return [
        f"{name}: the numbers of the images jump, the time stamps do not: {len(frames)} images, "
        f"{frames[0].name} to {frames[-1].name}. Give the stamps in timestamps.txt."
    ]


def _match_files(frames: list[Path], files: list[Path], folder: Path) -> list[Path | None]:
    """One file or None per frame: by equal stems, else by order where the counts agree."""
    if not files:
        return [None] * len(frames)
    by_stem = {path.stem: path for path in files}
    matched = [by_stem.get(frame.stem) for frame in frames]
    if any(matched):
        return matched
    if len(files) == len(frames):
        return list(files)
    raise InputError(
        f"{folder}: {len(files)} files for {len(frames)} frames, and no file name agrees "
        f"({files[0].name} against {frames[0].name}). Give both the same names."
    )


def _match_flow(
    frames: list[Path], files: list[Path], folder: Path, notices: list[str]
) -> list[Path | None]:
    """As :func:`_match_files`; a flow that led to a frame which is missing now is left out."""
    if len(files) == len(frames) - 1 and not {p.stem for p in files} & {p.stem for p in frames}:
        return [*files, None]
    matched = _match_files(frames, files, folder)
    if not files or not all(p.stem.isascii() and p.stem.isdigit() for p in (*frames, *files)):
        return matched
    if not {int(p.stem) for p in files} & {int(p.stem) for p in frames}:
        return matched  # names of their own, matched by order
    numbers = [int(path.stem) for path in frames]
    without_image = sorted({int(path.stem) for path in files} - {*numbers})
    steps = Counter(b - a for a, b in itertools.pairwise(numbers))
    usual = steps.most_common(1)[0][0] if steps else 1
    lost = [
        k
        for k, (a, b) in enumerate(itertools.pairwise(numbers))
        if matched[k] is not None
        and (b - a != usual or bisect(without_image, a) != bisect(without_image, b))
    ]
    if lost:
        names = ", ".join(frames[k].name for k in lost[:4]) + (", ..." if len(lost) > 4 else "")
        notices.append(
            f"{folder.parent.name}: images are missing after {names}: the flow files of these lead "
            f"to the missing ones and are not used."
        )
    for k in lost:
        matched[k] = None
    return matched


def _read_times_and_poses(
    root: Path, frames: list[Path], fps: float | None, notices: list[str]
) -> tuple[np.ndarray, np.ndarray | None, list[Path]]:
    """Stamps from timestamps.txt, else poses.txt, else file names, else the frame rate."""
    count = len(frames)
    stamp_file, pose_file = root / "timestamps.txt", root / "poses.txt"
    sources = [path for path in (stamp_file, pose_file) if path.exists()]
    rows = np.zeros((0, 8))
    if pose_file.exists():
        table = read_rows(pose_file, "timestamp tx ty tz qx qy qz qw")
        rows = np.array(table, dtype=np.float64).reshape(-1, 8)
    pose_stamps, converted = to_seconds(rows[:, 0], pose_file.name)
    notices += converted
    truth = poses_from_rows(rows[:, 1:], str(pose_file)) if pose_file.exists() else None
    if stamp_file.exists():
        stamps, converted = to_seconds([r[0] for r in read_rows(stamp_file, "t")], stamp_file.name)
        notices += converted
        if len(stamps) != count:
            raise InputError(f"{stamp_file}: {len(stamps)} stamps for {count} frames.")
    elif truth is not None and len(truth) == count:
        return pose_stamps, truth, sources
    elif fps is None and (named := _stamps_in_names(frames)) is not None:
        stamps, converted = to_seconds(named, "file names")
        notices += converted
    else:
        with np.errstate(over="ignore"):  # of an fps of almost zero: refused as stamps
            stamps = np.arange(count) / (fps or DEFAULT_FPS)
        notices += _jump_notice(root.name, frames)
        if fps is None:
            notices.append(f"{root.name}: no time stamps; {DEFAULT_FPS:g} frames a second assumed.")
    if truth is None:
        return stamps, None, sources
    poses = np.full((count, 4, 4), np.nan)
    for i, j in associate(stamps, pose_stamps):
        poses[i] = truth[j]
    missing = int(np.isnan(poses[:, 0, 0]).sum())
    if missing:
        notices.append(f"{pose_file}: {missing} of {count} frames have no pose within 0.02 s.")
    return stamps, poses, sources


def _stamps_in_names(frames: list[Path]) -> list[float] | None:
    """Stamps where every file name is a number of seconds or parts of one; counters are none."""
    try:
        values = [float(path.stem) for path in frames]
    except ValueError:
        return None
    stamps = all("." in path.stem for path in frames) or stamp_unit(np.array(values))[0] != 1
    return values if stamps and np.isfinite(values).all() else None
