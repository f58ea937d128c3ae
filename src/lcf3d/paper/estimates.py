"""What measuring a table takes: data, disk and hours."""

from __future__ import annotations

from collections.abc import Sequence

from lcf3d.paper.splits import KITTI_VAL
from lcf3d.paper.tables import Row, Table

DATA = {
    "kitti": "the object benchmark (cvlibs.net, registration): left and right images 12 GB each, Velodyne scans 29 GB, "
    "calibration and labels 21 MB, packed; half of it is the labelled part that is used",
    "nuscenes": "v1.0-trainval with sweeps (nuscenes.org, registration): about 300 GB packed; validation alone about a "
    "fifth of it",
}
"""What each dataset is and how large."""

FRAMES = {"kitti": len(KITTI_VAL), "nuscenes": 6019}
"""Frames of the validation splits."""

CPU_SECONDS = {
    "pointpillars-kitti": 0.40,
    "second-kitti": 0.96,
    "part-a2-kitti": 1.99,
    "pv-rcnn-kitti": 2.55,
    "pointpillars-nuscenes": 0.56,
    "ssn-regnet-nuscenes": 0.74,
    "centerpoint-voxel01-nuscenes": 1.14,
    "fasterrcnn-r101-kitti": 2.6,
    "mvxnet-kitti": 1.8,
    "bevfusion-nuscenes": 4.7,
}
"""Seconds a frame on two CPU cores: LiDAR networks as docs/results.md has them; others half of what one core takes."""

GPU_SECONDS = {
    "pointpillars-kitti": 0.016,
    "fasterrcnn-r101-kitti": 0.027,
    "pv-rcnn-kitti": 0.068,
    "mvxnet-kitti": 0.097,
    "bevfusion-nuscenes": 0.070,
}
"""Seconds a frame on an A100: the paper's table of complexity, and what its speeds say of PV-RCNN."""


def about(table: Table, rows: Sequence[Row]) -> str:
    """Hours of some rows on two CPU cores and, where known, on an A100, in words; a network runs once for all rows."""
    words = []
    for place, seconds in (("two CPU cores", CPU_SECONDS), ("an A100", GPU_SECONDS)):
        known: dict[tuple[str, str], float] = {}
        unknown: set[str] = set()
        for row in rows:
            kind = row.task[1] if row.task else (table.data or ("",))[0]
            views = 2 if row.stereo else 6 if kind == "nuscenes" and not row.task else 1
            for name, count in ((row.lidar, 1), (row.camera, views)):
                if name in seconds:
                    spent = seconds[name] * count * FRAMES[kind] / 3600
                    known[name, kind] = max(spent, known.get((name, kind), 0.0))
                elif name:
                    unknown.add(name)
        if known:
            more = f" and that of {', '.join(sorted(unknown))}" if unknown else ""
            hours = sum(known.values())
            spent_words = f"{hours:.1f} h" if hours >= 0.95 else f"{60 * hours:.0f} min"
            words.append(f"about {spent_words} on {place}{more}")
        elif unknown:
            words.append(f"the time of {', '.join(sorted(unknown))} on {place}, not known")
    return "; ".join(words)
