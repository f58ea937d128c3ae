"""Objects of other libraries: supervision and torchvision themselves, stand-ins with the fields of the others."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lcf3d.errors import ConfigError, DetectorError
from lcf3d.structures import Detections2D, Detections3D, InstanceMask

BOXES = np.array([[10.0, 20, 30, 60], [5, 5, 25, 15]])
SCORES = np.array([0.9, 0.4])


def bitmaps(height=80, width=100):
    """Masks that fill the boxes."""
    masks = np.zeros((2, height, width), dtype=bool)
    for mask, (x1, y1, x2, y2) in zip(masks, BOXES.astype(int), strict=True):
        mask[y1:y2, x1:x2] = True
    return masks


def check(found, names=("person", "car"), labels=(1, 0), masks=True):
    np.testing.assert_allclose(found.boxes, BOXES)
    np.testing.assert_allclose(found.scores, SCORES, rtol=1e-2)
    assert [found.class_names[i] for i in found.labels] == [names[i] for i in labels]
    if masks:
        for mask, (x1, y1, x2, y2) in zip(found.masks, BOXES, strict=True):
            assert (mask.x, mask.y, *mask.bitmap.shape[::-1]) == (x1, y1, x2 - x1, y2 - y1)
    else:
        assert found.masks is None


def test_supervision_there_and_back():
    supervision = pytest.importorskip("supervision")
    given = supervision.Detections(xyxy=BOXES, confidence=SCORES, class_id=np.array([1, 0]), mask=bitmaps())
    ours = Detections2D.from_supervision(given, ["person", "car"])
    check(ours)
    back = ours.to_supervision(image_size=(80, 100))
    assert isinstance(back, supervision.Detections)
    np.testing.assert_array_equal(back.mask, bitmaps())
    assert back.data["class_name"].tolist() == ["car", "person"]
    check(Detections2D.from_supervision(back))
    assert ours.to_supervision().mask is None
    empty = Detections2D.from_supervision(supervision.Detections.empty())
    assert len(empty) == 0


def test_compact_masks_of_supervision():
    supervision = pytest.importorskip("supervision")
    compact = pytest.importorskip("supervision.detection.compact_mask").CompactMask
    masks = compact.from_dense(bitmaps(), BOXES, (80, 100))
    check(
        Detections2D.from_supervision(supervision.Detections(BOXES, masks, SCORES, np.array([1, 0])), ["person", "car"])
    )


def test_supervision_without_names():
    supervision = pytest.importorskip("supervision")
    with pytest.raises(DetectorError, match="hold no class names"):
        Detections2D.from_supervision(supervision.Detections(xyxy=BOXES, class_id=np.array([1, 0])))
    with pytest.raises(DetectorError, match="no class_id"):
        Detections2D.from_supervision(supervision.Detections(xyxy=BOXES), ["person", "car"])


def ultralytics(masks=None):
    boxes = SimpleNamespace(
        xyxy=torch.tensor(BOXES, requires_grad=True),
        conf=torch.tensor(SCORES, dtype=torch.bfloat16),
        cls=torch.tensor([2.0, 0.0]),
    )
    return SimpleNamespace(boxes=boxes, names={0: "person", 2: "car", 1: "bicycle"}, orig_shape=(80, 100), masks=masks)


def test_ultralytics():
    check(Detections2D.from_ultralytics(ultralytics()), masks=False)
    whole = SimpleNamespace(data=torch.tensor(bitmaps()), xy=[])
    check(Detections2D.from_ultralytics(ultralytics(whole)))
    # of the network's size, letterboxed: the outlines count
    outlines = [np.array([[x1, y1], [x2 - 1, y1], [x2 - 1, y2 - 1], [x1, y2 - 1]]) for x1, y1, x2, y2 in BOXES]
    check(Detections2D.from_ultralytics(ultralytics(SimpleNamespace(data=torch.zeros(2, 64, 64), xy=outlines))))
    with pytest.raises(DetectorError, match="ultralytics Results with boxes"):
        Detections2D.from_ultralytics(SimpleNamespace(boxes=None, probs=1))


def test_torchvision():
    import torchvision

    model = torchvision.models.detection.maskrcnn_resnet50_fpn(
        weights=None, weights_backbone=None, num_classes=3, box_score_thresh=0.0, box_detections_per_img=4, min_size=64
    ).eval()
    prediction = model([torch.rand(3, 64, 96)])[0]
    found = Detections2D.from_torchvision(prediction, ["__background__", "person", "car"])
    assert len(found) == len(prediction["boxes"]) == len(found.masks)
    np.testing.assert_allclose(found.boxes, prediction["boxes"].detach().numpy())
    np.testing.assert_array_equal(found.labels, prediction["labels"].numpy())
    made = {"boxes": torch.tensor(BOXES), "scores": torch.tensor(SCORES), "labels": torch.tensor([2, 1])}
    masks = torch.tensor(bitmaps()[:, None] * 0.7)
    check(Detections2D.from_torchvision({**made, "masks": masks}, ["__background__", "person", "car"]))
    with pytest.raises(DetectorError, match="with 'scores'"):
        Detections2D.from_torchvision({"boxes": torch.tensor(BOXES)}, ["car"])


def test_mmdet():
    instances = SimpleNamespace(
        bboxes=torch.tensor(BOXES, requires_grad=True), scores=torch.tensor(SCORES), labels=torch.tensor([1, 0])
    )
    sample = SimpleNamespace(pred_instances=instances)
    check(Detections2D.from_mmdet(sample, ("person", "car")), masks=False)
    # HorizontalBoxes keep their numbers in .tensor, BitmapMasks theirs in .masks
    instances.bboxes, instances.masks = SimpleNamespace(tensor=torch.tensor(BOXES)), SimpleNamespace(masks=bitmaps())
    check(Detections2D.from_mmdet(instances, ("person", "car")))
    with pytest.raises(ConfigError, match="sequence of names"):
        Detections2D.from_mmdet(instances, "car")


def test_dataframe():
    pandas = pytest.importorskip("pandas")
    table = Detections2D(BOXES, SCORES, [1, 0], ("person", "car"), [InstanceMask(0, 0, np.ones((1, 1), bool))] * 2)
    frame = table.to_dataframe()
    assert isinstance(frame, pandas.DataFrame)
    assert list(frame.columns) == ["x1", "y1", "x2", "y2", "score", "class_name"]
    assert frame.class_name.tolist() == ["car", "person"]
    assert frame.y2.tolist() == [60, 15]
    solid = Detections3D([[1, 2, 3, 4, 5, 6, 0.5]], [0.7], [0], ("Car",), [[1, np.nan]], ["vehicle.parked"])
    row = solid.to_dataframe().iloc[0]
    assert row[["x", "y", "z", "length", "width", "height", "yaw"]].tolist() == [1, 2, 3, 4, 5, 6, 0.5]
    assert (row.velocity_x, row.attribute, row.class_name) == (1, "vehicle.parked", "Car")
    assert len(Detections3D.empty(("Car",)).to_dataframe()) == 0
