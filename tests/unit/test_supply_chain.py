"""What a run reaches for (F24, F26, F44): no network, no shell, no unpickler, no file outside of
its folder, no optional library; and that the lists of versions are what they say.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from hybridvo.data.synthetic import make_scene, write_sintel
from tests.scripts import load_script

ROOT = Path(__file__).resolve().parents[2]

WATCHED = r"""
import json, os, sys, traceback

report, arguments = sys.argv[1], sys.argv[2:]
seen = {"network": [], "programs": [], "unpickled": [], "written": [], "interfaces": None}
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.chmod")

def note(where):
    for path in where:
        if isinstance(path, (str, bytes)):
            seen["written"].append(os.path.realpath(os.fsdecode(path)))

def watch(event, given):
    if event.startswith("socket.") and event not in ("socket.gethostname", "socket.__new__"):
        seen["network"].append(f"{event} {given[1:]}")
        raise OSError("no network in this test")
    if event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn"):
        words = given[1] if event == "subprocess.Popen" else given[:1]
        words = [words] if isinstance(words, (str, bytes)) else words
        seen["programs"].append([os.fsdecode(word) for word in words])
    if event == "pickle.find_class":
        frames = {f.filename for f in traceback.extract_stack()}
        if not any("numba" in name for name in frames):
            seen["unpickled"].append(str(given))
    if event == "open" and isinstance(given[2], int) and given[2] & WRITES:
        note(given[:1])
    if event in CHANGES:
        note(given[: 2 if event in ("os.rename", "os.link", "os.symlink") else 1])

sys.addaudithook(watch)
try:
    with open("/proc/self/net/dev") as file:
        seen["interfaces"] = [line.split(":")[0].strip() for line in file if ":" in line]
except OSError:
    pass
from hybridvo.cli import main
code = main(arguments)
with open(report, "w") as file:
    json.dump(seen, file)
sys.exit(code)
"""
"""Python's audit events cannot be undone by the code that is watched. The numba cache is pickled
(SECURITY.md says who may write it), so what numba itself unpickles is left out."""

HIDDEN = r"""
import sys

HIDDEN = sys.argv[1].split(",")

class Hide:
    def __init__(self, finder):
        self.finder = finder
    def __getattr__(self, name):
        return getattr(self.finder, name)
    def find_spec(self, name, *where):
        return None if name.partition(".")[0] in HIDDEN else self.finder.find_spec(name, *where)

