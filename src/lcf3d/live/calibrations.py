"""The calibrations of a stream's cameras: those that came late, and those that change in the middle."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lcf3d.live.messages import CameraModel, Image, same_mount
from lcf3d.structures import Camera


class Calibrations:
    """Each camera by the time from which it stands so.

    Args:
        cameras: those that are known from the beginning.
    """

    def __init__(self, cameras: Iterable[Camera]) -> None:
        self._known: dict[str, list[tuple[float, Camera]]] = {c.name: [(-np.inf, c)] for c in cameras}

    @property
    def names(self) -> tuple[str, ...]:
        """Cameras with a calibration, in the order in which they came."""
        return tuple(self._known)

    def learn(self, message: CameraModel, closed: float) -> bool:
        """Take a calibration in; the first one of a camera serves all earlier scans too.

        Args:
            message: the calibration.
            closed: time of the newest moment that was fused: older ones are not asked for any more.

        Returns:
            Whether it differs from that before by more than the motion of a car between scan and image.
        """
        known = self._known.setdefault(message.camera.name, [])
        anew = bool(known) and not same_mount(known[-1][1], message.camera)
        known.append((message.time if known else -np.inf, message.camera))
        known.sort(key=lambda entry: entry[0])
        while len(known) > 1 and known[1][0] <= closed:
            known.pop(0)
        return anew

    def at(self, name: str, time: float) -> Camera:
        """A camera as its calibration was at some time."""
        known = self._known[name]
        valid = [camera for since, camera in known if since <= time]
        return valid[-1] if valid else known[0][1]

    def begin_anew(self) -> None:
        """Time went back: the latest ones hold from now on."""
        for name, known in self._known.items():
            self._known[name] = [(-np.inf, known[-1][1])]

    def misfit(self, image: Image) -> str | None:
        """A sentence if an image is of another size than its calibration is for: boxes would be in the wrong places."""
        if image.camera not in self._known:
            return None
        camera, (height, width) = self.at(image.camera, np.inf), image.pixels.shape[:2]
        if (width, height) == (camera.width, camera.height):
            return None
        return (
            f"camera {image.camera} sends images of {width} x {height} pixels, but its calibration is for "
            f"{camera.width} x {camera.height}"
        )
