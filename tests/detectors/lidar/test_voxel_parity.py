"""Sparse-convolution networks against the original implementations, stage by stage to the last box.

The recorded maps are those of one thread (``.one_thread``): with several, spconv adds up on the CPU through pointers
that its threads share. Changing every weight by a relative 1e-6 changes these maps by up to 2.4e-5 of their largest
value (recorded with them), so that they are compared at 1e-4 of a map's spread, and where a threshold turns small
changes into large ones (the part features of Part-A2: up to 9.4e-4), at 1e-3.
"""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar import sparse_spconv  # noqa: E402
from lcf3d.detectors.lidar.centerpoint import CenterPoint  # noqa: E402
from lcf3d.detectors.lidar.decoding import sigmoid  # noqa: E402
from lcf3d.detectors.lidar.part_a2 import PartA2  # noqa: E402
from lcf3d.detectors.lidar.presets import PRESETS  # noqa: E402
from lcf3d.detectors.lidar.pv_rcnn import PVRCNN  # noqa: E402
from lcf3d.detectors.lidar.roi import Proposals  # noqa: E402
from lcf3d.detectors.lidar.second import SECOND  # noqa: E402
from lcf3d.geometry.boxes import mmdet3d_from_canonical  # noqa: E402

pytestmark = pytest.mark.real
DENSE = 1e-4
PARTS = 1e-3


def given_proposals(data):
    """The fixed regions that the original's second stage was given, with class logits +2 and -2."""
    boxes, labels = data.arrays["rois"].astype(np.float64), data.arrays["roi_labels"]
    return Proposals(boxes, labels, np.where(np.arange(3) == labels[:, None], 2.0, -2.0))


def tensors(detector, data, columns=(0, 1, 2, 3)):
    return {name: torch.from_numpy(value) for name, value in detector.inputs(data.points(columns)).items()}


def check_first_stage(data, network, bev, head, prefix=""):
    """Backbone, neck and the head's three maps; returns the maps."""
    maps = network.backbone(bev)
    for i, value in enumerate(maps):
        data.check(f"{prefix}backbone.{i}", value, DENSE)
    neck = network.neck(maps)
    data.check(f"{prefix}neck.0", neck[0], DENSE)
    outputs = getattr(network, head)(neck)
    if not prefix:
        for i, value in enumerate(outputs[0]):
            data.check(f"{head}.{i}.0", value, DENSE)
    return outputs


@torch.inference_mode()
def test_second(golden):
    data = golden("second_kitti.one_thread")
    detector = SECOND.from_state_dict(data.state(), PRESETS["second-kitti"])
    inputs = tensors(detector, data)
    bev = detector.network.middle_encoder(**inputs)
    data.check("middle_encoder", bev, DENSE)
    check_first_stage(data, detector.network, bev, "bbox_head")
    # all 50 scores of the original are 1 in float32: which of the tied boxes stay is not determined
    assert len(detector.detect(inputs)) == data.info["n_predictions"]


@torch.inference_mode()
def test_centerpoint_voxel(golden):
    data = golden("centerpoint_voxel01_nus.one_thread")
    detector = CenterPoint.from_state_dict(data.state(), PRESETS["centerpoint-voxel01-nuscenes"])
    inputs = tensors(detector, data, (0, 1, 2, 3, 4))
    bev = detector.network.middle_encoder(**inputs)
    data.check("pts_middle_encoder", bev, DENSE)
    for task, maps in enumerate(check_first_stage(data, detector.network, bev, "bbox_head", "pts_")):
        for name, value in maps.items():
            data.check(f"pts_bbox_head.{task}.0.{name}", value, DENSE)
    boxes, scores, labels = data.predictions()
    # most scores are 1 in float32, so that which of the tied boxes suppresses which is not determined: the original's
    # other boxes must be among ours before suppression (suppression itself: test_postprocessing.py)
    untied = scores < 1
    assert untied.sum() > 150
    detector.nms = "off"
    data.check_contained(detector.detect(inputs), boxes[untied], scores[untied], labels[untied], 1e-3)


@torch.inference_mode()
def test_part_a2(golden, capture):
    data = golden("parta2_kitti.one_thread")
    detector = PartA2.from_state_dict(data.state(), PRESETS["part-a2-kitti"])
    network, head = detector.network, detector.network.roi_head
    inputs = tensors(detector, data)
    bev, features = network.middle_encoder(inputs["features"], inputs["coordinates"])
    data.check("middle_encoder.spatial_features", bev, DENSE)
    data.check("middle_encoder.seg_features", features, DENSE)
    check_first_stage(data, network, bev, "rpn_head")
    semantic = head.semantic_head
    outputs = capture(
        {"seg": semantic.seg_cls_layer, "reg": semantic.seg_reg_layer, "part": semantic, "box": head.bbox_head}
    )
    detections = detector.refine(features, inputs["centers"], given_proposals(data))
    data.check("roi_head.semantic_head.seg_preds", outputs["seg"], DENSE)
    data.check("roi_head.semantic_head.part_preds", outputs["reg"], DENSE)
    data.check("roi_head.semantic_head.part_feats", outputs["part"], PARTS)
    data.check("roi_head.seg_roi_extractor", outputs["box.input"][0], DENSE)
    data.check("roi_head.bbox_roi_extractor", outputs["box.input"][1], PARTS)
    data.check("roi_head.bbox_head.0", outputs["box"][0][:, None], DENSE)
    data.check("roi_head.bbox_head.1", outputs["box"][1], DENSE)
    check_degenerate_boxes(data, detections)


