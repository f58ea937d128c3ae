"""Bags without ROS: ROS 1 ``.bag``, rosbag2 folders (sqlite3 or MCAP), ``.db3`` and ``.mcap`` files (extra ``bag``).

A bag is indexed once, by the stamps in its message headers; messages are then read one at a time from where they lie,
so that memory does not grow with the bag.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from lcf3d.errors import ConfigError, DatasetError, FormatError, Lcf3dError, MissingExtraError
from lcf3d.formats.ros_types import store
from lcf3d.structures import IntArray

BagForm = Literal["mcap", "rosbag2", "rosbag1"]

JUMP_S = 1.0
"""Clocks that run back by more than this have jumped."""


class Topic(NamedTuple):
    """A topic of a bag: its message type and how many messages it has."""

    kind: str
    messages: int


class TopicIndex(NamedTuple):
    """Where the messages of a topic lie, in order of their stamps.

    Attributes:
        stamps_ns: (N,) of the headers; the time of recording where a header has none.
        log_ns: (N,) time of recording.
        places: (N,) number of the message among those recorded at the same time.
    """

    stamps_ns: IntArray
    log_ns: IntArray
    places: IntArray


class BagReader:
    """Reads one bag.

    Args:
        path: a file or a rosbag2 folder.

    Raises:
        DatasetError: it does not exist.
        FormatError: it is no bag, or cut off.
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            raise DatasetError(f"bag {path} does not exist")
        self.path = path
        self._types = store(path.suffix == ".bag")
        self._reader: Any = None
        with _reading(path):
            self._connections = {c.id: c for c in self._open().connections}
        self.topics = {
            name: Topic(info.msgtype or "", int(info.msgcount)) for name, info in self._open().topics.items()
        }

    def __getstate__(self) -> dict[str, Any]:
        """Without what is open: another process opens it anew."""
        return {**self.__dict__, "_reader": None, "_connections": {}, "_types": None}

    def _open(self) -> Any:
        if self._reader is None:
            from rosbags.highlevel import AnyReader

            logging.getLogger("rosbags").setLevel(logging.ERROR)
            if self._types is None:
                self._types = store(self.path.suffix == ".bag")
            with _reading(self.path):
                self._reader = AnyReader([self.path], default_typestore=self._types)
                self._reader.open()
        return self._reader

    def require(self, topic: str, kinds: Sequence[str]) -> str:
        """The message type of a topic, if it is one of ``kinds``.

        Raises:
            ConfigError: no such topic, or of another type; lists those that would do.
        """
        fitting = [name for name, found in self.topics.items() if found.kind in kinds]
        if topic not in self.topics:
            raise ConfigError(f"{self.path} has no topic {topic!r}; of that kind it has {', '.join(fitting) or 'none'}")
        if self.topics[topic].kind not in kinds:
            raise ConfigError(
                f"topic {topic} of {self.path} holds {self.topics[topic].kind}, which is none of {', '.join(kinds)}; "
                f"topics that do: {', '.join(fitting) or 'none'}"
            )
        return self.topics[topic].kind

    def index(self, topics: Sequence[str]) -> dict[str, TopicIndex]:
        """Index of topics whose messages begin with a header.

        Raises:
            DatasetError: the clock of one jumps back.
            FormatError: the bag is cut off.
        """
        stamps: dict[str, list[int]] = {topic: [] for topic in topics}
        logs: dict[str, list[int]] = {topic: [] for topic in topics}
        places: dict[str, list[int]] = {topic: [] for topic in topics}
        for topic, log, raw in self._raw(topics):
            little = self.path.suffix == ".bag" or bytes(raw[1:2]) != b"\0"
            seconds, nanoseconds = np.frombuffer(bytes(raw[4:12]), "<u4" if little else ">u4").tolist()
            stamp = seconds * 10**9 + nanoseconds or log
            found = stamps[topic]
            if found and stamp < found[-1] - JUMP_S * 1e9:
                raise DatasetError(
                    f"the stamps of {topic} jump back by {(found[-1] - stamp) / 1e9:.1f} s at message {len(found)}; "
                    f"cut {self.path.name} there"
                )
            same = bool(logs[topic]) and logs[topic][-1] == log
            places[topic].append(places[topic][-1] + 1 if same else 0)
            found.append(stamp)
            logs[topic].append(log)
        indices = {}
        for topic in topics:
            order = np.argsort(np.array(stamps[topic], dtype=np.int64), kind="stable")
            columns = (np.array(part[topic], dtype=np.int64)[order] for part in (stamps, logs, places))
            indices[topic] = TopicIndex(*columns)
        return indices

    def message(self, topic: str, index: TopicIndex, number: int) -> Any:
        """One message of an index.

        Raises:
            FormatError: it cannot be read.
        """
        log, place = int(index.log_ns[number]), int(index.places[number])
        for i, (_, _, raw) in enumerate(self._raw([topic], log, log + 1)):
            if i == place:
                return self._message(topic, raw)
        raise FormatError(f"{self.path} no longer holds message {number} of {topic}")

    def messages(self, topics: Sequence[str], most: int | None = None) -> Iterator[tuple[str, float, Any]]:
        """Topic, time of recording in seconds and message, one after the other; at most so many."""
        for number, (topic, log, raw) in enumerate(self._raw(topics)):
            if number == most:
                return
            yield topic, log * 1e-9, self._message(topic, raw)

    def _raw(self, topics: Sequence[str], start: int | None = None, stop: int | None = None) -> Iterator[Any]:
        reader = self._open()
        chosen = [c for c in reader.connections if c.topic in topics]
        if not chosen:
            return
        with _reading(self.path):
            for connection, log, raw in reader.messages(chosen, start=start, stop=stop):
                yield connection.topic, log, raw

    def _message(self, topic: str, raw: bytes) -> Any:
        kind = self.topics[topic].kind
        with _reading(self.path, f"message of {topic} ({kind})"):
            return self._open().deserialize(raw, kind)


