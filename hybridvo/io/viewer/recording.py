"""A file of what a tracker saw, for the Rerun viewer."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from hybridvo.core.errors import InputError
from hybridvo.core.files import atomic_write
from hybridvo.io.viewer.layout import blueprint
from hybridvo.io.viewer.scene import TRUTH, Seen, ViewerScene

MAX_IMAGES = 300
"""Images of a kind in a recording, which then has about 30 MB."""


def check_recording(path: str | Path) -> None:
    """Raise an InputError where no recording can be written to a path."""
    path = Path(path)
    if path.suffix != ".rrd" or path.is_dir():
        raise InputError(
            f"--rrd {path!s}: expected the name of a file that ends in .rrd."
        )
    if find_spec("rerun") is None:
        raise InputError(
            "--rrd: Rerun is not installed; pip install 'hybridvo[viz]'."
        )
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(
            f"--rrd {path!s}: Rerun needs a path that is UTF-8 text."
        ) from None


class RecordingWriter:
    """Writes a recording frame by frame, with the streams that the viewer shows.

    Args:
        path: The file.
        name: What the viewer calls it.
        count: How many frames will come, about; images are spread over them.
        truth: (N, 3) metres, the true path in the first camera's frame, or None.

    Raises:
        OutputError: The file cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        name: str,
        count: int,
        truth: np.ndarray | None = None,
    ) -> None:
        import rerun

        self.path = Path(path)
        # Rerun reports a bad path only later, in a thread.
        with atomic_write(self.path, "wb"):
            pass
        self._image_stride = max(-(-count // MAX_IMAGES), 1)
        self._count = 0
        self._stream = rerun.RecordingStream(f"hybridvo {name}")
        self._stream.save(self.path, default_blueprint=blueprint())
        self._scene = ViewerScene(self._stream)
        if truth is not None:
            self._scene.add_line(TRUTH, truth)

    def add(self, seen: Seen) -> None:
        """Record a tracked frame; images only of as many as fit."""
        with_images = self._count % self._image_stride == 0
        self._count += 1
        self._scene.add(seen._replace(with_images=with_images))

    def close(self) -> None:
        """Write what is still in memory, which completes the file."""
        self._stream.flush()
        self._stream.disconnect()
