"""Frames on a Ray cluster: shards of frames as tasks of a pool of actors, each with dataset and detectors of its own.

A worker builds the run anew from its request, so that only names travel to it, and opens files and networks on its own
machine and GPU. It gives back the files of a shard as bytes, which this process puts into the run folder: the folder
needs no file system that all share, has one writer, and holds the same bytes as after a run in one process.
"""

from __future__ import annotations

import os
import platform
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from lcf3d.detectors.joins import LeftOut
from lcf3d.errors import ConfigError, Lcf3dError, MissingExtraError
from lcf3d.fusion.alignment import Alignment
from lcf3d.fusion.calibration import Calibration
from lcf3d.fusion.config import FusionConfig
from lcf3d.run.folder import RunFolder
from lcf3d.run.frames import FrameRunner, FrameSummary, run_frames, run_shard, shards_of
from lcf3d.run.setup import Run, RunRequest, make_fusion, read_inputs
from lcf3d.run.sources import CameraOnImages, DetectorOnFrames, LidarOnScans
from lcf3d.run.table_folder import TableRunFolder

ATTEMPTS = 3
"""Workers that a shard may cost before the run gives up."""
START_S = 180.0
"""How long to wait for the first worker."""

Files = dict[str, bytes]


@dataclass(frozen=True)
class Plan:
    """What a worker builds the run from.

    Attributes:
        request: what was asked for.
        config: settings.
        calibration: of the scores.
        reports: classes that each camera's detector can report.
        alignment: how cameras stand beside what their calibration says, by name.
        left_out: what the LiDAR branch and each camera branch have counted; a worker does not read everything again.
    """

    request: RunRequest
    config: FusionConfig
    calibration: Calibration | None
    reports: Mapping[str, Any]
    alignment: Mapping[str, Alignment]
    left_out: Mapping[str, LeftOut | None] = field(default_factory=dict)

    @classmethod
    def of(cls, run: Run) -> Plan:
        """The plan of a prepared run."""
        runner = run.runner
        fusion: Any = runner.fusion
        sources = {"": runner.lidar, **runner.cameras}
        left_out = {name: getattr(source, "left_out", None) for name, source in sources.items()}
        return cls(run.request, run.config, fusion.calibration, fusion.reports, dict(runner.alignment), left_out)

    def runner(self, out: Path) -> FrameRunner:
        """What fuses frames into a folder, as in the process that made the plan.

        Raises:
            Lcf3dError: the dataset or a detector is not on this machine.
        """
        inputs = read_inputs(self.request, settings=self.config, look=False)
        for name, source in {"": inputs.lidar, **inputs.cameras}.items():
            # not every source counts, and some add up what others have counted
            if self.left_out.get(name) is not None and "left_out" in vars(source):
                setattr(source, "left_out", self.left_out[name])  # noqa: B010
        tables = self.request.form == "parquet"
        folder = TableRunFolder(out) if tables else RunFolder(out, inputs.dataset.writer(out))
        fusion = make_fusion(self.config, inputs.localizer, self.calibration, self.reports)
        return FrameRunner(inputs.dataset, inputs.lidar, inputs.cameras, fusion, folder, self.alignment)


class ShardWorker:
    """Fuses shards of frames in a process of Ray's."""

    def __init__(self, plan: Plan) -> None:
        self._folder = TemporaryDirectory(prefix="lcf3d-ray-")
        self._plan, self._runner = plan, None  # type: tuple[Plan, FrameRunner | None]

    def versions(self) -> tuple[str, str]:
        """Of lcf3d and Python here."""
        from lcf3d import __version__

        return __version__, platform.python_version()

    def fuse(self, frame_ids: Sequence[str]) -> tuple[list[FrameSummary], Files] | str:
        """Summaries and files of a shard; what lcf3d says where the input is at fault."""
        try:
            if self._runner is None:
                self._runner = self._plan.runner(Path(self._folder.name))
            for source in (self._runner.lidar, *self._runner.cameras.values()):
                # all files of the shard at once
                if getattr(source, "reads_frames", False):
                    source.load(frame_ids)  # type: ignore[attr-defined]
            summaries = list(run_shard(self._runner, frame_ids))
            return summaries, _taken(Path(self._folder.name))
        except Lcf3dError as error:
            return f"{error} (on {platform.node()})"


