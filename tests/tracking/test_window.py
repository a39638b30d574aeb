from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from hybridvo.errors import InputError
from hybridvo.geometry import invert, se3_exp, se3_log
from hybridvo.options import TrackOptions
from hybridvo.results import Reason, RelativePose, State, Status
from hybridvo.tracking.pose_graph import (
    FREEDOM,
    Edge,
    chi2,
    compose_covariance,
    solve_graph,
)
from hybridvo.tracking.state import MotionModel, TrackerState
from hybridvo.tracking.window import KeyFrame, Located, View, Window, locate
from hybridvo.types import Camera, Frame

HEIGHT, WIDTH = 48, 64
CAMERA = Camera(60, 60, 31.5, 23.5, HEIGHT, WIDTH)
DEPTH = np.full((HEIGHT, WIDTH), 4.0, np.float32)
STEP = se3_exp(np.array([0.04, -0.01, 0.02, 0.001, -0.004, 0.002]))
"""Motion of the camera from frame to frame: 0.6 px to the side."""
SURE = np.diag([1e-3**2] * 3 + [3e-4**2] * 3)
"""Covariance of every motion of these tests before the window inflates it."""
WRONG = se3_exp(np.array([0.1, 0.05, -0.08, 0.01, 0.02, -0.01]))
OPTIONS = TrackOptions()


def frame(index: int) -> Frame:
    return Frame(np.zeros((HEIGHT, WIDTH, 3), np.uint8), DEPTH, CAMERA, 0.1 * index, index)


def power(T: np.ndarray, n: int) -> np.ndarray:
    return np.linalg.matrix_power(T, n)


def right(key: KeyFrame, curr: Frame, *rest: object) -> RelativePose:
    return RelativePose(power(STEP, curr.index - key.frame.index), SURE)


def nothing(key: KeyFrame, curr: Frame, *rest: object) -> RelativePose:
    return RelativePose.failed(Reason.LOW_INLIERS, "not seen")


def walk(
    frames: int,
    motion: Callable[[int], RelativePose],
    register: Callable[..., RelativePose] = right,
    size: int = 5,
    options: TrackOptions = OPTIONS,
) -> list[Located]:
    """Every frame of a walk, ``motion(k)`` being what was found from k - 1 to k."""
    window, out = Window((KeyFrame(frame(0), np.eye(4)),)), []
    for k in range(1, frames):
        located = locate(window, motion(k), frame(k - 1), frame(k), register, size, options)
        out.append(located)
        window = located.window
    return out


def error(located: Located, k: int) -> float:
    """Translation error of frame k, metres."""
    return float(np.linalg.norm(located.T_world_cam[:3, 3] - invert(power(STEP, k))[:3, 3]))


def biased(k: int) -> RelativePose:
    return RelativePose(se3_exp(np.array([1e-3, 0, 0, 0, 0, 0])) @ STEP, SURE)


def test_composed_covariance_is_that_of_drawn_motions() -> None:
    rng = np.random.default_rng(0)
    first, second = se3_exp(np.array([0.5, 0, 1, 0.2, 0.1, 0])), STEP
    root = np.diag([0.01, 0.02, 0.01, 0.005, 0.002, 0.004])
    T = second @ first
    drawn = np.array(
        [
            se3_log(
                se3_exp(root @ rng.standard_normal(6))
                @ second
                @ se3_exp(root @ rng.standard_normal(6))
                @ first
                @ invert(T)
            )
            for _ in range(4000)
        ]
    )
    expected = compose_covariance(root @ root, second, root @ root)
    scale = np.sqrt(np.diag(expected))
    found = np.cov(drawn.T) / np.outer(scale, scale)
    # 4000 draws: an entry of the correlation has a standard deviation of at most 0.022
    np.testing.assert_allclose(found, expected / np.outer(scale, scale), atol=0.1)


def graph(seed: int, noise: float = 1.0) -> tuple[dict[int, np.ndarray], list[Edge]]:
    """Six frames with edges over strides of 1, 2 and 4, and drawn errors."""
    rng = np.random.default_rng(seed)
    poses = {0: np.eye(4)}
    for k in range(1, 6):
        poses[k] = poses[k - 1] @ se3_exp(0.2 * rng.standard_normal(6))
    edges = []
    for stride in (1, 2, 4):
        for k in range(6 - stride):
            A = rng.standard_normal((6, 6))
            covariance = 1e-4 * (A @ A.T / 6 + 0.3 * np.eye(6))
            drawn = noise * np.linalg.cholesky(covariance) @ rng.standard_normal(6)
            T = se3_exp(drawn) @ invert(poses[k + stride]) @ poses[k]
            edges.append(Edge(k, k + stride, T, covariance))
    return poses, edges


