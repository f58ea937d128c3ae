"""MVX-Net and BEVFusion against the original implementations, map by map, with every parameter filled by rule."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.base import SCAN  # noqa: E402
from lcf3d.detectors.fusion import mvxnet, view_transform  # noqa: E402
from lcf3d.detectors.fusion.bevfusion import RAW_FROM_LIDAR, BEVFusion  # noqa: E402
from lcf3d.detectors.fusion.transfusion import decode_queries, local_maxima, select  # noqa: E402
from lcf3d.geometry.boxes import mmdet3d_from_canonical, wrap_angle  # noqa: E402

pytestmark = pytest.mark.real
DENSE = 1e-4
CELLS = 180 * 180


@torch.inference_mode()
@pytest.mark.parametrize(("prefix", "size"), [("", None), ("resized.", mvxnet.IMAGE_SIZE)])
def test_mvxnet(golden, capture, kitti_frame, prefix, size):
    data = golden("mvxnet_kitti")
    detector = mvxnet.MVXNet.from_state_dict(data.state())
    network = detector.network
    encoder = network.voxel_encoder
    outputs = capture(
        {
            "img_backbone": network.img_backbone,
            "img_neck": network.img_neck,
            "pts_voxel_encoder.vfe_layers.0": encoder.vfe_layers[0],
            "pts_voxel_encoder.vfe_layers.1": encoder.vfe_layers[1],
            "pts_voxel_encoder.fusion_layer": encoder.fusion_layer,
            "pts_voxel_encoder.fusion_layer.img_transform": encoder.fusion_layer.img_transform,
            "pts_voxel_encoder.fusion_layer.pts_transform": encoder.fusion_layer.pts_transform,
            "pts_middle_encoder": network.middle_encoder,
            "voxels": encoder,
            "pts_backbone": network.backbone,
            "pts_neck": network.neck,
        }
    )
    inputs = detector.inputs(kitti_frame, size)
    # the original's points are in the order of the scan, ours voxel by voxel
    ours, theirs = (np.lexsort(points.T) for points in (inputs["features"][:, :4], data.arrays["input"]))
    place = np.empty_like(ours)
    place[theirs] = ours
    np.testing.assert_array_equal(inputs["features"][place, :4], data.arrays["input"])
    maps = network(**detector.tensors(inputs))

    def check(stage, value, tolerance=DENSE):
        if prefix + stage in data.info["maps"]:
            data.check(prefix + stage, value, tolerance)

    check("image", inputs["image"], 1e-7)
    for stage, value in outputs.items():
        if stage.endswith(".input") or stage == "voxels":
            continue
        for i, level in enumerate(value if isinstance(value, list) else [value]):
            per_point = "voxel_encoder" in stage
            check(f"{stage}.{i}" if isinstance(value, list) else stage, level[place] if per_point else level)
    cells = inputs["coordinates"]
    order = np.lexsort(cells.T[::-1])
    check("pts_voxel_encoder.0", outputs["voxels"][order])
    check("pts_voxel_encoder.1", np.pad(cells[order], ((0, 0), (1, 0))), 1e-7)
    for i, value in enumerate(maps[0]):
        check(f"pts_bbox_head.{i}.0", value)
    boxes, scores, labels = (data.arrays[f"prediction.{prefix}{n}_3d"] for n in ("bboxes", "scores", "labels"))
    found = detector.decode(maps)
    assert len(found) == len(boxes) == len(np.unique(scores))
    data.check_contained(found, boxes.astype(np.float64), scores, labels, 1e-3)


def bevfusion(data, frame, capture):
    """Detector, its inputs with the matrices of the parity data, and outputs of its parts by the original's names."""
    detector = BEVFusion.from_state_dict(data.state())
    network = detector.network
    # the parity data is of the key frame alone
    detector.cloud = SCAN
    inputs = detector.inputs(frame)
    modules = {
        "pts_middle_encoder": network.middle_encoder,
        "pts_backbone": network.backbone,
        "pts_neck": network.neck,
        "bbox_head.shared_conv": network.bbox_head.shared_conv,
        "bbox_head.heatmap_head": network.bbox_head.heatmap_head,
        "bbox_head.decoder.0.self_attn": network.bbox_head.decoder[0].self_attn,
        "bbox_head.decoder.0.cross_attn": network.bbox_head.decoder[0].cross_attn,
        "bbox_head.decoder.0": network.bbox_head.decoder[0],
        "pts_middle_encoder.conv_input": network.middle_encoder.conv_input,
        "pts_middle_encoder.conv_out": network.middle_encoder.conv_out,
    }
    for name, stage in network.middle_encoder.encoder_layers.named_children():
        modules[f"pts_middle_encoder.encoder_layers.{name}"] = stage
    if detector.uses_cameras:
        with_matrices(data, frame, inputs)
        modules |= {
            "img_backbone.patch_embed.0": network.img_backbone.patch_embed,
            "stage": network.img_backbone.stages[0],
            "img_backbone": network.img_backbone,
            "img_neck": network.img_neck,
            "view_transform.dtransform": network.view_transform.dtransform,
            "view_transform.depthnet": network.view_transform.depthnet,
            "view_transform.downsample": network.view_transform.downsample,
            "view_transform": network.view_transform,
            "fusion_layer": network.fusion_layer,
        }
    outputs = capture(modules)
    network(**detector.tensors(inputs))
    return detector, inputs, outputs


