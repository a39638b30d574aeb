"""The examples of the documentation run, and say what they promise."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from hybridvo.geometry import invert, se3_exp

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def rms(line: str) -> float:
    return float(re.findall(r"([\d.]+) mm", line)[0])


def test_the_pose_graph_closes_the_loop(capsys: pytest.CaptureFixture[str]) -> None:
    assert load("pose_graph").main(["--frames", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("6 frames, 5 motions")
    found = {line.split(":")[0]: rms(line) for line in lines if "from the truth" in line}
    # the loop's own motion is that of a neighbour, so the gap is the walk's drift; a pair of this
    # size is good to a few tenths of a millimetre, and closing adds no more than that
    assert found["scipy"] <= found["chained"] + 0.3
    if "gtsam" in found:
        assert found["gtsam"] == pytest.approx(found["scipy"], abs=0.01)


def loop(module: ModuleType) -> tuple[list[np.ndarray], list[object]]:
    """A square whose last motion contradicts the others, with uneven covariances."""
    side = se3_exp(np.array([0.0, 0.0, 1.0, 0.0, 0.5 * np.pi, 0.0]))
    poses = [np.linalg.matrix_power(side, k) for k in range(4)]
    rng = np.random.default_rng(1)
    factors = []
    for k in range(4):
        A = rng.standard_normal((6, 6))
        covariance = 1e-4 * (A @ A.T + 0.1 * np.eye(6))
        drawn = se3_exp(0.01 * rng.standard_normal(6))
        T_i_j = invert(drawn @ invert(side))
        factors.append(module.Between(k, (k + 1) % 4, T_i_j, covariance))
    return poses, factors


def test_the_residual_is_that_of_hybridvos_covariance() -> None:
    module = load("pose_graph")
    poses, factors = loop(module)
    one = [factors[0]]
    found = module.optimise_scipy(poses[:2], one)
    np.testing.assert_allclose(found[1], poses[0] @ factors[0].T_i_j, atol=1e-6)
    all_of_them = module.optimise_scipy(poses, factors)
    np.testing.assert_array_equal(all_of_them[0], poses[0])
    assert max(np.abs(a - b).max() for a, b in zip(all_of_them, poses, strict=True)) > 1e-4


def test_gtsam_finds_the_same_poses() -> None:
    pytest.importorskip("gtsam")
    module = load("pose_graph")
    poses, factors = loop(module)
    ours, theirs = module.optimise_scipy(poses, factors), module.optimise_gtsam(poses, factors)
    # a covariance in the wrong order or on the wrong side moves the poses by millimetres
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.slow
def test_weights_are_learned_through_the_refinement(capsys: pytest.CaptureFixture[str]) -> None:
    assert load("learn_weights").main(["--updates", "16", "--pairs", "32"]) == 0
    lines = capsys.readouterr().out.splitlines()
    before, after = (float(re.findall(r"([\d.]+) px", line)[0]) for line in (lines[0], lines[-1]))
    assert after < 0.7 * before
