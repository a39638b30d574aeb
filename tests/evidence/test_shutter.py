"""Pairs of a camera whose rows are exposed one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, se3_exp
from hybridvo.evidence.one_time import (
    pair_at_image_times,
)
from hybridvo.flow.providers import with_flow
from hybridvo_lab.synthetic.scenes import make_scene
from tests import worlds

SIZE = (120, 160)
TWIST = np.array([0.05, 0.02, 0.08, 0.02, -0.015, 0.01])
"""Motion of the camera in the time between the frames, in its own axes."""
READOUT = 0.9
"""Time of the rows, as a fraction of the time between the frames."""


def rolled(scene, start: float) -> hvo.Frame:
    """A frame whose rows are read one after the other from a time on, by a moving camera."""
    height = SIZE[0]
    slices = 24
    # the camera's pose at a time is the first one, moved by the twist that long
    times = start + READOUT * (np.arange(slices) + 0.5) / slices
    poses = np.stack(
        [scene.T_world_cam[0] @ np.linalg.inv(se3_exp(t * TWIST)) for t in times]
    )
    solids = [s for s in scene.solids if s.A_world_body.ndim == 2]
    moved = replace(scene, T_world_cam=poses, solids=tuple(solids))
    rgb = np.zeros((*SIZE, 3), np.uint8)
    depth = np.zeros(SIZE, np.float32)
    rows = height // slices
    for k in range(slices):
        seen = moved.render(k)
        part = slice(k * rows, (k + 1) * rows)
        rgb[part] = seen.rgb[part]
        depth[part] = seen.depth[part]
    camera = replace(scene.camera, readout_ms=1000 * READOUT)
    return hvo.Frame(rgb, depth, camera, timestamp=start)


@pytest.fixture(scope="module")
def pair():
    scene = make_scene("static", 4, height=SIZE[0], width=SIZE[1], frames=2)
    return rolled(scene, 0.0), rolled(scene, 1.0)


def without_readout(frame: hvo.Frame) -> hvo.Frame:
    return replace(frame, camera=replace(frame.camera, readout_ms=0.0))


# the noise of DIS flow stays with classical
@pytest.mark.parametrize(("method", "gain"), [("classical", 2), ("hybrid", 4)])
def test_a_known_readout_takes_the_error_of_the_shutter_away(pair, method, gain):
    true = se3_exp(TWIST)
    known = hvo.estimate(*pair, method=method)
    ignored = hvo.estimate(*map(without_readout, pair), method=method)
    error = np.linalg.norm(np.subtract(known.T_curr_prev, true))
    before = np.linalg.norm(np.subtract(ignored.T_curr_prev, true))
    assert known.usable
    assert error < before / gain


def test_a_known_readout_divides_flow_of_the_rows_as_they_were(pair):
    true = se3_exp(TWIST)

    def error(prev: hvo.Frame, curr: hvo.Frame) -> float:
        given = with_flow(hvo.FramePair(prev, curr, None), hvo.dis_flow())
        found = hvo.estimate(given, method="classical")
        return float(np.linalg.norm(found.T_curr_prev - true))

    assert error(*pair) < error(*map(without_readout, pair)) / 2


def test_the_flow_of_a_constant_motion_becomes_that_of_one_time():
    """To first order; the flow is 4 px, and the rows of a pixel differ by 4 % of the time."""
    camera = replace(worlds.camera(SIZE), readout_ms=30.0)
    depth = np.full(SIZE, 3.0, np.float32)
    exact = ego_flow(depth, se3_exp(0.3 * TWIST), camera, camera)
    # while a pixel's row is late by a fraction, it moves on by that fraction of the flow
    per_row = 30.0 / 33.0 / SIZE[0]
    factor = 1 / (1 - per_row * exact[..., 1:])
    frames = [hvo.Frame(None, depth, camera, timestamp=t) for t in (0.0, 0.033)]
    rolling = hvo.FramePair(*frames, (exact * factor).astype(np.float32))
    found = pair_at_image_times(rolling, se3_exp(0.3 * TWIST)).flow
    np.testing.assert_allclose(found, exact, atol=0.01)


def test_without_readout_or_stamps_a_pair_stays_as_it_is():
    camera = worlds.camera(SIZE)
    frame = hvo.Frame(None, np.ones(SIZE, np.float32), camera)
    pair = hvo.FramePair(frame, frame, np.ones((*SIZE, 2), np.float32))
    motion = se3_exp(TWIST)
    assert pair_at_image_times(pair, motion) is pair
    timeless = replace(frame, camera=replace(camera, readout_ms=20.0))
    pair = hvo.FramePair(timeless, timeless, None)
    assert pair_at_image_times(pair, motion) is pair


@pytest.mark.parametrize("rows", [-120.0, -500.0, 500.0, np.inf, -np.inf, np.nan])
def test_flow_that_no_shutter_can_see_is_unknown(rows):
    """A pixel that ends a whole image higher would have been read before it was exposed."""
    camera = replace(worlds.camera(SIZE), readout_ms=33.0)
    rgb = np.zeros((*SIZE, 3), np.uint8)
    depth = np.full(SIZE, 3.0, np.float32)
    frames = [hvo.Frame(rgb, depth, camera, timestamp=t) for t in (0.0, 0.033)]
    flow = np.zeros((*SIZE, 2), np.float32)
    flow[:60, :, 1] = rows
    found = pair_at_image_times(hvo.FramePair(*frames, flow), np.eye(4))
    assert np.isnan(found.flow[:60]).all()
    np.testing.assert_array_equal(found.flow[60:], 0)
    # nothing has moved there
    np.testing.assert_array_equal(found.curr.depth[60:], depth[60:])


@pytest.mark.parametrize("readout", [-1.0, np.nan, np.inf, "fast"])
def test_a_readout_that_is_none_is_refused(readout):
    with pytest.raises(hvo.InputError, match="readout_ms"):
        replace(worlds.camera(SIZE), readout_ms=readout)
