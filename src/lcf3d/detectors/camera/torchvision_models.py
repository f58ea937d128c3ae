"""torchvision's own two-stage detectors by name, with their COCO weights or a checkpoint trained with torchvision."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.detectors.base import Image
from lcf3d.detectors.classes import COCO_CLASSES, read_class_names, reported_classes, to_classes
from lcf3d.errors import ConfigError, DetectorError, ShapeError
from lcf3d.networks.checkpoints import load_parameters, read_state_dict
from lcf3d.networks.torch import nn, torch, torch_device, torchvision
from lcf3d.structures import Detections2D, InstanceMask

MODELS = (
    "fasterrcnn_resnet50_fpn",
    "fasterrcnn_resnet50_fpn_v2",
    "fasterrcnn_resnet101_fpn",
    "maskrcnn_resnet50_fpn",
    "maskrcnn_resnet50_fpn_v2",
)
"""Names of the detectors; the ResNet-101 of the paper is the one without COCO weights."""

WITHOUT_WEIGHTS = "fasterrcnn_resnet101_fpn"
MASK_THRESHOLD = 0.5

_CLASS_LAYER = "roi_heads.box_predictor.cls_score.weight"
# outputs of a detector of COCO's 91 categories, background at 0 included
_COCO_OUTPUTS = 91
# only normalization that was trained counts its batches
_BATCH_COUNTER = "backbone.body.bn1.num_batches_tracked"
# names that torchvision gave layers up to 0.13, which its COCO files of the first networks still have
_OLD_NAMES: tuple[tuple[str, str], ...] = (
    (r"^(rpn\.head\.conv)\.(weight|bias)$", r"\1.0.0.\2"),
    (r"^(backbone\.fpn\.(?:inner|layer)_blocks\.\d+)\.(weight|bias)$", r"\1.0.\2"),
)
_OLD_MASK_LAYER = re.compile(r"^roi_heads\.mask_head\.mask_fcn(\d+)\.(weight|bias)$")


class TorchvisionDetector:
    """A Faster or Mask R-CNN of torchvision; a `CameraDetector`.

    Args:
        name: one of `MODELS`.
        class_names: classes the detections shall have, mapped by name, persons on bicycles become cyclists
            (`lcf3d.detectors.classes`); the network's own without it.
        checkpoint: file of parameters as ``torch.save(model.state_dict(), FILE)`` or torchvision's training script
            write it; no code in it is executed. Without it, torchvision's COCO weights, downloaded at first use.
        names: the checkpoint's own classes in their order, without the background that torchvision puts first: a
            sequence, a comma-separated string or a text file with one name a line. Not needed for COCO's 91 categories.
        score_threshold: boxes need a higher score.
        device: torch device.

    Raises:
        ConfigError: an unknown name or device, a threshold out of [0, 1], or ``names`` without a checkpoint.
        DetectorError: there are no weights and no checkpoint, the download failed, or the checkpoint does not fit.
        MissingExtraError: torch or torchvision is not installed.
    """

    def __init__(
        self,
        name: str,
        class_names: Sequence[str] | None = None,
        checkpoint: str | Path | None = None,
        names: str | Sequence[str] | None = None,
        score_threshold: float = 0.05,
        device: str = "cpu",
    ) -> None:
        if name not in MODELS:
            raise ConfigError(f"unknown torchvision detector {name!r}; expected one of: {', '.join(MODELS)}")
        if not 0 <= score_threshold <= 1:
            raise ConfigError(f"score_threshold must be in [0, 1], got {score_threshold}")
        if names is not None and checkpoint is None:
            raise ConfigError("names=... are the classes of a checkpoint=FILE; leave them out for the COCO weights")
        self.name = name
        state = coco_parameters(name) if checkpoint is None else _read_checkpoint(Path(checkpoint))
        outputs = _outputs(state, name)
        self.own_class_names, self._own_labels = _own_classes(names, outputs, checkpoint)
        self.class_names = self.own_class_names if class_names is None else tuple(class_names)
        self.reports = reported_classes(self.own_class_names, self.class_names)
        self.device = torch_device(device)
        self.network = build_network(name, state, outputs, score_threshold).to(self.device)

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections in (H, W, 3) uint8 RGB images, by descending score.

        Raises:
            ShapeError: not such an image.
        """
        return [self._detect(np.asarray(image)) for image in images]

    def _detect(self, image: Image) -> Detections2D:
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise ShapeError(f"an image must be (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}")
        tensor = torch.from_numpy(np.array(image, order="C")).to(self.device).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            output = {key: value.cpu().numpy() for key, value in self.network([tensor])[0].items()}
        mapped = to_classes(self._convert(output), self.class_names)
        return mapped[np.argsort(-mapped.scores, kind="stable")]

    def _convert(self, output: Mapping[str, NDArray[Any]]) -> Detections2D:
        """torchvision's boxes, labels, scores and mask probabilities (N, 1, H, W), in the network's own classes."""
        labels = self._own_labels[output["labels"]]
        kept = (labels >= 0) & np.isfinite(output["boxes"]).all(axis=1)
        masks = None
        if "masks" in output:
            masks = tuple(InstanceMask.from_image(mask[0] > MASK_THRESHOLD) for mask in output["masks"][kept])
        return Detections2D(output["boxes"][kept], output["scores"][kept], labels[kept], self.own_class_names, masks)


