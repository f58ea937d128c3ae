"""Where the results of a stream may go besides to its caller: pictures, a Rerun recording or viewer, lines of health.

Pictures and recordings take longer than a fusion. In real time each has a thread of its own, newest first: what there
was no time for is counted. Without real time every result is drawn.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError
from lcf3d.frame import Frame
from lcf3d.fusion.warm_up import warm_up_frame
from lcf3d.live.fuser import Fuser
from lcf3d.live.settings import LiveResult
from lcf3d.live.workers import Worker
from lcf3d.provenance import FusedDetections
from lcf3d.visualization.trails import Trails

# seconds of the stream between two lines of health
HEALTH_PERIOD = 1.0
# seconds that a thread is waited for at the end
PATIENCE = 60.0


class Output:
    """Something that is done with results, in real time in a thread.

    Args:
        name: of what is made, for the report.
        show: does it with a result and what else belongs to it.
        realtime: in a thread of its own, newest first.

    Attributes:
        done: how many results were shown.
        left_out: how many there was no time for.
        error: what the last one that failed said.
    """

    def __init__(self, name: str, show: Callable[[Any], None], realtime: bool) -> None:
        self.name = name
        self.done = self.left_out = 0
        self.error: str | None = None
        self._show = show
        self._worker = Worker(name, show, self._finished) if realtime else None

    def __call__(self, task: Any) -> None:
        """Show one result, or hand it to the thread."""
        if self._worker is None:
            self._show(task)
            self.done += 1
        elif not self._worker.submit(task):
            self.left_out += 1

    def close(self) -> None:
        """Wait for what is being shown."""
        if self._worker is not None:
            self._worker.wait_idle(PATIENCE)
            self._worker.stop(PATIENCE)

    def report(self) -> str:
        """What was made, in a sentence."""
        late = f", {self.left_out} left out for want of time" if self.left_out else ""
        return f"{self.name}: {self.done} frames{late}{'' if self.error is None else f'; failed: {self.error}'}"

    def _finished(self, task: Any, result: Any, error: Exception | None, spent: float) -> None:
        if error is None:
            self.done += 1
        else:
            self.error = f"{type(error).__name__}: {error}"


class Outputs:
    """All that is wanted of a stream, called with the results as they come.

    Args:
        fuser: for health and how cameras stand.
        realtime: as that of the stream.
        pictures: folder for a PNG a frame, named by its time in seconds.
        rerun: a ``.rrd`` file, or ``viewer``.
        health: file for a JSON line of health a second.
        cameras: names of the cameras, for the layout of the viewer.

    Raises:
        ConfigError: ``rerun`` is neither.
        OSError: a place that cannot be written to.
        MissingExtraError: rerun-sdk is not installed, and a recording is wanted.
    """

    def __init__(
        self,
        fuser: Fuser,
        realtime: bool,
        *,
        pictures: Path | None = None,
        rerun: str | None = None,
        health: Path | None = None,
        cameras: Sequence[str] = (),
    ) -> None:
        self._fuser = fuser
        self._health: IO[str] | None = None
        self._said = 0.0
        self._outputs: list[tuple[Output, Callable[[LiveResult], Any]]] = []
        self._log: Any = None
        if health is not None:
            health.parent.mkdir(parents=True, exist_ok=True)
            # line by line, so that it can be followed and nothing is lost
            self._health = health.open("w", encoding="utf-8", buffering=1)
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            trails = Trails()
            self._outputs.append(
                (Output("pictures", lambda r: draw_result(r, pictures, trails), realtime), lambda r: r)
            )
        if rerun is not None:
            from lcf3d.visualization.rerun_log import RerunLog

            if rerun != "viewer" and Path(rerun).suffix != ".rrd":
                raise ConfigError(f"--rerun takes a file that ends in .rrd, or viewer, got {rerun}")
            self._log = RerunLog(None if rerun == "viewer" else Path(rerun), cameras, stream=True)
            self._outputs.append((Output("recording", self._record, realtime), self._with_health))

    def __call__(self, results: Sequence[LiveResult]) -> None:
        """Results that came, in order of time."""
        for output, task_of in self._outputs:
            for result in results:
                output(task_of(result))
        if self._health is not None and results and not 0 <= results[-1].time - self._said < HEALTH_PERIOD:
            self._said = results[-1].time
            self._health.write(json.dumps({"time": self._said, "status": self._fuser.diagnostics()}) + "\n")

    def warm_up(self) -> None:
        """Compile what draws, so that the first picture does not take time from the first frames."""
        if any(output.name == "pictures" for output, _ in self._outputs):
            frame, lidar, camera = warm_up_frame(self._fuser.fusion.config.class_names)
            _picture(frame, self._fuser.fusion(frame, lidar, camera), Trails())

    def close(self) -> list[str]:
        """Finish everything; a sentence each of what was made."""
        for output, _ in self._outputs:
            output.close()
        if self._log is not None:
            self._log.close()
        if self._health is not None:
            self._health.close()
        return [output.report() for output, _ in self._outputs]

    def _with_health(self, result: LiveResult) -> tuple[LiveResult, dict[str, float], list[dict[str, Any]]]:
        return result, self._fuser.turned_deg(), self._fuser.diagnostics()

    def _record(self, task: tuple[LiveResult, Mapping[str, float], list[dict[str, Any]]]) -> None:
        result, turned, health = task
        self._log.log(result.frame, result.fused, latency_ms=result.latency_ms, alignment_deg=turned, health=health)


def draw_result(result: LiveResult, folder: Path, trails: Trails) -> None:
    """A PNG of a result, named by its time in seconds; tracks with the ways that they came since the one before."""
    from lcf3d.visualization.png import save_png

    save_png(_picture(result.frame, result.fused, trails), folder / f"{result.time:010.3f}.png")


def _picture(frame: Frame, fused: FusedDetections, trails: Trails) -> NDArray[np.uint8]:
    from lcf3d.visualization.png import frame_pixels
    from lcf3d.visualization.scene import Scene

    return frame_pixels(frame, Scene.from_fused(fused, trails=trails(frame, fused)))
