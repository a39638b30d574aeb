"""Compiled kernels on disk, which neither damage nor a full disk can stop."""

from __future__ import annotations

import contextlib
import functools
import logging
from types import FunctionType
from typing import Any

from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    NullCache,
)

from hybridvo.compiled.kernel_sources import dependencies
from hybridvo.compiled.shipped_kernels import (
    build_here,
    holds,
    shipped_build,
    shipped_kernel,
)

_logger = logging.getLogger(__name__)
REPORTED = 10
"""After so many kernels that were compiled, their number is logged."""


class _Progress:
    """How many kernels there are, and how many of them are ready or being compiled."""

    def __init__(self) -> None:
        self._names: set[str] = set()
        self._ready: set[str] = set()
        self._compiled: set[str] = set()

    def know(self, name: str) -> None:
        """Count a kernel that may be needed."""
        self._names.add(name)

    def load(self, name: str) -> None:
        """Count a kernel whose code was found."""
        self._ready.add(name)

    def compile(self, name: str) -> None:
        """Count a kernel that is compiled now, and log every tenth such."""
        self._ready.add(name)
        if name in self._compiled:
            # for arguments of other types
            return
        self._compiled.add(name)
        if len(self._compiled) % REPORTED == 0:
            count = f"{len(self._ready)} of {len(self._names)} kernels"
            _logger.warning("hybridvo: compiling %s", count)


_progress = _Progress()


@functools.cache
def say_once(text: str) -> None:
    """Log a warning, unless this process has logged it before."""
    _logger.warning(text)


def say_that_it_compiles(target_context: Any) -> None:
    """State once why the first call takes so long."""
    text = "hybridvo: compiling once, about a minute"
    build = shipped_build()
    if build is not None:
        why = build.obstacle(build_here(target_context.codegen()))
        text += f" ({why})" if why else ""
    say_once(text)


class _KernelFiles(CompileResultCacheImpl):
    """How machine code becomes the content of a file."""

    def reduce(self, cres: Any) -> Any:
        """Leave out the listing of the source, which states where it lies."""
        return super().reduce(cres._replace(type_annotation=""))


class KernelCache(FunctionCache):
    """Numba's cache of the machine code of a function, with three additions.

    Files that are damaged count as missing. Numba compiles a function again when
    its own file changes. Here it is also compiled again when a kernel that it calls
    changes, or a constant that it reads, such as one of
    :mod:`hybridvo.calibration`: their values are part of the machine code. What is
    missing may be in the wheel: see :mod:`hybridvo.compiled.shipped_kernels`.
    """

    _impl_class = _KernelFiles

    def __init__(self, function: FunctionType) -> None:
        super().__init__(function)
        self._name = _full_name(function)
        self._shipped = shipped_kernel(function)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=dependencies(function),
        )

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Return whether code for a signature is kept, here or in the wheel."""
        if self._shipped is not None and self._shipped.holds(sig, target_context):
            return True
        return holds(self, sig, target_context.codegen())

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
        if found is None and self._shipped is not None:
            found = self._shipped.load_overload(sig, target_context)
        if found is None:
            say_that_it_compiles(target_context)
            _progress.compile(self._name)
        else:
            _progress.load(self._name)
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

    def __init__(self, function: FunctionType) -> None:
        self._name = _full_name(function)
        self._shipped = shipped_kernel(function)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the code of the wheel; None without it, upon which numba compiles."""
        if self._shipped is not None:
            found = self._shipped.load_overload(sig, target_context)
            if found is not None:
                _progress.load(self._name)
                return found
        say_that_it_compiles(target_context)
        _progress.compile(self._name)
        _say_that_nothing_is_kept("no folder can be written")
        return None


def kernel_cache(function: FunctionType) -> KernelCache | NoCache:
    """Make the cache of a function."""
    _progress.know(_full_name(function))
    try:
        return KernelCache(function)
    # neither the package nor the user's cache folder can be written
    except RuntimeError:
        return NoCache(function)


def _full_name(function: FunctionType) -> str:
    return f"{function.__module__}.{function.__qualname__}"


def _say_that_nothing_is_kept(why: str) -> None:
    remedy = (
        "the next start compiles again. Set NUMBA_CACHE_DIR to a folder with room"
    )
    say_once(f"hybridvo: compiled code cannot be kept ({why}): {remedy}.")
