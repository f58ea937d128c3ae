"""The way through spconv against our own convolutions: with a stand-in for spconv, and with spconv where it is there.

spconv is used on a GPU only. Its CPU build computes the same with one thread, and is not to be trusted with more.
"""

from __future__ import annotations

import sys

import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.lidar import sparse_spconv  # noqa: E402
from lcf3d.detectors.lidar.fusing import fuse_batch_norm  # noqa: E402
from lcf3d.detectors.lidar.sparse import (  # noqa: E402
    InverseConv,
    SparseBlock,
    SparseTensor,
    StridedConv,
    SubmanifoldConv,
)
from lcf3d.detectors.lidar.sparse_encoders import SparseEncoder  # noqa: E402
from lcf3d.detectors.lidar.sparse_sites import Sites  # noqa: E402
from lcf3d.detectors.lidar.sparse_unet import SparseUNet  # noqa: E402
from tests.detectors.lidar import spconv_stand_in  # noqa: E402

SHAPE = (7, 9, 8)


@pytest.fixture(params=["stand-in", "spconv"])
def library(request):
    if request.param == "stand-in":
        yield spconv_stand_in
    else:
        real = pytest.importorskip("spconv.pytorch")
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        yield real
        torch.set_num_threads(threads)


@pytest.fixture
def both(library, monkeypatch):
    """The results of a computation with our convolutions and with the library's."""

    def compute(run):
        ours = run()
        with monkeypatch.context() as patch:
            patch.setattr(sparse_spconv, "spconv_for", lambda features: library if len(features) else None)
            return ours, run()

    return compute


def cells(shape, batch=1, share=0.2):
    generator = torch.Generator().manual_seed(3)
    found = torch.nonzero(torch.rand((batch, *shape), generator=generator) < share)
    return found[torch.randperm(len(found), generator=generator)]


def cloud(channels=5, batch=2):
    coordinates = cells(SHAPE, batch)
    features = torch.randn(len(coordinates), channels, generator=torch.Generator().manual_seed(4))
    return SparseTensor(features, Sites(coordinates, SHAPE))


def close(first, second):
    assert first.std() > 0
    torch.testing.assert_close(first, second, rtol=1e-4, atol=1e-5 * float(first.std()))


@torch.inference_mode()
@pytest.mark.parametrize("kernel", [(3, 3, 3), (1, 3, 5)])
def test_submanifold_convolution(both, kernel):
    conv = SubmanifoldConv(5, 6, kernel)
    close(*both(lambda: conv(cloud()).features))


@torch.inference_mode()
@pytest.mark.parametrize(
    ("kernel", "stride", "padding"),
    [((3, 3, 3), (2, 2, 2), (1, 1, 1)), ((3, 3, 3), (2, 2, 2), (0, 1, 1)), ((3, 1, 1), (2, 1, 1), (0, 0, 0))],
)
def test_strided_convolution(both, kernel, stride, padding):
    conv = StridedConv(5, 6, kernel, stride, padding)
    ours, theirs = both(lambda: conv(cloud()))
    assert ours.sites.shape == theirs.sites.shape
    assert len(ours.sites) == len(theirs.sites)
    close(ours.dense(2), theirs.dense(2))


@torch.inference_mode()
def test_the_way_back_and_kernels_shared_between_layers(both):
    down, back = StridedConv(5, 6, padding=(0, 1, 1)), InverseConv(6, 4)
    before, between, after = SubmanifoldConv(5, 5), SubmanifoldConv(6, 6), SubmanifoldConv(4, 4)

    def run():
        fine = before(before(cloud()))
        coarse = between(between(down(fine)))
        assert set(coarse.sites.spconv_indices) in (set(), {"strided", "submanifold (3, 3, 3)"})
        return after(back(coarse, fine.sites, down)).features

    close(*both(run))


@torch.inference_mode()
def test_a_second_strided_convolution_of_the_same_sites_does_not_disturb_the_first(both):
    down, other, back = StridedConv(5, 6), StridedConv(5, 6, padding=(0, 1, 1)), InverseConv(6, 4)

    def run():
        fine = cloud()
        coarse = down(fine)
        other(fine)
        return back(coarse, fine.sites, down).features

    close(*both(run))


@torch.inference_mode()
def test_folded_normalization(both):
    block = SparseBlock(SubmanifoldConv(5, 6)).eval()
    block[1].running_mean.uniform_(-1, 1)
    fuse_batch_norm(block)
    close(*both(lambda: block(cloud()).features))


def test_gradients_reach_the_weights(both, library):
    if library is not spconv_stand_in:
        pytest.skip("spconv has no backward pass on the CPU")
    down, back = StridedConv(5, 6), InverseConv(6, 5)

    def run():
        x = cloud()
        parameters = (down.weight, back.weight)
        return torch.autograd.grad((back(down(x), x.sites, down).features ** 2).sum(), parameters)

    for ours, theirs in zip(*both(run), strict=True):
        assert ours.abs().max() > 0
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3)


@torch.inference_mode()
@pytest.mark.parametrize("build", [SparseUNet, SparseEncoder, lambda *a: SparseEncoder(*a, residual=True)])
def test_whole_encoders(both, build):
    shape = (41, 16, 8)
    torch.manual_seed(0)
    network = build(4, shape).eval()
    coordinates = cells(shape, share=0.02)[:, 1:]
    features = torch.randn(len(coordinates), 4)
    ours, theirs = both(lambda: network(features, coordinates))
    for a, b in zip(*(v if isinstance(v, tuple) else (v,) for v in (ours, theirs)), strict=True):
        close(a, b)


@torch.inference_mode()
def test_no_sites_need_no_library(both):
    nothing = SparseTensor(torch.zeros(0, 5), Sites(torch.zeros(0, 4, dtype=torch.int64), SHAPE))
    ours, theirs = both(lambda: SubmanifoldConv(5, 6)(StridedConv(5, 5)(nothing)).features)
    assert ours.shape == theirs.shape == (0, 6)


class OnGpu:
    """Features that say they are on a GPU."""

    is_cuda = True

    def __init__(self, count):
        self.count = count

    def __len__(self):
        return self.count


def test_the_library_serves_features_on_a_gpu(monkeypatch):
    monkeypatch.setitem(sys.modules, "spconv", spconv_stand_in)
    monkeypatch.setitem(sys.modules, "spconv.pytorch", spconv_stand_in)
    monkeypatch.setattr(sparse_spconv, "_library", sparse_spconv._library.__wrapped__)
    assert sparse_spconv.spconv_for(OnGpu(3)) is spconv_stand_in
    assert sparse_spconv.spconv_for(OnGpu(0)) is None
    assert sparse_spconv.spconv_for(torch.zeros(3, 1)) is None
    monkeypatch.setitem(sys.modules, "spconv.pytorch", None)
    assert sparse_spconv.spconv_for(OnGpu(3)) is None
