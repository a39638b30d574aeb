"""What an import does: it loads nothing heavy and changes no setting.

Which room may import which is stated in pyproject.toml, for import-linter: ``make check``.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter

import pytest

from tests.project import source_tree as source


def test_a_name_of_the_calibrations_is_given_once() -> None:
    """A second one would change what the first decides, wherever it is used."""
    count = Counter(
        name
        for path, tree in source.files_of_both().items()
        if path.endswith("/calibration.py")
        for name in source.constants(tree)
    )
    assert len(count) > 100
    assert not {name: times for name, times in count.items() if times > 1}


def fresh(code: str) -> dict:
    """What a fresh interpreter, to which warnings are errors, prints as JSON."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=source.ROOT,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout)


def test_import_loads_nothing_and_changes_nothing() -> None:
    code = """
import json, logging, os, sys, threading
before = dict(os.environ), os.listdir()
import hybridvo
hybridvo.__version__
heavy = ("torch", "evo", "matplotlib", "kornia", "pypose", "numba", "cv2", "scipy", "numpy")
print(json.dumps({
    "heavy": [name for name in heavy if name in sys.modules],
    "unchanged": before == (dict(os.environ), os.listdir()),
    "handlers": len(logging.getLogger().handlers) + len(logging.getLogger("hybridvo").handlers),
    "threads": threading.active_count(),
}))
"""
    assert fresh(code) == {
        "heavy": [],
        "unchanged": True,
        "handlers": 0,
        "threads": 1,
    }


def test_help_loads_no_heavy_library() -> None:
    code = """
import contextlib, io, json, sys
from hybridvo.run.cli import main
out = io.StringIO()
with contextlib.redirect_stdout(out):
    try:
        main(["--help"])
    except SystemExit as end:
        assert not end.code
assert "run" in out.getvalue() and "doctor" in out.getvalue()
heavy = ("torch", "evo", "matplotlib", "kornia", "pypose", "numba", "cv2", "scipy")
print(json.dumps([name for name in heavy if name in sys.modules]))
"""
    assert fresh(code) == []


@pytest.mark.long
def test_importing_every_module_changes_no_setting() -> None:
    """Thread counts, environment, log handlers and modes stay as the libraries leave them."""
    code = """
import importlib, json, logging, os, pkgutil, warnings
warnings.filterwarnings("ignore", message=".*torch.jit.script.*")
import cv2, evo, kornia, matplotlib, numba, numpy, pypose, scipy, torch
def state():
    return [
        torch.get_num_threads(), torch.get_num_interop_threads(), cv2.getNumThreads(),
        numba.get_num_threads(), torch.get_default_dtype() == torch.float32,
        torch.is_grad_enabled(), matplotlib.get_backend(), numpy.geterr(), sorted(os.environ),
        len(logging.getLogger().handlers), len(logging.getLogger("hybridvo").handlers),
        len(os.listdir()),
    ]
numba.get_num_threads()  # starts numba's threads, which changes what torch says
before = state()
import hybridvo, hybridvo_lab
names = [
    m.name
    for package in (hybridvo, hybridvo_lab)
    for m in pkgutil.walk_packages(package.__path__, package.__name__ + ".")
]
modules = [importlib.import_module(name) for name in names]
after = state()
print(json.dumps([len(names), [i for i, (a, b) in enumerate(zip(before, after)) if a != b]]))
"""
    count, changed = fresh(code)
    assert count > 40
    assert changed == []
