"""The house: who imports whom, how large things are, what an import does."""

from __future__ import annotations

import ast
import graphlib
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.project import source_tree as source

ESTIMATION = {"core", "compiled", "flow"}
"""What every room of the estimate may import."""
PROGRAMS = ESTIMATION | {"pipeline", "network", "solver", "tracking"}
IMPORTS: dict[str, set[str]] = {
    # a frame walks from the top to the bottom
    "compiled": set(),
    "core": {"__init__"},
    "flow": ESTIMATION,
    "baselines": ESTIMATION,
    "solver": ESTIMATION,
    "judge": ESTIMATION | {"solver"},
    "hypotheses": ESTIMATION | {"solver", "judge"},
    "evidence": ESTIMATION | {"hypotheses"},
    "network": ESTIMATION | {"solver", "hypotheses"},
    "pipeline": ESTIMATION
    | {"network", "evidence", "hypotheses", "solver", "judge", "baselines"},
    "api": ESTIMATION | {"pipeline", "network", "solver"},
    "tracking": PROGRAMS | {"evidence", "hypotheses", "judge"},
    "io": PROGRAMS,
    "lab": PROGRAMS | {"hypotheses", "io"},
    "__init__": set(),
}
"""Room (a folder, or a file at the top) -> rooms it may import."""
APPLICATION = {"run", "__main__"}
"""The command line: may import everything, and nothing imports it."""

ONLY_IN = {
    "evo": {"lab/evaluation/metrics.py"},
    "matplotlib": {"lab/visualization/"},
    "plotly": {"lab/evaluation/"},
    "pandas": {"lab/evaluation/", "run/commands/"},
    "rerun": {"io/viewer/"},
    "rosbags": {"io/data/bags/"},
    "onnxruntime": {"io/onnx/session.py"},
    "rich": {"run/commands/"},
    "yaml": {"core/files.py"},
    "open3d": {"baselines/images.py"},
    "poselib": {"baselines/solvers.py"},
    "small_gicp": {"baselines/clouds.py"},
    "kiss_icp": {"baselines/clouds.py"},
    "safetensors": {"network/weights.py"},
    "pypose": {"core/torch_geometry.py"},
    "kornia": {"core/torch_geometry.py"},
    "pydantic": {"core/options.py", "network/", "lab/synthetic/", "lab/training/"},
}
"""Library -> the only files, or folders, that may import it."""

MAX_FUNCTION_LINES = 100
MAX_CONSTANTS = 40
"""Numbers that neither stand in ``calibration.py`` nor have a class in ``numbers.yaml`` that says
why they decide nothing: a fact of a format, an index, a guard, the size of a working set."""
MAX_PUBLIC_NAMES = 40


def test_rooms_import_only_what_stands_before_them() -> None:
    wrong = [
        f"{path} imports {other}"
        for path, others in source.own_imports().items()
        if source.room(path) not in APPLICATION
        for other in others
        if source.room(other) != source.room(path)
        and source.room(other) not in IMPORTS.get(source.room(path), set())
    ]
    assert not wrong, "\n".join(wrong)


def test_the_table_names_every_room() -> None:
    assert {source.room(path) for path in source.files()} <= set(
        IMPORTS
    ) | APPLICATION


TYPE_CIRCLES = {
    ("core/results.py", "solver/refine_images.py"),
    ("network/hypothesis_readings.py", "network/hypothesis_inputs.py"),
}
"""Imports for types alone that close a circle today; none may be added."""


@pytest.mark.parametrize("for_types", [False, True])
def test_no_file_imports_itself_by_way_of_others(for_types: bool) -> None:
    imports = source.own_imports(for_types)
    if for_types:
        # what type checkers see of the public names closes no circle of its own
        front = {"__init__.py": source.own_imports()["__init__.py"]}
        imports = {
            path: {other for other in others if (path, other) not in TYPE_CIRCLES}
            for path, others in (imports | front).items()
        }
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_nothing_imports_the_commands_the_tools_or_the_tests() -> None:
    for path, tree in source.files().items():
        names = {name.split(".")[0] for name in source.imported(tree)}
        assert not names & {"tools", "tests"}, path
        if source.room(path) not in APPLICATION:
            below = {source.room(other) for other in source.own_imports()[path]}
            assert not below & APPLICATION, path


