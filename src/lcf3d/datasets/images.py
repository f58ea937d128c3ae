"""Image files: read, measured by their headers, offered by camera name without being opened before they are used."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import ConfigError, DatasetError, FormatError, Lcf3dError
from lcf3d.files import reading, require_file, shortened

MOST_PIXELS = 100_000_000
"""Larger images are refused by their header; the environment variable ``LCF3D_MAX_PIXELS`` sets another limit."""


def read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB image in any format that Pillow reads; grey images of 16 bits lose the lower eight.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it is no image, damaged, or too large.
    """
    with _opened(path) as image:
        if image.mode.startswith("I") or image.mode == "F":
            values = np.asarray(image)
            if image.mode == "F" or values.min() < 0 or values.max() > 65535:
                raise FormatError(f"{path} is an image of mode {image.mode}; expected 8 or 16 bits a channel")
            return np.repeat((values.astype(np.int64) // 257).astype(np.uint8)[..., None], 3, axis=2)
        return np.asarray(image.convert("RGB"))


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels, from the file's header alone.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it is no image, or too large.
    """
    with _opened(path) as image:
        size: tuple[int, int] = image.size
        return size


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An image, opened but not decoded; whatever Pillow raises until the block ends is a `FormatError`."""
    from PIL import Image

    try:
        require_file(path)
    except DatasetError:
        raise DatasetError(f"image {path} does not exist") from None
    try:
        with warnings.catch_warnings(), reading(path, "an image"):
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                if image.size[0] * image.size[1] > most_pixels():
                    raise FormatError(
                        f"{path} says it is {image.size[0]} x {image.size[1]} pixels, more than {most_pixels()}; set "
                        "LCF3D_MAX_PIXELS if it is right"
                    )
                yield image
    except Lcf3dError:
        raise
    except OSError as error:
        raise FormatError(f"{path} cannot be read as an image ({shortened(error)})") from None


def most_pixels() -> int:
    """The largest accepted number of pixels.

    Raises:
        ConfigError: ``LCF3D_MAX_PIXELS`` is no number.
    """
    text = os.environ.get("LCF3D_MAX_PIXELS", "")
    if text and not text.isdecimal():
        raise ConfigError(f"LCF3D_MAX_PIXELS must be a number of pixels, got {shortened(text)!r}")
    return int(text or MOST_PIXELS)


class ImageFiles(Mapping[str, NDArray[np.uint8]]):
    """Images of one frame by camera name, read when asked for.

    Args:
        paths: their files by camera name.
    """

    def __init__(self, paths: Mapping[str, Path]) -> None:
        self._paths = paths

    def __getitem__(self, name: str) -> NDArray[np.uint8]:
        return read_image(self._paths[name])

    def path(self, name: str) -> Path | None:
        """The file of a camera's image; None where there is none."""
        return self._paths.get(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
