from __future__ import annotations

import gc
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import hybridvo
from hybridvo.core.errors import CheckpointError, InputError
from hybridvo.core.geometry import ego_flow, invert, se3_exp
from hybridvo.core.options import Options, TrackOptions
from hybridvo.core.results import Reason, State
from hybridvo.core.types import Camera, Frame
from hybridvo.flow.providers import FlowField, dis_flow
from hybridvo.odometry import Odometry
from hybridvo.pipeline import DEFAULT_METHOD
from hybridvo_lab.synthetic.scenes import make_scene

HEIGHT, WIDTH = 48, 64
CAMERA = Camera(60, 60, 31.5, 23.5, height=HEIGHT, width=WIDTH)
MOTION = se3_exp(np.array([0.03, -0.02, 0.08, 0.004, -0.006, 0.003]))


def depth(index: int = 0, motion: np.ndarray = MOTION) -> np.ndarray:
    """Exact depth of the hilly wall Z = 4 + 0.5 sin 2X + 0.5 cos 2.4Y of a world without movers,
    seen by a camera that has moved ``index`` times.
    """
    T = np.linalg.matrix_power(invert(motion), index)  # T_world_cam
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)]
    )
    ways = np.tensordot(T[:3, :3], rays, 1)
    along = np.full(u.shape, 4.0)
    # slopes of 1.2 times rays of 0.5: each step leaves 0.6 of the error
    for _ in range(60):
        X, Y, Z = T[:3, 3, None, None] + along * ways
        along += (4 + 0.5 * np.sin(2 * X) + 0.5 * np.cos(2.4 * Y) - Z) / ways[2]
    return along.astype(np.float32)


def frame(index: int, **changes: object) -> Frame:
    rgb = np.full((HEIGHT, WIDTH, 3), index % 256, np.uint8)
    values = {"rgb": rgb, "depth": depth(index), "camera": CAMERA} | changes
    return Frame(**values, timestamp=0.1 * index, index=index)


def exact_flow(motion: np.ndarray = MOTION):
    """Provider of the exact flow of a static scene under one motion a frame."""

    def provide(prev: Frame, curr: Frame) -> FlowField:
        T = np.linalg.matrix_power(motion, curr.index - prev.index)
        flow = ego_flow(depth(prev.index), T, prev.camera, curr.camera).astype(
            np.float32
        )
        return FlowField(flow, source="exact", is_true=True)

    return provide


def tracker(flow: object = None, **track: object) -> Odometry:
    """A tracker on exact flow, with options of the group ``track``."""
    options = Options(track=TrackOptions(**track))
    return Odometry(flow=flow or exact_flow(), options=options)


def test_first_frame_is_the_identity() -> None:
    step = tracker().track(frame(3))
    assert step.ok and step.status.state is State.OK
    np.testing.assert_array_equal(step.T_world_cam, np.eye(4))
    np.testing.assert_array_equal(step.T_curr_prev, np.eye(4))
    assert (step.index, step.timestamp) == (3, pytest.approx(0.3))


def test_poses_chain_camera_to_world() -> None:
    vo = tracker()
    steps = [vo.track(frame(i)) for i in range(4)]
    for k, step in enumerate(steps):
        expected = invert(np.linalg.matrix_power(MOTION, k))
        # float32 flow of ten pixels carries 1e-6 px of rounding: nanometres, and far below 1e-5
        assert np.abs(step.T_world_cam - expected).max() < 1e-5 * max(k, 1)
        assert (
            step.covariance.shape == (6, 6) and np.isfinite(step.covariance).all()
        )
    np.testing.assert_allclose(
        steps[1].T_prev_curr @ steps[1].T_curr_prev, np.eye(4), atol=1e-12
    )


def test_set_pose_before_and_during_the_walk() -> None:
    start = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    vo = tracker()
    vo.set_pose(start)
    np.testing.assert_allclose(vo.track(frame(0)).T_world_cam, start, atol=1e-15)
    step = vo.track(frame(1))
    np.testing.assert_allclose(step.T_world_cam, start @ invert(MOTION), atol=1e-5)
    vo.set_pose(np.eye(4))
    np.testing.assert_allclose(
        vo.track(frame(2)).T_world_cam, invert(MOTION), atol=1e-5
    )


