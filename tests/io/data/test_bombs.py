"""Files of strangers that unpack to gigabytes, never end, or run: refused at little cost."""

from __future__ import annotations

import bz2
import json
import os
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import yaml

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

from hybridvo import Camera, open_sequence
from hybridvo.core.errors import FormatError, InputError
from hybridvo.io.data.bags import tape
from hybridvo.io.data.confined import limits
from hybridvo.io.data.record3d.lzfse import unpacked_size
from hybridvo.run.cli import main
from tests import bags

MEGABYTE = 10**6
BOMB = 1000 * MEGABYTE
"""Bytes to which a bomb unpacks."""


@pytest.fixture
def little(read_here: None) -> Iterator[None]:
    """Fails where a test needs much memory in this process, which reads the file."""
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300 * MEGABYTE, f"{peak / MEGABYTE:.0f} MB"


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        sequence = open_sequence(path)
        for i in range(len(sequence)):
            sequence[i]
    message = str(caught.value)
    assert "\n" not in message and len(message) < 2100
    return message


# -- what is packed ----------------------------------------------------------------


@cache
def zstd_bomb() -> bytes:
    packer = zstd.ZstdCompressor()
    parts = [packer.compress(bytes(MEGABYTE)) for _ in range(BOMB // MEGABYTE)]
    return b"".join(parts) + packer.flush()


@cache
def lz4_bomb() -> bytes:
    return lz4.frame.compress(bytes(10 * MEGABYTE)) * (BOMB // (10 * MEGABYTE))


@cache
def bz2_bomb() -> bytes:
    return bz2.compress(bytes(10 * MEGABYTE)) * (BOMB // (10 * MEGABYTE))


# -- chunks ------------------------------------------------------------------------


def mcap_text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def mcap_record(op: int, content: bytes) -> bytes:
    return struct.pack("<BQ", op, len(content)) + content


def mcap_records(data: bytes) -> list[tuple[int, bytes]]:
    records = []
    place = 0
    while place + 9 <= len(data):
        op, length = struct.unpack_from("<BQ", data, place)
        records.append((op, data[place + 9 : place + 9 + length]))
        place += 9 + length
    return records


def mcap_chunk(packing: str, packed: bytes, size: int) -> bytes:
    head = struct.pack("<QQQI", 1, 2, size, 0) + mcap_text(packing)
    return mcap_record(6, head + struct.pack("<Q", len(packed)) + packed)


def mcap_file(path: Path, *records: bytes) -> Path:
    magic = b"\x89MCAP0\r\n"
    header = mcap_record(1, mcap_text("ros2") + mcap_text("x"))
    footer = mcap_record(2, bytes(20))
    path.write_bytes(magic + header + b"".join(records) + footer + magic)
    return path


@pytest.mark.parametrize("stated", [BOMB, 1000])
@pytest.mark.parametrize("packing", ["zstd", "lz4"])
def test_a_chunk_of_mcap_that_unpacks_to_a_gigabyte(
    packing: str, stated: int, tmp_path: Path
) -> None:
    packed = zstd_bomb() if packing == "zstd" else lz4_bomb()
    chunk = mcap_chunk(packing, packed, stated)
    assert "drive" in refusal(mcap_file(tmp_path / "drive.mcap", chunk))


def test_frames_before_a_bomb_are_read(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    end = data.rindex(mcap_record(15, bytes(4)))
    bomb = mcap_chunk("zstd", zstd_bomb(), BOMB)
    file.write_bytes(data[:end] + bomb)
    sequence = open_sequence(path)
    np.testing.assert_array_equal(sequence[4].rgb, bags.rgb(4))
    assert any("damaged or cut off" in text for text in sequence.warnings)


def test_an_index_of_mcap_that_names_a_chunk_many_times(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    summary = int.from_bytes(data[-28:-20], "little")
    before = data[:summary]
    tables = [mcap_record(*each) for each in mcap_records(data[summary:-8])]
    index = next(each for each in tables if each[0] == 8)
    file.write_bytes(before + 500 * index + b"".join(tables) + data[-8:])
    np.testing.assert_array_equal(open_sequence(path)[3].rgb, bags.rgb(3))


def test_chunks_without_an_index_of_messages_are_read(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    file = next(path.glob("*.mcap"))
    data = file.read_bytes()
    summary = int.from_bytes(data[-28:-20], "little")
    changed = data[:summary]
    for op, content in mcap_records(data[summary:-8]):
        if op == 8:
            length = int.from_bytes(content[32:36], "little")
            content = content[:32] + bytes(4) + content[36 + length :]
        changed += mcap_record(op, content)
    file.write_bytes(changed + data[-8:])
    np.testing.assert_array_equal(open_sequence(path)[3].rgb, bags.rgb(3))


def ros1_record(header: dict[str, bytes], data: bytes) -> bytes:
    fields = [name.encode() + b"=" + value for name, value in header.items()]
    head = b"".join(struct.pack("<I", len(field)) + field for field in fields)
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def ros1_bag(
    path: Path, packing: str, packed: bytes, size: int, entries: bytes = bytes(12)
) -> Path:
    """A bag of one chunk and one topic."""
    number = struct.pack("<I", 0)
    one = struct.pack("<I", 1)
    place = 13 + 4096
    chunk = ros1_record(
        {
            "op": b"\x05",
            "compression": packing.encode(),
            "size": struct.pack("<I", size),
        },
        packed,
    )
    count = struct.pack("<I", len(entries) // 12)
    index = ros1_record(
        {"op": b"\x04", "ver": one, "conn": number, "count": count}, entries
    )
    described = ros1_record(
        {
            "topic": bags.RGB.encode(),
            "type": b"sensor_msgs/Image",
            "md5sum": b"*",
            "message_definition": b"",
        },
        b"",
    )
    connection = ros1_record(
        {"op": b"\x07", "conn": number, "topic": bags.RGB.encode()},
        described[4:-4],
    )
    chunk_info = ros1_record(
        {
            "op": b"\x06",
            "ver": one,
            "chunk_pos": struct.pack("<Q", place),
            "start_time": bytes(8),
            "end_time": bytes(8),
            "count": one,
        },
        number + count,
    )
    header = {
        "op": b"\x03",
        "index_pos": struct.pack("<Q", place + len(chunk) + len(index)),
        "conn_count": one,
        "chunk_count": one,
    }
    padding = 4096 - len(ros1_record(header, b""))
    start = b"#ROSBAG V2.0\n" + ros1_record(header, b" " * padding)
    path.write_bytes(start + chunk + index + connection + chunk_info)
    return path


@pytest.mark.parametrize("packing", ["bz2", "lz4"])
def test_a_chunk_of_ros1_that_unpacks_to_a_gigabyte(
    packing: str, tmp_path: Path
) -> None:
    packed = bz2_bomb() if packing == "bz2" else lz4_bomb()
    path = ros1_bag(tmp_path / "drive.bag", packing, packed, BOMB)
    assert "drive.bag" in refusal(path)


def test_an_index_of_ros1_that_names_messages_many_times(tmp_path: Path) -> None:
    entries = b"".join(struct.pack("<III", 1, 0, 50 * i) for i in range(15))
    path = tmp_path / "drive.bag"
    ros1_bag(path, "none", bytes(1000), 1000, 20_000 * entries)
    assert "drive.bag" in refusal(path)


@pytest.mark.slow
def test_a_record_that_states_the_size_of_a_disk(tmp_path: Path) -> None:
    path = mcap_file(tmp_path / "drive.mcap")
    head = path.read_bytes()[:-37]
    path.write_bytes(head + struct.pack("<BQ", 5, 2**40))
    os.truncate(path, 2**41)  # sparse: takes no room
    assert "drive.mcap" in refusal(path)
    path = tmp_path / "drive.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + struct.pack("<I", 2**32 - 1))
    os.truncate(path, 2**32 + 2**20)
    assert "drive.bag" in refusal(path)


def test_large_messages_are_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    monkeypatch.setattr(tape, "KEPT_BYTES", 1000)
    sequence = open_sequence(path, trust=True)
    for i in (0, 1, 4, 2):
        np.testing.assert_array_equal(sequence[i].rgb, bags.rgb(i))
        np.testing.assert_allclose(sequence[i].depth, bags.millimetres(i) / 1000)
    kept = sequence._tape._kept.values()
    assert max(len(messages) for messages in kept) <= 1


# -- bags that are packed by file or by message --------------------------------------


def packed_bag(root: Path, kind: str, mode: str) -> Path:
    """A bag as ``ros2 bag record --compression-mode file`` or ``message`` writes it."""
    path = bags.plain_bag(root, kind)
    metadata = path / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    stated = content["rosbag2_bagfile_information"]
    stated["compression_mode"] = mode.upper()
    stated["compression_format"] = "zstd"
    file = next(each for each in path.iterdir() if each != metadata)
    if mode == "file":
        packed = Path(f"{file}.zstd")
        packed.write_bytes(zstd.compress(file.read_bytes()))
        file.unlink()
        stated["relative_file_paths"] = [packed.name]
    else:
        with closing(sqlite3.connect(file)) as database, database:
            rows = database.execute("SELECT id, data FROM messages").fetchall()
            database.executemany(
                "UPDATE messages SET data = ? WHERE id = ?",
                [(zstd.compress(data), number) for number, data in rows],
            )
    metadata.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    ("kind", "mode"),
    [("sqlite3", "file"), ("mcap", "file"), ("sqlite3", "message")],
)
def test_packed_bags_are_recognised_and_read(
    kind: str, mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    path = packed_bag(tmp_path, kind, mode)
    sequence = open_sequence(path, trust=True)
    assert len(sequence) == bags.FRAMES
    np.testing.assert_array_equal(sequence[4].rgb, bags.rgb(4))
    if mode == "file":
        assert list(scratch.iterdir())
        (packed,) = path.glob("*.zstd")
        assert packed in sequence.files()
    del sequence
    assert not list(scratch.iterdir())
    if mode == "file":
        np.testing.assert_array_equal(open_sequence(packed)[1].rgb, bags.rgb(1))


def test_a_packed_file_that_would_fill_the_disk(
    tmp_path: Path,
) -> None:
    path = packed_bag(tmp_path, "sqlite3", "file")
    (packed,) = path.glob("*.zstd")
    packed.write_bytes(zstd.compress(bytes(BOMB)))
    assert "more than a recording does" in refusal(path)
    # it states nothing
    packed.write_bytes(zstd_bomb())
    assert "more than a recording does" in refusal(path)


@pytest.mark.usefixtures("read_here")
@pytest.mark.parametrize("is_stated", [True, False])
def test_packed_files_that_fill_the_disk_together(
    is_stated: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    path = packed_bag(tmp_path, "sqlite3", "file")
    (path / "metadata.yaml").unlink()
    (packed,) = path.glob("*.zstd")
    # each by itself is a recording of a useful size
    plain = zstd.decompress(packed.read_bytes()).ljust(40 * MEGABYTE, b"\0")
    content = zstd.compress(plain)
    if not is_stated:
        packer = zstd.ZstdCompressor()
        content = packer.compress(plain) + packer.flush()
    for number in range(4):
        (path / f"part_{number}.db3.zstd").write_bytes(content)
    said = refusal(path)
    assert "of all packed files of the bag" in said
    assert not list(scratch.iterdir())


def test_a_packed_message_that_unpacks_to_a_gigabyte(tmp_path: Path) -> None:
    path = packed_bag(tmp_path, "sqlite3", "message")
    changed(path, "UPDATE messages SET data = ?", zstd_bomb())
    assert "no frames" in refusal(path)


HOLDS_A_BAG = """
import os, sys
from pathlib import Path
from hybridvo import open_sequence
sequence = open_sequence(sys.argv[1])
print(sequence._child._forked.pid, flush=True)
sys.stdin.readline()
"""


@pytest.mark.skipif(not limits.is_available(), reason="no child process here")
@pytest.mark.parametrize("killed", ["child", "process", "nothing"])
def test_what_was_unpacked_is_removed_whoever_is_killed(
    killed: str, tmp_path: Path
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    path = packed_bag(tmp_path, "sqlite3", "file")
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS_A_BAG, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"TMPDIR": str(scratch)},
    )
    assert process.stdin is not None and process.stdout is not None
    with process:
        child = int(process.stdout.readline())
        assert list(scratch.rglob("*.db3"))
        if killed != "nothing":
            os.kill(child if killed == "child" else process.pid, signal.SIGKILL)
        process.stdin.close()
    deadline = time.monotonic() + 20
    while list(scratch.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not list(scratch.iterdir())


# -- databases -----------------------------------------------------------------------


def changed(path: Path, *statements: object) -> Path:
    """Run statements on the database of a bag; what follows a text are its values."""
    (file,) = path.glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        text = ""
        for each in statements:
            if isinstance(each, str):
                text = each
            if "?" not in text:
                database.executescript(text)
            elif not isinstance(each, str):
                database.execute(text, (each,))
    return path


ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM c) SELECT"
VIEWS = {
    "topics": f"""CREATE VIEW topics AS {ENDLESS} x AS id, 'a' AS name, 'b' AS type,
        'cdr' AS serialization_format, '' AS offered_qos_profiles,
        '' AS type_description_hash FROM c""",
    "message_definitions": f"""CREATE VIEW message_definitions AS {ENDLESS} x AS id,
        'a' AS topic_type, 'b' AS encoding, '' AS encoded_message_definition,
        '' AS type_description_hash FROM c""",
}


OTHER_MESSAGES = """ALTER TABLE messages RENAME TO aside;
    CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);
    INSERT INTO messages"""
OTHER_TOPICS = """ALTER TABLE topics RENAME TO aside;
    CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format);
    INSERT INTO topics"""
NO_MESSAGE = "a message has no time or no data"


@pytest.mark.parametrize("name", VIEWS)
def test_a_view_that_never_ends(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "CPU_S", 1)
    path = bags.plain_bag(tmp_path, "sqlite3")
    changed(path, f"ALTER TABLE {name} RENAME TO aside; {VIEWS[name]}")
    assert "drive" in refusal(path)


def test_the_topics_of_a_hostile_bag_are_looked_for_in_a_child(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(limits, "CPU_S", 1)
    path = bags.plain_bag(tmp_path, "sqlite3")
    changed(path, f"ALTER TABLE topics RENAME TO aside; {VIEWS['topics']}")
    assert main(["topics", str(path)]) == 2
    assert "more than 1 s of processor time" in capsys.readouterr().err


def test_a_column_that_is_computed(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "sqlite3")
    columns = "id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER"
    bomb = "data BLOB GENERATED ALWAYS AS (zeroblob(900000000))"
    changed(
        path,
        f"""ALTER TABLE messages RENAME TO aside;
        CREATE TABLE messages({columns}, {bomb});
        INSERT INTO messages SELECT id, topic_id, timestamp FROM aside""",
    )
    assert "no frames" in refusal(path)


@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        ("UPDATE messages SET data = 2000000000", NO_MESSAGE),
        ("UPDATE messages SET data = 'text'", NO_MESSAGE),
        ("UPDATE messages SET timestamp = 'noon' WHERE id = 3", NO_MESSAGE),
        (
            f"{OTHER_MESSAGES} SELECT id, topic_id, NULL, data FROM aside",
            NO_MESSAGE,
        ),
        (
            f"{OTHER_TOPICS} SELECT id, 7, type, '' FROM aside",
            "a topic has no name",
        ),
    ],
)
def test_rows_of_other_types_than_expected(
    statement: str, reason: str, tmp_path: Path
) -> None:
    path = changed(bags.plain_bag(tmp_path, "sqlite3"), statement)
    try:
        said = " ".join(open_sequence(path).warnings)
    except InputError as error:
        said = str(error)
    assert reason in said


# -- metadata.yaml -------------------------------------------------------------------


LAUGHS = "a0: &a0 [x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
STATED = "rosbag2_bagfile_information:\n"


@pytest.mark.parametrize(
    "text",
    [
        f"{LAUGHS}{STATED}  compression_mode: file\n  compression_format: *a8\n",
        f"{STATED}  compression_mode: {'x' * 2 * MEGABYTE}\n",
        f"{STATED}  files: {'[' * 5000}\n",
        f"{STATED}  topics_with_message_count: [{'1, ' * 60_000}]\n",
        "\xff\x00",
        "just text",
    ],
)
def test_metadata_that_would_last_are_left_aside(text: str, tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "sqlite3")
    (path / "metadata.yaml").write_text(text, "latin-1")
    sequence = open_sequence(path)
    np.testing.assert_array_equal(sequence[2].rgb, bags.rgb(2))
    assert any("metadata.yaml" in text for text in sequence.warnings)


def test_metadata_of_odd_types(tmp_path: Path) -> None:
    path = bags.plain_bag(tmp_path, "mcap")
    metadata = path / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    stated = content["rosbag2_bagfile_information"]
    stated["topics_with_message_count"][0]["topic_metadata"]["name"] = ["a", ["b"]]
    stated["relative_file_paths"] += [
        ["list"],
        7,
        "../../../etc/passwd",
        "gone.mcap",
    ]
    metadata.write_text(yaml.safe_dump(content))
    sequence = open_sequence(path)
    assert len(sequence) == bags.FRAMES
    assert sum("is not there" in text for text in sequence.warnings) == 4


# -- pipes ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["x.mcap", "x.db3", "x.mcap.zstd", "metadata.yaml"]
)
def test_a_pipe_in_the_folder_of_a_bag(name: str, tmp_path: Path) -> None:
    alone = tmp_path / "alone"
    alone.mkdir()
    os.mkfifo(alone / name)
    assert "not a layout that is read" in refusal(alone)
    path = bags.plain_bag(tmp_path, "mcap")
    metadata = path / "metadata.yaml"
    if name == metadata.name:
        metadata.unlink()
    else:
        metadata.write_text(metadata.read_text().replace("drive.mcap", name))
    os.mkfifo(path / name)
    np.testing.assert_array_equal(open_sequence(path)[2].rgb, bags.rgb(2))
    for ending in (".mcap", ".db3", ".bag"):
        device = tmp_path / f"device{ending}"
        device.symlink_to("/dev/zero")
        assert "got a pipe or a device" in refusal(device)


# -- arrays --------------------------------------------------------------------------


def npy_header(shape: str, dtype: str = "|u1") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    padded = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded


def zeros_after(header: bytes, size: int) -> Iterator[bytes]:
    yield header
    for _ in range(size // MEGABYTE):
        yield bytes(MEGABYTE)


SMALL: dict[str, np.ndarray] = {
    "rgb": np.zeros((3, 12, 16, 3), np.uint8),
    "depth": np.ones((3, 12, 16), np.float32),
    "K": np.array([[20.0, 0, 7.5], [0, 20, 5.5], [0, 0, 1]]),
    "timestamps": np.arange(3.0),
    "poses": np.tile(np.eye(4), (3, 1, 1)),
}


def stack(path: Path, name: str, pieces: Iterator[bytes]) -> Path:
    """An ``.npz`` file of which one array is another one."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for other, array in SMALL.items():
            if other != name:
                with file.open(f"{other}.npy", "w") as part:
                    np.save(part, array)
        with file.open(f"{name}.npy", "w", force_zip64=True) as part:
            for piece in pieces:
                part.write(piece)
    return path


@pytest.mark.parametrize(
    ("name", "shape", "dtype", "reason"),
    [
        ("K", "(25000000,)", "<f8", r"K: expected shape"),
        ("timestamps", "(25000000,)", "<f8", r"timestamps: expected shape"),
        ("poses", "(12500000, 4, 4)", "|u1", r"poses: expected shape"),
        ("depth_scale", "(200000000,)", "|u1", r"depth_scale: expected shape"),
        ("rgb", "(200, 1000, 1000)", "|u1", r"bytes are too many to unpack"),
        ("depth", "(200, 1000, 1000)", "|u1", r"depth: expected shape"),
        ("rgb", "(10,)", "|V20000000", r"rgb: expected numbers"),
    ],
)
def test_an_array_is_looked_at_before_it_is_unpacked(
    name: str, shape: str, dtype: str, reason: str, tmp_path: Path, little: None
) -> None:
    pieces = zeros_after(npy_header(shape, dtype), 200 * MEGABYTE)
    path = stack(tmp_path / "walk.npz", name, pieces)
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    with pytest.raises(FormatError, match=reason):
        open_sequence(path)
    assert tracemalloc.get_traced_memory()[1] - before < 20 * MEGABYTE


def test_a_header_of_an_array_that_is_long(tmp_path: Path, little: None) -> None:
    header = b"\x93NUMPY\x02\x00" + struct.pack("<I", 200 * MEGABYTE)
    pieces = zeros_after(header, 200 * MEGABYTE)
    path = stack(tmp_path / "walk.npz", "K", pieces)
    with pytest.raises(FormatError, match="its header states 200000000 bytes"):
        open_sequence(path)


def test_a_matrix_of_any_size_makes_a_short_message() -> None:
    with pytest.raises(InputError) as caught:
        Camera.from_matrix(np.zeros(10**6), 10, 10)
    assert "an array of shape (1000000,)" in str(caught.value)


# -- Record3D ------------------------------------------------------------------------


def phone(
    path: Path, name: str, pieces: Iterator[bytes], **changes: object
) -> Path:
    """A recording of which one file is another one."""
    K = [30.0, 0, 0, 0, 30.0, 0, 7.5, 5.5, 1]
    stated = {"K": K, "w": 16, "h": 12, "dw": 8, "dh": 6} | changes
    image = cv2.imencode(".jpg", np.zeros((12, 16, 3), np.uint8))[1].tobytes()
    depth = b"bvx-" + struct.pack("<I", 192) + bytes(192) + b"bvx$"
    files = {
        "metadata": json.dumps(stated).encode(),
        "rgbd/0.jpg": image,
        "rgbd/0.depth": depth,
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for other, content in files.items():
            if other != name:
                file.writestr(other, content)
        with file.open(name, "w") as part:
            for piece in pieces:
                part.write(piece)
    return path


@pytest.mark.parametrize(
    ("name", "limit"), [("metadata", 2**23), ("rgbd/0.jpg", 2**26)]
)
def test_a_file_of_a_phone_that_unpacks_to_much(
    name: str, limit: int, tmp_path: Path, little: None
) -> None:
    pytest.importorskip("liblzfse", reason="extra record3d")
    path = phone(tmp_path / "a.r3d", name, zeros_after(b"{", 200 * MEGABYTE))
    assert f"{name}: expected at most {limit} bytes" in refusal(path)


@pytest.mark.parametrize("changes", [{}, {"dw": 0, "dh": 0}])
def test_depth_of_a_phone_that_unpacks_to_much(
    changes: dict[str, object], tmp_path: Path, little: None
) -> None:
    liblzfse = pytest.importorskip("liblzfse", reason="extra record3d")
    packed = liblzfse.compress(bytes(20 * MEGABYTE))
    path = phone(tmp_path / "a.r3d", "rgbd/0.depth", iter([packed]), **changes)
    said = refusal(path)
    assert "unpacks to" in said or "expected at most" in said


def test_what_lzfse_states_is_what_comes_out() -> None:
    liblzfse = pytest.importorskip("liblzfse", reason="extra record3d")
    rng = np.random.default_rng(0)
    metres = np.linspace(1, 4, 256 * 192) + rng.normal(0, 0.01, 256 * 192)
    for content in (
        b"",
        b"x",
        b"abc" * 100,
        bytes(MEGABYTE),
        rng.bytes(300_000),
        metres.astype("f4").tobytes(),
        np.round(metres, 2).astype("f4").tobytes(),
        metres.astype("f2").astype("f4").tobytes() * 6,
    ):
        packed = liblzfse.compress(content)
        assert unpacked_size(packed, max(len(content), 1)) == len(content)
        if len(content) > 1:
            with pytest.raises(FormatError, match="expected at most"):
                unpacked_size(packed, len(content) - 1)
