"""Simulated frames: what the sensors of a preset deliver, with everything that is known about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.formats.kitti import KittiObjects, detections_3d
from lcf3d.frame import Frame
from lcf3d.geometry.boxes import points_in_boxes, transform_boxes
from lcf3d.geometry.rotation import invert_rigid
from lcf3d.simulation.actors import KITTI_CLASS, NUSCENES_CLASS, Actor
from lcf3d.simulation.camera import Render, Stage, measure_exposure, render
from lcf3d.simulation.labels import MAX_HIDDEN, Sightings, kitti_objects, sight
from lcf3d.simulation.lidar import Scan, scan
from lcf3d.simulation.light import make_light
from lcf3d.simulation.photo import NEUTRAL, Photo, draw_photo
from lcf3d.simulation.presets import KITTI_SIZE, Preset, get_preset
from lcf3d.simulation.rays import RayTracer
from lcf3d.simulation.scene import Scene, build_scene
from lcf3d.simulation.worlds import level_from_tilted
from lcf3d.structures import (
    KITTI_CLASSES,
    NUSCENES_CLASSES,
    Camera,
    Detections2D,
    Detections3D,
    FloatArray,
    InstanceMask,
    IntArray,
)


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One moment of a scene as its sensors see it.

    Attributes:
        id: name of the frame.
        preset: sensors and weather.
        scene: the street and everybody on it.
        time: seconds into the drive.
        world_from_lidar: (4, 4) pose of the LiDAR; upright, so that boxes upright in the world are upright for it,
            unless the preset's world has a mounting.
        scan: LiDAR returns with the actors they came from.
        renders: image, owner and depth by camera name; empty when images were not asked for.
        boxes: (A, 7) boxes of all actors in the LiDAR frame.
        points_on: (A,) LiDAR returns inside each box.
        sightings: what each camera sees of the actors, by camera name.
    """

    id: str
    preset: Preset
    scene: Scene
    time: float
    world_from_lidar: FloatArray
    scan: Scan
    renders: dict[str, Render]
    boxes: FloatArray
    points_on: IntArray
    sightings: dict[str, Sightings]

    @property
    def actors(self) -> tuple[Actor, ...]:
        """The labelled things, in the order of ``boxes``."""
        return self.scene.actors

    @cached_property
    def kitti(self) -> KittiObjects:
        """KITTI label lines, DontCare included, as seen by the first camera.

        Raises:
            ConfigError: the frame was simulated without images, from which visibility is taken.
        """
        camera = self.preset.cameras[0]
        if camera.name not in self.sightings:
            raise ConfigError("KITTI labels need visibility in the left image; simulate the frame with images=True")
        return kitti_objects(self.actors, self.boxes, self.sightings[camera.name], self.points_on, camera)

    @cached_property
    def labels(self) -> Detections3D:
        """Ground truth in the LiDAR frame: KITTI's labelled classes, or nuScenes' ten with at least one return."""
        if self.preset.layout == "kitti":
            return detections_3d(self.kitti, self.preset.cameras[0].camera_from_lidar, KITTI_CLASSES)
        names = [NUSCENES_CLASS[a.kind] for a in self.actors]
        kept = np.flatnonzero(self.points_on > 0)
        labels = np.array([NUSCENES_CLASSES.index(names[k]) for k in kept], dtype=np.int64)
        velocity = np.array([self.actors[k].motion.velocity(self.time) for k in kept]).reshape(-1, 2)
        attributes = np.array([attribute(self.actors[k]) for k in kept], dtype=np.str_)
        return Detections3D(
            self.boxes[kept],
            np.ones(len(kept)),
            labels,
            NUSCENES_CLASSES,
            velocity @ self.world_from_lidar[:2, :2],
            attributes,
        )

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The preset's cameras; those that fire at a time of their own are where the car has carried them by then."""
        moved = []
        for number, camera in enumerate(self.preset.cameras):
            delay = self.preset.delay(number)
            if delay:
                later = sensor_pose(self.scene, self.preset, self.time + delay)
                later_from_now = invert_rigid(later[None])[0] @ self.world_from_lidar
                camera = replace(camera, camera_from_lidar=camera.camera_from_lidar @ later_from_now)
            moved.append(camera)
        return tuple(moved)

    @property
    def frame(self) -> Frame:
        """The frame as detectors and the fusion take it."""
        images = {name: r.image for name, r in self.renders.items()}
        points = self.scan.points
        if self.preset.layout == "nuscenes":
            points = points * np.array([1, 1, 1, 255], dtype=np.float32)
        labels = self.labels if self.renders or self.preset.layout == "nuscenes" else None
        return Frame(self.id, points, self.cameras, images, labels)

    def detections_2d(self, camera: str) -> Detections2D:
        """What a perfect camera detector finds in an image: the labelled objects with visible boxes and masks.

        Raises:
            ConfigError: no such camera, or the frame was simulated without images.
        """
        if camera not in self.renders:
            raise ConfigError(f"no image of camera {camera!r}; there are {sorted(self.renders)}")
        seen, owner = self.sightings[camera], self.renders[camera].owner
        kitti = self.preset.layout == "kitti"
        class_names = KITTI_CLASSES if kitti else NUSCENES_CLASSES
        boxes, labels, masks = [], [], []
        for k, actor in enumerate(self.actors):
            name = KITTI_CLASS[actor.kind] if kitti else NUSCENES_CLASS[actor.kind]
            if name not in class_names or seen.pixels[k] < 12 or seen.hidden[k] >= MAX_HIDDEN:
                continue
            boxes.append(seen.boxes2d[k])
            labels.append(class_names.index(name))
            x1, y1, x2, y2 = seen.boxes2d[k].astype(int)
            masks.append(InstanceMask(x1, y1, owner[y1:y2, x1:x2] == actor.id))
        return Detections2D(
            np.array(boxes).reshape(-1, 4),
            np.ones(len(boxes)),
            np.array(labels, dtype=np.int64),
            class_names,
            tuple(masks),
        )


