"""Compiled kernels on disk, which neither damage nor a full disk can stop."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from collections.abc import Iterator
from enum import EnumMeta
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

CONSTANTS = (bool, int, float, str, tuple, np.generic, EnumMeta)
"""Types of the global values that numba freezes into a kernel."""
_logger = logging.getLogger(__name__)


@functools.cache
def say_once(text: str) -> None:
    """Log a warning, unless this process has logged it before."""
    _logger.warning(text)


def say_that_it_compiles() -> None:
    """State once why the first call takes so long."""
    say_once("hybridvo: compiling once, about a minute")


class KernelCache(FunctionCache):
    """Numba's cache of the machine code of a function, with two additions.

    Files that are damaged count as missing. Numba compiles a function again when
    its own file changes. Here it is also compiled again when a kernel that it calls
    changes, or a constant that it reads, such as one of
    :mod:`hybridvo.calibration`: their values are part of the machine code.
    """

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)
        locator = self._impl.locator
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=(locator.get_source_stamp(), dependencies(function)),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the code for a signature; None, upon which numba compiles."""
        found = None
        try:
            found = super().load_overload(sig, target_context)
        # pickle and LLVM raise all kinds of errors for bytes that they have not
        # written
        except Exception:
            with contextlib.suppress(OSError):
                # an empty index, in place of one that may be damaged
                self.flush()
        if found is None:
            say_that_it_compiles()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for a signature, if there is room."""
        try:
            super().save_overload(sig, data)
        except Exception as error:
            # without the path, for there are several folders: one warning is enough
            cause = getattr(error, "strerror", None) or type(error).__name__
            _say_that_nothing_is_kept(cause)


class NoCache(NullCache):
    """In place of a cache where no folder can be written."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Find nothing, upon which numba compiles."""
        say_that_it_compiles()
        _say_that_nothing_is_kept("no folder can be written")


def kernel_cache(function: FunctionType) -> KernelCache | NoCache:
    """Make the cache of a function."""
    try:
        return KernelCache(function)
    # neither the package nor the user's cache folder can be written
    except RuntimeError:
        return NoCache()


def dependencies(function: FunctionType) -> tuple[str, ...]:
    """Return what the machine code of a function depends on besides its own file.

    Returns:
        Sorted lines: names and values of the constants that it reads, and files,
        sizes and times of the kernels that it calls, with theirs.
    """
    lines: set[str] = set()
    visited: set[FunctionType] = set()
    _collect(function, lines, visited)
    return tuple(sorted(lines))


def _collect(
    function: FunctionType, lines: set[str], visited: set[FunctionType]
) -> None:
    """Add the dependencies of a function, and of the kernels that it calls."""
    if function in visited:
        return
    visited.add(function)
    for name, value in _globals_used(function):
        called = getattr(value, "py_func", None)
        if isinstance(called, FunctionType):
            lines.add(_file_stamp(called))
            _collect(called, lines, visited)
        elif isinstance(value, EnumMeta):
            lines.add(f"{name} = {list(value)!r}")
        elif isinstance(value, CONSTANTS):
            lines.add(f"{name} = {value!r}")


def _globals_used(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Names and values of the globals that a function uses."""
    names = set(_names(function.__code__))
    for name in names & set(function.__globals__):
        value = function.__globals__[name]
        if isinstance(value, ModuleType):
            for attribute in names & set(vars(value)):
                yield f"{name}.{attribute}", getattr(value, attribute)
        else:
            yield name, value


def _names(code: CodeType) -> Iterator[str]:
    """Global names and attributes in a piece of code and in its inner code."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _file_stamp(function: FunctionType) -> str:
    path = function.__code__.co_filename
    try:
        status = os.stat(path)
    # in an archive, which does not change
    except OSError:
        return path
    return f"{os.path.basename(path)} {status.st_size} {status.st_mtime}"


def _say_that_nothing_is_kept(why: str) -> None:
    remedy = (
        "the next start compiles again. Set NUMBA_CACHE_DIR to a folder with room"
    )
    say_once(f"hybridvo: compiled code cannot be kept ({why}): {remedy}.")
