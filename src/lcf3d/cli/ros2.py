"""``lcf3d ros2``: the fusion as a ROS 2 node."""

from __future__ import annotations

from typing import Annotated

import typer


def ros2(
    arguments: Annotated[list[str] | None, typer.Argument(help="what goes to ROS: --ros-args ...")] = None,
) -> None:
    """Run the fusion as a ROS 2 node, in a shell where ROS 2 is sourced; see docs/live.md for topics and parameters.

    Example: lcf3d ros2 --ros-args --params-file fuser.yaml
    """
    from lcf3d.live.ros2 import spin

    spin(arguments)
