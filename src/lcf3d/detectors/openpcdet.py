"""Checkpoints of OpenPCDet (0.6) by the names of our networks, where the networks are the same layer for layer.

PointPillars and SECOND are: the names differ, and the 2D blocks have a padding layer in front. PV-RCNN needs its second
stage's layers renamed too; its class-wise first stage is the same. Anchors stand in the order Car, Pedestrian, Cyclist,
which the presets ``*-openpcdet`` know.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_RULES: tuple[tuple[str, str], ...] = (
    (r"^vfe\.pfn_layers\.", "voxel_encoder.pfn_layers."),
    (r"^backbone_3d\.conv_input\.", "middle_encoder.conv_input."),
    (r"^backbone_3d\.conv(\d)\.", r"middle_encoder.encoder_layers.encoder_layer\1."),
    (r"^backbone_3d\.conv_out\.", "middle_encoder.conv_out."),
    (r"^backbone_2d\.deblocks\.", "neck.deblocks."),
    (r"^dense_head\.conv_box\.", "HEAD.conv_reg."),
    (r"^dense_head\.", "HEAD."),
    (r"^pfe\.SA_rawpoints\.", "points_encoder.rawpoints_sa_layer."),
    (r"^pfe\.SA_layers\.", "points_encoder.voxel_sa_layers."),
    (r"^pfe\.vsa_point_feature_fusion\.0\.", "points_encoder.point_feature_fusion_layer.0.conv."),
    (r"^pfe\.vsa_point_feature_fusion\.1\.", "points_encoder.point_feature_fusion_layer.0.bn."),
    (r"^point_head\.cls_layers\.", "roi_head.semantic_head.seg_cls_layer."),
    (r"^roi_head\.roi_grid_pool_layer\.", "roi_head.bbox_roi_extractor.roi_grid_pool_layer."),
)
_IGNORED = re.compile(r"(^global_step$|anchors|\.proj_|^dense_head\..*(loss|grid))")
# first layers of a fully connected stack in OpenPCDet: Conv, BN, ReLU, Dropout, Conv, BN, ReLU[, Conv]
_STACK = {0: "0.conv", 1: "0.bn", 4: "2.conv", 5: "2.bn", 7: "3"}


def translate(state: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of an OpenPCDet checkpoint by our names; names without a counterpart keep theirs."""
    two_stage = any(name.startswith("roi_head.") for name in state)
    head = "rpn_head" if two_stage else "bbox_head"
    translated = {}
    for name, value in state.items():
        if _IGNORED.search(name):
            continue
        new = _rename(name).replace("HEAD.", f"{head}.")
        if new.startswith("points_encoder.point_feature_fusion_layer.0.conv.") and value.ndim == 2:
            value = value[:, :, None, None]
        if re.match(r"roi_head\.bbox_head\.", new) and value.ndim == 3:
            value = value[..., None]
        translated[new] = value
    return translated


def _rename(name: str) -> str:
    block = re.match(r"^backbone_2d\.blocks\.(\d+)\.(\d+)\.(.*)$", name)
    if block:
        return f"backbone.blocks.{block[1]}.{int(block[2]) - 1}.{block[3]}"
    stack = re.match(r"^roi_head\.(shared_fc_layer|cls_layers|reg_layers)\.(\d+)\.(.*)$", name)
    if stack and int(stack[2]) in _STACK:
        layer = stack[1].replace("layers", "layer")
        return f"roi_head.bbox_head.{layer}.{_STACK[int(stack[2])]}.{stack[3]}"
    for pattern, replacement in _RULES:
        if re.search(pattern, name):
            name = re.sub(pattern, replacement, name)
            break
    # the layers of set abstraction: Conv, BN, ReLU, Conv, BN, ReLU
    mlp = re.match(r"^(.*\.mlps\.\d+)\.(\d+)\.(.*)$", name)
    if mlp:
        layer, part = divmod(int(mlp[2]), 3)
        return f"{mlp[1]}.layer{layer}.{('conv', 'bn')[part]}.{mlp[3]}"
    return name