def test_the_graph_has_the_solution_that_scipy_finds() -> None:
    true, edges = graph(3)
    start = {0: true[0]}
    for k in range(1, 6):
        start[k] = start[k - 1] @ invert(edges[k - 1].T)

    def residuals(x: np.ndarray) -> np.ndarray:
        T = {0: true[0]} | {k: start[k] @ se3_exp(x[6 * k - 6 : 6 * k]) for k in range(1, 6)}
        d2 = np.array([chi2(e.T @ invert(T[e.prev]) @ T[e.curr], e.covariance) for e in edges])
        return np.sqrt((FREEDOM + 6) * np.log1p(d2 / FREEDOM))

    found = least_squares(residuals, np.zeros(30), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    answer = solve_graph(start, edges, free=range(1, 6))
    assert answer.cost == pytest.approx(found.cost, rel=1e-4)
    for k in range(1, 6):
        expected = start[k] @ se3_exp(found.x[6 * k - 6 : 6 * k])
        # reweighting closes in by a factor a step, and ten steps leave 0.02 of a standard
        # deviation, which is 0.01 here
        np.testing.assert_allclose(answer.T_world_cam[k], expected, atol=2e-4)
    np.testing.assert_array_equal(answer.T_world_cam[0], true[0])


def test_a_wrong_edge_has_no_weight_and_a_failed_one_none_either() -> None:
    true, edges = graph(4, noise=0.5)
    alone = solve_graph(true, edges, free=range(1, 6))
    bad = replace(edges[7], T=WRONG @ edges[7].T)
    failed = Edge(0, 5, WRONG, np.eye(6), Status.failed(Reason.LOW_INLIERS, "nothing seen"))
    answer = solve_graph(true, [*edges[:7], bad, *edges[8:], failed], free=range(1, 6))
    assert answer.edges[7].weight == 0 and not answer.edges[7].ok
    assert answer.edges[-1].weight == 0 and not answer.edges[-1].ok
    assert all(e.ok for e in answer.edges[:7])
    for k in range(1, 6):
        # without the edge, and with what Student's kernel leaves it: within a standard deviation
        np.testing.assert_allclose(answer.T_world_cam[k], alone.T_world_cam[k], atol=0.01)


def test_key_frames_stop_the_drift_of_biased_motions() -> None:
    frames = 60
    with_window = walk(frames, biased)
    chained = walk(frames, biased, register=nothing)
    assert error(chained[-1], frames - 1) > 0.05  # 59 motions of a millimetre too much
    assert error(with_window[-1], frames - 1) < 0.6 * error(chained[-1], frames - 1)
    assert not any(located.used for located in chained)
    for located in with_window[10:]:
        assert located.motion.status.usable and located.used


def test_key_frames_are_taken_where_the_camera_has_moved_on() -> None:
    still = RelativePose(np.eye(4), SURE)
    held = walk(12, lambda k: still, register=lambda *_: still)
    assert [key.frame.index for key in held[-1].window.keys] == [0]
    moving = walk(40, biased)
    taken = [key.frame.index for key in moving[-1].window.keys]
    # 0.6 px a frame, the limit is 8 % of 64 px
    assert all(5 <= b - a <= 10 for a, b in pairwise(taken))


def test_one_wrong_stride_does_not_overrule_the_chain() -> None:
    def wrong_at_20(key: KeyFrame, curr: Frame, *rest: object) -> RelativePose:
        found = right(key, curr, *rest)
        if curr.index == 20 and key.frame.index == newest[0]:
            return found.replace(T_curr_prev=WRONG @ found.T_curr_prev)
        return found

    newest = [-1]
    before = walk(20, lambda k: RelativePose(STEP, SURE))
    newest[0] = before[-1].window.keys[-1].frame.index
    located = walk(26, lambda k: RelativePose(STEP, SURE), register=wrong_at_20)
    at = located[19]
    assert error(at, 20) < 5e-3 and at.motion.status.state is State.OK
    assert [e.weight == 0 for e in at.window.found if e.prev == newest[0]][-1]
    assert error(located[-1], 25) < 5e-3


def test_two_strides_that_agree_overrule_a_wrong_motion() -> None:
    def motion(k: int) -> RelativePose:
        return RelativePose(WRONG @ STEP if k == 20 else STEP, SURE)

    located = walk(24, motion)
    at = located[19]
    assert error(at, 20) < 5e-3
    status = at.motion.status
    assert status.state is State.DEGRADED and status.reason is Reason.AMBIGUOUS_MOTION
    assert error(located[20], 21) < 5e-3 and located[20].motion.status.state is State.OK
    # without longer strides the error stays for good
    assert error(walk(24, motion, register=nothing)[-1], 23) > 0.05


def test_a_failed_motion_is_taken_over_a_key_frame() -> None:
    lost = RelativePose.failed(Reason.NO_FLOW, "no flow")
    asked = []

    def register(key: KeyFrame, curr: Frame, prior: object, weights: object) -> RelativePose:
        if prior is None:
            asked.append(curr.index)
        return right(key, curr)

    located = walk(20, lambda k: lost if k == 15 else RelativePose(STEP, SURE), register)
    assert asked == [15]  # without a start where nothing is known, and only there
    assert located[14].motion.status.state is State.DEGRADED and error(located[14], 15) < 5e-3
    assert located[15].motion.status.state is State.OK and error(located[-1], 19) < 5e-3


def test_a_failed_motion_that_no_key_frame_knows_either_stays_failed() -> None:
    lost = RelativePose.failed(Reason.NO_FLOW, "no flow")
    located = walk(20, lambda k: lost if k == 15 else RelativePose(STEP, SURE), register=nothing)
    assert located[14].motion.status.state is State.FAILED and not located[14].used
    assert located[14].motion.covariance[0, 0] >= 1.0
    # a new walk begins beyond it: later motions are as sure as ever
    assert located[15].motion.status.usable and located[-1].window.keys[-1].frame.index >= 16
    assert located[-1].motion.covariance[0, 0] < 1e-4


def test_a_view_leaves_out_what_is_masked_hidden_or_outside() -> None:
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, :32] = False
    near = DEPTH.copy()
    near[:24] = 3.0  # something stands in front of the upper half
    key = KeyFrame(frame(0), np.eye(4))
    assert View(key, np.eye(4), frame(1)).overlap == 1.0
    assert View(key, np.eye(4), replace(frame(1), mask=mask)).overlap == pytest.approx(0.5)
    assert View(key, np.eye(4), replace(frame(1), depth=near)).overlap == pytest.approx(0.5)
    aside = se3_exp(np.array([2.0, 0, 0, 0, 0, 0]))  # 30 px to the right of 64
    view = View(key, aside, frame(1))
    assert view.overlap == pytest.approx(34 / 64, abs=0.07)  # a cell is 4 px wide
    assert view.motion == pytest.approx(30 / 64)
    weights = view.weights((HEIGHT, WIDTH))
    assert weights.shape == (HEIGHT, WIDTH) and weights[:, :32].all() and not weights[:, 40:].any()


