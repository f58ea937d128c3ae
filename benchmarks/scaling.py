"""What a second process, shards and a Ray cluster bring: the table of docs/many-machines.md, by whole commands.

    python benchmarks/scaling.py KITTI --lidar results/point_gnn --camera results/rcnn_2d --repeat 3

Each way fuses the same frames into tables, as a command of its own, start of Python included; the median of the
repeats is printed. Processor time is that of the command and all processes it starts and waits for; Ray's belong to
Ray's own servers, so for Ray there is only the clock.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

Way = Callable[[list[str], Path], list[list[list[str]]]]


def one(run: list[str], out: Path) -> list[list[list[str]]]:
    """Commands that run one after the other; those of each step side by side."""
    return [[[*run, "--out", str(out)]]]


def two_processes(run: list[str], out: Path) -> list[list[list[str]]]:
    """See `one`."""
    return [[[*run, "--jobs", "2", "--out", str(out)]]]


def two_shards(run: list[str], out: Path) -> list[list[list[str]]]:
    """See `one`."""
    parts = [str(out.with_name(f"part-{i}")) for i in (1, 2)]
    shards = [[*run, "--shard", f"{i}/2", "--out", part] for i, part in enumerate(parts, 1)]
    return [shards, [[*run[:3], "merge", *parts, "--out", str(out)]]]


def ray(run: list[str], out: Path) -> list[list[list[str]]]:
    """See `one`."""
    return [[[*run, "--ray", "auto", "--out", str(out)]]]


WAYS: dict[str, Way] = {
    "one process": one,
    "--jobs 2": two_processes,
    "two shards side by side, merged": two_shards,
    "--ray auto": ray,
}


def measure(way: Way, run: list[str]) -> tuple[float, float]:
    """Seconds by the clock and of processors."""
    with TemporaryDirectory() as folder:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        for step in way(run, Path(folder) / "out"):
            started = [subprocess.Popen(c, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for c in step]
            if any(process.wait() for process in started):
                sys.exit(f"a command failed: {step}")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        clock = time.perf_counter() - start
    return clock, sum(getattr(after, name) - getattr(before, name) for name in ("ru_utime", "ru_stime"))


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", type=Path)
    parser.add_argument("--lidar", default="results/point_gnn")
    parser.add_argument("--camera", default="results/rcnn_2d")
    parser.add_argument("--split", default="val")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    branches = ["--lidar", f"results:{options.kitti / options.lidar}"]
    branches += ["--camera", f"results:{options.kitti / options.camera}"]
    run = [sys.executable, "-m", "lcf3d", "run", f"kitti:{options.kitti}", "--split", options.split, *branches]
    run += ["--missing", "empty", "--recovery", "off", "--format", "parquet"]
    spent: dict[str, list[tuple[float, float]]] = {name: [] for name in WAYS}
    for _ in range(options.repeat):
        # in turns, so that a busy minute of the machine falls on all of them
        for name, way in WAYS.items():
            spent[name].append(measure(way, run))
    print(f"{'':34} by the clock  of processors")
    for name, values in spent.items():
        clock, processors = (median(column) for column in zip(*values, strict=True))
        print(f"{name:34} {clock:10.1f} s {'' if name == '--ray auto' else f'{processors:12.1f} s'}")


if __name__ == "__main__":
    main()