def with_matrices(data, frame, inputs):
    """Camera inputs in the original's order, and geometry from its single-precision matrices."""
    names = [camera.name for camera in frame.cameras]
    order = [names.index(name) for name in data.info["frame"]["cameras"]]
    from_raw = np.stack([frame.cameras[i].pixels_from_lidar @ RAW_FROM_LIDAR.T for i in order])
    # single precision ends at 1e-4 of pixels times metres
    np.testing.assert_allclose(from_raw, data.arrays["lidar2img"][:, :3], rtol=1e-6, atol=3e-4)
    resize = np.tile(np.array([0.48, 32, 176], np.float32), (6, 1))
    matrices = (data.arrays["cam2img"][:, :3, :3], data.arrays["cam2lidar"], resize)
    rays = view_transform.ray_points(*map(torch.from_numpy, matrices))
    data.check("view_transform.geometry", rays[None], 1e-6)
    cells = view_transform.bev_cells(rays).numpy()
    frustum = data.info["frustum"]
    assert (cells >= 0).sum() == frustum["inside_the_grid"]
    assert (cells != inputs["cells"][order]).sum() <= 2 * frustum[next(k for k in frustum if "another_cell" in k)]
    points, depths = data.arrays["input"], inputs["depths"][order]
    inputs["images"], inputs["cells"] = inputs["images"][order], cells
    inputs["depths"] = np.stack(
        [view_transform.depth_map(points, *pair) for pair in zip(data.arrays["lidar2img"], resize, strict=True)]
    )
    # a point on the border of a pixel may fall to the other side
    assert ((depths != 0) != (inputs["depths"] != 0)).sum() <= 4


def check_lidar(data, inputs, outputs):
    """Voxels and the sparse encoder; the original's axes are x, y, z."""
    cells = inputs["coordinates"][:, ::-1]
    data.check("voxel_coors", np.pad(cells, ((0, 0), (1, 0))), 1e-7)
    data.check("voxel_features", inputs["features"], 1e-6)
    for stage, value in outputs.items():
        if stage.startswith("pts_middle_encoder.") and not stage.endswith(".input"):
            sites = value.sites.coordinates.numpy()[:, [0, 3, 2, 1]]
            order = np.lexsort(sites.T[::-1])
            data.check(f"{stage}.sparse_indices", sites[order], 1e-7)
            data.check(f"{stage}.sparse_features", value.features[order], DENSE)
    data.check("pts_middle_encoder", outputs["pts_middle_encoder"].transpose(2, 3), DENSE)


def check_head(data, detector, outputs, check):
    """The own selection as a set; what follows, and the boxes, with the original's selection."""
    head = detector.network.bbox_head
    selection = torch.from_numpy(data.arrays["selection.class_cell"]).long()
    peaks = local_maxima(outputs["bbox_head.heatmap_head"].sigmoid())
    assert set(select(peaks).tolist()) == set(selection.tolist())
    values = head.predict(outputs["bbox_head.shared_conv"], peaks, selection)
    for stage in ("self_attn", "cross_attn"):
        check(f"bbox_head.decoder.0.{stage}", outputs[f"bbox_head.decoder.0.{stage}"])
    check("bbox_head.decoder.0", outputs["bbox_head.decoder.0"].transpose(1, 2))
    for name in ("center", "height", "dim", "rot", "vel", "heatmap"):
        check(f"bbox_head.0.0.{name}", values[name].t()[None])
    check("bbox_head.0.0.query_heatmap_score", peaks.flatten(2)[:, :, selection % CELLS])
    data.check("bbox_head.query_labels", values["label"][None], 1e-7)
    return values


