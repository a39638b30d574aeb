"""Compiled kernels of a wheel: used where they fit, and where they do not, numba compiles."""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import caching
from numba.core.registry import cpu_target

from hybridvo.compiled import kernel_cache, shipped_kernels
from tests.scripts import ROOT, load_script

build_wheel = load_script("tools/build_wheel.py")
SOURCE = """
import numpy as np
from hybridvo.compiled.numba_tools import njit

SCALE = 2.0

@njit(fastmath=True)
def norm(x):
    total = np.float32(0)
    for value in x:
        total += value * value
    return SCALE * np.sqrt(total)
"""
"""A sum that is vectorised: its order, and with it the rounding, depends on the processor."""
COMPILE = """
import sys
from pathlib import Path
import numpy as np
import kernels
from tests.scripts import load_script
kernels.norm(np.ones(3, np.float32))
calls = load_script("tools/kernel_calls.py")
package, cache, out = map(Path, sys.argv[1:])
assert calls.collect(package, cache, out) == 1
"""
X = np.random.default_rng(0).normal(size=1000).astype(np.float32)
TRUE = 2 * np.sqrt(np.sum(X.astype(float) ** 2))
ROUNDING = 1e-5
"""Relative: 1000 terms of float32, each with half a unit, are 6e-5 at worst and 2e-6 as a walk."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """A folder as the wheel has it: a source, and its kernel, compiled elsewhere."""
    if shipped_kernels.instructions(
        build_wheel.FEATURES["x86-64-v3"]
    ) - shipped_kernels.instructions(here().features):
        pytest.skip("this processor has fewer instructions than x86-64-v3")
    folder = tmp_path_factory.mktemp("wheel")
    sources = folder / "sources"
    cache = folder / "cache"
    cache.mkdir()
    (sources / "inner").mkdir(parents=True)
    (sources / "kernels.py").write_text(SOURCE)
    code = subprocess.run(
        [sys.executable, "-c", COMPILE, sources, cache, sources / "compiled"],
        env=build_wheel.compiling_for("x86-64-v3")
        | {
            "PYTHONPATH": os.pathsep.join((str(sources), str(ROOT))),
            "NUMBA_CACHE_DIR": str(cache),
        },
        check=False,
        capture_output=True,
        text=True,
    )
    assert code.returncode == 0, code.stderr
    return sources


@pytest.fixture
def package(wheel, tmp_path, monkeypatch, caplog) -> Path:
    """The wheel, unpacked in another place; nothing is compiled yet."""
    folder = tmp_path / "elsewhere"
    # another time than that of the build, as pip writes it
    shutil.copytree(wheel, folder, copy_function=shutil.copyfile)
    shutil.rmtree(folder / "__pycache__", ignore_errors=True)
    monkeypatch.setattr(shipped_kernels, "PACKAGE", folder)
    monkeypatch.setattr(shipped_kernels, "FOLDER", folder / "compiled")
    monkeypatch.setitem(sys.modules, "kernels", None)  # gone after the test
    kernel_cache.say_once.cache_clear()
    shipped_kernels.shipped_build.cache_clear()
    caplog.set_level(logging.WARNING, "hybridvo")
    yield folder
    shipped_kernels.shipped_build.cache_clear()


def here() -> shipped_kernels.Build:
    return shipped_kernels.build_here(cpu_target.target_context.codegen())


def load(folder: Path) -> Callable[[np.ndarray], float]:
    spec = importlib.util.spec_from_file_location("kernels", folder / "kernels.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["kernels"] = module  # numba looks the globals up there
    spec.loader.exec_module(module)
    return module.norm


def hits(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def restate(folder: Path, **changes: str) -> None:
    path = folder / "compiled" / "build.json"
    stated = json.loads(path.read_text())
    path.write_text(json.dumps(stated | changes))


def test_the_wheels_code_is_used_and_nothing_is_compiled(package, caplog):
    kernel = load(package)
    assert kernel(X) == pytest.approx(TRUE, rel=ROUNDING)
    assert hits(kernel) == 1
    assert caplog.records == []
    assert not list(package.rglob("__pycache__/*.nb?"))


def test_it_is_used_where_no_folder_can_be_written(package, monkeypatch, caplog):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    kernel = load(package)
    assert kernel(X) == pytest.approx(TRUE, rel=ROUNDING)
    assert hits(kernel) == 1
    assert caplog.records == []


@pytest.mark.parametrize("name", ["python", "numba", "llvmlite", "triple"])
def test_the_code_of_another_version_is_not_used(package, caplog, name):
    restate(package, **{name: "0.1"})
    kernel = load(package)
    assert kernel(X) == pytest.approx(TRUE, rel=ROUNDING)
    assert hits(kernel) == 0
    (record,) = caplog.records
    expected = (
        f"those of the wheel are for {name} 0.1, here is {getattr(here(), name)}"
    )
    assert expected in record.message


def test_a_processor_that_lacks_an_instruction_does_not_run_the_code(
    package, caplog
):
    restate(package, features="+sse2,+warp-drive")
    kernel = load(package)
    assert kernel(X) == pytest.approx(TRUE, rel=ROUNDING)
    assert hits(kernel) == 0
    (record,) = caplog.records
    assert record.message.endswith("need a processor with warp-drive)")


@pytest.mark.parametrize(
    ("old", "new", "factor"),
    [
        ("SCALE = 2.0", "SCALE = 3.0", 1.5),
        ("value * value", "value * 4 * value", 2),
    ],
    ids=["a constant", "the code"],
)
def test_the_code_of_another_source_is_not_used(package, old, new, factor):
    source = package / "kernels.py"
    source.write_text(SOURCE.replace(old, new))
    kernel = load(package)
    assert kernel(X) == pytest.approx(factor * TRUE, rel=ROUNDING)
    assert hits(kernel) == 0


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_damaged_code_is_not_used(package, ending):
    (path,) = (package / "compiled").rglob(f"*.{ending}")
    path.write_bytes(path.read_bytes()[:-20])
    kernel = load(package)
    assert kernel(X) == pytest.approx(TRUE, rel=ROUNDING)
    assert hits(kernel) == 0


@pytest.mark.parametrize("text", ["", "{", "[]", '{"numba": "0.68.1"}'])
def test_kernels_of_an_unknown_build_are_not_used(package, text):
    (package / "compiled" / "build.json").write_text(text)
    kernel = load(package)
    assert kernel(X) == pytest.approx(TRUE, rel=ROUNDING)
    assert hits(kernel) == 0


def test_what_the_user_asks_numba_for_decides():
    """NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= is to avoid AVX: then no AVX comes in."""
    wheel = replace(here(), cpu="x86-64-v3", features="+sse2,+avx2")
    generic = replace(here(), cpu="generic", features="")
    newer = replace(here(), features="+avx2,+avx512f,+sse2,-sse4a")
    absent = replace(here(), features="-avx2,+sse2")
    assert "avx2, sse2" in wheel.obstacle(generic)
    assert wheel.obstacle(newer) == ""
    assert wheel.obstacle(absent).endswith(" with avx2")


def test_the_baseline_is_the_level_of_the_x86_64_psabi():
    """Table 3.1 of the psABI, levels 1 to 3, under LLVM's names.

    Of its names, FPU, SCE, OSFXSR and OSXSAVE are of the system and LLVM has none.
    """
    level_1 = {"cmov", "cx8", "fxsr", "mmx", "sse", "sse2"}
    level_2 = {"cx16", "sahf", "popcnt", "sse3", "sse4.1", "sse4.2", "ssse3"}
    level_3 = {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"}
    implied = {"64bit", "crc32", "xsave"}
    stated = shipped_kernels.instructions(build_wheel.FEATURES["x86-64-v3"])
    assert stated == level_1 | level_2 | level_3 | implied
