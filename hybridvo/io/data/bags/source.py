"""Opening a bag of any kind, and its messages by topic, in the order in which they came."""

from __future__ import annotations

import contextlib
import heapq
import sys
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import file_size, read_head, unpacked_limit
from hybridvo.io.data.bags.folder import (
    METADATA,
    PACKED,
    STORAGE_FILES,
    contents,
    storage_files,
)
from hybridvo.io.data.bags.messages import IMAGE_TYPE, plain_ros1_image

FIRST_GAP_NS = 10**8
"""How far reading jumps at first, ns, where a part of a bag is damaged; then twice as far."""
LATEST_NS = 2**63 - 1
ZSTD_HEADER_BYTES = 18
UNPACKED_AT_ONCE = 2**20
"""Bytes."""


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
        self.is_ros1 = path.is_file() and storage_ending(path) not in STORAGE_FILES
        store = Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE
        self._types = get_typestore(store)
        if self.is_ros1:
            self._types.register(_transform_types())
        self._are_messages_packed = False
        self._readers: list[Any] = []
        self._scratch = _Scratch()
        self._close = weakref.finalize(
            self, _close_all, self._readers, self._scratch
        )
        try:
            self._open_readers()
        except BaseException:
            self.close()
            raise
        self.types: dict[str, str] = {}
        self.counts: dict[str, int] = {}
        for reader in self._readers:
            for connection in reader.connections:
                topic = connection.topic
                kind = connection.msgtype
                if not isinstance(topic, str) or not isinstance(kind, str):
                    raise FormatError(f"{path}: damaged: a topic has no name.")
                self.types.setdefault(topic, kind)
                self.counts.setdefault(topic, 0)
                self.counts[topic] += connection.msgcount

    def close(self) -> None:
        """Close the files."""
        self._close()

    def files(self) -> list[Path]:
        """Return the files that are read."""
        if self.path.is_file():
            return [self.path]
        metadata = self.path / METADATA
        beside = [metadata] if metadata.is_file() else []
        return sorted([*storage_files(self.path), *beside])

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
        streams = [self._stream(reader, wanted, start) for reader in self._readers]
        try:
            for time, connection, data in heapq.merge(*streams, key=itemgetter(0)):
                if connection is not None:
                    yield self._message(connection.topic, time, data)
        # damaged files raise errors of many kinds
        except Exception as error:
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            raise FormatError(f"{self.path}: damaged ({reason}).") from None

    @staticmethod
    def _stream(reader: Any, topics: set[str], start: int) -> Iterator[Any]:
        """Yield time, connection and data of a file, after a mark where its time begins.

        By the mark, of the files of a long recording only one is read at a time.
        """
        chosen = [each for each in reader.connections if each.topic in topics]
        if not chosen:
            return
        with contextlib.suppress(Exception):
            yield reader_start(reader), None, b""
        for connection, time, data in reader.messages(chosen, start=start or None):
            yield time, connection, data

    def _message(self, topic: str, time: int, data: bytes) -> Message:
        """A message, unpacked where it was packed by itself."""
        # a database may hold anything in their place
        is_time = isinstance(time, int) and abs(time) <= LATEST_NS
        if not is_time or not isinstance(data, bytes):
            raise FormatError("a message has no time or no data")
        if self._are_messages_packed:
            data = _zstd().decompress(data)
        return Message(topic, time, data)

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

    def stated_counts(self) -> dict[str, int]:
        """Return topic -> how many messages the bag held before damage, where it states it."""
        stated = Counter[str]()
        for reader in self._readers:
            before_damage = getattr(reader, "stated_counts", None)
            for each in reader.connections:
                count = each.msgcount
                if before_damage is not None:
                    count = before_damage.get(each.id, 0)
                stated[each.topic] += count
        return {topic: count for topic, count in stated.items() if count}

    def stated_times(self) -> tuple[int, int] | None:
        """Return when the bag begins and ends, ns, as far as its index states it."""
        times = list[int]()
        for reader in self._readers:
            before_damage = getattr(reader, "stated_times", None)
            if before_damage is None:
                times += [reader_start(reader), reader_end(reader)]
            times += before_damage or []
        return (min(times), max(times)) if times else None

    def first(self, topic: str) -> Any:
        """Return the first message of a topic, decoded; None where there is none."""
        with contextlib.suppress(FormatError):
            for message in self.messages([topic]):
                return self.decode(message)
        return None

    def _open_readers(self) -> None:
        files = [self.path]
        if self.path.is_dir():
            found = contents(self.path)
            files = found.files
            self.notes += found.notes
            self._are_messages_packed = found.are_messages_packed
        for file in self._scratch.unpacked(files):
            self._readers.append(self._opened(file))

    def _opened(self, path: Path) -> Any:
        """Open a file, or what is whole of it where its index is not."""
        from rosbags import rosbag1
        from rosbags.rosbag2.storage_mcap import McapReader
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        from hybridvo.io.data.bags.salvage import check_mcap, salvaged

        reader: Any
        if path.suffix.lower() == ".mcap":
            reader = McapReader(path)
        elif path.suffix.lower() == ".db3":
            reader = Sqlite3Reader(_escaped(path))
        else:
            reader = rosbag1.Reader(path)
        try:
            reader.open()
            if isinstance(reader, McapReader):
                check_mcap(reader)
        except PermissionError:
            raise
        # of many kinds
        except Exception as error:
            with contextlib.suppress(Exception):
                reader.close()
            words = " ".join(str(error).split())[:200].rstrip(".")
            reason = words or "its index is not whole"
            saved = salvaged(path)
            self.notes.append(f"{path}: damaged or cut off: {reason}.")
            return saved
        return reader