def _taken(folder: Path) -> Files:
    """The bytes of all files of a folder by their paths in it, removed from there."""
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = path.read_bytes()
            path.unlink()
    return files


def fuse_frames(
    run: Run,
    frame_ids: Sequence[str],
    jobs: int = 1,
    ray: str | None = None,
    sequences: Sequence[Sequence[str]] | None = None,
) -> Iterator[FrameSummary]:
    """Summaries of the frames in order, fused in this process, in others, or on a Ray cluster.

    Args:
        run: prepared, see `lcf3d.run.setup.prepare_run`.
        frame_ids: the frames that are still to be done.
        jobs: processes.
        ray: address of a cluster, see `run_on_ray`.
        sequences: groups of frames that must not be taken apart, see `run_frames`.

    Raises:
        Lcf3dError: see `require_processes`.
    """
    require_processes(run.request, jobs, ray)
    if ray is None:
        return run_frames(run.runner, frame_ids, jobs, sequences)
    return run_on_ray(run, frame_ids, ray)


def require_processes(request: RunRequest, jobs: int, ray: str | None) -> None:
    """Refuse a cluster that a run cannot use, before anything is read.

    Raises:
        ConfigError: ``jobs`` beside ``ray``, or a run that remembers earlier frames.
        MissingExtraError: Ray is not installed.
    """
    if ray is None:
        return
    if jobs > 1:
        raise ConfigError("--ray has a worker for each processor or GPU of its cluster; leave --jobs out")
    if request.memory or request.smooth:
        raise ConfigError("--ray takes drives apart, and --memory and --smooth need them whole; leave one out")
    if find_spec("ray") is None:
        raise MissingExtraError("ray", "fleet", "--ray")


def run_on_ray(run: Run, frame_ids: Sequence[str], address: str) -> Iterator[FrameSummary]:
    """Summaries of the frames in order, as their shards come back from a Ray cluster.

    Args:
        run: prepared, see `lcf3d.run.setup.prepare_run`.
        frame_ids: the frames that are still to be done.
        address: of the cluster; ``auto`` for the one of this machine, started for the time being if there is none.

    Raises:
        ConfigError: the cluster cannot be used.
        MissingExtraError: Ray is not installed.
        Lcf3dError: an input is at fault, or a shard cost `ATTEMPTS` workers.
    """
    shards = shards_of(run.folder, frame_ids, 16)
    if not shards:
        return
    with_ray, started = _connected(address)
    pool = _Pool(with_ray, Plan.of(run), _needs_gpu(run), len(shards))
    try:
        done: dict[int, list[FrameSummary]] = {}
        following = 0
        for number, (summaries, files) in pool.results(shards):
            run.folder.take(files)
            done[number] = summaries
            while following in done:
                yield from done.pop(following)
                following += 1
    finally:
        pool.stop()
        if started:
            with_ray.shutdown()


def _needs_gpu(run: Run) -> bool:
    """Whether a detector runs, and not only files are read."""
    kinds = (LidarOnScans, DetectorOnFrames, CameraOnImages)
    return any(isinstance(source, kinds) for source in (run.runner.lidar, *run.runner.cameras.values()))


def _connected(address: str) -> tuple[Any, bool]:
    """Ray, connected, and whether that was done here."""
    try:
        import ray
    except ImportError:
        raise MissingExtraError("ray", "fleet", "--ray") from None
    if ray.is_initialized():
        return ray, False
    # Ray counts people who use it and writes to the screen; neither is asked for
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        ray.init(
            address=None if address == "auto" else address,
            log_to_driver=False,
            logging_level="ERROR",
            **({} if address != "auto" else {"include_dashboard": False}),
        )
    except (Exception, SystemExit) as error:
        # Ray leaves the program where its own servers do not start in time
        said = (str(error).strip() or type(error).__name__).splitlines()[0]
        where = f"the Ray cluster at {address} cannot be used"
        if address == "auto":
            where = "no Ray cluster can be started here"
        raise ConfigError(
            f"{where} ({said}): it must run, with the Ray {ray.__version__} and Python "
            f"{platform.python_version()} of this machine"
        ) from None
    return ray, True


