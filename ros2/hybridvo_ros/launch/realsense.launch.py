"""A RealSense camera and the node; the camera's own tree of frames is the child of ``odom``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CAMERA = "/camera/camera"


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
            "rgb_camera.color_profile": "640x480x30",
            "depth_module.depth_profile": "640x480x30",
        }.items(),
    )
    topics = {
        "topic_rgb": f"{CAMERA}/color/image_raw",
        "topic_depth": f"{CAMERA}/aligned_depth_to_color/image_raw",
        "base_frame": ParameterValue(
            LaunchConfiguration("base_frame"), value_type=str
        ),
        "publish_tf": ParameterValue(
            LaunchConfiguration("publish_tf"), value_type=bool
        ),
    }
    node = Node(
        package="hybridvo_ros",
        executable="odometry",
        output="screen",
        parameters=[topics],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("base_frame", default_value="camera_link"),
            DeclareLaunchArgument("publish_tf", default_value="true"),
            camera,
            node,
        ]
    )
