"""What the independent attack on the library found, each fault with the test that keeps it away.

What was tried is in ``docs/attack.md``.
"""

import copy
import os
import pickle
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hybridvo.errors import InputError, OutputError
from hybridvo.flow import contradiction, dis_flow
from hybridvo.geometry import ego_flow, invert, se3_exp, se3_log, to_gtsam_covariance
from hybridvo.odometry import Odometry
from hybridvo.pipeline import estimate
from hybridvo.tracking.window import Located, Window, corrected
from hybridvo.trajectory import Trajectory, write_tum
from hybridvo.types import Camera, Frame, FramePair, Reason, RelativePose, State, Status

H, W = 72, 96
CAMERA = Camera(80.0, 80.0, 47.5, 35.5, H, W)


def _picture(seed=0):
    coarse = np.random.default_rng(seed).uniform(0, 255, (H // 6 + 1, W // 6 + 1, 3))
    return np.kron(coarse, np.ones((6, 6, 1)))[:H, :W].astype(np.uint8)


def _depth():
    v, u = np.mgrid[:H, :W]
    return (3.0 + np.sin(u / 9.0) + np.cos(v / 7.0)).astype(np.float32)


def _frame(rgb=None, index=0):
    return Frame(rgb, _depth(), CAMERA, timestamp=0.1 * index, index=index)


def _flow(scale=1.0):
    motion = se3_exp(scale * np.array([0.02, -0.01, 0.03, 0.004, -0.006, 0.002]))
    return ego_flow(_depth(), motion, CAMERA, CAMERA).astype(np.float32)


@pytest.mark.parametrize("kind", ["black", "noise", "stripes"])
def test_a_picture_without_texture_has_no_flow(kind):
    """DIS answers zero there in both directions: a confident standstill of a moving camera."""
    rng = np.random.default_rng(1)
    blind = {
        "black": np.zeros((H, W, 3), np.uint8),
        "noise": (20 + rng.integers(-1, 2, (H, W, 3))).astype(np.uint8),
        "stripes": np.repeat(_picture()[:, :1], W, axis=1),
    }[kind]
    seen, covered = _frame(_picture()), _frame(blind)
    dis = dis_flow()
    assert dis(seen, seen).flow is not None
    for prev, curr in ((seen, covered), (covered, seen), (covered, covered)):
        assert dis(prev, curr).flow is None


def test_a_tracker_with_a_covered_lens_says_so():
    vo = Odometry(network=None, prepare=False)
    vo.track(_frame(_picture()))
    for index in (1, 2):
        step = vo.track(_frame(np.zeros((H, W, 3), np.uint8), index))
        assert step.status.reason is Reason.NO_FLOW


def test_one_flow_provider_serves_several_threads():
    """Two threads in one DIS object ended the process."""
    dis, a, b = dis_flow(), _frame(_picture(1)), _frame(_picture(2))
    expected = dis(a, b).flow
    results, threads = [], []
    for _ in range(3):
        work = lambda: results.extend(dis(a, b).flow for _ in range(10))  # noqa: E731
        threads.append(threading.Thread(target=work))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 30
    assert all(np.array_equal(flow, expected) for flow in results)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda vo: pickle.loads(pickle.dumps(vo))])
def test_a_tracker_can_be_copied_and_sent_to_a_process(duplicate):
    vo = Odometry(network=None, prepare=False)
    vo.track(_frame(_picture(1)))
    other = duplicate(vo)
    frame = _frame(_picture(1), 1)
    assert np.array_equal(vo.track(frame).T_world_cam, other.track(frame).T_world_cam)


def _walk(vo, indices, spoil=()):
    """Steps over given flow; ``spoil`` are the arrays of each step that the caller overwrites."""
    steps = []
    for index in indices:
        flow = _flow(1.0 + 0.1 * index) if index else None
        step = vo.track(_frame(_picture(), index), flow)
        steps.append((step.T_world_cam.copy(), step.covariance.copy()))
        for name in spoil:
            getattr(step, name)[...] = 0.0
    return steps


@pytest.mark.parametrize("name", ["T_world_cam", "T_curr_prev", "covariance"])
def test_the_arrays_of_a_step_belong_to_the_caller(name):
    """The last motion was kept by reference: a unit conversion in place ended the tracker."""
    clean = _walk(Odometry(network=None, prepare=False), range(5))
    spoiled = _walk(Odometry(network=None, prepare=False), range(5), spoil=[name])
    for (T, covariance), (T_spoiled, covariance_spoiled) in zip(clean, spoiled, strict=True):
        assert np.array_equal(T, T_spoiled) and np.array_equal(covariance, covariance_spoiled)


