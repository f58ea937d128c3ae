"""That nothing in the networks stays on another device: CUDA tensors without values, so that no GPU is needed."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("torchvision")
fake_tensor = pytest.importorskip("torch._subclasses.fake_tensor")

from lcf3d.detectors.camera.ddq import DDQNetwork  # noqa: E402
from lcf3d.detectors.camera.detectors_cascade import RecursivePyramid, SwitchableResNet  # noqa: E402
from lcf3d.detectors.fusion import transfusion, view_transform  # noqa: E402
from lcf3d.detectors.fusion.mvxnet import FusedVoxelEncoder  # noqa: E402

CUDA = torch.device("cuda", 0)


@pytest.fixture(autouse=True)
def on_cuda():
    with fake_tensor.FakeTensorMode(allow_non_fake_inputs=True), torch.no_grad(), CUDA:
        yield


@pytest.mark.parametrize("swin", [False, True])
def test_ddq(swin):
    network = DDQNetwork(swin, 80).eval()
    memory, shapes = network.encode(torch.empty(1, 3, 255, 512))
    assert {x.device for x in network.propose(memory, shapes)} == {CUDA}
    distinct = [torch.ones(900, dtype=torch.bool) for _ in range(5)]
    decoded = network.decode(torch.empty(900, 256), torch.empty(900, 4), memory, shapes, distinct)
    assert {x.device for x in network.predict(decoded, 5)} == {CUDA}


def test_detectors():
    image = torch.empty(1, 3, 256, 512)
    maps = RecursivePyramid().eval().look(image, SwitchableResNet(recursive=False).eval()(image))
    assert {x.device for x in maps} == {CUDA}


def test_query_head():
    head = transfusion.TransFusionHead(512, 10).eval()
    assert {x.device for x in head(torch.empty(1, 512, 180, 180)).values()} == {CUDA}


def test_camera_branch():
    rays = view_transform.ray_points(torch.empty(2, 3, 3), torch.empty(2, 4, 4), torch.empty(2, 3))
    assert view_transform.bev_cells(rays).device == CUDA
    network = view_transform.DepthViewTransform().eval()
    depths, maps = torch.empty(2, 1, 256, 704), torch.empty(2, 256, 32, 88)
    assert network.depthnet(torch.cat([network.dtransform(depths), maps], dim=1)).device == CUDA


def test_points_with_pixels():
    maps = [torch.empty(1, 256, 96 >> i, 312 >> i) for i in range(5)]
    voxel = torch.zeros(100, dtype=torch.long)
    encoded = FusedVoxelEncoder(10).eval()(torch.empty(100, 10), voxel, 60, maps, torch.empty(100, 2))
    assert encoded.device == CUDA
