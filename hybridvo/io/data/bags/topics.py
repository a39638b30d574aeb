"""Which topics of a bag are colour, depth, cameras and ground truth: by type and by name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from hybridvo.core.errors import InputError
from hybridvo.io.data.bags.messages import (
    COMPRESSED_TYPE,
    IMAGE_TYPES,
    IMU_TYPE,
    INFO_TYPE,
    POSE_TYPES,
    is_depth_encoding,
)
from hybridvo.io.data.lists import abbreviated

TRANSPORTS = (
    "compressed",
    "compressedDepth",
    "image_transport",
    "theora",
    "ffmpeg",
)
"""What image_transport appends to the topic of the raw images."""
DEPTH_WORDS = ("depth",)
REGISTERED_WORDS = ("aligned", "registered", "depth_to_color", "depth_to_rgb")
"""In the topics of depth that the driver has registered to colour."""
COLOUR_WORDS = ("color", "colour", "rgb")
OTHER_WORDS = (
    "infra",
    "/ir",
    "fisheye",
    "confidence",
    "disparity",
    "thermal",
    "mask",
)
"""In the topics of images that are neither colour nor depth."""
RECTIFIED_WORDS = ("rect",)
TRUTH_WORDS = (
    "ground_truth",
    "groundtruth",
    "/gt",
    "_gt",
    "vicon",
    "vrpn",
    "mocap",
    "optitrack",
    "qualisys",
    "leica",
)
"""In the topics of poses that are measured from outside. Odometry of a robot is no ground truth."""


class TopicSummary(NamedTuple):
    """What is known of a topic before its messages are read."""

    name: str
    type: str  # of its messages
    messages: int
    encoding: str = ""  # of its first image, in lower case


class Topics(NamedTuple):
    """The topics that are read; empty where there is none."""

    rgb: str
    depth: str
    rgb_info: str
    depth_info: str
    truth: str
    guessed: str  # a sentence about what was guessed, empty if nothing was
    imu: str = ""


def choose_topics(
    summaries: Iterable[TopicSummary],
    rgb: str | None = None,
    depth: str | None = None,
    info: str | None = None,
    truth: str | None = None,
    needs_depth: bool = True,
    imu: str | None = None,
) -> Topics:
    """Choose the topics of a bag.

    Args:
        summaries: All topics of the bag.
        rgb: The topic of colour, where the user names it.
        depth: That of depth.
        info: That of the camera of colour.
        truth: That of true poses.
        needs_depth: Whether depth is read; a network may predict it.
        imu: The topic of the inertial sensor.

    Returns:
        The topics, the named ones first; that of depth is empty where it is not read.

    Raises:
        InputError: There are no images of colour or depth, or a named topic is not there or is of
            another type.
    """
    topics = {summary.name: summary for summary in summaries if summary.messages}
    images = [summary for summary in topics.values() if summary.type in IMAGE_TYPES]
    depths = [summary for summary in images if _is_depth(summary)]
    colours = [summary for summary in images if not _is_depth(summary)]
    depth_name = _named("--topic-depth", depth, topics, IMAGE_TYPES)
    rgb_name = _named("--topic-rgb", rgb, topics, IMAGE_TYPES)
    depth_name = depth_name or _best(depths, _depth_score, rgb_name)
    rgb_name = rgb_name or _best(colours, _colour_score, depth_name)
    if not needs_depth:
        depth_name = ""
    if not rgb_name or (needs_depth and not depth_name):
        lacking = "colour" if not rgb_name else "depth"
        option = "--topic-rgb" if not rgb_name else "--topic-depth"
        there = [f"{f.name} ({f.encoding or f.type})" for f in images]
        network = ", or predict it with --depth onnx:FILE" if rgb_name else ""
        raise InputError(
            f"no topic with images of {lacking}; images: {abbreviated(there) or 'none'}. "
            f"Name it with {option}{network}; stereo alone is not read from bags."
        )
    infos = [name for name, summary in topics.items() if summary.type == INFO_TYPE]
    rgb_info = _named("--topic-info", info, topics, (INFO_TYPE,))
    poses = [
        summary.name for summary in topics.values() if summary.type in POSE_TYPES
    ]
    truths = [name for name in poses if _has(name, TRUTH_WORDS)]
    truth_name = _named("--topic-truth", truth, topics, POSE_TYPES)
    chosen = Topics(
        rgb_name,
        depth_name,
        rgb_info or info_of(rgb_name, infos),
        info_of(depth_name, infos) if depth_name else "",
        truth_name or (truths[0] if truths else ""),
        "",
        _named("--topic-imu", imu, topics, (IMU_TYPE,))
        or choose_gyroscope(topics.values()),
    )
    is_guess = rgb is None or (needs_depth and depth is None)
    if not is_guess:
        return chosen
    others = [] if rgb is not None else other_cameras(rgb_name, colours)
    return chosen._replace(guessed=_sentence(chosen, others))


def choose_gyroscope(summaries: Iterable[TopicSummary]) -> str:
    """Return the topic of the gyroscope, of those that have messages; empty where there is none."""
    found = [
        summary
        for summary in summaries
        if summary.type == IMU_TYPE and not _has(summary.name, ("accel",))
    ]
    named = [each for each in found if _has(each.name, ("gyro",))] or found
    if not named:
        return ""
    return max(named, key=lambda summary: summary.messages).name


def other_cameras(chosen: str, colours: Iterable[TopicSummary]) -> list[str]:
    """Return topics of colour that are of other cameras than the chosen one, one of each.

    Args:
        chosen: The topic that is taken.
        colours: All topics of images that are no depth.
    """
    best: dict[str, TopicSummary] = {}
    for summary in colours:
        camera = camera_of(summary.name)
        if camera == camera_of(chosen) or _has(summary.name, OTHER_WORDS):
            continue
        if camera not in best or _colour_score(summary) > _colour_score(
            best[camera]
        ):
            best[camera] = summary
    return [summary.name for summary in best.values()]


def camera_of(topic: str) -> str:
    """Return the namespace of the camera to which a topic of images belongs.

    >>> camera_of("/front/color/image_raw/compressed")
    '/front/color'
    """
    return raw_topic(topic).rpartition("/")[0]


def info_of(image: str, infos: list[str]) -> str:
    """Return the topic of the camera to which a topic of images belongs; empty if there is none.

    ROS puts ``camera_info`` beside the images; RealSense's recorder puts it into a folder beside.
    """
    base = raw_topic(image)
    parent = base.rpartition("/")[0]
    for name in (f"{parent}/camera_info", f"{base}/camera_info"):
        if name in infos:
            return name
    grandparent = parent.rpartition("/")[0]
    inside = [name for name in infos if name == f"{grandparent}/info/camera_info"]
    if inside:
        return inside[0]
    alone = [name for name in infos if len(infos) == 1]
    return alone[0] if alone else ""


def raw_topic(topic: str) -> str:
    """Return the topic without what image_transport appends."""
    base, _, last = topic.rpartition("/")
    return base if last in TRANSPORTS else topic


def is_registered(depth_topic: str) -> bool:
    """Return whether the name of a topic states that its depth is registered to colour."""
    return _has(depth_topic, REGISTERED_WORDS)


def is_rectified(topic: str) -> bool:
    """Return whether the name of a topic states that its images are without distortion."""
    name = raw_topic(topic).rpartition("/")[2]
    # realsense's depth is "image_rect_raw": rectified as well
    return _has(name, RECTIFIED_WORDS)


def _named(
    option: str,
    name: str | None,
    topics: dict[str, TopicSummary],
    types: tuple[str, ...],
) -> str:
    """The topic that a user names, checked; empty where none is named."""
    if name is None:
        return ""
    fitting = [summary.name for summary in topics.values() if summary.type in types]
    if name in fitting:
        return name
    got = f"is of type {topics[name].type}" if name in topics else "is not there"
    there = abbreviated(sorted(fitting)) or "none"
    raise InputError(f"{option}: '{name[:100]}' {got}; such topics: {there}.")


def _is_depth(summary: TopicSummary) -> bool:
    name = summary.name.lower()
    if is_depth_encoding(summary.encoding) and not _has(name, OTHER_WORDS):
        return True
    is_named_so = _has(raw_topic(name), DEPTH_WORDS)
    # an image of depth for people is of 8 bits
    is_picture = summary.encoding.startswith(("rgb8", "bgr8", "mono8", "8uc"))
    return is_named_so and not is_picture and not _has(name, OTHER_WORDS)


def _depth_score(summary: TopicSummary) -> float:
    name = summary.name.lower()
    registered = 4.0 * _has(name, REGISTERED_WORDS)
    compressed = 0.5 * (summary.type == COMPRESSED_TYPE)
    return registered + _has(name, DEPTH_WORDS) - compressed


def _colour_score(summary: TopicSummary) -> float:
    name = summary.name.lower()
    folders = [part for part in name.split("/") if _has(part, COLOUR_WORDS)]
    named = 4.0 * bool(folders) + 0.125 * len(folders)
    other = 4.0 * _has(name, OTHER_WORDS)
    grey = 1.0 * summary.encoding.startswith(("mono", "8uc1", "16uc1"))
    compressed = 0.5 * (summary.type == COMPRESSED_TYPE)
    rectified = 0.25 * is_rectified(name)
    return named - other - grey - compressed + rectified


def _best(summaries: list[TopicSummary], score: object, beside: str) -> str:
    """The topic of the best score; of equals the one whose name is most like another's."""
    if not summaries or not callable(score):
        return ""

    def key(summary: TopicSummary) -> tuple[float, int, int]:
        return (
            score(summary),
            _shared_folders(summary.name, beside),
            summary.messages,
        )

    return max(summaries, key=key).name


def _shared_folders(a: str, b: str) -> int:
    count = 0
    for first, second in zip(a.split("/"), b.split("/"), strict=False):
        if first != second:
            break
        count += 1
    return count


def _sentence(chosen: Topics, others: list[str]) -> str:
    more = f", ground truth {chosen.truth}" if chosen.truth else ""
    more += f", IMU {chosen.imu}" if chosen.imu else ""
    text = (
        f"topics are guessed: colour {chosen.rgb}, depth {chosen.depth or 'none'}, camera "
        f"{chosen.rgb_info or 'none'}{more}; others by --topic-rgb, --topic-depth, "
        "--topic-info, --topic-truth, --topic-imu"
    )
    if not others:
        return text
    cameras = f"{len(others) + 1} cameras: {abbreviated([chosen.rgb, *others])}"
    return (
        f"{cameras}; {chosen.rgb} is taken, another one by --topic-rgb, and depth beside it is "
        f"found; {text}"
    )


def _has(name: str, words: Iterable[str]) -> bool:
    lower = name.lower()
    return any(word.lower() in lower for word in words)
