"""The ament_python package around ``lcf3d ros2``."""

from setuptools import setup

NAME = "lcf3d_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/fuser.launch.py"]),
        (f"share/{NAME}/config", ["config/fuser.yaml"]),
    ],
    install_requires=["setuptools", "lcf3d"],
    zip_safe=True,
    maintainer="The lcf3d authors",
    maintainer_email="lcf3d@example.com",
    description="Late-cascade fusion of camera and LiDAR detections as a ROS 2 node",
    license="Apache-2.0",
    entry_points={"console_scripts": ["fuser = lcf3d_ros.fuser:main"]},
)
