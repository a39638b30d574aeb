"""Answers are held against images and depth maps, whatever they were found from."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

import hybridvo as hvo
from hybridvo.core.geometry import invert, se3_log
from hybridvo.core.results import Reason, RelativePose
from hybridvo.evidence.pair import PairEvidence
from hybridvo.judge.consistency import (
    ByImages,
    ImageMatch,
    _against,
    against_images_and_depth,
    contradiction_by_depth,
)
from hybridvo.judge.findings import Finding
from hybridvo_lab.synthetic.scenes import make_scene

METHODS = ["hybrid", "hybrid-flow", "classical", "pwvo-refine"]


@pytest.fixture(scope="module")
def walk() -> list[hvo.Frame]:
    """Three frames of a rendered static scene, the camera moving by some 10 cm between them."""
    scene = make_scene("static", 6, height=144, width=192, frames=12)
    return [scene_frame(scene, i) for i in range(3)]


def scene_frame(scene, index: int) -> hvo.Frame:
    seen = scene.render(index)
    rgb = np.ascontiguousarray(seen.rgb)
    return hvo.Frame(rgb, seen.depth.astype(np.float32), scene.camera, index=index)


def with_given_flow(
    prev: hvo.Frame, curr: hvo.Frame, flow: np.ndarray
) -> hvo.FramePair:
    return hvo.FramePair(prev, curr, flow.astype(np.float32), flow_source="given")


def dis(prev: hvo.Frame, curr: hvo.Frame) -> np.ndarray:
    flow = hvo.dis_flow()(prev, curr).flow
    assert flow is not None
    return flow


@pytest.mark.parametrize("method", METHODS)
def test_right_input_is_not_contradicted(
    walk: list[hvo.Frame], method: str
) -> None:
    by_images = hvo.estimate(walk[0], walk[1], method=method)
    given = with_given_flow(walk[0], walk[1], dis(walk[0], walk[1]))
    by_given = hvo.estimate(given, method=method)
    for found in (by_images, by_given):
        assert found.usable and found.status.reason is not Reason.CONTRADICTED


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("factor", [-1.0, 0.0, 0.5, 2.0])
def test_flow_that_the_images_deny_is_not_ok(
    walk: list[hvo.Frame], method: str, factor: float
) -> None:
    flow = factor * dis(walk[0], walk[1])
    found = hvo.estimate(with_given_flow(walk[0], walk[1], flow), method=method)
    if found.ok:
        # the images have led it to their own motion
        assert "images" in found.terms
        expected = hvo.estimate(walk[0], walk[1]).T_curr_prev
        np.testing.assert_allclose(found.T_curr_prev, expected, atol=0.01)
        return
    assert found.status.reason in (Reason.NO_FLOW, Reason.CONTRADICTED)
    assert found.status.message and found.probability <= 0.1


def test_flow_of_another_scene_is_not_ok(walk: list[hvo.Frame]) -> None:
    other = make_scene("static", 9, height=144, width=192, frames=12)
    flow = dis(scene_frame(other, 0), scene_frame(other, 1))
    assert not hvo.estimate(with_given_flow(walk[0], walk[1], flow)).ok


@pytest.mark.parametrize("method", METHODS)
def test_an_image_that_was_handed_out_twice_is_not_ok(
    walk: list[hvo.Frame], method: str
) -> None:
    frozen = replace(walk[1], rgb=walk[0].rgb)
    found = hvo.estimate(walk[0], frozen, method=method)
    assert found.status.reason is Reason.CONTRADICTED
    # the covariance covers what the depth maps say
    sigma = np.sqrt(np.trace(found.covariance[:3, :3]))
    assert sigma > 0.02


def test_a_pattern_on_the_lens_of_a_dark_camera_is_not_ok(
    walk: list[hvo.Frame],
) -> None:
    dark = np.zeros_like(walk[0].rgb)
    dark[30:50, 40:60] = 220
    dark[90:110, 140:160] = 200
    frames = [replace(frame, rgb=dark) for frame in walk[:2]]
    assert not hvo.estimate(*frames).ok


def test_mirrored_images_are_not_ok(walk: list[hvo.Frame]) -> None:
    frames = [
        replace(frame, rgb=np.ascontiguousarray(frame.rgb[:, ::-1]))
        for frame in walk[:2]
    ]
    assert not hvo.estimate(*frames).ok


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [2.0, 0.5])
def test_depth_maps_of_two_scales_are_not_ok(
    walk: list[hvo.Frame], method: str, scale: float
) -> None:
    prev = replace(walk[0], depth=np.float32(scale) * walk[0].depth)
    found = hvo.estimate(prev, walk[1], method=method)
    assert not found.ok and found.status.reason in (
        Reason.NO_VALID_DEPTH,
        Reason.CONTRADICTED,
    )


@pytest.mark.parametrize("method", METHODS)
def test_depth_of_noise_is_not_ok(walk: list[hvo.Frame], method: str) -> None:
    noise = np.random.default_rng(0).uniform(0.5, 5.0, walk[1].depth.shape)
    curr = replace(walk[1], depth=noise.astype(np.float32))
    assert not hvo.estimate(walk[0], curr, method=method).ok


def test_depth_in_millimetres_is_degraded_with_the_remedy(
    walk: list[hvo.Frame],
) -> None:
    frames = [replace(frame, depth=1000 * frame.depth) for frame in walk[:2]]
    found = hvo.estimate(*frames)
    assert found.status.reason is Reason.DEPTH_UNIT
    assert "expects metres: divide by" in found.status.message


def test_a_tracker_goes_on_asking_the_images(walk: list[hvo.Frame]) -> None:
    flows = [dis(walk[0], walk[1]), -dis(walk[1], walk[2])]
    vo = hvo.Odometry()
    vo.track(walk[0])
    assert vo.track(walk[1], flows[0]).ok
    assert not vo.track(walk[2], flows[1]).ok


def by_images(pair: hvo.FramePair, motion: RelativePose) -> Finding | None:
    """What the images state against a motion on flow of another origin."""
    without_depth = replace(pair, curr=replace(pair.curr, depth=None))
    given = SimpleNamespace(source="given")
    evidence = PairEvidence(without_depth, provider=given)
    return against_images_and_depth(evidence, motion)


def test_leads_are_none_without_what_they_need(walk: list[hvo.Frame]) -> None:
    weights = np.ones(walk[0].camera.shape, np.float32)
    wrong = RelativePose(weights=weights)  # no motion, where there is one
    pair = hvo.FramePair(walk[0], walk[1], None)
    assert by_images(pair, wrong) is not None
    assert contradiction_by_depth(pair, wrong) is not None
    no_images = replace(pair, curr=replace(walk[1], rgb=None))
    assert by_images(no_images, wrong) is None
    no_depth = replace(pair, curr=replace(walk[1], depth=None))
    assert contradiction_by_depth(no_depth, wrong) is None
    nothing_static = wrong.replace(weights=np.zeros_like(weights))
    assert by_images(pair, nothing_static) is None
    assert contradiction_by_depth(pair, nothing_static) is None


def test_the_depth_maps_lead_to_the_true_motion(walk: list[hvo.Frame]) -> None:
    """From no motion, on exact depth of a scene with surfaces of many directions."""
    weights = np.ones(walk[0].camera.shape, np.float32)
    pair = hvo.FramePair(walk[0], walk[1], None)
    lead = contradiction_by_depth(pair, RelativePose(weights=weights))
    expected = hvo.estimate(walk[0], walk[1]).T_curr_prev
    assert lead is not None
    np.testing.assert_allclose(lead.T_curr_prev[:3, 3], expected[:3, 3], atol=0.01)


@pytest.mark.parametrize("method", ["hybrid", "hybrid-flow"])
def test_what_the_images_disagree_with_a_flow_is_in_the_covariance(
    method: str,
) -> None:
    """Flow that is three per cent too long is no contradiction, but its error is stated."""
    scene = make_scene("static", 3, frames=2)
    prev = scene.render(0)
    curr = scene.render(1)
    true_flow, _ = scene.flow(0)
    T = invert(scene.T_world_cam[1]) @ scene.T_world_cam[0]
    too_long = 1.03 * true_flow.astype(np.float32)
    answer = hvo.estimate(hvo.FramePair(prev, curr, too_long), method=method)
    assert answer.usable
    error = se3_log(answer.T_curr_prev @ invert(T))
    squared = error @ np.linalg.solve(answer.covariance, error)
    # 99.9 % of six numbers
    assert squared < chi2.ppf(0.999, 6)


@pytest.mark.parametrize("in_view", [1.0, 0.0])
def test_two_images_that_match_along_no_motion(
    walk: list[hvo.Frame], in_view: float
) -> None:
    """They contradict the motion without another one to go to, where enough is in view."""
    nowhere = ImageMatch(noise=50.0, correlation=0.05, in_view=in_view)
    motion = RelativePose(np.eye(4), np.eye(6))
    images = ByImages(np.eye(4), np.eye(6), nowhere, nowhere)
    pair = with_given_flow(walk[0], walk[1], dis(walk[0], walk[1]))
    found = _against(pair, motion, images, "given")
    if in_view == 0:
        assert found is None
        return
    assert found is not None
    np.testing.assert_array_equal(found.T_curr_prev, np.eye(4))
    assert "do not match" in found.message and "0.05" in found.message
