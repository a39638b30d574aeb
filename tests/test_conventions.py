"""Each line of the conventions, with numbers worked by hand.

Those of trajectory files are in ``trajectory/test_trajectory.py``. Tolerances of
1e-12 are a few thousand roundings of float64 at the size of the numbers; float32
results say so.
"""

from __future__ import annotations

import cv2
import numpy as np
import pypose
import pytest
import torch
from scipy.spatial.transform import Rotation

import hybridvo
from hybridvo.core import torch_geometry
from hybridvo.core.geometry import (
    agreement,
    backproject,
    ego_flow,
    euler_deg_to_matrix,
    invert,
    make_transform,
    matrix_to_euler_deg,
    ned_to_camera,
    pixel_grid,
    project,
    rotation_angle,
    se3_exp,
    se3_log,
    to_gtsam_covariance,
    to_ros_covariance,
)
from hybridvo.core.results import RelativePose, Step
from hybridvo.core.types import Camera, Frame, FramePair, PairBatch
from hybridvo.io.data.open import open_sequence
from hybridvo.io.data.resize import resize_camera
from hybridvo.solver import robust_fit
from hybridvo_lab.paper.inputs import assemble_inputs
from tests.walks import chained

RIGHT_TURN_ABOUT_Z = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""90 degrees about z: x goes to y, y goes to -x."""
HALF = 0.5**0.5
CAMERA = Camera(fx=100, fy=100, cx=50, cy=40, height=81, width=101)


def translation(x: float, y: float, z: float) -> np.ndarray:
    return make_transform(np.eye(3), np.array([x, y, z]))


def constant_depth(value: float) -> np.ndarray:
    return np.full(CAMERA.shape, value, np.float32)


# T_target_source


def test_names_cancel_when_composing():
    T_b_a = translation(0, 0, -1)
    T_c_b = make_transform(RIGHT_TURN_ABOUT_Z, np.zeros(3))
    # (1, 2, 3) in a is (1, 2, 2) in b and, x -> y and y -> -x, (-2, 1, 2) in c
    np.testing.assert_allclose(
        (T_c_b @ T_b_a @ [1, 2, 3, 1])[:3], [-2, 1, 2], atol=1e-15
    )


def test_the_result_offers_both_directions():
    motion = RelativePose(
        make_transform(RIGHT_TURN_ABOUT_Z, np.array([1.0, 2.0, 3.0]))
    )
    # R^T t = (2, -1, 3)
    expected = make_transform(RIGHT_TURN_ABOUT_Z.T, np.array([-2.0, 1.0, -3.0]))
    np.testing.assert_allclose(motion.T_prev_curr, expected, atol=1e-15)
    step = Step(1, 0.0, np.eye(4), motion, 0)
    np.testing.assert_array_equal(step.T_prev_curr, motion.T_prev_curr)
    np.testing.assert_array_equal(step.T_curr_prev, motion.T_curr_prev)
    np.testing.assert_allclose(invert(motion.T_curr_prev), expected, atol=1e-15)


def test_forward_is_plus_z_and_points_come_nearer():
    # the camera goes 1 m ahead: what was at 2 m is at 1 m, and the picture expands:
    # the pixel 10 to the right of the centre goes to 20, its flow is +10
    T_curr_prev = translation(0, 0, -1)
    flow = ego_flow(constant_depth(2), T_curr_prev, CAMERA, CAMERA)
    np.testing.assert_allclose(flow[40, 60], [10, 0], atol=1e-12)
    np.testing.assert_allclose(flow[40, 40], [-10, 0], atol=1e-12)
    np.testing.assert_allclose(flow[50, 50], [0, 10], atol=1e-12)
    path = chained([T_curr_prev], [0.0, 1.0])
    np.testing.assert_allclose(path.T_world_cam[1], translation(0, 0, 1))


def test_world_is_the_first_camera():
    path = chained([translation(0, 0, -1)], [0.0, 1.0])
    np.testing.assert_array_equal(path.T_world_cam[0], np.eye(4))


# Camera axes and pixels


def test_x_is_right_y_is_down_z_is_forward():
    points = backproject(constant_depth(2), CAMERA)
    np.testing.assert_allclose(points[40, 50], [0, 0, 2])
    # right in the picture: +x
    np.testing.assert_allclose(points[40, 60], [0.2, 0, 2])
    # down in the picture: +y
    np.testing.assert_allclose(points[50, 50], [0, 0.2, 2])


def test_ned_is_x_forward_y_right_z_down():
    # 1 m north, 2 m east, 3 m down: 2 to the right, 3 down, 1 ahead
    pose = ned_to_camera(translation(1, 2, 3))
    np.testing.assert_allclose(pose, translation(2, 3, 1))
    # yaw to the right, about NED z, is a turn about camera y (both down): x goes to -z, z to x
    turned = ned_to_camera(make_transform(RIGHT_TURN_ABOUT_Z, np.zeros(3)))
    np.testing.assert_allclose(turned[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(turned[:3, :3] @ [1, 0, 0], [0, 0, -1], atol=1e-15)


def test_pixel_zero_is_a_centre():
    # a picture of 4x2 pixels reaches from -0.5 to 3.5 and to 1.5: its middle is (1.5, 0.5)
    camera = Camera(10, 10, 1.5, 0.5, height=2, width=4)
    grid = pixel_grid(2, 4)
    np.testing.assert_array_equal(grid[0, 0], [0, 0])
    np.testing.assert_array_equal(grid[1, 3], [3, 1])
    points = backproject(np.ones((2, 4)), camera)
    np.testing.assert_allclose(points[0, 0], [-0.15, -0.05, 1])
    np.testing.assert_allclose(points[1, 3], [0.15, 0.05, 1])
    np.testing.assert_allclose(
        project(np.array([-0.15, -0.05, 1]), camera), [0, 0], atol=1e-12
    )


def test_resizing_keeps_the_borders_where_they_are():
    # 640x480 with the middle at 319.5, 239.5 -> 320x240: 0.5 (319.5 + 0.5) - 0.5 = 159.5
    half = resize_camera(
        Camera(525, 520, 319.5, 239.5, height=480, width=640), 240, 320
    )
    assert (half.fx, half.fy, half.cx, half.cy) == (262.5, 260, 159.5, 119.5)
    # off the middle, a quarter: 0.25 (9.5 + 0.5) - 0.5 = 2; corner-aligned it would be 9.5 * 4 / 19
    quarter = resize_camera(Camera(20, 20, 9.5, 3.5, height=12, width=20), 3, 5)
    assert (quarter.cx, quarter.cy) == (2.0, 0.5)
    # Sintel to the paper's size: 436 rows, 217.5 -> 128 / 436 * 218 - 0.5 = 63.5
    sintel = resize_camera(
        Camera(1120, 1120, 511.5, 217.5, height=436, width=1024), 128, 256
    )
    assert sintel.cx == 127.5
    assert sintel.cy == pytest.approx(63.5, abs=1e-12)


def test_network_inputs_scale_intrinsics_the_same_way():
    batch = PairBatch(
        flow=torch.zeros(1, 12, 20, 2),
        depth_prev=torch.ones(1, 12, 20),
        K_prev=torch.tensor([[[20.0, 0, 9.5], [0, 20, 3.5], [0, 0, 1]]]),
        K_curr=torch.tensor([[[40.0, 0, 7.5], [0, 40, 3.5], [0, 0, 1]]]),
    )
    inputs = assemble_inputs(batch, (3, 5))
    assert inputs.K_prev[0].tolist() == [[5, 0, 2], [0, 5, 0.5], [0, 0, 1]]
    assert inputs.K_curr[0].tolist() == [[10, 0, 1.5], [0, 10, 0.5], [0, 0, 1]]


def test_tartanair_principal_point_is_the_middle_pixel_edge(tmp_path):
    for height, expected in ((640, 319.5), (480, 239.5)):
        root = tmp_path / str(height) / "P000"
        image, depth = root / "image_left", root / "depth_left"
        for folder in (image, depth):
            folder.mkdir(parents=True)
        for i in range(2):
            picture = np.zeros((height, 640, 3), np.uint8)
            cv2.imwrite(str(image / f"{i:06d}_left.png"), picture)
            np.save(
                depth / f"{i:06d}_left_depth.npy",
                np.ones((height, 640), np.float32),
            )
        camera = open_sequence(root).camera(0)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (
            320,
            320,
            319.5,
            expected,
        )


# Depth, flow, intrinsics of each frame


def test_depth_is_z_and_not_the_distance():
    # the point (3, 0, 4) is 5 m away; its depth is 4. At f = 100 it is seen 75 px off the centre
    camera = Camera(100, 100, 0, 0, height=1, width=76)
    points = backproject(np.full((1, 76), 4.0), camera)
    np.testing.assert_allclose(points[0, 75], [3, 0, 4])
    assert np.linalg.norm(points[0, 75]) == pytest.approx(5)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_invalid_depth_is_masked(bad):
    depth = constant_depth(2)
    depth[3, 4] = bad
    flow = ego_flow(depth, translation(0.1, 0, 0), CAMERA, CAMERA)
    invalid = ~np.isfinite(flow).all(axis=2)
    assert np.argwhere(invalid).tolist() == [[3, 4]]
    frame = Frame(None, depth, CAMERA)
    inputs = assemble_inputs(
        FramePair(frame, frame, np.zeros((81, 101, 2), np.float32)), (81, 101)
    )
    assert torch.nonzero(~inputs.valid[0]).tolist() == [[3, 4]]


def test_flow_leads_from_previous_to_current_x_first():
    # points move 0.1 m to the right and 0.2 m up in the camera: at 2 m and f = 100, (5, -10) px
    depth = constant_depth(2)
    depth[:, ::2] = 4
    flow = ego_flow(depth, translation(0.1, -0.2, 0), CAMERA, CAMERA)
    np.testing.assert_allclose(
        flow[:, 1], np.tile([5.0, -10.0], (81, 1)), atol=1e-12
    )
    np.testing.assert_allclose(
        flow[:, 0], np.tile([2.5, -5.0], (81, 1)), atol=1e-12
    )
    # and the estimate from this flow is T_curr_prev, not its inverse
    frame = Frame(None, depth, CAMERA)
    result = hybridvo.refine(FramePair(frame, frame, flow.astype(np.float32)))
    np.testing.assert_allclose(
        result.T_curr_prev, translation(0.1, -0.2, 0), atol=1e-5
    )


def test_each_frame_has_its_own_intrinsics():
    # no motion, the lens zooms from 100 to 110: 40 px off the centre become 44
    zoomed = Camera(110, 110, 50, 40, height=81, width=101)
    flow = ego_flow(constant_depth(7), np.eye(4), CAMERA, zoomed)
    np.testing.assert_allclose(flow[40, 90], [4, 0], atol=1e-12)
    np.testing.assert_allclose(flow[40, 10], [-4, 0], atol=1e-12)
    other = Camera(100, 100, 53, 38, height=81, width=101)
    moved = ego_flow(constant_depth(7), np.eye(4), CAMERA, other)
    np.testing.assert_allclose(moved[12, 34], [3, -2], atol=1e-12)


def test_current_depth_is_sampled_at_x_plus_flow():
    # on its own grid the current depth is 1 + u: seen from pixel u with flow (3, 1) it is 4 + u
    height, width = 6, 10
    u = torch.arange(width, dtype=torch.float32).expand(1, height, width)
    K = torch.eye(3)[None]
    batch = PairBatch(
        flow=torch.tensor([3.0, 1.0]).expand(1, height, width, 2),
        depth_prev=torch.full((1, height, width), 2.0),
        K_prev=K,
        K_curr=K,
        depth_curr=1 + u,
    )
    inputs = assemble_inputs(batch, (height, width))
    np.testing.assert_allclose(
        1 / inputs.inverse_depth[0, 1, 2, :7], [4, 5, 6, 7, 8, 9, 10], rtol=1e-6
    )
    np.testing.assert_allclose(inputs.inverse_depth[0, 1, 2, 0], 0.25)
    assert (inputs.inverse_depth[0, 1, 2, 7:] == 0).all()  # x + F is outside
    assert (inputs.inverse_depth[0, 1, 5] == 0).all()


# Angles, tangents, covariance


def test_euler_angles_are_intrinsic_x_y_z_in_degrees():
    R = euler_deg_to_matrix(np.array([90.0, 0.0, 90.0]))
    # R = Rx Rz: Rz brings x to y, Rx brings y to z. (Rz Rx would leave x at y.)
    np.testing.assert_allclose(R @ [1, 0, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(R @ [0, 1, 0], [-1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(matrix_to_euler_deg(R), [90, 0, 90], atol=1e-12)
    # a positive angle about y (down) brings z to x: what was ahead goes to the right
    turn = euler_deg_to_matrix(np.array([0.0, 90.0, 0.0]))
    np.testing.assert_allclose(turn @ [0, 0, 1], [1, 0, 0], atol=1e-15)


def test_tangents_are_translation_then_rotation_in_radians():
    np.testing.assert_allclose(
        se3_exp(np.array([1.0, 2, 3, 0, 0, 0])), translation(1, 2, 3)
    )
    quarter = se3_exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(quarter[:3, :3], RIGHT_TURN_ABOUT_Z, atol=1e-15)
    # a quarter of a circle of radius 2/pi * pi/2: V (1, 0, 0) = (2/pi, 2/pi, 0)
    curved = se3_exp(np.array([1.0, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(curved[:3, 3], [2 / np.pi, 2 / np.pi, 0], atol=1e-15)
    np.testing.assert_allclose(
        se3_log(curved), [1, 0, 0, 0, 0, np.pi / 2], atol=1e-12
    )
    # a standard deviation each way
    off = np.array([0.1, 0.2, 0.1, 0.02, 0.03, 0.02])
    assert agreement(
        se3_exp(off) @ curved, curved, np.diag(off**2)
    ) == pytest.approx(0.5)


@pytest.mark.parametrize("twin", ["numba", "torch"])
def test_perturbation_is_on_the_left(twin):
    # Exp(quarter turn about z) applied to a step of 1 m along x puts it on y; on the right it would
    # stay on x
    delta = np.array([0, 0, 0, 0, 0, np.pi / 2])
    updated = update(twin, delta, translation(1, 0, 0))
    np.testing.assert_allclose(updated[:3, 3], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(updated[:3, :3], RIGHT_TURN_ABOUT_Z, atol=1e-15)


def test_covariance_of_the_estimate_is_of_a_left_translation_first_tangent():
    # depth is known and far (100 m): a pixel is worth 1 m sideways but 0.01 rad, so the first three
    # variances (m^2) are larger than the last three (rad^2)
    height, width = 48, 64
    camera = Camera(100, 100, 31.5, 23.5, height=height, width=width)
    grid = pixel_grid(height, width)
    depth = (100 + 40 * np.sin(grid[..., 0] / 3) * np.cos(grid[..., 1] / 4)).astype(
        np.float32
    )
    flow = ego_flow(depth, np.eye(4), camera, camera).astype(np.float32)
    flow += np.random.default_rng(1).normal(0, 0.3, flow.shape).astype(np.float32)
    frame = Frame(None, depth, camera)
    covariance = hybridvo.refine(FramePair(frame, frame, flow)).covariance
    assert np.diag(covariance)[:3].min() > 100 * np.diag(covariance)[3:].max()


def test_gtsam_wants_rotation_first_of_a_right_perturbation():
    # diagonal worked by hand: (1, 2, 3 | 4, 5, 6) becomes (4, 5, 6 | 1, 2, 3)
    assert np.diag(to_gtsam_covariance(np.diag([1, 2, 3, 4, 5, 6]))).tolist() == [
        4,
        5,
        6,
        1,
        2,
        3,
    ]
    mixed = np.zeros((6, 6))
    mixed[0, 5] = mixed[5, 0] = 7  # tx with rz
    assert to_gtsam_covariance(mixed)[3, 2] == to_gtsam_covariance(mixed)[2, 3] == 7


def test_gtsam_covariance_by_sampling():
    # spread of Log(T_prev_curr^-1 T') for T' the inverse of Exp(d) T_curr_prev, rotation first
    rng = np.random.default_rng(5)
    T_curr_prev = se3_exp(np.array([0.5, -0.3, 1.2, 0.2, -0.7, 0.4]))
    factor = rng.normal(size=(6, 6)) * 0.02
    samples = rng.normal(size=(400, 6)) @ factor.T
    seen = np.empty_like(samples)
    for row, d in zip(seen, samples, strict=True):
        xi = se3_log(T_curr_prev @ invert(se3_exp(d) @ T_curr_prev))
        row[:] = np.concatenate([xi[3:], xi[:3]])
    ours, theirs = (x.T @ x / len(x) for x in (samples, seen))
    # the relation is exact, so the spreads of the same samples agree to rounding
    np.testing.assert_allclose(theirs, to_gtsam_covariance(ours), atol=1e-12)


def test_ros_wants_the_axes_of_the_previous_camera():
    # the current camera is turned by 90 degrees about z: its x is the previous one's y, its y the
    # previous one's -x. Variances (1, 2, 3 | 4, 5, 6) become (2, 1, 3 | 5, 4, 6)
    T_prev_curr = make_transform(RIGHT_TURN_ABOUT_Z, np.array([7.0, 8.0, 9.0]))
    turned = to_ros_covariance(np.diag([1.0, 2, 3, 4, 5, 6]), T_prev_curr)
    np.testing.assert_allclose(turned, np.diag([2.0, 1, 3, 5, 4, 6]), atol=1e-15)
    # x with z becomes y with z, and y with z becomes minus x with z: turned the other way, the
    # signs are exchanged
    mixed = np.zeros((6, 6))
    mixed[0, 2] = mixed[2, 0] = 0.5
    mixed[1, 2] = mixed[2, 1] = 0.25
    mixed[0, 5] = mixed[5, 0] = 0.125  # tx with rz
    turned = to_ros_covariance(mixed, T_prev_curr)
    assert turned[1, 2] == turned[2, 1] == pytest.approx(0.5)
    assert turned[0, 2] == turned[2, 0] == pytest.approx(-0.25)
    assert turned[1, 5] == turned[5, 1] == pytest.approx(0.125)
    # many at once
    both = to_ros_covariance(
        np.stack([mixed, mixed]), np.stack([T_prev_curr, np.eye(4)])
    )
    np.testing.assert_allclose(both, [turned, mixed], atol=1e-15)


def test_ros_covariance_by_sampling():
    # T_prev_curr of a disturbed motion: its translation and rotation in the previous camera's axes,
    # for disturbances about the current camera's origin
    rng = np.random.default_rng(5)
    T_curr_prev = se3_exp(np.array([0.5, -0.3, 1.2, 0.2, -0.7, 0.4]))
    T_prev_curr = invert(T_curr_prev)
    factor = rng.normal(size=(6, 6)) * 1e-5
    samples = rng.normal(size=(400, 6)) @ factor.T
    seen = np.empty_like(samples)
    for row, d in zip(seen, samples, strict=True):
        moved = invert(se3_exp(d) @ T_curr_prev)
        turn = moved[:3, :3] @ T_prev_curr[:3, :3].T
        row[:3] = moved[:3, 3] - T_prev_curr[:3, 3]
        row[3:] = Rotation.from_matrix(turn).as_rotvec()
    ours, theirs = (x.T @ x / len(x) for x in (samples, seen))
    # exact to first order in 1e-5
    expected = to_ros_covariance(ours, T_prev_curr)
    np.testing.assert_allclose(theirs, expected, atol=1e-3 * np.abs(expected).max())


# Quaternions


def test_pypose_and_tum_are_xyzw_kornia_and_evo_wxyz():
    from evo.core.trajectory import PosePath3D
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    xyzw = np.array([0, 0, HALF, HALF])  # 90 degrees about z
    wxyz = np.array([HALF, 0, 0, HALF])
    by_pypose = pypose.SO3(torch.tensor(xyzw)).matrix().numpy()
    by_kornia = quaternion_to_rotation_matrix(torch.tensor(wxyz)).numpy()
    by_evo = PosePath3D(np.zeros((1, 3)), wxyz[None]).poses_se3[0][:3, :3]
    for R in (by_pypose, by_kornia, by_evo):
        np.testing.assert_allclose(R, RIGHT_TURN_ABOUT_Z, atol=1e-12)


# The group in numpy, numba and torch is pypose's


def tangents() -> np.ndarray:
    """(N, 6): everyday, near the identity (1e-7), around the series' switch (1e-4), near pi."""
    rng = np.random.default_rng(11)
    phi = rng.normal(size=(60, 3))
    phi /= np.linalg.norm(phi, axis=1, keepdims=True)
    angles = np.repeat([0.8, 1e-7, 1e-4, 1.01e-4, 3.0, np.pi - 1e-6], 10)
    phi *= angles[:, None]
    rho = rng.normal(size=(60, 3))
    rho[10:20] *= 1e-7
    zero = np.zeros((1, 6))
    return np.concatenate([np.concatenate([rho, phi], axis=1), zero])


