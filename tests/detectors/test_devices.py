"""That nothing in the networks stays on another device: CUDA tensors without values, so that no GPU is needed.

Weights and inputs are made on the GPU; what a network makes on its way is not, unless it says so, as in use: torch's
own device is the CPU, and operations on both devices fail.
"""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")
fake_tensor = pytest.importorskip("torch._subclasses.fake_tensor")

from lcf3d.detectors.camera.ddq import DDQNetwork  # noqa: E402
from lcf3d.detectors.camera.detectors_cascade import RecursivePyramid, SwitchableResNet  # noqa: E402
from lcf3d.detectors.camera.torchvision_fasterrcnn import FasterRCNNNetwork  # noqa: E402
from lcf3d.detectors.camera.torchvision_styles import STYLES  # noqa: E402
from lcf3d.detectors.fusion import transfusion, view_transform  # noqa: E402
from lcf3d.detectors.fusion.mvxnet import FusedVoxelEncoder  # noqa: E402

CUDA = torch.device("cuda", 0)


@pytest.fixture(autouse=True)
def on_cuda():
    with fake_tensor.FakeTensorMode(allow_non_fake_inputs=True), torch.no_grad():
        yield


def made(build):
    """A network with its weights on the GPU."""
    with CUDA:
        return build().eval()


def empty(*shape):
    return torch.empty(*shape, device=CUDA)


@pytest.mark.parametrize("swin", [False, True])
def test_ddq(swin):
    network = made(lambda: DDQNetwork(swin, 80))
    memory, shapes = network.encode(empty(1, 3, 255, 512))
    assert {x.device for x in network.propose(memory, shapes)} == {CUDA}
    distinct = [torch.ones(900, dtype=torch.bool, device=CUDA) for _ in range(5)]
    decoded = network.decode(empty(900, 256), empty(900, 4), memory, shapes, distinct)
    assert {x.device for x in network.predict(decoded, 5)} == {CUDA}


def test_detectors():
    image = empty(1, 3, 256, 512)
    maps = made(RecursivePyramid).look(image, made(lambda: SwitchableResNet(recursive=False))(image))
    assert {x.device for x in maps} == {CUDA}


def test_faster_rcnn():
    network = made(lambda: FasterRCNNNetwork(50, STYLES["kitti"], masks=True))
    maps = network.maps(empty(1, 3, 128, 416))
    assert {x.device for x in maps} == {CUDA}
    assert {x.device for level in network.rpn_head(maps) for x in level} == {CUDA}
    # what lies in which level of the pyramid depends on values, which there are none of here: the heads alone
    assert {x.device for x in network.roi_head.bbox_head(empty(7, 256, 7, 7))} == {CUDA}
    assert network.roi_head.mask_head(empty(7, 256, 14, 14)).device == CUDA


def test_query_head():
    head = made(lambda: transfusion.TransFusionHead(512, 10))
    assert {x.device for x in head(empty(1, 512, 180, 180)).values()} == {CUDA}


def test_camera_branch():
    rays = view_transform.ray_points(empty(2, 3, 3), empty(2, 4, 4), empty(2, 3))
    assert view_transform.bev_cells(rays).device == CUDA
    network = made(view_transform.DepthViewTransform)
    depths, maps = empty(2, 1, 256, 704), empty(2, 256, 32, 88)
    assert network.depthnet(torch.cat([network.dtransform(depths), maps], dim=1)).device == CUDA


def test_points_with_pixels():
    maps = [empty(1, 256, 96 >> i, 312 >> i) for i in range(5)]
    voxel = torch.zeros(100, dtype=torch.long, device=CUDA)
    encoded = made(lambda: FusedVoxelEncoder(10))(empty(100, 10), voxel, 60, maps, empty(100, 2))
    assert encoded.device == CUDA
