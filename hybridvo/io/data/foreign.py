"""Recordings that are recognised but not read: what they are, and what the user can do."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class Foreign(NamedTuple):
    """A kind of recording that no reader reads."""

    description: str  # what it is
    remedy: str  # what the user can do


class ForeignFolder(NamedTuple):
    """How a kind of recording that is a folder is recognised."""

    names: tuple[str, ...]  # with wildcards; all of them are in the folder
    kind: Foreign


SDK = "export colour images into rgb/ and registered depth into depth/ with its maker's tools"
ARRAYS = (
    "stack them: one .npz with rgb, depth and K, or rgb.npy and depth.npy in a folder, with K and "
    "timestamps; in Python: hvo.Frame(rgb, depth, camera, timestamp=stamp), then vo.track(frame)"
)
RESULTS = "name the recording itself, which run.json states as 'sequence'"
STEREO = (
    "one camera alone has no depth: it needs cam0/ and cam1/, each with data.csv, data/ and "
    "sensor.yaml"
)
PHONE = (
    "write the frames of its video into rgb/ and its depth, resized to them, into depth/ "
    "(millimetres: depth_scale 1000)"
)

ZED = Foreign("a ZED recording", SDK)
DEPTH_CAMERA = Foreign("a recording of a depth camera", SDK)
EUROC = Foreign("a EuRoC recording", STEREO)

FILES: dict[str, Foreign] = {
    ".npy": Foreign("arrays of numpy", ARRAYS),
    ".svo": ZED,
    ".svo2": ZED,
    ".oni": DEPTH_CAMERA,
    ".klg": DEPTH_CAMERA,
}
"""Kinds of recordings by the ending of their file."""
FOLDERS: tuple[ForeignFolder, ...] = (
    ForeignFolder(
        ("run.json", "steps.*"), Foreign("what 'hybridvo run' has written", RESULTS)
    ),
    ForeignFolder(("mav0",), EUROC),
    ForeignFolder(("cam0/data.csv",), EUROC),
    ForeignFolder(("metadata.json", "rgbd"), Foreign("a Record3D export", PHONE)),
    ForeignFolder(("lowres_depth",), Foreign("an ARKitScenes recording", PHONE)),
    ForeignFolder(
        ("*_Color_*.png", "*_Depth_*.*"),
        Foreign(
            "what rs-convert writes of a RealSense recording, with depth as colours",
            "give the .bag itself",
        ),
    ),
)
"""Kinds of recordings by the names in their folder; the first that fits is taken."""


def recognised(path: Path) -> str:
    """Describe a file or folder that is not read, and state what the user can do.

    Args:
        path: What exists: a file, a folder, a pipe or a device.

    Returns:
        A sentence without its full stop; empty if the kind is not known.
    """
    if path.is_file():
        kind = FILES.get(path.suffix.lower())
        return "" if kind is None else _description(kind)
    if not path.is_dir():
        return "a pipe or a device"
    for folder in FOLDERS:
        if all(any(path.glob(name)) for name in folder.names):
            return _description(folder.kind)
    for inside in sorted(path.iterdir()):
        kind = FILES.get(inside.suffix.lower())
        if kind is not None and inside.is_file():
            return f"it holds {inside.name}: {_description(kind)}"
    return ""


def _description(kind: Foreign) -> str:
    """State what a recording is, and what the user can do."""
    return f"{kind.description}, which is not read. Today: {kind.remedy}"
