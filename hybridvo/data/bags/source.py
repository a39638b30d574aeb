"""Opening a bag of any kind, and its messages by topic, in the order in which they came."""

from __future__ import annotations

import contextlib
import heapq
import weakref
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from hybridvo.data.bags.messages import IMAGE_TYPE, plain_ros1_image
from hybridvo.errors import FormatError, InputError

STORAGE_FILES = (".mcap", ".db3")
"""Endings of the files in the folder of a ROS 2 bag."""
FIRST_GAP_NS = 10**8
"""How far reading jumps at first, ns, where a part of a bag is damaged; then twice as far."""


class Message(NamedTuple):
    """A message as it is stored."""

    topic: str
    time: int  # ns, when it was recorded
    data: bytes


class Bag:
    """A bag that is open: its topics, its messages, and what is wrong with it.

    Attributes:
        path: The file or folder.
        is_ros1: Whether messages are coded as in ROS 1.
        types: Topic -> type of its messages, as ``sensor_msgs/msg/Image``.
        counts: Topic -> how many messages the index names.
        notes: Sentences about what is damaged.
    """

    def __init__(self, path: Path) -> None:
        if find_spec("rosbags") is None:
            raise InputError(
                f"{path}: bags are read by rosbags: pip install 'hybridvo[bags]'."
            )
        from rosbags.typesys import Stores, get_typestore

        self.path = path
        self.notes: list[str] = []
        self.is_ros1 = path.is_file() and path.suffix.lower() not in STORAGE_FILES
        store = Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE
        self._types = get_typestore(store)
        if self.is_ros1:
            self._types.register(_transform_types())
        self._readers = self._open_readers()
        self._close = weakref.finalize(self, _close_all, self._readers)
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        for reader in self._readers:
            for connection in reader.connections:
                topic = connection.topic
                self.types.setdefault(topic, connection.msgtype)
                self.counts.setdefault(topic, 0)
                self.counts[topic] += connection.msgcount

    def close(self) -> None:
        """Close the files."""
        self._close()

    def files(self) -> list[Path]:
        """Return the files that are read."""
        if self.path.is_file():
            return [self.path]
        wanted = (*STORAGE_FILES, ".yaml", ".zstd")
        inside = sorted(self.path.iterdir())
        return [path for path in inside if path.suffix.lower() in wanted]

    def decode(self, message: Message) -> Any:
        """Return the fields of a message; a FormatError where they cannot be read."""
        kind = self.types[message.topic]
        try:
            if self.is_ros1:
                data = message.data
                if kind == IMAGE_TYPE:
                    data = plain_ros1_image(data)
                return self._types.deserialize_ros1(data, kind)
            return self._types.deserialize_cdr(message.data, kind)
        # whatever numpy, struct and the decoder of text raise for bytes of another kind
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise FormatError(
                f"{self.path}: {message.topic}: a message is damaged ({reason})."
            ) from None

    def messages(self, topics: Iterable[str], start: int = 0) -> Iterator[Message]:
        """Yield the messages of some topics, from a time on.

        Args:
            topics: Names of topics.
            start: The first time of recording, ns.

        Yields:
            Messages in the order of their time of recording.

        Raises:
            FormatError: A part of the bag is damaged.
        """
        wanted = set(topics)
        streams = []
        for reader in self._readers:
            chosen = [c for c in reader.connections if c.topic in wanted]
            if chosen:
                streams.append(reader.messages(chosen, start=start or None))
        try:
            for connection, time, data in heapq.merge(*streams, key=itemgetter(1)):
                yield Message(connection.topic, time, bytes(data))
        # damaged files raise errors of many kinds
        except Exception as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise FormatError(f"{self.path}: damaged ({reason}).") from None

    def all_messages(self, topics: set[str]) -> Iterator[Message]:
        """Yield the messages of some topics, all that can be read: damaged parts are skipped."""
        start = 0
        gap = FIRST_GAP_NS
        last = max((reader_end(reader) for reader in self._readers), default=0)
        reasons = list[str]()
        while True:
            came = False
            try:
                for message in self.messages(topics, start):
                    came = True
                    start = message.time + 1
                    gap = FIRST_GAP_NS
                    yield message
                break
            except FormatError as error:
                if came or not reasons:
                    reasons.append(str(error))
            if not came and start == 0:
                start = min(reader_start(reader) for reader in self._readers)
            start += gap
            gap *= 2
            if start > last:
                break
        if reasons:
            where = "parts of it are" if len(reasons) > 1 else "a part of it is"
            self.notes.append(
                f"{where} damaged and left out; the first: {reasons[0]}"
            )

    def first(self, topic: str) -> Any:
        """Return the first message of a topic, decoded; None where there is none."""
        with contextlib.suppress(FormatError):
            for message in self.messages([topic]):
                return self.decode(message)
        return None

    def _open_readers(self) -> list[Any]:
        from rosbags import rosbag1, rosbag2

        if self.is_ros1:
            return [self._opened(rosbag1.Reader(self.path), self.path)]
        if self.path.is_file():
            return [self._opened(rosbag2.Reader(self.path), self.path)]
        if (self.path / "metadata.yaml").is_file():
            reader = rosbag2.Reader(self.path)
            try:
                reader.open()
                _check_connections(reader)
                return [reader]
            # of many kinds
            except Exception as error:
                _close_all([reader])
                reason = " ".join(str(error).split())[:200]
                self.notes.append(f"{self.path}: cannot be read whole: {reason}.")
        else:
            self.notes.append(
                f"{self.path}: there is no metadata.yaml: was recording cut off?"
            )
        files = [p for p in self.files() if p.suffix.lower() in STORAGE_FILES]
        if not files:
            raise FormatError(f"{self.path}: damaged: {' '.join(self.notes)}")
        return [self._opened(rosbag2.Reader(file), file) for file in files]

    def _opened(self, reader: Any, path: Path) -> Any:
        """Open a reader, or one that goes without the index where there is none."""
        try:
            reader.open()
        except PermissionError:
            raise
        # of many kinds
        except Exception as error:
            from hybridvo.data.bags.salvage import salvaged

            reason = " ".join(str(error).split())[:200]
            saved = salvaged(path)
            self.notes.append(
                f"{path}: damaged or cut off ({reason}): what is whole of it is used."
            )
            return saved
        return reader


