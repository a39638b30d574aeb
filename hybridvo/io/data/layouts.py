"""Layouts of recordings by what is in them: which one a folder is nearest to, and what it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from hybridvo.io.calibration import MIN_LAYOUT_LIKENESS, TELLING_WEIGHT
from hybridvo.io.data.camera_file import RECORDER_FILES


class Part(NamedTuple):
    """A file or folder of a layout."""

    names: tuple[str, ...]  # with wildcards; one of them is enough
    is_telling: bool = False  # whether only recordings of this kind have it
    is_needed: bool = True  # whether it is read, or only a sign

    @property
    def weight(self) -> float:
        """How much it says of the kind of a recording that has it."""
        return TELLING_WEIGHT if self.is_telling else 1.0


class Layout(NamedTuple):
    """The files of a kind of recordings."""

    name: str  # for a message, with its article
    parts: tuple[Part, ...]
    remedy: str  # what a user can do who lacks some of them


class Likeness(NamedTuple):
    """How near a folder is to a layout."""

    layout: Layout
    score: float  # share of the weight of its parts that is there
    missing: tuple[str, ...]  # names of parts that are read and are not there


def _needed(*names: str) -> Part:
    return Part(names)


def _telling(*names: str) -> Part:
    return Part(names, is_telling=True)


def _sign(*names: str) -> Part:
    return Part(names, is_needed=False)


def _telling_sign(*names: str) -> Part:
    return Part(names, is_telling=True, is_needed=False)


CAMERA_NUMBERS = "--camera fx,fy,cx,cy"
LAYOUTS = (
    Layout(
        "a Stray Scanner recording",
        (
            _telling("rgb.mp4"),
            _needed("depth"),
            _telling("camera_matrix.csv"),
            _telling_sign("odometry.csv"),
            _sign("confidence"),
        ),
        "copy all files of the recording from the phone",
    ),
    Layout(
        "an export of ScanNet's SensReader",
        (
            _needed("color"),
            _needed("depth"),
            _telling("intrinsic/intrinsic_color.txt"),
            _sign("pose"),
        ),
        "export with --export_color_images --export_depth_images --export_intrinsics "
        "--export_poses, or give the .sens file itself",
    ),
    Layout(
        "a recording of Open3D or RealSense",
        (
            _needed("color", "colour"),
            _needed("depth"),
            _telling(*RECORDER_FILES[1:]),
        ),
        f"write the intrinsics there, or give {CAMERA_NUMBERS}",
    ),
    Layout(
        "a scene of Replica, as NICE-SLAM has it",
        (
            _telling("results/frame*"),
            _telling("results/depth*"),
            _sign("traj.txt"),
        ),
        "copy the whole folder results",
    ),
    Layout(
        "a raw export of Polycam",
        (
            _telling_sign("keyframes/cameras"),
            _telling_sign("keyframes/images", "keyframes/corrected_images"),
            _sign("keyframes/depth"),
            _needed("transforms.json"),
        ),
        "write it with 'ns-process-data polycam --use-depth' of nerfstudio",
    ),
    Layout(
        "a recording for nerfstudio or instant-ngp",
        (_telling("transforms.json"), _needed("images", "depth", "depths")),
        "it has intrinsics and poses, and names the images and depth maps",
    ),
    Layout(
        "a TUM recording",
        (
            _needed("rgb"),
            _needed("depth", "depths"),
            _telling("rgb.txt", "associations.txt"),
            _telling("depth.txt", "associations.txt"),
            _sign("groundtruth.txt"),
        ),
        "each line of the lists is 'timestamp filename'",
    ),
    Layout(
        "a KITTI sequence",
        (
            _telling("image_2", "image_0"),
            _telling("calib.txt"),
            _needed("image_3", "image_1", "depth"),
            _sign("times.txt"),
        ),
        "calib.txt is in KITTI's data_odometry_calib.zip",
    ),
    Layout(
        "a EuRoC recording",
        (
            _telling("mav0/cam0/data.csv", "cam0/data.csv"),
            _telling("mav0/cam1/data.csv", "cam1/data.csv"),
            _needed("mav0/cam0/sensor.yaml", "cam0/sensor.yaml"),
            _sign("mav0/imu0", "imu0"),
        ),
        "depth needs both cameras, each with data.csv, data/ and sensor.yaml",
    ),
    Layout(
        "a Record3D recording",
        (_telling("metadata", "metadata.json"), _telling("rgbd/*.depth")),
        "unpack the whole .r3d file, or give it as it is",
    ),
    Layout(
        "a scene of 7-Scenes",
        (_telling("seq-*/frame-*.color.png"), _telling_sign("seq-*.zip")),
        "unpack its seq-01.zip there",
    ),
    Layout(
        "a ROS 2 bag",
        (
            _telling_sign("metadata.yaml"),
            _telling("*.mcap", "*.db3", "*.zstd"),
        ),
        "copy the file of the messages beside metadata.yaml",
    ),
    Layout(
        "a folder of hybridvo's own layout",
        (_needed("rgb"), _needed("depth"), _telling("camera.yaml")),
        "see 'hybridvo init DIR'",
    ),
)
"""The layouts with which a folder that no reader knows is compared."""


def nearest_layout(folder: Path) -> Likeness | None:
    """Return the known layout to which a folder is nearest; None where it is like none.

    Args:
        folder: Any folder.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as name:
        ...     for part in ("odometry.csv", "camera_matrix.csv"):
        ...         _ = (Path(name) / part).write_text("")
        ...     nearest_layout(Path(name)).missing
        ('rgb.mp4', 'depth')
    """
    found = [_likeness(layout, folder) for layout in LAYOUTS]
    best = max(found, key=lambda likeness: likeness.score)
    return best if best.score >= MIN_LAYOUT_LIKENESS and best.missing else None


def lack_of(folder: Path) -> str:
    """Describe a folder as its nearest layout without what it lacks, for a message.

    Returns:
        A sentence without its full stop; empty where the folder is like no layout.
    """
    nearest = nearest_layout(folder)
    if nearest is None:
        return ""
    missing = " and ".join(nearest.missing)
    layout = nearest.layout
    return f"{layout.name} without {missing}: {layout.remedy}"


def _likeness(layout: Layout, folder: Path) -> Likeness:
    """Compare a folder with a layout."""
    weight_there = 0.0
    missing = []
    for part in layout.parts:
        if any(any(folder.glob(name)) for name in part.names):
            weight_there += part.weight
        elif part.is_needed:
            missing.append(part.names[0])
    weight = sum(part.weight for part in layout.parts)
    return Likeness(layout, weight_there / weight, tuple(missing))
