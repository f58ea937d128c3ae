"""The Swin transformer's parts against torchvision's and by hand."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")

from lcf3d.networks.swin import (  # noqa: E402
    MASKED,
    PatchMerging,
    ShiftedWindowAttention,
    SwinTransformer,
    from_windows,
    shift_mask,
    to_windows,
)


def test_windows_and_back():
    x = torch.arange(2 * 6 * 9 * 1.0).reshape(2, 6, 9, 1)
    windows = to_windows(x, 3)
    assert windows.shape == (2, 6, 9, 1)
    # the second window of the upper row
    assert windows[0, 1, :, 0].tolist() == [3, 4, 5, 12, 13, 14, 21, 22, 23]
    assert torch.equal(from_windows(windows, 3, 6, 9), x)


def test_shift_mask_by_hand():
    # 4 x 4 cells, windows of 2, shifted by 1: of the last window every cell comes from another corner
    mask = shift_mask(4, 4, 2, 1, torch.zeros(1))
    assert mask.shape == (4, 1, 4, 4)
    assert not mask[0].any()
    apart = mask[3, 0] == MASKED
    assert torch.equal(apart, ~torch.eye(4, dtype=torch.bool))
    # the upper right window: its columns do not see one another, its rows do
    assert (mask[1, 0] == MASKED).tolist() == [[False, True] * 2, [True, False] * 2] * 2


@pytest.mark.parametrize("shift", [0, 2])
@torch.inference_mode()
def test_attention_is_torchvisions(shift):
    swin = pytest.importorskip("torchvision.models.swin_transformer")
    torch.manual_seed(0)
    layer = ShiftedWindowAttention(8, heads=2, window=4, shift=shift)
    inner = layer.w_msa
    torch.nn.init.normal_(inner.relative_position_bias_table)
    theirs = swin.ShiftedWindowAttention(8, [4, 4], [shift, shift], 2)
    theirs.load_state_dict(
        {
            "relative_position_bias_table": inner.relative_position_bias_table,
            "relative_position_index": theirs.relative_position_index,
            **{f"qkv.{k}": v for k, v in inner.qkv.state_dict().items()},
            **{f"proj.{k}": v for k, v in inner.proj.state_dict().items()},
        }
    )
    # sides that are no multiples of the window are padded
    x = torch.randn(2, 10, 13, 8)
    torch.testing.assert_close(layer(x), theirs(x), rtol=1e-4, atol=1e-5)


@torch.inference_mode()
def test_patch_merging_is_an_unfold():
    layer = PatchMerging(3)
    x = torch.randn(2, 5, 7, 3)
    padded = torch.nn.functional.pad(x.permute(0, 3, 1, 2), (0, 1, 0, 1))
    unfolded = torch.nn.functional.unfold(padded, 2, stride=2).transpose(1, 2)
    expected = layer.reduction(layer.norm(unfolded))
    torch.testing.assert_close(layer(x).flatten(1, 2), expected)


@torch.inference_mode()
def test_outputs_have_their_strides():
    network = SwinTransformer(8, (1, 2, 1, 1), (1, 2, 2, 4), window=4, outputs=(1, 2, 3)).eval()
    maps = network(torch.zeros(1, 3, 66, 97))
    assert [tuple(x.shape) for x in maps] == [(1, 16, 9, 13), (1, 32, 5, 7), (1, 64, 3, 4)]
