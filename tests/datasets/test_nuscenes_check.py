from pathlib import Path

import pytest

from lcf3d.datasets.nuscenes_check import check_nuscenes
from tests.datasets.nuscenes_world import world_tables, write_world


def test_a_world_without_images_but_otherwise_sound(tmp_path: Path) -> None:
    findings = check_nuscenes(write_world(tmp_path, points=True))
    assert {finding.id for finding in findings} == {"NUS09", "NUS11"}
    assert {finding.severity for finding in findings} == {"warning"}
    # five of six cameras lack in each of three samples
    assert sum(finding.id == "NUS09" for finding in findings) == 15
    absent = [finding.message for finding in findings if finding.id == "NUS11"]
    assert absent == ["CAM_FRONT: 3 of 3 key-frame files are absent, the first is samples/C0.jpg"]


def test_all_findings_are_listed_errors_first(tmp_path: Path) -> None:
    tables = world_tables()
    tables["sample_annotation"][0]["sample_token"] = "ghost"
    tables["sample_annotation"][1]["instance_token"] = "ghost"
    tables["ego_pose"][0]["rotation"] = [2, 0, 0, 0]
    tables["sample"][2]["token"] = "s0"
    tables["sample_data"][2]["timestamp"] = 0
    tables["sample_annotation"][3]["attribute_tokens"] = ["a-moving", "a-moving"]
    tables["sample_annotation"][4]["size"] = [0, 1, 1]
    tables["calibrated_sensor"][1]["camera_intrinsic"] = []
    findings = check_nuscenes(write_world(tmp_path, tables))
    rules = [finding.id for finding in findings]
    assert rules == sorted(rules)
    assert set(rules) == {f"NUS{n:02d}" for n in (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12)}
    assert sum(rule == "NUS02" for rule in rules) >= 2
    errors = [finding.severity == "error" for finding in findings]
    assert errors == sorted(errors, reverse=True)


def test_what_cannot_be_read_is_one_finding(tmp_path: Path) -> None:
    (finding,) = check_nuscenes(tmp_path)
    assert (finding.id, finding.severity) == ("NUS01", "error")
    root = write_world(tmp_path)
    (root / "v1.0-mini/sample.json").write_text("[{")
    (finding,) = check_nuscenes(root)
    assert "sample.json" in finding.message


@pytest.mark.real
def test_the_real_tables_lack_files_only(shared: Path) -> None:
    assert {finding.id for finding in check_nuscenes(shared / "data/nuscenes")} == {"NUS11"}