sys.meta_path[:] = [Hide(finder) for finder in sys.meta_path]
from hybridvo.cli import main
sys.exit(main(sys.argv[2:]))
"""
"""The libraries in the first argument are as if they had never been installed."""

OPTIONAL = "rerun,poselib,open3d,distributed,dask,OpenEXR,Imath,torchvision,gtsam"


def child(code: str, *arguments: object, before: tuple[str, ...] = (), **environment: str):
    return subprocess.run(
        [*before, sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
    )


def cut_off() -> tuple[str, ...]:
    """Command prefix for an empty network namespace; nothing where the system allows none."""
    for prefix in (("unshare", "-n"), ("unshare", "-rn")):
        if shutil.which("unshare") and subprocess.run([*prefix, "true"], capture_output=True):
            done = subprocess.run([*prefix, sys.executable, "-c", ""], capture_output=True)
            if done.returncode == 0:
                return prefix
    return ()


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    """What a demo of three frames did, and the folder it ran in."""
    folder = tmp_path_factory.mktemp("watched").resolve()
    command = ["demo", "--out", folder / "out", "--frames", 3, "-q"]
    done = child(WATCHED, folder / "seen.json", *command, before=cut_off())
    assert done.returncode == 0, done.stderr
    assert (folder / "out" / "trajectory.png").is_file()
    return json.loads((folder / "seen.json").read_text()), folder


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("sintel")
    write_sintel(make_scene("static", 3, height=96, width=160, frames=3), root, "static")
    return root / "training" / "clean" / "static"


# A demo under watch


def test_the_watch_sees_network_programs_pickles_and_files(tmp_path):
    code = WATCHED.replace(
        "from hybridvo.cli import main",
        "import pickle, socket, subprocess, urllib.request\n"
        "def main(arguments):\n"
        "    subprocess.run(['true'])\n"
        "    pickle.loads(b'cos\\ngetpid\\n.')\n"
        "    open(arguments[0], 'w').close()\n"
        "    os.replace(arguments[0], arguments[0] + '.b')\n"
        "    for act in (lambda: socket.create_connection(('127.0.0.1', 9)),\n"
        "                lambda: urllib.request.urlopen('http://localhost:9')):\n"
        "        try:\n            act()\n        except OSError:\n            pass\n",
    )
    done = child(code, tmp_path / "seen.json", tmp_path / "a")
    assert done.returncode == 0, done.stderr
    seen = json.loads((tmp_path / "seen.json").read_text())
    assert len(seen["network"]) == 2
    assert seen["programs"] == [["true"]]
    assert "getpid" in seen["unpickled"][0]
    here = os.fspath(tmp_path.resolve())
    assert {f"{here}/a", f"{here}/a.b"} <= set(seen["written"])


def test_the_demo_needs_no_network(watched):
    seen, _ = watched
    assert seen["network"] == []
    if cut_off():
        assert seen["interfaces"] in (None, ["lo"])


def test_the_demo_starts_no_program_and_unpickles_nothing(watched, tmp_path):
    seen, _ = watched
    # torch with CUDA looks for its libraries by ldconfig and a Python of its own
    code = WATCHED.replace("from hybridvo.cli import main", "import torch\nmain = print")
    assert child(code, tmp_path / "seen.json").returncode == 0
    of_torch = json.loads((tmp_path / "seen.json").read_text())["programs"]
    # the kernels are compiled by a Python of their own, once; platform asks for the processor, as
    # numpy.testing of numpy 2.0 does, and matplotlib for fonts when it finds no list of its own
    own = [sys.executable, "-P", "-c"]
    started = [words for words in seen["programs"] if words not in of_torch]
    others = [words for words in started if words[:3] != own]
    assert {Path(words[0]).name for words in others} <= {"uname", "lscpu", "fc-list"}
    for words in started:
        assert words[:3] != own or "hybridvo.refinement.readiness import run_kernels" in words[3]
    assert seen["unpickled"] == []


def test_the_demo_writes_into_its_folder_alone(watched):
    seen, folder = watched
    out = os.fspath(folder / "out")
    assert [path for path in seen["written"] if path.startswith(out)]
    # beside it: compiled kernels and byte code, matplotlib's list of fonts, /dev/null, and the
    # file by which tempfile finds out where it may write, which is gone again
    caches = re.compile(r"/__pycache__(/|$)|numba|matplotlib|fontlist|^/dev/|\.pyc")
    outside = [p for p in seen["written"] if not p.startswith(out) and not caches.search(p)]
    assert {p for p in outside if Path(p).exists()} <= {os.fspath(folder / "seen.json")}


# Optional libraries (F44)


def test_the_core_needs_no_optional_library(sequence, tmp_path):
    command = ["run", "--sequence", sequence, "--out", tmp_path / "out", "-q"]
    done = child(HIDDEN, OPTIONAL, *command)
    assert (done.returncode, done.stderr) == (0, "")
    with_all = child(HIDDEN, "", *command[:-2], tmp_path / "all", "-q")
    assert with_all.returncode == 0
    for name in ("trajectory.tum", "trajectory.kitti", "metrics.json"):
        if name != "metrics.json":
            assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "all" / name).read_bytes()


@pytest.mark.parametrize(
    ("hidden", "options", "remedy"),
    [
        ("rerun", ["--rrd"], "pip install 'hybridvo[viz]'"),
        ("poselib", ["--method", "poselib"], "pip install 'hybridvo[baselines]'"),
        ("open3d", ["--method", "open3d-rgbd"], "pip install open3d"),
    ],
)
def test_an_absent_library_is_one_line_with_its_command(
    sequence, tmp_path, hidden, options, remedy
):
    command = ["run", "--sequence", sequence, "--out", tmp_path / "out", "-q", *options]
    done = child(HIDDEN, hidden, *command)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert remedy in done.stderr
    assert not (tmp_path / "out").exists()


# Lists of versions


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def declared() -> dict[str, Requirement]:
    """Every requirement of the package and its extras, by normalised name."""
    content = project()
    lines = chain(content["dependencies"], *content["optional-dependencies"].values())
    return {normal(Requirement(line).name): Requirement(line) for line in lines}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(name: str) -> dict[str, Version]:
    found = {}
    for line in (ROOT / name).read_text(encoding="utf-8").splitlines():
        line = line.split("#")[0].strip()
        if line:
            package, _, version = line.partition("==")
            assert version, f"{name}: {line!r} pins nothing"
            found[normal(package)] = Version(version)
    return found


TOOLS_OF_STYLE = {"ruff", "mypy", "types-pyyaml", "pip-audit", "atheris"}
"""Not part of the tests: their lowest version says nothing about the package."""


@pytest.mark.parametrize("name", ["constraints.txt", "constraints-min.txt"])
def test_pins_satisfy_what_is_declared(name):
    pinned = pins(name)
    for package, requirement in declared().items():
        if name == "constraints-min.txt" and package in TOOLS_OF_STYLE:
            continue
        assert package in pinned, f"{package} is not in {name}"
        assert pinned[package] in requirement.specifier, f"{package} {pinned[package]}"


def test_lower_bounds_are_the_versions_that_test_min_installs():
    pinned = pins("constraints-min.txt")
    for package, requirement in declared().items():
        if package in TOOLS_OF_STYLE:
            continue
        bounds = [Version(s.version) for s in requirement.specifier if s.operator == ">="]
        assert bounds == [pinned[package]], f"{requirement}: pinned {pinned[package]}"
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    rule = makefile.split("\ntest-min:")[1].split("\n\n")[0]
    assert "constraints-min.txt" in makefile
    assert "pytest" in rule


# pip-audit (make check)


def audit() -> ModuleType:
    return load_script("tools/audit.py")


SKIPPED = {"name": "numpy", "skip_reason": "Dependency not found"}
CLEAN = {"name": "scipy", "version": "1.17.1", "vulns": []}
HIT = {
    "name": "pillow",
    "version": "1.0",
    "vulns": [{"id": "PYSEC-1", "fix_versions": ["2.0"], "description": "overflow"}],
}


@pytest.mark.parametrize(
    ("answer", "code", "words"),
    [
        ([CLEAN, CLEAN], 0, "2 packages, none with a known vulnerability"),
        ([CLEAN, HIT], 1, "pillow 1.0: PYSEC-1, mended in 2.0"),
        ([SKIPPED, SKIPPED], 0, "skipped: the advisory data knows none of the 2 packages"),
        ([SKIPPED, CLEAN], 0, "1 packages, none with a known vulnerability; not known: numpy"),
        (None, 0, "skipped: the advisory data cannot be reached: ConnectionError"),
    ],
)
def test_audit_says_what_it_could_not_look_up(answer, code, words):
    stdout = "" if answer is None else json.dumps({"dependencies": answer, "fixes": []})
    stderr = "Traceback\nrequests.exceptions.ConnectionError: host\n" if answer is None else ""
    got, text = audit().verdict(stdout, stderr)
    assert got == code
    assert words in text


def test_audit_is_part_of_make_check():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    rule = makefile.split("\ncheck:")[1].split("\n\n")[0]
    assert "tools/audit.py" in rule


# The threat model


def test_security_page_names_what_exists():
    text = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    paths = {
        span.split("::")[0].split()[0]
        for span in re.findall(r"`([^`\n]+)`", text)
        if re.match(r"(hybridvo|tests|tools|docs|configs)/", span)
    }
    assert len(paths) >= 5
    for path in paths:
        assert (ROOT / path).exists(), path
    for test in re.findall(r"`(tests/[\w/.]+)::(\w+)`", text):
        assert f"def {test[1]}(" in (ROOT / test[0]).read_text(encoding="utf-8"), test
