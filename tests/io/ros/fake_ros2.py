"""The parts of ROS 2 that the node calls, made up; messages are those of rosbags.

As rclpy's do, messages refuse a value of another type than ROS 2 wants.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from tests.io.ros.msgs import Types

TYPES = Types(2)
NOW_NS = 1_700_000_001_000_000_000


PARAMETER_KINDS = (bool, int, float, str)
"""Types of a parameter's value."""


class Parameter(SimpleNamespace):
    """A parameter of a node."""


class Publisher:
    """Keeps what is published, as it arrives elsewhere."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def publish(self, message: Any) -> None:
        check_like_rclpy(message)
        # rosbags has other types for some fields
        self.sent.append(TYPES.sent(for_rosbags(message)))


class Node:
    """``rclpy.node.Node``."""

    overrides: ClassVar[dict[str, Any]] = {}

    def __init__(
        self, name: str, *, automatically_declare_parameters_from_overrides: bool
    ) -> None:
        assert automatically_declare_parameters_from_overrides
        self.name = name
        self.publishers_by_topic: dict[str, Publisher] = {}
        self.subscriptions_by_topic: dict[str, SimpleNamespace] = {}
        self.services_by_name: dict[str, Callable[..., Any]] = {}
        self.said: list[str] = []
        self.parameters = self.overrides | {"use_sim_time": False}
        self.descriptors: dict[str, Any] = {}

    def get_parameters_by_prefix(self, prefix: str) -> dict[str, Parameter]:
        assert prefix == ""
        return {
            name: Parameter(name=name, value=value)
            for name, value in self.parameters.items()
        }

    def has_parameter(self, name: str) -> bool:
        return name in self.parameters

    def undeclare_parameter(self, name: str) -> None:
        assert name in self.parameters
        assert name not in self.descriptors or not self.descriptors[name].read_only
        del self.parameters[name]

    def declare_parameter(
        self, name: str, value: Any, descriptor: Any, *, ignore_override: bool
    ) -> None:
        """Refuse what rclpy refuses: it takes the type from the value."""
        assert name not in self.parameters, "ParameterAlreadyDeclaredException"
        assert ignore_override
        check_like_rclpy(descriptor)
        assert value is None or type(value) in PARAMETER_KINDS, name
        assert value is not None or descriptor.dynamic_typing, name
        ranges = {int: "integer_range", float: "floating_point_range"}
        for limits in getattr(descriptor, ranges.get(type(value), ""), ()):
            assert limits.from_value <= value <= limits.to_value, name
        self.parameters[name] = value
        self.descriptors[name] = TYPES.sent(for_rosbags(descriptor))

    def create_service(
        self, kind: type, name: str, callback: Callable[..., Any]
    ) -> None:
        self.services_by_name[name] = lambda: callback(
            kind.Request(), kind.Response()
        )

    def create_publisher(self, kind: type, topic: str, qos: int) -> Publisher:
        publisher = Publisher()
        self.publishers_by_topic[topic] = publisher
        return publisher

    def create_subscription(
        self, kind: type, topic: str, callback: Callable[..., Any], qos_profile: Any
    ) -> SimpleNamespace:
        made = SimpleNamespace(kind=kind, callback=callback, qos=qos_profile)
        self.subscriptions_by_topic[topic] = made
        return made

    def get_logger(self) -> Any:
        return SimpleNamespace(warning=self.said.append)

    def get_clock(self) -> Any:
        now = SimpleNamespace(nanoseconds=NOW_NS)
        return SimpleNamespace(now=lambda: now)

    def destroy_node(self) -> None:
        self.name = ""


class Subscriber:
    """``message_filters.Subscriber``."""

    def __init__(
        self, node: Node, kind: type, topic: str, *, qos_profile: Any
    ) -> None:
        self.callback: Callable[[Any], None] | None = None
        node.create_subscription(kind, topic, self.add, qos_profile)

    def add(self, message: Any) -> None:
        if self.callback is not None:
            self.callback(message)


class ApproximateTimeSynchronizer:
    """That of ``message_filters``, for stamps that are equal."""

    def __init__(self, fs: list[Subscriber], queue_size: int, slop: float) -> None:
        assert 0 < slop < 1 <= queue_size
        self.waiting: list[dict[int, Any]] = [{} for _ in fs]
        self.callback: Callable[..., None] | None = None
        for subscriber, queue in zip(fs, self.waiting, strict=True):
            subscriber.callback = lambda message, queue=queue: self.add(
                message, queue
            )

    def registerCallback(self, callback: Callable[..., None]) -> None:
        self.callback = callback

    def add(self, message: Any, queue: dict[int, Any]) -> None:
        stamp = message.header.stamp
        key = stamp.sec * 10**9 + stamp.nanosec
        queue[key] = message
        if self.callback and all(key in queue for queue in self.waiting):
            self.callback(*(queue.pop(key) for queue in self.waiting))


def check_like_rclpy(message: Any) -> None:
    """Refuse what the setters of rclpy's messages refuse."""
    kind = message.__msgtype__
    for name, (node, detail) in TYPES.store.fielddefs[kind][1]:
        value = getattr(message, name)
        where = f"{kind}: {name}"
        if node == 2:  # a message
            check_like_rclpy(value)
        elif node == 1:
            wanted = PLAIN[detail[0]]
            assert isinstance(value, wanted), where
            assert not isinstance(value, bool) or wanted is bool, where
        elif detail[0][0] == 2 or detail[0][1][0] == "string":
            assert isinstance(value, list), where
            for each in value:
                check_like_rclpy(each)
        elif node == 3:
            assert isinstance(value, np.ndarray), where
            assert (value.dtype, value.shape) == (np.float64, (detail[1],)), where
        else:
            assert isinstance(value, array | np.ndarray), where


