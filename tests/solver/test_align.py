"""The motion by images and depth maps alone: where it holds, and where it says that it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybridvo.api import estimate
from hybridvo.core.calibration import MIN_PROBABILITY
from hybridvo.core.geometry import pose_matrix, project
from hybridvo.core.options import DirectOptions, Options
from hybridvo.core.results import Reason, RelativePose
from hybridvo.core.types import FramePair
from hybridvo.flow.frame_images import reduced
from hybridvo.flow.providers import FlowField, dis_flow, with_flow
from hybridvo.judge.calibration import DIRECT_PROBABILITY
from hybridvo.judge.verdict import believed
from hybridvo.pipeline import Context, run_method, sure_alignment
from hybridvo.solver.align import align_images
from tests.solver.test_photometric import error_px, made_pair

SIZE = {"height": 240, "width": 320}


@pytest.fixture(scope="module")
def static():
    """(pair without flow, true motion) of a scene in which nothing moves."""
    pair, T, _ = made_pair("static", 303, **SIZE)
    return FramePair(pair.prev, pair.curr, None), T


@pytest.fixture(scope="module")
def moving():
    """The same of a scene in which most of the image moves."""
    pair, T, _ = made_pair("heavy_two", 900, **SIZE)
    return FramePair(pair.prev, pair.curr, None), T


def test_a_reduced_camera_sees_a_point_where_the_pixels_are_averaged(static):
    frame = static[0].prev
    small = reduced(frame, 4)
    assert small is reduced(frame, 4)  # kept with the frame
    assert small.camera.shape == (60, 80)
    # the middle of the block of pixels 8..11 is 9.5, and block 2 of the small image
    X = np.array([0.3, -0.2, 2.0])
    large, fine = project(X, frame.camera), project(X, small.camera)
    np.testing.assert_allclose(fine, (large - 1.5) / 4, atol=1e-12)


def direct(
    pair: FramePair,
    T_start: np.ndarray | None = None,
    least: float = DIRECT_PROBABILITY,
) -> RelativePose | None:
    """The motion by images and depth maps alone, where it is so probable."""
    motion = sure_alignment(align_images(pair, T_start), least)
    return None if motion is None else believed(motion)


def test_static_scene_needs_no_flow(static):
    pair, T = static
    assert error_px(pair, np.eye(4), T) > 1.0
    found = direct(pair)
    assert error_px(pair, found.T_curr_prev, T) < 0.05
    assert found.probability > 0.9 and found.inlier_ratio > 0.85
    assert np.linalg.eigvalsh(found.covariance)[0] > 0
    assert found.weights.shape == pair.prev.camera.shape


def test_where_most_moves_it_is_not_sure(moving):
    assert direct(moving[0]) is None


@pytest.mark.parametrize("seed", [901, 903])
def test_a_start_on_a_moving_object_is_no_answer(seed):
    pair, T, _ = made_pair("heavy_rigid", seed, **SIZE)
    found = next(Context(flow=dis_flow()).evidence(pair).flows()).motions
    assert len(found.poses) > 1
    for pose in found.poses:
        answer = direct(FramePair(pair.prev, pair.curr, None), pose_matrix(pose))
        assert (
            answer is None
            or answer.probability < MIN_PROBABILITY
            or error_px(pair, answer.T_curr_prev, T) < 1
        )


@pytest.mark.parametrize("seed", [303, 305, 307])
def test_a_smooth_thing_that_moves_is_seen_by_its_outline_and_depth(seed):
    """A grey square on 40 % of the image goes 14 px to the right."""
    pair, T, _ = made_pair("static", seed, **SIZE)
    frames = []
    for frame, left in ((pair.prev, 30), (pair.curr, 44)):
        rgb, depth = frame.rgb.copy(), frame.depth.copy()
        place = np.s_[32:208, left : left + 176]
        rgb[place], depth[place] = 180, 1.2
        frames.append(replace(frame, rgb=rgb, depth=depth))
    found = direct(FramePair(*frames, None), least=0.0)
    assert error_px(pair, found.T_curr_prev, T) > 1.0 and found.probability < 0.5


def test_a_start_leads_over_a_motion_that_is_too_far():
    pair, T, _ = made_pair("static", 305, **SIZE)
    far = replace(pair.curr, rgb=np.roll(pair.curr.rgb, 90, axis=1))
    assert direct(FramePair(pair.prev, far, None)) is None
    found = direct(FramePair(pair.prev, pair.curr, None), T)
    assert error_px(pair, found.T_curr_prev, T) < 0.05


def test_hybrid_asks_for_flow_only_where_the_images_do_not_suffice(static, moving):
    asked = []

    class Counted:
        source = "dis"

        def __call__(self, prev, curr) -> FlowField:
            asked.append(prev)
            return dis_flow()(prev, curr)

    ctx = Context(flow=Counted())
    found = run_method(ctx.evidence(static[0]), "hybrid", ctx)
    assert found.terms == ("images", "depth") and not asked
    run_method(ctx.evidence(moving[0]), "hybrid", ctx)
    assert len(asked) == 1
    run_method(ctx.evidence(static[0]), "hybrid-flow", ctx)
    assert len(asked) == 2


def test_a_flow_from_elsewhere_is_used_and_the_mode_decides(static):
    pair, _ = static
    field = dis_flow()(pair.prev, pair.curr)
    given = with_flow(pair, lambda *_: replace(field, source="file"))
    assert "flow" in estimate(given).terms
    on = Options(direct=DirectOptions(mode="on"))
    assert "flow" not in estimate(given, options=on).terms
    off = Options(direct=DirectOptions(mode="off"))
    assert "flow" in estimate(pair.prev, pair.curr, options=off).terms
    assert "flow" not in estimate(pair.prev, pair.curr).terms


def test_masked_pixels_are_not_looked_at(static):
    """What stands still with the camera fills the image but for a strip, and is masked."""
    pair, T = static
    height = pair.prev.camera.height
    mask = np.zeros(pair.prev.camera.shape, bool)
    mask[height // 3 : -height // 3] = True
    still = np.where(mask[..., None], pair.curr.rgb, pair.prev.rgb)
    depth = np.where(mask, pair.curr.depth, pair.prev.depth)
    curr = replace(pair.curr, rgb=still, depth=depth)
    seen = replace(
        pair, prev=replace(pair.prev, mask=mask), curr=replace(curr, mask=mask)
    )
    wrong, motion = direct(replace(pair, curr=curr)), direct(seen)
    assert wrong is None or error_px(pair, wrong.T_curr_prev, T) > 0.5
    assert error_px(pair, motion.T_curr_prev, T) < 0.2


def test_images_do_not_settle_which_of_two_depths_is_right(static):
    pair, _ = static
    pair = replace(pair, curr=replace(pair.curr, depth=1.3 * pair.curr.depth))
    options = Options(direct=DirectOptions(mode="off"))
    ctx = Context(options, flow=dis_flow())
    by_flow, by_images = (
        run_method(ctx.evidence(pair), method, ctx)
        for method in ("hybrid-flow", "hybrid")
    )
    assert by_images.status.reason is Reason.NO_VALID_DEPTH
    np.testing.assert_allclose(by_images.covariance, by_flow.covariance)
