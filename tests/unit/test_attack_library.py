"""What the independent attack on the library found, each fault with the test that keeps it away.

What was tried is in ``docs/attack.md``.
"""

import copy
import pickle
import threading
from dataclasses import replace

import numpy as np
import pytest

from hybridvo.errors import InputError, OutputError
from hybridvo.flow import dis_flow
from hybridvo.geometry import ego_flow, se3_exp
from hybridvo.odometry import Odometry
from hybridvo.trajectory import Trajectory, write_tum
from hybridvo.types import Camera, Frame, FramePair, Reason, State

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
