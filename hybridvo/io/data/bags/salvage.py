"""Readers of bags that were cut off: each takes what is whole and goes without the index.

A recorder that is killed, or a disk that is full, leaves a bag without its last part, and that
holds the index. These readers extend those of whole bags, and have their limits.
"""

from __future__ import annotations

import contextlib
import io
import mmap
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import apsw
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2.metadata import ReaderMetadata
from rosbags.typesys.msg import normalize_msgtype

from hybridvo.core.errors import FormatError
from hybridvo.io.data.bags.storage import (
    MCAP_CHUNK,
    MCAP_FOOTER,
    MCAP_HEAD,
    NO_DEFINITION,
    BoundedBag1,
    BoundedMcap,
    BoundedSqlite,
    check_chunk,
    check_messages,
    check_topics,
    chunk_content,
    chunk_info,
)
from hybridvo.io.data.bags.unpacking import MAX_LINE_BYTES, unpack

MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_DATA_END = 15
COUNT_OF_CONNECTION = struct.Struct("<II")
"""What the index of a ROS 1 bag states of a connection in a chunk: its number, its messages."""
SQLITE_PAGE = 4096  # bytes
CHUNK_MARK = b"\x04\x00\x00\x00op=\x05"
"""In the header of every chunk of a ROS 1 bag: a field of four bytes."""
LONGEST_CHUNK_HEADER = 128  # bytes
MAX_MARKS = 10_000
"""Such marks that are looked at behind damage: the data of a stranger may be full of them."""
MAX_DEFINITION_BYTES = 2**24
LAST_ROWS = 100
"""Rows at the end of a cut database of which data may be missing: a page of the tree names ten."""


