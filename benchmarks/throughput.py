"""How many frames one core fuses a second: processor time of a run on KITTI result files, stretch by stretch.

    python benchmarks/throughput.py KITTI --lidar results/point_gnn --camera results/rcnn_2d --form parquet

Processor time (own and the system's, of this process and those it starts) says what a core does even where others use
the machine, but a busy machine makes it longer too: compare figures of one sitting only.
"""

from __future__ import annotations

import argparse
import logging
import resource
import tempfile
from pathlib import Path

import numpy as np

from lcf3d.run.frames import run_frames
from lcf3d.run.setup import Run, RunRequest, prepare_run

STRETCH = 250


def cpu_s() -> tuple[float, float]:
    """Processor seconds of this process, and of those that it started and that have ended."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime, children.ru_utime + children.ru_stime


def prepared(options: argparse.Namespace, out: Path, frames: tuple[str, ...] = ()) -> Run:
    """The run, result files read and scores calibrated."""
    return prepare_run(
        RunRequest(
            f"kitti:{options.kitti}",
            f"results:{options.kitti / options.lidar}",
            {"*": f"results:{options.kitti / options.camera}"},
            split=options.split,
            frames=frames,
            recovery=options.recovery,
            missing="empty",
            form=options.form,
        ),
        out,
    )


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Print the processor time of getting ready, of stretches of frames, and of all in ``--jobs`` processes."""
    before = cpu_s()[0]
    run = prepared(options, folder / "run")
    ready = (cpu_s()[0] - before) / len(run.frame_ids)
    spent = []
    for start in range(0, len(run.frame_ids), STRETCH):
        part = run.frame_ids[start : start + STRETCH]
        before = cpu_s()[0]
        list(run_frames(run.runner, part))
        spent.append((cpu_s()[0] - before) / len(part))
    run.folder.finish(run.frame_ids)
    best, median = min(spent), float(np.median(spent))
    print(f"{options.form}: ready {ready * 1e3:.2f} ms a frame, fused and written {best * 1e3:.2f} to ", end="")
    print(f"{max(spent) * 1e3:.2f}, median {median * 1e3:.2f}: {1 / (ready + median):.0f} frames a second of a core")
    if options.jobs > 1:
        run = prepared(options, folder / "jobs")
        before = cpu_s()
        list(run_frames(run.runner, run.frame_ids, options.jobs))
        own, children = (b - a for a, b in zip(before, cpu_s(), strict=True))
        run.folder.finish(run.frame_ids)
        alone, shared = sum(spent) / len(spent), (own + children) / len(run.frame_ids)
        print(f"{options.jobs} processes: {shared / alone:.2f} times the processor time of one for the same frames")
    print(f"at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", type=Path)
    parser.add_argument("--lidar", default="results/point_gnn")
    parser.add_argument("--camera", default="results/rcnn_2d")
    parser.add_argument("--split", default="val")
    parser.add_argument("--form", choices=("folder", "parquet"), default="parquet")
    parser.add_argument("--recovery", choices=("on", "off"), default="off")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        # compiled functions loaded, libraries imported
        warm = prepared(options, Path(folder) / "warm")
        list(run_frames(warm.runner, warm.frame_ids[:5]))
        warm.folder.finish(())
        measure(options, Path(folder))


if __name__ == "__main__":
    main()