def coco_parameters(name: str) -> dict[str, Any]:
    """torchvision's COCO weights of a detector, from torch's cache or downloaded into it and verified.

    Raises:
        DetectorError: there are none, or the download failed; the message says what to put where.
    """
    if name == WITHOUT_WEIGHTS:
        raise DetectorError(
            f"torchvision has no COCO weights for {name}; give a file of your own: torchvision:{name}?checkpoint=FILE"
        )
    weights = torchvision().models.get_model_weights(name).DEFAULT
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(weights.url).name
    if path.is_file():
        return read_state_dict(path)
    try:
        # torch announces the download on the standard output, where a script may expect results
        with redirect_stdout(sys.stderr):
            state: dict[str, Any] = weights.get_state_dict(progress=True, check_hash=True, weights_only=True)
    except (OSError, RuntimeError, EOFError) as error:
        # urllib's errors are OSErrors; torch reports a wrong hash as RuntimeError
        raise DetectorError(
            f"{weights.url} cannot be downloaded ({str(error) or type(error).__name__}); download it elsewhere and "
            f"put it at {path}, or name a file: torchvision:{name}?checkpoint=FILE"
        ) from None
    return state


def build_network(name: str, state: Mapping[str, Any], outputs: int, score_threshold: float) -> Any:
    """The network of that name with given parameters, ready to detect.

    Args:
        name: one of `MODELS`.
        state: parameter name -> tensor.
        outputs: classes, background included.
        score_threshold: boxes need a higher score.

    Raises:
        DetectorError: the parameters are of another network; the message names the first that differ.
    """
    detection = torchvision().models.detection
    options = {"num_classes": outputs, "box_score_thresh": score_threshold}
    with torch.device("meta"):
        if name == WITHOUT_WEIGHTS:
            backbone = detection.backbone_utils.resnet_fpn_backbone(
                backbone_name="resnet101", weights=None, norm_layer=nn.BatchNorm2d
            )
            network = detection.FasterRCNN(backbone, **options)
        else:
            network = getattr(detection, name)(weights=None, weights_backbone=None, **options)
        if _BATCH_COUNTER not in state:
            # torchvision's own COCO files of the first networks were trained with nothing added to the variance
            exact = outputs == _COCO_OUTPUTS and name != WITHOUT_WEIGHTS
            _freeze_normalization(network.backbone.body, 0.0 if exact else 1e-5)
    source = f"the checkpoint for torchvision's {name} with {outputs - 1} classes"
    load_parameters(network, current_names(state), source)
    # the only tensors that are no parameters: with the rest, they were not given values
    network.rpn.anchor_generator = detection.anchor_utils.AnchorGenerator(
        network.rpn.anchor_generator.sizes, network.rpn.anchor_generator.aspect_ratios
    )
    return network.eval().requires_grad_(False)


def current_names(state: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters by the names of today's torchvision; those of before 0.14 are translated."""
    return {_current_name(name): value for name, value in state.items()}


def _current_name(name: str) -> str:
    for pattern, replacement in _OLD_NAMES:
        name = re.sub(pattern, replacement, name)
    old = _OLD_MASK_LAYER.match(name)
    return f"roi_heads.mask_head.{int(old[1]) - 1}.0.{old[2]}" if old else name


def _freeze_normalization(body: nn.Module, eps: float) -> None:
    """Frozen batch normalization, as torchvision trains with pretrained backbones, in place of the one that learns."""
    frozen = torchvision().ops.misc.FrozenBatchNorm2d
    for parent in list(body.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.BatchNorm2d):
                setattr(parent, name, frozen(child.num_features, eps=eps))


def _read_checkpoint(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise DetectorError(
            f"checkpoint {path} does not exist; without checkpoint=... torchvision's COCO weights are used"
        )
    return read_state_dict(path)


def _outputs(state: Mapping[str, Any], name: str) -> int:
    """Classes of the parameters, background included."""
    if _CLASS_LAYER not in state:
        raise DetectorError(f"the checkpoint is no {name} of torchvision: it lacks {_CLASS_LAYER}")
    return len(state[_CLASS_LAYER])


def _own_classes(
    names: str | Sequence[str] | None, outputs: int, checkpoint: str | Path | None
) -> tuple[tuple[str, ...], NDArray[np.int64]]:
    """The network's class names, and the index into them of each output, -1 for background and unused ones."""
    labels = np.arange(outputs) - 1
    if names is not None:
        own = read_class_names(names)
        if len(own) != outputs - 1:
            raise DetectorError(
                f"{checkpoint} has {outputs - 1} classes (without background) but names=... gives {len(own)}"
            )
        return own, labels
    if outputs != _COCO_OUTPUTS:
        raise DetectorError(
            f"{checkpoint} has {outputs - 1} classes (without background) and does not name them; name them with "
            "names=first,second,..."
        )
    weights = torchvision().models.get_model_weights("fasterrcnn_resnet50_fpn").DEFAULT
    index = {name: i for i, name in enumerate(COCO_CLASSES)}
    return COCO_CLASSES, np.array([index.get(category, -1) for category in weights.meta["categories"]])
