"""One function per door through which bytes come in: what it may raise, and what it may cost.

A target takes arbitrary bytes and an empty folder. It passes when the reader returns or raises one
of hybridvo's documented errors; every other exception is a finding, as is a call that takes more
memory or time than the size of its input explains. ``fuzz.py`` feeds these with atheris, and
``tests/unit/test_fuzz_regressions.py`` with the corpus that is kept here.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import struct
import sys
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hybridvo.configuration import load_options
from hybridvo.data import image_io
from hybridvo.data.presets import load_preset
from hybridvo.data.sequence import open_sequence
from hybridvo.errors import InputError
from hybridvo.network.weights import load_weights
from hybridvo.training.checkpoint import load_checkpoint
from hybridvo.trajectory import read_trajectory
from hybridvo.types import Camera

CORPUS = Path(__file__).parent / "corpus"
PART = b"%%"
"""Between the parts of an input that becomes several files."""

SLACK_BYTES, BYTES_PER_BYTE = 128 * 2**20, 4096
"""Memory that a call may add: an allowance for first calls and libraries, and a multiple of the
input (deflate expands 1032 times, a decoded pixel has up to 4 channels)."""
SLACK_S, S_PER_BYTE = 4.0, 1e-4
"""CPU time that a call may take, under a tracer; building an empty network takes half a second."""


class TooExpensive(AssertionError):
    """A call whose cost the size of its input does not explain."""


@contextlib.contextmanager
def bounded(size: int) -> Iterator[None]:
    """Raise TooExpensive where the block raises the peak memory or takes time beyond its bounds."""
    unit = 1 if sys.platform == "darwin" else 1024
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    started = time.process_time()
    yield
    spent = time.process_time() - started
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit - before
    if grown > SLACK_BYTES + BYTES_PER_BYTE * size:
        raise TooExpensive(f"{grown / 2**20:.0f} MiB for {size} bytes")
    if spent > SLACK_S + S_PER_BYTE * size:
        raise TooExpensive(f"{spent:.1f} s for {size} bytes")


def refused(call: Callable[[], object], *also: type[Exception]) -> bool:
    """Whether a call raises InputError (FormatError, CheckpointError) or one of ``also``."""
    try:
        call()
    except (InputError, *also) as error:
        if len(str(error)) > 4000:
            raise AssertionError(f"a message of {len(str(error))} characters") from None
        return True
    return False


def parts(data: bytes, names: Iterable[str], folder: Path) -> None:
    """Write the parts of the input under these names; a missing part is an absent file."""
    for name, part in zip(names, data.split(PART), strict=False):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(part)


def frames(paths: Iterable[Path], array: np.ndarray) -> None:
    """The same small PNG under every path."""
    content = cv2.imencode(".png", array)[1].tobytes()
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


GREY16 = np.full((6, 8), 1500, np.uint16)
RGB = np.full((6, 8, 3), 90, np.uint8)


def whole(folder: Path, kind: str, **options: Any) -> None:
    """Open a sequence and read every frame and flow of it."""

    def read() -> None:
        sequence = open_sequence(folder, kind, **options)
        for index in range(min(len(sequence), 8)):
            refused(lambda i=index: sequence.frame(i), FileNotFoundError)
            if index + 1 < len(sequence):
                refused(lambda i=index: sequence.flow(i), FileNotFoundError)

    refused(read)


def flo(data: bytes, folder: Path) -> None:
    path = folder / "x.flo"
    path.write_bytes(data)
    for strict in (False, True):
        refused(lambda s=strict: image_io.read_flo(path, strict=s))
    refused(lambda: image_io.image_size(path))


def dpt(data: bytes, folder: Path) -> None:
    path = folder / "x.dpt"
    path.write_bytes(data)
    for strict in (False, True):
        refused(lambda s=strict: image_io.read_dpt(path, strict=s))
    refused(lambda: image_io.image_size(path))


def cam(data: bytes, folder: Path) -> None:
    path = folder / "x.cam"
    path.write_bytes(data)
    for strict in (False, True):
        refused(lambda s=strict: image_io.read_cam(path, strict=s))
    refused(lambda: Camera.from_matrix(image_io.read_cam(path)[0], 6, 8))


def npy(data: bytes, folder: Path) -> None:
    path = folder / "x.npy"
    path.write_bytes(data)
    for channels in (None, 2):
        for strict in (False, True):
            refused(lambda c=channels, s=strict: image_io.read_npy(path, channels=c, strict=s))
    refused(lambda: image_io.image_size(path))


def npy_header(data: bytes, folder: Path) -> None:
    """The text of the header; magic, length and a little data around it are right."""
    data = data[:60000]
    npy(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(data)) + data + bytes(96), folder)


IMAGE_READERS = (
    image_io.read_rgb,
    image_io.read_png16,
    image_io.read_mask_png,
    image_io.read_depth_rgba_png,
    image_io.read_flow_kitti_png,
    image_io.read_flow_tartanair_png,
    image_io.image_size,
)


def image(data: bytes, folder: Path) -> None:
    """PNG and JPEG as they come."""
    path = folder / "x.png"
    path.write_bytes(data)
    for read in IMAGE_READERS:
        refused(lambda r=read: r(path))


def repaired(data: bytes) -> bytes:
    """PNG whose chunk checksums are right, so that what is in the chunks reaches the decoder."""
    out, position = bytearray(b"\x89PNG\r\n\x1a\n"), 8
    while position + 8 <= len(data):
        length = min(struct.unpack(">I", data[position : position + 4])[0], len(data) - position)
        body = data[position + 4 : position + 8 + length]
        out += struct.pack(">I", max(len(body) - 4, 0)) + body + struct.pack(">I", zlib.crc32(body))
        position += 12 + length
    return bytes(out)


def png(data: bytes, folder: Path) -> None:
    image(repaired(data), folder)


def tum(data: bytes, folder: Path) -> None:
    frames([folder / "rgb" / f"{i}.png" for i in range(3)], RGB)
    frames([folder / "depth" / f"{i}.png" for i in range(3)], GREY16)
    parts(data, ("rgb.txt", "depth.txt", "groundtruth.txt"), folder)
    camera = Camera(8, 8, 3.5, 2.5, 6, 8)
    for keep in (False, True):
        whole(folder, "tum", camera=camera, keep_unmatched=keep)


def associations(data: bytes, folder: Path) -> None:
    frames([folder / "rgb" / f"{i}.png" for i in range(3)], RGB)
    frames([folder / "depth" / f"{i}.png" for i in range(3)], GREY16)
    parts(data, ("associations.txt", "x.gt.freiburg"), folder)
    whole(folder, "tum", camera=Camera(8, 8, 3.5, 2.5, 6, 8))


def kitti(data: bytes, folder: Path) -> None:
    root = folder / "07"
    frames([root / "image_2" / f"{i:06d}.png" for i in range(2)], RGB)
    frames([root / "image_3" / f"{i:06d}.png" for i in range(2)], RGB)
    frames([root / "depth" / f"{i:06d}.png" for i in range(2)], GREY16)
    parts(data, ("07/calib.txt", "07/times.txt", "poses/07.txt"), folder)
    for depth in ("file", "stereo"):
        whole(root, "kitti", depth=depth)


def tartanair(data: bytes, folder: Path) -> None:
    frames([folder / "image_left" / f"{i:06d}_left.png" for i in range(3)], RGB)
    depth = folder / "depth_left"
    depth.mkdir()
    np.save(depth / "000000_left_depth.npy", np.ones((6, 8), np.float32))
    parts(data, ("pose_left.txt", "flow/000000_000001_flow.npy"), folder)
    whole(folder, "tartanair")


def seven_scenes(data: bytes, folder: Path) -> None:
    frames([folder / f"frame-{i:06d}.color.png" for i in range(2)], RGB)
    frames([folder / f"frame-{i:06d}.depth.png" for i in range(2)], GREY16)
    parts(data, (f"frame-{i:06d}.pose.txt" for i in range(2)), folder)
    for strict in (False, True):
        whole(folder, "7scenes", camera=Camera(8, 8, 3.5, 2.5, 6, 8), strict=strict)


def own_folder(data: bytes, folder: Path) -> None:
    frames([folder / "rgb" / f"{i}.png" for i in range(3)], RGB)
    frames([folder / "depth" / f"{i}.png" for i in range(3)], GREY16)
    parts(data, ("camera.yaml", "poses.txt", "timestamps.txt", "flow/0.npy"), folder)
    whole(folder, "folder")


def names(data: bytes, folder: Path) -> None:
    """File names: each line is one, in every folder in which readers look for numbered files."""
    for line in data.split(b"\n")[:12]:
        name = os.fsdecode(line.replace(b"/", b"_").replace(b"\0", b"_")[:200])
        if name in ("", ".", ".."):
            continue
        for place in ("rgb", "depth", "image_2", "image_left", "depth_left", "."):
            (folder / place).mkdir(exist_ok=True)
            with contextlib.suppress(OSError):  # a name that is a folder by now
                (folder / place / name).write_bytes(b"\x89PNG")
    (folder / "camera.yaml").write_text("fx: 8\nfy: 8\ncx: 4\ncy: 3\nwidth: 8\nheight: 6\n")
    (folder / "calib.txt").write_text("P2: 8 0 4 0 0 8 3 0 0 0 1 0\n")
    for kind in ("folder", "kitti", "tartanair", "7scenes", "sintel"):
        whole(folder, kind)


def yaml(data: bytes, folder: Path) -> None:
    """Options of a run, of data and of training, and the same bytes as ``--set``."""
    from hybridvo.training.options import load_training_options

    path = folder / "x.yaml"
    path.write_bytes(data)
    for read in (load_options, load_preset, load_training_options):
        refused(lambda r=read: r(str(path)))
    refused(lambda: load_options(assignments=data.decode("utf-8", "replace").split("\n")[:8]))


def weights(data: bytes, folder: Path) -> None:
    path = folder / "x.safetensors"
    path.write_bytes(data)
    refused(lambda: load_weights(path))


def weights_header(data: bytes, folder: Path) -> None:
    """The JSON header of a safetensors file, with the right lengths in front and behind it."""
    ends = [int(end) for end in re.findall(rb",\s*(\d{1,5})\s*\]", data)]
    weights(struct.pack("<Q", len(data)) + data + bytes(max(ends, default=0)), folder)


def weights_options(data: bytes, folder: Path) -> None:
    """Options and card inside a well-formed header."""
    options, _, card = data.decode("utf-8", "replace").partition("%%")
    metadata = {"format": "hybridvo-network-1", "options": options, "card": card or "{}"}
    header = json.dumps({"__metadata__": metadata}).encode()
    weights(struct.pack("<Q", len(header)) + header, folder)


def checkpoint(data: bytes, folder: Path) -> None:
    path = folder / "x.pt"
    path.write_bytes(data)
    refused(lambda: load_checkpoint(path))


def checkpoint_inner(data: bytes, folder: Path) -> None:
    """The pickled structure inside a well-formed archive with two small storages."""
    path = folder / "x.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("x/data.pkl", data)
        archive.writestr("x/byteorder", "little")
        archive.writestr("x/data/0", bytes(16))
        archive.writestr("x/data/1", bytes(64))
        archive.writestr("x/version", "3\n")
    refused(lambda: load_checkpoint(path))


def trajectory(data: bytes, folder: Path) -> None:
    path = folder / "x.txt"
    path.write_bytes(data)
    for kind in ("auto", "tum", "kitti", "tartanair"):
        refused(lambda k=kind: read_trajectory(path, k))


TARGETS: dict[str, Callable[[bytes, Path], None]] = {
    target.__name__.replace("_", "-"): target
    for target in (
        *(flo, dpt, cam, npy, npy_header, image, png, tum, associations, kitti, tartanair),
        *(seven_scenes, own_folder, names, yaml, weights, weights_header, weights_options),
        *(checkpoint, checkpoint_inner, trajectory),
    )
}


def run(name: str, data: bytes, folder: Path) -> None:
    """One target on one input, within its bounds; numeric warnings count as findings."""
    with warnings.catch_warnings(), bounded(len(data)):
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", RuntimeWarning)
        TARGETS[name](data, folder)
