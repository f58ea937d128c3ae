"""What labelling tools load: COCO, FiftyOne's image detections, Label Studio's pre-annotations. Plain JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from lcf3d.structures import FloatArray, IntArray


@dataclass(frozen=True)
class ImageDetections:
    """The detections in one image.

    Attributes:
        name: of the image, unique among all: frame and camera.
        file: where the image lies; empty where there is none.
        size: width and height in pixels.
        boxes: (N, 4) ``x1, y1, x2, y2`` in pixels.
        labels: (N,) class numbers.
        scores: (N,) between 0 and 1.
        explanations: a sentence on why each is there.
    """

    name: str
    file: str
    size: tuple[int, int]
    boxes: FloatArray
    labels: IntArray
    scores: FloatArray
    explanations: Sequence[str]


def to_coco(images: Sequence[ImageDetections], class_names: Sequence[str]) -> dict[str, Any]:
    """A COCO data set, with scores and explanations beside the usual keys; numbers begin with 1."""
    annotations: list[dict[str, Any]] = []
    for number, image in enumerate(images, 1):
        for (x1, y1, x2, y2), label, score, why in _rows(image):
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": number,
                    "category_id": label + 1,
                    "bbox": [x1, y1, x2 - x1, y2 - y1],
                    "area": (x2 - x1) * (y2 - y1),
                    "iscrowd": 0,
                    "score": score,
                    "explanation": why,
                }
            )
    return {
        "images": [
            {"id": number, "file_name": image.file or image.name, "width": image.size[0], "height": image.size[1]}
            for number, image in enumerate(images, 1)
        ],
        "categories": [{"id": number, "name": name} for number, name in enumerate(class_names, 1)],
        "annotations": annotations,
    }


def to_fiftyone(images: Sequence[ImageDetections], class_names: Sequence[str]) -> dict[str, Any]:
    """The ``labels.json`` of a FiftyOneImageDetectionDataset: boxes as parts of the image's width and height."""
    labels: dict[str, Any] = {}
    for image in images:
        width, height = image.size
        labels[image.file or image.name] = [
            {
                "label": label,
                "bounding_box": [x1 / width, y1 / height, (x2 - x1) / width, (y2 - y1) / height],
                "confidence": score,
                "attributes": {"explanation": why},
            }
            for (x1, y1, x2, y2), label, score, why in _rows(image)
        ]
    return {"classes": list(class_names), "labels": labels}


def to_label_studio(images: Sequence[ImageDetections], class_names: Sequence[str], model: str) -> list[dict[str, Any]]:
    """Tasks of Label Studio with pre-annotations; its labelling setup needs ``RectangleLabels`` named ``label``.

    Args:
        images: with detections.
        class_names: that labels index.
        model: what the predictions are called.
    """
    tasks = []
    for image in images:
        width, height = image.size
        result = [
            {
                "id": str(number),
                "type": "rectanglelabels",
                "from_name": "label",
                "to_name": "image",
                "original_width": width,
                "original_height": height,
                "image_rotation": 0,
                "score": score,
                "meta": {"text": [why]},
                "value": {
                    "x": 100 * x1 / width,
                    "y": 100 * y1 / height,
                    "width": 100 * (x2 - x1) / width,
                    "height": 100 * (y2 - y1) / height,
                    "rotation": 0,
                    "rectanglelabels": [class_names[label]],
                },
            }
            for number, ((x1, y1, x2, y2), label, score, why) in enumerate(_rows(image))
        ]
        mean = float(image.scores.mean()) if len(image.scores) else 0.0
        tasks.append(
            {
                "data": {"image": image.file or image.name, "name": image.name},
                "predictions": [{"model_version": model, "score": mean, "result": result}],
            }
        )
    return tasks


def _rows(image: ImageDetections) -> list[tuple[list[float], int, float, str]]:
    boxes = [[round(value, 3) for value in box] for box in image.boxes.tolist()]
    return list(zip(boxes, image.labels.tolist(), image.scores.tolist(), image.explanations, strict=True))
