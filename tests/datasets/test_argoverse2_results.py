from pathlib import Path

import numpy as np
import pytest

from lcf3d.datasets.argoverse2 import Argoverse2Dataset
from lcf3d.datasets.argoverse2_results import ArgoverseWriter
from lcf3d.datasets.opening import open_dataset
from lcf3d.errors import DatasetError, FormatError
from lcf3d.formats.argoverse import read_submission
from lcf3d.formats.feather import write_columns
from lcf3d.frame import Frame
from lcf3d.fusion.config import FusionConfig
from lcf3d.fusion.pipeline import LateCascadeFusion
from lcf3d.structures import ARGOVERSE_CLASSES, Detections2D, Detections3D
from tests.datasets.argoverse_log import (
    CUBOID,
    LOG,
    POSE,
    cuboid,
    rows,
    sweep_time,
    write_log,
    write_submission_rows,
)

pytest.importorskip("pyarrow", reason="needs pyarrow (extra formats)")
CLASSES = ("REGULAR_VEHICLE", "PEDESTRIAN")


@pytest.fixture
def dataset(tmp_path: Path) -> Argoverse2Dataset:
    write_log(tmp_path)
    return Argoverse2Dataset(tmp_path)


def results(path: Path, *times: int, log: str = LOG) -> Path:
    boxes = [cuboid(time, "REGULAR_VEHICLE", (20, 0, 1.5)) for time in times]
    write_submission_rows(path, [*boxes, cuboid(times[0], "DOG", (5, 5, 1))], [0.9] * len(times) + [0.8], log)
    return path


def test_detections_of_a_file(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    source = dataset.lidar_results(results(tmp_path / "found.feather", sweep_time(0), sweep_time(2)), CLASSES)
    found = [source.detect(frame) for frame in dataset]
    # the dog is of no class that was asked for; a sweep without a line has no detections
    assert [len(part) for part in found] == [1, 0, 1]
    assert {part.class_names for part in found} == {CLASSES}


def test_files_of_something_else(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    path = results(tmp_path / "found.feather", 7)
    with pytest.raises(DatasetError, match=rf"1 sweeps, but of none of the 3 frames; the first there is {LOG}_7"):
        dataset.lidar_results(path, CLASSES)
    write_log(tmp_path, log="other")
    both = Argoverse2Dataset(tmp_path)
    path = results(tmp_path / "found.feather", sweep_time(0))
    with pytest.raises(DatasetError, match="lacks 1 of 2 logs, first other"):
        both.lidar_results(path, CLASSES)
    source = both.lidar_results(path, CLASSES, "empty")
    assert len(source.detect(both.frame(f"other_{sweep_time(0)}"))) == 0
    with pytest.raises(FormatError, match="does not exist"):
        both.lidar_results(tmp_path / "none.feather", CLASSES)


def test_a_run_is_written_and_read_again(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    config = FusionConfig(class_names=ARGOVERSE_CLASSES)
    source = dataset.lidar_results(results(tmp_path / "found.feather", sweep_time(0), sweep_time(1)), ARGOVERSE_CLASSES)
    fusion = LateCascadeFusion(config)
    fused = {
        frame.id: fusion(frame, source.detect(frame), {"ring_front_center": Detections2D.empty(ARGOVERSE_CLASSES)})
        for frame in dataset
    }
    writer = ArgoverseWriter(tmp_path / "run")
    assert list(writer.written()) == []
    writer.finish(dataset.ids, fused.__getitem__)
    assert list(writer.written()) == [tmp_path / "run/results.feather"]
    found = read_submission(tmp_path / "run/results.feather")
    assert len(found) == 3
    again = dataset.lidar_results(tmp_path / "run", ARGOVERSE_CLASSES)
    np.testing.assert_allclose(again.detect(dataset[1]).boxes, fused[dataset.ids[1]].detections.boxes, atol=1e-9)


def test_classes_that_the_form_does_not_know(tmp_path: Path) -> None:
    frame = Frame(f"{LOG}_1")
    found = Detections3D([[1, 2, 3, 4, 5, 6, 0]], [0.5], [0], ("Tram",))
    fused = LateCascadeFusion(FusionConfig(class_names=("Tram",)))(frame, found, {})
    with pytest.raises(DatasetError, match="class 'Tram' is none of Argoverse 2"):
        ArgoverseWriter(tmp_path).finish([frame.id], lambda _: fused)


def check(dataset: Argoverse2Dataset, path: Path | None = None) -> list[tuple[str, str]]:
    return [(finding.id, finding.message) for finding in dataset.check(path)]


def test_a_log_that_is_in_order(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    findings = dict(check(dataset, results(tmp_path / "found.feather", sweep_time(0))))
    # the tiny log has two of nine cameras, and one annotated moment without a sweep
    assert list(findings) == ["ARG02", "ARG04", "FRM06"]
    assert "no calibration of ring_front_left" in findings["ARG02"]
    assert f"1 of 3 annotated moments have no sweep, first {sweep_time(2)}" in findings["ARG04"]


def test_what_is_wrong_with_a_log(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "val" / LOG
    write_columns(
        folder / "city_SE3_egovehicle.feather",
        rows(["timestamp_ns", *POSE], [(sweep_time(1), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)]),
    )
    findings = check(Argoverse2Dataset(tmp_path))
    assert ("ARG03", f"log {LOG} has no ego pose for 2 of 3 frames") in findings
    columns = rows(CUBOID, [cuboid(sweep_time(1), "DOG", (1, 2, 3))])
    del columns["tz_m"]
    write_columns(folder / "annotations.feather", columns)
    findings = check(Argoverse2Dataset(tmp_path))
    assert findings[0][0] == "ARG01"
    assert "annotations.feather has no column tz_m" in findings[0][1]
    (folder / "annotations.feather").write_text("nothing")
    with pytest.raises(FormatError, match=r"annotations\.feather cannot be read as a feather file"):
        Argoverse2Dataset(tmp_path)


def test_what_is_wrong_with_results(dataset: Argoverse2Dataset, tmp_path: Path) -> None:
    path = tmp_path / "found.feather"
    write_submission_rows(path, [cuboid(t, "DOG", (5, 5, 1)) for t in (sweep_time(0), 7)], [0.5, 3.0])
    findings = check(dataset, path)
    assert ("ARG05", f"{path} holds boxes of 1 sweeps that are no frames here") in findings
    assert ("ARG06", f"{path}: 1 of 2 scores lie outside [0, 1]") in findings
    assert any(id == "ARG05" and "does not exist" in text for id, text in check(dataset, tmp_path / "none.feather"))


def test_by_name(tmp_path: Path) -> None:
    write_log(tmp_path)
    for text in (f"argoverse2:{tmp_path}?log={LOG}", str(tmp_path), str(tmp_path / "val" / LOG)):
        dataset = open_dataset(text)
        assert isinstance(dataset, Argoverse2Dataset)
        assert len(dataset) == 3
        assert dataset.has_image(dataset.ids[0], "ring_side_left")
        assert not dataset.has_image(dataset.ids[0], "ring_rear_left")
