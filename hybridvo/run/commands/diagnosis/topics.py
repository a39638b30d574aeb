"""``hybridvo topics``: the topics of a bag, for what each is taken, and the cameras in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hybridvo.core.errors import InputError
from hybridvo.io.data.bags.messages import (
    IMAGE_TYPES,
    TF_TYPES,
    TRANSFORM_TYPE,
    camera_info,
)
from hybridvo.io.data.bags.reader import BagSequence, summaries_of
from hybridvo.io.data.bags.source import Bag
from hybridvo.io.data.bags.topics import (
    Topics,
    TopicSummary,
    camera_of,
    choose_topics,
    is_registered,
    other_cameras,
)
from hybridvo.io.data.confined.limits import is_confined
from hybridvo.io.data.confined.sequence import report_of

ROLES = {
    "rgb": "colour",
    "depth": "depth",
    "rgb_info": "camera of colour",
    "depth_info": "camera of depth",
    "truth": "true poses",
    "imu": "gyroscope",
}
"""For what a topic is taken, by the name of the field."""


def topics(file: str | Path, trust: bool = False) -> dict[str, Any]:
    """List the topics of a bag.

    Args:
        file: The file, or the folder of ROS 2.
        trust: Whether it is read without limits, as in ``open_sequence``.

    Returns:
        A report, JSON-ready: ``topics`` with name, type, number of messages, encoding of images
        and what each is taken for; ``cameras`` with the topics of each, its intrinsics, and whether
        its depth is registered to colour; ``problem`` where the bag cannot be tracked as it is; and
        ``warnings``.

    Raises:
        InputError: It is no bag, or nothing of it can be read.
    """
    path = Path(file)
    if not BagSequence.knows(path):
        got = "something else" if path.exists() else "no such file"
        raise InputError(f"{path}: expected a bag of ROS 1 or ROS 2, got {got}.")
    if trust or not is_confined(BagSequence.kind, path):
        return {"bag": str(path)} | report(path.absolute())
    found = report_of(__name__, "report", BagSequence.kind, path.absolute())
    return {"bag": str(path)} | found


def report(path: Path) -> dict[str, Any]:
    """Return what :func:`topics` states of a bag, but for its name."""
    bag = Bag(path)
    chosen = None
    problem = ""
    try:
        summaries = summaries_of(bag)
        warnings = list(bag.notes)
        try:
            chosen = choose_topics(summaries)
            warnings.append(chosen.guessed)
        except InputError as error:
            problem = str(error)
        found = _cameras(bag, summaries)
    finally:
        bag.close()
    rows = [
        {
            "name": summary.name,
            "type": summary.type,
            "messages": summary.messages,
            "encoding": summary.encoding,
            "taken_for": _roles(summary.name, chosen),
        }
        for summary in sorted(summaries)
    ]
    return {
        "topics": rows,
        "cameras": found,
        "problem": problem,
        "warnings": warnings,
    }


def _roles(name: str, chosen: Topics | None) -> str:
    """For what a topic is taken, in words; empty where it is not read."""
    if chosen is None:
        return ""
    taken = [
        role for field, role in ROLES.items() if getattr(chosen, field) == name
    ]
    return ", ".join(taken)


def _cameras(bag: Bag, summaries: list[TopicSummary]) -> list[dict[str, str]]:
    """Describe the cameras of colour in a bag, the one that is taken first."""
    try:
        first = choose_topics(summaries, needs_depth=False).rgb
    except InputError:
        return []
    images = [each for each in summaries if each.type in IMAGE_TYPES]
    depths = _depth_topics(summaries)
    colours = [each for each in images if each.name not in depths]
    names = [first, *other_cameras(first, colours)]
    return [_camera(bag, summaries, name) for name in names]


def _depth_topics(summaries: list[TopicSummary]) -> set[str]:
    """The topics of depth that belong to any image of colour."""
    found = set()
    for each in summaries:
        if each.type in IMAGE_TYPES:
            try:
                found.add(choose_topics(summaries, rgb=each.name).depth)
            # there is none at all
            except InputError:
                continue
    return found


def _camera(bag: Bag, summaries: list[TopicSummary], rgb: str) -> dict[str, str]:
    """Describe the camera of a topic of colour."""
    try:
        topics = choose_topics(summaries, rgb=rgb)
    except InputError:
        topics = choose_topics(summaries, rgb=rgb, needs_depth=False)
    return {
        "camera": camera_of(rgb),
        "colour": rgb,
        "depth": topics.depth,
        "intrinsics": _intrinsics(bag, topics.rgb_info),
        "registered": _registration(bag, topics),
    }


def _intrinsics(bag: Bag, topic: str) -> str:
    """State the intrinsics of a CameraInfo, in words."""
    message = bag.first(topic) if topic else None
    if message is None:
        return "no CameraInfo: give --camera fx,fy,cx,cy or FILE"
    try:
        lens = camera_info(message, topic).lens
    except InputError as error:
        return str(error)
    camera = lens.camera
    bent = "no distortion" if lens.is_straight else f"distortion {lens.model}"
    numbers = f"fx {camera.fx:.1f} fy {camera.fy:.1f} cx {camera.cx:.1f} cy {camera.cy:.1f}"
    return f"{camera.width}x{camera.height}, {numbers}, {bent}"


def _registration(bag: Bag, topics: Topics) -> str:
    """State whether depth is on the pixels of colour, in words."""
    if not topics.depth:
        return "no depth: predict it with --depth onnx:FILE"
    if is_registered(topics.depth):
        return "yes, as the topic is named"
    frames = [_frame(bag, name) for name in (topics.rgb, topics.depth)]
    if frames[0] and frames[0] == frames[1]:
        return f"yes, both are of the frame '{frames[0]}'"
    between = f"frames '{frames[0]}' and '{frames[1]}'"
    if topics.depth_info in ("", topics.rgb_info):
        return f"not known: {between}, and depth has no CameraInfo of its own"
    if any(kind in (*TF_TYPES, TRANSFORM_TYPE) for kind in bag.types.values()):
        return f"no: it will be, by the transforms between {between}"
    return f"not known: {between}, and the bag has no transforms"


def _frame(bag: Bag, topic: str) -> str:
    """The frame of reference that the first image of a topic names."""
    header = getattr(bag.first(topic), "header", None)
    return "" if header is None else str(header.frame_id).lstrip("/")
