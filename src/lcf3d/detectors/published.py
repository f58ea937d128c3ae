"""Published weights: the paper's detectors and localizers, and a camera detector to start with. What, where, whose.

Facts of the model indices of mmdetection3d 1.4.0 and of the YOLOX releases. OpenMMLab's files carry the first eight
digits of their SHA-256 in their name; the full sums are not published, so those digits are what a download is checked
against.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlparse

from lcf3d.errors import DetectorError

Sensor = Literal["lidar", "camera", "localizer"]

_ROOT = "https://download.openmmlab.com/mmdetection3d/"
_YOLOX = "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/"


@dataclass(frozen=True)
class PublishedModel:
    """A model that others have published, or that the paper names.

    Attributes:
        name: what it is called here; of a LiDAR network, the configuration it belongs to.
        url: where it is; "" where no address is known.
        row: which row of which table of the paper it belongs to; "" for none.
        scores: what its publishers report.
        sensor: which branch it serves.
        use: how a command names it.
        licence: of the published file.
        sha256: the whole sum where it is known, else "".
        size_bytes: size of the file where it is known, else 0.
        note: what to know beyond that.
    """

    name: str
    url: str
    row: str = ""
    scores: str = ""
    sensor: Sensor = "lidar"
    use: str = ""
    licence: str = ""
    sha256: str = ""
    size_bytes: int = 0
    note: str = ""

    @property
    def file_name(self) -> str:
        """Last part of the URL."""
        return Path(urlparse(self.url).path).name

    @property
    def digest_prefix(self) -> str:
        """The SHA-256, or its first digits from the file name; "" when nothing is known."""
        found = re.search(r"[-_]([0-9a-f]{8,64})\.pth$", self.file_name)
        return self.sha256 or (found.group(1) if found else "")


KINDS = ("pointpillars", "second", "part-a2", "pv-rcnn", "ssn", "centerpoint", "mvxnet", "bevfusion")
"""Kinds of ``--lidar`` that load OpenMMLab's files; a file is named after its kind."""


def _model(name: str, path: str, row: str, scores: str) -> PublishedModel:
    kind = next(k for k in KINDS if name.startswith(k))
    data = "nuScenes" if "nuscenes" in name else "KITTI"
    licence = f"Apache-2.0; trained on {data}, which is for non-commercial use"
    return PublishedModel(name, _ROOT + path, row, scores, use=f"--lidar {kind}:{name}", licence=licence)


def _yolox(size: str, scores: str, sha256: str = "", size_bytes: int = 0) -> PublishedModel:
    note = "COCO's 80 classes; the size and the sum are not published, the file is taken as it comes"
    return PublishedModel(
        f"yolox-{size}",
        f"{_YOLOX}yolox_{size}.onnx",
        "",
        scores,
        "camera",
        f"--camera yolox:{size}",
        "Apache-2.0",
        sha256,
        size_bytes,
        "COCO's 80 classes" if sha256 else note,
    )


def _mask_rcnn(name: str, path: str, scores: str) -> PublishedModel:
    return PublishedModel(
        name,
        f"{_ROOT}v0.1.0_models/nuimages_semseg/{path}",
        "",
        scores,
        "camera",
        f"--camera fasterrcnn:{name}",
        "Apache-2.0; trained on nuImages, which is for non-commercial use",
        note="nuScenes' ten classes, with masks",
    )


def _coco(name: str, kind: str, path: str, scores: str) -> PublishedModel:
    url = f"https://download.openmmlab.com/mmdetection/{path}"
    note = "COCO's 80 classes"
    return PublishedModel(name, url, "", scores, "camera", f"--camera {kind}:{name}", "Apache-2.0", note=note)


_AUTHORS = "trained by the LCF3D authors; no public address is known here: pass the path of your file"


