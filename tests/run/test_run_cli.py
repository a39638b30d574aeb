"""What the command line does at its edges: names, numbers, stdout, and how it is started."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hybridvo import __version__
from hybridvo.io.data.datasets import SINTEL_PARTS
from hybridvo.io.data.open import READERS
from hybridvo.run.cli import main
from hybridvo.run.commands.arguments import KINDS
from hybridvo.run.commands.dispatch import SCENE_FOLDERS

ROOT = Path(__file__).resolve().parents[2]


def python(*arguments: str, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        text=True,
        cwd=ROOT,
        check=False,
        stderr=subprocess.PIPE,
        **{"stdout": subprocess.PIPE} | options,
    )


def test_the_package_is_a_command():
    done = python("-m", "hybridvo", "--version")
    assert (done.returncode, done.stdout) == (0, f"hybridvo {__version__}\n")


@pytest.mark.parametrize("command", ["run", "doctor", "show", "compare"])
def test_a_folder_that_is_not_there_is_refused_before_heavy_imports(command):
    code = f"""
import json, sys
from hybridvo.run.cli import main
assert main(["{command}", "nosuch"]) == 2
heavy = ("torch", "cv2", "scipy", "numba", "pandas", "matplotlib", "pydantic")
print(json.dumps([name for name in heavy if name in sys.modules]))
"""
    done = python("-c", code)
    assert "nosuch: expected a sequence folder, got no such folder" in done.stderr
    assert json.loads(done.stdout) == []


def test_wrong_arguments_are_refused_before_heavy_imports(tmp_path):
    commands = [
        ["live"],
        ["live", "--camera", "nosuch"],
        ["live", "--camera", "realsense", "--method", "hybird"],
        ["doctor", "--camera", "nosuch"],
        ["run", str(tmp_path), "--method", "hybird"],
        ["run", str(tmp_path), "--view", "window"],
        ["live", "--camera", "realsense", "--view", "window"],
        ["run", str(tmp_path), "--set", "refine.cutof=1"],
        ["run", str(tmp_path), "--weights", "pwvo=nosuch"],
        ["compare", str(tmp_path), "--methods", "hybird"],
        ["show", str(tmp_path), "--method", "hybird"],
        ["train", "paper", "--config", "nosuch", "--out", str(tmp_path / "out")],
    ]
    code = f"""
import json, sys
from hybridvo.run.cli import main
for words in {commands!r}:
    assert main(words) == 2, words
heavy = ("torch", "cv2", "scipy", "numba", "pandas", "matplotlib")
print(json.dumps([name for name in heavy if name in sys.modules]))
"""
    done = python("-c", code)
    assert done.stderr.count("did you mean 'hybrid'?") == 4
    assert json.loads(done.stdout) == []


@pytest.mark.parametrize(
    ("words", "usage", "said"),
    [
        (["run", "mine", "--metod", "x"], "run [-h]", "did you mean --method?"),
        (["live", "mine"], "live [-h]", "unrecognized arguments: mine\n"),
        (
            ["train", "pwvo", "--out", "a", "--data", "b", "--sed", "1"],
            "train pwvo [-h]",
            "did you mean --seed?",
        ),
    ],
)
def test_an_unknown_option_is_an_error_of_its_command(words, usage, said, capsys):
    assert main(words) == 2
    shown = capsys.readouterr().err
    assert f"usage: hybridvo {usage}" in shown
    assert said in shown


def test_methods_that_are_known_early_are_all():
    from hybridvo import pipeline
    from hybridvo.run.commands import early

    assert early.METHODS == tuple(pipeline.METHODS)
    assert set(early.EARLIER_METHODS) == set(pipeline.EARLIER_NAMES)


def test_the_help_names_every_kind_of_recording():
    named = KINDS.replace(" or ", ", ").split(", ")
    assert sorted(named) == sorted(READERS), "add it to KINDS in arguments.py"


def test_a_scene_of_sintel_may_be_named_by_any_of_its_parts(dataset, tmp_path):
    assert set(SCENE_FOLDERS) == set(SINTEL_PARTS)
    scene = dataset.parents[1] / "invalid" / dataset.name
    assert not scene.exists()
    words = [
        "run",
        str(scene),
        "--out",
        str(tmp_path),
        "--method",
        "identity",
        "-q",
    ]
    assert main(words) == 0


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="has no /dev/full")
@pytest.mark.parametrize("json_or_text", [["--json"], []])
def test_stdout_on_a_full_disk(tmp_path, json_or_text):
    poses = tmp_path / "poses.tum"
    poses.write_text("".join(f"{k} {k * k} {k % 2} 0 0 0 0 1\n" for k in range(5)))
    arguments = ["evaluate", str(poses), str(poses), *json_or_text]
    with open("/dev/full", "w") as full:
        done = python("-m", "hybridvo", *arguments, stdout=full)
    assert done.returncode == 5
    assert (
        done.stderr.count("\n") == 1
        and "stdout: cannot be written: No space" in done.stderr
    )


@pytest.mark.parametrize("name", ["a\0b", "x" * 300])
def test_names_that_no_file_can_have_are_wrong_usage(
    dataset, tmp_path, monkeypatch, capsys, name
):
    monkeypatch.chdir(tmp_path)
    sequence = str(dataset)
    for arguments in (
        ["run", sequence, "--out", name],
        ["compare", sequence, "--methods", "identity", "--out", name],
        ["demo", "--frames", "2", "--out", name],
        ["show", sequence, "--out", name],
        ["init", name],
        ["generate", "--count", "1", "--out", name],
        ["evaluate", name, name],
        ["run", name],
    ):
        assert main(arguments) == 2, arguments
        said = capsys.readouterr().err
        assert "expected" in said and "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_giant_numbers_are_wrong_usage(dataset, tmp_path, capsys):
    giant = "99999999999999999999"
    out = ["--out", str(tmp_path / "out")]
    for arguments in (
        ["run", str(dataset), "--stride", giant, *out],
        ["compare", str(dataset), "--stride", giant, "--methods", "identity", *out],
        # one frame is no comparison
        ["compare", str(dataset), "--stride", "100", "--methods", "identity", *out],
    ):
        assert main(arguments) == 2, arguments
        assert "Traceback" not in capsys.readouterr().err