def check_degenerate_boxes(data, detections):
    """The original's boxes, as such weights give them: sizes of 1e-54 to infinity, compared by their logarithms."""
    boxes, raw, labels = data.predictions()
    ours = mmdet3d_from_canonical(detections.boxes)
    # one box of the 18 has no extent on the ground; the original's overlap of it and another is not a number
    assert len(boxes) <= len(detections) <= len(boxes) + 1
    for box, logit, label in zip(boxes, raw, labels, strict=True):
        near = np.abs(ours[:, :2] - box[:2]).max(axis=1) < 1e-3 * (1 + np.abs(box[:2]).max())
        near &= (detections.labels == label) & np.isclose(detections.scores, sigmoid(logit), rtol=1e-3, atol=1e-9)
        assert near.sum() == 1
        sizes = ours[near][0, 3:6]
        both = np.isfinite(box[3:6]) & (box[3:6] > 1e-37)
        np.testing.assert_allclose(np.log(sizes[both]), np.log(box[3:6][both]), atol=2e-3)
        assert (sizes[np.isinf(box[3:6])] > 1e37).all()
        turn = ours[near][0, 6] - box[6]
        assert abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-3 * (1 + abs(box[6]))


@torch.inference_mode()
def test_pv_rcnn(golden, capture):
    data = golden("pvrcnn_kitti.one_thread")
    detector = PVRCNN.from_state_dict(data.state(), PRESETS["pv-rcnn-kitti"])
    network = detector.network
    inputs = tensors(detector, data)
    stages = network.middle_encoder.stages(inputs["features"], inputs["coordinates"])
    for i, stage in enumerate(stages):
        order = stage.sites._order
        data.check(f"middle_encoder.1.{i}.sparse_indices", stage.sites.coordinates[order], 1e-9)
        data.check(f"middle_encoder.1.{i}.sparse_features", stage.features[order], DENSE)
        # the ball query takes the first neighbours in this order
        places = torch.empty_like(order)
        places[order] = torch.arange(len(order))
        assert np.array_equal(places.numpy(), data.arrays[f"order.middle_encoder.1.{i}"])
    bev = network.middle_encoder.flatten(stages[-1])
    data.check("middle_encoder.0", bev, DENSE)
    check_first_stage(data, network, bev, "rpn_head")
    encoded = network.points_encoder(inputs["points"], stages, bev)
    data.check("points_encoder.keypoints", torch.nn.functional.pad(encoded[0], (1, 0)), 1e-6)
    data.check("points_encoder.keypoint_features", encoded[1], DENSE)
    data.check("points_encoder.fusion_keypoint_features", encoded[2], DENSE)
    outputs = capture({"semantic": network.roi_head.semantic_head, "box": network.roi_head.bbox_head})
    assert len(detector.refine(encoded, given_proposals(data))) == data.info["n_predictions"]
    data.check("roi_head.semantic_head.seg_preds", outputs["semantic"], DENSE)
    data.check("roi_head.bbox_roi_extractor", outputs["box.input"][0], DENSE)
    for i in (0, 1):
        expected = data.info["maps"][f"roi_head.bbox_head.{i}"]["shape"]
        data.check(f"roi_head.bbox_head.{i}", outputs["box"][i].reshape(expected), DENSE)


@torch.inference_mode()
@pytest.mark.parametrize(
    ("name", "preset", "kind"),
    [
        ("second_kitti", "second-kitti", SECOND),
        ("parta2_kitti", "part-a2-kitti", PartA2),
        ("pvrcnn_kitti", "pv-rcnn-kitti", PVRCNN),
        ("centerpoint_voxel01_nus", "centerpoint-voxel01-nuscenes", CenterPoint),
    ],
)
def test_the_encoders_are_those_of_spconv(golden, monkeypatch, name, preset, kind):
    library = pytest.importorskip("spconv.pytorch")
    data = golden(f"{name}.one_thread")
    detector = kind.from_state_dict(data.state(), PRESETS[preset])
    inputs = tensors(detector, data, (0, 1, 2, 3) if "kitti" in name else (0, 1, 2, 3, 4))
    encoder = detector.network.middle_encoder

    def run():
        stages = encoder.stages(inputs["features"], inputs["coordinates"])
        output = encoder(inputs["features"], inputs["coordinates"])
        outputs = output if isinstance(output, tuple) else (output,)
        return [*(stage.features[stage.sites._order] for stage in stages), *outputs]

    ours = run()
    monkeypatch.setattr(sparse_spconv, "spconv_for", lambda features: library)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    theirs = run()
    torch.set_num_threads(threads)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(a.std()))
