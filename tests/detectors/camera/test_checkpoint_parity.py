"""DDQ-DETR and DetectoRS against the original implementations, map by map, with every parameter filled by rule."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")

from lcf3d.detectors.camera import ddq, detectors_cascade  # noqa: E402
from lcf3d.detectors.camera.torchvision_boxes import select_detections  # noqa: E402

pytestmark = pytest.mark.real
DENSE = 1e-4


def prepared(data, detector):
    """The network's input of the image at its own size; the original's is blue first."""
    image, size = detector.prepare(data.arrays["input"][..., ::-1], None)
    data.check("image", image, 1e-6)
    return image, size


@torch.inference_mode()
@pytest.mark.parametrize("name", ["ddq_detr_r50", "ddq_detr_swinl"])
def test_ddq(golden, capture, name):
    data = golden(name)
    detector = ddq.DDQDetector.from_state_dict(data.state())
    network = detector.network
    layers = {f"encoder.layers.{i}": layer for i, layer in enumerate(network.encoder.layers)}
    layers |= {f"decoder.layers.{i}": layer for i, layer in enumerate(network.decoder.layers)}
    modules = {"backbone": network.backbone, "neck": network.neck, "memory_trans_norm": network.memory_trans_norm}
    outputs = capture({**modules, **layers})
    image, _ = prepared(data, detector)
    memory, shapes = network.encode(image)
    for i, value in enumerate(outputs["backbone"][-3:]):
        data.check(f"backbone.{i}", value, DENSE)
    for i, value in enumerate(outputs["neck"]):
        data.check(f"neck.{i}", value, DENSE)
    logits, boxes = network.propose(memory, shapes)
    mapped = network.query_map(memory)
    data.check("memory_trans_norm", outputs["memory_trans_norm"][None], DENSE)
    data.check("bbox_head.cls_branches.6", logits[None], DENSE)
    data.check("query_map", mapped, DENSE)

    # the own selections as sets, what follows with the original's
    selection = torch.from_numpy(data.arrays["selection.encoder"].astype(np.int64))
    own = ddq.distinct_boxes(boxes, logits.max(dim=1).values.sigmoid())[: ddq.QUERIES]
    assert len(set(own.tolist()) & set(selection.tolist())) >= 0.97 * len(selection)
    data.check("pre_decoder.query", mapped[selection][None], DENSE)
    data.check("pre_decoder.reference_points", boxes[selection][None], DENSE)
    start = (mapped[selection], boxes[selection], memory, shapes)
    distinct = [torch.from_numpy(data.arrays[f"selection.decoder.{i}"].astype(bool)) for i in range(5)]
    for ours, theirs in zip(network.decode(*start).distinct, distinct, strict=True):
        assert (ours != theirs).float().mean() < 0.03
    decoded = network.decode(*start, distinct)
    noise = data.info["largest_relative_change_for_weight_noise_1e-6_with_the_selection_of_the_npz"]
    for stage in layers:
        # layer by layer, small differences grow as they do in the original
        data.check(stage, outputs[stage][None], max(DENSE, 5 * noise[stage]))
    data.check("decoder.0", torch.stack(decoded.states)[:, None], 5e-3)
    data.check("decoder.1", torch.stack(decoded.references)[:, None], 1e-3)
    predictions = [network.predict(decoded, i) for i in range(6)]
    data.check("bbox_head.0", torch.stack([p[0] for p in predictions])[:, None], 5e-3)
    data.check("bbox_head.1", torch.stack([p[1] for p in predictions])[:, None], 1e-3)

    scores, final = predictions[-1]
    kept = decoded.candidates
    found = ddq.best_pairs(scores[kept].sigmoid(), final[kept], 512, 255)
    check_predictions(data, found, pixels=0.1)


@torch.inference_mode()
def test_detectors(golden):
    data = golden("detectors_cascade_r50")
    detector = detectors_cascade.DetectoRSDetector.from_state_dict(data.state())
    network = detector.network
    calls = {"neck.rfp_aspp": [], "neck.rfp_weight": []}
    for name, values in calls.items():
        network.get_submodule(name).register_forward_hook(
            lambda _, inputs, output, values=values: values.append(output)
        )
    heads = []
    for head in network.roi_head.bbox_head:
        head.register_forward_hook(lambda _, inputs, output: heads.append((inputs[0], *output)))
    image, (width, height) = prepared(data, detector)
    first = network.backbone(image)
    for i, value in enumerate(first, start=1):
        data.check(f"backbone.{i}", value, DENSE)
    maps = network.neck.look(image, first)
    for name, values in calls.items():
        for i, value in enumerate(values):
            data.check(name + (f"#{i}" if i else ""), value, DENSE)
    for i, value in enumerate(maps):
        data.check(f"neck.{i}", value, DENSE)
    for kind, levels in enumerate(network.rpn_head(maps)):
        for i, value in enumerate(levels):
            data.check(f"rpn_head.{kind}.{i}", value, DENSE)

    # the own regions as a set, what follows with the original's
    scale, ratios = detectors_cascade.ANCHOR_SCALE, detectors_cascade.ANCHOR_RATIOS
    own, _ = network.rpn_head.propose(maps, scale, ratios, height, width)
    regions = torch.from_numpy(data.arrays["selection.proposals"])
    distance = (own[:, None] - regions[None]).abs().amax(dim=2).amin(dim=0)
    assert (distance < 0.01).float().mean() >= 0.97
    scores, boxes = network.refine(maps, regions, height, width)
    for i, (pooled, logits, residuals) in enumerate(heads):
        data.check(f"roi_head.bbox_roi_extractor.{i}", pooled, DENSE)
        data.check(f"roi_head.bbox_head.{i}.0", logits, DENSE)
        data.check(f"roi_head.bbox_head.{i}.1", residuals, DENSE)
    by_class = np.broadcast_to(boxes.numpy()[:, None], (*scores.shape, 4))
    check_predictions(data, select_detections(by_class, scores.numpy(), 0.05, 0.5, soft=False), pixels=0.01)


def check_predictions(data, found, pixels):
    """The original's final boxes, each with its own of ours; nearly equal scores may have changed places."""
    boxes, scores, labels = found
    expected = [data.arrays[f"prediction.{name}"] for name in ("bboxes", "scores", "labels")]
    assert len(boxes) == len(expected[0])
    np.testing.assert_allclose(scores, expected[1], atol=1e-4)
    fits = (labels[:, None] == expected[2]) & (np.abs(scores[:, None] - expected[1]) < 1e-4)
    fits &= np.abs(boxes[:, None] - expected[0]).max(axis=2) < pixels
    assert (maximum_bipartite_matching(csr_matrix(fits)) >= 0).all()