@pytest.mark.parametrize("policy", ["hold", "constant_velocity"])
def test_failed_motion_follows_the_policy(policy: str) -> None:
    vo = tracker(on_failure=policy)
    vo.track(frame(0))
    good = vo.track(frame(1))
    bad = vo.track(frame(2), np.full((HEIGHT, WIDTH, 2), np.nan, np.float32))
    assert bad.status.state is State.FAILED
    expected = np.eye(4) if policy == "hold" else good.T_curr_prev
    np.testing.assert_allclose(bad.T_curr_prev, expected, atol=1e-4)
    # at least a metre and 0.3 rad: no pose graph can take it for a measurement
    assert (np.diag(bad.covariance) >= [1.0] * 3 + [0.09] * 3).all()
    assert vo.track(frame(3)).ok


def test_a_frame_that_cannot_be_read_is_spanned() -> None:
    vo = tracker()
    vo.track(frame(0))
    vo.track(frame(1))
    lost = vo.skip(2, 0.2, "gone")
    assert (
        lost.status.reason is Reason.MISSING_FRAME and lost.status.message == "gone"
    )
    np.testing.assert_array_equal(lost.T_curr_prev, np.eye(4))
    step = vo.track(frame(3))
    assert step.ok
    # from frame 1 to 3: both motions, nothing is lost
    np.testing.assert_allclose(step.T_curr_prev, MOTION @ MOTION, atol=1e-5)
    np.testing.assert_allclose(
        step.T_world_cam, invert(np.linalg.matrix_power(MOTION, 3)), atol=3e-5
    )


def test_frames_lost_under_constant_velocity_move_on_and_come_back() -> None:
    vo = tracker(on_failure="constant_velocity")
    vo.track(frame(0))
    vo.track(frame(1))
    for k in (2, 3):
        step = vo.skip(k, 0.1 * k)
        expected = invert(np.linalg.matrix_power(MOTION, k))
        np.testing.assert_allclose(step.T_world_cam, expected, atol=1e-4)
    expected = invert(np.linalg.matrix_power(MOTION, 4))
    np.testing.assert_allclose(vo.track(frame(4)).T_world_cam, expected, atol=1e-4)


def test_flow_can_be_handed_in() -> None:
    def never(prev: Frame, curr: Frame) -> FlowField:
        raise AssertionError("the provider must not be asked")

    vo = tracker(flow=never)
    vo.track(frame(0))
    flow = ego_flow(depth(0), MOTION, CAMERA, CAMERA)
    np.testing.assert_allclose(
        vo.track(frame(1), flow).T_curr_prev, MOTION, atol=1e-5
    )
    with pytest.raises(InputError, match=r"FramePair\.flow: expected shape"):
        vo.track(frame(2), flow[:10])


def test_flow_that_is_handed_in_leads_from_the_frame_before() -> None:
    vo = Odometry()  # its own flow could span frames, the neighbours' flow cannot
    flows = [ego_flow(depth(i), MOTION, CAMERA, CAMERA) for i in range(5)]
    vo.track(frame(0))
    assert not vo.track(frame(1), np.full_like(flows[0], np.nan)).usable
    np.testing.assert_allclose(
        vo.track(frame(2), flows[1]).T_curr_prev, MOTION, atol=1e-4
    )
    assert vo.track(frame(3, depth=None), flows[2]).ok
    assert vo.track(frame(4), flows[3]).status.reason is Reason.NO_VALID_DEPTH
    np.testing.assert_allclose(
        vo.track(frame(5), flows[4]).T_curr_prev, MOTION, atol=1e-4
    )


def test_a_driver_may_reuse_its_buffers() -> None:
    shared_depth = depth(0)
    vo = tracker()
    vo.track(frame(0, depth=shared_depth))
    shared_depth[:] = np.nan
    assert vo.track(frame(1)).ok


def test_a_frame_of_another_size_is_refused_and_changes_nothing() -> None:
    vo = tracker()
    vo.track(frame(0))
    small = Frame(
        None,
        np.ones((24, 32), np.float32),
        Camera(30, 30, 15.5, 11.5, height=24, width=32),
    )
    with pytest.raises(InputError, match=r"\(48, 64\).*\(24, 32\)"):
        vo.track(small)
    assert vo.track(frame(1)).ok


