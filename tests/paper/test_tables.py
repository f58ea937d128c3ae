import re

import numpy as np
import pytest

from lcf3d.detectors.published import find_model
from lcf3d.errors import ConfigError
from lcf3d.paper.estimates import about
from lcf3d.paper.networks import NeedsError, branches, parse_uses, spec_of
from lcf3d.paper.report import markdown, table_data, to_json
from lcf3d.paper.splits import KITTI_TRAIN, KITTI_VAL
from lcf3d.paper.tables import find_row, find_rows, find_table, paper_tables
from lcf3d.paper.workplace import Measured


def test_the_split_divides_all_labelled_frames():
    assert (len(KITTI_TRAIN), len(KITTI_VAL)) == (3712, 3769)
    assert sorted(KITTI_TRAIN + KITTI_VAL) == [f"{i:06d}" for i in range(7481)]
    # known beginnings of the two lists
    assert KITTI_TRAIN[:4] == ("000000", "000003", "000007", "000009")
    assert KITTI_VAL[:4] == ("000001", "000002", "000004", "000005")


@pytest.mark.real
def test_the_split_is_that_of_the_data_at_hand(shared):
    lists = shared / "data" / "kitti" / "ImageSets"
    assert set(KITTI_TRAIN) == set((lists / "train_labels.txt").read_text().split())
    assert set(KITTI_VAL) >= set((lists / "val.txt").read_text().split())


@pytest.mark.real
@pytest.mark.parametrize("table", [t for t in paper_tables() if t.startswith("table")])
def test_every_number_is_printed_in_the_paper(shared, table):
    text = (shared / "paper" / "lcf3d.tex").read_text()
    label = find_table(table).place.split(", ")[1]
    end = text.index(f"\\label{{{label}}}")
    body = text[text.rindex("\\begin{table}", 0, end) : end]
    printed = {float(v) for v in re.findall(r"(?<![\w.])\d+\.\d+(?![\w.])", body)}
    ours = {v for row in find_table(table).rows for v in row.values if v is not None}
    assert ours <= printed
    # and nothing that the paper prints there is left out, but for widths of columns and the like
    assert {v for v in printed - ours if v not in (0.9, 0.75, 0.55, 0.8, 1.2, 1.4, 1.1)} == set()


def test_rows_have_a_number_a_column_and_name_networks_that_are_known():
    for table in paper_tables().values():
        for row in table.rows:
            assert len(row.values) == len(table.columns)
            assert row.quoted or row.needs or row.lidar or table.measure == "cost", row.name
            for name in row.networks:
                find_model(name)


def test_a_row_is_found_by_the_beginning_of_its_name():
    table = find_table("table-2")
    assert find_row(table, "loGoNet").name == "LoGoNet"
    assert find_row(table, "virconv").quoted
    with pytest.raises(ConfigError, match="names 3 rows of table-2"):
        find_row(table, "LCF3D")
    with pytest.raises(ConfigError, match="names 0 rows"):
        find_row(table, "PointRCNN")
    # the whole name goes before the beginning of another
    assert find_row(find_table("table-1"), "SECOND").camera == ""
    with pytest.raises(ConfigError, match="choose one of table-1"):
        find_table("table-9")


def test_rows_are_found_in_all_tables_that_have_them():
    found = find_rows(list(paper_tables().values()), ["PointPillars", "LCF3D*"])
    assert [(table.name, [row.name for row in rows]) for table, rows in found if table.name != "table-4"] == [
        ("table-1", ["PointPillars"]),
        ("table-3", ["PointPillars"]),
        ("figure-1", ["LCF3D*"]),
    ]
    assert sum(len(rows) for _, rows in find_rows(list(paper_tables().values()), [])) > 70
    with pytest.raises(ConfigError, match="no table has a row"):
        find_rows(list(paper_tables().values()), ["PointRCNN"])


def test_networks_without_an_address_are_asked_for():
    assert spec_of("pointpillars-kitti", "lidar", {}) == "pointpillars:pointpillars-kitti"
    with pytest.raises(NeedsError, match="--use fasterrcnn-r101-kitti=FILE"):
        spec_of("fasterrcnn-r101-kitti", "camera", {})
    row = find_row(find_table("table-1"), "SECOND + Faster R-CNN, single")
    with pytest.raises(NeedsError, match=r"fasterrcnn-r101-kitti.*frustum-pointnet-kitti"):
        branches(row, {})


def test_a_file_or_another_detector_stands_for_a_network(tmp_path):
    weights = tmp_path / "mine.pth"
    weights.write_bytes(b"")
    row = find_row(find_table("table-1"), "PointPillars")
    assert branches(row, {"pointpillars-kitti": str(weights)}) == (f"pointpillars:{weights}?nms=keep", "", "geometric")
    assert branches(row, {}, "cuda")[0] == "pointpillars:pointpillars-kitti?device=cuda&nms=keep"
    assert branches(row, {"pointpillars-kitti": "results:DIR"})[0] == "results:DIR"
    # no suppression of its own, so no setting for it
    fusion = find_row(find_table("table-7"), "nuscenes -> kitti: BEVFusion")
    assert branches(fusion, {})[0] == "bevfusion:bevfusion-nuscenes"
    with pytest.raises(ConfigError, match="no such file"):
        spec_of("pointpillars-kitti", "lidar", {"pointpillars-kitti": "gone.pth"})
    with pytest.raises(ConfigError, match="--use takes"):
        parse_uses(("pointpillars=x",))


def test_paper_measured_and_difference():
    table = find_table("table-3")
    rows = (table.rows[0],)
    measured = {"PointPillars": Measured((0.4, *(None,) * 11), 6019)}
    content = to_json(table, rows, measured)["rows"][0]
    assert content["difference"]["mAP"] == pytest.approx(0.4 - 0.39)
    assert content["difference"]["NDS"] is None
    data = table_data(table, rows, measured)
    assert [row[:2] for row in data.rows] == [
        ("PointPillars", ""),
        ("  paper", "0.390"),
        ("  measured", "0.400"),
        ("  difference", "+0.010"),
    ]
    assert "PointPillars: measured on 6019 frames" in data.notes
    assert "|   difference | +0.010 |" in markdown(data)


def test_a_network_counts_once_for_all_rows_of_an_estimate():
    table = find_table("table-4")
    # PointPillars at 0.40 s and Faster R-CNN at 2.6 s on 3,769 frames
    hours = 3769 * (0.40 + 2.6) / 3600
    assert about(table, table.rows).startswith(f"about {hours:.1f} h on two CPU cores")
    assert np.isclose(hours, 3.141, atol=1e-3)
