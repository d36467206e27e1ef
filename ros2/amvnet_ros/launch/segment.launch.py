"""Start the node: `ros2 launch amvnet_ros segment.launch.py points:=/velodyne_points`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PARAMETERS = Path(__file__).parents[1] / "config" / "segment.yaml"


def generate_launch_description():
    """Return the node and its arguments."""
    points = DeclareLaunchArgument(
        "points", default_value="points", description="topic of the scans (PointCloud2)"
    )
    parameters = DeclareLaunchArgument(
        "params", default_value=str(PARAMETERS), description="YAML file of the node's parameters"
    )
    node = Node(
        package="amvnet_ros",
        executable="segment",
        name="amvnet",
        output="screen",
        parameters=[LaunchConfiguration("params")],
        remappings=[("points", LaunchConfiguration("points"))],
    )
    return LaunchDescription([points, parameters, node])
