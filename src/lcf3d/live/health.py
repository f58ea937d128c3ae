"""How every sensor of a stream is doing: rates, delays, what was dropped, cameras gone blind, frozen or silent."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.frame import Frame
from lcf3d.fusion.alignment_watch import CameraReport
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.live.messages import CameraBoxes, Image, Message
from lcf3d.live.synchronizer import Synchronizer
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D

OK, WARN, ERROR, STALE = range(4)

# messages that rates and delays are measured over
RECENT = 50
# frames that the share of confirmed boxes is taken over: now, and as it usually is
NOW, USUAL = 20, 300
# a camera is blinded when it confirms less than this share of what it usually confirms, judged on so many boxes
BLINDED, FEWEST_BOXES = 0.3, 15
# LiDAR boxes above this score, and in the image at least so tall, should be confirmed
CONFIDENT, TALL_PX = 0.5, 25.0
# so many equal images or lists of detections one after the other are a frozen camera
FROZEN = 4
# sectors of a scan, and the share of its usual points below which one is missing
SECTORS, MISSING = 36, 0.1
# notes that are kept
NOTES = 20
_HARMLESS = {"duplicate"}


@dataclass
class Stream:
    """What is known of one stream of messages: times by the sensor, times of arrival, equal messages in a row."""

    stamps: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    count: int = 0
    backwards: int = 0
    equal: int = 0
    content: int | None = None

    @property
    def rate(self) -> float:
        """Messages a second by the sensor's clock, NaN with fewer than three."""
        steps = np.diff(np.sort(np.array(self.stamps)))
        middle = float(np.median(steps)) if len(steps) > 1 else 0.0
        return 1 / middle if middle > 0 else float("nan")

    @property
    def delay(self) -> float:
        """Median seconds from a message's time to its arrival, by clocks that may differ; infinite without any."""
        return float(np.median(np.subtract(self.arrivals, self.stamps))) if self.stamps else float("inf")

    @property
    def delay_spread(self) -> float:
        """Seconds by which the slowest twentieth is later than the median."""
        return float(np.percentile(np.subtract(self.arrivals, self.stamps), 95)) - self.delay if self.stamps else 0.0