def test_a_frame_without_depth_is_spanned() -> None:
    vo = tracker()
    for i in range(3):
        vo.track(frame(i))
    assert vo.track(frame(3, depth=None)).ok  # its own depth is not needed
    step = vo.track(frame(4))
    assert step.ok
    np.testing.assert_allclose(step.T_curr_prev, MOTION @ MOTION, atol=1e-4)
    expected = invert(np.linalg.matrix_power(MOTION, 4))
    np.testing.assert_allclose(step.T_world_cam, expected, atol=1e-4)
    vo.set_pose(np.eye(4))
    np.testing.assert_allclose(
        vo.track(frame(5)).T_world_cam, invert(MOTION), atol=1e-4
    )


def test_a_frame_that_shows_something_else_is_spanned() -> None:
    scene = make_scene("static", 3, height=120, width=160, frames=4)
    vo = Odometry()
    steps = []
    for i in range(4):
        seen = scene.render(i)
        rgb = seen.rgb
        depth = seen.depth
        if i == 2:  # a hand before the lens
            rgb = np.full_like(rgb, 90)
            depth = np.full_like(depth, 0.15)
        steps.append(vo.track(Frame(rgb, depth, scene.camera, 0.1 * i, i)))
    assert [step.usable for step in steps] == [True, True, False, True]
    true = invert(scene.T_world_cam[0]) @ scene.T_world_cam[3]
    assert np.linalg.norm(steps[3].T_world_cam[:3, 3] - true[:3, 3]) < 0.01


def test_prediction_is_the_last_motion_with_a_covariance() -> None:
    vo = tracker()
    assert vo.predict() is None
    for i in range(8):
        vo.track(frame(i))
    ahead = vo.predict()
    assert ahead is not None
    np.testing.assert_allclose(ahead.T_curr_prev, MOTION, atol=1e-5)
    # a motion that never changed: the floor of a millimetre and a milliradian
    np.testing.assert_allclose(np.sqrt(np.diag(ahead.covariance)), 1e-3, rtol=0.05)
    two = vo.state.motion_model.predict(2)
    assert two is not None
    np.testing.assert_allclose(two.T_curr_prev, MOTION @ MOTION, atol=1e-5)
    np.testing.assert_allclose(two.covariance, 5 * ahead.covariance)


def test_a_failed_motion_under_constant_velocity_has_the_covariance_of_the_history() -> (
    None
):
    vo = tracker(on_failure="constant_velocity")
    for i in range(8):
        vo.track(frame(i))
    ahead = vo.predict()
    none = np.full((HEIGHT, WIDTH, 2), np.nan, np.float32)
    first, second = vo.track(frame(8), none), vo.track(frame(9), none)
    assert ahead is not None and not first.ok and not second.ok
    np.testing.assert_allclose(
        first.covariance, ahead.covariance, rtol=0.2, atol=1e-12
    )
    np.testing.assert_allclose(
        second.covariance, 2 * first.covariance, rtol=1e-6, atol=1e-12
    )


