"""Frames and what was decided in them as a Rerun recording, or live in its viewer (extra ``viz``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import MissingExtraError
from lcf3d.frame import Frame
from lcf3d.geometry.rotation import quaternions_from_yaws
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Camera, Detections3D, FloatArray
from lcf3d.visualization.scene import CAMERA_COLOUR, COLOURS, TRUTH_COLOUR, Scene, drawn_dropped
from lcf3d.visualization.trails import Trails

_GREY = (110, 115, 120)
# colours are chosen for a dark ground, whatever the viewer's theme
_GROUND = (16, 18, 22)
# legible on the plates of a light theme and of a dark one
_UNUSED = (150, 150, 150)
# scans and images of more than this are thinned, so that a recording of a drive stays small
MOST_POINTS = 60_000
JPEG_QUALITY = 80


class RerunLog:
    """Writes frame after frame into a recording file, or into the viewer that it opens.

    Args:
        path: the ``.rrd`` file; without one the viewer is opened.
        cameras: names of the cameras, for the layout.
        stream: whether latency, alignment and health come with the frames and get a place in the layout.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """

    def __init__(self, path: Path | None, cameras: Sequence[str], *, stream: bool = False) -> None:
        try:
            import rerun
            import rerun.blueprint
        except ImportError:
            raise MissingExtraError("rerun-sdk", "viz", "the Rerun viewer") from None
        self._rerun: Any = rerun
        # names of cameras and stages may hold spaces and slashes
        self._part: Any = rerun.escape_entity_path_part
        self._stream: Any = rerun.RecordingStream("lcf3d")
        if path is None:
            self._stream.spawn()
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream.save(path)
        self._stream.send_blueprint(
            _blueprint(rerun.blueprint, [(name, self._camera(name)) for name in cameras], stream)
        )
        self._stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        # what is no object stays as it is
        nothing = rerun.AnnotationContext([rerun.AnnotationInfo(0, "no object", (0, 0, 0, 0))])
        self._stream.log("world", nothing, static=True)
        for outcome, colour in COLOURS.items():
            line = rerun.SeriesLines(colors=colour, names=outcome, widths=2)
            self._stream.log(f"boxes/{outcome}", line, static=True)
        self._index = 0
        self._trails = Trails()
        self._messages: dict[str, str] = {}

    def log(
        self,
        frame: Frame,
        fused: FusedDetections,
        *,
        truth: Detections3D | None = None,
        latency_ms: Mapping[str, float] | None = None,
        alignment_deg: Mapping[str, float] | None = None,
        health: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """One frame: cameras with images and boxes, the scan coloured by what was decided, boxes with their reasons.

        Where the boxes have tracks and the frame a pose, each has the way over ground that it came.

        Args:
            frame: the frame.
            fused: what came of it.
            truth: ground truth to draw, if any.
            latency_ms: milliseconds by stage, for the timeline.
            alignment_deg: how far each camera has turned against its calibration, by name, for the timeline.
            health: of a stream, as `lcf3d.live.fuser.Fuser.diagnostics` gives it.
        """
        scene = Scene.from_fused(fused, truth, trails=self._trails(frame, fused))
        self._stream.set_time("frame", sequence=self._index)
        if frame.timestamp is not None:
            self._stream.set_time("time", duration=frame.timestamp)
        self._index += 1
        reasons = [fused.explain(i) for i in range(len(fused))]
        reasons += [fused.explain_lidar(int(i)) for i in drawn_dropped(fused)]
        self._log_boxes("world/boxes", scene.boxes, [COLOURS[o] for o in scene.outcomes], reasons)
        if fused.tracks is not None:
            ways = [way for way in scene.trails if len(way) > 1]
            colours = [COLOURS[o] for o, way in zip(scene.outcomes, scene.trails, strict=False) if len(way) > 1]
            self._stream.log("world/trails", self._rerun.LineStrips3D(ways, colors=np.array(colours).reshape(-1, 3)))
        if scene.truth is not None:
            self._log_boxes("world/truth", scene.truth, [TRUTH_COLOUR] * len(scene.truth), ())
        self._log_points(frame.points, scene)
        for camera in frame.cameras:
            self._log_camera(camera, frame, scene)
        self._log_masks(frame, fused)
        self._log_reasons(fused, reasons[: len(fused)])
        self._log_curves(fused, scene, latency_ms or {}, alignment_deg or {})
        self._log_health(health)

    def close(self) -> None:
        """Write what is not yet written."""
        self._stream.flush()
        self._stream.disconnect()

    def _camera(self, name: str) -> str:
        """The entity of a camera."""
        return f"world/cameras/{self._part(name)}"

    def _log_boxes(
        self, entity: str, boxes: FloatArray, colours: Sequence[tuple[int, int, int]], texts: Sequence[str]
    ) -> None:
        quaternions = quaternions_from_yaws(boxes[:, 6])[:, [1, 2, 3, 0]]
        self._stream.log(
            entity,
            self._rerun.Boxes3D(
                centers=boxes[:, :3],
                half_sizes=boxes[:, 3:6] / 2,
                quaternions=quaternions,
                colors=np.array(colours, dtype=np.uint8).reshape(-1, 3),
                labels=list(texts) or None,
                show_labels=False,
            ),
        )

    def _log_points(self, points: NDArray[np.float32] | None, scene: Scene) -> None:
        if points is None:
            return
        thinned = points[:: -(-len(points) // MOST_POINTS) or 1]
        self._stream.log(
            "world/scan", self._rerun.Points3D(thinned[:, :3], colors=point_colours(thinned, scene), radii=0.03)
        )

    def _log_camera(self, camera: Camera, frame: Frame, scene: Scene) -> None:
        entity = self._camera(camera.name)
        self._stream.log(
            entity,
            self._rerun.Transform3D(
                translation=camera.camera_from_lidar[:3, 3],
                mat3x3=camera.camera_from_lidar[:3, :3],
                relation=self._rerun.TransformRelation.ChildFromParent,
            ),
        )
        resolution = [camera.width, camera.height]
        self._stream.log(
            f"{entity}/image", self._rerun.Pinhole(image_from_camera=camera.intrinsics, resolution=resolution)
        )
        pixels = frame.images.get(camera.name)
        if pixels is not None:
            self._stream.log(f"{entity}/image", self._rerun.Image(pixels).compress(jpeg_quality=JPEG_QUALITY))
        found = scene.image_boxes.get(camera.name)
        if found is not None:
            colours = [CAMERA_COLOUR if used else _UNUSED for used in found.used]
            self._stream.log(
                f"{entity}/image/boxes",
                self._rerun.Boxes2D(
                    array=found.boxes,
                    array_format=self._rerun.Box2DFormat.XYXY,
                    colors=np.array(colours, dtype=np.uint8).reshape(-1, 3),
                    # shown under the pointer: all at once they would hide what they name
                    labels=list(found.texts),
                    show_labels=False,
                ),
            )

    def _log_masks(self, frame: Frame, fused: FusedDetections) -> None:
        """Instance masks of each camera as one picture of numbers: 0 for no object."""
        for name, found in zip(fused.camera_names, fused.camera_inputs, strict=True):
            if found.masks is None:
                continue
            camera = frame.camera(name)
            picture = np.zeros((camera.height, camera.width), np.uint8)
            for number, mask in enumerate(found.masks):
                if mask is not None:
                    height, width = mask.bitmap.shape
                    part = picture[mask.y : mask.y + height, mask.x : mask.x + width]
                    part[mask.bitmap[: part.shape[0], : part.shape[1]]] = number % 255 + 1
            self._stream.log(f"{self._camera(name)}/image/masks", self._rerun.SegmentationImage(picture, opacity=0.4))

    def _log_reasons(self, fused: FusedDetections, reasons: Sequence[str]) -> None:
        lines = [f"- {reason}" for reason in reasons] + [f"- *{note}*" for note in fused.notes]
        self._stream.log("reasons", self._rerun.TextDocument("\n".join(lines) or "nothing", media_type="text/markdown"))

    def _log_curves(
        self, fused: FusedDetections, scene: Scene, latency_ms: Mapping[str, float], alignment_deg: Mapping[str, float]
    ) -> None:
        scores = fused.detections.scores
        curves = {"scores/highest": float(scores.max()) if len(scores) else 0.0}
        curves["scores/median"] = float(np.median(scores)) if len(scores) else 0.0
        # every outcome at every frame: a curve that stops would look as if it went on
        curves |= {f"boxes/{outcome}": float(scene.outcomes.count(outcome)) for outcome in COLOURS}
        curves |= {f"latency/{self._part(part)}": value for part, value in latency_ms.items()}
        curves |= {f"alignment/{self._part(camera)}": value for camera, value in alignment_deg.items()}
        for entity, value in curves.items():
            self._stream.log(entity, self._rerun.Scalars(value))

    def _log_health(self, health: Sequence[Mapping[str, Any]]) -> None:
        """Level of every part (0 ok, 1 warning, 2 error, 3 silent) and shares of confirmed boxes as curves; a line of
        text where what is said of a part changes."""
        levels = ("INFO", "WARN", "ERROR", "ERROR")
        for status in health:
            part = str(status["hardware_id"]).removeprefix("camera ")
            self._stream.log(f"health/{self._part(part)}", self._rerun.Scalars(float(status["level"])))
            values = {entry["key"]: entry["value"] for entry in status["values"]}
            share = float(values.get("confirmed_share", "nan"))
            if np.isfinite(share):
                self._stream.log(f"confirmed/{self._part(part)}", self._rerun.Scalars(share))
            if self._messages.get(part) != status["message"]:
                self._messages[part] = status["message"]
                line = self._rerun.TextLog(f"{part}: {status['message']}", level=levels[status["level"]])
                self._stream.log("events", line)


def point_colours(points: NDArray[np.float32], scene: Scene) -> NDArray[np.uint8]:
    """(N, 3) colours of points: that of the outcome of the box they lie in, grey outside of all."""
    colours = np.full((len(points), 3), _GREY, dtype=np.uint8)
    for i in scene.drawing_order:
        x, y, z, length, width, height, yaw = scene.boxes[i]
        moved = points[:, :3] - np.array([x, y, z])
        along = np.cos(yaw) * moved[:, 0] + np.sin(yaw) * moved[:, 1]
        across = np.cos(yaw) * moved[:, 1] - np.sin(yaw) * moved[:, 0]
        inside = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2) & (np.abs(moved[:, 2]) <= height / 2)
        colours[inside] = COLOURS[scene.outcomes[i]]
    return colours


def _blueprint(blueprint: Any, cameras: Sequence[tuple[str, str]], stream: bool) -> Any:
    """Scan and boxes above the cameras (name, entity); beside them reasons, curves and, of a stream, events."""
    views = [
        blueprint.Spatial2DView(origin=f"{entity}/image", name=name, contents="$origin/**") for name, entity in cameras
    ]
    legend = blueprint.PlotLegend(corner=blueprint.Corner2D.LeftTop)

    def curves(*names: str) -> Any:
        shown = [blueprint.TimeSeriesView(origin=n, name=n.capitalize(), plot_legend=legend) for n in names]
        return blueprint.Tabs(*shown)

    beside = [blueprint.TextDocumentView(origin="reasons", name="Reasons")]
    if stream:
        beside.append(blueprint.TextLogView(origin="events", name="Health"))
        beside += [curves("latency", "health", "alignment"), curves("boxes", "scores", "confirmed")]
    else:
        beside += [curves("boxes"), curves("scores")]
    scene = blueprint.Spatial3DView(origin="world", name="Scan and boxes", background=_GROUND)
    cameras_below = [blueprint.Grid(*views, grid_columns=min(len(views), 3))] if views else []
    left = blueprint.Vertical(scene, *cameras_below, row_shares=[3, *([2] if views else [])])
    right = blueprint.Vertical(*beside, row_shares=[3, *([1] if stream else []), 2, 2])
    return blueprint.Blueprint(blueprint.Horizontal(left, right, column_shares=[5, 3]), collapse_panels=True)
