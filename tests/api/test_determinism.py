"""The same input gives the same answer: again, in another process, with a cold or a warm cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hybridvo.run.cli import main
from tests.walks import command, write_walk

ROOT = Path(__file__).resolve().parents[2]
TOLERANCE = 1e-6
"""Metres, and entries of rotation matrices."""


def in_another_process(code: str, *words: object, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.fspath(ROOT)} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.long
def test_two_runs_agree_and_so_does_one_with_two_threads(tmp_path: Path) -> None:
    walk = write_walk(tmp_path / "walk", 5, height=64, width=96, pictures=True)
    for name in ("first", "second"):
        assert main([*command(walk, tmp_path / name, "--flow", "dis", "-q")]) == 0
    code = "import sys; from hybridvo.run.cli import main; sys.exit(main(sys.argv[1:]))"
    two = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2"
    )
    in_another_process(
        code, *command(walk, tmp_path / "threads", "--flow", "dis", "-q"), **two
    )

    def motions(name: str) -> np.ndarray:
        with np.load(tmp_path / name / "steps.npz") as steps:
            return steps["T_curr_prev"]

    first = motions("first")
    assert first.shape == (5, 4, 4)
    for name in ("second", "threads"):
        np.testing.assert_allclose(motions(name), first, rtol=0, atol=TOLERANCE)


@pytest.mark.long
def test_the_first_motion_on_a_new_machine_is_that_of_every_later_one(
    tmp_path: Path,
) -> None:
    """Once with an empty cache of compiled kernels, once with the cache that this left behind."""
    code = (
        "import json, numpy as np, hybridvo as hvo; "
        "rng = np.random.default_rng(0); "
        "K = hvo.Camera(90, 90, 79.5, 59.5, height=120, width=160); "
        "f = hvo.Frame(None, rng.uniform(2, 5, (120, 160)), K); "
        "flow = np.full((120, 160, 2), 1.5) + rng.normal(0, 0.3, (120, 160, 2)); "
        "print(json.dumps(hvo.refine(hvo.FramePair(f, f, flow)).T_curr_prev.tolist()))"
    )
    cold, warm = (
        json.loads(in_another_process(code, NUMBA_CACHE_DIR=str(tmp_path)))
        for _ in range(2)
    )
    np.testing.assert_allclose(cold, warm, rtol=0, atol=TOLERANCE)
    assert np.abs(np.asarray(cold) - np.eye(4)).max() > 1e-3
