"""The readers of ``rosbags`` within limits, whatever a file of a stranger states.

They take what rosbags reads of a file's tables, and unpack and hand out messages themselves:
chunks, messages and indexes have limits, and a database can run nothing.
"""

from __future__ import annotations

import heapq
import io
import struct
from binascii import crc32
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import apsw
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2 import storage_sqlite3 as sqlite
from rosbags.rosbag2.metadata import ReaderMetadata

from hybridvo.core.errors import FormatError
from hybridvo.core.files import file_size
from hybridvo.io.data.bags.unpacking import (
    MAX_CHUNK_BYTES,
    MAX_CHUNK_MESSAGES,
    MAX_MESSAGE_BYTES,
    MAX_TOPICS,
    BoundedPath,
    unpack,
)

NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, "")
"""Types of messages are known by their names."""
INDEX_HEAD_BYTES = 55
"""Bytes of a record of ROS 1's index before its entries; the last four are their length."""
INDEX_ENTRY_BYTES = 12
UNPACKERS = {
    ros1.decompressors[name]: partial(unpack, packing=name)
    for name in ("bz2", "lz4")
}
"""What takes the place of rosbags' functions, which have no limits."""

MCAP_FOOTER = 2
MCAP_SCHEMA = 3
MCAP_CHANNEL = 4
MCAP_MESSAGE = 5
MCAP_CHUNK = 6
MCAP_SUMMARY_OFFSET = 14
MCAP_HEAD = struct.Struct("<BQ")
"""Before a record: what it is, and how many bytes it has."""
MCAP_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, number, time of recording, time of sending."""
MCAP_CHUNK_HEAD = struct.Struct("<QQQI")
"""First and last time, bytes of the content, its checksum."""
MCAP_TAIL_BYTES = 8
"""The mark at the end of a file."""
LATEST_NS = 2**63 - 1
MAX_HELD_BYTES = 2 * MAX_CHUNK_BYTES
"""Bytes of chunks of the same time, which are in memory at once."""

MAX_STEPS = 10**8
"""Steps that SQLite may take until it has the next row: some seconds."""
STEPS_A_CALL = 10**5
HIDDEN_COLUMN = 6
"""The place in what SQLite states of a column, of whether it is computed."""


# -- ROS 1 -----------------------------------------------------------------------------


class BoundedBag1(rosbag1.Reader):
    """A ROS 1 bag: a file of chunks, with an index at its end."""

    def __init__(self, path: Path) -> None:
        super().__init__(BoundedPath(path))
        self._connections_read = 0
        self._named_chunks = set[int]()
        # the chunk whose index is being read, and its messages that have been named
        self._chunk_of_index = -1
        self._named_messages = set[int]()

    def read_connection(self) -> Connection:
        """Read what is stated of a topic."""
        self._connections_read += 1
        check_topics(self._connections_read)
        return super().read_connection()

    def read_chunk_info(self) -> ros1.ChunkInfo:
        """Read where a chunk is, and which topics it holds; each is named once."""
        bio = self._file()
        place = bio.tell()
        header = ros1.Header.read(bio, ros1.RecordType.CHUNK_INFO)
        check_topics(header.get_uint32("count"))
        bio.seek(place)
        info = super().read_chunk_info()
        if info.pos in self._named_chunks:
            raise rosbag1.ReaderError("the index names a chunk twice")
        self._named_chunks.add(info.pos)
        return info

    def read_chunk(self) -> ros1.Chunk:
        """Read where the data of a chunk is; it will be unpacked within limits."""
        chunk = super().read_chunk()
        check_chunk(chunk.datasize)
        unpacker = UNPACKERS.get(chunk.decompressor, chunk.decompressor)
        return chunk._replace(decompressor=unpacker)

    def read_index_data(
        self, pos: int, indexes: dict[int, list[ros1.IndexData]]
    ) -> None:
        """Read where the messages of a topic are in a chunk; each is named once."""
        bio = self._file()
        head = bio.read(INDEX_HEAD_BYTES)
        size = int.from_bytes(head[-4:], "little")
        check_messages(size // INDEX_ENTRY_BYTES)
        bio.seek(-len(head), io.SEEK_CUR)
        if pos != self._chunk_of_index:
            self._chunk_of_index = pos
            self._named_messages.clear()
        found: dict[int, list[ros1.IndexData]] = defaultdict(list)
        super().read_index_data(pos, found)
        for number, entries in found.items():
            before = len(self._named_messages)
            self._named_messages.update(entry.offset for entry in entries)
            if len(self._named_messages) < before + len(entries):
                raise rosbag1.ReaderError("the index names a message twice")
            indexes[number] += entries
        check_messages(len(self._named_messages))

    def _file(self) -> BinaryIO:
        if self.bio is None:
            raise rosbag1.ReaderError("the bag is closed")
        return self.bio


# -- mcap ------------------------------------------------------------------------------


class Record(NamedTuple):
    """A record of an mcap file."""

    op: int  # what it is
    place: int  # of its content
    size: int  # of its content, bytes


class BoundedMcap(mcap.McapReader):
    """An mcap file."""

    def __init__(self, path: Path) -> None:
        super().__init__(BoundedPath(path))
        self._held = 0

    def read_index(self) -> None:
        """Read schemas, channels, chunks and statistics from the end of the file."""
        bio = self._file()
        end = file_size(str(self.path)) - MCAP_TAIL_BYTES
        tables = list[bytes]()
        for record in records(bio, self.data_end, end):
            if record.op in (MCAP_FOOTER, MCAP_SUMMARY_OFFSET):
                break
            tables.append(_table(record.op, mcap.read_exact(bio, record.size)))
        self._read_tables(tables)
        places = {chunk.chunk_start_offset for chunk in self.chunks}
        if len(places) < len(self.chunks):
            raise rosbag2.ReaderError("the index names a chunk twice")

    def meta_scan(self) -> None:
        """Go over the data, where no index states what is in it."""
        tables = list[bytes]()
        counts: dict[int, int] = defaultdict(int)
        first = LATEST_NS
        last = 0
        chunks = list[mcap.ChunkInfo]()
        are_all_packed = True
        bio = self._file()
        for outer in records(bio, self.data_start, self.data_end):
            content: BinaryIO = bio
            inner: Iterable[Record] = [outer]
            if outer.op == MCAP_CHUNK:
                record = mcap.read_exact(bio, outer.size)
                data = chunk_content(record)
                content = io.BytesIO(data)
                inner = records(content, 0, len(data))
                chunks.append(chunk_info(outer.place, record, data))
            elif outer.op == MCAP_MESSAGE:
                are_all_packed = False
            for each in inner:
                content.seek(each.place)
                if each.op in (MCAP_SCHEMA, MCAP_CHANNEL):
                    data = mcap.read_exact(content, each.size)
                    tables.append(_table(each.op, data))
                elif each.op == MCAP_MESSAGE:
                    channel, time = _message_head(content)
                    counts[channel] += 1
                    first = min(first, time)
                    last = max(last, time)
        self._read_tables(tables)
        self.chunks = chunks if are_all_packed else []
        self.statistics = mcap.Statistics(
            sum(counts.values()),
            len(self.schemas),
            len(self.channels),
            0,
            0,
            len(chunks),
            first,
            last,
            dict(counts),
        )

    def messages(
        self,
        connections: Any,
        start: int | None = None,
        stop: int | None = None,
    ) -> Any:
        """Yield connection, time, ns, and bytes of the messages in the order of time."""
        if not self.chunks:
            yield from super().messages(connections, start, stop)
            return
        earliest = start or 0
        latest = LATEST_NS if stop is None else stop
        wanted = {connection.id: connection for connection in connections}
        streams = [
            self._chunk_messages(chunk, wanted, earliest, latest)
            for chunk in self.chunks
            if earliest <= chunk.message_end_time
            and chunk.message_start_time < latest
            and (not chunk.channel_count or chunk.channel_count.keys() & wanted)
        ]
        for time, connection, data in heapq.merge(*streams, key=itemgetter(0)):
            if connection is not None:
                yield connection, time, data

    def messages_scan(
        self,
        connections: Any,
        start: int | None = None,
        stop: int | None = None,
    ) -> Any:
        """Yield the messages as they lie in the file, packed or not."""
        earliest = start or 0
        latest = LATEST_NS if stop is None else stop
        wanted = {connection.id: connection for connection in connections}
        bio = self._file()
        for outer in records(bio, self.data_start, self.data_end):
            content: BinaryIO = bio
            inner: Iterable[Record] = [outer]
            if outer.op == MCAP_CHUNK:
                data = chunk_content(mcap.read_exact(bio, outer.size))
                content = io.BytesIO(data)
                inner = records(content, 0, len(data))
            for each in inner:
                if each.op != MCAP_MESSAGE:
                    continue
                content.seek(each.place)
                channel, time = _message_head(content)
                if channel in wanted and earliest <= time < latest:
                    size = each.size - MCAP_MESSAGE_HEAD.size
                    yield wanted[channel], time, mcap.read_exact(content, size)

    def _chunk_messages(
        self,
        chunk: mcap.ChunkInfo,
        wanted: dict[int, Connection],
        earliest: int,
        latest: int,
    ) -> Iterator[tuple[int, Connection | None, bytes]]:
        """Yield the messages of a chunk, after a mark without one where its time begins.

        By the mark the chunk is only unpacked when its turn comes.
        """
        yield chunk.message_start_time, None, b""
        bio = self._file()
        end = chunk.chunk_start_offset + chunk.chunk_length
        first = next(records(bio, chunk.chunk_start_offset, end), None)
        if first is None or first.op != MCAP_CHUNK:
            raise rosbag2.ReaderError("the index names a chunk where none is")
        data = chunk_content(mcap.read_exact(bio, first.size))
        self._held += len(data)
        try:
            if self._held > MAX_HELD_BYTES:
                raise rosbag2.ReaderError("too many chunks are of the same time")
            found = list[tuple[int, int, int, int]]()
            content = io.BytesIO(data)
            for record in records(content, 0, len(data)):
                if record.op != MCAP_MESSAGE:
                    continue
                channel, time = _message_head(content)
                if channel in wanted and earliest <= time < latest:
                    place = record.place + MCAP_MESSAGE_HEAD.size
                    stop = record.place + record.size
                    found.append((time, channel, place, stop))
                    check_messages(len(found))
            for time, channel, place, stop in sorted(found, key=itemgetter(0)):
                yield time, wanted[channel], data[place:stop]
        finally:
            self._held -= len(data)

    def _read_tables(self, tables: list[bytes]) -> None:
        """Let rosbags read some records as if they were the end of the file."""
        bio = self.bio
        end = self.data_end
        self.bio = io.BytesIO(b"".join(tables) + bytes([MCAP_FOOTER]))
        self.data_end = 0
        try:
            super().read_index()
        finally:
            self.bio = bio
            self.data_end = end
        check_topics(len(self.connections))

    def _file(self) -> BinaryIO:
        if self.bio is None:
            raise rosbag2.ReaderError("the file is closed")
        return self.bio


def records(bio: BinaryIO, place: int, end: int) -> Iterator[Record]:
    """Yield the records of an mcap file between two places; the file stands at the content.

    Raises:
        ReaderError: The last one is cut off.
    """
    while place < end:
        bio.seek(place)
        op, size = MCAP_HEAD.unpack(mcap.read_exact(bio, MCAP_HEAD.size))
        place += MCAP_HEAD.size
        if place + size > end:
            raise rosbag2.ReaderError(f"a record at {place} is cut off")
        yield Record(op, place, size)
        place += size


def chunk_content(record: bytes) -> bytes:
    """Return the content of a chunk of an mcap file, unpacked within limits and checked.

    Raises:
        Exception: It is damaged, or too large.
    """
    _, _, size, checksum = MCAP_CHUNK_HEAD.unpack_from(record)
    check_chunk(size)
    place = MCAP_CHUNK_HEAD.size
    length = int.from_bytes(record[place : place + 4], "little")
    place += 4
    packing = record[place : place + length].decode()
    # the number of packed bytes takes eight
    place += length + 8
    content = unpack(memoryview(record)[place:], packing, size)
    if len(content) != size:
        raise rosbag2.ReaderError(
            f"a chunk states {size} bytes and has {len(content)}"
        )
    if checksum and crc32(content) != checksum:
        raise rosbag2.ReaderError("the checksum of a chunk is wrong")
    return content


def chunk_info(place: int, record: bytes, content: bytes) -> mcap.ChunkInfo:
    """Return what an index states of a chunk.

    Args:
        place: Of the record, behind its head.
        record: The chunk.
        content: The same unpacked.
    """
    start, end, size, _ = MCAP_CHUNK_HEAD.unpack_from(record)
    counts: dict[int, int] = defaultdict(int)
    bio = io.BytesIO(content)
    for each in records(bio, 0, len(content)):
        if each.op == MCAP_MESSAGE:
            channel, _ = _message_head(bio)
            counts[channel] += 1
    return mcap.ChunkInfo(
        start,
        end,
        place - MCAP_HEAD.size,
        len(record) + MCAP_HEAD.size,
        {},
        0,
        "",
        len(record),
        size,
        dict(counts),
    )


def _message_head(bio: BinaryIO) -> tuple[int, int]:
    """Channel and time of recording, ns, of a message at whose content a file stands."""
    head = mcap.read_exact(bio, MCAP_MESSAGE_HEAD.size)
    channel, _, time, _ = MCAP_MESSAGE_HEAD.unpack(head)
    return channel, time


def _table(op: int, content: bytes) -> bytes:
    """A record as rosbags shall read it.

    What a channel states of the quality of service is left out: it is YAML of any length.
    """
    if op == MCAP_CHANNEL:
        place = 4
        # its topic and its encoding
        for _ in range(2):
            place += 4 + int.from_bytes(content[place : place + 4], "little")
        content = content[:place] + bytes(4)
    return MCAP_HEAD.pack(op, len(content)) + content


# -- SQLite ----------------------------------------------------------------------------


class StepLimit:
    """Stops a query that takes too many steps."""

    def __init__(self) -> None:
        self._calls = 0

    def __call__(self) -> bool:
        """Return whether the query shall stop; SQLite calls it after some steps."""
        self._calls += 1
        return self._calls * STEPS_A_CALL > MAX_STEPS

    def begin(self) -> None:
        """Count from 0 on."""
        self._calls = 0


class BoundedSqlite(sqlite.Sqlite3Reader):
    """A database of a ROS 2 bag, of which tables are read and nothing is run."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._steps = StepLimit()

    def open(self) -> None:
        """Find the topics, and how many messages they have."""
        self.dbconn = apsw.Connection(
            f"{self._regular_file().as_uri()}?immutable=1",
            flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI,
        )
        try:
            self._restrict(self.dbconn)
            self._check_tables()
            self._read_topics(self._counts())
        except apsw.Error as error:
            self.close()
            raise rosbag2.ReaderError(f"its tables are lost ({error})") from None
        except BaseException:
            self.close()
            raise

    def messages(
        self,
        connections: Any,
        start: int | None = None,
        stop: int | None = None,
    ) -> Any:
        """Yield connection, time, ns, and bytes of the messages, as rosbags' readers do."""
        by_number = {connection.id: connection for connection in connections}
        for time, topic, row in self._rows(by_number, start, stop):
            yield by_number[topic], time, self._data_of(row)

    def _regular_file(self) -> Path:
        path = Path(str(self.path)).absolute()
        file_size(path)
        return path

    def _restrict(self, connection: apsw.Connection) -> None:
        """Let a file run nothing: no views, no triggers, no functions, no endless query."""
        connection.config(apsw.SQLITE_DBCONFIG_DEFENSIVE, 1)
        connection.config(apsw.SQLITE_DBCONFIG_TRUSTED_SCHEMA, 0)
        connection.config(apsw.SQLITE_DBCONFIG_ENABLE_VIEW, 0)
        connection.config(apsw.SQLITE_DBCONFIG_ENABLE_TRIGGER, 0)
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        connection.limit(apsw.SQLITE_LIMIT_ATTACHED, 0)
        connection.set_progress_handler(self._steps, STEPS_A_CALL)

    def _check_tables(self) -> None:
        """Refuse what is no plain table: a view or a computed column is a program."""
        tables = set[str]()
        for kind, name, page in self._query(
            "SELECT type, name, rootpage FROM sqlite_master"
        ):
            if kind not in ("table", "index") or not page:
                what = "virtual table" if kind == "table" else str(kind)[:40]
                raise FormatError(
                    f"it holds a {what}, '{str(name)[:40]}': expected tables only"
                )
            if kind == "table":
                tables.add(name)
        for name in ("topics", "messages"):
            if name not in tables:
                raise rosbag2.ReaderError(f"it has no table '{name}'")
            for column in self._query(f"PRAGMA table_xinfo({name})"):
                if column[HIDDEN_COLUMN]:
                    raise FormatError(
                        f"the column '{column[1]}' of '{name}' is computed: expected a plain one"
                    )

    def _counts(self) -> dict[int, int]:
        """Count the messages of each topic, and take over the first and the last time."""
        counts: dict[int, int] = {}
        times = list[Any]()
        query = "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages"
        for topic, count, first, last in self._query(f"{query} GROUP BY topic_id"):
            counts[topic] = count
            times += [first, last]
            check_topics(len(counts))
        if not all(isinstance(time, int) for time in times):
            raise FormatError("expected whole numbers as times of messages")
        if times:
            self._take_times(min(times), max(times), sum(counts.values()))
        return counts

    def _take_times(self, first: int, last: int, count: int) -> None:
        self.metadata = ReaderMetadata(
            last - first + 1, first, last + 1, count, None, None, None, None
        )

    def _read_topics(self, counts: dict[int, int]) -> None:
        extension = ConnectionExtRosbag2("cdr", [])
        for row in self._query("SELECT id, name, type FROM topics"):
            number, name, kind = row
            if not isinstance(name, str) or not isinstance(kind, str):
                got = f"{str(name)[:40]!r} of type {str(kind)[:40]!r}"
                raise FormatError(f"expected texts as names of topics, got {got}")
            count = counts.get(number, 0)
            self.connections.append(
                Connection(
                    number, name, kind, NO_DEFINITION, "", count, extension, self
                )
            )
            check_topics(len(self.connections))

    def _rows(
        self, wanted: Iterable[int], start: int | None, stop: int | None
    ) -> Iterator[tuple[int, int, int]]:
        """Yield time, ns, topic and row of messages in the order of time."""
        numbers = list(wanted)
        places = ",".join("?" * len(numbers))
        query = f"SELECT timestamp, topic_id, rowid FROM messages WHERE topic_id IN ({places})"
        if start is not None:
            query += " AND timestamp >= ?"
            numbers.append(start)
        if stop is not None:
            query += " AND timestamp < ?"
            numbers.append(stop)
        for time, topic, row in self._query(f"{query} ORDER BY timestamp", numbers):
            if not isinstance(time, int):
                raise FormatError("a message has no time")
            yield time, topic, row

    def _data_of(self, row: int) -> bytes:
        for (data,) in self._query(
            "SELECT data FROM messages WHERE rowid = ?", [row]
        ):
            if not isinstance(data, bytes):
                got = type(data).__name__
                raise FormatError(f"a message is no bytes, but of type {got}")
            return data
        raise rosbag2.ReaderError("a message is gone")

    def _query(self, text: str, values: list[int] | None = None) -> Iterator[Any]:
        """Yield rows; the steps to each of them are limited."""
        if self.dbconn is None:
            raise rosbag2.ReaderError("the database is closed")
        self._steps.begin()
        for row in self.dbconn.execute(text, values):
            yield row
            self._steps.begin()


# -- limits ----------------------------------------------------------------------------


def check_chunk(size: int) -> None:
    """Raise a FormatError where a chunk is too large."""
    if size > MAX_CHUNK_BYTES:
        raise FormatError(
            f"a chunk has {size} bytes: expected at most {MAX_CHUNK_BYTES}"
        )


def check_messages(count: int) -> None:
    """Raise a FormatError where a chunk holds too many messages."""
    if count > MAX_CHUNK_MESSAGES:
        raise FormatError(
            f"a chunk has {count} messages: expected at most {MAX_CHUNK_MESSAGES}"
        )


def check_topics(count: int) -> None:
    """Raise a FormatError where a bag has too many topics."""
    if count > MAX_TOPICS:
        raise FormatError(f"it has {count} topics: expected at most {MAX_TOPICS}")