@contextmanager
def _reading(path: Path, what: str = "bag") -> Iterator[None]:
    """Errors of the libraries as one sentence."""
    try:
        yield
    except Lcf3dError:
        raise
    except ImportError as error:
        raise MissingExtraError(error.name or "rosbags", "bag", f"reading {path}") from None
    except Exception as error:
        # the library raises whatever its parsing ran into
        reason = (str(error).splitlines() or [type(error).__name__])[0][:160]
        raise FormatError(f"{path}: a {what} cannot be read, it is cut off or no bag ({reason})") from None


def require_writer(name: str) -> None:
    """See that a bag of that name can be written, before there is anything to write.

    Raises:
        MissingExtraError: rosbags or mcap is not installed.
    """
    for package in ("rosbags", *(("mcap",) if name.endswith(".mcap") else ())):
        if find_spec(package) is None:
            raise MissingExtraError(package, "bag", f"writing {name}")


class BagWriter:
    """Writes a bag: a single ``.mcap`` file, a ROS 1 ``.bag``, or a rosbag2 folder (sqlite3).

    Args:
        path: its suffix tells the form; without one it is a rosbag2 folder. Must not exist.

    Raises:
        ConfigError: it exists.
        MissingExtraError: rosbags or mcap is not installed.
    """

    def __init__(self, path: Path) -> None:
        require_writer(path.name)
        if path.exists():
            raise ConfigError(f"{path} exists; choose another place for the bag")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.form: BagForm = {".mcap": "mcap", ".bag": "rosbag1"}.get(path.suffix, "rosbag2")  # type: ignore[assignment]
        self._types = store(self.form == "rosbag1")
        self._channels: dict[str, Any] = {}
        self._file: Any = None
        if self.form == "mcap":
            from mcap.writer import Writer

            self._file = path.open("wb")
            self._writer: Any = Writer(self._file)
            self._writer.start(profile="ros2", library="lcf3d")
        elif self.form == "rosbag1":
            from rosbags.rosbag1 import Writer as Writer1

            self._writer = Writer1(path)
            self._writer.open()
        else:
            from rosbags.rosbag2 import Writer as Writer2

            self._writer = Writer2(path, version=8)
            self._writer.open()

    def make(self, kind: str, /, **fields: Any) -> Any:
        """A message; fields of ROS 2's names, those of ROS 1 are translated."""
        if self.form == "rosbag1":
            if kind == "std_msgs/msg/Header":
                fields = {"seq": 0, **fields}
            elif kind == "sensor_msgs/msg/CameraInfo":
                fields = {name.upper() if name in "dkrp" else name: value for name, value in fields.items()}
        return self._types.types[kind](**fields)

    def fields_of(self, kind: str) -> set[str]:
        """Names of the fields of a message type, which differ between releases of ROS."""
        return {name for name, _ in self._types.fielddefs[kind][1]}

    def write(self, topic: str, message: Any, seconds: float) -> None:
        """Write a message at a time."""
        kind, nanoseconds = message.__msgtype__, round(seconds * 1e9)
        if topic not in self._channels:
            self._channels[topic] = self._add(topic, kind)
        if self.form == "rosbag1":
            raw = self._types.serialize_ros1(message, kind)
        else:
            raw = self._types.serialize_cdr(message, kind)
        if self.form == "mcap":
            self._writer.add_message(self._channels[topic], nanoseconds, bytes(raw), nanoseconds)
        else:
            self._writer.write(self._channels[topic], nanoseconds, raw)

    def _add(self, topic: str, kind: str) -> Any:
        if self.form != "mcap":
            return self._writer.add_connection(topic, kind, typestore=self._types)
        text, _ = self._types.generate_msgdef(kind, ros_version=2)
        schema = self._writer.register_schema(kind, "ros2msg", text.encode())
        return self._writer.register_channel(topic, "cdr", schema)

    def close(self) -> None:
        """Write the index and close."""
        if self.form == "mcap":
            self._writer.finish()
            self._file.close()
        else:
            self._writer.close()
