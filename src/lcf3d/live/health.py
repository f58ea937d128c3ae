"""How every sensor of a stream is doing: rates, delays, failures, cameras gone blind, frozen or silent."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lcf3d.frame import Frame
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.live.counting import RECENT, Stream, StreamClock, Tally
from lcf3d.live.messages import CameraBoxes, Image, Message
from lcf3d.provenance import FusedDetections
from lcf3d.structures import Detections2D

# a source is silent when nothing came for this long (seconds), and for so many of its usual periods
SILENT, PERIODS = 1.0, 3.0
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


class Health:
    """Counts and judges; `lcf3d.live.diagnostics` says it.

    Args:
        class_names: classes that cameras should confirm.
    """

    def __init__(self, class_names: Sequence[str]) -> None:
        self.class_names = tuple(class_names)
        self.clock = StreamClock()
        self.errors: Tally[str] = Tally(self.clock)
        self.last_error: dict[str, str] = {}
        self.notes: deque[str] = deque(maxlen=NOTES)
        self.latency: dict[str, deque[float]] = {}
        self.frames = 0
        self.missing_sectors: list[tuple[int, int]] = []
        self.streams: dict[str, Stream] = {}
        # boxes to confirm and confirmed, by frame: of the latest frames, and of those before
        self._shares: dict[str, deque[tuple[int, int]]] = {}
        self._usual: dict[str, deque[tuple[int, int]]] = {}
        self._blinded: set[str] = set()
        self.moments: Tally[str] = Tally(self.clock)
        self.absent: Tally[str] = Tally(self.clock)
        self._arrival = 0.0
        self._sectors: deque[NDArray[np.float64]] = deque(maxlen=RECENT)
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
        self.errors.add(source)
        self.last_error[source] = f"{type(error).__name__}: {error}"

    def saw(self, source: str, message: Message, arrival: float) -> None:
        """A message came."""
        stream = self.streams.setdefault(source, Stream())
        stream.count += 1
        if not np.isfinite(message.time):
            return
        self.clock.saw(source, message.time)
        self._arrival = arrival
        if stream.stamps and message.time < stream.stamps[-1]:
            stream.backwards += 1
        stream.stamps.append(message.time)
        stream.arrivals.append(arrival)
        if isinstance(message, Image | CameraBoxes):
            content = _content(message)
            stream.equal = stream.equal + 1 if content is not None and content == stream.content else 0
            stream.content = content

    def began_anew(self) -> None:
        """Time went back by much."""
        self.tell("time went back: everything began anew")
        for stream in self.streams.values():
            stream.begin_anew()

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
            self.moments.add(camera.name)
            if camera.name not in found:
                self.absent.add(camera.name)
                continue
            projected, visible = project_boxes(boxes, camera)
            tall = visible & (projected[:, 3] - projected[:, 1] >= TALL_PX)
            overlap = image_iou(projected[tall], found[camera.name].boxes)
            confirmed = int((overlap > 0.3).any(axis=1).sum()) if overlap.size else 0
            self._shares.setdefault(camera.name, deque()).append((int(tall.sum()), confirmed))
            self._usual.setdefault(camera.name, deque(maxlen=USUAL))
            if len(self._shares[camera.name]) > NOW:
                before = self._shares[camera.name].popleft()
                if camera.name not in self._blinded:
                    self._usual[camera.name].append(before)
            self._judge_sight(camera.name)
        if points is None:
            self.missing_sectors = []
        else:
            self._look_at_sectors(points)

    def share(self, camera: str) -> tuple[float, int]:
        """Share of confident LiDAR boxes that a camera confirmed over the latest `NOW` frames, and of how many."""
        rows = self._shares.get(camera, ())
        return _share(rows), sum(row[0] for row in rows)

    def blinded(self) -> frozenset[str]:
        """Cameras that confirm far fewer LiDAR boxes than they used to."""
        return frozenset(self._blinded)

    def silent(self, source: str, quiet: float = 0.0) -> float | None:
        """Seconds since a source was seen, where that is too long; None otherwise, and for one that never was.

        Args:
            source: its name.
            quiet: seconds for which nothing at all has come, where somebody's own clock can tell.
        """
        stream = self.streams.get(source)
        if stream is None:
            return None
        seconds = self.clock.silent(source) + quiet
        period = np.nan_to_num(1 / stream.rate)
        return seconds if seconds > max(SILENT, PERIODS * period) else None

    def quiet(self, now: float) -> float:
        """Seconds since anything came, by the clock that arrivals are told in."""
        return max(now - self._arrival, 0.0) if self.streams else 0.0

    def _judge_sight(self, camera: str) -> None:
        """Whether a camera is blinded from now on; with too few boxes to tell it stays as it was.

        What a blinded camera confirms does not become what is usual, however long it lasts.
        """
        now, usual = self._shares[camera], self._usual[camera]
        seen = sum(row[0] for row in now)
        if seen < FEWEST_BOXES:
            return
        usually = _share(usual)
        if len(usual) >= NOW and usually > 0.4 and _share(now) < BLINDED * usually:
            self._blinded.add(camera)
        else:
            self._blinded.discard(camera)

    def frozen(self, camera: str) -> bool:
        """Whether a camera has sent the same again and again."""
        stream = self.streams.get(f"camera {camera}")
        return stream is not None and stream.equal >= FROZEN - 1

    def percentile(self, part: str, percent: float) -> float:
        """Of the latest 1,000 latencies of a part, in milliseconds; NaN without any."""
        values = self.latency.get(part)
        return float(np.percentile(np.array(values), percent)) if values else float("nan")

    def _look_at_sectors(self, points: NDArray[np.float32]) -> None:
        """Compare the points in each sector with those of the scans before."""
        angles = np.rad2deg(np.arctan2(points[:, 1], points[:, 0]))
        finite = angles[np.isfinite(angles)]
        counts = np.bincount(((finite + 180) // (360 / SECTORS)).astype(np.int64) % SECTORS, minlength=SECTORS)
        usual = np.median(np.array(self._sectors), axis=0) if len(self._sectors) >= 5 else np.zeros(SECTORS)
        gone = (usual >= 20) & (counts < MISSING * usual)
        self.missing_sectors = _runs(gone)
        # what is gone does not become what is usual
        self._sectors.append(np.where(gone, usual, counts))


def _share(rows: Iterable[tuple[int, int]]) -> float:
    rows = list(rows)
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