def test_masks_and_depth_variances_of_ones_own_are_used() -> None:
    # the left half of every picture is a body that follows another motion, and masked
    mask = np.ones((HEIGHT, WIDTH), np.bool_)
    mask[:, : 2 * WIDTH // 3] = False
    variance = np.full((HEIGHT, WIDTH), 1e-4, np.float32)
    other = se3_exp(np.array([-0.2, 0.1, -0.1, 0.02, 0.03, -0.02]))

    def provide(prev: Frame, curr: Frame) -> FlowField:
        flow = exact_flow()(prev, curr).flow
        body = ego_flow(depth(prev.index), other, CAMERA, CAMERA).astype(np.float32)
        return FlowField(np.where(mask[..., None], flow, body))

    vo = tracker(flow=provide)
    steps = [
        vo.track(frame(i, mask=mask, depth_variance=variance)) for i in range(3)
    ]
    np.testing.assert_allclose(steps[2].T_curr_prev, MOTION, atol=1e-4)


def test_a_tracker_knows_its_weights() -> None:
    assert hybridvo.Odometry().method == DEFAULT_METHOD
    with pytest.raises(CheckpointError, match="pwvo"):
        hybridvo.Odometry("jugde")


@pytest.mark.parametrize("bad", [np.nan, 0.0, -1.0, np.inf])
def test_bad_depth_never_gives_a_pose_that_is_not_finite(bad: float) -> None:
    vo = tracker()
    vo.track(frame(0))
    vo.track(frame(1, depth=np.full((HEIGHT, WIDTH), bad, np.float32)))
    step = vo.track(frame(2))
    # no motion can start from such a frame: the next one spans it, and nothing is lost
    assert step.ok and step.prev_index == 0
    assert (
        np.isfinite(step.T_world_cam).all() and np.isfinite(step.covariance).all()
    )
    np.testing.assert_allclose(step.T_curr_prev, MOTION @ MOTION, atol=1e-4)


@pytest.mark.long
def test_memory_is_constant_over_200_frames() -> None:
    vo = tracker()
    for i in range(20):
        vo.track(frame(i))
    tracemalloc.start()
    try:
        for i in range(20, 40):
            vo.track(frame(i))
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        for i in range(40, 220):
            vo.track(frame(i))
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    # one frame is 21 kB: keeping even one in ten would be 380 kB; interpreter and numpy caches fill
    # up to 100 kB and stay there (measured over 800 frames)
    assert grown < 200_000


def test_frames_without_an_index_are_counted() -> None:
    vo = tracker()
    flow = ego_flow(depth(0), MOTION, CAMERA, CAMERA)
    steps = [vo.track(replace(frame(i), index=None), flow) for i in range(3)]
    assert [step.index for step in steps] == [0, 1, 2]
    assert vo.skip(3, 0.3).index == 3
    assert vo.track(replace(frame(4), index=None), flow).index == 4


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["light", "heavy_rigid"])
def test_the_motion_model_cannot_hold_the_tracker(kind: str) -> None:
    # forwards, then back again at once: every motion after the turn is the inverse of its like
    scene = make_scene(kind, 7, height=160, width=320, frames=5)
    there = [scene.render(i) for i in range(5)]
    path = [0, 1, 2, 3, 4, 3, 2, 1]
    errors = {}
    for history in (True, False):
        options = Options(track=TrackOptions(motion_prior=history))
        vo = Odometry(flow=dis_flow(), options=options)
        for step, at in enumerate(path):
            seen = there[at]
            depth_m = np.where(np.isfinite(seen.depth), seen.depth, 0).astype(
                np.float32
            )
            result = vo.track(
                Frame(seen.rgb, depth_m, scene.camera, 0.1 * step, step)
            )
            if step == 3 and history:
                # and a last motion that is quite another one
                wrong = se3_exp(np.array([0.3, 0.2, -0.4, 0.05, -0.08, 0.02]))
                trapped = replace(vo.state.motion_model, T_last=wrong)
                vo.resume(replace(vo.state, motion_model=trapped))
            before = path[max(step - 1, 0)]
            true = invert(scene.T_world_cam[at]) @ scene.T_world_cam[before]
            camera = scene.camera
            z = there[before].depth
            flows = [
                ego_flow(z, T, camera, camera) for T in (result.T_curr_prev, true)
            ]
            errors[step, history] = np.nanmean(
                np.linalg.norm(flows[0] - flows[1], axis=2)
            )
    # recovered within two frames of the change; half a pixel is what DIS flow of this size allows
    assert max(errors[step, True] for step in (5, 6, 7)) < 0.5
    assert max(errors[step, False] for step in (5, 6, 7)) < 0.5


def test_a_state_can_be_taken_up_by_another_tracker() -> None:
    vo, other = tracker(), tracker()
    for i in range(5):
        vo.track(frame(i, mask=np.ones((HEIGHT, WIDTH), np.bool_)))
    vo.skip(5, 0.5)
    other.resume(vo.state)
    here, there = vo.track(frame(6)), other.track(frame(6))
    np.testing.assert_array_equal(here.T_world_cam, there.T_world_cam)
    assert here.index == there.index and here.ok