def test_prediction_and_anchor_are_no_door_into_the_tracker():
    vo, other = (Odometry(network=None, prepare=False) for _ in range(2))
    _walk(vo, range(3))
    _walk(other, range(3))
    vo.predict().T_curr_prev[...] = 0.0
    with pytest.raises(ValueError, match="read-only"):
        vo.anchor.T_world_cam[...] = 0.0
    assert np.array_equal(_walk(vo, [3])[0][0], _walk(other, [3])[0][0])


WRONG_OPTIONS = [
    {"seed": "x"},
    {"seed": None},
    {"seed": -1},
    {"seed": 1.5},
    {"seed": True},
    {"seed": 2**70},
    {"options": {"cutoff": 3}},
    {"photometric": "x"},
    {"window_options": {}},
]


@pytest.mark.parametrize("option", WRONG_OPTIONS, ids=str)
def test_options_of_another_kind_are_refused_at_the_door(option):
    with pytest.raises(InputError, match=f"Odometry.{next(iter(option))}"):
        Odometry(network=None, prepare=False, **option)


@pytest.mark.parametrize("frames", [0, -1, 1.5, "x", None, 10**400, float("nan")], ids=str)
def test_predict_refuses_what_is_no_number_of_frames(frames):
    with pytest.raises(InputError, match="predict"):
        Odometry(network=None, prepare=False).predict(frames)


BAD_LAST_ROW = np.vstack([np.eye(4)[:3], [0, 0, 1, 1]])


@pytest.mark.parametrize("T", ["x", None, BAD_LAST_ROW, np.eye(4) * 1j, np.zeros((4, 4))], ids=str)
def test_set_pose_refuses_what_is_no_pose(T):
    with pytest.raises(InputError, match="set_pose"):
        Odometry(network=None, prepare=False).set_pose(T)


def test_resume_and_skip_refuse_what_a_trajectory_could_not_hold():
    vo = Odometry(network=None, prepare=False)
    for anchor in (None, "x", {}):
        with pytest.raises(InputError, match="resume"):
            vo.resume(anchor)
    for index, stamp in ((1, float("nan")), ("a", 0.0), (1, "b"), (None, 0.0)):
        with pytest.raises(InputError, match="skip"):
            vo.skip(index, stamp)


def test_masked_pixels_are_invalid():
    """The mask of a masked array was dropped: its fill values took part as depth and flow."""
    depth, flow = _depth(), _flow()
    hidden = np.zeros((H, W), bool)
    hidden[:20] = True
    depth[hidden], flow[hidden] = 9.0, 99.0
    frame = Frame(None, np.ma.masked_array(depth, hidden), CAMERA)
    pair = FramePair(frame, frame, np.ma.masked_array(flow, np.stack([hidden] * 2, -1)))
    assert np.array_equal(np.isnan(pair.prev.depth), hidden)
    assert np.array_equal(np.isnan(pair.flow).any(-1), hidden)


def test_what_is_no_array_is_refused_in_words():
    torch = pytest.importorskip("torch")
    frame = _frame()
    for flow in (torch.zeros(H, W, 2, requires_grad=True), torch.zeros(H, W, 2, device="meta")):
        with pytest.raises(InputError, match=r"FramePair\.flow"):
            FramePair(frame, frame, flow)
    with pytest.raises(InputError, match=r"Frame\.depth"):
        Frame(None, [[1.0], [1.0, 2.0]], CAMERA)
    with pytest.raises(InputError, match="3x3"):
        Camera.from_matrix("K", H, W)
    vo = Odometry(network=None, prepare=False, flow=lambda prev, curr: (_flow(), None))
    vo.track(frame)
    with pytest.raises(InputError, match="flow"):
        vo.track(frame)


@pytest.mark.parametrize("index", ["a", 1.5, None, float("nan")], ids=str)
def test_an_index_is_a_whole_number(index):
    with pytest.raises(InputError, match=r"Frame\.index"):
        Frame(None, _depth(), CAMERA, index=index)


