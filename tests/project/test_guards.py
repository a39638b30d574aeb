"""What no file may contain: ways to run foreign code, the network, traces of a machine.

Ruff refuses pickle, eval, exec, unsafe YAML, shells and prints (see pyproject.toml).
"""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.project import source_tree as source

NETWORK = set(
    """
socket socketserver ssl http urllib urllib3 requests aiohttp httpx ftplib smtplib
xmlrpc asyncio webbrowser huggingface_hub
""".split()
)


def unsafe_loads(tree: ast.AST) -> Iterator[str]:
    """Calls by which a file of weights or arrays could run what it holds."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        given = {
            keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords
        }
        name = ast.unparse(node.func)
        if name == "torch.load" and given.get("weights_only") != "True":
            yield f"line {node.lineno}: {name} without weights_only=True"
        if given.get("allow_pickle", "False") != "False":
            yield f"line {node.lineno}: {name} with allow_pickle"
        if name in (
            "torch.hub.load",
            "torch.jit.load",
            "pandas.read_pickle",
            "pd.read_pickle",
        ):
            yield f"line {node.lineno}: {name}"


def test_no_file_of_weights_or_arrays_can_run_code() -> None:
    found = {
        path: list(unsafe_loads(tree))
        for path, tree in source.files_of_both().items()
    }
    assert not {path: lines for path, lines in found.items() if lines}


SENDS = {"run/commands/live.py", "io/viewer/program.py"}
"""The only files that may open a socket: what a user asks to be sent, to where he says, and whether
the viewer that he asks for listens."""


def test_the_library_uses_no_network() -> None:
    for path, tree in source.files_of_both().items():
        if path in SENDS:
            continue
        assert (
            not {name.split(".")[0] for name in source.imported(tree)} & NETWORK
        ), path


def test_no_assert_checks_what_a_user_gave() -> None:
    """Assertions vanish under ``python -O``; those that narrow a type for mypy may stay."""
    found = [
        f"{path}:{node.lineno}"
        for path, tree in source.files_of_both().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Assert)
        and "is not None" not in (text := ast.unparse(node.test))
        and not text.startswith("isinstance(")
    ]
    assert not found


def tracked() -> list[Path]:
    try:
        done = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=source.ROOT,
            capture_output=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip(
            "git, or the repository, is not there: no list of the project's files"
        )
    paths = [
        source.ROOT / name for name in done.stdout.decode().split("\0") if name
    ]
    return [path for path in paths if path.is_file()]


# put together here, so that this file does not contain what it looks for
TRACES = [
    *(f"/{name}/".encode() for name in ("work", "root", "home", "Users")),
    *(
        ".".join(parts).encode()
        for parts in (
            ("pypi", "org"),
            ("pythonhosted", "org"),
            ("download", "pytorch", "org"),
        )
    ),
    *(b"--" + option for option in (b"index-url", b"find-links")),
]


def test_no_file_names_a_folder_of_a_machine_or_a_registry() -> None:
    found = {
        path.relative_to(source.ROOT).as_posix(): trace.decode()
        for path in tracked()
        for trace in TRACES
        if trace in path.read_bytes()
    }
    assert not found


def test_no_file_is_large() -> None:
    large = {
        path.relative_to(source.ROOT).as_posix(): path.stat().st_size
        for path in tracked()
        # the README's moving picture has a limit in tests/tools/test_moving_people.py
        if path.suffix not in (".safetensors", ".gif")
        and path.stat().st_size > 1_500_000
    }
    assert not large