def attribute(actor: Actor) -> str:
    """nuScenes attribute name of an actor, empty for classes without one."""
    name = NUSCENES_CLASS[actor.kind]
    moving = abs(actor.motion.speed) > 0.1
    if name == "pedestrian":
        if actor.kind == "sitting":
            return "pedestrian.sitting_lying_down"
        return "pedestrian.moving" if moving else "pedestrian.standing"
    if name in ("bicycle", "motorcycle"):
        return "cycle.with_rider" if actor.kind in ("cyclist", "motorcyclist") else "cycle.without_rider"
    if name in ("traffic_cone", "barrier"):
        return ""
    return "vehicle.moving" if moving else "vehicle.stopped" if actor.stopped else "vehicle.parked"


def capture(
    scene: Scene, preset: Preset, time: float, seed: tuple[int, ...], id: str, images: bool = True, threads: int = 2
) -> SimulatedFrame:
    """What the sensors of ``preset`` deliver ``time`` seconds into a scene.

    Args:
        scene: the street.
        preset: sensors and weather.
        time: seconds into the drive.
        seed: of the sensor noise.
        id: name of the frame.
        images: whether to render the cameras; without them there is no visibility, only boxes and points.
        threads: sensors worked on at the same time.

    Raises:
        MissingExtraError: embreex is not installed.
    """
    stage = make_stage(scene, preset, time)
    lidar_from_world = invert_rigid(stage.world_from_lidar[None])[0]
    boxes = transform_boxes(scene.boxes(time), lidar_from_world)
    sensor = np.random.default_rng([*seed, 1])
    seen: dict[str, tuple[Render, Sightings]] = {}
    with ThreadPoolExecutor(max(1, threads)) as pool:
        turning = pool.submit(scan, preset.lidar, stage, scene.ego.velocity(time), preset.rain, sensor)
        if images:
            seen = _look(scene, preset, time, stage, seed, range(len(preset.cameras)), pool.map)
        turn = turning.result()
    points_on = np.zeros(len(boxes), dtype=np.int64)
    near = np.flatnonzero(np.hypot(boxes[:, 0], boxes[:, 1]) < preset.lidar.max_range_m + 12.0)
    points_on[near] = points_in_boxes(turn.points, boxes[near]).sum(axis=1)
    renders = {name: picture for name, (picture, _) in seen.items()}
    sightings = {name: sighting for name, (_, sighting) in seen.items()}
    return SimulatedFrame(id, preset, scene, time, stage.world_from_lidar, turn, renders, boxes, points_on, sightings)


