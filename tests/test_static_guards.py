"""What no file may contain (faults.md, F24): ways to run foreign code, traces of a machine.

Each guard is shown a bad line first: a guard that cannot fail guards nothing.
"""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

UNPICKLERS = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "imp"}
EXCEPTIONS_OF_PICKLE = {"UnpicklingError", "PickleError"}
"""torch raises these: naming them in an ``except`` runs nothing."""
BUILTINS = {"eval", "exec", "compile", "__import__"}
CALLS = {
    *("os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput"),
    *("yaml.load", "yaml.load_all", "yaml.full_load", "yaml.unsafe_load", "tempfile.mktemp"),
    *("torch.hub.load", "torch.jit.load", "pandas.read_pickle", "np.fromfile", "numpy.fromfile"),
    *("warnings.simplefilter", "warnings.filterwarnings", "logging.basicConfig"),
}
NETWORK = {
    *("socket", "socketserver", "ssl", "http", "urllib", "urllib3", "requests", "aiohttp", "httpx"),
    *("ftplib", "imaplib", "poplib", "smtplib", "telnetlib", "xmlrpc", "asyncio", "webbrowser"),
}
REACHES_OUT = {
    "hybridvo/run_folder.py": {"socket"},  # the name of this machine, for the lock
    "hybridvo/compilation.py": {"subprocess"},  # this Python, on this package
    "hybridvo/comparison/executors.py": {"multiprocessing"},  # --jobs
    "hybridvo/training/provenance.py": {"subprocess"},  # git rev-parse, on this package
}
"""File of the library -> the only modules by which it may reach beyond its process."""
PRINTERS = {"cli.py", "console.py", "demo.py", "doctor.py"}
"""The command line. The progress line prints to the stream that it was given."""


def library() -> list[Path]:
    return sorted((ROOT / "hybridvo").rglob("*.py"))


def programs() -> list[Path]:
    return [*library(), *sorted((ROOT / "tools").glob("*.py"))]


def dotted(node: ast.AST) -> str:
    """``a.b.c`` of an attribute chain, else an empty string."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        before = dotted(node.value)
        return f"{before}.{node.attr}" if before else ""
    return ""


def keyword(call: ast.Call, name: str) -> object:
    """Literal value of a keyword; None if absent, the text if it is no literal."""
    for given in call.keywords:
        if given.arg == name:
            return given.value.value if isinstance(given.value, ast.Constant) else "not a literal"
    return None


def dangers(source: str) -> Iterator[str]:
    """Lines by which a file could run what an input says."""
    for node in ast.walk(ast.parse(source)):
        where = f"line {getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in UNPICKLERS:
            yield f"{where}: from {node.module} import"
        if isinstance(node, ast.ImportFrom) and any(alias.name == "*" for alias in node.names):
            yield f"{where}: import *"
        if isinstance(node, ast.Import):
            for alias in node.names:
                name = alias.name.split(".")[0]
                if (name in UNPICKLERS and name != "pickle") or (name == "pickle" and alias.asname):
                    yield f"{where}: import {alias.name}"
        if (
            isinstance(node, ast.Attribute)
            and dotted(node.value) == "pickle"
            and node.attr not in EXCEPTIONS_OF_PICKLE
        ):
            yield f"{where}: pickle.{node.attr}"
        if isinstance(node, ast.ExceptHandler) and node.type is None:
            yield f"{where}: bare except"
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        if name in BUILTINS or name in CALLS:
            yield f"{where}: {name}"
        if name == "torch.load" and keyword(node, "weights_only") is not True:
            yield f"{where}: torch.load without weights_only=True"
        if keyword(node, "allow_pickle") not in (None, False):
            yield f"{where}: allow_pickle"
        if keyword(node, "shell") not in (None, False):
            yield f"{where}: shell"


def reaches(source: str) -> set[str]:
    """Modules for networks and for other programs that a source imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
    return found & (NETWORK | {"subprocess", "pty", "multiprocessing"})


def children_of_this_folder(source: str) -> Iterator[str]:
    """Pythons that are started with ``-c`` and would import what lies in the current folder."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.List) and node.elts and dotted(node.elts[0]) == "sys.executable":
            options = {part.value for part in node.elts if isinstance(part, ast.Constant)}
            if "-c" in options and not options & {"-P", "-I"}:
                yield f"line {node.lineno}"


def prints(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and dotted(node.func) in ("print", "sys.stdout.write"):
            yield f"line {node.lineno}"


def narrows(test: ast.expr) -> bool:
    """Whether a condition only tells the type checker what the code before it made sure of."""
    if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And):
        return all(narrows(part) for part in test.values)
    if isinstance(test, ast.Compare):
        against = test.comparators[0]
        return (
            isinstance(test.ops[0], ast.IsNot)
            and isinstance(against, ast.Constant)
            and against.value is None
        )
    return isinstance(test, ast.Call) and dotted(test.func) == "isinstance"


def checking_asserts(source: str) -> Iterator[str]:
    """Assertions that vanish under -O and that something could depend on."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assert) and not narrows(node.test):
            yield f"line {node.lineno}: assert {ast.unparse(node.test)}"


