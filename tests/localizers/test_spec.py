import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.errors import ConfigError
from lcf3d.geometry.boxes import wrap_angle
from lcf3d.localizers.spec import LocalizerSpec, decode_boxes, encode_headings


def outputs_of(spec, size_class, size_residual, heading, residual):
    """The box head's values that say this."""
    n = len(spec.class_names)
    values = np.zeros((1, spec.outputs))
    values[0, 3 + 3 * size_class : 6 + 3 * size_class] = size_residual
    values[0, 3 + 3 * n + size_class] = 5
    values[0, 3 + 4 * n + heading] = residual
    values[0, 3 + 4 * n + 12 + heading] = 5
    return values


def test_a_box_worked_out_by_hand():
    spec = LocalizerSpec.of("v1", "kitti")
    assert spec.class_names == ("Pedestrian", "Cyclist", "Car")
    # car template 3.9 1.6 1.56, 10 % longer, 5 % narrower; bin 6 is -3.14 + pi, half a half bin further
    values = outputs_of(spec, 2, (0.1, -0.05, 0.0), 6, 0.5)
    box = decode_boxes(np.array([[20.0, 1.0, -0.8]]), values, spec)[0]
    np.testing.assert_allclose(box, [20, 1, -0.8, 4.29, 1.52, 1.56, np.pi - 3.14 + np.pi / 24], atol=1e-12)
    low = LocalizerSpec.of("v2", "kitti")
    box = decode_boxes(np.array([[20.0, 1.0, -0.8]]), values, low)[0]
    np.testing.assert_allclose(box[[2, 6]], [-0.8 + 0.78, np.pi / 24], atol=1e-12)


@given(st.floats(-20, 20), st.sampled_from(["v1", "v2"]))
def test_headings_come_back(yaw, form):
    spec = LocalizerSpec.of(form, "nuscenes")
    bins, residual = encode_headings(np.array([yaw]), spec)
    assert 0 <= bins[0] < 12
    assert abs(residual[0]) < 1.02
    box = decode_boxes(np.zeros((1, 3)), outputs_of(spec, 0, 0.0, int(bins[0]), residual[0]), spec)
    assert abs(wrap_angle(box[:, 6] - yaw))[0] < 1e-9


def test_it_travels_as_text_and_nothing_else_is_taken_for_it():
    spec = LocalizerSpec.of("v1", "nuscenes")
    assert LocalizerSpec.from_json(spec.to_json()) == spec
    for text in ("", "[]", "{}", '{"form": "v1"}'):
        with pytest.raises(ConfigError, match="not the configuration of a frustum network"):
            LocalizerSpec.from_json(text)
    with pytest.raises(ConfigError, match="version 9"):
        LocalizerSpec.from_json(spec.to_json().replace('"version": 1', '"version": 9'))
    with pytest.raises(ConfigError, match="templates for kitti and nuscenes"):
        LocalizerSpec.of("v1", "waymo")
