"""Numba's cache on disk: there where it can be, no reason to fail where it cannot, same numbers.

A kernel that is compiled calls those that were compiled before it in the same process; one that is
read from the cache brings its own copies of them along. Both are right, but they sum in another
order: motions differ in the eighth digit. So what is not in the cache yet is compiled by a process
of its own (:func:`compile_once`), and every run reads the same code.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hybridvo.errors import InputError

MOST_THREADS = 4096
"""More than a machine has cores; a million end the process where numba starts them."""


def check_threads() -> None:
    """Refuse a ``NUMBA_NUM_THREADS`` that numba answers with a traceback, or with a crash.

    Raises:
        InputError: no whole number from 1 to ``MOST_THREADS``.
    """
    setting = os.environ.get("NUMBA_NUM_THREADS")
    try:
        usable = setting is None or 1 <= int(setting) <= MOST_THREADS
    except ValueError:
        usable = False
    if not usable:
        raise InputError(
            f"NUMBA_NUM_THREADS (environment): expected a whole number from 1 to {MOST_THREADS}, "
            f"got {setting!r}. Unset it: numba then takes as many threads as there are cores."
        )


check_threads()  # before numba reads it
import numba  # noqa: E402
from numba import types  # noqa: E402
from numba.extending import intrinsic  # noqa: E402

__all__ = ["check_threads", "compile_once", "intrinsic", "njit", "types"]

LONGEST_S = 1200.0
"""Patience with the compiling process, seconds: twenty times what it takes."""

COMPILING = "HYBRIDVO_COMPILING"
"""In the environment of the process that compiles: it must not ask for another one."""

_logger = logging.getLogger(__name__)

_cached: list[Any] = []
"""The functions that have a cache: they know where it is."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``numba.njit`` to which a cache is a help and never a condition.

    Without a folder that can be written the function is compiled in every process; a full disk or
    a damaged cache file cost a compilation as well, and no exception.

    Args:
        **options: of ``numba.njit``; with ``cache=True``, or it makes no difference.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            compiled = numba.njit(**options)(function)
        except RuntimeError:  # numba: no locator available
            return numba.njit(**options | {"cache": False})(function)
        if hasattr(compiled, "stats"):  # not where numba is switched off
            _cached.append(compiled)
        cache = getattr(compiled, "_cache", None)
        index: Any = getattr(cache, "_cache_file", None)
        if hasattr(index, "_source_stamp"):
            index._source_stamp = _stamp(_file(compiled).parent)
        for name in ("save_overload", "load_overload"):
            if hasattr(cache, name):
                setattr(cache, name, _forgiving(getattr(cache, name)))
        return compiled

    return decorate


@functools.cache
def _stamp(folder: Path) -> tuple[Any, ...]:
    """What numba's cache has to belong to: every file with kernels beside the function's own.

    Numba looks at the file of the function alone, though its code holds that of the functions that
    it calls: after a change of theirs it would go on with the old ones, or fail between the two.
    """
    return tuple(
        (f.name, s.st_mtime_ns, s.st_size) for f in sorted(_files(folder)) for s in [f.stat()]
    )


def _files(folder: Path) -> set[Path]:
    """The files with kernels, whether they are imported yet or not."""
    return {f for f in folder.glob("*.py") if b"njit" in f.read_bytes()}


def _forgiving(act: Callable[..., Any]) -> Callable[..., Any]:
    """``act``, or None where it fails: numba lets every error of its cache through."""

    def attempt(*arguments: Any) -> Any:
        try:
            return act(*arguments)
        except Exception as error:  # a full disk, a truncated pickle, a foreign file
            _logger.debug("numba's cache: %s: %s", type(error).__name__, error)
            return None

    return attempt


def compile_once(code: str, sources: Path, name: str) -> bool:
    """Have the kernels of a folder compiled into the cache by another process.

    The first time that they are needed on this machine; nothing where there is no cache.

    Args:
        code: Python that compiles them.
        sources: folder of the files that define them; a change of one makes it the first time.
        name: of this set of kernels, a plain word.

    Returns:
        Whether they are in the cache now.
    """
    kernels = [k for k in _cached if _file(k).parent == sources and k.stats.cache_path]
    if not kernels or not sys.executable or getattr(sys, "frozen", False):
        return False
    if os.environ.get(COMPILING):  # this is that process
        return False
    folder = Path(kernels[0].stats.cache_path)
    mark = folder / f"{name}-{_fingerprint({_file(k) for k in kernels} | _files(sources))}.compiled"
    if mark.exists():
        return True
    _logger.warning("compiling the kernels, once on this machine: up to a minute ...")
    package = os.fspath(Path(__file__).resolve().parents[1])
    paths = [package, *filter(None, [os.environ.get("PYTHONPATH")])]
    try:
        done = subprocess.run(
            # -P: not the modules that lie in the current folder, which may be a data set's
            [sys.executable, "-P", "-c", code],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), COMPILING: "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=LONGEST_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    if done.returncode != 0:
        return False
    with contextlib.suppress(OSError):
        for older in folder.glob(f"{name}-*.compiled"):
            older.unlink(missing_ok=True)
        mark.touch()
    return True


def _file(kernel: Any) -> Path:
    """Where a function is defined."""
    return Path(kernel.py_func.__code__.co_filename).resolve()


def _fingerprint(sources: Iterable[Path]) -> str:
    """Of what numba's cache depends on: the code, the compiler and the processor."""
    import llvmlite
    from llvmlite import binding

    digest = hashlib.sha256()
    for word in (
        *(platform.python_version(), numba.__version__, llvmlite.__version__),
        *(binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()),
    ):
        digest.update(f"{word}\0".encode())
    for path in sorted(sources):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