def check_boxes(data, detector, values, tolerance):
    """Boxes in the network's frame, then the same in ours, a quarter turn away."""
    boxes, scores, labels = decode_queries({name: value.numpy() for name, value in values.items()})
    expected, expected_scores, expected_labels = (
        data.arrays[f"prediction.{name}_3d"] for name in ("bboxes", "scores", "labels")
    )
    np.testing.assert_array_equal(labels, expected_labels)
    np.testing.assert_allclose(scores, expected_scores, atol=tolerance)
    np.testing.assert_allclose(boxes, expected, rtol=tolerance, atol=tolerance)
    found = detector.decode(values)
    turned = mmdet3d_from_canonical(found.boxes)
    np.testing.assert_allclose(turned[:, :2], np.stack([boxes[:, 1], -boxes[:, 0]], axis=1))
    np.testing.assert_allclose(turned[:, 2:6], boxes[:, 2:6])
    np.testing.assert_allclose(np.cos(turned[:, 6] + np.pi / 2 - boxes[:, 6]), 1)
    assert (turned[:, 6] == wrap_angle(turned[:, 6])).all()
    np.testing.assert_allclose(found.velocities, np.stack([boxes[:, 8], -boxes[:, 7]], axis=1))


@torch.inference_mode()
def test_bevfusion_lidar(golden, capture, nuscenes_frame):
    data = golden("bevfusion_lidar_nus")
    detector, inputs, outputs = bevfusion(data, nuscenes_frame, capture)

    def check(stage, value):
        data.check(stage, value, DENSE)

    check_lidar(data, inputs, outputs)
    for i in range(2):
        check(f"pts_backbone.{i}", outputs["pts_backbone"][i])
    check("pts_neck.0", outputs["pts_neck"][0])
    for stage in ("shared_conv", "heatmap_head"):
        check(f"bbox_head.{stage}", outputs[f"bbox_head.{stage}"])
    check_boxes(data, detector, check_head(data, detector, outputs, check), 1e-4)


@torch.inference_mode()
def test_bevfusion(golden, capture, nuscenes_frame):
    data = golden("bevfusion_nus")
    detector, inputs, outputs = bevfusion(data, nuscenes_frame, capture)
    check_lidar(data, inputs, outputs)
    data.check("image", inputs["images"][None], 1e-7)
    data.check("view_transform.depth_map", inputs["depths"], 1e-6)
    data.check("img_backbone.patch_embed.0", outputs["img_backbone.patch_embed.0"].flatten(1, 2), DENSE)
    data.check("img_backbone.stages.0.0", outputs["stage"][1].flatten(1, 2), DENSE)
    data.check("img_backbone.stages.0.2", outputs["stage"][0].flatten(1, 2), DENSE)
    for stage in ("img_backbone", "img_neck"):
        for i, value in enumerate(outputs[stage]):
            data.check(f"{stage}.{i}", value, DENSE)

    for stage in ("view_transform.dtransform", "view_transform.depthnet"):
        data.check(stage, outputs[stage], DENSE)
    check_frustum_features(data, outputs["view_transform.depthnet"])

    # of the 2 million points of the rays, some dozens fall into another cell where geometry is rounded otherwise
    def check(stage, value):
        data.check_most(stage, value, 5e-3)

    check("view_transform.bev_pool", outputs["view_transform.downsample.input"][0])
    for stage in ("view_transform", "fusion_layer", "bbox_head.shared_conv", "bbox_head.heatmap_head"):
        check(stage, outputs[stage])
    for i in range(2):
        check(f"pts_backbone.{i}", outputs["pts_backbone"][i])
    check("pts_neck.0", outputs["pts_neck"][0])
    check_boxes(data, detector, check_head(data, detector, outputs, check), 1e-4)


def check_frustum_features(data, mixed):
    """The samples of depth times features, which are never built as a whole."""
    stage = "view_transform.frustum_features"
    shape = data.info["maps"][stage]["shape"]
    _, camera, depth, row, column, channel = np.unravel_index(data.arrays[f"map.{stage}.index"], shape)
    depths, features = mixed[:, : shape[2]].softmax(dim=1).numpy(), mixed[:, shape[2] :].numpy()
    found = depths[camera, depth, row, column] * features[camera, channel, row, column]
    np.testing.assert_allclose(found, data.arrays[f"map.{stage}.value"], rtol=DENSE, atol=1e-7)
