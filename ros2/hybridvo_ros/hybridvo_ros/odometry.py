"""The node: colour, depth and camera in, odometry and diagnostics out."""

from __future__ import annotations

import threading
from array import array
from collections.abc import Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, TransformStamped
from message_filters import ApproximateTimeSynchronizer, Subscriber
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
)
from rclpy.executors import ExternalShutdownException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from hybridvo.core.errors import HybridVOError
from hybridvo.core.options import Options
from hybridvo.io.ros.descriptions import descriptions
from hybridvo.io.ros.follower import Follower, Report, make_tracker
from hybridvo.io.ros.frames import stamp_ns
from hybridvo.io.ros.inbox import Inbox
from hybridvo.io.ros.outputs import (
    RecentPath,
    fill_descriptor,
    fill_mask,
    fill_objects,
    fill_odometry,
    fill_status,
    fill_transform,
)
from hybridvo.io.ros.parameters import is_compressed, read_parameters

QUEUE = 10
"""Messages that wait on a topic: colour until its depth has come, and what is published."""
ARRIVING = 100
"""Messages of a topic that DDS keeps until the executor takes them."""
ARRIVING_SAMPLES = 1000
"""The same of a gyroscope, which sends some hundred a second."""


class OdometryNode(Node):
    """Tracks images in a thread of its own, while the executor takes messages."""

    def __init__(self) -> None:
        super().__init__(
            "hybridvo", automatically_declare_parameters_from_overrides=True
        )
        given = self.get_parameters_by_prefix("")
        self.options, options = read_parameters(
            {name: parameter.value for name, parameter in given.items()}
        )
        self._declare(options)
        say = self.get_logger().warning
        self.inbox = Inbox(self.options, say)
        tracker = make_tracker(self.options, options)
        self.follower = Follower(tracker, self.options, say)
        self._odometry = self.create_publisher(Odometry, "odom", QUEUE)
        self._diagnostics = self.create_publisher(
            DiagnosticArray, "/diagnostics", QUEUE
        )
        self._transforms = None
        if self.options.publish_tf:
            self._transforms = self.create_publisher(TFMessage, "/tf", QUEUE)
        self._mask = None
        if self.options.publish_mask:
            self._mask = self.create_publisher(Image, "~/moving", QUEUE)
        self._objects = None
        if self.options.publish_objects:
            self._objects = self.create_publisher(MarkerArray, "~/objects", QUEUE)
        self._path = None
        if self.options.publish_path:
            self._path = self.create_publisher(Path, "~/path", QUEUE)
        self._recent = RecentPath(
            self.options.path_length, self.options.odom_frame, PoseStamped
        )
        self._service = self.create_service(Trigger, "~/reset", self.reset)
        self._thread = threading.Thread(target=self.work, daemon=True)
        self._subscribe()

    def start(self) -> None:
        """Begin to track."""
        self._thread.start()

    def stop(self) -> None:
        """End after the frame that is being tracked."""
        self.inbox.close()
        self._thread.join()

    def work(self) -> None:
        """Track frames as they come, until the inbox is closed."""
        while (arrived := self.inbox.take()) is not None:
            report = self.follower.follow(arrived)
            if report is not None and rclpy.ok():
                self._publish(report)

    def reset(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Let the next frame be the first one; a service."""
        response.success = True
        response.message = self.follower.ask_for_reset()
        return response

    def _declare(self, options: Options) -> None:
        """Declare every parameter, with its value in force, its meaning and its limits.

        Those that were given are declared already, of whatever type they were given.
        """
        for described in descriptions(self.options, options):
            descriptor = ParameterDescriptor()
            fill_descriptor(descriptor, described, IntegerRange, FloatingPointRange)
            name = described.name
            if self.has_parameter(name):
                self.undeclare_parameter(name)
            self.declare_parameter(
                name, described.value, descriptor, ignore_override=True
            )

    def _subscribe(self) -> None:
        options = self.options
        wait = QUEUE + options.queue_size
        policy = ReliabilityPolicy.BEST_EFFORT
        if options.reliable:
            policy = ReliabilityPolicy.RELIABLE
        of_sensor = QoSProfile(depth=ARRIVING, reliability=policy)
        of_static = QoSProfile(
            depth=ARRIVING, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        images = [
            Subscriber(
                self,
                CompressedImage if is_compressed(topic) else Image,
                topic,
                qos_profile=of_sensor,
            )
            for topic in (options.topic_rgb, options.topic_depth)
        ]
        self._pairs = ApproximateTimeSynchronizer(
            images, wait, options.max_offset_s
        )
        self._pairs.registerCallback(self.inbox.add_images)
        self.create_subscription(
            CameraInfo, options.info, self.inbox.add_info, of_sensor
        )
        if options.topic_imu:
            self.create_subscription(
                Imu,
                options.topic_imu,
                self.inbox.add_imu,
                QoSProfile(depth=ARRIVING_SAMPLES, reliability=policy),
            )
        self.create_subscription(
            TFMessage, "/tf_static", self.inbox.add_transforms, of_static
        )

    def _publish(self, report: Report) -> None:
        frame = self.options.odom_frame
        odometry = Odometry()
        fill_odometry(odometry, report, frame)
        self._odometry.publish(odometry)

        now = self.get_clock().now().nanoseconds / 1e9
        status = DiagnosticStatus()
        fill_status(
            status,
            report,
            KeyValue,
            age_s=now - stamp_ns(report) / 1e9,
            dropped=self.inbox.dropped,
        )
        diagnostics = DiagnosticArray()
        diagnostics.header.stamp = report.header.stamp
        diagnostics.status = [status]
        self._diagnostics.publish(diagnostics)

        if self._transforms is not None:
            transform = TransformStamped()
            fill_transform(transform, report, frame)
            self._transforms.publish(TFMessage(transforms=[transform]))
        if self._mask is not None and report.moving is not None:
            mask = Image()
            fill_mask(mask, report.moving, lambda data: array("B", data))
            self._mask.publish(mask)
        if self._objects is not None:
            objects = MarkerArray()
            fill_objects(objects, report, Marker)
            self._objects.publish(objects)
        if self._path is not None:
            self._recent.add(report)
            path = Path()
            self._recent.fill(path, report)
            self._path.publish(path)


def main(args: Sequence[str] | None = None) -> None:
    """Run the node until it is stopped."""
    rclpy.init(args=args)
    try:
        node = OdometryNode()
    except HybridVOError as error:
        get_logger("hybridvo").fatal(str(error))
        raise SystemExit(2) from None
    node.start()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