class CutBag1(BoundedBag1):
    """A ROS 1 bag without an index: all chunks are looked through.

    Attributes:
        stated_counts: number of a connection -> how many messages it had, as far as the index can
            be read.
        stated_times: when chunks began and ended, ns, by the index.
    """

    def open(self) -> None:
        """Find the messages of all chunks that are whole, and those before a cut in one."""
        self.stated_counts: dict[int, int] = defaultdict(int)
        self.stated_times = list[int]()
        self._marks_left = MAX_MARKS
        self.bio = self.path.open("rb")
        if not self.bio.readline(MAX_LINE_BYTES).startswith(b"#ROSBAG V2.0"):
            self.close()
            raise rosbag1.ReaderError("it does not begin as a ROS 1 bag")
        end = self.path.stat().st_size
        found: dict[int, Connection] = {}
        indexes: dict[int, list[Any]] = defaultdict(list)
        while True:
            place = self.bio.tell()
            try:
                header = ros1.Header.read(self.bio)
                size = ros1.read_uint32(self.bio)
                is_chunk = header.get_uint8("op") == ros1.RecordType.CHUNK
                data_place = self.bio.tell()
                if is_chunk:
                    self._take_chunk(place, header, size, end, found, indexes)
                else:
                    self._take_index_record(header, size, found)
                is_whole = data_place + size <= end
            # bytes that are no record, or a part of one
            except (rosbag1.ReaderError, ValueError):
                is_whole = False
            if is_whole:
                self.bio.seek(data_place + size)
            elif not self._seek_next_chunk(place):
                break
        for each in indexes.values():
            each.sort()
        self.indexes = {number: indexes[number] for number in found}
        self.connections = [
            connection._replace(msgcount=len(indexes[number]))
            for number, connection in found.items()
        ]

    def _take_chunk(
        self,
        place: int,
        header: ros1.Header,
        size: int,
        end: int,
        found: dict[int, Connection],
        indexes: dict[int, list[Any]],
    ) -> None:
        """Index the messages of one chunk."""
        data_place = self.bio.tell()  # type: ignore[union-attr]
        size = min(size, end - data_place)
        compression = header.get_string("compression")
        check_chunk(size)
        packed = self.bio.read(size)  # type: ignore[union-attr]
        try:
            content = unpack(packed, compression)
        # each library raises errors of its own for a part of its data
        except Exception as error:
            raise rosbag1.ReaderError(f"a chunk is damaged ({error})") from None
        times = self._index_messages(io.BytesIO(content), place, found, indexes)
        self.chunks[place] = ros1.Chunk(
            size, data_place, partial(unpack, packing=compression)
        )
        if times:
            self.chunk_infos.append(
                ros1.ChunkInfo(place, min(times), max(times) + 1, {})
            )

    def _take_index_record(
        self, header: ros1.Header, size: int, found: dict[int, Connection]
    ) -> None:
        """Take what a record outside of chunks states: a connection, or what a chunk held."""
        op = header.get_uint8("op")
        is_connection = op == ros1.RecordType.CONNECTION
        if not is_connection and op != ros1.RecordType.CHUNK_INFO:
            return
        if size > MAX_DEFINITION_BYTES:
            raise rosbag1.ReaderError("a record of the index is too long")
        data = ros1.read_bytes(self.bio, size)  # type: ignore[arg-type]
        if is_connection:
            number = header.get_uint32("conn")
            found.setdefault(number, self._connection(header, number, data))
            return
        whole = len(data) - len(data) % COUNT_OF_CONNECTION.size
        for number, count in COUNT_OF_CONNECTION.iter_unpack(data[:whole]):
            self.stated_counts[number] += count
        self.stated_times.append(header.get_time("start_time"))
        self.stated_times.append(header.get_time("end_time"))

    def _seek_next_chunk(self, place: int) -> bool:
        """Go to the next record behind a place that can be a chunk; whether there is one."""
        if self.bio is None:
            return False
        with mmap.mmap(self.bio.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = content.find(CHUNK_MARK, place + 1)
            while at >= 0 and self._marks_left > 0:
                self._marks_left -= 1
                first = max(at - LONGEST_CHUNK_HEADER, place + 1)
                for start in range(at - 4, first - 1, -1):
                    (length,) = struct.unpack_from("<I", content, start)
                    reaches = start + 4 + length >= at + len(CHUNK_MARK)
                    if reaches and length <= LONGEST_CHUNK_HEADER:
                        self.bio.seek(start)
                        if self._is_chunk():
                            self.bio.seek(start)
                            return True
                at = content.find(CHUNK_MARK, at + 1)
        return False

    def _is_chunk(self) -> bool:
        """Whether the header of a chunk comes next in the file."""
        with contextlib.suppress(rosbag1.ReaderError, ValueError):
            header = ros1.Header.read(self.bio)  # type: ignore[arg-type]
            is_chunk = header.get_uint8("op") == ros1.RecordType.CHUNK
            return is_chunk and {"compression", "size"} <= header.keys()
        return False

    def _index_messages(
        self,
        content: BinaryIO,
        place: int,
        found: dict[int, Connection],
        indexes: dict[int, list[Any]],
    ) -> list[int]:
        """Index the whole messages of a chunk's content; returns their times, ns."""
        times = list[int]()
        while True:
            offset = content.tell()
            try:
                header = ros1.Header.read(content)
                data = ros1.read_bytes(content, ros1.read_uint32(content))
                op = header.get_uint8("op")
                number = header.get_uint32("conn")
                if op == ros1.RecordType.CONNECTION:
                    found.setdefault(number, self._connection(header, number, data))
                    check_topics(len(found))
                elif op == ros1.RecordType.MSGDATA:
                    time = header.get_time("time")
                    indexes[number].append(ros1.IndexData(time, place, offset))
                    times.append(time)
                    check_messages(len(times))
            except (rosbag1.ReaderError, ValueError):
                return times

    def _connection(
        self, header: ros1.Header, number: int, data: bytes
    ) -> Connection:
        # the data is a header without its length
        described = ros1.Header.read(
            io.BytesIO(struct.pack("<I", len(data)) + data)
        )
        return Connection(
            number,
            ros1.normalize(header.get_string("topic")),
            normalize_msgtype(described.get_string("type")),
            NO_DEFINITION,
            "",
            0,
            ConnectionExtRosbag1(None, None),
            self,
        )


class CutMcap(BoundedMcap):
    """An mcap file without its summary: all records are looked through."""

    # the summary, which would state them, is lost
    stated_counts: Mapping[int, int] = {}
    stated_times: Sequence[int] = ()

    def _open(self) -> None:
        """Find the channels, and the chunks or messages that are whole."""
        if self.bio is None or self.bio.read(8) != MCAP_MAGIC:
            raise rosbag2.ReaderError("it does not begin as an mcap file")
        self.data_start = self.bio.tell()
        self.data_end, chunks = self._whole_records()
        self.meta_scan()
        self.chunks = chunks
        statistics = self.statistics
        counts = {} if statistics is None else statistics.channel_message_counts
        self.connections = [
            connection._replace(msgcount=counts.get(connection.id, 0))
            for connection in self.connections
        ]
        if statistics is not None and statistics.message_count:
            self.metadata = ReaderMetadata(
                statistics.end_time - statistics.start_time + 1,
                statistics.start_time,
                statistics.end_time + 1,
                statistics.message_count,
                None,
                None,
                None,
                None,
            )

    def _whole_records(self) -> tuple[int, list[mcap.ChunkInfo]]:
        """Where the first record begins that is not whole, and the chunks before."""
        chunks = list[mcap.ChunkInfo]()
        bio = self.bio
        size_of_file = self.path.stat().st_size
        while bio is not None:
            place = bio.tell()
            head = bio.read(MCAP_HEAD.size)
            if len(head) < MCAP_HEAD.size:
                return place, chunks
            op, size = MCAP_HEAD.unpack(head)
            content = place + MCAP_HEAD.size
            # what follows the end of the data is a summary
            is_last = op in (0, MCAP_FOOTER, MCAP_DATA_END)
            if is_last or content + size > size_of_file:
                return place, chunks
            if op == MCAP_CHUNK:
                chunk = _whole_chunk(content, bio.read(size))
                if chunk is None:
                    return place, chunks
                chunks.append(chunk)
            bio.seek(content + size)
        return self.data_start, chunks


def _whole_chunk(place: int, record: bytes) -> mcap.ChunkInfo | None:
    """What the index states of a chunk that is whole; None for a damaged one."""
    try:
        return chunk_info(place, record, chunk_content(record))
    # each library raises errors of its own for damaged data
    except Exception:
        return None


class CutSqlite(BoundedSqlite):
    """A database of a ROS 2 bag whose last pages are missing: rows are read until one is gone."""

    # no table states them
    stated_counts: Mapping[int, int] = {}
    stated_times: Sequence[int] = ()

    def _restrict(self, connection: apsw.Connection) -> None:
        """Let the file run nothing, once reading has begun."""
        super()._restrict(connection)
        self._begin(connection)

    def _begin(self, connection: apsw.Connection) -> None:
        """Begin to read a file that is shorter than its first page states.

        SQLite refuses such a file, but for the setting by which a broken schema may be repaired.
        It looks when reading begins: then the setting is taken back.
        """
        connection.config(apsw.SQLITE_DBCONFIG_DEFENSIVE, 0)
        connection.execute("PRAGMA writable_schema=ON")
        connection.execute("BEGIN")
        connection.execute("PRAGMA schema_version").fetchall()
        connection.execute("PRAGMA writable_schema=OFF")
        connection.config(apsw.SQLITE_DBCONFIG_DEFENSIVE, 1)

    def _query(self, text: str, values: list[int] | None = None) -> Iterator[Any]:
        """Yield rows; what comes to a missing page ends, and others can still be read."""
        try:
            yield from super()._query(text, values)
        except apsw.Error:
            if self.dbconn is not None and not self.dbconn.in_transaction:
                self._begin(self.dbconn)
            raise

    def _counts(self) -> dict[int, int]:
        """Count the messages that can still be reached."""
        self._reachable = self._reachable_rows()
        counts: dict[int, int] = defaultdict(int)
        for _, topic, _ in self._reachable:
            counts[topic] += 1
        if self._reachable:
            first = self._reachable[0][0]
            last = self._reachable[-1][0]
            self._take_times(first, last, len(self._reachable))
        return counts

    def _rows(
        self, wanted: Iterable[int], start: int | None, stop: int | None
    ) -> Iterator[tuple[int, int, int]]:
        """Yield time, ns, topic and row of messages in the order of time."""
        numbers = set(wanted)
        for time, topic, row in self._reachable:
            is_early = start is not None and time < start
            is_late = stop is not None and time >= stop
            if topic in numbers and not is_early and not is_late:
                yield time, topic, row

    def _reachable_rows(self) -> list[tuple[int, int, int]]:
        """Time, ns, topic and row of the messages that can be read, in the order of time."""
        rows = list[tuple[int, int, int]]()
        query = "SELECT timestamp, topic_id, rowid FROM messages NOT INDEXED"
        # the last byte: the data of the row can be read as well
        query = f"{query} WHERE substr(data, -1) IS NOT NULL ORDER BY rowid"
        with contextlib.suppress(apsw.Error):
            for row in self._query(query):
                if all(isinstance(value, int) for value in row):
                    rows.append(row)
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
    reader = kinds.get(path.suffix.lower(), CutBag1)(path)
    try:
        reader.open()
    # damaged files raise errors of many kinds
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise FormatError(
            f"{path}: damaged: nothing can be read ({reason})."
        ) from None
    return reader