@pytest.mark.parametrize("library", ONLY_IN)
def test_one_place_for_each_of_these_libraries(library: str) -> None:
    users = {
        path
        for path, tree in source.files().items()
        if any(name.split(".")[0] == library for name in source.imported(tree))
    }
    wrong = {path for path in users if not path.startswith(tuple(ONLY_IN[library]))}
    assert not wrong


def test_the_parts_of_evo_that_act_on_import_are_never_used() -> None:
    # evo.tools.settings writes into the home folder, evo.tools.plot sets a matplotlib backend
    for path, tree in source.files().items():
        for name in source.imported(tree):
            assert not name.startswith(
                ("evo.tools.settings", "evo.tools.plot", "evo.main")
            ), path


# --- sizes ----------------------------------------------------------------------------------------


def lines(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def python_files(folder: str) -> list[Path]:
    return sorted((source.ROOT / folder).rglob("*.py"))


def test_public_names_are_few() -> None:
    import hybridvo

    assert len(hybridvo.__all__) <= MAX_PUBLIC_NAMES


def test_functions_are_short() -> None:
    long = {
        name: count
        for name, count in source.functions().items()
        if count > MAX_FUNCTION_LINES
    }
    assert not long


def test_few_numbers_decide_outside_of_the_calibration() -> None:
    found = [
        f"{number.path}: {number.text}"
        for number in source.numbers_with_class()
        if number.heading in (None, source.DECIDES)
    ]
    assert len(found) <= MAX_CONSTANTS, "\n".join(found)


def test_every_number_has_a_place_or_a_class() -> None:
    found = [
        f"{number.path}: {number.text}"
        for number in source.numbers_with_class()
        if number.heading is None
    ]
    assert not found, (
        "A number that decides which answer is given, or whether it is believed, goes into "
        "the calibration.py of its room; any other one gets its class in numbers.yaml:\n"
        + "\n".join(found)
    )


def test_every_class_is_of_a_number_that_is_there() -> None:
    there = {
        (number.path, entry)
        for number in source.numbers_with_class()
        for entry in source.entries_of(number.text)
    }
    gone = [
        f"{heading}: {path}: {entry}"
        for heading, path, entry in source.classified()
        if (path, entry) not in there
    ]
    assert not gone, "\n".join(gone)


def test_a_number_has_one_class() -> None:
    count = Counter((path, entry) for _, path, entry in source.classified())
    assert not {key: times for key, times in count.items() if times > 1}


def test_a_name_of_the_calibrations_is_given_once() -> None:
    """A second one would change what the first decides, wherever it is used."""
    count = Counter(
        name
        for path, tree in source.files().items()
        if path.endswith("/calibration.py")
        for node in tree.body
        for name, _ in source.assigned(node)
    )
    assert len(count) > 100
    assert not {name: times for name, times in count.items() if times > 1}


NUMBERS = """
A, B = 0.3, 7
ROWS, COLUMNS = range(2)
NAMED = "0.3"

def decide(x, limit=0.2, shape=(1, 2)):
    y = 0.37 * x + 0.5
    z = x[12]
    if len(x) < 24 or x > 1:
        return {"low": 0.86}
"""


def test_every_number_that_decides_is_counted() -> None:
    """Tuples, defaults and the bodies of functions included; indices and halves are none."""
    tree = ast.parse(NUMBERS)
    found = [
        *source._in_constants(tree),
        *source._in_defaults(tree),
        *source._in_bodies(tree),
    ]
    assert found == [
        *("A = 0.3", "B = 7", "decide(... = 0.2)"),
        *("decide: 0.37", "decide: 24", "decide: 0.86"),
    ]


# --- what an import does --------------------------------------------------------------------------


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


@pytest.mark.slow
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
import hybridvo
names = [m.name for m in pkgutil.walk_packages(hybridvo.__path__, "hybridvo.")]
modules = [importlib.import_module(name) for name in names]
after = state()
print(json.dumps([len(names), [i for i, (a, b) in enumerate(zip(before, after)) if a != b]]))
"""
    count, changed = fresh(code)
    assert count > 40
    assert changed == []
