"""How a stream is doing, in the form of ROS ``diagnostic_msgs/DiagnosticStatus``.

Levels and their messages come from the latest seconds of the stream (`lcf3d.live.counting.LATELY`): what went wrong
before is in the counts only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lcf3d.fusion.alignment_watch import CameraReport
from lcf3d.live.counting import LATELY
from lcf3d.live.health import Health
from lcf3d.live.synchronizer import Synchronizer

OK, WARN, ERROR, STALE = range(4)

# a camera that was missing at such a share of recent moments is told, once there were so many
ABSENT, FEWEST_MOMENTS = 0.6, 10
# causes of dropped messages that say nothing about the sensor, or are told in other words
_HARMLESS = {"duplicate", "clock", "no lidar"}
_STAGES = {
    "fusion": "frames could not be fused",
    "memory": "frames went without memory",
    "watch": "moments the watch failed at",
    "callback": "results whose callback failed",
}
_LATELY = f"in the latest {LATELY:.0f} s"


class Diagnostics:
    """One entry for the fusion, LiDAR and each camera: name, level, message, values.

    Args:
        health: what was seen.
        sync: what it dropped and which clocks are off.
        reports: of the calibration watch, by camera.
        hanging: seconds that a detector or the watch has been at one message for, by source, where that is too long.
        quiet: seconds for which nothing at all has come, where the stream is in real time.
    """

    def __init__(
        self,
        health: Health,
        sync: Synchronizer,
        reports: Mapping[str, CameraReport],
        hanging: Mapping[str, float],
        quiet: float,
    ) -> None:
        self._health, self._sync, self._reports, self._hanging, self._quiet = health, sync, reports, hanging, quiet
        self._errors, self._lost = health.errors.lately(), sync.dropped.lately()
        # clocks of sensors are not ours: delays are those beyond the quickest sensor's
        delays = [s.delay for source, s in health.streams.items() if source not in sync.clocks]
        self._quickest = min(delays, default=0.0)

    def entries(self, cameras: Sequence[str]) -> list[dict[str, Any]]:
        """Those of the fusion, of LiDAR, of all calibrated cameras, and of those that send without a calibration."""
        sending = [source.removeprefix("camera ") for source in self._health.streams if source.startswith("camera ")]
        unknown = [name for name in sending if name not in cameras]
        entries = [self._of_fusion(), self._of_lidar(), *(self._of_camera(name) for name in cameras)]
        for name in unknown:
            told = "has no calibration: nothing of it is used"
            entries.append(_entry(f"camera {name}", ERROR, [told], self._values([f"camera {name}"])))
        return entries

    def _of_fusion(self) -> dict[str, Any]:
        health, errors = self._health, self._errors
        problems = [f"{errors[stage]} {what} {_LATELY}" for stage, what in _STAGES.items() if errors[stage]]
        if "watch" in self._hanging:
            problems.append(f"the calibration watch has not answered for {self._hanging['watch']:.1f} s")
        values = {
            "frames": health.frames,
            "pending": self._sync.pending,
            "restarts": self._sync.restarts,
            "failed": sum(health.errors.total[stage] for stage in _STAGES),
            "latency_added_ms_median": health.percentile("added", 50),
            "latency_added_ms_p99": health.percentile("added", 99),
            "notes": "; ".join(health.notes),
            "last_error": "; ".join(health.last_error[stage] for stage in _STAGES if stage in health.last_error),
        }
        return _entry("fusion", ERROR if problems else OK, problems, values)

    def _of_lidar(self) -> dict[str, Any]:
        health, sources = self._health, [s for s in ("lidar", "scan") if s in self._health.streams]
        level, problems = self._common(["lidar", "scan"])
        if not sources:
            level, problems = STALE, [*problems, "nothing came from it"]
        elif health.frames == 0:
            level, problems = max(level, WARN), [*problems, "nothing was fused yet"]
        if sources and self._sync.settings.scans and "scan" not in sources:
            level, problems = max(level, WARN), [*problems, "no scan came, though every moment waits for one"]
        for first, last in health.missing_sectors:
            level = max(level, WARN)
            problems.append(f"no points from {first} to {last} degrees")
        values = self._values(["lidar", "scan"])
        values["missing_sectors_deg"] = "; ".join(f"{a} to {b}" for a, b in health.missing_sectors)
        return _entry("lidar", level, problems, values)

    def _of_camera(self, name: str) -> dict[str, Any]:
        health, source = self._health, f"camera {name}"
        level, problems = self._common([source])
        if source not in health.streams:
            level, problems = STALE, [*problems, "nothing came from it"]
        absent, moments = health.absent.lately()[name], health.moments.lately()[name]
        if moments >= FEWEST_MOMENTS and absent >= ABSENT * moments and level < ERROR:
            level = max(level, WARN)
            problems.append(f"missing at {absent} of {moments} moments {_LATELY}")
        if name in health.blinded():
            level = max(level, ERROR)
            problems.append("confirms far fewer LiDAR boxes than it used to")
        if health.frozen(name):
            level = max(level, ERROR)
            problems.append("sends the same image again and again")
        values = self._values([source])
        share, seen = health.share(name)
        values |= {"confirmed_share": share, "confirmed_of": seen, "absent": health.absent.total[name]}
        report = self._reports.get(name)
        if report is not None:
            alignment = report.to_json()
            values |= {"alignment": report.status, **{k: v for k, v in alignment.items() if k != "status"}}
            if report.status in ("drifting", "wrong"):
                level = max(level, WARN if report.status == "drifting" else ERROR)
                angle = float(np.rad2deg(np.linalg.norm(report.alignment.rotation)))
                problems.append(f"turned by {angle:.2f} degrees against its calibration ({report.status})")
        return _entry(source, level, problems, values)

    def _common(self, sources: Sequence[str]) -> tuple[int, list[str]]:
        """What any sensor may have."""
        health, level, problems = self._health, OK, []
        for source in sources:
            silent = health.silent(source, self._quiet)
            if silent is not None:
                level = max(level, STALE)
                problems.append(f"no {'scan' if source == 'scan' else 'message'} for {silent:.1f} s")
            if self._errors[source]:
                level = max(level, ERROR)
                told = f"its detector failed {self._errors[source]} times {_LATELY}"
                problems.append(f"{told}, last {health.last_error[source]}")
            if source in self._hanging:
                level = max(level, ERROR)
                problems.append(f"its detector has not answered for {self._hanging[source]:.1f} s")
            if source in self._sync.clocks:
                level = max(level, ERROR)
                lead = self._sync.clocks[source]
                problems.append(f"its clock is {lead:+.1f} s from the LiDAR's: nothing of it is used")
            lost = {cause: n for (s, cause), n in self._lost.items() if s == source and cause not in _HARMLESS}
            if lost:
                level = max(level, WARN)
                problems += [f"{n} messages dropped ({cause}) {_LATELY}" for cause, n in sorted(lost.items())]
        return level, problems

    def _values(self, sources: Sequence[str]) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for source in sources:
            stream = self._health.streams.get(source)
            if stream is None:
                continue
            prefix = "scan_" if source == "scan" else ""
            values[f"{prefix}messages"] = stream.count
            values[f"{prefix}rate_hz"] = stream.rate
            if source not in self._sync.clocks:
                values[f"{prefix}delay_ms"] = 1e3 * (stream.delay - self._quickest)
            values[f"{prefix}delay_spread_ms"] = 1e3 * stream.delay_spread
            values[f"{prefix}backwards"] = stream.backwards
        values["dropped"] = sum(n for (source, _), n in self._sync.dropped.total.items() if source in sources)
        values["failed"] = sum(self._health.errors.total[source] for source in sources)
        return values


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
