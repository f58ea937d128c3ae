import json

import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.errors import Lcf3dError
from lcf3d.localizers.named import load_localizer
from tests.datasets.kitti_folder import make_kitti
from tests.localizers.scenes import street_proposals

pytest.importorskip("torch")


@pytest.fixture
def kitti(tmp_path):
    return f"kitti:{make_kitti(tmp_path / 'kitti')}"


def lcf3d(*arguments):
    result = CliRunner().invoke(app, ["train", "localizer", *(str(a) for a in arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def test_a_localizer_from_a_kitti_folder_and_on_from_its_checkpoint(kitti, tmp_path):
    out = tmp_path / "out"
    options = (kitti, "--split", "val", "--val-split", "val", "--steps", "3", "--batch-size", "4", "--out", out)
    result = lcf3d(*options)
    assert result.exit_code == 0, result.output
    assert f"--localizer onnx:{out / 'localizer.onnx'}" in " ".join(result.stdout.split())
    boxes, _ = load_localizer(f"onnx:{out / 'localizer.onnx'}")(street_proposals())
    assert boxes.shape == (3, 7)
    (figures,) = json.loads((out / "metrics.json").read_text())
    assert {"Car IoU", "Car >0.5", "Car 0-20 m IoU", "Pedestrian >0.7"} <= set(figures)
    with pytest.raises(Lcf3dError, match="holds a training already"):
        lcf3d(*options)
    assert lcf3d(*options, "--resume").exit_code == 0


def test_the_authors_form_ends_as_a_checkpoint(kitti, tmp_path):
    out = tmp_path / "out"
    result = lcf3d(kitti, "--form", "v2", "--steps", "1", "--batch-size", "2", "--out", out)
    assert result.exit_code == 0, result.output
    assert load_localizer(f"frustum-pointnet:{out / 'localizer.pth'}").spec.form == "v2"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--classes", "waymo"), "no localizer recipe 'waymo'"),
        (("--variant", "sketch"), "--variant takes all, box, stereo, mask, box"),
        (("--form", "v3"), "--form takes v1 or v2"),
        (("--split", "val"), "are for a dataset"),
        (("kitti:nowhere",), "does not exist"),
    ],
)
def test_bad_requests_leave_nothing_behind(arguments, message, tmp_path):
    with pytest.raises(Lcf3dError, match=message):
        lcf3d(*arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_frames_without_scans_are_named(kitti, tmp_path):
    for path in (tmp_path / "kitti" / "training" / "velodyne").iterdir():
        path.unlink()
    with pytest.raises(Lcf3dError, match="frame 000000 has no scan to train on"):
        lcf3d(kitti, "--out", tmp_path / "out")