def test_steps_say_how_sure_they_are() -> None:
    rng = np.random.default_rng(5)
    root = np.sqrt(OPTIONS.inflation) * np.sqrt(SURE)

    def noisy(T: np.ndarray) -> RelativePose:
        return RelativePose(se3_exp(root @ rng.standard_normal(6)) @ T, SURE)

    located = walk(
        160,
        lambda k: noisy(STEP),
        register=lambda key, curr, *_: noisy(power(STEP, curr.index - key.frame.index)),
    )
    squared = []
    for a, b in pairwise(located):
        step = invert(b.T_world_cam) @ a.T_world_cam
        squared.append(chi2(step @ invert(STEP), b.motion.covariance))
    # 6 where all is independent; poses read from one key frame, and merged ones, do better
    assert 1.0 < np.mean(squared) < 9.0


def test_the_model_knows_how_well_constant_velocity_held() -> None:
    rng = np.random.default_rng(2)
    sigma = np.array([0.02, 0.01, 0.03, 0.004, 0.006, 0.002])
    for ahead in (1, 3):
        motion, model, squared = STEP, MotionModel(), []
        for k in range(400):
            prediction = model.predict(ahead)
            motions = [motion]
            for _ in range(ahead):
                motions.append(se3_exp(sigma * rng.standard_normal(6)) @ motions[-1])
            if prediction is not None and k > 20:
                true = np.eye(4)
                for T in motions[1:]:
                    true = T @ true
                squared.append(chi2(true @ invert(prediction.T_curr_prev), prediction.covariance))
            motion = motions[1]
            model = model.observed(motion)
        # twice the mean square of the last ten changes: a mean of 3 to 6 for six numbers
        assert 1.5 < np.mean(squared) < 7.0


def test_the_state_goes_through_a_file(tmp_path: Path) -> None:
    window = walk(40, biased)[-1].window
    model = MotionModel()
    for _ in range(4):
        model = model.observed(STEP @ se3_exp(1e-3 * np.arange(6)))
    state = TrackerState(frame(39), STEP, WRONG, model, 2, 1, 40, window)
    np.savez(tmp_path / "state.npz", **state.to_arrays())
    with np.load(tmp_path / "state.npz", allow_pickle=False) as arrays:
        back = TrackerState.from_arrays(arrays)
    again = back.to_arrays()
    for name, array in state.to_arrays().items():
        np.testing.assert_array_equal(again[name], array)
    assert (back.gap, back.failed, back.count) == (2, 1, 40) and back.frame is not None
    assert [e.status for e in back.window.edges] == [e.status for e in window.edges]
    first = TrackerState()
    assert TrackerState.from_arrays(first.to_arrays()).frame is None
    with pytest.raises(InputError, match="to_arrays"):
        TrackerState.from_arrays({})
