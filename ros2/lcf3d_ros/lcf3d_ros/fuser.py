"""``ros2 run lcf3d_ros fuser``."""

import sys

from lcf3d.live.ros2 import spin


def main() -> None:
    """Run the node with the arguments of ROS."""
    spin(sys.argv)
