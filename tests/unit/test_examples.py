"""The examples of the documentation run, and say what they promise."""

from __future__ import annotations

import importlib.util
import re
import sys
import textwrap
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import hybridvo
from hybridvo.geometry import invert, se3_exp
from hybridvo.results import Reason, RelativePose, Status

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
    assert lines[0].startswith("6 of 6 frames, 5 motions")
    found = {
        line.split(":")[0]: rms(line) for line in lines if "from the truth" in line
    }
    # the loop's own motion is that of a neighbour, so the gap is the walk's drift; a pair of this
    # size is good to a few tenths of a millimetre, and closing adds no more than that
    assert found["scipy"] <= found["chained"] + 0.3
    if "gtsam" in found:
        assert found["gtsam"] == pytest.approx(found["scipy"], abs=0.01)


def test_a_sequence_that_is_not_there_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert load("pose_graph").main(["--sequence", str(tmp_path / "nosuch")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1 and "nosuch" in said.err


class Scripted:
    """A tracker whose steps are written down: states of the frames 1, 2, ..., each 0.1 m ahead.

    As in ``hvo.Odometry`` a frame whose motion failed is passed over, and after two failures in a
    row the next motion starts from the second of these frames.
    """

    def __init__(self, states: list[str]) -> None:
        self.states = states
        self.index = 0
        self.reference = 0
        self.failed = 0

    def track(self, frame: object) -> hybridvo.Step:
        prev_index = None if self.index == 0 else self.reference
        motion = RelativePose(covariance=1e-6 * np.eye(6))
        if prev_index is not None:
            ahead = 0.1 * (self.index - prev_index)
            motion = motion.replace(
                T_curr_prev=se3_exp(np.array([0, 0, -ahead, 0, 0, 0]))
            )
            state = self.states[self.index - 1]
            if state == "degraded":
                status = Status.degraded(Reason.AMBIGUOUS_MOTION, "")
                motion = motion.replace(status=status, covariance=1e-2 * np.eye(6))
            if state == "failed":
                motion = RelativePose.failed(Reason.NO_FLOW, "")
        self.failed = 0 if motion.usable else self.failed + 1
        if motion.usable or self.failed == 2:
            self.reference = self.index
        pose = se3_exp(np.array([0, 0, 0.1 * self.index, 0, 0, 0]))
        step = hybridvo.Step(self.index, 0.1 * self.index, pose, motion, prev_index)
        self.index += 1
        return step


def tracked(
    monkeypatch: pytest.MonkeyPatch, states: list[str]
) -> tuple[list, list, list]:
    """What the example makes of a tracker with these states; a number stands for a frame."""
    module = load("pose_graph")
    monkeypatch.setattr(module.hvo, "Odometry", lambda: Scripted(states))
    kept, poses, factors = module.track(range(len(states) + 1))
    # connected: every node but the first is the end of a factor that starts at an earlier one
    assert sorted(f.j for f in factors) == list(range(1, len(kept)))
    assert all(f.i < f.j for f in factors)
    for pose, found in zip(
        poses, module.optimise_scipy(poses, factors), strict=True
    ):
        np.testing.assert_allclose(found, pose, atol=1e-9)
    return kept, poses, factors


def test_a_degraded_step_keeps_the_graph_in_one_piece(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept, _, factors = tracked(monkeypatch, ["ok", "degraded", "ok"])
    assert kept == [0, 1, 2, 3]
    assert [f.covariance[0, 0] for f in factors] == [1e-6, 1e-2, 1e-6]


def test_the_frame_of_a_failed_step_is_spanned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept, _, factors = tracked(monkeypatch, ["ok", "failed", "ok"])
    assert kept == [0, 1, 3]
    assert (factors[1].i, factors[1].j) == (1, 2)
    np.testing.assert_allclose(factors[1].T_i_j[2, 3], 0.2)


def test_a_walk_that_broke_ends_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kept, _, _ = tracked(monkeypatch, ["ok", "failed", "failed", "ok"])
    assert kept == [0, 1]
    assert "lost before frame 4" in capsys.readouterr().out


def blocks(page: str) -> list[str]:
    """The Python code of a page, in its order."""
    text = (EXAMPLES.parent / page).read_text(encoding="utf-8")
    found = re.findall(
        r"^( *)```python\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE
    )
    return [textwrap.dedent(code) for _, code in found]


def test_the_code_of_the_librarys_page_runs(
    image_walk: Path, tmp_path: Path
) -> None:
    sequence = hybridvo.open_sequence(image_walk)
    frames = [sequence[i] for i in range(3)]
    factors: list[tuple] = []
    names = {
        "sensor": [(frame.rgb, frame.depth, frame.timestamp) for frame in frames],
        "camera": frames[0].camera,
        "graph": SimpleNamespace(
            add_between=lambda *factor: factors.append(factor)
        ),
        "map_": SimpleNamespace(insert=lambda *_: None),
        "frame0": frames[0],
        "frame1": frames[1],
        "flow": hybridvo.dis_flow()(frames[0], frames[1]).flow,
        "pairs": list(hybridvo.iter_pairs(sequence, flow=hybridvo.dis_flow()))[:1],
    }
    for code in blocks("library.md"):
        code = code.replace("path/to/sequence", str(image_walk))
        exec(code.replace("path.tum", str(tmp_path / "path.tum")), names)
    # a motion starts from the frame before, or from an earlier one that is surer
    assert [curr for _, curr, *_ in factors] == [1, 2]
    assert all(prev < curr for prev, curr, *_ in factors)
    assert len((tmp_path / "path.tum").read_text().splitlines()) == len(sequence)


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
    assert (
        max(np.abs(a - b).max() for a, b in zip(all_of_them, poses, strict=True))
        > 1e-4
    )


def test_gtsam_finds_the_same_poses() -> None:
    pytest.importorskip("gtsam")
    module = load("pose_graph")
    poses, factors = loop(module)
    ours, theirs = (
        module.optimise_scipy(poses, factors),
        module.optimise_gtsam(poses, factors),
    )
    # a covariance in the wrong order or on the wrong side moves the poses by millimetres
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.slow
def test_weights_are_learned_through_the_refinement(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert load("learn_weights").main(["--updates", "16", "--pairs", "32"]) == 0
    lines = capsys.readouterr().out.splitlines()
    before, after = (
        float(re.findall(r"([\d.]+) px", line)[0]) for line in (lines[0], lines[-1])
    )
    assert after < 0.7 * before
