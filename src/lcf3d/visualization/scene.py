"""What a picture shows: boxes with their outcome in the fusion and a text, apart from where they came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lcf3d.provenance import FusedDetections
from lcf3d.reasons import Outcome, Reason
from lcf3d.structures import BoolArray, Detections2D, Detections3D, FloatArray, IntArray
from lcf3d.visualization.canvas import Colour

# Okabe and Ito's colours, told apart with any colour vision; order of the legend and, backwards, of drawing
COLOURS: Mapping[str, Colour] = {
    "matched": (0, 190, 135),
    "recovered": (240, 160, 0),
    "kept": (86, 180, 233),
    "downweighted": (214, 130, 178),
    "predicted": (213, 94, 0),
    "detection": (86, 180, 233),
    "dropped": (190, 190, 190),
}
CAMERA_COLOUR: Colour = (240, 228, 66)
TRUTH_COLOUR: Colour = (255, 255, 255)
# inputs that were never candidates would only clutter the picture
_NOT_DRAWN = (Reason.LOW_SCORE, Reason.OTHER_CLASS, Reason.TOO_MANY, Reason.INVALID)


@dataclass(frozen=True, eq=False)
class ImageBoxes:
    """2D detections of one camera.

    Attributes:
        boxes: (M, 4) pixels.
        used: (M,) whether each led to a fused detection; the others are dashed.
        texts: (M,) labels, empty for none.
    """

    boxes: FloatArray
    used: BoolArray
    texts: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is drawn over the sensors' data of one frame.

    Attributes:
        boxes: (N, 7) canonical boxes.
        outcomes: (N,) keys of `COLOURS`.
        texts: (N,) labels, empty for none; earlier boxes get their labels first.
        image_boxes: 2D detections by camera name.
        truth: (K, 7) ground truth, or None.
        trails: where each of the first boxes has been, (K, 3) places in the LiDAR frame, see `trails`; empty for none.
    """

    boxes: FloatArray
    outcomes: tuple[str, ...]
    texts: tuple[str, ...]
    image_boxes: Mapping[str, ImageBoxes] = field(default_factory=dict)
    truth: FloatArray | None = None
    trails: Sequence[FloatArray] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Number of boxes of each outcome that occurs, in the order of `COLOURS`."""
        return {outcome: self.outcomes.count(outcome) for outcome in COLOURS if outcome in self.outcomes}

    @property
    def drawing_order(self) -> list[int]:
        """Indices of the boxes, the important ones last, so that they lie on top."""
        rank = list(COLOURS)
        return sorted(range(len(self.outcomes)), key=lambda i: (-rank.index(self.outcomes[i]), -i))

    @classmethod
    def from_detections(
        cls,
        detections: Detections3D,
        camera: Mapping[str, Detections2D] | None = None,
        truth: Detections3D | None = None,
        least_score: float = -np.inf,
    ) -> Scene:
        """Detections that went through no fusion; those of a lower score than ``least_score`` are left out."""
        detections = detections[detections.scores >= least_score]
        camera = {name: found[found.scores >= least_score] for name, found in (camera or {}).items()}
        return cls(
            detections.boxes,
            ("detection",) * len(detections),
            _texts(detections),
            {
                name: ImageBoxes(found.boxes, np.ones(len(found), dtype=bool), _texts(found))
                for name, found in camera.items()
            },
            None if truth is None else truth.boxes,
        )

    @classmethod
    def from_fused(
        cls,
        fused: FusedDetections,
        truth: Detections3D | None = None,
        least_score: float = -np.inf,
        trails: Sequence[FloatArray] = (),
    ) -> Scene:
        """Outputs of a fusion in the colour of their outcome, and the inputs that were dropped on the way.

        Outputs and inputs of a lower score than ``least_score`` are left out. Tracked boxes have their track's number
        in their text.

        Args:
            fused: the result of a frame.
            truth: ground truth to draw, if any.
            least_score: see above.
            trails: where each output has been, see `lcf3d.visualization.trails`.
        """
        outcomes = fused.origins
        dropped = drawn_dropped(fused)
        dropped = dropped[fused.lidar_inputs.scores[dropped] >= least_score]
        shown = np.flatnonzero(fused.detections.scores >= least_score)
        numbers = None if fused.tracks is None else fused.tracks.ids[shown]
        return cls(
            np.concatenate([fused.detections.boxes[shown], fused.lidar_inputs.boxes[dropped]]),
            (*(outcomes[i] for i in shown), *("dropped",) * len(dropped)),
            (*_texts(fused.detections[shown], numbers), *("",) * len(dropped)),
            _image_boxes(fused, least_score),
            None if truth is None else truth.boxes,
            [trails[int(i)] for i in shown] if trails else (),
        )


def drawn_dropped(fused: FusedDetections) -> IntArray:
    """Indices of the LiDAR detections that were candidates and were dropped; they are drawn after the outputs."""
    dropped = fused.dropped_lidar
    return dropped[~np.isin(fused.lidar.reason[dropped], _NOT_DRAWN)]


def _image_boxes(fused: FusedDetections, least_score: float) -> dict[str, ImageBoxes]:
    """The 2D detections that took part, with the reason where they led to nothing."""
    result = {}
    for c, (name, found) in enumerate(zip(fused.camera_names, fused.camera_inputs, strict=True)):
        rows = np.flatnonzero((fused.camera.camera == c) & ~np.isin(fused.camera.reason, _NOT_DRAWN))
        rows = rows[found.scores[fused.camera.detection[rows]] >= least_score]
        chosen = found[fused.camera.detection[rows]]
        used = fused.camera.outcome[rows] != Outcome.DROPPED
        texts = [
            "" if ok else f"{text} {Reason(reason).name.lower().replace('_', ' ')}"
            for text, ok, reason in zip(_texts(chosen), used, fused.camera.reason[rows], strict=True)
        ]
        result[name] = ImageBoxes(chosen.boxes, used, tuple(texts))
    return result


def _texts(detections: Detections2D | Detections3D, numbers: IntArray | None = None) -> tuple[str, ...]:
    texts = tuple(
        f"{detections.class_names[label]} {score:.2f}"
        for label, score in zip(detections.labels, detections.scores, strict=True)
    )
    return texts if numbers is None else tuple(f"{text} #{own}" for text, own in zip(texts, numbers, strict=True))