def _check_connections(reader: Any) -> None:
    """Raise a FormatError where metadata.yaml names a topic by something else than a text."""
    for each in reader.connections:
        names = (each.topic, each.msgtype)
        are_texts = all(isinstance(name, str) for name in names)
        if not are_texts or not isinstance(each.msgcount, int):
            got = f"{each.topic!r}, {each.msgtype!r}, {each.msgcount!r}"[:120]
            raise FormatError(f"expected a topic, a type and a count, got {got}")


def reader_start(reader: Any) -> int:
    """Return the time of the first message of a reader of rosbags, ns."""
    with contextlib.suppress(Exception):
        return int(reader.start_time)
    return int(reader.metadata.start_time)


def reader_end(reader: Any) -> int:
    """Return the time after the last message of a reader of rosbags, ns."""
    with contextlib.suppress(Exception):
        return int(reader.end_time)
    return int(reader.metadata.end_time)


def _transform_types() -> dict[str, Any]:
    """The types of ``/tf`` and ``/tf_static``, which rosbags' table of ROS 1 lacks."""
    from rosbags.typesys import get_types_from_msg

    content = "geometry_msgs/TransformStamped[] transforms"
    return {
        **get_types_from_msg(content, "tf2_msgs/msg/TFMessage"),
        **get_types_from_msg(content, "tf/msg/tfMessage"),
    }


def _close_all(readers: list[Any]) -> None:
    for reader in readers:
        with contextlib.suppress(Exception):
            reader.close()
