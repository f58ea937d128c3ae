"""Weights filled by rule and simulated frames, in place of what is not here, to see that every step of a table runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lcf3d.detectors.published import find_model
from lcf3d.files import atomic_path
from lcf3d.networks.torch import nn, torch
from lcf3d.simulation.writer import Recipe, write_dataset

# the camera networks are rehearsed as the smallest one that finds the same classes, on small images: file, style, masks
_CAMERAS = {
    "fasterrcnn-r101-kitti": ("fasterrcnn-kitti", "kitti", False),
    "fasterrcnn-r50-nuscenes": ("maskrcnn-nuscenes", "nuscenes", True),
    "ddq-detr-nuscenes": ("maskrcnn-nuscenes", "nuscenes", True),
    "detectors-nuimages": ("maskrcnn-nuscenes", "nuscenes", True),
}
# gain of the class weights, with which scores differ, and a threshold that a handful of boxes passes
_SCORES = {"kitti": (150.0, 0.75), "nuscenes": (2.6, 0.4)}
IMAGE_SIZE = "400x225"
"""Longer and shorter side of images that the camera networks see, in pixels."""

DATA = {"kitti": ("kitti64", 2), "nuscenes": ("nuscenes32", 1)}
"""Preset and number of the simulated frames by kind of dataset; of KITTI's, the last one is the validation split."""


def filled_weights(names: Sequence[str], folder: Path) -> dict[str, str]:
    """Checkpoint files of networks with fixed random weights; what each name stands for (see `spec_of`).

    Args:
        names: published names, see `lcf3d.detectors.published`.
        folder: where the files are kept; those that are there are taken.
    """
    return {name: _filled(name, folder / f"{name}.pth") for name in names}


def _filled(name: str, path: Path) -> str:
    camera = _CAMERAS.get(name)
    if camera is not None:
        path = path.with_name(f"{camera[0]}.pth")
    if not path.is_file():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            state = _state(name)
        with atomic_path(path) as temporary:
            torch.save({"state_dict": state}, temporary)
    if camera is None:
        return str(path)
    return f"fasterrcnn:{path}?size={IMAGE_SIZE}&score_threshold={_SCORES[camera[1]][1]}"


def _state(name: str) -> dict[str, Any]:
    """Parameters of an untrained network that finds something."""
    if name in _CAMERAS:
        return _camera_state(*_CAMERAS[name][1:])
    sensor = find_model(name).sensor
    if sensor == "localizer":
        from lcf3d.localizers.pointnet2 import FrustumPointNet2
        from lcf3d.localizers.spec import LocalizerSpec

        data = "kitti" if "kitti" in name else "nuscenes"
        localizer: dict[str, Any] = FrustumPointNet2(LocalizerSpec.of("v2", data)).state_dict()
        return localizer
    if name.startswith("bevfusion"):
        from lcf3d.detectors.fusion.bevfusion import BEVFusionNetwork

        network: Any = BEVFusionNetwork(cameras="lidar" not in name)
        # its files have kernels over x, y, z
        return {
            key: value.permute(2, 1, 0, 3, 4).contiguous() if value.ndim == 5 else value
            for key, value in _lively(network).state_dict().items()
        }
    if name.startswith("mvxnet"):
        from lcf3d.detectors.fusion.mvxnet import MVXNetwork

        network = MVXNetwork()
    else:
        from lcf3d.detectors.lidar.loading import detector_class
        from lcf3d.detectors.lidar.presets import PRESETS

        network = detector_class(PRESETS[name].architecture).build(PRESETS[name])
    state: dict[str, Any] = _lively(network).state_dict()
    return state


def _camera_state(style: str, masks: bool) -> dict[str, Any]:
    from lcf3d.detectors.camera.torchvision_fasterrcnn import FasterRCNNNetwork
    from lcf3d.detectors.camera.torchvision_styles import STYLES

    state: dict[str, Any] = FasterRCNNNetwork(50, STYLES[style], masks).state_dict()
    for parameter, value in state.items():
        # residual blocks that add nothing keep activations finite
        if parameter.endswith("bn3.weight"):
            value.zero_()
        elif parameter.endswith("fc_cls.weight"):
            value.mul_(_SCORES[style][0])
    return state


def _lively(network: Any) -> Any:
    """A LiDAR network changed in place so that a few of its many anchors score."""
    for parameter, module in network.named_modules():
        if parameter.startswith("img_"):
            if parameter.endswith("bn3"):
                nn.init.zeros_(module.weight)
            continue
        # gains that keep activations from fading
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d) and module.weight is not None:
            nn.init.constant_(module.weight, 2.4)
        if parameter.endswith("conv_reg") and hasattr(module, "weight"):
            # boxes as large as their anchors
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)
        if parameter.endswith(("conv_cls", "heatmap.1")) and getattr(module, "bias", None) is not None:
            nn.init.constant_(module.bias, -2.2)
    return network


def simulated_data(kinds: set[str], folder: Path) -> dict[str, Path]:
    """Folders of simulated frames by kind of dataset; what is there is taken."""
    for kind in sorted(kinds):
        write_dataset(Recipe(*DATA[kind]), folder / kind, resume=True)
    return {kind: folder / kind for kind in sorted(kinds)}