PUBLISHED: tuple[PublishedModel, ...] = (
    _model(
        "pointpillars-kitti",
        "v1.0.0_models/pointpillars/hv_pointpillars_secfpn_6x8_160e_kitti-3d-3class/"
        "hv_pointpillars_secfpn_6x8_160e_kitti-3d-3class_20220301_150306-37dc2420.pth",
        "KITTI: PointPillars",
        "KITTI moderate mAP 64.07",
    ),
    _model(
        "pointpillars-kitti-car",
        "v1.0.0_models/pointpillars/hv_pointpillars_secfpn_6x8_160e_kitti-3d-car/"
        "hv_pointpillars_secfpn_6x8_160e_kitti-3d-car_20220331_134606-d42d15ed.pth",
        "",
        "KITTI moderate AP 77.6",
    ),
    _model(
        "second-kitti",
        "v1.1.0_models/second/second_hv_secfpn_8xb6-80e_kitti-3d-3class/"
        "second_hv_secfpn_8xb6-80e_kitti-3d-3class-b086d0a3.pth",
        "KITTI: SECOND",
        "KITTI moderate mAP 65.3",
    ),
    _model(
        "second-kitti-car",
        "v1.1.0_models/second/second_hv_secfpn_8xb6-80e_kitti-3d-car/"
        "second_hv_secfpn_8xb6-80e_kitti-3d-car-75d9305e.pth",
        "",
        "KITTI moderate AP 78.2",
    ),
    _model(
        "part-a2-kitti",
        "v1.0.0_models/parta2/hv_PartA2_secfpn_2x8_cyclic_80e_kitti-3d-3class/"
        "hv_PartA2_secfpn_2x8_cyclic_80e_kitti-3d-3class_20210831_022017-454a5344.pth",
        "KITTI: Part-A2",
        "KITTI moderate mAP 68.33",
    ),
    _model(
        "part-a2-kitti-car",
        "v1.0.0_models/parta2/hv_PartA2_secfpn_2x8_cyclic_80e_kitti-3d-car/"
        "hv_PartA2_secfpn_2x8_cyclic_80e_kitti-3d-car_20210831_022017-cb7ff621.pth",
        "",
        "KITTI moderate AP 79.08",
    ),
    _model(
        "pv-rcnn-kitti",
        "v1.1.0_models/pv_rcnn/pv_rcnn_8xb2-80e_kitti-3d-3class/"
        "pv_rcnn_8xb2-80e_kitti-3d-3class_20221117_234428-b384d22f.pth",
        "KITTI: PV-RCNN",
        "KITTI moderate mAP 72.28",
    ),
    _model(
        "pointpillars-nuscenes",
        "v1.0.0_models/pointpillars/hv_pointpillars_fpn_sbn-all_4x8_2x_nus-3d/"
        "hv_pointpillars_fpn_sbn-all_4x8_2x_nus-3d_20210826_104936-fca299c1.pth",
        "nuScenes: PointPillars",
        "nuScenes mAP 39.71, NDS 53.15",
    ),
    _model(
        "ssn-nuscenes",
        "v1.0.0_models/ssn/hv_ssn_secfpn_sbn-all_2x16_2x_nus-3d/"
        "hv_ssn_secfpn_sbn-all_2x16_2x_nus-3d_20210830_101351-51915986.pth",
        "",
        "nuScenes mAP 40.91, NDS 54.44",
    ),
    _model(
        "ssn-regnet-nuscenes",
        "v1.0.0_models/ssn/hv_ssn_regnet-400mf_secfpn_sbn-all_2x16_2x_nus-3d/"
        "hv_ssn_regnet-400mf_secfpn_sbn-all_2x16_2x_nus-3d_20210829_210615-361e5e04.pth",
        "nuScenes: SSN (by its scores)",
        "nuScenes mAP 46.65, NDS 58.24",
    ),
    _model(
        "centerpoint-pillar02-nuscenes",
        "v1.0.0_models/centerpoint/centerpoint_02pillar_second_secfpn_circlenms_4x8_cyclic_20e_nus/"
        "centerpoint_02pillar_second_secfpn_circlenms_4x8_cyclic_20e_nus_20220811_031844-191a3822.pth",
        "",
        "nuScenes mAP 48.70, NDS 59.62",
    ),
    _model(
        "centerpoint-voxel01-nuscenes",
        "v1.0.0_models/centerpoint/centerpoint_01voxel_second_secfpn_circlenms_4x8_cyclic_20e_nus/"
        "centerpoint_01voxel_second_secfpn_circlenms_4x8_cyclic_20e_nus_20220810_030004-9061688e.pth",
        "nuScenes: CenterPoint (by its scores)",
        "nuScenes mAP 56.11, NDS 64.61",
    ),
    _model(
        "mvxnet-kitti",
        "v1.1.0_models/mvxnet/mvxnet_fpn_dv_second_secfpn_8xb2-80e_kitti-3d-3class/"
        "mvxnet_fpn_dv_second_secfpn_8xb2-80e_kitti-3d-3class-8963258a.pth",
        "KITTI: MVXNet",
        "KITTI moderate mAP 63.5",
    ),
    _model(
        "bevfusion-lidar-nuscenes",
        "v1.1.0_models/bevfusion/bevfusion_lidar_voxel0075_second_secfpn_8xb4-cyclic-20e_nus-3d-2628f933.pth",
        "",
        "nuScenes mAP 64.9",
    ),
    _model(
        "bevfusion-nuscenes",
        "v1.1.0_models/bevfusion/bevfusion_lidar-cam_voxel0075_second_secfpn_8xb4-cyclic-20e_nus-3d-5239b1af.pth",
        "domain generalization: BEVFusion",
        "nuScenes mAP 68.6",
    ),
    _coco(
        "ddq-detr-r50-coco",
        "ddq",
        "v3.0/ddq/ddq-detr-4scale_r50_8xb2-12e_coco/ddq-detr-4scale_r50_8xb2-12e_coco_20230809_170711-42528127.pth",
        "COCO AP 51.4",
    ),
    _coco("ddq-detr-swinl-coco", "ddq", "v3.0/ddq/ddq_detr_swinl_30e.pth", "COCO AP 58.7"),
    _coco(
        "detectors-cascade-r50-coco",
        "detectors",
        "v2.0/detectors/detectors_cascade_rcnn_r50_1x_coco/detectors_cascade_rcnn_r50_1x_coco-32a10ba0.pth",
        "COCO AP 47.4",
    ),
    _yolox("nano", "COCO AP 25.8", "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d", 3_659_407),
    _yolox("tiny", "COCO AP 32.8", "427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7", 20_219_662),
    _yolox("s", "COCO AP 40.5", "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063", 35_858_002),
    _yolox("m", "COCO AP 47.2"),
    _yolox("l", "COCO AP 50.1", "7860ae79de6c89a3c1eb72ae9a2756c0ccfbe04b7791bb5880afabd97855a411", 216_746_733),
    _yolox("x", "COCO AP 51.5", "c892d7aaf1c4746d8a4d675bec669a4db4f434b4ee1efb654bc9b353379c7c55", 396_142_663),
    _mask_rcnn(
        "mask-rcnn-r50-nuimages",
        "mask_rcnn_r50_fpn_coco-2x_1x_nuim/mask_rcnn_r50_fpn_coco-2x_1x_nuim_20201008_195238-b1742a60.pth",
        "nuImages box AP 49.7, mask AP 40.5",
    ),
    _mask_rcnn(
        "mask-rcnn-r50-caffe-nuimages",
        "mask_rcnn_r50_caffe_fpn_coco-3x_20e_nuim/mask_rcnn_r50_caffe_fpn_coco-3x_20e_nuim_20201009_125002-5529442c.pth",
        "nuImages box AP 50.6, mask AP 41.3",
    ),
    PublishedModel(
        "fasterrcnn-r101-kitti",
        "",
        "KITTI: Faster R-CNN",
        sensor="camera",
        use="--camera fasterrcnn:FILE",
        note=_AUTHORS,
    ),
    PublishedModel(
        "fasterrcnn-r50-nuscenes",
        "",
        "nuScenes: Faster R-CNN",
        sensor="camera",
        use="--camera fasterrcnn:FILE",
        note=_AUTHORS,
    ),
    PublishedModel(
        "ddq-detr-nuscenes",
        "",
        "nuScenes: DDQ-DETR",
        sensor="camera",
        use="--camera ddq:FILE",
        note=_AUTHORS,
    ),
    PublishedModel(
        "detectors-nuimages",
        "",
        "nuScenes: DetectoRS, with masks",
        sensor="camera",
        use="--camera mmdet:CONFIG,FILE",
        note=_AUTHORS,
    ),
    PublishedModel(
        "frustum-pointnet-kitti",
        "",
        "KITTI: the localizer",
        sensor="localizer",
        use="--localizer frustum-pointnet:FILE",
        note=_AUTHORS,
    ),
    PublishedModel(
        "frustum-pointnet-nuscenes",
        "",
        "nuScenes: the localizer",
        sensor="localizer",
        use="--localizer frustum-pointnet:FILE",
        note=_AUTHORS,
    ),
)


def find_model(name: str) -> PublishedModel:
    """The published model of that name.

    Raises:
        DetectorError: there is none.
    """
    for model in PUBLISHED:
        if model.name == name:
            return model
    raise DetectorError(f"no published model {name!r}; known: {', '.join(model.name for model in PUBLISHED)}")
