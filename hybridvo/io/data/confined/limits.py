"""Which kinds of recordings are read in a child process, and what the child may take.

A recording comes from a stranger, and these kinds are parsed by large libraries, most of them in
C: rosbags with SQLite and three decompressors, OpenCV's FFmpeg, zip archives with LZFSE. A file
of a few kilobytes can make them take any time and any memory, or end the process. In a child of
its own, which has limits, this costs one frame or one recording, never the run.

All other kinds are read in this process: folders of images and lists, whose headers are checked
before they are decoded, and folders of ``.npy`` files, which are mapped and not unpacked.

The limits are those of Linux (``setrlimit``). Memory is limited by ``RLIMIT_DATA``, which counts
what a process allocates, but not files that are mapped. Other systems do not enforce it; there
all kinds are read in this process, and nothing limits what a library takes.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NamedTuple

MIB = 2**20
CPU_S = 15
"""Seconds of processor time for opening, and for each frame, of an empty file."""
OPEN_FILES = 1024
"""Files that are open at once."""
UNPACKED_RATIO = 20
"""Bytes written into temporary files for each byte of the recording: depth packs so well."""
MAX_MEMORY = 8 * 2**30
"""Bytes, for a recording of any size."""


class Confinement(NamedTuple):
    """What the child of a kind of recordings may take.

    Processor time and memory grow with the size of the recording: opening reads all of it.
    """

    memory: int  # bytes, beside those of Python and its libraries
    memory_for_byte: float  # further bytes for each byte of the recording
    cpu_s_for_mib: float  # further seconds for each MiB of the recording
    memory_for_core: int = 0  # further bytes for each core
    # what the child imports, so that it is imported once for all children
    modules: tuple[str, ...] = ()


ROSBAGS = (
    "rosbags.rosbag1",
    "rosbags.rosbag2",
    "rosbags.typesys.stores.ros1_noetic",
    "rosbags.typesys.stores.ros2_humble",
)
VIDEO = Confinement(
    memory=1024 * MIB,
    memory_for_byte=0,
    # a still scene has minutes in a MiB
    cpu_s_for_mib=10,
    # FFmpeg decodes as many frames at once
    memory_for_core=32 * MIB,
)
CONFINED: dict[str, Confinement] = {
    "bag": Confinement(
        memory=448 * MIB, memory_for_byte=1, cpu_s_for_mib=0.5, modules=ROSBAGS
    ),
    "record3d": Confinement(
        memory=448 * MIB,
        memory_for_byte=0,
        cpu_s_for_mib=0.5,
        modules=("liblzfse",),
    ),
    "sens": Confinement(memory=448 * MIB, memory_for_byte=0, cpu_s_for_mib=0.5),
    "transforms": Confinement(
        memory=448 * MIB, memory_for_byte=0, cpu_s_for_mib=0.5
    ),
    "kinect": Confinement(
        memory=448 * MIB,
        memory_for_byte=0,
        cpu_s_for_mib=0.5,
        modules=("av",),
    ),
    # arrays that are packed are unpacked as a whole
    "arrays": Confinement(memory=448 * MIB, memory_for_byte=20, cpu_s_for_mib=0.5),
    "video": VIDEO,
    "strayscanner": VIDEO,
}
"""The kinds that are read in a child process."""


class Limits(NamedTuple):
    """What the child of one recording may take."""

    memory: int  # bytes, beside those of Python and its libraries
    mapped: int  # bytes of files that are mapped into memory
    cpu_s: int  # processor time of one request, seconds
    file_bytes: int  # size of a temporary file


def is_available() -> bool:
    """Return whether this system can limit a child process."""
    is_frozen = getattr(sys, "frozen", False)
    return sys.platform == "linux" and not is_frozen


def is_confined(kind: str, path: Path) -> bool:
    """Return whether a recording is read in a child process.

    Args:
        kind: Of the recording, as in ``READERS``.
        path: Its file or folder.
    """
    if not is_available() or kind not in CONFINED:
        return False
    # a folder of .npy files is mapped, not unpacked
    return kind != "arrays" or path.is_file()


def limits_of(kind: str, path: Path) -> Limits:
    """Return the limits for a recording.

    Args:
        kind: One of ``CONFINED``.
        path: Its file or folder.
    """
    allowed = CONFINED[kind]
    size = _size(path)
    cores = os.cpu_count() or 1
    memory = allowed.memory + allowed.memory_for_byte * size
    memory += allowed.memory_for_core * cores
    return Limits(
        memory=int(min(memory, MAX_MEMORY)),
        mapped=2 * size,
        cpu_s=int(CPU_S + allowed.cpu_s_for_mib * size / MIB),
        file_bytes=UNPACKED_RATIO * size + 64 * MIB,
    )


def _size(path: Path) -> int:
    """Return the bytes that a recording takes on the disk; holes in its files are none."""
    inside = path.rglob("*") if path.is_dir() else [path]
    sizes = []
    for each in inside:
        if not each.is_file():
            continue
        status = each.stat()
        stored = getattr(status, "st_blocks", 0) * 512
        sizes.append(min(status.st_size, stored))
    return sum(sizes)


def apply_limits(limits: Limits) -> None:
    """Limit this process, for good."""
    import resource

    page = os.sysconf("SC_PAGE_SIZE")
    numbers = Path("/proc/self/statm").read_text(encoding="ascii").split()
    mapped_now = int(numbers[0]) * page
    data_now = int(numbers[5]) * page
    allowed = {
        resource.RLIMIT_DATA: data_now + limits.memory,
        # libraries map themselves, and each thread reserves memory that it does not use
        resource.RLIMIT_AS: mapped_now + limits.memory + limits.mapped + MAX_MEMORY,
        resource.RLIMIT_FSIZE: limits.file_bytes,
        resource.RLIMIT_NOFILE: OPEN_FILES,
        resource.RLIMIT_CORE: 0,
    }
    for what, limit in allowed.items():
        _, hard = resource.getrlimit(what)
        if hard != resource.RLIM_INFINITY:
            limit = min(limit, hard)
        resource.setrlimit(what, (limit, limit))


def allow_one_request(limits: Limits) -> None:
    """Let this process use the processor for one more request; it is ended after that."""
    import resource

    used = resource.getrusage(resource.RUSAGE_SELF)
    until = int(used.ru_utime + used.ru_stime) + 1 + limits.cpu_s
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    if hard != resource.RLIM_INFINITY:
        until = min(until, hard)
    resource.setrlimit(resource.RLIMIT_CPU, (until, hard))
