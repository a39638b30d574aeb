"""What is in an ``.r3d`` file: images, maps that are packed by LZFSE, and a table of numbers."""

from __future__ import annotations

import json
import re
import zipfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.files import read_bytes
from hybridvo.io.data.record3d.lzfse import unpacked_size

METADATA = ("metadata", "metadata.json")
"""What the file of all numbers may be called."""
MAX_METADATA_BYTES = 2**23
"""Bytes of it: ten minutes of poses, stamps and intrinsics at 60 Hz."""
PACKING_BYTES = 4096
"""What LZFSE may add to a map that it cannot make smaller."""
MAX_IMAGE_BYTES = 2**26
"""Bytes of an image."""


class Archive:
    """The files of a recording, in a zip archive or in a folder.

    Attributes:
        root: The archive or the folder.
        names: The names of all files in it.
        metadata: What the app wrote of the recording: K, w, h, poses and more.

    Raises:
        InputError: LZFSE is not installed.
        FormatError: There is no archive, or no metadata.
    """

    def __init__(self, root: Path) -> None:
        if find_spec("liblzfse") is None:
            raise InputError(
                f"{root}: depth of Record3D is packed by LZFSE, for which pyliblzfse is "
                "needed: pip install 'hybridvo[record3d]'."
            )
        self.root = root
        self._archive: zipfile.ZipFile | None = None
        if root.is_file():
            try:
                self._archive = zipfile.ZipFile(root)
            except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
                reason = " ".join(str(error).split())[:200]
                raise FormatError(
                    f"{root}: expected an .r3d file, which is a zip archive ({reason})."
                ) from None
            self.names = set(self._archive.namelist())
        else:
            paths = [*root.glob("*"), *root.glob("rgbd/*")]
            self.names = {path.relative_to(root).as_posix() for path in paths}
        found = [name for name in METADATA if name in self.names]
        if not found:
            raise FormatError(
                f"{root}: expected a file 'metadata', as Record3D writes it."
            )
        self._metadata_name = found[0]
        self.metadata = self._read_metadata()

    def numbers(self) -> list[int]:
        """The numbers of the frames that have an image and depth."""
        matches = [re.fullmatch(r"rgbd/(\d{1,9})\.jpg", n) for n in self.names]
        numbers = {int(match[1]) for match in matches if match}
        return sorted(n for n in numbers if f"rgbd/{n}.depth" in self.names)

    def read(self, name: str, limit: int = MAX_IMAGE_BYTES) -> bytes:
        """The bytes of a file, at most ``limit``."""
        if self._archive is None:
            return read_bytes(self.root / name, limit)
        try:
            with self._archive.open(name) as file:
                data = file.read(limit + 1)
        # zipfile raises errors of many kinds for damaged files
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise FormatError(
                f"{self.root}: {name}: damaged: it cannot be read ({reason})."
            ) from None
        if len(data) > limit:
            raise FormatError(
                f"{self.root}: {name}: expected at most {limit} bytes, got more."
            )
        return data

    def unpacked(self, name: str, limit: int) -> bytes:
        """At most ``limit`` bytes of a file that is packed by LZFSE."""
        import liblzfse

        packed = self.read(name, limit + PACKING_BYTES)
        try:
            unpacked_size(packed, limit)
            return bytes(liblzfse.decompress(packed))
        # the library's own error, and those of memory
        except Exception as error:
            reason = " ".join(str(error).split())[:100]
            raise FormatError(
                f"{self.root}: {name}: damaged: LZFSE cannot unpack it ({reason})."
            ) from None

    def table(self, name: str, columns: int | None) -> np.ndarray | None:
        """Numbers of the metadata, (N, columns) or of any shape; None where there are none."""
        stored = self.metadata.get(name)
        if not stored:
            return None
        try:
            values = np.array(stored, np.float64)
        except (TypeError, ValueError, OverflowError):
            values = np.full(1, np.nan)
        fits = columns is None or (values.ndim == 2 and values.shape[1] == columns)
        if not fits or not np.isfinite(values).all():
            expected = (
                "numbers" if columns is None else f"rows of {columns} numbers"
            )
            raise FormatError(
                f"{self.root}: {self._metadata_name}: {name}: expected {expected}, got "
                f"{str(stored)[:80]}."
            )
        return values

    def _read_metadata(self) -> dict[str, Any]:
        where = f"{self.root}: {self._metadata_name}"
        try:
            content = json.loads(self.read(self._metadata_name, MAX_METADATA_BYTES))
        except FormatError:
            raise
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise FormatError(
                f"{where}: expected a JSON object with K, w, h, poses."
            )
        return content
