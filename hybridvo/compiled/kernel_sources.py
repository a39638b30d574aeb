"""What the machine code of a kernel was made of: files and constants."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Iterator
from enum import EnumMeta
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

CONSTANTS = (bool, int, float, str, tuple, np.generic, EnumMeta)
"""Types of the global values that numba freezes into a kernel."""


def dependencies(function: FunctionType) -> tuple[str, ...]:
    """Return what the machine code of a function depends on.

    It is the same on every machine and after every copy of the files, for no path
    and no time is part of it.

    Returns:
        Sorted lines: names and values of the constants that it reads; names and
        hashes of its file and of those of the kernels that it calls, with theirs.
    """
    lines = {_file_stamp(function)}
    visited: set[FunctionType] = set()
    _collect(function, lines, visited)
    return tuple(sorted(lines))


def kernels_called(kernel: Any) -> list[FunctionType]:
    """Return the Python functions of the kernels that a kernel calls itself."""
    values = [value for _, value in _globals_used(kernel.py_func)]
    called = [getattr(value, "py_func", None) for value in values]
    return [python for python in called if isinstance(python, FunctionType)]


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
    """Name and hash of the file of a function."""
    path = function.__code__.co_filename
    try:
        status = os.stat(path)
    # in an archive, which its loader reads
    except OSError:
        loader = function.__globals__.get("__loader__")
        content = b"" if loader is None else loader.get_data(path)
        digest = hashlib.sha256(content).hexdigest()
    else:
        digest = _hash_of(path, status.st_mtime_ns, status.st_size)
    return f"{os.path.basename(path)} {digest}"


@functools.cache
def _hash_of(path: str, time_ns: int, size: int) -> str:
    """Hash of a file; time and size state that it is the one read before."""
    with open(path, "rb") as file:
        return hashlib.sha256(file.read()).hexdigest()
