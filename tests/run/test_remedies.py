"""What messages tell users to type: it is parsed by the real parser, and done where it can be."""

from __future__ import annotations

import ast
import contextlib
import io
import re
import shlex
import shutil
from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import hybridvo
import hybridvo_lab
from hybridvo.core.pages import DOCUMENTATION
from hybridvo.run.cli import main
from hybridvo.run.commands.arguments import build_parser
from hybridvo.run.commands.run_folder import CHECKPOINT
from tests import sequences as write

PACKAGES = [Path(each.__file__).parent for each in (hybridvo, hybridvo_lab)]
REPOSITORY = PACKAGES[0].parent
GAP = "\0"
"""In place of a value that a message fills in."""
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
QUOTED = re.compile(
    r"'hybridvo ([^']+)'|\bhybridvo ((?:[a-z][a-z-]+)(?: --[a-z-]+)*)"
)
OF_OTHERS = {
    # of git, torchrun and a program that exports transforms.json
    *(
        "--always",
        "--dirty",
        "--abbrev",
        "--exclude",
        "--nproc-per-node",
        "--use-depth",
    ),
}
VALUES = {
    "--camera": "9,9,4,3",
    "--out": "x",
    "--depth": "onnx:x.onnx",
    "--mask": "x",
    "--passes": "3",
}
"""Of options whose value a message leaves to the reader."""


class Sentence(NamedTuple):
    """A text that users may read."""

    place: str
    text: str