@pytest.mark.parametrize(
    "bad",
    [
        "import dill",
        "import pickle as p",
        "import pickle\npickle.loads(b'')",
        "import pickle\nload = pickle.load",
        "from pickle import loads",
        "eval('1')",
        "exec('x = 1')",
        "import yaml\nyaml.load('a')",
        "import torch\ntorch.load('f')",
        "import torch\ntorch.load('f', weights_only=False)",
        "import torch\nsafe = True\ntorch.load('f', weights_only=safe)",
        "import numpy as np\nnp.load('f', allow_pickle=True)",
        "import subprocess\nsubprocess.run('ls', shell=True)",
        "import os\nos.system('ls')",
        "from os.path import *",
        "try:\n    f()\nexcept:\n    pass",
        "import warnings\nwarnings.simplefilter('ignore')",
    ],
)
def test_the_guard_sees_it(bad):
    assert list(dangers(bad))


@pytest.mark.parametrize(
    "good",
    [
        "network.eval()",
        "import re\nre.compile('a')",
        "import torch\ntorch.load('f', weights_only=True)",
        "import numpy as np\nnp.load('f', allow_pickle=False)",
        "import pickle\ntry:\n    f()\nexcept pickle.UnpicklingError:\n    g()",
        "import yaml\nyaml.safe_load('a')",
    ],
)
def test_the_guard_lets_it_pass(good):
    assert not list(dangers(good))


@pytest.mark.parametrize("path", programs(), ids=lambda p: p.relative_to(ROOT).as_posix())
def test_nothing_runs_what_an_input_says(path):
    assert not list(dangers(path.read_text(encoding="utf-8")))


def test_the_library_reaches_for_no_network_and_no_program():
    assert reaches("from urllib.request import urlopen") == {"urllib"}
    assert reaches("def f():\n    import http.client, subprocess") == {"http", "subprocess"}
    found = {
        path.relative_to(ROOT).as_posix(): modules
        for path in library()
        if (modules := reaches(path.read_text(encoding="utf-8")))
    }
    assert {name: found[name] - REACHES_OUT.get(name, set()) for name in found} == {
        name: set() for name in found
    }
    lock = (ROOT / "hybridvo" / "run_folder.py").read_text(encoding="utf-8")
    assert set(re.findall(r"\bsocket\.(\w+)", lock)) == {"gethostname"}


def test_no_child_imports_what_lies_in_the_current_folder():
    assert list(children_of_this_folder("[sys.executable, '-c', code]"))
    assert not list(children_of_this_folder("[sys.executable, '-P', '-c', code]"))
    for path in library():
        assert not list(children_of_this_folder(path.read_text(encoding="utf-8"))), path


def test_no_print_in_the_library():
    assert list(prints("print('x')"))
    found = {
        path.name: lines
        for path in library()
        if path.name not in PRINTERS and (lines := list(prints(path.read_text(encoding="utf-8"))))
    }
    assert not found


def test_no_assert_checks_what_a_user_gave():
    assert list(checking_asserts("assert x > 0"))
    assert list(checking_asserts("assert x is not None and x.ndim == 2"))
    assert not list(checking_asserts("assert x is not None and isinstance(y, int)"))
    found = {
        path.name: lines
        for path in library()
        if (lines := list(checking_asserts(path.read_text(encoding="utf-8"))))
    }
    assert not found


def tracked() -> list[Path]:
    try:
        done = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("git, or the repository, is not there: no list of the project's files")
    return [ROOT / name for name in done.stdout.decode().split("\0") if name]


# put together here, so that this file does not contain what it looks for
FOLDERS = [f"/{name}/".encode() for name in ("work", "root", "home", "Users")]
HOSTS = [
    ".".join(parts).encode()
    for parts in (
        ("pypi", "org"),
        ("pythonhosted", "org"),
        ("download", "pytorch", "org"),
        ("anaconda", "org"),
        ("registry", "npmjs", "org"),
        ("proxy", "golang", "org"),
        ("index", "crates", "io"),
    )
]
OPTIONS = [("--" + option).encode() for option in ("index-url", "extra-index-url", "find-links")]


def traces(content: bytes) -> list[str]:
    return [needle.decode() for needle in (*FOLDERS, *HOSTS, *OPTIONS) if needle in content]


def test_no_file_names_a_folder_of_a_machine_or_a_registry():
    assert traces(b"open('" + FOLDERS[2] + b"me/x')")
    assert traces(b"https://" + HOSTS[0] + b"/simple")
    found = {}
    for path in tracked():
        if path.is_file() and (names := traces(path.read_bytes())):
            found[path.relative_to(ROOT).as_posix()] = names
    assert not found


def test_no_file_is_large():
    # apart from weights all is text and small pictures; results keep every pair (1 MB)
    large = {
        path.relative_to(ROOT).as_posix(): path.stat().st_size
        for path in tracked()
        if path.is_file() and path.suffix != ".safetensors" and path.stat().st_size > 4_000_000
    }
    assert not large
