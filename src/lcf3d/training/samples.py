"""Training samples from the simulation: scans with the boxes all around, or images with boxes and masks.

Quicker than whole simulated data sets, because a network needs one sensor only; and richer, because KITTI's labels
end at the image's border, while these go all around the car. Equal recipes give equal bytes.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures import as_completed as as_they_end
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError, FormatError, MissingExtraError
from lcf3d.files import atomic_path, read_json, reading, write_json
from lcf3d.processes import end_with_parent, workers
from lcf3d.structures import FloatArray, IntArray

if TYPE_CHECKING:
    from lcf3d.simulation.presets import Preset
    from lcf3d.simulation.scene import Scene

RECIPE_FILE = "samples.json"
FARTHEST_M = 90.0
# largest number of instances in a mask image of one byte a pixel
MOST_INSTANCES = 255


@dataclass(frozen=True)
class SampleRecipe:
    """Everything that a set of samples depends on.

    Attributes:
        sensor: ``lidar`` for scans, ``camera`` for images of the preset's first camera.
        preset: a preset of the simulation.
        frames: number of samples, each of a scene of its own.
        seed: of all random numbers.
        scale: size of the images as a share of the camera's.
        density: factor on the number of road users.
    """

    sensor: Literal["lidar", "camera"]
    preset: str
    frames: int
    seed: int
    scale: float = 1.0
    density: float = 1.0

    def __post_init__(self) -> None:
        if self.frames < 1 or self.seed < 0:
            raise ConfigError(f"frames must be 1 or more and seed 0 or more, got {self.frames} and {self.seed}")

    @property
    def folder(self) -> str:
        """A folder name that tells such sets apart; a longer set begins with the shorter one."""
        density = "" if self.density == 1 else f"-density{self.density:g}"
        return f"{self.preset}-{self.sensor}-seed{self.seed}{density}"

    def made_by(self) -> dict[str, Any]:
        """What every single sample depends on."""
        return {name: value for name, value in asdict(self).items() if name != "frames"}


@dataclass(frozen=True, eq=False)
class ScanSample:
    """A scan with the boxes of everything all around.

    Attributes:
        points: (N, 4) float32 x, y, z, intensity in the LiDAR frame.
        boxes: (A, 7) x y z length width height yaw, LiDAR frame.
        names: (A,) class names of the preset's dataset, ``Van`` and the like included.
        points_on: (A,) returns inside each box.
    """

    points: NDArray[np.float32]
    boxes: FloatArray
    names: NDArray[np.str_]
    points_on: IntArray


@dataclass(frozen=True, eq=False)
class ImageSample:
    """An image with everything in view.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        boxes: (A, 4) pixel bounds of the projected 3D boxes clipped to the image: whole objects, whatever hides them.
        visible: (A, 4) pixel bounds of what can be seen of them.
        names: (A,) class names.
        hidden: (A,) share that something else covers.
        truncated: (A,) share outside the image.
        owner: (H, W) uint8, 1 + row of the object in each pixel, 0 for scenery.
    """

    image: NDArray[np.uint8]
    boxes: FloatArray
    visible: FloatArray
    names: NDArray[np.str_]
    hidden: FloatArray
    truncated: FloatArray
    owner: NDArray[np.uint8]


def write_samples(
    recipe: SampleRecipe, root: Path, jobs: int = 1, progress: Callable[[int], None] = lambda _: None
) -> list[Path]:
    """Simulate what is missing of a set of samples; gives the paths of all, in order.

    Args:
        recipe: what to simulate.
        root: the set's folder; a set begun there with the same recipe is completed.
        jobs: processes.
        progress: called with the number of samples just finished.

    Raises:
        ConfigError: the folder holds another set.
        MissingExtraError: embreex is not installed and something is missing.
    """
    settings = root / RECIPE_FILE
    if settings.is_file() and read_json(settings) != recipe.made_by():
        raise ConfigError(f"{root} holds samples of another recipe; name another folder, or remove it")
    paths = [root / f"{index:06d}.npz" for index in range(recipe.frames)]
    missing = [index for index, path in enumerate(paths) if not path.is_file()]
    progress(len(paths) - len(missing))
    if not missing:
        return paths
    if find_spec("embreex") is None:
        raise MissingExtraError("embreex", "simulate", "simulating training samples")
    write_json(settings, recipe.made_by())
    work = partial(_write_one, recipe, root)
    if jobs == 1:
        _count(map(work, missing), progress)
        return paths
    with (
        workers("making samples: those that are done are kept, go on with --resume and fewer --jobs"),
        ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool,
    ):
        futures = [pool.submit(work, index) for index in missing]
        try:
            _count((future.result() for future in as_they_end(futures)), progress)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return paths


def _count(done: Iterable[int], progress: Callable[[int], None]) -> None:
    for _ in done:
        progress(1)


def _write_one(recipe: SampleRecipe, root: Path, index: int) -> int:
    """Simulate and write one sample."""
    write_scene_samples({root: recipe}, index)
    return index


def write_scene_samples(recipes: Mapping[Path, SampleRecipe], index: int) -> None:
    """Simulate one scene and write a sample of each recipe from it, what is there already left alone.

    Args:
        recipes: by folder; they differ in sensor and image scale only.
        index: number of the scene and its samples.

    Raises:
        MissingExtraError: embreex is not installed.
    """
    from lcf3d.simulation.presets import get_preset
    from lcf3d.simulation.scene import build_scene

    first = next(iter(recipes.values()))
    preset = get_preset(first.preset)
    rng = np.random.default_rng([first.seed, index])
    scene = build_scene(rng, preset.layout, 0.0, None, first.density, preset.world)
    for root, recipe in recipes.items():
        path = root / f"{index:06d}.npz"
        if path.is_file():
            continue
        sensors = preset if recipe.scale == 1 else preset.resized(recipe.scale)
        make = _scan_arrays if recipe.sensor == "lidar" else _image_arrays
        arrays = make(scene, sensors, (recipe.seed, index, 0))
        with atomic_path(path) as temporary:
            np.savez(temporary, allow_pickle=False, **arrays)


def _scan_arrays(scene: Scene, preset: Preset, seed: tuple[int, ...]) -> dict[str, NDArray[np.generic]]:
    from lcf3d.simulation.frames import capture

    frame = capture(scene, preset, 0.0, seed, "", images=False, threads=1)
    names = _names(scene, preset)
    kept = (names != "") & (np.hypot(frame.boxes[:, 0], frame.boxes[:, 1]) < FARTHEST_M)
    return {
        "points": frame.frame.points if frame.frame.points is not None else frame.scan.points,
        "boxes": frame.boxes[kept],
        "names": names[kept],
        "points_on": frame.points_on[kept],
    }


def _image_arrays(scene: Scene, preset: Preset, seed: tuple[int, ...]) -> dict[str, NDArray[np.generic]]:
    from lcf3d.simulation.frames import look

    camera = preset.cameras[0]
    picture, seen = look(scene, preset, (camera,), 0.0, seed)[camera.name]
    names = _names(scene, preset)
    kept = np.flatnonzero((names != "") & (seen.pixels > 0))[:MOST_INSTANCES]
    row_of = np.zeros(1 + max([0, *(actor.id for actor in scene.actors), int(picture.owner.max())]), dtype=np.uint8)
    row_of[[scene.actors[k].id for k in kept]] = np.arange(1, len(kept) + 1)
    return {
        "image": picture.image,
        "boxes": seen.amodal[kept],
        "visible": seen.boxes2d[kept],
        "names": names[kept],
        "hidden": seen.hidden[kept],
        "truncated": seen.truncated[kept],
        "owner": row_of[picture.owner],
    }


def _names(scene: Scene, preset: Preset) -> NDArray[np.str_]:
    """(A,) class names in the preset's dataset, empty for what it does not label."""
    from lcf3d.simulation.actors import KITTI_CLASS, NUSCENES_CLASS

    table = KITTI_CLASS if preset.layout == "kitti" else NUSCENES_CLASS
    return np.array([table[actor.kind] or "" for actor in scene.actors], dtype=np.str_)


def read_scan(path: Path) -> ScanSample:
    """A sample of the sensor ``lidar``.

    Raises:
        FormatError: the file is not one.
    """
    return ScanSample(*_read(path, ("points", "boxes", "names", "points_on")))


def read_image(path: Path) -> ImageSample:
    """A sample of the sensor ``camera``.

    Raises:
        FormatError: the file is not one.
    """
    return ImageSample(*_read(path, ("image", "boxes", "visible", "names", "hidden", "truncated", "owner")))


def _read(path: Path, names: tuple[str, ...]) -> list[NDArray[Any]]:
    try:
        with reading(path, "a training sample"), np.load(path, allow_pickle=False) as arrays:
            return [arrays[name] for name in names]
    except (OSError, FormatError) as error:
        raise FormatError(f"{path} is no training sample ({error}); remove it to have it simulated again") from error
