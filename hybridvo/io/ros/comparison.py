"""Whether a node publishes the poses that ``hybridvo run`` writes of the same bag."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import invert
from hybridvo.core.trajectory import Trajectory
from hybridvo.io.data.bags.messages import stamped_pose
from hybridvo.io.data.bags.source import Bag
from hybridvo.io.data.open import open_sequence
from hybridvo.io.ros.conversions import optical_mount, pose_in_odom

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
EVERY_FRAME = 100_000
"""Frames that may wait: more than a bag that fits into memory has."""
TICKS_PER_S = 1e6
"""Stamps are equal to the microsecond: seconds since 1970 have no more digits."""


class Difference(NamedTuple):
    """How far the poses of a node are from those of a run.

    Attributes:
        compared: frames that both have.
        missing: frames of the run that the node did not publish.
        further: frames that only the node has.
        metres: the largest distance between two positions.
        degrees: the largest angle between two orientations.
        frame: the number, in the run, of the frame with that distance.
    """

    compared: int
    missing: int
    further: int
    metres: float
    degrees: float
    frame: int

    def is_within(self, metres: float, degrees: float) -> bool:
        """Return whether both have the same frames, and poses that differ by no more than this."""
        are_the_same = not self.missing and not self.further
        return are_the_same and self.metres <= metres and self.degrees <= degrees

    def __str__(self) -> str:
        text = (
            f"{self.compared} poses compared: largest difference {self.metres:.3g} m (frame "
            f"{self.frame}), {self.degrees:.3g} deg"
        )
        if self.missing:
            text += f"; {self.missing} frames of the run were not published"
        if self.further:
            text += f"; {self.further} published poses are of no frame of the run"
        return text


def difference(messages: Iterable[Any], path: Trajectory) -> Difference:
    """Compare what a node published with the path of a run.

    Args:
        messages: ``nav_msgs/Odometry`` of the optical frame: of a node without ``base_frame``.
        path: ``trajectory.tum`` of ``hybridvo run`` on the same bag.

    Raises:
        InputError: No pose has the stamp of a frame of the run.
    """
    mount = optical_mount("")
    published = {
        _tick(pose.stamp / 1e9): pose.T
        for pose in map(stamped_pose, messages)
        if pose is not None
    }
    metres = np.full(len(path), np.nan)
    degrees = np.full(len(path), np.nan)
    for i, stamp in enumerate(path.timestamps):
        T_odom_child = published.get(_tick(stamp))
        if T_odom_child is None:
            continue
        expected = pose_in_odom(path.T_world_cam[i], mount)
        off = invert(expected) @ T_odom_child
        metres[i] = np.linalg.norm(off[:3, 3])
        degrees[i] = np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude())
    compared = int(np.isfinite(metres).sum())
    if not compared:
        raise InputError(
            f"expected poses with the stamps of the {len(path)} frames of the run, got "
            f"{len(published)} poses with others: was the same bag played, and did the node "
            "track?"
        )
    return Difference(
        compared,
        len(path) - compared,
        len(published) - compared,
        float(np.nanmax(metres)),
        float(np.nanmax(degrees)),
        int(np.nanargmax(metres)),
    )


def _tick(seconds: float) -> int:
    return round(float(seconds) * TICKS_PER_S)


def recorded_odometry(bag: Path, topic: str) -> list[Any]:
    """Return the messages of a topic that ``ros2 bag record`` or ``rosbag record`` wrote.

    Args:
        bag: The recording.
        topic: That of the node's odometry.

    Raises:
        InputError: The topic is not there, or of another type.
    """
    source = Bag(bag)
    try:
        kind = source.types.get(topic)
        if kind != ODOMETRY_TYPE:
            got = "no such topic" if kind is None else kind
            there = [name for name, k in source.types.items() if k == ODOMETRY_TYPE]
            raise InputError(
                f"{bag}: expected {ODOMETRY_TYPE} on {topic}, got {got}; such topics: "
                f"{', '.join(sorted(there)) or 'none'}."
            )
        return [source.decode(message) for message in source.messages([topic])]
    finally:
        source.close()


class Used(NamedTuple):
    """The topics of a bag that ``hybridvo run`` uses; a node must be given the same.

    Attributes:
        rgb: of colour.
        depth: of depth.
        info: of the camera of colour.
        imu: of the gyroscope; empty where none is used.
        frames: how many frames it tracks.
    """

    rgb: str
    depth: str
    info: str
    imu: str
    frames: int

    @property
    def played(self) -> list[str]:
        """All topics that a node needs of the bag."""
        topics = (self.rgb, self.depth, self.info, self.imu, "/tf_static")
        return [topic for topic in topics if topic]


def used_topics(bag: Path) -> Used:
    """Return which topics of a bag ``hybridvo run`` uses.

    Args:
        bag: A file of ROS 1, or the folder of ROS 2.

    Raises:
        InputError: It is no bag, or lacks colour or depth.
    """
    sequence = open_sequence(bag)
    topics = getattr(sequence, "topics", None)
    if topics is None:
        raise InputError(f"{bag}: expected a bag, got {sequence.kind}.")
    imu = "" if sequence.imu_samples is None else topics.imu
    return Used(topics.rgb, topics.depth, topics.rgb_info, imu, len(sequence))


def node_parameters(used: Used, assignments: Iterable[str] = ()) -> dict[str, str]:
    """Return the parameters by which a node of ROS 2 tracks every frame as the run does.

    Args:
        used: The topics.
        assignments: Options of both, as ``--set`` takes them: ``group.key=value``.

    Raises:
        InputError: An assignment is none.
    """
    parameters = {
        "topic_rgb": used.rgb,
        "topic_depth": used.depth,
        "topic_info": used.info,
        "topic_imu": used.imu,
        "queue_size": str(EVERY_FRAME),
        "reliable": "true",
        "use_sim_time": "true",
    }
    for text in assignments:
        key, sign, value = text.partition("=")
        if not sign or "." not in key:
            raise InputError(
                f"--set: expected group.key=value, as refine.cutoff=3, got {text!r}."
            )
        parameters[key] = value
    return {name: value for name, value in parameters.items() if value}


def play_qos(used: Used) -> dict[str, dict[str, Any]]:
    """Return the quality of service by which ``ros2 bag play`` loses nothing, by topic.

    A bag may state what its driver offered, which loses images; or nothing, and then nobody who
    listens later hears ``/tf_static``.
    """
    overrides: dict[str, dict[str, Any]] = {
        topic: {"reliability": "reliable", "history": "keep_all"}
        for topic in used.played
    }
    overrides["/tf_static"]["durability"] = "transient_local"
    return overrides
