"""A RealSense camera and the node; the camera's own tree of frames is the child of ``odom``."""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
)
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CAMERA = "/camera/camera"
COLOUR = f"{CAMERA}/color/image_raw"
TEXTS = {"base_frame": "camera_link", "topic_imu": ""}
SHOWN = ("publish_mask", "publish_objects", "publish_path")
"""What RViz shows: published with it, and otherwise where it is asked for."""


def generate_launch_description():
    """Return what ``ros2 launch`` starts."""
    camera = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution(
                [FindPackageShare("realsense2_camera"), "launch", "rs_launch.py"]
            )
        ),
        launch_arguments={
            "align_depth.enable": "true",
            "enable_sync": "true",
            "enable_gyro": LaunchConfiguration("enable_gyro"),
            # an argument of the same name as ours: the camera's own frames
            "publish_tf": "true",
            "rgb_camera.color_profile": "640x480x30",
            "depth_module.depth_profile": "640x480x30",
        }.items(),
    )
    topics = {
        "topic_rgb": COLOUR,
        "topic_depth": f"{CAMERA}/aligned_depth_to_color/image_raw",
    }
    texts = {
        name: ParameterValue(LaunchConfiguration(name), value_type=str)
        for name in TEXTS
    }
    shown = {
        name: ParameterValue(LaunchConfiguration(name), value_type=bool)
        for name in ("publish_tf", *SHOWN)
    }
    node = Node(
        package="hybridvo_ros",
        executable="odometry",
        output="screen",
        parameters=[topics | texts | shown],
    )
    share = FindPackageShare("hybridvo_ros")
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "rviz", "hybridvo.rviz"])],
        remappings=[("/image", COLOUR)],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("rviz", default_value="false"),
            # of a D435i or D455, with topic_imu:=/camera/camera/gyro/sample
            DeclareLaunchArgument("enable_gyro", default_value="false"),
            DeclareLaunchArgument("publish_tf", default_value="true"),
            *(
                DeclareLaunchArgument(name, default_value=value)
                for name, value in TEXTS.items()
            ),
            *(
                DeclareLaunchArgument(
                    name, default_value=LaunchConfiguration("rviz")
                )
                for name in SHOWN
            ),
            # so that its arguments are not those of the node
            GroupAction([camera]),
            node,
            rviz,
        ]
    )
