"""A bag and the node, which tracks every frame of it."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, TimerAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

DEFAULTS = {
    "topic_rgb": "/camera/color/image_raw",
    "topic_depth": "/camera/aligned_depth_to_color/image_raw",
    "topic_imu": "",
    "base_frame": "",
}
SHOWN = ("publish_tf", "publish_mask", "publish_objects", "publish_path")
"""What RViz shows: published with it, and otherwise where it is asked for."""
LONG_QUEUE = 100_000
"""Frames: more than a bag that fits into memory has."""


def generate_launch_description():
    """Return what ``ros2 launch`` starts."""
    texts = {
        name: ParameterValue(LaunchConfiguration(name), value_type=str)
        for name in DEFAULTS
    }
    shown = {
        name: ParameterValue(LaunchConfiguration(name), value_type=bool)
        for name in SHOWN
    }
    fixed = {"queue_size": LONG_QUEUE, "reliable": True, "use_sim_time": True}
    node = Node(
        package="hybridvo_ros",
        executable="odometry",
        output="screen",
        parameters=[texts | shown | fixed],
    )
    share = FindPackageShare("hybridvo_ros")
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "rviz", "hybridvo.rviz"])],
        parameters=[{"use_sim_time": True}],
        remappings=[("/image", LaunchConfiguration("topic_rgb"))],
        condition=IfCondition(LaunchConfiguration("rviz")),
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
            DeclareLaunchArgument("rviz", default_value="false"),
            *(
                DeclareLaunchArgument(name, default_value=value)
                for name, value in DEFAULTS.items()
            ),
            *(
                DeclareLaunchArgument(
                    name, default_value=LaunchConfiguration("rviz")
                )
                for name in SHOWN
            ),
            node,
            rviz,
            # the node loads its network first
            TimerAction(period=LaunchConfiguration("delay"), actions=[play]),
        ]
    )
