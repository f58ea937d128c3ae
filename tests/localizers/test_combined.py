"""Two localizers made one, by hand."""

import numpy as np
import pytest

from lcf3d.localizers.combined import FAINT, CombinedLocalizer, combine
from lcf3d.localizers.geometric import GeometricLocalizer
from lcf3d.localizers.named import ShippedLocalizer
from tests.localizers.scenes import street_proposals

CAR = np.array([[20.0, 0.0, -0.9, 4.0, 1.6, 1.5, 0.1]])
NOTHING = np.full((1, 7), np.nan)


def shifted(x=0.0, yaw=0.0):
    return CAR + np.array([x, 0, 0, 0, 0, 0, yaw])


def one(fitted, fit_quality, learned, net_quality, share=0.25):
    boxes, quality = combine(fitted, np.array([fit_quality]), learned, np.array([net_quality]), np.array([share]))
    return boxes[0], quality[0]


def test_boxes_that_agree_are_averaged():
    box, quality = one(shifted(), 0.9, shifted(x=0.4), 0.4)
    np.testing.assert_allclose(box, shifted(x=0.1)[0])
    assert quality == pytest.approx(0.6)


def test_the_front_is_where_the_network_sees_it():
    box, _ = one(shifted(), 0.9, shifted(yaw=np.pi - 0.2), 0.9, share=0.5)
    # axes 0.1 and 0.1 - 0.2: their mean is 0.0, the other way round
    assert abs(box[6]) == pytest.approx(np.pi)
    np.testing.assert_allclose(box[:6], CAR[0, :6])


def test_who_is_believed_where_they_disagree():
    away = shifted(x=6.0)
    np.testing.assert_array_equal(one(CAR, 0.9, away, 0.6)[0], away[0])
    box, quality = one(CAR, 0.9, away, 0.4)
    np.testing.assert_array_equal(box, CAR[0])
    assert quality == pytest.approx(0.6)


def test_one_of_them_may_be_missing():
    box, quality = one(NOTHING, 0.0, CAR, 0.9)
    np.testing.assert_array_equal(box, CAR[0])
    assert quality == pytest.approx(np.sqrt(FAINT * 0.9))
    box, quality = one(CAR, 0.8, NOTHING, 0.0)
    np.testing.assert_array_equal(box, CAR[0])
    assert quality == 0.8
    assert np.isnan(one(NOTHING, 0.0, NOTHING, 0.0)[0]).all()


def test_on_a_scan_it_lies_between_its_parts_and_faces_like_the_network():
    proposals = street_proposals(class_names=("Car", "Pedestrian", "Cyclist"))
    boxes, quality = CombinedLocalizer()(proposals)
    fitted, fit_quality = GeometricLocalizer()(proposals)
    learned, net_quality = ShippedLocalizer()(proposals)
    assert boxes.shape == (3, 7)
    car = int(np.flatnonzero(proposals.labels == 0)[0])
    low, high = np.minimum(fitted[car, :3], learned[car, :3]), np.maximum(fitted[car, :3], learned[car, :3])
    assert (boxes[car, :3] >= low - 1e-9).all()
    assert (boxes[car, :3] <= high + 1e-9).all()
    assert np.cos(boxes[car, 6] - learned[car, 6]) > 0
    assert quality[car] == pytest.approx(np.sqrt(fit_quality[car] * net_quality[car]))


def test_without_proposals_there_is_nothing():
    none = street_proposals().select(np.array([], dtype=np.int64))
    boxes, quality = CombinedLocalizer()(none)
    assert boxes.shape == (0, 7)
    assert quality.shape == (0,)
