"""The parameters of a node: its own, and those of the tracker, as ``--set`` has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from hybridvo.core.errors import InputError
from hybridvo.core.options import (
    Count,
    NonNegative,
    Options,
    Positive,
    load_options,
    option_group,
)
from hybridvo.io.calibration import MAX_STAMP_DIFFERENCE_S
from hybridvo.io.data.bags.topics import raw_topic

OF_ROS = ("use_sim_time", "start_type_description_service")
"""Parameters that ROS 2 itself gives to every node."""
OF_ROS_GROUP = "qos_overrides."
"""How the names of others begin."""
PATH_LENGTH = 1000
"""Poses in a path: half a minute of a camera's frames, 0.1 MB a message."""


@option_group
class NodeOptions:
    """What a node reads and publishes.

    Attributes:
        topic_rgb: the topic of colour or grey images; ``.../compressed`` is decoded.
        topic_depth: that of depth, registered to colour; ``.../compressedDepth`` is decoded.
        topic_info: that of the camera of colour; empty: ``camera_info`` beside the images.
        topic_imu: that of a gyroscope, ``sensor_msgs/Imu``, fixed to the camera by
            ``/tf_static``; empty: none is used.
        odom_frame: the frame in which poses are published.
        base_frame: the frame whose pose is published, fixed to the camera by ``/tf_static``;
            empty: the optical frame of the images.
        publish_tf: whether the transform from ``odom_frame`` is broadcast as well.
        publish_mask: whether the mask of what moves is published.
        publish_objects: whether what moves is published thing by thing; it sets
            ``track.objects``.
        publish_path: whether the poses so far are published, those of failed motions left out.
        path_length: poses that the path keeps; it forgets the oldest one.
        depth_scale: units in a metre of depth in whole numbers.
        readout_ms: time from the first row of an image to the last, where the shutter rolls, ms.
        depth_lag_ms: how much later than the image the depth map is measured, ms.
        max_offset_s: largest difference of the stamps of colour and depth, seconds.
        queue_size: frames that may wait; with 1 the newest frame counts.
        reliable: whether images that are lost are requested again (ROS 2).
        weights: a file of PWVO's weights; empty: the pretrained ones.
    """

    topic_rgb: str = "/camera/color/image_raw"
    topic_depth: str = "/camera/aligned_depth_to_color/image_raw"
    topic_info: str = ""
    topic_imu: str = ""
    odom_frame: str = "odom"
    base_frame: str = ""
    publish_tf: bool = False
    publish_mask: bool = False
    publish_objects: bool = False
    publish_path: bool = False
    path_length: Count = PATH_LENGTH
    depth_scale: Positive = 1000.0
    readout_ms: NonNegative = 0.0
    depth_lag_ms: float = 0.0
    max_offset_s: Positive = MAX_STAMP_DIFFERENCE_S
    queue_size: Count = 1
    reliable: bool = False
    weights: str = ""

    @property
    def info(self) -> str:
        """The topic of the camera."""
        if self.topic_info:
            return self.topic_info
        folder = raw_topic(self.topic_rgb).rpartition("/")[0]
        return f"{folder}/camera_info"


def is_compressed(topic: str) -> bool:
    """Return whether a topic has messages of type ``CompressedImage``.

    Example:
        >>> is_compressed("/camera/color/image_raw/compressed")
        True
    """
    return raw_topic(topic) != topic


def read_parameters(given: Mapping[str, Any]) -> tuple[NodeOptions, Options]:
    """Sort what a user set into the options of the node and those of the tracker.

    Args:
        given: Values by name: ``base_frame``, ``refine.cutoff``, or groups within
            (ROS 1: ``{"refine": {"cutoff": 2.5}}``).

    Returns:
        The options of the node, and those of the tracker.

    Raises:
        InputError: A name is unknown, or a value is of no use.

    Example:
        >>> node, options = read_parameters({"base_frame": "base", "refine.cutoff": 2.5})
        >>> node.base_frame, options.refine.cutoff
        ('base', 2.5)
    """
    own = {field.name for field in fields(NodeOptions)}
    of_node = dict[str, Any]()
    of_tracker = dict[str, Any]()
    for name, value in _flat(given).items():
        if name in OF_ROS or name.startswith(OF_ROS_GROUP):
            continue
        if "." in name:
            of_tracker[name] = value
        elif name in own:
            of_node[name] = value
        else:
            known = ", ".join(sorted(own))
            raise InputError(
                f"parameter {name[:60]}: expected one of {known}, or GROUP.KEY as "
                "'hybridvo run --set help' lists them."
            )
    options = NodeOptions(**of_node)
    if options.publish_objects:
        of_tracker.setdefault("track.objects", "auto")
    return options, load_options(named=of_tracker)


def _flat(groups: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted name."""
    flat = dict[str, Any]()
    for name, value in groups.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat
