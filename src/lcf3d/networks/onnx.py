"""The one place where networks are opened with onnxruntime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lcf3d.errors import DetectorError
from lcf3d.remote.places import fetched


def open_session(path: Path, threads: int, what: str) -> Any:
    """An onnxruntime session on the CPU.

    Args:
        path: the ONNX file.
        threads: that an operator uses; 0 for one a core.
        what: the file should hold, in words, for the message.

    Raises:
        DetectorError: there is no such file, or onnxruntime cannot run it (damaged, of an unknown opset, ...).
    """
    import onnxruntime

    if not path.is_file():
        raise DetectorError(f"{path} does not exist; expected the ONNX file of {what}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    # waiting threads that spin doubled the time where other processes compute too
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(str(fetched(path)), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base class
        raise DetectorError(f"{path} cannot be read as an ONNX file: {first_line(error)}") from error
    return Session(session, path, threads, what)


class Session:
    """An onnxruntime session that can be sent to another process, where it is opened anew."""

    def __init__(self, session: Any, path: Path, threads: int, what: str) -> None:
        self._session, self._opened_with = session, (path, threads, what)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._session, name)

    def __reduce__(self) -> tuple[Any, ...]:
        return open_session, self._opened_with


def read_metadata(session: Any, path: Path | str) -> dict[str, str]:
    """The texts that a network carries by their names.

    Raises:
        DetectorError: they are no texts: the file is damaged.
    """
    try:
        return dict(session.get_modelmeta().custom_metadata_map)
    except UnicodeDecodeError as error:
        raise DetectorError(f"{path}: its metadata is damaged ({error.reason}); export it again") from None


def first_line(error: Exception) -> str:
    """The first line of an error's message, or its kind where it has none."""
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
