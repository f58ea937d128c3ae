"""What a million frames cost: the table of docs/many-machines.md, from pieces that are measured here.

    python benchmarks/many_machines.py KITTI --lidar results:DIR --camera results:DIR

Fuses the frames once as `lcf3d run --recovery off --format parquet` does, then measures apart what each process of a
run on many machines does: the first reads all results and takes in finished shards, workers fuse, and a store
elsewhere is listed and read. Processor time where a processor works, wall time where an answer is waited for. The store
is this disk with a delay before each answer (`--delay`), as that of a bucket.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

MILLION = 1_000_000
OBJECTS = 20_000
FETCHED = 400


def seconds(call: Callable[[], object], clock: Callable[[], float] = time.process_time) -> float:
    """How long a call takes by a clock."""
    before = clock()
    call()
    return clock() - before


def frame_costs(dataset: str, lidar: str, camera: str, folder: Path) -> tuple[dict[str, float], float]:
    """Seconds of a processor a frame, by piece, and bytes a frame."""
    from lcf3d.run.frames import shards_of
    from lcf3d.run.ray_workers import Plan, ShardWorker
    from lcf3d.run.setup import RunRequest, prepare_run
    from lcf3d.run.table_folder import TableRunFolder

    request = RunRequest(dataset, lidar, {"*": camera}, split="val", recovery="off", form="parquet")
    runs = []
    # the first run also compiles
    prepare_run(request, folder / "warm").folder.release()
    read = seconds(lambda: runs.append(prepare_run(request, folder / "run")))
    run = runs[0]
    worker = ShardWorker(Plan.of(run))
    shards = shards_of(run.folder, run.frame_ids, 16)
    worker.fuse(shards[0][:50])
    done = []
    fuse = seconds(lambda: done.extend(worker.fuse(shard) for shard in shards))
    take = seconds(lambda: [run.folder.take(files) for _, files in done])
    size = sum(len(content) for _, files in done for content in files.values())
    run.folder.finish(run.frame_ids)
    ids = seconds(TableRunFolder(folder / "run").frame_ids)
    n = len(run.frame_ids)
    costs = {"read results and calibrate": read, "fuse": fuse, "take in": take, "list a finished run": ids}
    return {name: value / n for name, value in costs.items()}, size / n


def store_costs(delay_s: float, cache: Path) -> tuple[float, float, float, float]:
    """Seconds to list an object, and again; files a second one by one, and with those fetched ahead."""
    import fsspec

    from lcf3d.remote import mirror
    from lcf3d.remote.places import local

    os.environ["LCF3D_CACHE"] = str(cache)
    store, place = fsspec.filesystem("file"), cache / "place"
    place.mkdir(parents=True)
    for i in range(OBJECTS):
        (place / f"{i:06d}.txt").write_bytes(b"Car 0 0 0\n")
    first, again = (seconds(lambda: local(f"file://{place}")) / OBJECTS for _ in range(2))
    answer = type(store).get_file

    def later(self: object, *arguments: object, **options: object) -> None:
        time.sleep(delay_s)
        answer(self, *arguments, **options)

    type(store).get_file = later
    rates, folder = [], local(f"file://{place}")
    for ahead in (0, mirror.AHEAD):
        mirror.AHEAD = ahead
        names = sorted(folder.glob("*.txt"))[len(rates) * FETCHED :][:FETCHED]
        rates.append(len(names) / seconds(lambda names=names: [p.read_bytes() for p in names], time.perf_counter))
    return first, again, rates[0], rates[1]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti")
    parser.add_argument("--lidar", required=True)
    parser.add_argument("--camera", required=True)
    parser.add_argument("--delay", type=float, default=0.03, help="seconds that the store takes to answer")
    chosen = parser.parse_args()
    # what is fetched ahead may still be arriving
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        costs, size = frame_costs(f"kitti:{chosen.kitti}", chosen.lidar, chosen.camera, Path(folder))
        first, again, alone, ahead = store_costs(chosen.delay, Path(folder) / "cache")
    for name, value in costs.items():
        print(f"{name:28} {value * 1e3:7.3f} ms a frame  {value * MILLION:8.0f} s a million")
    print(f"{'a shard holds':28} {size:7.0f} bytes a frame  {size * MILLION / 1e9:6.1f} GB a million")
    print(f"{'list an object':28} {first * 1e6:7.0f} us, again {again * 1e6:.0f} us")
    print(f"{'fetch, one by one':28} {alone:7.0f} files a second at {chosen.delay * 1e3:.0f} ms an answer")
    print(f"{'fetch, ahead':28} {ahead:7.0f} files a second")
    serial = costs["read results and calibrate"] + costs["take in"]
    for workers in (1, 8, 64):
        print(
            f"a million frames, {workers:2} workers: {(serial + costs['fuse'] / workers) * MILLION / 60:6.0f} minutes"
        )
    print(f"more than {costs['fuse'] / serial:.0f} workers wait for the first process")


if __name__ == "__main__":
    main()
