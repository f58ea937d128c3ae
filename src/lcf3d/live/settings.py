"""Settings of a `lcf3d.live.fuser.Fuser`, and what it gives."""

from __future__ import annotations

from dataclasses import dataclass, field

from lcf3d.frame import Frame
from lcf3d.fusion.alignment_watch import WatchSettings
from lcf3d.live.synchronizer import SyncSettings
from lcf3d.provenance import FusedDetections


@dataclass(frozen=True)
class LiveSettings:
    """Settings of a `Fuser` beyond those of the fusion.

    Attributes:
        sync: how messages are grouped.
        realtime: run detectors and the watch in threads, newest first. Without it they run when a message is pushed and
            nothing is left out for want of time: the same messages give the same results.
        watch: settings of the calibration watch, None for no watch.
        watch_period: seconds from one frame that the watch looks at to the next: those in between show the same.
        correct: turn each camera as the watch says, and move it in time.
        leave_out_blinded: do not use a camera that confirms far fewer LiDAR boxes than it used to.
    """

    sync: SyncSettings = field(default_factory=SyncSettings)
    realtime: bool = False
    watch: WatchSettings | None = field(default_factory=WatchSettings)
    watch_period: float = 0.1
    correct: bool = False
    leave_out_blinded: bool = True


@dataclass(frozen=True, eq=False)
class LiveResult:
    """The fusion of one moment.

    Attributes:
        time: of the scan, in the sensors' clock.
        frame: what was fused: cameras as they stood at their own moments, scan and images if there were any.
        fused: the result with its provenance; its notes say which cameras were left out.
        latency_ms: ``wait`` (first LiDAR message to last part), ``fusion``, ``added`` (last part to result); and
            ``detect SOURCE`` where detectors ran. Not the same from run to run.
    """

    time: float
    frame: Frame
    fused: FusedDetections
    latency_ms: dict[str, float]
