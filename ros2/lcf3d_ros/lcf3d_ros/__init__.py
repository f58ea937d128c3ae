"""The ROS 2 package around ``lcf3d ros2``."""
