"""Depth whose scale changes from frame to frame, as that of networks does."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from hybridvo import Frame, Odometry
from hybridvo.core.geometry import chain, invert, se3_exp
from hybridvo.core.options import DepthOptions, Options
from hybridvo.core.results import RelativePose, Step
from hybridvo.tracking.depth_scale import (
    ScaleFilter,
    in_one_scale,
    measured_scale,
    scale_factors,
)
from hybridvo_lab.synthetic.scenes import make_scene
from tests.worlds import world

FRAMES = 40
WOBBLE = 0.05
"""Standard deviation of the log scale of a frame."""


def similarity_scale(path: np.ndarray, onto: np.ndarray) -> float:
    """The factor that brings a path onto another one best (Umeyama 1991)."""
    a = path[:, :3, 3] - path[:, :3, 3].mean(0)
    b = onto[:, :3, 3] - onto[:, :3, 3].mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    d[2] *= np.sign(np.linalg.det(u @ vt))
    return float(d.sum() / np.sum(a * a))


def test_the_ratio_of_two_depth_maps() -> None:
    pair, T = world(noise=(0.0, 0.01), movers=2, seed=1)
    weights = np.ones(pair.prev.camera.shape, np.float32)
    motion = RelativePose(T_curr_prev=T, weights=weights)
    larger = replace(pair.curr, depth=1.07 * pair.curr.depth)
    # the median of 2000 ratios of noise 1.4 %, some of them on objects that move
    assert measured_scale(pair.prev, larger, motion) == pytest.approx(
        1.07, abs=2e-3
    )


def test_a_path_in_one_scale() -> None:
    step = se3_exp(np.array([-0.1, 0.0, -0.2, 0.0, 0.05, 0.0]))
    true = [np.eye(4)]
    for _ in range(4):
        true.append(chain(true[-1], step))
    # motions of the first two are half as long; the third starts two frames before
    starts = [None, 0, 1, 1, 3]
    factors = np.array([1.0, 2.0, 2.0, 1.0, 1.0])
    motions = [np.eye(4)]
    for i in range(1, 5):
        T = invert(true[i]) @ true[starts[i]]
        T_prev_curr = invert(T)
        T_prev_curr[:3, 3] /= factors[i]
        motions.append(invert(T_prev_curr))
    path = in_one_scale(np.stack(true), np.stack(motions), starts, factors)
    np.testing.assert_allclose(path, true, atol=1e-12)


def filtered(own: np.ndarray, bias: float) -> tuple[np.ndarray, np.ndarray]:
    """What the tracker states of frames of these log scales, where each ratio errs by ``bias``."""
    known = ScaleFilter()
    common = 0.0
    scales = [1.0]
    changes = [1.0]
    for k in range(1, len(own)):
        ratio = own[k] - own[0] + bias * k - common
        change = known.gain * ratio
        scales.append(np.exp(ratio))
        changes.append(np.exp(change))
        common += change
        known = known.observed()
    return np.array(scales), np.array(changes)


@pytest.mark.parametrize("bias", [0.0, 0.0015, -0.0015])
def test_a_chain_of_ratios_that_err_to_one_side_does_not_bend_the_path(
    bias: float,
) -> None:
    """As on a road, where a network's far things come nearer: a third in 200 frames."""
    own = 0.02 * np.random.default_rng(2).standard_normal(200)
    scales, changes = filtered(own, bias)
    # a motion has the scale that the chain had at its time
    before = np.concatenate([[0.0], np.cumsum(np.log(changes))[:-1]])
    length = np.exp(before - bias * np.arange(200) + own[0])
    path_scale = length * scale_factors(scales, changes)
    thirds = [np.mean(part) for part in np.array_split(path_scale, 3)]
    assert np.ptp(thirds) < 0.015
    assert np.mean(path_scale) == pytest.approx(1, abs=0.01)


