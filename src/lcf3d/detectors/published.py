"""The published weights of the paper's LiDAR detectors: where they are, and fetching them whole and verified.

Facts of the model index of mmdetection3d 1.4.0. Its files carry the first eight digits of their SHA-256 in their name;
the full sums are not published, so those digits are what a download is checked against.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import urlparse
from urllib.request import urlopen

from lcf3d.errors import DetectorError
from lcf3d.files import atomic_path

_ROOT = "https://download.openmmlab.com/mmdetection3d/"
CACHE = Path("~/.cache/lcf3d/models")
BLOCK = 1 << 20


@dataclass(frozen=True)
class PublishedModel:
    """A checkpoint that can be downloaded.

    Attributes:
        name: what it is called here, and the configuration it belongs to.
        url: where it is; its file name ends in the first digits of its SHA-256.
        row: which row of which table of the paper it belongs to; "" for none.
        scores: what its publishers report.
    """

    name: str
    url: str
    row: str
    scores: str

    @property
    def file_name(self) -> str:
        """Last part of the URL."""
        return Path(urlparse(self.url).path).name

    @property
    def digest_prefix(self) -> str:
        """First digits of the SHA-256, from the file name; "" when it has none."""
        found = re.search(r"[-_]([0-9a-f]{8,64})\.pth$", self.file_name)
        return found.group(1) if found else ""


def _model(name: str, path: str, row: str, scores: str) -> PublishedModel:
    return PublishedModel(name, _ROOT + path, row, scores)


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


def download(model: PublishedModel, folder: Path | None = None, timeout_s: float = 30.0) -> Path:
    """The path of the model's file in ``folder``, downloaded unless it is there and right.

    Raises:
        DetectorError: the server cannot be reached or sends something else; nothing is left in ``folder`` then.
    """
    path = (folder or CACHE.expanduser()) / model.file_name
    if path.is_file() and _is_right(model, _sha256(path)):
        return path
    with atomic_path(path) as temporary:
        digest = _fetch(model, temporary, timeout_s)
        if not _is_right(model, digest):
            raise DetectorError(
                f"{model.url} has SHA-256 {digest[:16]}..., expected one that begins with {model.digest_prefix}: "
                "the download was cut or the file was replaced; try again"
            )
    return path


def _is_right(model: PublishedModel, digest: str) -> bool:
    return digest.startswith(model.digest_prefix)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while block := file.read(BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _fetch(model: PublishedModel, path: Path, timeout_s: float) -> str:
    """Write what the URL serves to ``path``; its SHA-256."""
    from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn

    digest = hashlib.sha256()
    received = 0
    try:
        with (
            urlopen(model.url, timeout=timeout_s) as response,
            path.open("wb") as file,
            Progress("{task.description}", BarColumn(), DownloadColumn(), TransferSpeedColumn()) as progress,
        ):
            length = response.headers.get("Content-Length")
            task = progress.add_task(model.name, total=int(length) if length else None)
            while block := response.read(BLOCK):
                file.write(block)
                digest.update(block)
                received += len(block)
                progress.update(task, completed=received)
    except (URLError, OSError) as error:
        reason = error if isinstance(error, HTTPError) else getattr(error, "reason", error)
        raise DetectorError(
            f"{model.name} cannot be downloaded from {model.url} ({reason}); on a machine without network, download it "
            f"elsewhere and put it at {CACHE / model.file_name} or name its path"
        ) from None
    if length and received != int(length):
        raise DetectorError(f"{model.url} sent {received} of {length} bytes; try again")
    return digest.hexdigest()