def look(
    scene: Scene, preset: Preset, cameras: Sequence[Camera], time: float, seed: tuple[int, ...]
) -> dict[str, tuple[Render, Sightings]]:
    """Images of some cameras of a preset without a LiDAR scan, and what they show of the actors.

    Args:
        scene: the street.
        preset: sensors and weather.
        cameras: those of the preset to render.
        time: seconds into the drive.
        seed: of the sensor noise.

    Returns:
        By camera name.

    Raises:
        MissingExtraError: embreex is not installed.
    """
    stage = make_stage(scene, preset, time)
    wanted = [number for number, camera in enumerate(preset.cameras) if camera in cameras]
    return _look(scene, preset, time, stage, seed, wanted, map)


def _look(
    scene: Scene,
    preset: Preset,
    time: float,
    stage: Stage,
    seed: tuple[int, ...],
    numbers: Sequence[int],
    map_: Callable[..., Iterable[tuple[Render, Sightings]]],
) -> dict[str, tuple[Render, Sightings]]:
    """Image and sightings of the cameras of those numbers, by name; ``stage`` is that of ``time``."""
    shared = measure_exposure(preset.cameras[0], stage)
    photo = _photo(scene, preset)

    def one(number: int) -> tuple[Render, Sightings]:
        camera, delay = preset.cameras[number], preset.delay(number)
        now = make_stage(scene, preset, time + delay) if delay else stage
        boxes = transform_boxes(scene.boxes(time + delay), invert_rigid(now.world_from_lidar[None])[0])
        rng = np.random.default_rng([*seed, 2, number])
        exposure = shared if preset.layout == "kitti" else measure_exposure(camera, now)
        picture = render(camera, now, rng, exposure, photo)
        ids = [actor.id for actor in scene.actors]  # the triangles of an actor follow one another
        first, last = (np.searchsorted(now.owner, ids, side=side) for side in ("left", "right"))
        corners = [now.mesh.corners[a:b] for a, b in zip(first, last, strict=True)]
        return picture, sight(camera, picture.owner, scene.actors, corners, boxes, now.world_from_lidar)

    return dict(zip((preset.cameras[number].name for number in numbers), map_(one, numbers), strict=True))


def make_stage(scene: Scene, preset: Preset, time: float) -> Stage:
    """Triangles, light and pose of a scene at a moment, ready for rays."""
    snapshot = scene.at(time)
    pose = sensor_pose(scene, preset, time)
    x = float(pose[0, 3])
    light = make_light(
        scene.sun, scene.cloudiness, scene.haze_m, scene.look, preset.rain, preset.night, lamp_positions(scene, x)
    )
    shade = _photo(scene, preset).shade
    if shade != 1:
        light = replace(light, sky_ambient=light.sky_ambient * shade, ground_ambient=light.ground_ambient * shade)
    return Stage(RayTracer(snapshot.mesh.corners), snapshot.mesh, snapshot.owner, light, scene.site.markings(), pose)


def _photo(scene: Scene, preset: Preset) -> Photo:
    """The look of a drive's images."""
    if not preset.world.varied_photos:
        return NEUTRAL
    scale = preset.cameras[0].width / KITTI_SIZE[0] if preset.layout == "kitti" else 1.0
    return draw_photo(np.random.default_rng([scene.look, 9]), scale)


def sensor_pose(scene: Scene, preset: Preset, time: float) -> FloatArray:
    """(4, 4) world from LiDAR: level at its height above the ground, or riding as the preset's mounting says.

    A car on uneven ground tilts with it; what its springs and load add is drawn anew every half second.
    """
    x, y, yaw = scene.ego.pose(time)
    terrain, mounting = scene.site.terrain, preset.world.mounting
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, float(terrain.height(x, y)) + preset.lidar.height_m
    if mounting is None:
        return pose
    before = np.floor(2 * time)
    rides = [mounting.draw(np.random.default_rng([scene.look, int(before) + k])) for k in (0, 1)]
    share = 2 * time - before
    height = sum(w * ride[0] for w, ride in zip((1 - share, share), rides, strict=True))
    up = sum(w * ride[1][2] for w, ride in zip((1 - share, share), rides, strict=True))
    # the slope that the mounting adds, on top of the ground's own: both are small enough for their order not to matter
    slant = level_from_tilted(terrain.normal(x, y)).T
    pose[:3, :3] = slant @ pose[:3, :3] @ level_from_tilted(up / np.linalg.norm(up))
    crown = scene.site.world.crown * max(scene.site.street.half_width - abs(scene.ego.offset), 0.0)
    pose[:3, 3] += slant[:, 2] * (preset.lidar.height_m + height) - [0, 0, preset.lidar.height_m - crown]
    return pose