PLAIN: dict[str, type] = {
    "string": str,
    **dict.fromkeys(("float32", "float64"), float),
    "bool": bool,
    "byte": bytes,
    **dict.fromkeys(("int32", "uint32", "uint8", "int64", "uint64"), int),
}


def for_rosbags(message: Any) -> Any:
    """The message with the types of rosbags: numbers for bytes, arrays of numpy."""
    for name, (node, _) in TYPES.store.fielddefs[message.__msgtype__][1]:
        value = getattr(message, name)
        if isinstance(value, bytes):
            setattr(message, name, value[0])
        elif isinstance(value, array):
            setattr(message, name, np.frombuffer(value, np.uint8))
        elif node == 2:
            for_rosbags(value)
        elif isinstance(value, list):
            for each in value:
                for_rosbags(each)
    return message


def diagnostic_status() -> type:
    """Its levels are single bytes in rclpy, as is the field."""
    base = TYPES.message_class("diagnostic_msgs/msg/DiagnosticStatus")

    def __init__(self: Any) -> None:
        base.__init__(self)
        self.level = b"\x00"
        self.OK = b"\x00"
        self.WARN = b"\x01"
        self.ERROR = b"\x02"

    return type("DiagnosticStatus", (base,), {"__init__": __init__})


class Trigger:
    """``std_srvs/srv/Trigger``, of which rosbags has no table."""

    class Request:
        """It is empty."""

    class Response:
        """Whether it was done, and a sentence."""

        def __init__(self) -> None:
            self.success = False
            self.message = ""


def install(monkeypatch: pytest.MonkeyPatch, overrides: dict[str, Any]) -> None:
    """Put the modules where ``import`` finds them, for one test."""

    def module(name: str, **content: Any) -> None:
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    def messages(package: str, *names: str, **own: Any) -> None:
        kinds = {n: TYPES.message_class(f"{package}/msg/{n}") for n in names}
        module(package)
        module(f"{package}.msg", **kinds, **own)

    policies = SimpleNamespace
    module("rclpy", ok=lambda: True)
    module("rclpy.logging", get_logger=lambda name: None)
    module("rclpy.executors", ExternalShutdownException=RuntimeError)
    module("rclpy.node", Node=type("Node", (Node,), {"overrides": overrides}))
    module(
        "rclpy.qos",
        QoSProfile=SimpleNamespace,
        ReliabilityPolicy=policies(BEST_EFFORT="best effort", RELIABLE="reliable"),
        DurabilityPolicy=policies(TRANSIENT_LOCAL="transient local"),
    )
    module(
        "message_filters",
        Subscriber=Subscriber,
        ApproximateTimeSynchronizer=ApproximateTimeSynchronizer,
    )
    messages("sensor_msgs", "Image", "CompressedImage", "CameraInfo", "Imu")
    messages("nav_msgs", "Odometry", "Path")
    messages("geometry_msgs", "PoseStamped", "TransformStamped")
    messages(
        "rcl_interfaces",
        *("ParameterDescriptor", "FloatingPointRange", "IntegerRange"),
    )
    module("std_srvs")
    module("std_srvs.srv", Trigger=Trigger)
    messages("tf2_msgs", "TFMessage")
    messages("visualization_msgs", "Marker", "MarkerArray")
    messages(
        "diagnostic_msgs",
        *("DiagnosticArray", "KeyValue"),
        DiagnosticStatus=diagnostic_status(),
    )
