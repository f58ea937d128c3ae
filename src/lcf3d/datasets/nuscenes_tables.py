"""The nuScenes tables as columns, with tokens resolved to row numbers, and the names that they use."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.structures import NUSCENES_CLASSES, BoolArray, FloatArray, IntArray

CAMERAS = ("CAM_FRONT_LEFT", "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT", "CAM_BACK", "CAM_BACK_RIGHT")
MAX_CAMERA_DELAY_S = 0.1
"""Default of the longest accepted time in seconds between a camera image and the LiDAR sweep of its sample."""
LIDAR = "LIDAR_TOP"
CHANNELS = (*CAMERAS, LIDAR)
BICYCLE_RACK = "static_object.bicycle_rack"

DETECTION_CLASS_OF_CATEGORY = {
    "vehicle.car": "car",
    "vehicle.truck": "truck",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.trailer": "trailer",
    "vehicle.construction": "construction_vehicle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.bicycle": "bicycle",
    "movable_object.trafficcone": "traffic_cone",
    "movable_object.barrier": "barrier",
}
"""Category of the tables -> class of the detection task; others are not evaluated (nuScenes detection task)."""

Tokens = NDArray[np.bytes_]


@dataclass(frozen=True, eq=False)
class Samples:
    """Columns of ``sample.json``: one row a key frame.

    Attributes:
        tokens: (M,) tokens.
        timestamps_us: (M,) microseconds.
        scenes: (M,) rows of the scenes.
        lidar: (M,) row in `SensorData` of the LIDAR_TOP key frame, -1 where there is none.
        cameras: (M, 6) rows in `SensorData` of the key frames of `CAMERAS`, -1 where there is none.
    """

    tokens: Tokens
    timestamps_us: IntArray
    scenes: IntArray
    lidar: IntArray
    cameras: IntArray


@dataclass(frozen=True, eq=False)
class SensorData:
    """Columns of ``sample_data.json`` for `CHANNELS`, with pose and calibration of each recording.

    Attributes:
        tokens: (D,) tokens.
        samples: (D,) rows of the samples.
        channels: (D,) indices into `CHANNELS`.
        timestamps_us: (D,) microseconds.
        key_frames: (D,) whether a key frame.
        filenames: (D,) paths relative to the dataset's root.
        sizes: (D, 2) image width and height.
        previous: (D,) row of the preceding recording of LIDAR_TOP, -1 where there is none (and for cameras).
        pose_rotations: (D, 4) ``global_from_ego`` quaternions at the time of the recording.
        pose_translations: (D, 3) metres.
        sensor_rotations: (D, 4) ``ego_from_sensor`` quaternions.
        sensor_translations: (D, 3) metres.
        intrinsics: (D, 3, 3) camera matrices, NaN for the LiDAR.
    """

    tokens: Tokens
    samples: IntArray
    channels: IntArray
    timestamps_us: IntArray
    key_frames: BoolArray
    filenames: Tokens
    sizes: IntArray
    previous: IntArray
    pose_rotations: FloatArray
    pose_translations: FloatArray
    sensor_rotations: FloatArray
    sensor_translations: FloatArray
    intrinsics: FloatArray


@dataclass(frozen=True, eq=False)
class Annotations:
    """Columns of ``sample_annotation.json``, in table order.

    Attributes:
        tokens: (A,) tokens.
        samples: (A,) rows of the samples.
        categories: (A,) indices into ``NuscenesTables.category_names``.
        translations: (A, 3) centres in metres, global frame.
        sizes: (A, 3) width, length, height in metres.
        rotations: (A, 4) quaternions (w, x, y, z), global frame.
        previous: (A,) row of the same object's annotation before, -1 where there is none.
        following: (A,) row of the one after, -1 where there is none.
        point_counts: (A,) LiDAR and radar points inside.
        attributes: (A,) indices into `NUSCENES_ATTRIBUTES`, -1 for none.
        instances: (A,) number of the object, the same in all samples of its scene; -1 where it is unknown.
    """

    tokens: Tokens
    samples: IntArray
    categories: IntArray
    translations: FloatArray
    sizes: FloatArray
    rotations: FloatArray
    previous: IntArray
    following: IntArray
    point_counts: IntArray
    attributes: IntArray
    instances: IntArray


@dataclass(frozen=True, eq=False)
class NuscenesTables:
    """All columns of one version of the tables."""

    root: Path
    version: str
    scene_names: tuple[str, ...]
    category_names: tuple[str, ...]
    samples: Samples
    sensor_data: SensorData
    annotations: Annotations

    def detection_labels(self) -> IntArray:
        """(A,) class of each annotation as an index into `NUSCENES_CLASSES`, -1 for categories not evaluated."""
        names = [DETECTION_CLASS_OF_CATEGORY.get(name) for name in self.category_names]
        table = np.array([NUSCENES_CLASSES.index(name) if name else -1 for name in names], dtype=np.int64)
        return table[self.annotations.categories] if len(self.annotations.categories) else self.annotations.categories

    def camera_rows(self, sample_rows: IntArray, camera: str) -> IntArray:
        """(S,) rows in ``sensor_data`` of the images that ``camera`` took of the given samples, -1 where none.

        Raises:
            ConfigError: no camera of that name.
        """
        if camera not in CAMERAS:
            raise ConfigError(f"nuScenes has no camera {camera!r}; its cameras are {', '.join(CAMERAS)}")
        rows: IntArray = self.samples.cameras[sample_rows, CAMERAS.index(camera)]
        return rows

    def rows_of_scenes(self, names: Collection[str]) -> IntArray:
        """(S,) rows of the samples in the named scenes, scene by scene in table order, each in order of time."""
        chosen = np.array([name in names for name in self.scene_names], dtype=bool)
        rows = np.flatnonzero(chosen[self.samples.scenes])
        ordered: IntArray = rows[np.lexsort((self.samples.timestamps_us[rows], self.samples.scenes[rows]))]
        return ordered