class _Scratch:
    """The files of a bag that were packed as a whole, unpacked into a temporary folder."""

    def __init__(self) -> None:
        self._folder: TemporaryDirectory[str] | None = None

    def unpacked(self, files: list[Path]) -> list[Path]:
        """Return the files of a bag; in place of a packed one what it unpacks to.

        Raises:
            FormatError: One cannot be unpacked, or all together unpack to more than a recording
                does.
        """
        packed = [file for file in files if file.suffix.lower() == PACKED]
        limit = unpacked_limit(sum(file_size(file) for file in packed))
        room = limit
        plain = []
        for number, file in enumerate(files):
            file_size(file)
            if file in packed:
                source = file
                # two files of a bag may have one name but for its ending
                file = self._path() / f"{number}-{file.stem}"
                room -= _unpack_file(source, file, room, limit)
            plain.append(file)
        return plain

    def remove(self) -> None:
        """Remove the folder, if there is one."""
        if self._folder is not None:
            self._folder.cleanup()

    def _path(self) -> Path:
        if self._folder is None:
            self._folder = TemporaryDirectory(prefix="hybridvo-bag-")
        return Path(self._folder.name)


def _unpack_file(packed: Path, target: Path, room: int, limit: int) -> int:
    """Unpack a file that zstd packed as a whole, into another file; return its bytes.

    Args:
        packed: The file.
        target: The other one.
        room: To how many bytes it may unpack.
        limit: To how many bytes all packed files of the bag may unpack, for the message.

    Raises:
        FormatError: It unpacks to more, or is damaged.
    """
    zstd = _zstd()
    too_large = FormatError(
        f"{packed}: unpacks to more than a recording does: expected at most {limit} bytes of all "
        "packed files of the bag. If you know where it comes from, unpack it by 'zstd -d' and "
        "name what comes out."
    )
    written = 0
    try:
        stated = zstd.get_frame_info(read_head(packed, ZSTD_HEADER_BYTES))
        if (stated.decompressed_size or 0) > room:
            raise too_large
        with zstd.open(packed) as source, target.open("wb") as file:
            while part := source.read(UNPACKED_AT_ONCE):
                written += len(part)
                if written > room:
                    raise too_large
                file.write(part)
    except InputError:
        raise
    # the decoder has errors of its own
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise FormatError(f"{packed}: cannot be unpacked ({reason}).") from None
    return written


def _escaped(path: Path) -> Path:
    """A path as rosbags needs it, which makes a part of a URI of it."""
    text = str(path)
    for character in "%?#":
        text = text.replace(character, f"%{ord(character):x}")
    return Path(text)


def _zstd() -> Any:
    """The module that unpacks what zstd has packed; rosbags brings it."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


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


def storage_ending(path: Path) -> str:
    """Return the ending of a file of a bag, in lower case, without that of its packing."""
    return Path(path.name.lower().removesuffix(PACKED)).suffix


def _close_all(readers: list[Any], scratch: _Scratch) -> None:
    for reader in readers:
        with contextlib.suppress(Exception):
            reader.close()
    scratch.remove()