class Health:
    """Counts and judges; see `diagnostics`.

    Args:
        class_names: classes that cameras should confirm.
    """

    def __init__(self, class_names: Sequence[str]) -> None:
        self.class_names = tuple(class_names)
        self.errors: Counter[str] = Counter()
        self.last_error: dict[str, str] = {}
        self.notes: deque[str] = deque(maxlen=NOTES)
        self.latency: dict[str, deque[float]] = {}
        self.frames = 0
        self.missing_sectors: list[tuple[int, int]] = []
        self._streams: dict[str, Stream] = {}
        self._shares: dict[str, deque[tuple[int, int]]] = {}
        self._blinded: set[str] = set()
        self._absent: Counter[str] = Counter()
        self._sectors: deque[NDArray[np.int64]] = deque(maxlen=RECENT)
        self._told: set[str] = set()

    def tell(self, note: str) -> None:
        """Keep a sentence for the people who look after the stream."""
        self.notes.append(note)

    def tell_once(self, note: str) -> None:
        """The same, unless it was said before."""
        if note not in self._told:
            self._told.add(note)
            self.tell(note)

    def failed(self, source: str, error: Exception) -> None:
        """A detector or the fusion raised."""
        self.errors[source] += 1
        self.last_error[source] = f"{type(error).__name__}: {error}"

    def saw(self, source: str, message: Message, arrival: float) -> None:
        """A message came."""
        stream = self._streams.setdefault(source, Stream())
        stream.count += 1
        if not np.isfinite(message.time):
            return
        if stream.stamps and message.time < stream.stamps[-1]:
            stream.backwards += 1
        stream.stamps.append(message.time)
        stream.arrivals.append(arrival)
        if isinstance(message, Image | CameraBoxes):
            content = _content(message)
            stream.equal = stream.equal + 1 if content is not None and content == stream.content else 0
            stream.content = content

    def fused(
        self,
        frame: Frame,
        result: FusedDetections,
        found: Mapping[str, Detections2D],
        latency: Mapping[str, float],
        points: NDArray[np.float32] | None,
    ) -> None:
        """A moment was fused."""
        self.frames += 1
        for part, milliseconds in latency.items():
            self.latency.setdefault(part, deque(maxlen=1000)).append(milliseconds)
        confident = result.lidar_inputs[np.nan_to_num(result.lidar.lidar_score) > CONFIDENT]
        boxes = confident.with_classes(self.class_names).boxes
        for camera in frame.cameras:
            if camera.name not in found:
                self._absent[camera.name] += 1
                continue
            projected, visible = project_boxes(boxes, camera)
            tall = visible & (projected[:, 3] - projected[:, 1] >= TALL_PX)
            overlap = image_iou(projected[tall], found[camera.name].boxes)
            confirmed = int((overlap > 0.3).any(axis=1).sum()) if overlap.size else 0
            shares = self._shares.setdefault(camera.name, deque(maxlen=USUAL))
            shares.append((int(tall.sum()), confirmed))
            self._judge_sight(camera.name)
        if points is not None:
            self._look_at_sectors(points)

    def share(self, camera: str, frames: int = USUAL) -> tuple[float, int]:
        """Share of confident LiDAR boxes that a camera confirmed over so many frames, and of how many boxes."""
        rows = list(self._shares.get(camera, ()))[-frames:]
        seen = sum(row[0] for row in rows)
        return (sum(row[1] for row in rows) / seen if seen else float("nan")), seen

    def blinded(self) -> frozenset[str]:
        """Cameras that confirm far fewer LiDAR boxes than they used to."""
        return frozenset(self._blinded)

    def _judge_sight(self, camera: str) -> None:
        """Whether a camera is blinded from now on."""
        rows = list(self._shares[camera])
        now, usual = rows[-NOW:], rows[:-NOW]
        seen = sum(row[0] for row in now)
        usually = _share(usual)
        if len(usual) >= NOW and seen >= FEWEST_BOXES and usually > 0.4 and _share(now) < BLINDED * usually:
            self._blinded.add(camera)
        else:
            self._blinded.discard(camera)

    def frozen(self, camera: str) -> bool:
        """Whether a camera has sent the same again and again."""
        stream = self._streams.get(f"camera {camera}")
        return stream is not None and stream.equal >= FROZEN - 1

    def percentile(self, part: str, percent: float) -> float:
        """Of the latest 1,000 latencies of a part, in milliseconds; NaN without any."""
        values = self.latency.get(part)
        return float(np.percentile(np.array(values), percent)) if values else float("nan")

    def diagnostics(
        self,
        sync: Synchronizer,
        reports: Mapping[str, CameraReport],
        cameras: Sequence[str],
        hanging: Mapping[str, float],
    ) -> list[dict[str, Any]]:
        """One entry for the fusion, LiDAR and each camera: name, level, message, values, as ROS has it.

        Args:
            sync: what it dropped and which clocks are off.
            reports: of the calibration watch, by camera.
            cameras: all calibrated cameras.
            hanging: seconds that a detector has been at one message for, by source, where that is too long.
        """
        entries = [self._of_fusion(sync), self._of_lidar(sync, hanging)]
        return entries + [self._of_camera(name, sync, reports.get(name), hanging) for name in cameras]

    def _of_fusion(self, sync: Synchronizer) -> dict[str, Any]:
        stages = {
            "fusion": "frames could not be fused",
            "memory": "frames went without memory",
            "watch": "moments the watch failed at",
            "callback": "results whose callback failed",
        }
        problems = [f"{self.errors[stage]} {what}" for stage, what in stages.items() if self.errors[stage]]
        values = {
            "frames": self.frames,
            "pending": sync.pending,
            "restarts": sync.restarts,
            "latency_added_ms_median": self.percentile("added", 50),
            "latency_added_ms_p99": self.percentile("added", 99),
            "notes": "; ".join(self.notes),
            "last_error": "; ".join(self.last_error[stage] for stage in stages if stage in self.last_error),
        }
        return _entry("fusion", ERROR if problems else OK, problems, values)

    def _of_lidar(self, sync: Synchronizer, hanging: Mapping[str, float]) -> dict[str, Any]:
        level, problems = self._common(["lidar", "scan"], sync, hanging)
        if self.frames == 0:
            level, problems = max(level, WARN), [*problems, "nothing was fused yet"]
        for first, last in self.missing_sectors:
            level = max(level, WARN)
            problems.append(f"no points from {first} to {last} degrees")
        values = self._values(["lidar", "scan"], sync)
        values["missing_sectors_deg"] = "; ".join(f"{a} to {b}" for a, b in self.missing_sectors)
        return _entry("lidar", level, problems, values)

    def _of_camera(
        self, name: str, sync: Synchronizer, report: CameraReport | None, hanging: Mapping[str, float]
    ) -> dict[str, Any]:
        source = f"camera {name}"
        level, problems = self._common([source], sync, hanging)
        if source not in self._streams:
            return _entry(source, STALE, ["nothing came from it"], {})
        if name in self.blinded():
            level = max(level, ERROR)
            problems.append("confirms far fewer LiDAR boxes than it used to")
        if self.frozen(name):
            level = max(level, ERROR)
            problems.append("sends the same image again and again")
        values = self._values([source], sync)
        share, seen = self.share(name, NOW)
        values |= {"confirmed_share": share, "confirmed_of": seen, "absent": self._absent[name]}
        if report is not None:
            alignment = report.to_json()
            values |= {"alignment": report.status, **{k: v for k, v in alignment.items() if k != "status"}}
            if report.status in ("drifting", "wrong"):
                level = max(level, WARN if report.status == "drifting" else ERROR)
                angle = float(np.rad2deg(np.linalg.norm(report.alignment.rotation)))
                problems.append(f"turned by {angle:.2f} degrees against its calibration ({report.status})")
        return _entry(source, level, problems, values)

    def _common(
        self, sources: Sequence[str], sync: Synchronizer, hanging: Mapping[str, float]
    ) -> tuple[int, list[str]]:
        level, problems = OK, []
        for source in sources:
            if self.errors[source]:
                level = max(level, ERROR)
                problems.append(f"its detector failed {self.errors[source]} times, last {self.last_error[source]}")
            if source in hanging:
                level = max(level, ERROR)
                problems.append(f"its detector has not answered for {hanging[source]:.1f} s")
            if source in sync.clocks:
                level = max(level, ERROR)
                problems.append(f"its clock is {sync.clocks[source]:+.1f} s from the LiDAR's: nothing of it is used")
            lost = {c: n for (s, c), n in sync.dropped.items() if s == source and c not in _HARMLESS and c != "clock"}
            if lost:
                level = max(level, WARN)
                problems += [f"{n} messages dropped ({cause})" for cause, n in sorted(lost.items())]
        return level, problems

    def _values(self, sources: Sequence[str], sync: Synchronizer) -> dict[str, Any]:
        values: dict[str, Any] = {}
        # clocks of sensors are not ours: delays are those beyond the quickest sensor's
        quickest = min(s.delay for s in self._streams.values()) if self._streams else 0.0
        for source in sources:
            stream = self._streams.get(source)
            if stream is None:
                continue
            prefix = "scan_" if source == "scan" else ""
            values[f"{prefix}messages"] = stream.count
            values[f"{prefix}rate_hz"] = stream.rate
            values[f"{prefix}delay_ms"] = 1e3 * (stream.delay - quickest)
            values[f"{prefix}delay_spread_ms"] = 1e3 * stream.delay_spread
            values[f"{prefix}backwards"] = stream.backwards
        values["dropped"] = sum(n for (source, _), n in sync.dropped.items() if source in sources)
        return values

    def _look_at_sectors(self, points: NDArray[np.float32]) -> None:
        """Compare the points in each sector with those of the scans before."""
        angles = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
        finite = angles[np.isfinite(angles)]
        counts = np.bincount(((finite + 180) // (360 / SECTORS)).astype(np.int64) % SECTORS, minlength=SECTORS)
        usual = np.median(np.array(self._sectors), axis=0) if len(self._sectors) >= 5 else np.zeros(SECTORS)
        gone = (usual >= 20) & (counts < MISSING * usual)
        self.missing_sectors = _runs(gone)
        if not gone.any():
            self._sectors.append(counts)


def _share(rows: Sequence[tuple[int, int]]) -> float:
    seen = sum(row[0] for row in rows)
    return sum(row[1] for row in rows) / seen if seen else float("nan")


def _runs(gone: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Degrees from and to of each run of sectors, counted from -180."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], gone, [False]]).astype(np.int8)))
    width = 360 // SECTORS
    return [(int(a) * width - 180, int(b) * width - 180) for a, b in edges.reshape(-1, 2)]


def _content(message: Image | CameraBoxes) -> int | None:
    """A number that equal contents share; None for what says nothing, such as no detections."""
    if isinstance(message, Image):
        return hash(message.pixels[::37, ::41].tobytes())
    found = message.detections
    return hash((found.boxes.tobytes(), found.scores.tobytes())) if len(found) else None


def _entry(name: str, level: int, problems: Sequence[str], values: Mapping[str, Any]) -> dict[str, Any]:
    """One ``DiagnosticStatus`` as plain values."""
    return {
        "name": f"lcf3d: {name}",
        "level": level,
        "message": "; ".join(problems) if problems else "ok",
        "hardware_id": name,
        "values": [{"key": key, "value": _text(value)} for key, value in values.items()],
    }


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
