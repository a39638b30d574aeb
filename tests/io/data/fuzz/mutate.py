"""Recordings that are changed by what their formats mean, one a seed.

Changing bytes at random finds little: nearly all of such files are refused at the first check. So
each function here takes a recording apart as its format has it (messages, members of an archive,
lines), changes what readers believe (lengths, counts, types, names, values), and puts it together
again. What holds the messages of a bag is read by a library: there bytes are changed at random.
"""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import struct
import zipfile
from collections.abc import Callable
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from tests import bags, captures
from tests.io.data.test_record3d import parts
from tests.io.data.test_stereo import euroc_folder
from tests.sequences import write_folder

NUMBERS = (
    *(0, 1, 2, 3, 7, 8, 255, 256, 4096, 65535, 2**20, 2**24),
    *(
        2**28,
        2**31 - 1,
        2**31,
        2**32 - 1,
        2**33,
        2**40,
        2**62,
        2**63 - 1,
        2**64 - 1,
    ),
)
"""Where whole numbers overflow, and sizes that a machine has or has not."""
TEXTS = (
    *("", "a", "\0", "../../etc/passwd", "/dev/zero", "{}", "[]", "*a", "&a [*a]"),
    *("null", ".nan", ".inf", "-1", "1e308", "1e999", "0x10", "1:1:1:1", "true"),
    *("\x1b]0;owned\x07", "\ud7ff", "9" * 400, "[" * 3000, "- " * 2000, "sqlite3"),
    *("FILE", "MESSAGE", "zstd", "lz4", "bz2", "none", "rgb8", "16UC1", "32FC4"),
)
"""Texts that parsers take for something else."""
Rng = np.random.Generator


