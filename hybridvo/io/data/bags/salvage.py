"""Readers of bags that were cut off: each takes what is whole and goes without the index.

A recorder that is killed, or a disk that is full, leaves a bag without its last part, and that
holds the index. rosbags refuses such a bag; these readers find the messages and let it read them.
"""

from __future__ import annotations

import contextlib
import io
import mmap
import sqlite3
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import storage_mcap as mcap

from hybridvo.core.errors import FormatError

MAX_CHUNK_BYTES = 2**27
"""Bytes of a chunk, a part of a bag that is packed as a whole. Recorders write 1 to 4 MB."""

ROS1_BEGINNING = b"#ROSBAG V2.0"
CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
"""In the header of every chunk of a ROS 1 bag: a field of four bytes."""
LONGEST_CHUNK_HEADER = 128  # bytes
ROS1_DAMAGE = (rosbag1.ReaderError, ValueError, IndexError)
"""What is raised for bytes that are no record, or a part of one."""

MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_HEAD = struct.Struct("<BQ")
"""Before a record: what it is, and how many bytes it has."""
MCAP_CHUNK = 6
MCAP_LAST = (0, 2, 15)
"""Records behind which there is a summary at most."""

SQLITE_PAGE = 4096  # bytes
LAST_ROWS = 100
"""Rows at the end of a cut database of which data may be missing: a page of the tree names ten."""


class CutBag1(rosbag1.Reader):
    """A ROS 1 bag without an index: all chunks are looked through.

    Attributes:
        stated_counts: number of a connection -> how many messages it had, as far as the index can
            be read.
        stated_times: when chunks began and ended, ns, by the index.
    """

    def open(self) -> None:
        """Find the chunks that are whole, and the messages in them."""
        self.stated_counts: dict[int, int] = defaultdict(int)
        self.stated_times = list[int]()
        self._found: dict[int, Connection] = {}
        self.indexes = defaultdict(list)
        with self.path.open("rb") as file:
            # reads no more than there is, whatever length a record states
            content: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.bio = content
        if content[: len(ROS1_BEGINNING)] != ROS1_BEGINNING:
            self.close()
            raise rosbag1.ReaderError("it does not begin as a ROS 1 bag")
        place = content.find(b"\n") + 1
        while place >= 0:
            try:
                content.seek(place)
                self._take_record(content, place)
                place = content.tell()
            except ROS1_DAMAGE:
                place = self._next_chunk(content, place)
        for each in self.indexes.values():
            each.sort()
        self.connections = [
            connection._replace(msgcount=len(self.indexes[number]))
            for number, connection in self._found.items()
        ]

    def _take_record(self, content: Any, place: int) -> None:
        """Take a chunk, a topic or what a chunk held, and go behind it."""
        header = ros1.Header.read(content)
        size = ros1.read_uint32(content)
        check_chunk(size)
        end = content.tell() + size
        op = header.get_uint8("op")
        content.seek(place)
        if op == ros1.RecordType.CHUNK:
            check_chunk(header.get_uint32("size"))
            self._take_chunk(content, place)
        elif op == ros1.RecordType.CONNECTION:
            self._take_topic(self)
        elif op == ros1.RecordType.CHUNK_INFO:
            stated = self.read_chunk_info()
            for number, count in stated.connection_counts.items():
                self.stated_counts[number] += count
            self.stated_times += [stated.start_time, stated.end_time - 1]
        content.seek(end)

    def _take_topic(self, reader: rosbag1.Reader) -> None:
        """Take the topic at which a reader stands."""
        connection = reader.read_connection()
        self._found.setdefault(connection.id, connection)

    def _take_chunk(self, content: Any, place: int) -> None:
        """Take the topics of a chunk, and index its messages."""
        chunk = self.read_chunk()
        content.seek(chunk.datapos)
        try:
            unpacked = chunk.decompressor(content.read(chunk.datasize))
        # each library raises errors of its own for a part of its data
        except Exception as error:
            raise rosbag1.ReaderError(f"a chunk is damaged ({error})") from None
        inside = rosbag1.Reader(self.path)
        inside.bio = io.BytesIO(unpacked)
        times = list[int]()
        with contextlib.suppress(*ROS1_DAMAGE):
            while True:
                offset = inside.bio.tell()
                header = ros1.Header.read(inside.bio)
                ros1.read_bytes(inside.bio, ros1.read_uint32(inside.bio))
                end = inside.bio.tell()
                if header.get_uint8("op") == ros1.RecordType.CONNECTION:
                    inside.bio.seek(offset)
                    self._take_topic(inside)
                else:
                    time = header.get_time("time")
                    entry = ros1.IndexData(time, place, offset)
                    self.indexes[header.get_uint32("conn")].append(entry)
                    times.append(time)
                inside.bio.seek(end)
        self.chunks[place] = chunk
        if times:
            self.chunk_infos.append(
                ros1.ChunkInfo(place, min(times), max(times) + 1, {})
            )

    @staticmethod
    def _next_chunk(content: Any, place: int) -> int:
        """Return where behind a place the next record begins that can be a chunk, or -1."""
        at = content.find(CHUNK_MARK, place + 1)
        while at >= 0:
            for start in range(at - 4, max(at - LONGEST_CHUNK_HEADER, place), -1):
                (length,) = struct.unpack_from("<I", content, start)
                reaches = start + 4 + length >= at + len(CHUNK_MARK)
                if reaches and length <= LONGEST_CHUNK_HEADER:
                    content.seek(start)
                    with contextlib.suppress(*ROS1_DAMAGE):
                        ros1.Header.read(content, ros1.RecordType.CHUNK)
                        return start
            at = content.find(CHUNK_MARK, at + 1)
        return -1


