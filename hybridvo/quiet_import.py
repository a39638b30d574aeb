"""Imports of other people's packages that warn of their own deprecations when they are loaded.

Under ``-W error`` such a warning would end the first pair that needs the package in a traceback,
and its user can do nothing about it.
"""

from __future__ import annotations

import importlib
import sys
import threading
import warnings
from types import ModuleType

__all__ = ["quiet_import"]

_lock = threading.RLock()


def quiet_import(name: str) -> ModuleType:
    """A module, loaded without the deprecation warnings of its import.

    The filters of the caller are the same afterwards. While the module is loaded, once a process,
    deprecation warnings of other threads are not shown either: Python has one list for all.

    Args:
        name: of the module, as in ``import``.

    Raises:
        ImportError: it is not installed.
    """
    # one at a time: of two threads that restore the filters the slower would restore the other's
    with _lock:
        if name in sys.modules:
            return importlib.import_module(name)
        with (
            warnings.catch_warnings(action="ignore", category=DeprecationWarning),
            warnings.catch_warnings(action="ignore", category=FutureWarning),
        ):
            return importlib.import_module(name)
