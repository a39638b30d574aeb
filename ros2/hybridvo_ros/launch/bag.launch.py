"""A bag and the node, which tracks every frame of it."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, TimerAction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

DEFAULTS = {
    "topic_rgb": "/camera/color/image_raw",
    "topic_depth": "/camera/aligned_depth_to_color/image_raw",
    "base_frame": "",
}
LONG_QUEUE = 100_000
"""Frames: more than a bag that fits into memory has."""


def generate_launch_description():
    """Return what ``ros2 launch`` starts."""
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=str)
        for name in DEFAULTS
    }
    node = Node(
        package="hybridvo_ros",
        executable="odometry",
        output="screen",
        parameters=[
            parameters
            | {"queue_size": LONG_QUEUE, "reliable": True, "use_sim_time": True},
        ],
    )
    play = ExecuteProcess(
        # the time of the bag: ages of poses are of it
        cmd=["ros2", "bag", "play", "--clock", "100", LaunchConfiguration("bag")],
        output="screen",
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="folder of a bag"),
            DeclareLaunchArgument(
                "delay", default_value="20.0", description="until it plays, s"
            ),
            *(
                DeclareLaunchArgument(name, default_value=value)
                for name, value in DEFAULTS.items()
            ),
            node,
            # the node loads its network first
            TimerAction(period=LaunchConfiguration("delay"), actions=[play]),
        ]
    )