def lamp_positions(scene: Scene, around: float) -> NDArray[np.float64]:
    """(L, 4) positions and power of the street lamps nearest to the place."""
    lamps = np.array(scene.site.lamps, dtype=np.float64).reshape(-1, 3)
    near = lamps[np.argsort(np.abs(lamps[:, 0] - around - 25.0))]
    return np.concatenate([near, np.full((len(near), 1), 14.0)], axis=1)


def simulate_frame(
    preset: str | Preset = "kitti64",
    seed: int = 0,
    index: int = 0,
    *,
    street: str | None = None,
    density: float = 1.0,
    images: bool = True,
    threads: int = 2,
) -> SimulatedFrame:
    """One single frame in a scene of its own.

    Args:
        preset: name of a preset, or one of one's own.
        seed: of the data set.
        index: number of the frame in it; equal seed and index give equal bytes.
        street: kind of street (``lcf3d.simulation.streets.STREET_NAMES``); None draws one.
        density: factor on the number of road users.
        images: whether to render the cameras.
        threads: sensors worked on at the same time.

    Raises:
        ConfigError: unknown preset or street, or a density that the street cannot hold.
        MissingExtraError: embreex is not installed.
    """
    return next(
        simulate_drive(preset, seed, 1, drive=index, street=street, density=density, images=images, threads=threads)
    )


def simulate_drive(
    preset: str | Preset = "kitti64",
    seed: int = 0,
    frames: int = 20,
    *,
    drive: int = 0,
    street: str | None = None,
    density: float = 1.0,
    images: bool = True,
    threads: int = 2,
    first: int = 0,
) -> Iterator[SimulatedFrame]:
    """A drive through one scene, at the preset's frame rate, with tracks that keep their ids.

    Args:
        preset: name of a preset, or one of one's own.
        seed: of the data set.
        frames: length of the drive.
        drive: number of the drive in the data set.
        street: kind of street; None draws one.
        density: factor on the number of road users.
        images: whether to render the cameras.
        threads: sensors worked on at the same time.
        first: frame to begin with; those before are passed over.

    Raises:
        ConfigError: see `simulate_frame`, or no frames.
    """
    if frames < 1:
        raise ConfigError(f"a drive needs at least one frame, got {frames}")
    if seed < 0 or drive < 0:
        raise ConfigError(f"seed and number must not be negative, got {seed} and {drive}")
    sensors = get_preset(preset) if isinstance(preset, str) else preset
    scene = _drive_scene(sensors, seed, frames, drive, street, density)
    for number in range(first, frames):
        name = f"{drive:06d}" if frames == 1 else f"{drive:04d}_{number:06d}"
        yield capture(scene, sensors, number / sensors.rate_hz, (seed, drive, number), name, images, threads)


def drive_poses(
    preset: str, seed: int, frames: int, drive: int = 0, street: str | None = None, density: float = 1.0
) -> FloatArray:
    """(frames, 4, 4) world from LiDAR of the frames that `simulate_drive` gives, without simulating them."""
    sensors = get_preset(preset)
    scene = _drive_scene(sensors, seed, frames, drive, street, density)
    return np.array([sensor_pose(scene, sensors, number / sensors.rate_hz) for number in range(frames)])


def _drive_scene(sensors: Preset, seed: int, frames: int, drive: int, street: str | None, density: float) -> Scene:
    """The scene that a drive goes through."""
    duration = (frames - 1) / sensors.rate_hz
    return build_scene(np.random.default_rng([seed, drive]), sensors.layout, duration, street, density, sensors.world)