class CutMcap(mcap.McapReader):
    """An mcap file without its summary: all records are looked through."""

    # the summary, which would state them, is lost
    stated_counts: Mapping[int, int] = {}
    stated_times: Sequence[int] = ()

    def _open(self) -> None:
        """Find the channels, and the chunks or messages that are whole."""
        if self.bio is None or self.bio.read(8) != MCAP_MAGIC:
            raise rosbag2.ReaderError("it does not begin as an mcap file")
        self.data_start = self.bio.tell()
        chunks = self._whole_chunks(self.bio)
        self.meta_scan()
        self.chunks = chunks
        check_mcap(self)
        if self.statistics is None or not self.statistics.message_count:
            return
        counts = self.statistics.channel_message_counts
        self.connections = [
            connection._replace(msgcount=counts.get(connection.id, 0))
            for connection in self.connections
        ]
        self.metadata = self.metadata._replace(
            start_time=self.statistics.start_time,
            end_time=self.statistics.end_time + 1,
        )

    def _whole_chunks(self, bio: BinaryIO) -> list[mcap.ChunkInfo]:
        """Return the chunks before the first record that is not whole; data ends there."""
        chunks = list[mcap.ChunkInfo]()
        size_of_file = self.path.stat().st_size
        place = self.data_start
        while True:
            self.data_end = place
            bio.seek(place)
            head = bio.read(MCAP_HEAD.size)
            if len(head) < MCAP_HEAD.size:
                return chunks
            op, size = MCAP_HEAD.unpack(head)
            end = place + MCAP_HEAD.size + size
            if op in MCAP_LAST or end > size_of_file:
                return chunks
            if op == MCAP_CHUNK:
                chunk = _whole_chunk(place, bio.read(size))
                if chunk is None:
                    return chunks
                chunks.append(chunk)
            place = end


def _whole_chunk(place: int, record: bytes) -> mcap.ChunkInfo | None:
    """What an index would state of a chunk that is whole; None for a damaged one."""
    try:
        bio = io.BytesIO(record)
        first, last, size, checksum = mcap.deserialize_qqqi(bio.read(28))
        check_chunk(size)
        packing = mcap.read_string(bio)
        packed = mcap.read_sized(bio)
        mcap.decompress(packed, packing, size, checksum)
    # each library raises errors of its own for damaged data
    except Exception:
        return None
    length = MCAP_HEAD.size + len(record)
    return mcap.ChunkInfo(
        first, last, place, length, {}, 0, packing, len(packed), size, {}
    )


class Topic(NamedTuple):
    """What is used of a ``Connection`` of rosbags."""

    id: int
    topic: str
    msgtype: str
    msgcount: int


