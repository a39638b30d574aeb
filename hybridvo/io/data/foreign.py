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


BAG = "name the bag itself: hybridvo run DIR/NAME"
VIDEO = (
    "a video has no depth: put a depth map of each frame into depth/ beside it (16-bit PNG or "
    ".npy), or predict it with --depth onnx:FILE; write camera.yaml with 'hybridvo init DIR'"
)
SDK = "export colour images into rgb/ and registered depth into depth/ with its maker's tools"
ARRAYS = (
    "name the file itself if it is one .npz with rgb, depth and K; else stack them: one .npz, or "
    "rgb.npy and depth.npy in a folder, with K and timestamps; in Python: "
    "hvo.Frame(rgb, depth, camera, timestamp=stamp), then vo.track(frame)"
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

ROS_1_BAG = Foreign("a ROS 1 bag or a RealSense recording", BAG)
ROS_2_BAG = Foreign("a ROS 2 bag", BAG)
VIDEO_FILE = Foreign("a video", VIDEO)
MATROSKA = Foreign("a video or an Azure Kinect recording", VIDEO)
NUMPY_ARRAYS = Foreign("arrays of numpy", ARRAYS)
SCANNET = Foreign("a ScanNet recording", BAG)
ZED = Foreign("a ZED recording", SDK)
DEPTH_CAMERA = Foreign("a recording of a depth camera", SDK)
RECORD3D = Foreign("a Record3D recording", BAG)
RECORD3D_EXPORT = Foreign("a Record3D export", PHONE)
RUN_FOLDER = Foreign("what 'hybridvo run' has written", RESULTS)
EUROC = Foreign("a EuRoC recording", STEREO)
ARKIT_SCENES = Foreign("an ARKitScenes recording", PHONE)
RS_CONVERT = Foreign(
    "what rs-convert writes of a RealSense recording, with depth as colours",
    "give the .bag itself",
)

FILES: dict[str, Foreign] = {
    ".bag": ROS_1_BAG,
    ".mcap": ROS_2_BAG,
    ".db3": ROS_2_BAG,
    ".mp4": VIDEO_FILE,
    ".avi": VIDEO_FILE,
    ".mov": VIDEO_FILE,
    ".m4v": VIDEO_FILE,
    ".webm": VIDEO_FILE,
    ".mkv": MATROSKA,
    ".npz": NUMPY_ARRAYS,
    ".npy": NUMPY_ARRAYS,
    ".svo": ZED,
    ".svo2": ZED,
    ".oni": DEPTH_CAMERA,
    ".klg": DEPTH_CAMERA,
    ".sens": SCANNET,
    ".r3d": RECORD3D,
}
"""Kinds of recordings by the ending of their file."""
FOLDERS: tuple[ForeignFolder, ...] = (
    ForeignFolder(("run.json", "steps.*"), RUN_FOLDER),
    ForeignFolder(("mav0",), EUROC),
    ForeignFolder(("cam0/data.csv",), EUROC),
    ForeignFolder(("metadata.json", "rgbd"), RECORD3D_EXPORT),
    ForeignFolder(("lowres_depth",), ARKIT_SCENES),
    ForeignFolder(("*_Color_*.png", "*_Depth_*.*"), RS_CONVERT),
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
            if kind.remedy == BAG:
                return f"it holds {inside.name}: {kind.description}: {kind.remedy}"
            return f"it holds {inside.name}: {_description(kind)}"
    return ""


def _description(kind: Foreign) -> str:
    """State what a recording is, and what the user can do."""
    return f"{kind.description}, which is not read. Today: {kind.remedy}"
