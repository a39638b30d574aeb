"""The house: who imports whom, what an import does, how long a file is."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "hybridvo"
MAX_LINES = 500
"""A file is one noun; the aim is 400 lines."""

NOUNS = {"checks", "errors", "types"}
ESTIMATORS = {"pose", "refinement", "hypotheses", "baselines"}
CLASSICAL = NOUNS | {"geometry"} | ESTIMATORS
IMPORTS: dict[str, set[str]] = {
    # the house itself: data walks from left to right
    "errors": set(),
    "files": {"errors"},
    "checks": {"errors"},
    "types": {"checks", "errors"},
    "compilation": {"errors"},
    "quiet_import": set(),
    "geometry": NOUNS,
    "units": set(),
    "data": NOUNS | {"geometry", "compilation", "files", "units"},
    "flow": NOUNS | {"geometry"},
    "network": NOUNS | {"geometry"},
    **{room: CLASSICAL | {"compilation", "quiet_import"} for room in sorted(ESTIMATORS)},
    "trajectory": NOUNS | {"geometry", "files", "units"},
    "learned": CLASSICAL | {"network"},
    "flow_check": NOUNS,
    "learned_judge": CLASSICAL | {"network", "learned"},
    "pipeline": CLASSICAL | {"network", "learned", "learned_judge", "compilation", "flow_check"},
    "tracking": CLASSICAL,
    "odometry": CLASSICAL | {"flow", "pipeline", "tracking", "trajectory"},
    "evaluation": NOUNS | {"geometry", "trajectory"},
    "training": CLASSICAL | {"data", "flow", "network", "learned", "pipeline"},
    # one run of `hybridvo run`: what it writes, how it is set, and the loop around the tracker
    "console": {"errors"},
    "run_folder": {"checks", "errors", "evaluation"},
    "recording": NOUNS | {"evaluation"},
    "depth_steps": NOUNS,
    "run_results": NOUNS | {"geometry", "data", "trajectory", "evaluation", "depth_steps"},
    "run_report": {"errors", "evaluation"},
    "configuration": CLASSICAL | {"data", "flow", "pipeline", "odometry", "tracking"},
    "run": {
        *("__init__", "errors", "types", "geometry", "data", "flow", "pipeline", "odometry"),
        *("trajectory", "evaluation", "configuration", "console", "run_folder", "run_results"),
        *("recording", "compilation", "tracking", "depth_steps"),
    },
    # what tools/compare_methods.py runs, on this machine and on others
    "comparison": {
        *("__init__", "errors", "types", "geometry", "data", "flow", "pipeline", "trajectory"),
        *("evaluation", "configuration", "console", "run_folder", "run_results", "run", "checks"),
        *("learned_judge", *ESTIMATORS),
    },
    # figures of one pair: tools/visualize.py, and the report of a comparison
    "visualization": {
        *("checks", "errors", "types", "geometry", "data", "network", *ESTIMATORS, "learned"),
        *("pipeline", "trajectory", "evaluation", "configuration", "run"),
    },
    # what stands at the door
    "demo": {"checks", "errors", "data", "evaluation", "configuration", "run"},
    "doctor": {"__init__", "compilation", "errors", "pipeline"},
    "diagnosis_findings": CLASSICAL | {"depth_steps"},
    "diagnosis": CLASSICAL | {"flow", "diagnosis_findings", "depth_steps"},
    "__init__": set(),
}
"""Room -> rooms it may import. ``cli`` and the tools may import everything."""

ONLY_IN = {
    "evo": {"evaluation/metrics.py", "trajectory.py"},
    "evo.core.metrics": {"evaluation/metrics.py"},
    "matplotlib": {
        f"evaluation/plots{part}.py" for part in ("", "_calibration", "_comparison", "_maps")
    },
}
"""Module -> the files that may import it."""


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def imported(source: str) -> set[str]:
    """Dotted names of all modules that a source imports, inside functions as well."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            assert node.module is not None
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return names


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def rooms_in(names: set[str]) -> set[str]:
    """First part below ``hybridvo`` of each imported name."""
    known = {room_of(path) for path in sources()}
    parts = [name.split(".") for name in names if name.split(".")[0] == "hybridvo"]
    return {p[1] if len(p) > 1 and p[1] in known else "__init__" for p in parts}


