"""Depths of two frames that do not belong to one world, as a pair can tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridvo.api import estimate, refine
from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.core.options import Options, RefineOptions
from hybridvo.core.results import Reason
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.solver.depths import DepthAgreement, compare_depths

K = Camera(140, 140, 127.5, 95.5, height=192, width=256)
T = se3_exp(np.array([0.05, -0.03, 0.1, 0.01, -0.02, 0.015]))


def world(T_cam_world: np.ndarray) -> np.ndarray:
    """Depth of two planes: a wall and a floor, exact at every pixel."""
    v, u = np.mgrid[: K.height, : K.width].astype(float)
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], -1)
    depths = []
    for normal, distance in (((0.3, 0, 1.0), 4.0), ((0.0, 1.0, 0.2), 1.5)):
        turned = T_cam_world[:3, :3] @ np.array(normal)
        along = rays @ turned
        depth = (distance + turned @ T_cam_world[:3, 3]) / np.where(
            along > 1e-3, along, np.nan
        )
        depths.append(depth)
    return np.fmin(*depths)


def make(noise_px: float = 0.1, seed: int = 0) -> FramePair:
    prev, curr = Frame(None, world(np.eye(4)), K), Frame(None, world(T), K, index=1)
    flow = ego_flow(prev.depth, T, K, K)
    rng = np.random.default_rng(seed)
    return FramePair(prev, curr, flow + rng.normal(0, noise_px, flow.shape))


def with_depths(pair: FramePair, change) -> FramePair:
    prev, curr = (replace(f, depth=change(f.depth)) for f in (pair.prev, pair.curr))
    return replace(pair, prev=prev, curr=curr)


def test_numbers_by_hand() -> None:
    # 200 points 3 m away
    camera, weights = Camera(9, 9, 0, 0, height=10, width=300), np.zeros((10, 300))
    weights[3, :200] = 1.0
    depth = np.full((10, 300), 3.0)
    prev, flow = Frame(None, depth.copy(), camera), np.zeros((10, 300, 2))
    depth[3, :50], depth[3, 50:100] = 3.3, 2.7

    def compare(depth: np.ndarray, weights: np.ndarray) -> DepthAgreement | None:
        pair = FramePair(prev, Frame(None, depth, camera), flow)
        return compare_depths(pair, np.eye(4), weights)

    found = compare(depth, weights)
    assert found is not None
    # a quarter at log 1.1 = 0.0953, a quarter at log 0.9, a half at 0: the middle one is 0
    assert found.ratio == pytest.approx(1.0, abs=1e-6)
    assert 0 <= found.log_deviation <= 0.106 and found.status.ok
    twice = compare(2 * depth, weights)
    assert twice is not None and twice.ratio == pytest.approx(2.0, abs=1e-6)
    assert "2 times" in twice.status.message and twice.status.usable
    weights[3, 99:] = 0.0
    assert compare(depth, weights) is None


def test_one_world_is_no_doubt() -> None:
    found = refine(make())
    assert found.status.state.value == "ok"
    # 5 % of noise in every pixel of both is 5 % of spread
    rng = np.random.default_rng(1)
    noisy = with_depths(make(), lambda d: d * np.exp(rng.normal(0, 0.05, d.shape)))
    assert refine(noisy).status.state.value == "ok"


@pytest.mark.parametrize("method", ["classical", "hybrid"])
@pytest.mark.parametrize("low, high", [(0.5, 10.0), (2.0, 4.0)])
def test_depth_of_noise_is_never_simply_ok(
    method: str, low: float, high: float
) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        pair = with_depths(
            make(seed=seed), lambda d, r=rng: r.uniform(low, high, d.shape)
        )
        found = estimate(pair, method=method, seed=seed)
        assert found.status.state.value != "ok"
        # whatever the motion turns on, the depths of 0.5 to 10 m have nothing in common
        assert found.status.state.value == "failed" or low == 2.0


@pytest.mark.parametrize("scale", [0.5, 0.8, 1.3, 1000.0])
def test_another_scale_is_degraded_and_the_motion_that_of_the_first(
    scale: float,
) -> None:
    pair = make()
    pair = replace(pair, curr=replace(pair.curr, depth=scale * pair.curr.depth))
    found = refine(pair)
    assert found.status.reason is Reason.NO_VALID_DEPTH
    assert found.status.state.value == "degraded"
    assert f"{scale:.3g} times" in found.status.message
    # the flow and the first depth alone say how far: 0.1 px over 200 x 256 pixels
    assert np.linalg.norm(found.T_curr_prev[:3, 3] - T[:3, 3]) < 0.003


def test_what_cannot_be_compared_is_no_doubt() -> None:
    pair = make()
    wrong = 3.0 * pair.curr.depth
    for depth, mask in (
        (np.full(K.shape, np.nan), None),
        (np.zeros(K.shape), None),
        (wrong, np.zeros(K.shape, bool)),
        (np.where(np.arange(K.width) < 1, wrong, np.inf), None),
    ):
        curr = replace(pair.curr, depth=depth, mask=mask)
        assert refine(replace(pair, curr=curr)).status.state.value == "ok"
    off = Options(refine=RefineOptions(current_depth="off"))
    unasked = replace(pair, curr=replace(pair.curr, depth=wrong))
    assert refine(unasked, options=off).status.state.value == "ok"