def update(twin: str, delta: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Exp(delta) T by one of the solvers' own updates."""
    if twin == "numba":
        out = np.eye(4)
        robust_fit.left_update(delta, np.ascontiguousarray(T[:3]), out[:3])
        return out
    pose = torch_geometry.se3(torch.tensor(T)[None])
    return (
        torch_geometry.left_update(torch.tensor(delta)[None], pose)[0]
        .matrix()
        .numpy()
    )


def test_se3_exp_is_pyposes():
    deltas = tangents()
    expected = pypose.se3(torch.tensor(deltas)).Exp().matrix().numpy()
    ours = np.stack([se3_exp(delta) for delta in deltas])
    np.testing.assert_allclose(ours, expected, atol=1e-12)


@pytest.mark.parametrize("twin", ["numba", "torch"])
def test_left_update_is_pyposes(twin):
    rng = np.random.default_rng(2)
    for delta in tangents():
        T = se3_exp(rng.normal(size=6))
        step = pypose.se3(torch.tensor(delta)).Exp().matrix().numpy()
        np.testing.assert_allclose(update(twin, delta, T), step @ T, atol=1e-12)


def test_se3_log_is_pyposes_and_inverts_exp():
    for delta in tangents():
        T = se3_exp(delta)
        # near pi the angle enters through a cosine of slope |pi - angle|: rounding grows by 1e6
        near_pi = np.linalg.norm(delta[3:]) > 3.1
        tolerance = 1e-9 if near_pi else 1e-12
        np.testing.assert_allclose(se3_log(T), delta, atol=tolerance)
        np.testing.assert_allclose(se3_exp(se3_log(T)), T, atol=1e-12)
        group = pypose.se3(torch.tensor(delta)).Exp()
        np.testing.assert_allclose(se3_log(T), group.Log().numpy(), atol=tolerance)


@pytest.mark.parametrize(
    "angle",
    [0.0, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12, np.pi],
)
def test_rotation_angle_is_exact_near_zero_and_pi(angle):
    # arccos((trace - 1) / 2) would be wrong by 1e-8 at both ends
    axis = np.array([2.0, -1.0, 2.0]) / 3
    R = se3_exp(np.concatenate([np.zeros(3), angle * axis]))[:3, :3]
    assert rotation_angle(R) == pytest.approx(
        angle, abs=5e-16 if angle < 1e-3 else 2e-15
    )
    assert rotation_angle(np.stack([R, R.T])).shape == (2,)
