"""A made-up stream that goes every way that a real one goes, so that all is loaded and compiled before the first frame.

The scan and the images are the first of the shipped drive: networks find something in them, so that what comes after
a network runs too.
"""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
import PIL.Image

from lcf3d.datasets.drive import ShippedFrame, read_drive
from lcf3d.distortion import Distortion
from lcf3d.geometry.camera import project_boxes
from lcf3d.live.messages import CameraBoxes, EgoPose, Image, LidarBoxes, Message, Scan
from lcf3d.live.settings import LiveSettings
from lcf3d.structures import Camera, Detections2D, Detections3D, FloatArray

# moments, and seconds between them: enough for the watch's window and for tracks that are seen, missed and predicted
MOMENTS, PERIOD = 7, 0.1
# from this moment on the first object of each camera is gone
MISSED = 5
_SPEED = 5.0


def settle_memory() -> None:
    """Keep the garbage collector off everything that is there now: its full passes take tens of milliseconds.

    For a process whose only work is a stream, after the warm-up. What is there now and is dropped later in a circle of
    references stays in memory.
    """
    gc.collect()
    gc.freeze()


def made_up_cameras() -> list[Camera]:
    """A pinhole and a fisheye, for a stream whose cameras are not known yet."""
    axes = np.eye(4)
    axes[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    projection = np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]])
    lens = Distortion("fisheye", (0.02, -0.004, 0.0, 0.0))
    return [
        Camera("warm-up", projection, axes, 1000, 400),
        Camera("warm-up lens", projection, axes, 1000, 400, distortion=lens),
    ]


def settings_of_rehearsal(settings: LiveSettings) -> LiveSettings:
    """Nothing in threads, cameras that look with the scan, and a watch that looks at every moment."""
    watch = settings.watch
    return replace(
        settings,
        sync=replace(settings.sync, offsets={}),
        realtime=False,
        watch=None if watch is None else replace(watch, every=1, recent=2),
        watch_period=0.0,
    )


def rehearsal(
    cameras: Sequence[Camera], class_names: tuple[str, ...], detectors: Collection[str] = (), delay: float = 0.002
) -> Iterator[Message]:
    """Scans, poses and either boxes or what detectors are to find boxes in, as they would come.

    Args:
        cameras: the cameras, each sees four objects of its own: two that LiDAR sees too, one that it missed, and one
            that LiDAR alone reports.
        class_names: of the fusion.
        detectors: sources that get scans or images instead of boxes: ``scan`` or ``camera NAME``.
        delay: seconds from a scan to the images of the first camera, the second has twice as many, and so on.
    """
    shipped = read_drive(count=1)[0]
    # further away from one camera to the next: what two cameras see alike is recovered for one of them only
    objects = {camera.name: _objects(camera, 1 + 0.15 * number) for number, camera in enumerate(cameras)}
    points = np.concatenate([shipped.points, *(_surface(box) for boxes in objects.values() for box in boxes)])
    pixels = {c.name: _picture(shipped, c) for c in cameras if f"camera {c.name}" in detectors}
    for i in range(MOMENTS):
        time = i * PERIOD
        for k in range(3):
            yield EgoPose(time + k * PERIOD / 3, _pose(time + k * PERIOD / 3))
        yield Scan(time, points)
        if "scan" not in detectors:
            yield LidarBoxes(time, _lidar(list(objects.values()), class_names, i))
        for number, camera in enumerate(cameras, start=1):
            moment = time + delay * number
            if camera.name in pixels:
                image = pixels[camera.name].copy()
                # images that cannot be written to are another type to compiled functions
                image.setflags(write=bool(i % 2))
                yield Image(moment, camera.name, image)
            else:
                yield CameraBoxes(moment, camera.name, _seen(camera, objects[camera.name], class_names, i))


def _objects(camera: Camera, further: float) -> FloatArray:
    """(4, 7) cars ahead of a camera, in the LiDAR frame, so many times as far as usual."""
    places = [(15.0, -3.0), (12.0, 3.0), (20.0, 4.0), (30.0, 0.0)]
    from_camera = np.array([[aside, 0.5, further * depth, 1] for depth, aside in places])
    centres = (from_camera @ np.linalg.inv(camera.camera_from_lidar).T)[:, :3]
    return np.column_stack([centres, np.tile([4.0, 1.8, 1.6, 0.3], (len(places), 1))])


def _surface(box: FloatArray) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """Points on an object and on the ground about it."""
    u, v = np.array(np.meshgrid(np.linspace(-0.5, 0.5, 20), np.linspace(-0.5, 0.5, 20))).reshape(2, -1)
    side = np.column_stack([u * box[3], np.full(len(u), box[4] / 2), v * box[5]])
    front = np.column_stack([np.full(len(u), -box[3] / 2), u * box[4], v * box[5]])
    ground = np.column_stack([u * 12, v * 12, np.full(len(u), -box[5] / 2)])
    around = np.concatenate([side, front, ground]) + box[:3]
    return np.column_stack([around, np.full(len(around), 0.3)]).astype(np.float32)


def _lidar(objects: list[FloatArray], class_names: tuple[str, ...], moment: int) -> Detections3D:
    """What LiDAR reports: each object twice, one of each camera not at all, another only at first."""
    own = [boxes[[1, 3] if moment >= MISSED else [0, 1, 3]] for boxes in objects]
    boxes = np.concatenate([*own, *(boxes + np.eye(7)[0] * 0.3 for boxes in own)])
    labels = np.full(len(boxes), _car(class_names))
    # another class, for those that differ
    labels[-1] = len(class_names) - 1
    scores = np.linspace(0.9, 0.3, len(boxes))
    # with velocities and without
    speeds = np.tile([1.0, 0.2], (len(boxes), 1)) if moment % 2 else None
    return Detections3D(boxes, scores, labels, class_names, speeds)


def _seen(camera: Camera, objects: FloatArray, class_names: tuple[str, ...], moment: int) -> Detections2D:
    """What a camera reports: all but the last of its objects."""
    edges, visible = project_boxes(objects[1:3] if moment >= MISSED else objects[:3], camera)
    found = edges[visible]
    return Detections2D(found, np.full(len(found), 0.9), np.full(len(found), _car(class_names)), class_names)


def _car(class_names: tuple[str, ...]) -> int:
    """The class that the objects are of: cars, where there are."""
    return next((i for i, name in enumerate(class_names) if "car" in name.lower()), 0)


def _picture(shipped: ShippedFrame, camera: Camera) -> np.ndarray[tuple[int, int, int], np.dtype[np.uint8]]:
    """The drive's image in the size of a camera's."""
    picture = PIL.Image.fromarray(shipped.image).resize((camera.width, camera.height))
    return np.array(picture)


def _pose(time: float) -> FloatArray:
    pose = np.eye(4)
    pose[0, 3] = _SPEED * time
    return pose