@dataclass
class _Task:
    """A shard that a worker has, or with no shard a worker that is starting."""

    worker: Any
    shard: int | None = None


class _Pool:
    """Actors that take shards one by one; one that dies is replaced, and its shard goes to another."""

    def __init__(self, ray: Any, plan: Plan, on_gpu: bool, most: int) -> None:
        self._ray = ray
        there = ray.cluster_resources()
        self._on_gpu = on_gpu and there.get("GPU", 0) >= 1
        self._actor = ray.remote(num_cpus=1, num_gpus=1 if self._on_gpu else 0, max_restarts=0)(ShardWorker)
        self._plan = ray.put(plan)
        count = int(there.get("GPU" if self._on_gpu else "CPU", 1))
        self._tasks: dict[Any, _Task] = {}
        for _ in range(max(1, min(count, most))):
            self._start()

    def _start(self) -> None:
        worker = self._actor.remote(self._plan)
        self._tasks[worker.versions.remote()] = _Task(worker)

    def results(self, shards: Sequence[Sequence[str]]) -> Iterator[tuple[int, tuple[list[FrameSummary], Files]]]:
        """Number, summaries and files of each shard, in the order in which they are done."""
        waiting, attempts, left = deque(range(len(shards))), Counter[int | None](), len(shards)
        while left:
            ready, _ = self._ray.wait(list(self._tasks), timeout=START_S)
            if not ready and all(task.shard is None for task in self._tasks.values()):
                kind = "GPU" if self._on_gpu else "CPU"
                raise ConfigError(
                    f"no worker began on the Ray cluster within {START_S:g} s: no {kind} of it is free; the frames "
                    "that are done are kept, go on with --resume"
                )
            for one in ready:
                task = self._tasks.pop(one)
                answer = self._answer(one, task, shards, attempts)
                if answer is None:
                    if task.shard is not None:
                        waiting.appendleft(task.shard)
                    self._start()
                    continue
                if waiting:
                    number = waiting.popleft()
                    self._tasks[task.worker.fuse.remote(list(shards[number]))] = _Task(task.worker, number)
                else:
                    self._ray.kill(task.worker)
                if task.shard is not None:
                    left -= 1
                    yield task.shard, answer

    def _answer(self, one: Any, task: _Task, shards: Sequence[Sequence[str]], attempts: Counter[int | None]) -> Any:
        """What a worker gives; None if it died and another may try.

        Raises:
            Lcf3dError: an input is at fault, the worker is of another version, or too many died.
        """
        try:
            answer = self._ray.get(one)
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, MemoryError):
                raise Lcf3dError("a Ray worker ran out of memory: give it more, then go on with --resume") from None
            raise Lcf3dError(f"a Ray worker failed: {_first_line(error.cause)}") from None
        except self._ray.exceptions.RayError as error:
            number = task.shard
            attempts[number] += 1
            if attempts[number] < ATTEMPTS:
                return None
            frames = "when it began" if number is None else f"on the frames {shards[number][0]} to {shards[number][-1]}"
            raise Lcf3dError(
                f"{attempts[number]} Ray workers died {frames} ({_reason(error)}); the frames that are done are kept: "
                "give a worker more memory, then go on with --resume"
            ) from None
        if isinstance(answer, str):
            raise Lcf3dError(answer)
        if task.shard is None:
            _require_versions(answer)
        return answer

    def stop(self) -> None:
        """End all workers."""
        for task in self._tasks.values():
            self._ray.kill(task.worker)
        self._tasks.clear()


def _require_versions(there: tuple[str, str]) -> None:
    from lcf3d import __version__

    if there[0] != __version__:
        raise ConfigError(f"a Ray worker has lcf3d {there[0]}, this machine {__version__}: install the same on all")


def _reason(error: BaseException) -> str:
    """Why Ray says that a worker died, in a few words."""
    text = str(error).lower()
    if "oom" in text or "out of memory" in text or "low on memory" in text:
        return "the machine ran out of memory"
    return _first_line(error)


def _first_line(error: object) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
