"""What a program with a loop relies on: its arrays are its own, copies go on, bad flow is seen."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import hybridvo as hvo
from hybridvo.core.geometry import invert
from hybridvo.core.results import Reason
from hybridvo.flow.providers import dis_flow
from tests import worlds

PAIR, T_TRUE = worlds.world()


def frames(count: int) -> list[hvo.Frame]:
    """The same view again and again: with ``PAIR.flow`` the motion is that of the pair.

    One pixel changes, or the frames would be one that was handed out again.
    """
    views = []
    for i in range(count):
        rgb = PAIR.prev.rgb.copy()
        depth = PAIR.prev.depth.copy()
        rgb[0, 0] = i
        depth[0, 0] *= 1 + 0.001 * i
        view = replace(PAIR.prev, rgb=rgb, depth=depth, timestamp=0.1 * i, index=i)
        views.append(view)
    return views


def walk(
    vo: hvo.Odometry, count: int, spoil: tuple[str, ...] = ()
) -> list[np.ndarray]:
    """Poses over given flow; ``spoil`` names the arrays of each step that the caller overwrites."""
    poses = []
    for frame in frames(count):
        step = vo.track(frame, PAIR.flow if frame.index else None)
        poses.append(step.T_world_cam.copy())
        for name in spoil:
            getattr(step, name)[...] = 0.0
    return poses


@pytest.mark.parametrize("name", ["T_world_cam", "T_curr_prev", "covariance"])
def test_the_arrays_of_a_step_belong_to_the_caller(name: str) -> None:
    clean = walk(hvo.Odometry(network=None), 4)
    spoiled = walk(hvo.Odometry(network=None), 4, spoil=(name,))
    np.testing.assert_allclose(spoiled, clean, rtol=0, atol=1e-9)
    assert np.linalg.norm(clean[3][:3, 3]) > 0.1


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda vo: pickle.loads(pickle.dumps(vo))]
)
def test_a_tracker_can_be_copied_and_sent_to_a_process(duplicate: Callable) -> None:
    vo = hvo.Odometry(network=None)
    first, second = frames(2)
    vo.track(first)
    other = duplicate(vo)
    one, two = (tracker.track(second, PAIR.flow) for tracker in (vo, other))
    np.testing.assert_allclose(one.T_world_cam, two.T_world_cam, rtol=0, atol=1e-9)


def test_after_a_skipped_frame_a_flow_leads_from_the_last_tracked_one() -> None:
    asked = []

    def provider(prev: hvo.Frame, curr: hvo.Frame) -> np.ndarray:
        asked.append((prev.index, curr.index))
        return PAIR.flow

    for given in (None, PAIR.flow):
        vo = hvo.Odometry(network=None, flow=provider)
        first, _, third = frames(3)
        vo.track(first)
        vo.skip(1, 0.1)
        step = vo.track(third, given)
        np.testing.assert_allclose(
            step.T_world_cam, invert(T_TRUE), rtol=0, atol=1e-5
        )
    assert asked == [(0, 2)]


def test_a_covered_lens_is_no_standstill() -> None:
    vo = hvo.Odometry(network=None)
    vo.track(PAIR.prev)
    black = np.zeros_like(PAIR.prev.rgb)
    for index in (1, 2):
        step = vo.track(
            replace(PAIR.prev, rgb=black, index=index, timestamp=0.1 * index)
        )
        assert step.status.reason is Reason.NO_FLOW


@pytest.mark.parametrize("kind", ["black", "noise", "stripes"])
def test_an_image_without_texture_has_no_flow(kind: str) -> None:
    """DIS answers zero there in both directions: a sure standstill of a moving camera."""
    rgb = PAIR.prev.rgb
    blind = {
        "black": np.zeros_like(rgb),
        "noise": (20 + np.random.default_rng(1).integers(-1, 2, rgb.shape)).astype(
            np.uint8
        ),
        "stripes": np.repeat(rgb[:, :1], rgb.shape[1], axis=1),
    }[kind]
    seen, covered = PAIR.prev, replace(PAIR.prev, rgb=blind)
    dis = dis_flow()
    assert dis(seen, seen).flow is not None
    for prev, curr in ((seen, covered), (covered, seen), (covered, covered)):
        assert dis(prev, curr).flow is None


def test_the_callers_torch_settings_change_nothing() -> None:
    expected = hvo.estimate(PAIR, method="pwvo").T_curr_prev
    torch.set_default_dtype(torch.float64)
    try:
        found = [hvo.estimate(PAIR, method="pwvo").T_curr_prev]
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found.append(hvo.estimate(PAIR, method="pwvo").T_curr_prev)
    np.testing.assert_allclose(found, [expected] * 2, rtol=0, atol=1e-6)
