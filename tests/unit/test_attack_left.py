"""What the attacks had left open, one test for each that is closed by now.

What was tried, and what is left, is in docs/attack.md.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from hybridvo.errors import InputError
from hybridvo.pose.selection import SELECTION_METHODS, select
from hybridvo.types import PixelwisePrediction

ROOT = Path(__file__).resolve().parents[2]

# select


def prediction(**changed: object) -> PixelwisePrediction:
    maps = torch.zeros(1, 3, 8, 16)
    names = ("rotation", "translation", "log_scale_rotation", "log_scale_translation")
    return PixelwisePrediction(**{name: changed.get(name, maps) for name in names})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rotation", None, "expected rotation as a torch tensor, got NoneType"),
        ("rotation", torch.zeros(1, 3, 8, 16).numpy(), "rotation as a torch tensor, got ndarray"),
        ("translation", None, "expected translation as a torch tensor, got NoneType"),
        ("translation", torch.zeros(1, 3, 8, 16, dtype=torch.int64), "got torch.int64"),
        ("translation", torch.zeros(1, 3, 8, 16, dtype=torch.complex64), "got torch.complex64"),
        ("log_scale_rotation", torch.zeros(1, 3, 8, 16, dtype=torch.bool), "got torch.bool"),
        ("log_scale_rotation", "softmax", "as a torch tensor, got str"),
        ("log_scale_translation", torch.zeros(1, 3, 8, 16, device="meta"), "on cpu .* got meta"),
        ("log_scale_translation", torch.zeros(1, 3, 8, 16).to_sparse(), "a dense tensor"),
        ("log_scale_translation", torch.zeros(2, 3, 8, 16), r"of \(1, 3, 8, 16\), got \(2, 3"),
    ],
)
def test_select_refuses_maps_of_another_kind(name: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        select(prediction(**{name: value}))


@pytest.mark.parametrize("what", [None, "softmax", (torch.zeros(1, 3), torch.zeros(1, 3)), {}])
def test_select_refuses_what_is_no_prediction(what: object) -> None:
    with pytest.raises(InputError, match="expected a PixelwisePrediction, got"):
        select(what)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": ["softmax"]}, "method .* unknown"),
        ({"method": torch.zeros(2)}, "method .* unknown"),
        ({"joint": torch.zeros(2)}, "joint to be True or False"),
        ({"joint": "no"}, "joint to be True or False"),
        ({"patch": 8.0}, "at least 1 cell"),
    ],
)
def test_select_refuses_options_of_another_kind(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        select(prediction(), **options)


@pytest.mark.parametrize("method", SELECTION_METHODS)
def test_a_patch_larger_than_the_map_is_the_map(method: str) -> None:
    """A side of 10^9 asked for 10^18 cells of padding."""
    maps = torch.randn(2, 3, 8, 16, generator=torch.Generator().manual_seed(0))
    drawn = PixelwisePrediction(maps, maps + 1, -maps, maps.flip(3))
    for got, expected in zip(select(drawn, method, 10**9), select(drawn, method, 16), strict=True):
        assert torch.equal(got, expected)


def test_select_takes_maps_of_several_real_types() -> None:
    """As they come out of a network under autocast, with scales in single precision."""
    half = torch.ones(1, 3, 8, 16, dtype=torch.bfloat16)
    rotation, translation = select(prediction(rotation=half, translation=2 * half))
    assert rotation.tolist() == [[1.0] * 3]
    assert translation.tolist() == [[2.0] * 3]


# surroundings


def in_a_fresh_process(code: str, *flags: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *flags, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
    )


ASK_EVERY_DOOR = """
import contextlib, io, runpy, sys
from hybridvo.cli import main
folder = sys.argv[1] if len(sys.argv) > 1 else "nowhere"
tool = lambda name: runpy.run_path(f"tools/{name}.py")["main"]
for door, words in (
    (main, ["run", "--sequence", folder]),
    (main, ["demo", "--out", folder]),
    (tool("train"), ["--config", "configs/train_pwvo.yaml", "--out", folder]),
    (tool("generate_dataset"), ["--out", folder]),
    (tool("train_judge"), ["make", "--data", folder, "--first-seed", "0", "--seeds", "1"]),
):
    with contextlib.redirect_stderr(io.StringIO()) as said:
        code = door(words)
    print(code, said.getvalue().strip())
import hybridvo
for name in ("Odometry", "estimate"):
    try:
        getattr(hybridvo, name)
    except hybridvo.HybridVOError as error:
        print(2, f"{name}: {error}")
main(["doctor"])
"""


@pytest.mark.parametrize("threads", ["0", "many", "1000000"])
def test_numbas_threads_are_refused_in_words(threads: str) -> None:
    """Numba: a ValueError, a warning that holds a traceback, the end of the process."""
    done = in_a_fresh_process(ASK_EVERY_DOOR, NUMBA_NUM_THREADS=threads)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    *doors, ready = done.stdout.strip().splitlines()
    answers = [line for line in doors if line.startswith("2 ")]
    assert len(answers) == 7
    told = (
        f"NUMBA_NUM_THREADS (environment): expected a whole number from 1 to 4096, got '{threads}'"
    )
    assert all(told in line and "Unset it" in line for line in answers)
    assert any(line.startswith("note") and told in line for line in doors)
    assert ready == "NOT ready: see above"
    assert not (ROOT / "nowhere").exists()
