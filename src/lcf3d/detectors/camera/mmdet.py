"""Any detector of an installed mmdet (DDQ-DETR, DetectoRS, Mask R-CNN, ...) as a camera detector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lcf3d.detectors.base import Image
from lcf3d.detectors.classes import reported_classes, to_classes
from lcf3d.errors import ConfigError, DetectorError, Lcf3dError
from lcf3d.structures import Detections2D


class MmdetDetector:
    """A detector that mmdet 3 builds from its own configuration and checkpoint; a `CameraDetector`.

    Args:
        files: ``CONFIG,CHECKPOINT``, two paths. mmdet executes both: use files that you trust.
        class_names: classes the detections shall have, mapped by name; the model's own without it.
        score_threshold: boxes need a higher score.
        device: torch device.

    Raises:
        ConfigError: ``files`` is not two paths.
        Lcf3dError: mmdet is not installed.
        DetectorError: mmdet cannot build the model.
    """

    def __init__(
        self,
        files: str,
        class_names: Sequence[str] | None = None,
        score_threshold: float = 0.05,
        device: str = "cpu",
    ) -> None:
        config, comma, checkpoint = files.partition(",")
        if not (comma and config and checkpoint):
            raise ConfigError(f"mmdet takes CONFIG,CHECKPOINT, two paths with a comma between them, got {files!r}")
        try:
            from mmdet.apis import inference_detector, init_detector
        except ModuleNotFoundError as error:
            raise Lcf3dError(
                f"mmdet detectors need mmdet 3 and mmcv in this environment (missing: {error.name}); see mmdetection's "
                "installation page, or use yolox:nano or onnx:FILE, which need neither"
            ) from None
        try:
            self._model = init_detector(config, checkpoint, device=device)
        except Exception as error:
            # mmengine's registries raise many kinds; none is of ours
            raise DetectorError(f"mmdet cannot build {config} with {checkpoint}: {str(error)[:200]}") from error
        self._infer = inference_detector
        self._own_classes = tuple(self._model.dataset_meta["classes"])
        self.class_names = self._own_classes if class_names is None else tuple(class_names)
        self.reports = reported_classes(self._own_classes, self.class_names)
        self.score_threshold = score_threshold

    def __call__(self, images: Sequence[Image]) -> list[Detections2D]:
        """Detections in (H, W, 3) uint8 RGB images."""
        # mmdet takes images as OpenCV reads them: blue, green, red
        results = self._infer(self._model, [np.ascontiguousarray(image[..., ::-1]) for image in images])
        found = (Detections2D.from_mmdet(result, self._own_classes) for result in results)
        return [to_classes(boxes[boxes.scores > self.score_threshold], self.class_names) for boxes in found]