def test_rooms_import_only_what_stands_before_them():
    back_edges = []
    for path in sources():
        room = room_of(path)
        if room == "cli":
            continue
        assert room in IMPORTS, f"{room}: a new room; say in this table what it may import"
        for other in rooms_in(imported(path.read_text(encoding="utf-8"))) - {room}:
            if other not in IMPORTS[room]:
                back_edges.append(f"{path.relative_to(ROOT)} imports {other}")
    assert not back_edges, "\n".join(back_edges)


def test_the_table_has_no_cycle():
    done: set[str] = set()
    waiting = dict(IMPORTS)
    while waiting:
        free = [room for room, needs in waiting.items() if needs <= done]
        assert free, f"a cycle among {sorted(waiting)}"
        done.update(free)
        for room in free:
            del waiting[room]


def test_the_table_names_no_room_that_is_gone():
    assert set(IMPORTS) <= {room_of(path) for path in sources()}


def test_nothing_imports_cli_tools_or_tests():
    for path in sources():
        names = imported(path.read_text(encoding="utf-8"))
        first = {name.split(".")[0] for name in names}
        assert not first & {"tools", "tests"}, path
        assert "cli" not in rooms_in(names), path


def test_the_reader_of_imports_sees_edges_in_functions():
    source = "def f():\n    from hybridvo.network import pwvo\n    import evo.core.metrics\n"
    assert rooms_in(imported(source)) == {"network"}
    assert "evo.core.metrics" in imported(source)
    assert rooms_in(imported("from hybridvo import __version__")) == {"__init__"}


@pytest.mark.parametrize("module", ONLY_IN)
def test_one_place_for_each_of_these_libraries(module):
    files = {
        path.relative_to(PACKAGE).as_posix()
        for path in sources()
        for name in imported(path.read_text(encoding="utf-8"))
        if name == module or name.startswith(module + ".")
    }
    assert files <= ONLY_IN[module]


def test_the_parts_of_evo_that_act_on_import_are_never_used():
    # evo.tools.settings writes into the home folder, evo.tools.plot sets a matplotlib backend
    for path in sources():
        for name in imported(path.read_text(encoding="utf-8")):
            assert not name.startswith(("evo.tools.settings", "evo.tools.plot", "evo.main")), path


def test_no_opencv_windows():
    windows = {"cv2.imshow", "cv2.waitKey", "cv2.namedWindow", "cv2.destroyAllWindows"}
    for path in [*sources(), *(ROOT / "tools").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                assert ast.unparse(node) not in windows, f"{path}:{node.lineno}"


def fresh(code: str, *flags: str) -> dict:
    """What a fresh interpreter prints as JSON."""
    done = subprocess.run(
        [sys.executable, *flags, "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return json.loads(done.stdout)


def test_import_loads_nothing_and_warns_of_nothing():
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
    seen = fresh(code, "-W", "error")
    assert seen == {"heavy": [], "unchanged": True, "handlers": 0, "threads": 1}


def test_the_tracker_needs_no_torch_evo_or_matplotlib():
    code = """
import json, sys
import hybridvo
hybridvo.Odometry, hybridvo.estimate, hybridvo.refine, hybridvo.Trajectory, hybridvo.open_sequence
heavy = ("torch", "evo", "matplotlib", "kornia", "pypose")
print(json.dumps([name for name in heavy if name in sys.modules]))
"""
    assert fresh(code, "-W", "error") == []


def test_importing_every_module_does_nothing():
    # thread counts, environment, log handlers and modes stay as the libraries leave them
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
    count, changed = fresh(code, "-W", "error")
    assert count > 40
    assert changed == []


def test_help_is_quick():
    command = [sys.executable, "-m", "hybridvo.cli", "--help"]
    times = []
    for _ in range(3):
        started = time.perf_counter()
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ})
        times.append(time.perf_counter() - started)
        assert done.returncode == 0
        assert "run" in done.stdout
        assert "doctor" in done.stdout
    # 0.1 s on an idle machine; the best of three, as other programs may hold the processor
    assert min(times) < 1.0


def test_files_are_not_long():
    long = {}
    for path in [*sources(), *(ROOT / "tools").glob("*.py")]:
        lines = len(path.read_text(encoding="utf-8").splitlines())
        if lines > MAX_LINES:
            long[str(path.relative_to(ROOT))] = lines
    assert not long, f"split these by noun: {long}"
