"""The cache of compiled kernels: no file in it, and no full disk, can stop the program."""

from __future__ import annotations

import errno
import importlib
import importlib.util
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import caching

from hybridvo.compiled import kernel_cache

SOURCE = """
from hybridvo.compiled.numba_tools import njit

@njit(cache=True)
def twice(x):
    return 2 * x
"""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "kernels.py"
    path.write_text(SOURCE)
    return path


@pytest.fixture(autouse=True)
def warnings_are_heard(caplog) -> None:
    kernel_cache.say_once.cache_clear()
    caplog.set_level(logging.WARNING, "hybridvo")


def load(path: Path) -> Callable[[int], int]:
    """The kernel as another process would see it: with nothing compiled, nothing said."""
    kernel_cache.say_once.cache_clear()
    return new(path)


def new(path: Path) -> Callable[[int], int]:
    """The kernel with nothing compiled."""
    spec = importlib.util.spec_from_file_location("kernels", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.twice


def hits(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def files(source: Path, ending: str) -> list[Path]:
    return list((source.parent / "__pycache__").glob(f"*.{ending}"))


def test_the_first_call_says_that_it_compiles_and_a_cached_one_says_nothing(
    source, caplog
):
    assert load(source)(21) == 42
    assert [record.message for record in caplog.records] == [
        "hybridvo: compiling once, about a minute"
    ]
    assert caplog.records[0].name.startswith("hybridvo.")
    caplog.clear()
    again = load(source)
    assert again(21) == 42 and hits(again) == 1
    assert caplog.records == []


FROM_ELSEWHERE = """
from hybridvo.compiled.numba_tools import njit
from {module} import FACTOR, scaled

@njit()
def twice(x):
    return FACTOR * scaled(x)
"""
ELSEWHERE = """
from hybridvo.compiled.numba_tools import njit

FACTOR = {factor}

@njit()
def scaled(x):
    return {scale} * x
"""


@pytest.mark.parametrize(
    ("factor", "scale"), [(3, 1), (2, 5)], ids=["a number", "a kernel"]
)
def test_a_kernel_is_compiled_anew_when_what_it_uses_changes(
    tmp_path, monkeypatch, factor, scale
):
    """Numba looks at the kernel's own file alone, and freezes numbers of other files into it."""
    monkeypatch.syspath_prepend(tmp_path)
    # one name a case: python keeps what it imported
    module = f"elsewhere_{factor}_{scale}"
    elsewhere = tmp_path / f"{module}.py"
    kernels = tmp_path / "kernels.py"
    kernels.write_text(FROM_ELSEWHERE.format(module=module))
    elsewhere.write_text(ELSEWHERE.format(factor=2, scale=1))
    assert load(kernels)(21) == 42
    again = load(kernels)
    assert again(21) == 42
    assert hits(again) == 1
    monkeypatch.delitem(sys.modules, module)
    elsewhere.write_text(ELSEWHERE.format(factor=factor, scale=scale) + "# longer")
    importlib.invalidate_caches()
    assert load(kernels)(21) == 21 * factor * scale


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", ["empty", "cut", "random", "pickle"])
def test_damaged_files_are_replaced(source, ending, damage, caplog):
    load(source)(21)
    (path,) = files(source, ending)
    whole = path.read_bytes()
    # the pickle of None, behind that of the version where it is an index
    nothing = b"N."
    version = whole[: whole.index(b".") + 1] if ending == "nbi" else b""
    damaged = {
        "empty": b"",
        "cut": whole[:-20],
        "random": np.random.default_rng(0).bytes(500),
        "pickle": version + nothing,
    }
    path.write_bytes(damaged[damage])
    caplog.clear()
    assert load(source)(21) == 42
    assert len(caplog.records) == 1
    mended = load(source)
    assert mended(21) == 42 and hits(mended) == 1


def test_a_full_disk_is_one_line_and_the_program_goes_on(
    source, monkeypatch, caplog
):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(caching.IndexDataCacheFile, "_open_for_write", full)
    other = source.parent / "below" / "kernels.py"
    other.parent.mkdir()
    other.write_text(SOURCE)
    first, second = new(source), new(other)
    assert first(21) == 42 and first(0.5) == 1.0 and second(21) == 42
    told = [
        record.message
        for record in caplog.records
        if "cannot be kept" in record.message
    ]
    assert len(told) == 1
    assert "No space left" in told[0] and "NUMBA_CACHE_DIR" in told[0]


def test_without_any_folder_to_write_to_it_compiles_in_every_process(
    source, monkeypatch, caplog
):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    assert load(source)(21) == 42
    assert "no folder can be written" in caplog.records[-1].message
    assert files(source, "nbi") == []
