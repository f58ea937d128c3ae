"""Errors that lcf3d raises on bad input: each message says what was expected, what came and what to do."""

import re

_LONG_WORD = re.compile(r"[^\s/]{200,}")
_MOST = 600


class Lcf3dError(ValueError):
    """Base of every error raised on purpose; the command line prints its message and exits with code 2.

    Messages quote input, which may be anything: they are one line without control characters, and what is long in them
    is cut.
    """

    def __init__(self, message: object = "") -> None:
        text = "".join(c if c.isprintable() else " " for c in str(message))
        # paths may be long, other words not
        text = _LONG_WORD.sub(lambda word: word[0][:60] + "..." + word[0][-20:], text)
        super().__init__(text if len(text) <= _MOST else text[: _MOST - 160] + " ... " + text[-150:])


class ShapeError(Lcf3dError):
    """An array has the wrong shape, or parallel arrays disagree in length."""


class FormatError(Lcf3dError):
    """A file cannot be read as what it should be; the message names the file and, for text, the line."""


class DatasetError(Lcf3dError):
    """A dataset misses a file or folder, or its parts disagree."""


class ConfigError(Lcf3dError):
    """A setting, a command-line value or a combination of them makes no sense."""


class DetectorError(Lcf3dError):
    """A detector, localizer or checkpoint cannot be loaded or returns something that is not detections."""


class MissingExtraError(Lcf3dError):
    """An optional dependency is not installed; the message says exactly what to install."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {package}; install it with: pip install 'lcf3d[{extra}]'")
