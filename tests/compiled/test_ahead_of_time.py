"""Kernels that are compiled in several processes before they are called."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from numba.core import types

import hybridvo_lab
from hybridvo.compiled import ahead_of_time
from hybridvo.solver.noise_estimation import Noise
from tests.scripts import ROOT

SOURCE = """
from typing import NamedTuple

import numpy as np
from hybridvo.compiled.numba_tools import njit

class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray

@njit()
def inner(x):
    return 2 * x

@njit()
def outer(pair):
    return inner(pair.first[0]) + pair.second[0]

@njit()
def alone(x):
    return x + 1
"""
VECTOR = ["array", "float64", 1, "C", False]
TABLE = {
    "ahead_kernels:alone": [["float64"], ["int64"]],
    "ahead_kernels:inner": [["float64"]],
    "ahead_kernels:outer": [[["ahead_kernels:Pair", VECTOR, VECTOR]]],
}
CALL = """
import logging
import numpy as np
import ahead_kernels as kernels
logging.basicConfig(level=logging.WARNING)
vector = np.ones(1)
assert kernels.outer(kernels.Pair(vector, vector)) == 3
assert kernels.alone(1) == 2 and kernels.alone(0.5) == 1.5
for kernel in kernels.outer, kernels.alone:
    assert not kernel.stats.cache_misses, kernel
"""
COMPILE = """
import sys
from pathlib import Path
from hybridvo.compiled.ahead_of_time import compile_ahead
if __name__ == "__main__":
    print(compile_ahead(2, Path(sys.argv[1])))
"""
CALLED = """
import json
from tests.scripts import load_script
calls = load_script("tools/kernel_calls.py")
import hybridvo, hybridvo_lab
from hybridvo_lab.commands.demo import demo_frames
calls.call_all()
demo_frames(2)
print(json.dumps(calls.signatures(hybridvo) | calls.signatures(hybridvo_lab)))
"""

WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in {absent}:
            raise ImportError(name)

sys.meta_path.insert(0, Absent())
from hybridvo.compiled.ahead_of_time import find_kernel, read_signature, read_table
for name, signatures in read_table().items():
    find_kernel(name)
    for signature in signatures:
        read_signature(signature)
"""


@pytest.mark.parametrize(
    "numba_type",
    [
        types.int64,
        types.boolean,
        types.npy_rng,
        types.literal(4),
        types.Array(types.float32, 2, "C", readonly=True),
        types.Array(types.uint8, 3, "A"),
        types.UniTuple(types.float32, 2),
        types.Tuple((types.int64, types.Array(types.float64, 1, "F"))),
        types.NamedUniTuple(types.float64, 2, Noise),
    ],
    ids=str,
)
def test_a_type_is_read_as_it_was_described(numba_type):
    text = json.dumps(ahead_of_time.describe_type(numba_type))
    again = ahead_of_time.read_type(json.loads(text))
    assert again == numba_type
    if isinstance(numba_type, types.Array):
        assert again.mutable == numba_type.mutable


@pytest.mark.slow
def test_the_next_process_compiles_nothing(tmp_path):
    (tmp_path / "ahead_kernels.py").write_text(SOURCE)
    (tmp_path / "compile.py").write_text(COMPILE)
    ahead_of_time.write_table(TABLE, tmp_path / "table.json")
    assert ahead_of_time.read_table(tmp_path / "table.json") == TABLE
    first, again = (
        run(tmp_path, "compile.py", "table.json").stdout.split() for _ in range(2)
    )
    assert first == ["3"]
    assert again == ["0"]
    said = run(tmp_path, "-c", CALL).stderr
    assert "compiling" not in said


@pytest.mark.slow
def test_the_table_has_all_that_the_package_calls(tmp_path):
    called = json.loads(run(ROOT, "-c", CALLED).stdout)
    table = ahead_of_time.read_table()
    table |= ahead_of_time.read_table(hybridvo_lab.KERNELS)
    missing = {
        name: [entry for entry in signatures if entry not in table.get(name, [])]
        for name, signatures in called.items()
    }
    remedy = (
        "NUMBA_CACHE_DIR=EMPTY_FOLDER python tools/kernel_calls.py --signatures"
    )
    assert not any(missing.values()), f"{missing}; {remedy}"
    assert len(called) > 30


def test_a_kernel_takes_as_many_arguments_as_the_table_states():
    for name, signatures in ahead_of_time.read_table().items():
        names = inspect.signature(
            ahead_of_time.find_kernel(name).py_func
        ).parameters
        for signature in signatures:
            assert len(ahead_of_time.read_signature(signature)) == len(names), name


def test_all_kernels_can_be_imported_before_the_other_packages_are_installed():
    """``make`` compiles while pip still installs PyTorch and the others."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    stated = re.search(r"^KERNELS_NEED := (.+)$", makefile, re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    names = project["project"]["dependencies"]
    core = {re.split(r"[<>=\[;]", name)[0] for name in names}
    present = set(stated[1].split())
    # numba brings it
    absent = core - present - {"numpy"}
    assert present < core and "torch" in absent
    run(ROOT, "-c", WITHOUT.format(absent=absent | {"rosbags"}))


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python where it finds this package and the modules of a folder."""
    path = os.pathsep.join((str(folder), str(ROOT)))
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": path},
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done
