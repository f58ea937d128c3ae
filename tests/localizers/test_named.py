import numpy as np
import pytest

from lcf3d.errors import ConfigError, DetectorError
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.localizers.named import SHIPPED, ShippedLocalizer, load_localizer
from lcf3d.localizers.onnx import OnnxLocalizer
from tests.localizers.scenes import street_proposals


@pytest.mark.parametrize("dataset", list(SHIPPED))
def test_shipped_networks_are_small_and_put_boxes_where_things_are(dataset):
    assert SHIPPED[dataset].stat().st_size < 3e6
    assert SHIPPED[dataset].with_suffix(".md").is_file(), "every weight has a model card"
    names = OnnxLocalizer(SHIPPED[dataset]).spec.class_names
    car = names.index("Car" if dataset == "kitti" else "car")
    proposals = street_proposals(class_names=names)
    proposals = type(proposals)(**{**vars(proposals), "labels": np.array([car, 0, 1])})
    boxes, quality = ShippedLocalizer()(proposals)
    located = proposals.lidar_from_frustum(boxes)
    assert np.linalg.norm(located[0, :2] - [15, 2]) < 1.5
    assert 0.3 < quality[0] <= 1


def test_frustums_one_by_one_or_together_are_the_same():
    proposals = street_proposals()
    together, sure = ShippedLocalizer()(proposals)
    for k in range(3):
        alone, quality = ShippedLocalizer()(proposals.select(np.array([k])))
        np.testing.assert_allclose(alone[0], together[k], atol=1e-4)
        np.testing.assert_allclose(quality[0], sure[k], atol=1e-4)
    assert len(ShippedLocalizer()(proposals.select(np.array([], dtype=np.int64)))[0]) == 0


def test_classes_a_network_does_not_know_get_no_box():
    proposals = street_proposals(class_names=("Tram", "Pedestrian", "Cyclist"))
    boxes, quality = OnnxLocalizer(SHIPPED["kitti"])(proposals)
    assert np.isnan(boxes[0]).all()
    assert quality[0] == 0
    assert np.isfinite(boxes[1:]).all()


def test_names(tmp_path):
    assert isinstance(load_localizer("geometric"), GeometricLocalizer)
    assert isinstance(load_localizer(f"onnx:{SHIPPED['kitti']}"), OnnxLocalizer)
    with pytest.raises(ConfigError, match=r"unknown localizer kind 'best'; installed: .*frustum-pointnet, geometric"):
        load_localizer("best")
    for text in ("onnx", "onnx:"):
        with pytest.raises(ConfigError, match="localizer 'onnx' needs an argument: onnx:PATH"):
            load_localizer(text)
    with pytest.raises(ConfigError, match="localizer 'geometric' takes no argument"):
        load_localizer("geometric:3")
    with pytest.raises(DetectorError, match="does not exist"):
        load_localizer("onnx:nowhere.onnx")
    (tmp_path / "torn.onnx").write_bytes(b"no network")
    with pytest.raises(DetectorError, match="cannot be read as an ONNX file"):
        load_localizer(f"onnx:{tmp_path / 'torn.onnx'}")


def test_an_onnx_file_of_something_else_or_of_an_unknown_opset_is_refused(tmp_path):
    onnx = pytest.importorskip("onnx")
    node = onnx.helper.make_node("Identity", ["x"], ["y"])
    values = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, [1]) for n in "xy"]
    graph = onnx.helper.make_graph([node], "other", values[:1], values[1:])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(DetectorError, match="no frustum network of lcf3d"):
        load_localizer(f"onnx:{tmp_path / 'other.onnx'}")
    model.opset_import[0].version = 999
    onnx.save(model, tmp_path / "opset.onnx")
    with pytest.raises(DetectorError, match=r"cannot be read as an ONNX file: .*opset"):
        load_localizer(f"onnx:{tmp_path / 'opset.onnx'}")
