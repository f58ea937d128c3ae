"""Sanity checks of a nuScenes folder, as numbered rules.

| rule | severity | what is wrong |
|---|---|---|
| NUS01 | error | a table is absent or malformed |
| NUS02 | error | dangling token: a record names one that its table does not hold |
| NUS03 | error | a token occurs more than once |
| NUS04 | error | a rotation is not a unit quaternion |
| NUS05 | error | a sample has no LIDAR_TOP key frame |
| NUS06 | error | a camera has no intrinsics or no image size |
| NUS07 | error | an annotated size is not positive |
| NUS08 | error | an annotation has several attributes |
| NUS09 | warning | a sample lacks a camera |
| NUS10 | warning | camera and LiDAR of a sample are too far apart in time |
| NUS11 | warning | sensor files of key frames are absent |
| NUS12 | warning | a sensor's recordings are not in order of time |
| NUS13 | error | the result file cannot be read, lacks samples, or nothing in it fits the dataset |
| NUS14 | warning | detections of the result file are left out: other samples or classes |
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lcf3d.datasets.check import Finding
from lcf3d.datasets.nuscenes_loading import find_version, read_tables
from lcf3d.datasets.nuscenes_tables import CAMERAS, CHANNELS, LIDAR, MAX_CAMERA_DELAY_S, NuscenesTables
from lcf3d.errors import Lcf3dError


def check_nuscenes(
    root: Path, version: str | None = None, max_camera_delay_s: float = MAX_CAMERA_DELAY_S
) -> list[Finding]:
    """Everything that is wrong with the tables and key-frame files, errors first; an empty list means all is well.

    Args:
        root: folder that holds the folder of tables.
        version: name of that folder; None for the only one there.
        max_camera_delay_s: longest accepted time in seconds between an image and the LiDAR sweep of its sample.
    """
    try:
        tables, findings = read_tables(root, version or find_version(root))
    except Lcf3dError as error:
        return [Finding("NUS01", "error", str(error))]
    findings = [
        *findings,
        *_check_cameras(tables, max_camera_delay_s),
        *_check_order(tables),
        *_check_files(tables),
    ]
    return sorted(findings, key=lambda finding: (finding.severity != "error", finding.id))


def _check_cameras(tables: NuscenesTables, max_delay_s: float) -> list[Finding]:
    samples, data = tables.samples, tables.sensor_data
    findings = []
    for c, name in enumerate(CAMERAS):
        rows = samples.cameras[:, c]
        for i in np.flatnonzero(rows < 0):
            findings.append(Finding("NUS09", "warning", f"sample {samples.tokens[i].decode()} has no {name}"))
        both = np.flatnonzero((rows >= 0) & (samples.lidar >= 0))
        delay = 1e-6 * np.abs(data.timestamps_us[rows[both]] - data.timestamps_us[samples.lidar[both]])
        for i in np.flatnonzero(delay > max_delay_s):
            findings.append(
                Finding(
                    "NUS10",
                    "warning",
                    f"sample {samples.tokens[both[i]].decode()}: {name} is {delay[i]:.3f} s away from the LiDAR sweep, "
                    f"more than {max_delay_s} s",
                )
            )
    return findings


def _check_order(tables: NuscenesTables) -> list[Finding]:
    data = tables.sensor_data
    rows = np.flatnonzero(data.previous >= 0)
    late = rows[data.timestamps_us[data.previous[rows]] >= data.timestamps_us[rows]]
    return [
        Finding(
            "NUS12", "warning", f"sample_data.json: record {data.tokens[i].decode()} is not later than its predecessor"
        )
        for i in late
    ]


def _check_files(tables: NuscenesTables) -> list[Finding]:
    """One finding a channel: how many key-frame files are absent."""
    findings = []
    data = tables.sensor_data
    for channel in (LIDAR, *CAMERAS):
        rows = np.flatnonzero(data.key_frames & (data.channels == CHANNELS.index(channel)))
        names = [name.decode() for name in data.filenames[rows].tolist()]
        absent = [name for name in names if not (tables.root / name).is_file()]
        if absent:
            findings.append(
                Finding(
                    "NUS11",
                    "warning",
                    f"{channel}: {len(absent)} of {len(names)} key-frame files are absent, the first is {absent[0]}",
                )
            )
    return findings
