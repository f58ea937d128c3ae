"""Image files: read, measured by their headers, offered by camera name without being opened before they are used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcf3d.errors import DatasetError, FormatError


def read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB image in any format that Pillow reads.

    Raises:
        DatasetError: the file does not exist.
        FormatError: it is no image.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except FileNotFoundError:
        raise DatasetError(f"image {path} does not exist") from None
    except (UnidentifiedImageError, OSError) as error:
        raise FormatError(f"{path} cannot be read as an image ({error})") from None


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) in pixels, from the file's header alone.

    Raises:
        FormatError: it is no image.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.size
    except (UnidentifiedImageError, OSError) as error:
        raise FormatError(f"{path} cannot be read as an image ({error})") from None


class ImageFiles(Mapping[str, NDArray[np.uint8]]):
    """Images of one frame by camera name, read when asked for.

    Args:
        paths: their files by camera name.
    """

    def __init__(self, paths: Mapping[str, Path]) -> None:
        self._paths = paths

    def __getitem__(self, name: str) -> NDArray[np.uint8]:
        return read_image(self._paths[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._paths)

    def __len__(self) -> int:
        return len(self._paths)
