"""Runs on a real Ray cluster of two nodes on this machine, and what is said where there is none."""

import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

import lcf3d
from lcf3d.datasets import kitti_results
from lcf3d.detectors.joins import LeftOut
from lcf3d.errors import ConfigError, Lcf3dError, MissingExtraError
from lcf3d.run import ray_workers
from lcf3d.run.folder import RunFolder
from lcf3d.run.ray_workers import Plan, ShardWorker, run_on_ray
from lcf3d.run.setup import RunRequest, prepare_run
from tests.datasets.kitti_folder import make_kitti, make_results
from tests.run.test_fleet import content

IDS = tuple(f"{i:06d}" for i in range(40))
PARTS = ("data", "provenance", "detections")


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    make_kitti(folder / "kitti", IDS)
    make_results(folder, IDS)
    return folder


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a cluster of two nodes with a processor each."""
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'lcf3d[fleet]'")
    from ray.cluster_utils import Cluster

    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    try:
        node = {"num_cpus": 1, "object_store_memory": 100 * 2**20, "include_log_monitor": False}
        started = Cluster(initialize_head=True, head_node_args={**node, "include_dashboard": False})
        started.add_node(**node)
    except (Exception, SystemExit) as error:
        pytest.skip(f"Ray's own servers did not start on this machine in time: {error!r}")
    yield started.address
    ray.shutdown()
    started.shutdown()


def request(root: Path, **options) -> RunRequest:
    camera = {"*": f"results:{root / 'camera'}"}
    return RunRequest(f"kitti:{root / 'kitti'}", f"results:{root / 'lidar'}", camera, **options)


def fused(root: Path, out: Path, **options) -> dict:
    asked = request(root)
    return lcf3d.run(asked.dataset, asked.lidar, asked.cameras, out, **options)


def test_a_cluster_that_is_not_there(root: Path, tmp_path: Path, refused_by) -> None:
    # before there is one that Ray would already be connected with
    pytest.importorskip("ray", reason="needs Ray: pip install 'lcf3d[fleet]'")
    asked = request(root)
    command = ["run", asked.dataset, "--lidar", asked.lidar, "--camera", asked.cameras["*"], "--out", tmp_path / "out"]
    said = refused_by(*command, "--ray", "nonsense://x")
    assert said.startswith("error: the Ray cluster at nonsense://x cannot be used (")


def test_a_cluster_gives_the_same_bytes(
    root: Path, tmp_path: Path, cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lcf3d.run.frames.SHARD_FRAMES", 16)
    one = fused(root, tmp_path / "one", form="parquet")
    counts = fused(root, tmp_path / "two", form="parquet", ray=cluster)
    assert content(tmp_path / "one", *PARTS) == content(tmp_path / "two", *PARTS)
    assert {k: v for k, v in counts.items() if k not in ("median_ms", "out")} == {
        k: v for k, v in one.items() if k not in ("median_ms", "out")
    }
    # what a lost shard held is fused again
    lost = next((tmp_path / "two" / "provenance").iterdir())
    lost.unlink()
    again = fused(root, tmp_path / "two", form="parquet", ray=cluster, resume=True)
    assert again["already_done"] in (24, 32)
    assert content(tmp_path / "one", *PARTS) == content(tmp_path / "two", *PARTS)


def test_workers_that_are_killed_are_replaced(
    root: Path, tmp_path: Path, cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = fused(root, tmp_path / "one")
    import ray

    pids, killed = [], []
    start, take = ray_workers._Pool._start, RunFolder.take

    def starting(self) -> None:
        start(self)
        worker = list(self._tasks.values())[-1].worker
        pids.append(worker.__ray_call__.remote(lambda worker: os.getpid()))

    def taking(self, files) -> None:
        take(self, files)
        if not killed:
            # those that have begun: the one that has just answered, and if it is quick the one that is at work
            ready, _ = ray.wait(pids, num_returns=len(pids), timeout=0)
            killed.extend(ray.get(ready))
            for pid in killed:
                os.kill(pid, signal.SIGKILL)

    monkeypatch.setattr(ray_workers._Pool, "_start", starting)
    monkeypatch.setattr(RunFolder, "take", taking)
    two = fused(root, tmp_path / "two", ray=cluster)
    assert killed
    # each of the two nodes had a worker, and each that was killed another in its place
    assert len(pids) == 2 + len(killed)
    assert one["outputs"] == two["outputs"]
    assert content(tmp_path / "one", *PARTS) == content(tmp_path / "two", *PARTS)


def test_shards_that_no_worker_survives(
    root: Path, tmp_path: Path, cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Dying(ShardWorker):
        def fuse(self, frame_ids):
            os.kill(os.getpid(), signal.SIGKILL)

    Dying.__module__ = "__main__"
    monkeypatch.setattr(ray_workers, "ShardWorker", Dying)
    monkeypatch.setattr(ray_workers, "ATTEMPTS", 2)
    with pytest.raises(Lcf3dError, match=r"2 Ray workers died on the frames 000000 to 000003 \(.*--resume"):
        fused(root, tmp_path / "out", ray=cluster, frames=IDS[:4])


def test_what_is_wrong_on_a_worker_is_said(
    root: Path, tmp_path: Path, cluster: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # one shard, and so one worker
    ids = IDS[:4]
    prepared = prepare_run(request(root, frames=ids), tmp_path / "out")
    (root / "kitti").rename(root / "away")
    try:
        with pytest.raises(Lcf3dError, match=r"dataset folder .*kitti does not exist \(on "):
            list(run_on_ray(prepared, ids, cluster))
    finally:
        (root / "away").rename(root / "kitti")
    monkeypatch.setattr("lcf3d.__version__", "0.0.0")
    with pytest.raises(ConfigError, match=r"a Ray worker has lcf3d .*, this machine 0.0.0"):
        list(run_on_ray(prepared, ids, cluster))
    prepared.folder.release()


def test_a_worker_without_a_cluster(root: Path, tmp_path: Path) -> None:
    prepared = prepare_run(request(root), tmp_path / "out")
    worker = ShardWorker(Plan.of(prepared))
    summaries, files = worker.fuse(IDS[:3])
    assert [summary.frame_id for summary in summaries] == list(IDS[:3])
    assert set(files) == {f"{f}/{i}.{e}" for i in IDS[:3] for f, e in (("data", "txt"), ("provenance", "json"))}
    # nothing is left of a shard when the next begins
    assert len(worker.fuse(IDS[3:4])[1]) == 2
    prepared.folder.take(files)
    assert prepared.folder.frame_ids() == list(IDS[:3])
    prepared.folder.release()


def test_a_worker_reads_the_files_of_its_shards_at_once(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = prepare_run(request(root), tmp_path / "out")
    prepared.folder.release()
    worker = ShardWorker(Plan.of(prepared))
    read: list[tuple[str, ...]] = []
    read_folder = kitti_results.read_folder

    def noting(folder: Path, frame_ids, **options):
        read.append(tuple(frame_ids))
        return read_folder(folder, frame_ids, **options)

    monkeypatch.setattr(kitti_results, "read_folder", noting)
    # a part must not list the files of all others
    list_it = os.scandir
    monkeypatch.setattr(os, "scandir", lambda a=".": pytest.fail("listed") if str(root) in str(a) else list_it(a))
    summaries, _ = worker.fuse(IDS[4:9])
    assert len(summaries) == 5
    assert read == [IDS[4:9], IDS[4:9]]


def test_sources_that_add_up_what_others_count_go_to_a_worker_too(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Several:
        """As a folder of results for each camera."""

        @property
        def left_out(self) -> LeftOut:
            return LeftOut("somewhere", taken=3)

    prepared = prepare_run(request(root), tmp_path / "out")
    prepared.folder.release()
    plan = Plan.of(prepared)
    inputs = ray_workers.read_inputs(prepared.request, look=False)
    monkeypatch.setattr(ray_workers, "read_inputs", lambda *a, **k: inputs._replace(cameras={"left": Several()}))
    assert plan.runner(tmp_path / "worker").cameras["left"].left_out.taken == 3


def test_memory_of_drives_and_ray_do_not_go_together(root: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="takes drives apart"):
        fused(root, tmp_path / "out", memory=True, ray="auto")
    with pytest.raises(ConfigError, match="leave --jobs out"):
        fused(root, tmp_path / "other", jobs=2, ray="auto")


def test_no_ray(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"--ray needs ray; install it with: pip install 'lcf3d\[fleet\]'"):
        fused(root, tmp_path / "out", ray="auto")


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ("The actor died. Task was killed due to the node running low on memory.", "the machine ran out of memory"),
        ("Worker exit detail: OOM", "the machine ran out of memory"),
        ("The actor died unexpectedly.\nmore", "The actor died unexpectedly."),
    ],
)
def test_why_workers_die(said: str, reason: str) -> None:
    assert ray_workers._reason(RuntimeError(said)) == reason


class Failing:
    """Stands for Ray where a worker fails: gives the error whatever is asked for."""

    class exceptions:
        class RayError(Exception):
            """Of Ray itself."""

        class RayTaskError(RayError):
            """Of a worker."""

            cause: BaseException

    def __init__(self, cause: BaseException | None = None) -> None:
        self.error = self.exceptions.RayTaskError() if cause else self.exceptions.RayError("died: out of memory")
        if cause:
            self.error.cause = cause

    def get(self, one: object) -> object:
        raise self.error


def test_workers_without_memory_are_said() -> None:
    def answer(ray: Failing, attempts: Counter) -> object:
        pool = object.__new__(ray_workers._Pool)
        pool._ray = ray
        return pool._answer("one", ray_workers._Task("worker", 0), [("a", "b", "c")], attempts)

    with pytest.raises(Lcf3dError, match="a Ray worker ran out of memory: give it more"):
        answer(Failing(MemoryError()), Counter())
    with pytest.raises(Lcf3dError, match="a Ray worker failed: no such thing"):
        answer(Failing(RuntimeError("no such thing\nat line 3")), Counter())
    # another worker may have more
    attempts: Counter = Counter()
    assert [answer(Failing(), attempts) for _ in range(2)] == [None, None]
    with pytest.raises(Lcf3dError, match=r"3 Ray workers died on the frames a to c \(the machine ran out of memory\)"):
        answer(Failing(), attempts)


def test_a_cluster_that_does_not_start(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'lcf3d[fleet]'")

    def leave(**options: object) -> None:
        raise SystemExit(1)

    monkeypatch.setattr(ray, "init", leave)
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with pytest.raises(ConfigError, match="no Ray cluster can be started here"):
        fused(root, tmp_path / "out", ray="auto")