def sentences() -> Iterator[Sentence]:
    """Every text of both packages with a blank in it that is no docstring."""
    for package in PACKAGES:
        for path in sorted(package.rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            docstrings = set()
            parts = set()
            for node in ast.walk(tree):
                if isinstance(node, ast.Expr) and isinstance(
                    node.value, ast.Constant
                ):
                    docstrings.add(node.value)
                if isinstance(node, ast.JoinedStr):
                    parts |= set(ast.walk(node)) - {node}
            for node in ast.walk(tree):
                if node in docstrings or node in parts:
                    continue
                text = text_of(node)
                if " " in text:
                    place = f"{path.relative_to(REPOSITORY)}:{node.lineno}"
                    yield Sentence(place, text)


def text_of(node: ast.AST) -> str:
    """The text of a string, with a mark for each value in it; empty of anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) or GAP for part in node.values)
    return ""


SENTENCES = list(sentences())


def parsers() -> dict[str, ArgumentParser]:
    """Every command with its parser; those inside of another one by both names."""

    def inside(
        parser: ArgumentParser, prefix: str
    ) -> Iterator[tuple[str, ArgumentParser]]:
        for action in parser._actions:
            if isinstance(action, _SubParsersAction):
                for name, each in action.choices.items():
                    yield f"{prefix}{name}", each
                    yield from inside(each, f"{prefix}{name} ")

    return dict(inside(build_parser(), ""))


PARSERS = parsers()


def options_of(*known: ArgumentParser) -> set[str]:
    return {
        option
        for parser in known
        for action in parser._actions
        for option in action.option_strings
    }


def test_there_is_something_to_check() -> None:
    assert len(SENTENCES) > 500
    assert sum(bool(OPTION.search(each.text)) for each in SENTENCES) > 60
    assert sum(bool(QUOTED.search(each.text)) for each in SENTENCES) > 15


def test_every_option_that_a_message_names_exists() -> None:
    known = options_of(build_parser(), *PARSERS.values()) | OF_OTHERS
    unknown = [
        f"{each.place}: {option}"
        for each in SENTENCES
        for option in OPTION.findall(each.text)
        if option not in known
    ]
    assert not unknown


def test_every_command_that_a_message_names_is_understood() -> None:
    wrong = []
    for each in SENTENCES:
        for quoted, bare in QUOTED.findall(each.text):
            if quoted.startswith(GAP):
                # the name of any command
                continue
            words = shlex.split((quoted or bare).replace(GAP, " x "))
            if quoted and not is_understood(words):
                wrong.append(f"{each.place}: hybridvo {quoted}")
            if bare and words[0] in PARSERS:
                given = {word for word in words if word.startswith("--")}
                if given - options_of(PARSERS[words[0]]):
                    wrong.append(f"{each.place}: hybridvo {bare}")
    assert not wrong


def is_understood(words: list[str]) -> bool:
    """Whether the parser takes a command, with values for what stands for one."""
    name = " ".join(words[:2]) if " ".join(words[:2]) in PARSERS else words[0]
    if name not in PARSERS:
        return False
    given = list[str]()
    for word in words:
        given.append(word)
        if word in VALUES:
            given.append(VALUES[word])
    known = options_of(PARSERS[name])
    if {word for word in words if word.startswith("--")} - known:
        return False
    # a sentence may leave out the sequence, as in: measure it with 'hybridvo doctor'
    quiet = io.StringIO()
    with contextlib.redirect_stderr(quiet), contextlib.redirect_stdout(quiet):
        for more in ([], ["x"], ["x", "--out", "y"]):
            try:
                build_parser().parse_args([*given, *more])
            except SystemExit as end:
                # what prints help ends with 0
                if end.code:
                    continue
            return True
    return False


def test_messages_name_pages_that_a_user_can_open() -> None:
    named = [
        each.place
        for each in SENTENCES
        if re.search(r"\bdocs/[\w-]+\.md", each.text)
    ]
    assert not named
    pyproject = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    assert f'Documentation = "{DOCUMENTATION}"' in pyproject
    pages = re.compile(r"\bpage\(['\"]([\w-]+)['\"]\)")
    for package in PACKAGES:
        for path in package.rglob("*.py"):
            for name in pages.findall(path.read_text(encoding="utf-8")):
                assert (REPOSITORY / "docs" / f"{name}.md").is_file(), (path, name)


def test_what_deletes_is_never_the_first_remedy() -> None:
    for each in SENTENCES:
        if "--overwrite" in each.text and "--out" in each.text:
            assert each.text.index("--out") < each.text.index("--overwrite"), each


# -- remedies that are done --------------------------------------------------------------


def commands_in(message: str) -> list[list[str]]:
    """The commands that a message prints, as words without the name of the program."""
    # one that the message ends with a blank, since a name in it may end with a point
    whole = re.findall(r": hybridvo ([^\n]*?) \. ", message)
    quoted = re.findall(r"'hybridvo ([^']+)'", message)
    return [shlex.split(words) for words in whole + quoted]


def test_a_run_that_is_resumed_as_the_message_says_keeps_its_frames(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where it was started with --overwrite, which would wipe it."""
    out = tmp_path / "my run"
    given = ["run", str(dataset), "--out", str(out), "--method", "identity", "-q"]
    given += ["--flow", "dis", "--overwrite"]
    assert main(given) == 0
    whole = (out / "trajectory.tum").read_bytes()
    (out / "mine.txt").write_text("keep")
    resumed = [word for word in given if word != "--overwrite"]
    assert main([*resumed, "--stop", "3", "--resume"]) == 2
    said = capsys.readouterr().err
    (command,) = commands_in(said)
    assert "--resume" in command and "--overwrite" not in command
    assert said.index("--out DIR") < said.index("--overwrite")
    before = (out / "steps.csv").stat().st_mtime_ns
    assert main(command) == 0
    assert (out / "trajectory.tum").read_bytes() == whole
    assert (out / "steps.csv").stat().st_mtime_ns == before
    assert not (out / CHECKPOINT).exists()


def test_the_file_of_a_camera_is_written_as_the_message_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write.WRITERS["folder"](tmp_path).path
    (root / "camera.yaml").unlink()
    assert main(["run", str(root), "-q"]) == 2
    (command,) = commands_in(capsys.readouterr().err)
    assert command[0] == "init"
    assert main(command) == 0
    assert (root / "camera.yaml").is_file()


def test_depth_in_another_unit_is_read_by_the_option_that_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rgb = np.zeros((3, 24, 32, 3), np.uint8)
    K = np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]])
    depth = np.full((3, 24, 32), 1500, np.uint16)
    path = tmp_path / "walk.npz"
    np.savez(path, rgb=rgb, depth=depth, K=K)
    command = ["run", str(path), "-q", "--method", "identity", "--out"]
    assert main([*command, str(tmp_path / "a")]) == 2
    said = capsys.readouterr().err
    assert "--depth-scale" in said and "1000" in said
    scale = ["--depth-scale", "1000"]
    assert main([*command, str(tmp_path / "a"), *scale]) == 0


def test_results_that_are_there_are_kept_by_the_first_remedy(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    given = ["run", str(dataset), "--method", "identity", "-q", "--flow", "dis"]
    assert main([*given, "--out", str(out)]) == 0
    before = tmp_path / "before"
    shutil.copytree(out, before)
    assert main([*given, "--out", str(out)]) == 2
    first = OPTION.findall(capsys.readouterr().err)[0]
    assert main([*given, "--out", str(out), first]) == 0
    for path in before.iterdir():
        assert (out / path.name).read_bytes() == path.read_bytes(), path.name