# -- a tracked path ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk() -> list[tuple[Frame, np.ndarray | None]]:
    """Frames in which an object moves, depth of 0.3 percent noise, and the flow to each."""
    scene = make_scene("light", 9203, height=96, width=128, frames=FRAMES)
    rng = np.random.default_rng(5)
    found = []
    for i in range(FRAMES):
        frame = scene.render(i)
        noise = np.exp(0.003 * rng.standard_normal(frame.depth.shape))
        depth = frame.depth * noise.astype(np.float32)
        flow = scene.flow(i - 1)[0] if i else None
        found.append((replace(frame, rgb=None, depth=depth), flow))
    return found


class Tracked(NamedTuple):
    """A path in one scale, and the steps that it was made of."""

    path: np.ndarray
    steps: list[Step]


def tracked(walk: list, scales: np.ndarray, mode: str) -> Tracked:
    """Track the frames, each depth times a scale."""
    options = Options(depth=DepthOptions(scale_per_frame=mode))
    vo = Odometry(None, options=options)
    steps = []
    for (frame, flow), scale in zip(walk, scales, strict=True):
        breathing = replace(frame, depth=frame.depth * np.float32(scale))
        steps.append(vo.track(breathing, flow))
    row_of = {step.index: i for i, step in enumerate(steps)}
    path = in_one_scale(
        np.stack([step.T_world_cam for step in steps]),
        np.stack([step.T_curr_prev for step in steps]),
        [row_of.get(step.prev_index) for step in steps],
        scale_factors(
            np.array([step.depth_scale for step in steps]),
            np.array([step.scale_change for step in steps]),
        ),
    )
    return Tracked(path, steps)


@pytest.fixture(scope="module")
def steady(walk: list) -> Tracked:
    """The path with the true scale in every frame."""
    return tracked(walk, np.ones(FRAMES), "off")


@pytest.mark.slow
def test_a_path_of_breathing_depth_has_one_scale(
    walk: list, steady: Tracked
) -> None:
    wobble = WOBBLE * np.random.default_rng(1).standard_normal(FRAMES)
    off = tracked(walk, np.exp(wobble), "off")
    on = tracked(walk, np.exp(wobble), "on")
    assert {step.depth_scale for step in off.steps} == {1.0}
    assert all(step.ok for step in on.steps)
    assert not all(step.ok for step in off.steps)
    scale = similarity_scale(on.path, steady.path)
    assert abs(scale - 1) < 0.01
    # all that is left is the mean of the scales that were drawn, and some drift
    assert scale == pytest.approx(np.exp(-wobble.mean()), abs=3e-3)
    length = np.linalg.norm(np.diff(steady.path[:, :3, 3], axis=0), axis=1).sum()
    away = np.linalg.norm((on.path - steady.path)[:, :3, 3], axis=1)
    assert away.max() < 0.005 * length
    # the scales themselves, but for the common one
    changes = np.array([step.scale_change for step in on.steps])
    common = np.concatenate([[1.0], np.cumprod(changes[:-1])])
    measured = np.log([step.depth_scale for step in on.steps]) + np.log(common)
    assert np.std(measured - wobble) < 0.15 * WOBBLE

    def error(path: np.ndarray) -> float:
        scaled = similarity_scale(path, steady.path) * path[:, :3, 3]
        return float(np.linalg.norm(scaled - steady.path[:, :3, 3]))

    assert error(on.path) < 0.4 * error(off.path)


def test_auto_scales_depth_of_a_network_alone(walk: list) -> None:
    scales = np.array([1.0, 1.1])
    for source, expected in (("network", 1.1), ("sensor", 1.0)):
        frames = [(replace(f, depth_source=source), flow) for f, flow in walk[:2]]
        last = tracked(frames, scales, "auto").steps[-1]
        assert last.depth_scale == pytest.approx(expected, abs=5e-3)


def test_a_lost_frame_keeps_its_own_scale(walk: list) -> None:
    options = Options(depth=DepthOptions(scale_per_frame="on"))
    vo = Odometry(None, options=options)
    vo.track(*walk[0])
    nowhere = np.full_like(walk[1][1], np.nan)
    lost = vo.track(walk[1][0], nowhere)
    assert not lost.usable
    assert (lost.depth_scale, lost.scale_change) == (1.0, 1.0)
    # as at the beginning: the next frame tells as much of the common scale as this one
    assert vo.state.sensors.scale.gain == 0.5
    assert vo.track(*walk[2]).usable
