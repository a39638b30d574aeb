"""Recordings that are known by their names but not read: what they are, and what to do."""

from __future__ import annotations

from pathlib import Path

BAG = "name the bag itself: hybridvo run DIR/NAME"
VIDEO = (
    "a video has no depth: put a depth map of each frame into depth/ beside it (16-bit PNG or "
    ".npy), and write camera.yaml with 'hybridvo init DIR'"
)
SDK = "export colour images into rgb/ and registered depth into depth/ with its maker's tools"
ARRAYS = (
    "stack them: one .npz, or rgb.npy and depth.npy in a folder, with K and timestamps; in Python: "
    "hvo.Frame(rgb, depth, camera, timestamp=stamp), then vo.track(frame)"
)
STEREO = (
    "one camera alone has no depth: it needs cam0/ and cam1/, each with data.csv, data/ and "
    "sensor.yaml"
)
PHONE = (
    "write the frames of its video into rgb/ and its depth, resized to them, into depth/ "
    "(millimetres: depth_scale 1000)"
)

FILES = {
    ".bag": ("a ROS 1 bag or a RealSense recording", BAG),
    **dict.fromkeys((".mcap", ".db3"), ("a ROS 2 bag", BAG)),
    **dict.fromkeys((".mp4", ".avi", ".mov", ".m4v", ".webm"), ("a video", VIDEO)),
    ".mkv": ("a video or an Azure Kinect recording", VIDEO),
    **dict.fromkeys((".npz", ".npy"), ("arrays of numpy", ARRAYS)),
    **dict.fromkeys((".svo", ".svo2"), ("a ZED recording", SDK)),
    **dict.fromkeys(
        (".oni", ".klg", ".sens"), ("a recording of a depth camera", SDK)
    ),
    ".r3d": ("a Record3D recording", PHONE),
}
"""Ending of a file -> what it is, and what to do with it."""
FOLDERS = (
    (("mav0",), "a EuRoC recording", STEREO),
    (("cam0/data.csv",), "a EuRoC recording", STEREO),
    (("metadata.json", "rgbd"), "a Record3D export", PHONE),
    (("lowres_depth",), "an ARKitScenes recording", PHONE),
)
"""Names in a folder, which all must be there, what it then is, and what to do with it."""


def recognised(path: Path) -> str:
    """Say what a file or a folder is that is not read, and what to do; empty if not known."""
    if path.is_file():
        return (
            _told(*FILES[path.suffix.lower()])
            if path.suffix.lower() in FILES
            else ""
        )
    for names, what, remedy in FOLDERS:
        if all(any(path.glob(name)) for name in names):
            return _told(what, remedy)
    for inside in sorted(path.iterdir()):
        if inside.suffix.lower() in FILES and inside.is_file():
            what, remedy = FILES[inside.suffix.lower()]
            if remedy == BAG:
                return f"it holds {inside.name}: {what}: {remedy}"
            return f"it holds {inside.name}: {_told(what, remedy)}"
    return ""


def _told(what: str, remedy: str) -> str:
    return f"{what}, which is not read. Today: {remedy}"
