"""Shows a run in Rerun while it goes on; a viewer that is missing, closed or slow never stops it.

Everything is sent from a thread of its own. Where the viewer is slower than the tracker, images
are left out, numbers are not. Once the viewer is lost, nothing more is sent.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np

from hybridvo.io.viewer.address import CONNECT, Address, parse_address
from hybridvo.io.viewer.layout import blueprint
from hybridvo.io.viewer.program import REMEDY, NoViewer, Program, listens
from hybridvo.io.viewer.scene import TRUTH, Seen, ViewerScene

# s after which a viewer that takes nothing is lost; the tracker does not wait
VIEWER_SILENCE_S = 5.0
# s at the end of a run for what the viewer has not taken yet: more than its silence
# may last
VIEWER_CLOSING_S = 10.0

MAX_WAITING_IMAGES = 2
"""Steps that may wait with their images; those that come then are shown without."""
MAX_WAITING = 2000
"""Steps that may wait at all; those that come then are not shown."""

_logger = logging.getLogger(__name__)
_LOST: list[Any] = []
"""Streams to viewers that do not answer: to drop one would wait for the viewer for ever."""


class Viewer:
    """A viewer beside a run.

    Args:
        view: Where it is, as in :func:`hybridvo.io.viewer.address.parse_address`.
        name: What the viewer calls the run.
        truth: (N, 3) metres, the true path in the first camera's frame, or None.
        say: Gets a sentence where something happens to the viewer; by default the log.
        open_stream: Returns a ``rerun.RecordingStream``, instead of one to the viewer.

    Raises:
        InputError: ``view`` names no place of a viewer.
    """

    def __init__(
        self,
        view: str,
        name: str,
        truth: np.ndarray | None = None,
        say: Callable[[str], None] | None = None,
        open_stream: Callable[[], Any] | None = None,
    ) -> None:
        self._address = parse_address(view)
        self._name = name
        self._truth = truth
        self._say = say or _logger.warning
        self._open_stream = open_stream or self._connect
        self._program: Program | None = None
        self._waiting: queue.SimpleQueue[Seen | None] = queue.SimpleQueue()
        self._is_lost = threading.Event()
        self._thread = threading.Thread(
            target=self._work, name="viewer", daemon=True
        )
        self._thread.start()

    def add(self, seen: Seen) -> None:
        """Show a tracked frame; returns at once."""
        waiting = self._waiting.qsize()
        if self._is_lost.is_set() or waiting >= MAX_WAITING:
            return
        if waiting >= MAX_WAITING_IMAGES:
            seen = without_images(seen)
        self._waiting.put(seen)

    def close(self) -> None:
        """Send what is left, within a few seconds; a second call changes nothing."""
        self._waiting.put(None)
        self._thread.join(VIEWER_CLOSING_S)
        if self._thread.is_alive():
            self._lose(f"takes longer than {VIEWER_CLOSING_S:g} s for the rest")

    def served(self) -> str:
        """Finish; return the address of a page that stays, empty where there is none."""
        self.close()
        program = self._program
        if program is None or self._is_lost.is_set():
            return ""
        return program.page

    # -- what the thread does --------------------------------------------------------

    def _work(self) -> None:
        """Connect, and show steps until there are no more or the viewer is lost."""
        try:
            stream = self._open_stream()
            scene = ViewerScene(stream)
            if self._truth is not None:
                scene.add_line(TRUTH, self._truth)
        except NoViewer as error:
            self._lose(str(error), is_sentence=True)
            return
        except Exception as error:
            # whatever a viewer does, the run goes on
            self._lose(f"cannot be used: {one_line(error)}")
            return
        try:
            self._show(stream, scene)
        except Exception as error:
            keep(stream)
            words = self._program.last_words() if self._program else ""
            self._lose(f"is lost: {words or one_line(error)}")

    def _show(self, stream: Any, scene: ViewerScene) -> None:
        """Show steps until there are no more; raises where the viewer takes none."""
        while not self._is_lost.is_set():
            seen = self._waiting.get()
            if seen is None:
                stream.flush(timeout_sec=VIEWER_SILENCE_S)
                stream.disconnect()
                return
            scene.add(seen)
            stream.flush(timeout_sec=VIEWER_SILENCE_S)
        keep(stream)

    def _connect(self) -> Any:
        """Start the viewer where that is wanted, and open a stream to it."""
        if find_spec("rerun") is None:
            raise NoViewer(
                "--view: Rerun is not installed, nothing is shown: pip install "
                "'hybridvo[viz]'"
            )
        address = self._address
        if address.kind == CONNECT:
            check_listener(address)
        else:
            self._program = Program(address.kind)
            address = self._program.address
            if self._program.page:
                self._say(f"the run is shown at {self._program.page}")
        import rerun

        stream = rerun.RecordingStream(f"hybridvo {self._name}")
        stream.connect_grpc(address.url, default_blueprint=blueprint())
        return stream

    def _lose(self, reason: str, is_sentence: bool = False) -> None:
        """State once that nothing more is shown."""
        if self._is_lost.is_set():
            return
        self._is_lost.set()
        text = reason if is_sentence else f"the viewer {reason}"
        remedy = "" if REMEDY in text else f"; {REMEDY}"
        self._say(f"{text}{remedy}; the run goes on without it")


def check_listener(address: Address) -> None:
    """Raise NoViewer where no viewer listens at an address."""
    if listens(address.host, address.port):
        return
    raise NoViewer(
        f"no viewer listens at {address.host}:{address.port}: start one there with "
        f"'rerun', or pass --view alone, which opens one; {REMEDY}"
    )


def without_images(seen: Seen) -> Seen:
    """Return what is seen without all that is large."""
    frame = replace(seen.frame, rgb=None, depth=None, mask=None)
    motion = seen.step.motion.replace(weights=None, hypotheses=())
    step = replace(seen.step, motion=motion)
    return Seen(frame, step, rate=seen.rate, with_images=False)


def keep(stream: Any) -> None:
    """Keep a stream whose viewer does not answer, so that the program can end."""
    _LOST.append(stream)
    with contextlib.suppress(ImportError):
        import rerun

        rerun.unregister_shutdown()


def one_line(error: Exception) -> str:
    """Return what an error states, on one line."""
    return " ".join(str(error).split()) or type(error).__name__