def pick(rng: Rng, values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


def number(rng: Rng, size: int) -> bytes:
    """A whole number of some bytes."""
    value = pick(rng, NUMBERS)
    if rng.random() < 0.3:
        value = int(rng.integers(2**16))
    return (value % 2 ** (8 * size)).to_bytes(size, "little")


def changed_numbers(rng: Rng, data: bytes, count: int = 1) -> bytes:
    """Some bytes, with numbers of 1 to 8 bytes in them replaced."""
    changed = bytearray(data)
    for _ in range(count):
        size = pick(rng, (1, 2, 4, 4, 8))
        if len(changed) < size:
            break
        # what is read first decides most
        reach = len(changed) if rng.random() < 0.3 else min(len(changed), 200)
        place = int(rng.integers(max(reach - size, 0) + 1))
        changed[place : place + size] = number(rng, size)
    return bytes(changed)


def rearranged(rng: Rng, records: list[bytes]) -> list[bytes]:
    """Records of which one is left out, doubled, moved, cut or repeated often."""
    records = list(records)
    place = int(rng.integers(len(records)))
    other = int(rng.integers(len(records)))
    deed = int(rng.integers(5))
    if deed == 0:
        del records[place]
    elif deed == 1:
        records.insert(other, records[place])
    elif deed == 2:
        records[place], records[other] = records[other], records[place]
    elif deed == 3:
        records[place] = records[place][: len(records[place]) // 2]
    else:
        records[place:place] = [records[place]] * 200
    return records


CAPTURES: dict[str, Callable[[Path], Path]] = {
    "nerfstudio": captures.nerfstudio,
    "nerfcapture": captures.nerfcapture,
    "scannet": captures.scannet,
    "recorder": captures.recorder,
    "replica": partial(captures.replica, scene_name=""),
}
"""Folders of other programs, with texts in them."""


@cache
def folder(kind: str) -> Path:
    """A folder with a whole recording, which is made once."""
    root = Path(mkdtemp(prefix="hybridvo-fuzz-"))
    if kind in bags.FORMATS:
        bags.plain_bag(root, kind, 4)
    elif kind == "euroc":
        captures.with_imu(euroc_folder(root / "seq"))
    elif kind in CAPTURES:
        CAPTURES[kind](root / "seq")
    else:
        write_folder(root)
    return root


# -- bags: whatever a library makes of them -----------------------------------------------------


def storage(rng: Rng, root: Path, kind: str, at: str) -> Path:
    """The file of a bag, with other numbers in it or without its end."""
    path = next(folder(kind).glob(at))
    data = changed_numbers(rng, path.read_bytes(), 3)
    if rng.random() < 0.2:
        data = data[: int(rng.integers(len(data)))]
    return written(root / path.name, data)


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


# -- texts: YAML, lists, JSON -------------------------------------------------------------------


def changed_text(rng: Rng, text: str) -> str:
    """A text of lines in which one value, or one line, is another."""
    lines = text.split("\n")
    place = int(rng.integers(len(lines)))
    deed = rng.random()
    words = re.split(r"([^\s,:\[\]]+)", lines[place])
    if deed < 0.6 and len(words) > 1:
        which = 1 + 2 * int(rng.integers(len(words) // 2))
        new = pick(rng, TEXTS)
        words[which] = str(pick(rng, NUMBERS)) if rng.random() < 0.4 else new
        lines[place] = "".join(words)
    elif deed < 0.7:
        lines[place] = "  " + lines[place]
    elif deed < 0.75:
        lines[place] += " &a " + "[*a" * 20
    elif deed < 0.8:
        layers = [
            f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)
        ]
        lines = ["a0: &a0 [x]", *layers, *lines, "b: *a8"]
    else:
        lines = [
            line.decode() for line in rearranged(rng, [i.encode() for i in lines])
        ]
    return "\n".join(lines)


def changed_folder(rng: Rng, root: Path, kind: str, names: str, at: str) -> Path:
    """A folder in which some of the texts are changed."""
    copied = root / "seq"
    shutil.copytree(next(folder(kind).glob(at)), copied)
    paths = sorted(copied.rglob(names))
    for _ in range(1 + int(rng.integers(2))):
        path = pick(rng, paths)
        text = changed_text(rng, path.read_text(encoding="utf-8"))
        path.write_bytes(text.encode("utf-8", "replace"))
    return copied


# -- archives: members and what is in them -------------------------------------------------------

SHAPES = ("()", "(0,)", "(3,)", "(-1,)", "(4, 24, 32, 3)", "(4, 24, 32)", "(3, 3)")
SIZES = ("(1000000000,)", "(2147483648, 8)", "(99999, 99999)", "(1e9,)", "(None,)")
DTYPES = (
    *(
        "|u1",
        "<u2",
        "<f4",
        "<f8",
        ">f8",
        "|O",
        "|S9",
        "<U4",
        "<M8[s]",
        "|V8",
        "<c16",
    ),
    *("[('a', '<f8')]", "", "x", "|b1", "<f2", "<i8"),
)


def npy(rng: Rng, array: np.ndarray) -> bytes:
    """An array in numpy's format, with a header that may state something else."""
    shape = str(array.shape)
    dtype = array.dtype.str
    deed = int(rng.integers(7))
    if deed == 0:
        shape = pick(rng, SHAPES + SIZES)
    elif deed == 1:
        dtype = pick(rng, DTYPES)
    order = pick(rng, ("False", "False", "False", "True", "None"))
    quoted = dtype if dtype.startswith("[") else repr(dtype)
    text = f"{{'descr': {quoted}, 'fortran_order': {order}, 'shape': {shape}, }}"
    if deed == 2:
        text = pick(rng, TEXTS)
    header = text.encode("latin1", "replace").ljust(117) + b"\n"
    length = struct.pack("<H", len(header))
    version = b"\x01\x00"
    if deed == 3:
        length = number(rng, 2)
    elif deed == 4:
        version = pick(rng, (b"\x02\x00", b"\x03\x00", b"\x09\x00", b"\x00\x00"))
    data = array.tobytes()
    if deed == 5:
        data = data[: int(rng.integers(len(data)))]
    return b"\x93NUMPY" + version + length + header + data


def zipped(rng: Rng, path: Path, members: dict[str, bytes]) -> Path:
    """An archive, whose directory may state something else."""
    packing = pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(path, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    if rng.random() < 0.5:
        return path
    data = bytearray(path.read_bytes())
    marks = (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06")
    places = [m.start() for m in re.finditer(b"|".join(marks), bytes(data))]
    place = pick(rng, places) + 4
    size = pick(rng, (2, 4))
    place += 2 * int(rng.integers(13))
    data[place : place + size] = number(rng, size)
    return written(path, bytes(data))


def arrays(rng: Rng, root: Path) -> Path:
    stacks: dict[str, np.ndarray] = {
        "rgb": rng.integers(0, 255, (4, 24, 32, 3), np.uint8),
        "depth": np.ones((4, 24, 32), np.float32),
        "K": np.array([[40, 0, 15.5], [0, 40, 11.5], [0, 0, 1]]),
        "timestamps": np.arange(4) / 30,
        "poses": np.tile(np.eye(4), (4, 1, 1)),
        "depth_scale": np.array(1000.0),
    }
    whole = np.random.default_rng(5)
    members = {}
    changed = pick(rng, tuple(stacks))
    for name, array in stacks.items():
        if name == changed and rng.random() < 0.3:
            flat = array.reshape(-1).astype(np.float64)
            flat[int(rng.integers(flat.size))] = pick(
                rng, (np.nan, np.inf, -1, 0, 1e308, 1e-308, 2.0**62)
            )
            array = flat.reshape(array.shape)
        generator = rng if name == changed else whole
        content = npy(generator, array) if name == changed else exact_npy(array)
        members[f"{name}.npy"] = content
    if rng.random() < 0.1:
        # a bomb: zeros pack a thousand times
        members[f"{changed}.npy"] += bytes(2**26)
    return zipped(rng, root / "a.npz", members)


def exact_npy(array: np.ndarray) -> bytes:
    from io import BytesIO

    file = BytesIO()
    np.save(file, array)
    return file.getvalue()


def record3d(rng: Rng, root: Path) -> Path:
    members = parts()
    name = pick(rng, tuple(members))
    content = members[name]
    if name != "metadata" or rng.random() < 0.1:
        content = changed_numbers(rng, content, 3)
        members[name] = content
        name = "metadata"
        content = members[name]
    values = None
    if rng.random() < 0.7:
        # bytes of the metadata itself may have been changed before
        with contextlib.suppress(ValueError):
            values = json.loads(content)
    if isinstance(values, dict):
        key = pick(rng, tuple(values))
        values[key] = pick(
            rng,
            (
                *NUMBERS,
                *TEXTS,
                None,
                [],
                {},
                [[]],
                [1] * 9,
                [[0.0] * 7] * 3,
                -1,
                0.5,
            ),
        )
        if rng.random() < 0.2:
            del values[key]
        content = json.dumps(values).encode("ascii", "replace")
    elif rng.random() < 0.2:
        content = b" " * 2**26 + content
    members["metadata"] = content
    return zipped(rng, root / "a.r3d", members)


# -- messages that a driver could have sent ------------------------------------------------------

ENCODINGS = (
    *(
        "rgb8",
        "bgr8",
        "mono8",
        "16UC1",
        "32FC1",
        "rgba8",
        "bayer_rggb8",
        "yuv422",
        "",
    ),
    *("8UC3", "64FC1", "32FC4", "8UC999999999", "mono16", "\0", "jpeg", "nv12"),
)


def messages(rng: Rng, root: Path) -> Path:
    """A whole bag of images and cameras with fields that cannot be."""
    writer = bags.Writer(root, pick(rng, bags.FORMATS))
    what = pick(rng, ("rgb", "depth", "info"))
    names = {
        "rgb": ("height", "width", "step", "encoding", "data", "is_bigendian"),
        "depth": ("height", "width", "step", "encoding", "data"),
        "info": ("height", "width", "distortion_model", "binning_x", "k", "d"),
    }
    name = pick(rng, names[what])
    for i in range(3):
        sent = {
            "info": writer.info(),
            "rgb": writer.image(bags.rgb(i), "rgb8", bags.stamp(i)),
            "depth": writer.image(bags.millimetres(i), "16UC1", bags.stamp(i)),
        }
        message = sent[what]
        if name == "data":
            message.data = message.data[: int(rng.integers(len(message.data)))]
        elif name in ("encoding", "distortion_model"):
            setattr(
                message, name, pick(rng, (*ENCODINGS, "equidistant", "x" * 999))
            )
        elif name in ("k", "d"):
            name = name.upper() if writer.is_ros1 else name
            value = pick(rng, (np.nan, np.inf, 0, -1, 1e308, 1e-308))
            setattr(message, name, np.full(9, value))
        elif name in ("K", "D"):
            setattr(message, name, np.full(9, 1e308))
        elif name == "is_bigendian":
            message.is_bigendian = int(rng.integers(256))
        else:
            setattr(message, name, pick(rng, NUMBERS) % 2**32)
        time = bags.stamp(i)
        writer.write(bags.INFO, sent["info"], time)
        writer.write(bags.RGB, sent["rgb"], time + 1)
        writer.write(bags.DEPTH, sent["depth"], time + 2)
    return writer.close()


# -- ScanNet's files, and Matroska of an Azure Kinect --------------------------------------------


def sens(rng: Rng, root: Path) -> Path:
    """A file of ScanNet with other numbers before it, before a frame, or in its maps."""
    head = captures.sens_head()
    frames = [captures.sens_frame(i) for i in range(captures.FRAMES)]
    deed = rng.random()
    if deed < 0.4:
        # what follows the matrices is what sizes and counts come from
        place = len(head) - 36
        head = head[:place] + changed_numbers(rng, head[place:], 2)
    elif deed < 0.5:
        head = changed_numbers(rng, head, 3)
    elif deed < 0.9:
        which = int(rng.integers(len(frames)))
        frames[which] = changed_numbers(rng, frames[which], 2)
    else:
        frames = rearranged(rng, frames)
    return written(root / "a.sens", head + b"".join(frames))


def kinect(rng: Rng, root: Path) -> Path:
    """A recording of an Azure Kinect with other tracks, calibration, or blocks."""
    parts_ = captures.kinect_parts()
    deed = rng.random()
    if deed < 0.35:
        content = json.dumps(captures.kinect_calibration())
        changed = changed_text(rng, content.replace(",", ",\n"))
        # as long as before, so that the lengths around it stay true
        text = changed.replace("\n", " ")[: len(content)].ljust(len(content))
        data = parts_[2]
        place = data.index(b'{"CalibrationInformation"')
        end = place + len(content)
        parts_[2] = data[:place] + text.encode("utf-8", "replace")[: len(content)]
        parts_[2] += data[end:]
    elif deed < 0.6:
        parts_[1] = changed_numbers(rng, parts_[1], 2)
    elif deed < 0.9:
        which = int(rng.integers(len(parts_)))
        parts_[which] = changed_numbers(rng, parts_[which], 3)
    else:
        parts_ = rearranged(rng, parts_)
    return written(root / "a.mkv", captures.kinect_file(parts_))


MUTATORS: dict[str, Callable[[Rng, Path], Path]] = {
    "ros1": partial(storage, kind="ros1", at="*.bag"),
    "mcap": partial(storage, kind="mcap", at="*/*.mcap"),
    "sqlite3": partial(storage, kind="sqlite3", at="*/*.db3"),
    "metadata": partial(changed_folder, kind="mcap", names="metadata.yaml", at="*"),
    "messages": messages,
    "npz": arrays,
    "record3d": record3d,
    "camera.yaml": partial(
        changed_folder, kind="folder", names="*.yaml", at="mine"
    ),
    "euroc": partial(
        changed_folder, kind="euroc", names="*.[cy][sa][vm]*", at="seq"
    ),
    "sens": sens,
    **{
        kind: partial(changed_folder, kind=kind, names="*.[jt][sx][ot]*", at="seq")
        for kind in CAPTURES
    },
}
if find_spec("av") is not None:
    MUTATORS["kinect"] = kinect
"""The kinds of recordings that are changed."""


def mutated(kind: str, seed: int, root: Path) -> Path:
    """Write the recording of a kind and a seed into an empty folder; return what is opened."""
    rng = np.random.default_rng([seed, *kind.encode()])
    return MUTATORS[kind](rng, root)
