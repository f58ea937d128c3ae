"""How the shipped localizers are trained: everything that their weights depend on, by dataset."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lcf3d.errors import ConfigError
from lcf3d.structures import Camera
from lcf3d.training.frustum_batch import Augmentation
from lcf3d.training.loop import TrainingSettings
from lcf3d.training.samples import SampleRecipe

VARIANTS: Mapping[str, Augmentation] = {
    "all": Augmentation(),
    "box": Augmentation(stereo=0.0, mask=0.0, on_mask=0.0),
    "stereo": Augmentation(stereo=1.0, mask=0.0, on_mask=0.0),
    "mask": Augmentation(stereo=0.0, mask=0.0, on_mask=1.0),
    "box+mask": Augmentation(stereo=0.0, mask=1.0, on_mask=0.0),
}
"""Proposals that a network is trained on; ``all`` mixes them, so that one network serves every mask mode and pairs."""


@dataclass(frozen=True)
class LocalizerRecipe:
    """A localizer's training.

    Attributes:
        samples: simulated scans.
        held_out: how many of them, the last ones, are kept for validation.
        views: headings from which each scan is looked at.
        settings: of the training loop.
        batch_size: frustums a step.
        shares: share of each class in the batches.
        synonyms: class names that are trained as another class.
    """

    samples: SampleRecipe
    held_out: int
    views: int
    settings: TrainingSettings
    batch_size: int
    shares: Mapping[str, float]
    synonyms: Mapping[str, str] = field(default_factory=dict)


RECIPES: Mapping[str, LocalizerRecipe] = {
    "kitti": LocalizerRecipe(
        SampleRecipe("lidar", "kitti64", 900, 1001),
        held_out=100,
        views=5,
        settings=TrainingSettings(2500, 3e-3, seed=1, checkpoint_every=500),
        batch_size=64,
        shares={"Car": 0.4, "Pedestrian": 0.35, "Cyclist": 0.25},
        synonyms={"Van": "Car"},
    ),
    "nuscenes": LocalizerRecipe(
        SampleRecipe("lidar", "nuscenes32", 260, 1003),
        held_out=40,
        views=8,
        settings=TrainingSettings(1200, 3e-3, seed=1, checkpoint_every=400),
        batch_size=64,
        shares={"car": 0.25, "pedestrian": 0.2},
    ),
}


def recipe_of(dataset: str) -> LocalizerRecipe:
    """The recipe of ``kitti`` or ``nuscenes``.

    Raises:
        ConfigError: there is none.
    """
    if dataset not in RECIPES:
        raise ConfigError(f"there is no localizer recipe {dataset!r}; choose {' or '.join(RECIPES)}")
    return RECIPES[dataset]


def training_cameras(recipe: LocalizerRecipe) -> list[tuple[Camera, Camera | None]]:
    """Cameras that look at the samples of a recipe, KITTI's as a stereo pair."""
    from lcf3d.simulation.presets import get_preset

    preset = get_preset(recipe.samples.preset)
    if preset.layout == "kitti":
        return [(preset.cameras[0], preset.cameras[1])]
    return [(camera, None) for camera in preset.cameras]


def default_samples_root() -> Path:
    """Where simulated samples are kept between trainings: ``lcf3d/samples`` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "lcf3d" / "samples"
