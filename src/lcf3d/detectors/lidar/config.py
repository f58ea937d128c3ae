"""What a LiDAR network needs to know beside its weights: ranges, voxels, anchors, thresholds."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from lcf3d.detectors.base import SCAN, CloudRequest
from lcf3d.errors import ConfigError
from lcf3d.files import shortened

CHANNELS = ("x", "y", "z", "intensity", "time")
GROUND_MODES = ("ignored", "rest", "level")


@dataclass(frozen=True)
class VoxelSpec:
    """How points are put into voxels.

    Attributes:
        size: voxel edge along x, y, z in metres.
        area: ``(x, y, z)`` lower, then upper corner of the voxelised volume, in metres.
        max_points: points of one voxel beyond this number are dropped, in input order.
        max_voxels: voxels beyond this number are dropped, in order of their first point.
    """

    size: tuple[float, float, float]
    area: tuple[float, float, float, float, float, float]
    max_points: int
    max_voxels: int

    @property
    def grid(self) -> tuple[int, int, int]:
        """Number of voxels along x, y, z."""
        nx, ny, nz = (round((self.area[i + 3] - self.area[i]) / self.size[i]) for i in range(3))
        return nx, ny, nz


@dataclass(frozen=True)
class AnchorLevel:
    """Anchors of one output map: a size and a bottom height each, every size at every rotation.

    Attributes:
        sizes: ``(length, width, height)`` in metres.
        bottoms: z of the bottom face of each size, in metres.
    """

    sizes: tuple[tuple[float, float, float], ...]
    bottoms: tuple[float, ...]


@dataclass(frozen=True)
class AnchorSpec:
    """Anchor boxes and the direction classifier of an anchor head.

    Attributes:
        levels: one for each output map of the head.
        area: ``(x, y)`` lower, then upper corner that the anchors cover, in metres.
        aligned: anchors stand on cell centres; otherwise the first and last stand on the border of ``area``.
        direction_offset: heading at which the direction classifier's two half turns meet.
        code_size: 7 box parameters, or 9 with velocity.
        joint: the best candidates are chosen over all maps together; otherwise for each map.
        rotations: anchor headings in radians.
    """

    levels: tuple[AnchorLevel, ...]
    area: tuple[float, float, float, float]
    aligned: bool
    direction_offset: float
    code_size: int = 7
    joint: bool = False
    rotations: tuple[float, ...] = (0.0, 1.57)


@dataclass(frozen=True)
class CenterSpec:
    """Tasks and decoding of a centre head.

    Attributes:
        tasks: class names of each task; their concatenation is the class list.
        stride: voxels to one cell of the heat map.
        limits: ``(x, y, z)`` lower, then upper corner that kept centres lie in, in metres.
        max_per_task: boxes kept of each task after suppression.
        max_candidates: heat-map peaks taken of each task.
        velocity: whether the head predicts velocities.
        axis: whether it also predicts the doubled heading, which is the same for front and rear: where the network
            cannot tell which is which, the box still lies along the object.
    """

    tasks: tuple[tuple[str, ...], ...]
    stride: int
    limits: tuple[float, float, float, float, float, float] = (-61.2, -61.2, -10.0, 61.2, 61.2, 10.0)
    max_per_task: int = 83
    max_candidates: int = 500
    velocity: bool = True
    axis: bool = False


@dataclass(frozen=True)
class Suppression:
    """The model's own last step: score threshold and rotated bird's-eye-view NMS.

    Attributes:
        score_threshold: boxes need a higher score.
        iou_threshold: of two boxes with a higher overlap, the one with the lower score goes.
        candidates: best boxes that enter (of each output map, or of all, see `AnchorSpec.joint`).
        max_boxes: boxes returned at most.
        over_classes: a box has its best class only, and boxes of all classes suppress one another (OpenPCDet);
            otherwise it may come out once for each class, and each class is suppressed by itself.
    """

    score_threshold: float
    iou_threshold: float
    candidates: int
    max_boxes: int
    over_classes: bool = False


@dataclass(frozen=True)
class LidarConfig:
    """A LiDAR network's configuration.

    Attributes:
        name: name of the preset.
        architecture: which detector class builds it.
        class_names: the classes its scores stand for, in order.
        channels: point columns the network takes, of `CHANNELS`.
        voxels: voxelization.
        suppression: the final step.
        anchors: for detectors with anchors.
        centers: for CenterPoint.
        proposals: first stage of two-stage detectors.
        variant: which of the architecture's networks, for example the backbone of SSN.
        offsets_replace_position: see `lcf3d.detectors.lidar.voxelization.decorate`.
        encoding: what the encoder sees of a pillar: its ``points``, or their ``statistics`` (see
            `lcf3d.detectors.lidar.statistics`).
        ground: what the ground under a scan is used for (`lcf3d.detectors.lidar.grounding`): nothing (``ignored``), to
            set boxes on it (``rest``), or to level the scan before the network sees it (``level``).
        frame: the LiDAR frame it was trained in: ``canonical`` (x forward, y left) or ``lidar_top``, nuScenes' raw
            frame (x right, y forward). Points are turned into it and boxes back, so that outside of the network
            everything is canonical.
        cloud: what it was trained on: earlier sweeps, or the part that a camera sees.
        tall: points above and below the volume stay among the raw points of a two-stage network (OpenPCDet).
        upright: classes whose boxes are held against the heights of the returns in them, see
            `lcf3d.detectors.lidar.upright`.
        painted: classes whose scores follow the four columns of each point (`lcf3d.detectors.fusion.painting`).
        painter: what they were painted with in training.
        only_painted: points without any score are left out.
    """

    name: str
    architecture: str
    class_names: tuple[str, ...]
    channels: tuple[str, ...]
    voxels: VoxelSpec
    suppression: Suppression
    anchors: AnchorSpec | None = None
    centers: CenterSpec | None = None
    proposals: Suppression | None = None
    variant: str = ""
    offsets_replace_position: bool = False
    encoding: str = "points"
    ground: str = "ignored"
    frame: str = "canonical"
    cloud: CloudRequest = SCAN
    tall: bool = False
    upright: tuple[str, ...] = ()
    painted: tuple[str, ...] = ()
    painter: str = ""
    only_painted: bool = False

    def __post_init__(self) -> None:
        if self.ground not in GROUND_MODES:
            raise ConfigError(f"{self.name}: ground takes {', '.join(GROUND_MODES)}, got {self.ground!r}")

    @property
    def has_velocity(self) -> bool:
        """Whether the network predicts velocities."""
        if self.centers is not None:
            return self.centers.velocity
        return self.anchors is not None and self.anchors.code_size == 9

    def with_candidates(self, count: int) -> LidarConfig:
        """The configuration with ``count`` candidates before suppression (of two-stage networks: regions to refine).

        Raises:
            ConfigError: ``count`` is not positive.
        """
        if count < 1:
            raise ConfigError(f"candidates must be at least 1, got {count}")
        if self.proposals is not None:
            pool = max(count, self.proposals.candidates)
            return replace(self, proposals=replace(self.proposals, candidates=pool, max_boxes=count))
        centers = self.centers and replace(self.centers, max_candidates=count)
        return replace(self, suppression=replace(self.suppression, candidates=count), centers=centers)

    def to_dict(self) -> dict[str, Any]:
        """The configuration as plain values, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, value: dict[str, Any]) -> LidarConfig:
        """The configuration that `to_dict` wrote.

        Raises:
            ConfigError: ``value`` is not such a dictionary.
        """
        try:
            # a file written before a setting existed holds its default
            values = {field.name: _tuples(value[field.name]) for field in fields(cls) if field.name in value}
            values["voxels"] = VoxelSpec(**values["voxels"])
            for name, kind in (("suppression", Suppression), ("proposals", Suppression), ("centers", CenterSpec)):
                values[name] = None if values[name] is None else kind(**values[name])
            if values["anchors"] is not None:
                levels = tuple(AnchorLevel(**level) for level in values["anchors"]["levels"])
                values["anchors"] = AnchorSpec(**{**values["anchors"], "levels": levels})
            if "cloud" in values:
                values["cloud"] = CloudRequest(**values["cloud"])
            return cls(**values)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            raise ConfigError(f"not a LiDAR network configuration of lcf3d: {shortened(error)}") from None


def _tuples(value: Any) -> Any:
    """``value`` with every list, at any depth, turned into a tuple."""
    if isinstance(value, (list, tuple)):
        return tuple(_tuples(item) for item in value)
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return value
