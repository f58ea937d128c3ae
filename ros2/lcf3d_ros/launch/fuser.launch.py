"""The fusion node with its parameter file: ``ros2 launch lcf3d_ros fuser.launch.py params:=my.yaml``."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """One node, one argument."""
    usual = f"{get_package_share_directory('lcf3d_ros')}/config/fuser.yaml"
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=usual, description="parameter file of the node"),
            Node(
                package="lcf3d_ros",
                executable="fuser",
                name="lcf3d",
                parameters=[LaunchConfiguration("params")],
                output="screen",
            ),
        ]
    )
