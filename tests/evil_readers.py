"""A reader that does what a hostile file may make a library do."""

from __future__ import annotations

import ctypes
import mmap
import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hybridvo import Camera
from hybridvo.core.errors import FormatError
from hybridvo.io.data.streams import FrameImages, StreamSequence

FRAMES = 6
BAD = 2
"""The frame whose reading is hostile."""


def take_memory() -> None:
    np.ones(2**28)


def take_memory_and_hide_it() -> None:
    try:
        np.ones(2**28)
    except MemoryError:
        raise FormatError("the chunk is damaged.") from None


def compute() -> None:
    while True:
        pass


def wait() -> None:
    time.sleep(1000)


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def fail() -> None:
    raise KeyError("a bug")


def write() -> None:
    with Path("large").open("wb") as file:
        file.write(bytes(2**27))


def open_many() -> None:
    files = [Path(os.devnull).open("rb") for _ in range(2000)]
    raise AssertionError(len(files))


def connect() -> None:
    socket.socket().connect(("127.0.0.1", 9))


def run_program() -> None:
    os.execv("/bin/true", ["true"])


def take_over() -> None:
    """Read the memory of the process of the run, which has the rights of the child."""
    libc = ctypes.CDLL(None, use_errno=True)
    attach = 16
    if libc.ptrace(attach, os.getppid(), 0, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def thread() -> None:
    """Decoders of video have threads."""
    worker = threading.Thread(target=lambda: None)
    worker.start()
    worker.join()


def end() -> None:
    os._exit(0)


def map_file() -> None:
    """What is mapped is no memory."""
    with Path("mapped").open("w+b") as file:
        file.truncate(2**20)
        mmap.mmap(file.fileno(), 2**20).close()


DEEDS: dict[str, Callable[[], None]] = {
    each.__name__: each
    for each in (
        *(take_memory, take_memory_and_hide_it, compute, wait, crash, fail),
        *(write, open_many, end, map_file, connect, run_program, take_over, thread),
    )
}


class EvilSequence(StreamSequence):
    """Six frames; one does what ``deed`` names, or the opening where ``early`` is given."""

    kind = "bag"
    choices = ("deed", "early")

    def _open(self) -> None:
        os.chdir(self.root)
        if "early" in self.chosen:
            DEEDS[self.chosen["deed"]]()
        self.timestamps = np.arange(FRAMES) / 30
        self._camera = Camera(40, 40, 15.5, 11.5, height=24, width=32)

    def _images(self, index: int) -> FrameImages:
        if index == BAD:
            DEEDS[self.chosen["deed"]]()
        rgb = np.full((24, 32, 3), index, np.uint8)
        return FrameImages(rgb, np.full((24, 32), 1 + index, np.float32))