class CutSqlite:
    """A database of a ROS 2 bag whose last pages are missing: rows are read until one is gone."""

    # no table states them
    stated_counts: Mapping[int, int] = {}
    stated_times: Sequence[int] = ()

    def __init__(self, path: Path) -> None:
        self.connections = list[Topic]()
        self.start_time = 0
        self.end_time = 0
        self._database = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode=ro&immutable=1",
            uri=True,
            isolation_level=None,
            check_same_thread=False,
        )

    def open(self) -> None:
        """Find the topics and the messages that can still be reached."""
        topics = list(self._query("SELECT id, name, type FROM topics"))
        if not topics:
            raise rosbag2.ReaderError("its tables are lost")
        self._reachable = self._reachable_rows()
        if self._reachable:
            self.start_time = self._reachable[0][0]
            self.end_time = self._reachable[-1][0] + 1
        counts = Counter(topic for _, topic, _ in self._reachable)
        self.connections = [
            Topic(number, name, kind, counts[number])
            for number, name, kind in topics
        ]

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def messages(
        self, connections: Sequence[Topic], start: int | None = None
    ) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield connection, time, ns, and bytes of the messages, as rosbags' readers do."""
        by_number = {connection.id: connection for connection in connections}
        for time, topic, row in self._reachable:
            if topic in by_number and time >= (start or 0):
                yield by_number[topic], time, self._data_of(row)

    def _query(self, text: str, *values: int) -> Iterator[Any]:
        """Yield rows until one is gone."""
        with contextlib.suppress(sqlite3.Error):
            if not self._database.in_transaction:
                self._begin()
            yield from self._database.execute(text, values)

    def _begin(self) -> None:
        """Begin to read a file that is shorter than its first page states.

        SQLite refuses such a file, but for the setting by which a broken schema may be repaired.
        It looks when reading begins: then the setting is taken back.
        """
        self._database.execute("PRAGMA writable_schema=ON")
        self._database.execute("BEGIN")
        self._database.execute("PRAGMA schema_version").fetchall()
        self._database.execute("PRAGMA writable_schema=OFF")

    def _data_of(self, row: int) -> bytes:
        query = "SELECT data FROM messages WHERE rowid = ?"
        for (data,) in self._query(query, row):
            return bytes(data)
        raise rosbag2.ReaderError("a message is gone")

    def _reachable_rows(self) -> list[tuple[int, int, int]]:
        """Time, ns, topic and row of the messages that can be read, in the order of time."""
        query = "SELECT timestamp, topic_id, rowid FROM messages NOT INDEXED"
        # the last byte: the data of the row can be read as well
        query = f"{query} WHERE substr(data, -1) IS NOT NULL ORDER BY rowid"
        rows = [
            row
            for row in self._query(query)
            if all(isinstance(value, int) for value in row)
        ]
        return sorted(self._without_empty_end(rows))

    def _without_empty_end(
        self, rows: list[tuple[int, int, int]]
    ) -> list[tuple[int, int, int]]:
        """Drop the last rows whose data is not in the file any more.

        SQLite reads pages beyond the end of a file as zeros. Pages are given out in the order of
        the rows: once one with data of several pages is whole, those before it are.
        """
        for kept in range(len(rows), max(len(rows) - LAST_ROWS, 0), -1):
            data = self._data_of(rows[kept - 1][2])
            if len(data) > 2 * SQLITE_PAGE and any(data[-SQLITE_PAGE:]):
                return rows[:kept]
        return rows[:-LAST_ROWS]


def salvaged(path: Path) -> Any:
    """Open a file of a bag that rosbags' readers refuse.

    Returns:
        A reader with ``connections`` and ``messages``, which holds what is whole.

    Raises:
        FormatError: Nothing can be read.
    """
    kinds: dict[str, Any] = {".mcap": CutMcap, ".db3": CutSqlite}
    try:
        reader = kinds.get(path.suffix.lower(), CutBag1)(path)
        reader.open()
    # damaged files raise errors of many kinds
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise FormatError(
            f"{path}: damaged: nothing can be read ({reason})."
        ) from None
    return reader


def check_chunk(size: int) -> None:
    """Raise a FormatError where a chunk states more bytes than a recorder writes."""
    if size > MAX_CHUNK_BYTES:
        raise FormatError(
            f"a chunk states {size} bytes: expected at most {MAX_CHUNK_BYTES}"
        )


def check_mcap(reader: mcap.McapReader) -> None:
    """Check the chunks of an mcap file, and have those read that state no channels.

    Raises:
        FormatError: One states to be too large.
    """
    for chunk in reader.chunks:
        check_chunk(chunk.uncompressed_size)
        if not chunk.channel_count:
            chunk.channel_count.update(dict.fromkeys(reader.channels, 1))
