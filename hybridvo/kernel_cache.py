"""Compiled kernels on disk: where they are damaged or find no room, the program goes on."""

from __future__ import annotations

import contextlib
import functools
import logging
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache, NullCache

_logger = logging.getLogger(__name__)
PACKAGE = Path(__file__).parent
COMPILED_IN = tuple(
    PACKAGE / name
    for name in (
        "calibration.py",
        "geometry.py",
        "numba_tools.py",
        "refinement/kernels.py",
        "refinement/depth.py",
        "refinement/noise_estimation.py",
        "refinement/robust_fit.py",
    )
)
"""Files whose numbers and kernels the machine code of other files contains."""


@functools.cache
def say_once(text: str) -> None:
    """Log a warning, unless this process has done so before."""
    _logger.warning(text)


def say_that_it_compiles() -> None:
    """Tell once why the first call lasts so long."""
    say_once("hybridvo: compiling once, about a minute")


class KernelCache(FunctionCache):
    """numba's cache of the machine code of one function, which no file can stop."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        # numba compares the function's own file alone
        stamps = (self._cache_file._source_stamp, *_compiled_in())
        self._cache_file._source_stamp = stamps

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the code for a signature; None, upon which it is compiled, where that fails."""
        found = None
        try:
            found = super().load_overload(sig, target_context)
        # pickle and LLVM raise all kinds of errors for bytes that they have not written
        except Exception:
            with contextlib.suppress(OSError):
                self.flush()  # an empty index, in place of one that may be damaged
        if found is None:
            say_that_it_compiles()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for a signature, if there is room."""
        try:
            super().save_overload(sig, data)
        except Exception as error:
            # without the folder, of which there are several: it is said once
            _say_that_nothing_is_kept(
                getattr(error, "strerror", None) or type(error).__name__
            )


class NoCache(NullCache):
    """In place of a cache where no folder can be written."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """Find nothing, upon which numba compiles."""
        say_that_it_compiles()
        _say_that_nothing_is_kept("no folder can be written")


def _compiled_in() -> list[tuple[int, int]]:
    """Return time of change and size of each file that other files compile in."""
    stats = [path.stat() for path in COMPILED_IN if path.exists()]
    return [(found.st_mtime_ns, found.st_size) for found in stats]


def kernel_cache(function: Any) -> KernelCache | NoCache:
    """Make the cache of a function."""
    try:
        return KernelCache(function)
    # neither the package nor the user's cache folder can be written
    except RuntimeError:
        return NoCache()


def _say_that_nothing_is_kept(why: str) -> None:
    remedy = (
        "the next start compiles again. Set NUMBA_CACHE_DIR to a folder with room"
    )
    say_once(f"hybridvo: compiled code cannot be kept ({why}): {remedy}.")