def test_a_result_never_replaces_a_device_or_a_pipe(tmp_path):
    """As root, a trajectory written to /dev/full took the device's place."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    path = Trajectory([0.0], [np.eye(4)])
    with pytest.raises(OutputError, match="pipe"):
        write_tum(path, pipe)
    assert pipe.is_fifo() and [p.name for p in tmp_path.iterdir()] == ["pipe"]
    for nowhere in (None, 3, "a\0b"):
        with pytest.raises(InputError, match="path"):
            write_tum(path, nowhere)
    with pytest.raises(InputError, match="Trajectory"):
        write_tum([np.eye(4)], tmp_path / "list.txt")
    with pytest.raises(InputError, match="T_new_world"):
        path.transformed(None)


def test_errors_of_what_is_no_trajectory_are_refused(tmp_path):
    from hybridvo.evaluation.metrics import evaluate_files, evaluate_trajectories

    path = Trajectory([0.0, 1.0], [np.eye(4)] * 2)
    for wrong in (None, path.T_world_cam, "x.txt"):
        with pytest.raises(InputError, match="Trajectory"):
            evaluate_trajectories(wrong, path)
        with pytest.raises(InputError, match="Trajectory"):
            evaluate_trajectories(path, wrong)
    for option in ({"max_diff": "x"}, {"delta": "x"}, {"delta": float("nan")}, {"start_step": "x"}):
        with pytest.raises(InputError, match=next(iter(option))):
            evaluate_trajectories(path, path, **option)
    write_tum(path, tmp_path / "a.tum")
    with pytest.raises(InputError, match="foo"):
        evaluate_files(tmp_path / "a.tum", tmp_path / "a.tum", foo=1)


def _located(T, covariance):
    return Located(Window(), T, covariance, Status(), used=True)


def test_a_step_that_corrects_older_poses_is_no_sure_measurement():
    """After a frame of another place the key frames pulled the pose back: ok, 2962 sigma off."""
    pair = RelativePose(T_curr_prev=se3_exp(np.full(6, 0.01)), covariance=1e-8 * np.eye(6))
    jump = np.array([0.6, 0.0, 0.1, 0.0, 0.02, 0.0])
    T = se3_exp(jump) @ pair.T_curr_prev
    step = corrected(pair, _located(T, pair.covariance), T)
    assert step.status.state is State.DEGRADED and "0.608 m" in step.status.message
    error = se3_log(step.T_curr_prev @ invert(pair.T_curr_prev))
    # one outer product: the correction is one standard deviation of what is claimed
    assert error @ np.linalg.solve(step.covariance, error) <= 1.0
    assert np.array_equal(step.T_curr_prev, T)


def test_a_correction_of_drift_stays_a_measurement():
    pair = RelativePose(T_curr_prev=se3_exp(np.full(6, 0.01)), covariance=1e-8 * np.eye(6))
    T = se3_exp(np.full(6, 2e-4)) @ pair.T_curr_prev  # chi-square 12
    step = corrected(pair, _located(T, pair.covariance), T)
    assert step.status.state is State.OK
    assert np.array_equal(step.covariance, pair.covariance)


SIZE = (120, 160)
SEEN = Camera(130.0, 130.0, 79.5, 59.5, *SIZE)


def _moving_pair(flow_of=lambda flow: flow, **more):
    """A picture shifted by (6, 3) px beside its true flow, or a wrong one made of it."""
    rng = np.random.default_rng(3)
    wide = cv2.GaussianBlur(rng.uniform(0, 255, (140, 180, 3)), (0, 0), 3)
    wide = ((wide - wide.min()) / np.ptp(wide) * 255).astype(np.uint8)
    prev, curr = wide[10:130, 10:170], wide[7:127, 4:164]
    depth = np.full(SIZE, 3.0, np.float32)
    flow = np.broadcast_to(np.float32([6.0, 3.0]), (*SIZE, 2))
    frames = (Frame(np.ascontiguousarray(rgb), depth, SEEN) for rgb in (prev, curr))
    return FramePair(*frames, np.array(flow_of(flow), np.float32), **more)


WRONG_FLOWS = {
    "negated": lambda flow: -flow,
    "zero": lambda flow: 0 * flow,
    "twice": lambda flow: 2.2 * flow,
    "normalised": lambda flow: flow / [160, 120],
    "(v, -u)": lambda flow: flow[..., ::-1] * [1, -1],
}


@pytest.mark.parametrize("kind", WRONG_FLOWS)
def test_a_flow_that_the_pictures_contradict_is_refused(kind):
    """A wrong sign, unit or order gave ok and a wrong motion at thousands of sigma."""
    message = contradiction(_moving_pair(WRONG_FLOWS[kind]))
    assert message is not None and "sign" in message
    found = estimate(_moving_pair(WRONG_FLOWS[kind]))
    assert found.status.state is State.FAILED and found.status.reason is Reason.NO_FLOW
    # what was asked not to look at the pictures does not
    assert contradiction(_moving_pair(WRONG_FLOWS[kind], flow_source="dis")) is None


def test_a_right_flow_is_not_doubted():
    rng = np.random.default_rng(0)
    noisy = lambda flow: flow + rng.normal(0, 3, flow.shape)  # noqa: E731
    holes = lambda flow: np.where(rng.random((*SIZE, 1)) < 0.4, np.nan, flow)  # noqa: E731
    wrong = lambda flow: np.where(rng.random((*SIZE, 1)) < 0.3, 40.0, flow)  # noqa: E731
    for kind in (lambda flow: flow, noisy, holes, wrong):
        assert contradiction(_moving_pair(kind)) is None


def test_pictures_that_tell_nothing_contradict_nothing():
    pair = _moving_pair(WRONG_FLOWS["negated"])
    black = np.zeros_like(pair.prev.rgb)
    other = np.random.default_rng(9).integers(0, 255, black.shape, dtype=np.uint8)
    for rgb in (black, other, pair.prev.rgb, None):
        assert contradiction(replace(pair, curr=replace(pair.curr, rgb=rgb))) is None
    tiny = Frame(np.zeros((3, 4, 3), np.uint8), None, Camera(4, 4, 1.5, 1.0, 3, 4))
    assert contradiction(FramePair(tiny, tiny, np.zeros((3, 4, 2), np.float32))) is None


WRONG_ARGUMENTS = [
    {"seed": "x"},
    {"seed": 2**70},
    {"T_last": np.zeros((4, 4))},
    {"T_last": np.stack([np.eye(4)] * 3)},
    {"T_last": "x"},
    {"options": {}},
    {"photometric": {}},
    {"trust": "x"},
    {"trust": float("nan")},
]


@pytest.mark.parametrize("argument", WRONG_ARGUMENTS, ids=str)
def test_estimate_refuses_arguments_of_another_kind(argument):
    with pytest.raises(InputError, match=next(iter(argument))):
        estimate(FramePair(_frame(), _frame(), _flow()), method="refine", **argument)
    with pytest.raises(InputError, match="FramePair"):
        estimate((_frame(), _frame(), _flow()))


def test_the_callers_torch_settings_do_not_reach_the_judge():
    """A default dtype of float64, or autocast, ended the hybrid in a traceback."""
    torch = pytest.importorskip("torch")
    pair = FramePair(_frame(), _frame(), _flow())
    expected = estimate(pair).T_curr_prev
    torch.set_default_dtype(torch.float64)
    try:
        assert np.array_equal(estimate(pair).T_curr_prev, expected)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert np.array_equal(estimate(pair).T_curr_prev, expected)


@pytest.mark.parametrize("wrong", [None, np.eye(4), "x"], ids=str)
def test_a_covariance_for_gtsam_has_six_rows(wrong):
    with pytest.raises(InputError, match="to_gtsam_covariance"):
        to_gtsam_covariance(wrong)


@pytest.mark.parametrize("seed", [-1, 2**70])
def test_a_comparison_refuses_a_seed_before_it_makes_a_folder(tmp_path, seed):
    from hybridvo.comparison.runner import ComparisonOptions, compare

    options = ComparisonOptions(("nowhere",), methods=("identity",), seed=seed)
    with pytest.raises(InputError, match="seed"):
        compare(options, tmp_path / "out", quiet=True)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", [{"jobs": 0}, {"worst": -1}], ids=str)
def test_a_comparison_refuses_counts_that_cannot_be_meant(option):
    """``--worst -1`` meant all but one, ``--jobs 0`` left a folder behind."""
    from hybridvo.comparison.runner import ComparisonOptions

    with pytest.raises(InputError, match=f"--{next(iter(option))}"):
        ComparisonOptions(("nowhere",), **option)
