"""Wide steps: motions from sparse matches, and flow that starts from a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridvo import Frame, FramePair, Options, dis_flow, estimate
from hybridvo.core.geometry import ego_flow, invert, rotation_angle, se3_exp
from hybridvo.core.options import SearchOptions
from hybridvo.hypotheses.matches import (
    guided_flow,
    match_features,
    matched_motions,
)
from hybridvo_lab.synthetic.render import Scene
from hybridvo_lab.synthetic.scenes import make_scene


class Turned:
    """A rendered room, and the same after a wide turn of the camera."""

    def __init__(self, turn_deg: float) -> None:
        scene = make_scene("static", 3, height=240, width=320, frames=2)
        step = se3_exp(np.array([0.03, 0.0, 0.05, 0.0, np.radians(turn_deg), 0.02]))
        first = scene.T_world_cam[0]
        path = np.stack([first, first @ step])
        scene = replace(scene, T_world_cam=path)
        self.T_curr_prev = invert(step)
        self.pair = FramePair(_frame(scene, 0), _frame(scene, 1), None)


def _frame(scene: Scene, k: int) -> Frame:
    return Frame(scene.render(k).rgb, scene.depth(k), scene.camera)


def _error_deg(T: np.ndarray, truth: np.ndarray) -> float:
    return float(np.degrees(rotation_angle((T @ invert(truth))[:3, :3])))


@pytest.fixture(scope="module")
def turned() -> Turned:
    return Turned(22.0)


def test_the_first_motion_is_that_of_most_matches(turned: Turned) -> None:
    motions = matched_motions(turned.pair)
    assert _error_deg(motions[0], turned.T_curr_prev) < 0.3
    difference = motions[0][:3, 3] - turned.T_curr_prev[:3, 3]
    assert np.linalg.norm(difference) < 0.05


def test_guided_flow_reaches_where_flow_does_not(turned: Turned) -> None:
    pair = turned.pair
    depth = np.asarray(pair.prev.depth)
    truth = ego_flow(depth, turned.T_curr_prev, pair.prev.camera, pair.curr.camera)
    # a start that is half a degree off
    start = se3_exp(np.array([0, 0, 0, 0, 0.008, 0])) @ turned.T_curr_prev
    field = guided_flow(pair, start, dis_flow())
    assert field.flow is not None and field.valid is not None
    error = np.linalg.norm(field.flow - truth, axis=2)
    assert np.median(error[field.valid]) < 0.3
    assert field.valid.mean() > 0.15
    plain = dis_flow()(pair.prev, pair.curr)
    assert plain.flow is not None
    assert np.median(np.linalg.norm(plain.flow - truth, axis=2)) > 20


def test_a_wide_turn_is_found_from_matches(turned: Turned) -> None:
    off = Options(search=SearchOptions(matches="off"))
    without = estimate(turned.pair.prev, turned.pair.curr, options=off)
    assert not without.ok
    found = estimate(turned.pair.prev, turned.pair.curr)
    assert found.usable
    assert _error_deg(found.T_curr_prev, turned.T_curr_prev) < 0.1


def test_a_narrow_step_asks_for_no_matches(monkeypatch) -> None:
    def refuse(*args: object) -> None:
        raise AssertionError("matched")

    monkeypatch.setattr("hybridvo.evidence.pair.matched_motions", refuse)
    narrow = Turned(1.0)
    assert estimate(narrow.pair.prev, narrow.pair.curr).ok


def test_without_images_depth_or_texture_there_are_no_matches(
    turned: Turned,
) -> None:
    pair = turned.pair
    bare = replace(pair.prev, rgb=None)
    flat = replace(pair.prev, rgb=np.full_like(pair.prev.rgb, 90))
    blind = replace(pair.prev, depth=None)
    for prev in (bare, flat, blind):
        other = replace(pair, prev=prev)
        assert matched_motions(other) == []
        assert len(match_features(other).points) == 0
    assert (
        guided_flow(replace(pair, prev=blind), np.eye(4), dis_flow()).flow is None
    )


def test_holes_of_the_depth_are_guided_by_what_is_beside_them(
    turned: Turned,
) -> None:
    pair = turned.pair
    depth = np.array(pair.prev.depth)
    depth[100:140, 100:160] = np.nan
    holed = replace(pair, prev=replace(pair.prev, depth=depth))
    field = guided_flow(holed, turned.T_curr_prev, dis_flow())
    assert field.flow is not None
    assert np.isfinite(field.flow[100:140, 100:160]).all()
