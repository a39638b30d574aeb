from __future__ import annotations

import json
import time

import numpy as np
import pytest
from hybridvo.evaluation.drift import KITTI_LENGTHS, SHORT_LENGTHS, kitti_drift
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hybridvo.errors import FormatError, InputError
from hybridvo.evaluation.metrics import (
    associate,
    ate,
    dynamic_fraction,
    evaluate_files,
    evaluate_trajectories,
    mean_pair_errors,
    pair_errors,
    rpe,
)
from hybridvo.geometry import ego_flow, make_transform, se3_exp
from hybridvo.trajectory import Trajectory, read_trajectory, write_tum
from hybridvo.types import Camera


def random_trajectory(rng: np.random.Generator, frames: int = 40) -> Trajectory:
    relative = [se3_exp(0.2 * rng.standard_normal(6)) for _ in range(frames - 1)]
    return Trajectory.from_relative(relative, np.arange(frames) * 0.1)


def perturbed(trajectory: Trajectory, rng: np.random.Generator, size: float = 0.05) -> Trajectory:
    T = trajectory.T_world_cam.copy()
    for pose in T:
        pose[:] = pose @ se3_exp(size * rng.standard_normal(6))
    return Trajectory(trajectory.timestamps, T)


def from_positions(positions, stamps=None) -> Trajectory:
    positions = np.asarray(positions, dtype=np.float64)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, 3] = positions
    return Trajectory(np.arange(len(T)) * 0.1 if stamps is None else stamps, T)


# -- the official figures -------------------------------------------------------------------------


@pytest.fixture
def official(shared_data):
    folder = shared_data / "trajectories"
    return folder / "pose_est.txt", folder / "pose_gt.txt"


def test_official_evaluator(official):
    report = evaluate_files(*official)
    exact = {"rel": 1e-6}
    assert report["ate_rmse"] == pytest.approx(1.2045074393, **exact)
    assert report["ate_rmse_norms"] == pytest.approx(0.8344983412, **exact)
    assert report["scale_norms"] == pytest.approx(1.0782526734, **exact)
    assert report["kitti_drift"]["rotation_deg_per_m"] == pytest.approx(0.0229947185, **exact)
    assert report["kitti_drift"]["translation"] == pytest.approx(0.0271438892, **exact)
    short = report["kitti_drift_short"]
    assert short["rotation_deg_per_m"] == pytest.approx(0.0798719448, **exact)
    assert short["translation"] == pytest.approx(0.0749175164, **exact)
    assert report["alignment"] == "se3"
    assert (report["matched"], report["total"]) == (734, 734)
    assert report["reasons"] == {}
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_errors_do_not_depend_on_the_axes(official):
    ned = evaluate_files(*official)
    camera = evaluate_files(*official, axes_est="camera", axes_gt="camera")
    for key in ("ate_rmse", "ate_rmse_sim3", "rpe_trans_rmse", "rpe_rot_rmse_deg"):
        assert ned[key] == pytest.approx(camera[key], rel=1e-9)


# -- ATE and RPE ----------------------------------------------------------------------------------


def umeyama(x, y, with_scale):
    """Independent least-squares alignment y ~ s R x + t (Umeyama 1991) of (M, 3) points."""
    mx, my = x.mean(0), y.mean(0)
    xc, yc = x - mx, y - my
    U, d, Vt = np.linalg.svd(yc.T @ xc / len(x))
    S = np.diag([1, 1, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = U @ S @ Vt
    s = np.trace(np.diag(d) @ S) / (xc**2).sum() * len(x) if with_scale else 1.0
    return s, R, my - s * R @ mx


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_ate_against_independent_umeyama(rng, alignment):
    truth = random_trajectory(rng)
    moved = perturbed(truth, rng).transformed(se3_exp(rng.standard_normal(6)), 1.7)
    before = moved.T_world_cam.copy()
    result = ate(moved, truth, alignment)
    s, R, t = umeyama(moved.positions, truth.positions, alignment == "sim3")
    errors = np.linalg.norm(s * moved.positions @ R.T + t - truth.positions, axis=1)
    np.testing.assert_allclose(result.errors, errors, rtol=1e-9)
    assert result.rmse == pytest.approx(np.sqrt((errors**2).mean()), rel=1e-12)
    assert result.mean == pytest.approx(errors.mean())
    assert result.median == pytest.approx(np.median(errors))
    assert result.max == pytest.approx(errors.max())
    assert result.scale == pytest.approx(s)
    np.testing.assert_allclose(result.T_gt_est, make_transform(R, t), atol=1e-12)
    np.testing.assert_array_equal(moved.T_world_cam, before)  # evo aligns in place: not ours
    aligned = moved.transformed(result.T_gt_est, result.scale)
    np.testing.assert_allclose(
        np.linalg.norm(aligned.positions - truth.positions, axis=1), errors, rtol=1e-9
    )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_errors_do_not_depend_on_the_world(seed):
    rng = np.random.default_rng(seed)
    truth = random_trajectory(rng, 10)
    est = perturbed(truth, rng)
    moved = est.transformed(se3_exp(rng.standard_normal(6)))
    for alignment in ("se3", "sim3", "origin"):
        a, b = ate(est, truth, alignment), ate(moved, truth, alignment)
        assert a.rmse == pytest.approx(b.rmse, rel=1e-9)
    assert rpe(est, truth).rot_rmse_deg == pytest.approx(rpe(moved, truth).rot_rmse_deg, rel=1e-6)


def test_ate_by_hand():
    truth = from_positions([[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    est = from_positions([[0, 0, 3], [1, 0, 3], [1, 1, 4]])
    none = ate(est, truth, "none")
    assert none.rmse == pytest.approx(np.sqrt((9 + 9 + 16) / 3))
    assert none.max == pytest.approx(4)
    assert none.rmse_unaligned == none.rmse
    assert ate(est, truth, "origin").rmse == pytest.approx(np.sqrt(1 / 3))


def test_rpe_by_hand():
    # the truth goes 1 m a frame; the estimate 1.1 m, and turns by 2 deg a frame about y
    truth = from_positions([[0, 0, k] for k in range(5)])
    step = make_transform(Rotation.from_euler("y", 2, degrees=True).as_matrix(), [0, 0, 1.1])
    T = [np.eye(4)]
    for _ in range(4):
        T.append(T[-1] @ step)
    result = rpe(Trajectory(truth.timestamps, np.array(T)), truth)
    assert result.trans_rmse == pytest.approx(0.1)
    assert result.rot_rmse_deg == pytest.approx(2.0)
    assert result.pairs == 4
    two = rpe(Trajectory(truth.timestamps, np.array(T)), truth, delta=2)
    assert two.rot_mean_deg == pytest.approx(4.0)
    assert two.pairs == 3


def test_rpe_with_scale(rng):
    truth = random_trajectory(rng)
    doubled = truth.transformed(np.eye(4), 2.0)
    assert rpe(doubled, truth).trans_rmse > 0.1
    scaled = rpe(doubled, truth, alignment="sim3")
    assert scaled.trans_rmse == pytest.approx(0, abs=1e-12)
    assert scaled.scale == pytest.approx(0.5)


def test_norms_scale_is_the_inverse_of_the_reverse_regression(rng):
    truth = random_trajectory(rng)
    est = perturbed(truth, rng, 0.2)
    forward = ate(est, truth, "sim3", scale="norms").scale
    assert forward == pytest.approx(1 / ate(truth, est, "sim3").scale)
    assert forward > ate(est, truth, "sim3").scale


# -- what cannot be computed (F21, F39) -----------------------------------------------------------


def test_static_camera():
    still = from_positions(np.ones((10, 3)))
    moving = from_positions(np.random.default_rng(1).normal(size=(10, 3)))
    for est, truth in ((still, moving), (moving, still), (still, still)):
        result = ate(est, truth)
        assert result.rmse is None and result.scale is None
        assert "static camera" in result.reasons["rmse"]
        assert result.rmse_unaligned is not None
        assert ate(est, truth, "origin").rmse is not None
        assert rpe(est, truth).trans_rmse is not None
        assert rpe(est, truth, alignment="sim3").trans_rmse is None
    assert ate(still, still).rmse_unaligned == 0.0


def test_straight_line():
    line = np.outer(np.arange(20.0), [0.3, 0.1, 2.0])
    bent = line + np.random.default_rng(2).normal(size=line.shape) * 0.1
    for est, truth in ((line, bent), (bent, line), (line + 1, line)):
        result = ate(from_positions(est), from_positions(truth))
        assert result.rmse is None
        assert "straight line" in result.reasons["rmse"]
        assert result.rmse_unaligned > 0
    # 2 mm aside on 40 m is enough
    nearly = line + np.sin(np.arange(20))[:, None] * [0.002, 0, 0]
    assert ate(from_positions(nearly), from_positions(nearly)).rmse == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("frames", [1, 2])
def test_one_and_two_poses(frames):
    trajectory = from_positions(np.eye(3)[:frames])
    report = evaluate_trajectories(trajectory, trajectory)
    assert report["ate_rmse"] is None
    assert "not enough poses" in report["reasons"]["ate_rmse"]
    assert report["ate_rmse_unaligned"] == 0.0
    assert report["ate_rmse_origin"] == 0.0
    if frames == 1:
        assert report["rpe_trans_rmse"] is None
        assert "not enough poses" in report["reasons"]["rpe_trans_rmse"]
    else:
        assert report["rpe_trans_rmse"] == 0.0
    assert report["kitti_drift"]["translation"] is None
    assert "shorter than" in report["kitti_drift"]["reasons"]["translation"]
    json.dumps(report, allow_nan=False)


def test_overflow_is_none_with_a_reason():
    truth = from_positions(np.random.default_rng(3).normal(size=(10, 3)))
    far = from_positions(truth.positions * 1e200)
    report = evaluate_trajectories(far, truth)
    for key in ("ate_rmse", "ate_rmse_unaligned", "ate_rmse_origin", "rpe_trans_rmse"):
        assert report[key] is None
        assert "not a finite number" in report["reasons"][key]
    json.dumps(report, allow_nan=False)


def test_nan_in_a_file_names_the_line(tmp_path):
    write_tum(from_positions(np.eye(3)), tmp_path / "gt")
    (tmp_path / "est").write_text("0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n")
    with pytest.raises(FormatError, match="est:2: expected finite numbers"):
        evaluate_files(tmp_path / "est", tmp_path / "gt")


def test_few_matches_give_no_number():
    positions = np.random.default_rng(4).normal(size=(50, 3))
    truth = from_positions(positions)
    # nanoseconds read as seconds elsewhere: one stamp of fifty meets
    est = from_positions(positions, truth.timestamps * 1000)
    report = evaluate_trajectories(est, truth)
    assert (report["matched"], report["total"]) == (1, 50)
    for key in ("ate_rmse", "ate_rmse_unaligned", "rpe_rot_rmse_deg", "kitti_drift"):
        assert report[key] is None
        assert "only 1 of 50 poses match" in report["reasons"][key]
    nothing = evaluate_trajectories(from_positions(positions, truth.timestamps + 1e6), truth)
    assert nothing["matched"] == 0
    assert "only 0 of 50" in nothing["reasons"]["ate_rmse"]


def test_all_none_values_have_a_reason():
    still = from_positions(np.ones((10, 3)))
    report = evaluate_trajectories(still, still)
    missing = {key for key, value in report.items() if value is None}
    assert missing == set(report["reasons"])


# -- association ----------------------------------------------------------------------------------


def test_association_is_one_to_one_and_nearest():
    truth = from_positions(np.zeros((5, 3)), [0.0, 0.1, 0.2, 0.3, 0.4])
    est = from_positions(np.zeros((4, 3)), [0.001, 0.115, 0.12, 0.4])
    match = associate(est, truth, max_diff=0.02)
    # 0.115 and 0.12 both want 0.1: the nearer one gets it
    np.testing.assert_array_equal(match.est_indices, [0, 1, 3])
    np.testing.assert_array_equal(match.gt_indices, [0, 1, 4])
    assert (match.matched, match.total, match.by) == (3, 4, "time")
    back = associate(truth, est, max_diff=0.02)
    np.testing.assert_array_equal(back.est_indices, [0, 1, 4])


def test_default_time_difference():
    slow = from_positions(np.zeros((5, 3)), np.arange(5) * 0.1)
    fast = from_positions(np.zeros((5, 3)), np.arange(5) * 0.01)
    assert associate(slow, slow).max_diff == 0.02
    assert associate(fast, fast).max_diff == pytest.approx(0.005)
    with pytest.raises(InputError, match="max_diff"):
        associate(slow, slow, max_diff=-1.0)


def test_files_without_stamps_match_by_index():
    stamped = from_positions(np.eye(3))
    plain = Trajectory(np.arange(3), stamped.T_world_cam, has_timestamps=False)
    assert associate(plain, stamped).by == "index"
    assert associate(plain, stamped).matched == 3
    short = Trajectory([0, 1], stamped.T_world_cam[:2], has_timestamps=False)
    report = evaluate_trajectories(short, stamped)
    assert report["ate_rmse"] is None
    assert "the estimate has 2 and the truth 3" in report["reasons"]["ate_rmse"]


def test_unknown_options():
    t = from_positions(np.eye(3))
    with pytest.raises(InputError, match="alignment: expected"):
        ate(t, t, "affine")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="scale: expected"):
        rpe(t, t, scale="median")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="delta: expected"):
        rpe(t, t, delta=0)


# -- KITTI drift ----------------------------------------------------------------------------------


def test_drift_by_hand():
    # truth: 1 m a frame along z, 0 to 12 m. Estimate: 1.02 m a frame. Length 10 m: the first frame
    # strictly beyond it is 11 frames on, so starts 0 and 1, error 11 * 0.02 = 0.22 m over 10 m.
    T_true = from_positions([[0, 0, k] for k in range(13)]).T_world_cam
    T_est = from_positions([[0, 0, 1.02 * k] for k in range(13)]).T_world_cam
    drift = kitti_drift(T_est, T_true, lengths=[10])
    assert drift.segments == 2
    assert drift.translation == pytest.approx(0.022)
    assert drift.rotation_deg_per_m == 0.0
    # lengths 5 (6 frames on, starts 0..6, 0.12 / 5) and 10: mean of lengths, and of segments
    both = kitti_drift(T_est, T_true, lengths=[5, 10, 100])
    assert both.per_length[0][:2] == (5.0, 7)
    assert both.translation == pytest.approx((0.024 + 0.022) / 2)
    segments = kitti_drift(T_est, T_true, lengths=[5, 10, 100], averaging="segments")
    assert segments.translation == pytest.approx((7 * 0.024 + 2 * 0.022) / 9)
    assert kitti_drift(T_est, T_true, lengths=[5], start_step=3).segments == 3


def test_drift_of_rotation_by_hand():
    T_true = from_positions([[0, 0, k] for k in range(13)]).T_world_cam
    T_est = T_true.copy()
    for k in range(13):
        T_est[k, :3, :3] = Rotation.from_euler("z", 0.5 * k, degrees=True).as_matrix()
    drift = kitti_drift(T_est, T_true, lengths=[10])
    assert drift.rotation_deg_per_m == pytest.approx(11 * 0.5 / 10)
    assert drift.translation == pytest.approx(0, abs=1e-15)


def test_drift_against_a_plain_loop(rng):
    truth = random_trajectory(rng, 120)
    est = perturbed(truth, rng)
    lengths, translations, rotations = (2.0, 7.0), [], []
    steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    for length in lengths:
        errors = []
        for i in range(len(truth)):
            ends = [j for j in range(i, len(truth)) if steps[i:j].sum() > length]
            if ends:
                j = ends[0]
                D = [np.linalg.inv(t.T_world_cam[i]) @ t.T_world_cam[j] for t in (est, truth)]
                E = np.linalg.inv(D[0]) @ D[1]
                angle = np.arccos(np.clip((np.trace(E[:3, :3]) - 1) / 2, -1, 1))
                errors.append((np.linalg.norm(E[:3, 3]) / length, np.degrees(angle) / length))
        translations.append(np.mean([e[0] for e in errors]))
        rotations.append(np.mean([e[1] for e in errors]))
    drift = kitti_drift(est.T_world_cam, truth.T_world_cam, lengths=lengths)
    assert drift.translation == pytest.approx(np.mean(translations), rel=1e-9)
    assert drift.rotation_deg_per_m == pytest.approx(np.mean(rotations), rel=1e-9)


def test_drift_refuses_bad_arguments():
    T = np.tile(np.eye(4), (3, 1, 1))
    with pytest.raises(InputError, match="Associate"):
        kitti_drift(T, T[:2])
    with pytest.raises(InputError, match="positive lengths"):
        kitti_drift(T, T, lengths=[0])
    with pytest.raises(InputError, match="start_step"):
        kitti_drift(T, T, start_step=0)
    assert KITTI_LENGTHS[0] == 100 and SHORT_LENGTHS[-1] == 40


# -- errors of a pair -----------------------------------------------------------------------------

CAMERA = Camera(200.0, 200.0, 127.5, 63.5, 128, 256)
"""Camera of the paper's size, principal point in the middle: nothing is resized."""


def test_pair_errors_by_hand():
    # depth 4 m, f = 200: a translation of 0.02 m in x moves every pixel by 200 * 0.02 / 4 = 1 px,
    # -0.04 m in y by -2 px. Component mean 1.5, L2 sqrt(5).
    depth = np.full(CAMERA.shape, 4.0, dtype=np.float32)
    T_est = make_transform(np.eye(3), np.array([0.02, -0.04, 0.0]))
    errors = pair_errors(T_est, np.eye(4), depth, CAMERA, CAMERA)
    assert errors["epe"] == pytest.approx(1.5)
    assert errors["epe_l2_px"] == pytest.approx(np.sqrt(5))
    assert errors["t_err"] == pytest.approx(0.02)
    assert errors["trans_err"] == pytest.approx(np.sqrt(0.002))
    assert errors["r_err_deg"] == 0.0
    assert errors["rot_err_deg"] == 0.0
    assert set(errors) == {"r_err_deg", "t_err", "epe", "epe_l2_px", "rot_err_deg", "trans_err"}


def test_paper_epe_at_another_native_size():
    # 512x512 at f = 400: at 128x256 one has fx' = 200, fy' = 100; the same motion gives 1 and -1 px
    camera = Camera(400.0, 400.0, 255.5, 255.5, 512, 512)
    depth = np.full(camera.shape, 4.0)
    T_est = make_transform(np.eye(3), np.array([0.02, -0.04, 0.0]))
    errors = pair_errors(T_est, np.eye(4), depth, camera, camera)
    assert errors["epe"] == pytest.approx(1.0)
    assert errors["epe_l2_px"] == pytest.approx(np.sqrt(4 + 16))


def test_paper_epe_scales_the_principal_point_about_pixel_corners():
    # forward motion with a known focus of expansion: u' = (u - cx') z / z' + cx' at the small size,
    # cx' = (511 + 0.5) / 4 - 0.5 = 127.375, cy' = (200 + 0.5) / 2 - 0.5 = 99.75
    camera = Camera(400.0, 400.0, 511.0, 200.0, 256, 1024)
    T_est = make_transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    errors = pair_errors(T_est, np.eye(4), np.full(camera.shape, 5.0), camera, camera)
    u, v = np.arange(256.0), np.arange(128.0)
    expected = 0.25 * (np.abs(u - 127.375).mean() + np.abs(v - 99.75).mean()) / 2
    assert errors["epe"] == pytest.approx(expected)


def test_paper_epe_takes_the_nearest_depth_at_pixel_centres():
    # 384 rows, 3 to 1: centre of small row i is native row 3 i + 1; only those rows hold 4 m
    camera = Camera(200.0, 200.0, 127.5, 191.5, 384, 256)
    depth = np.full(camera.shape, 1e-3)
    depth[1::3] = 4.0
    T_est = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    assert pair_errors(T_est, np.eye(4), depth, camera, camera)["epe"] == pytest.approx(0.5)


def test_paper_epe_counts_invalid_and_long_flows_as_zero():
    depth = np.full(CAMERA.shape, 4.0)
    T_est = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    for bad in (0.0, -1.0, np.nan, np.inf):
        half = depth.copy()
        half[:64] = bad
        errors = pair_errors(T_est, np.eye(4), half, CAMERA, CAMERA)
        assert errors["epe"] == pytest.approx(0.25)  # (1 + 0) / 2 over all pixels, half of them 0
        assert errors["epe_l2_px"] == pytest.approx(1.0)  # over the valid ones
    # 8.1 m aside at 4 m: true ego flow 405 px, zeroed but counted; at 7.9 m: 395 px, kept
    for aside, expected in ((8.1, 0.0), (7.9, 0.5)):
        T_true = make_transform(np.eye(3), np.array([aside, 0.0, 0.0]))
        errors = pair_errors(T_true @ T_est, T_true, depth, CAMERA, CAMERA)
        assert errors["epe"] == pytest.approx(expected)
        assert errors["epe_l2_px"] == pytest.approx(1.0)


def test_no_valid_depth_is_none_not_nan():
    depth = np.zeros(CAMERA.shape)
    errors = pair_errors(np.eye(4), np.eye(4), depth, CAMERA, CAMERA)
    assert errors["epe"] is None and errors["epe_l2_px"] is None
    good = pair_errors(np.eye(4), np.eye(4), depth + 1, CAMERA, CAMERA)
    report = mean_pair_errors([errors, good])
    assert report["epe"] == 0.0
    assert "1 of 2 pairs" in report["reasons"]["epe"]
    empty = mean_pair_errors([])
    assert empty["pairs"] == 0 and empty["epe"] is None and "epe" in empty["reasons"]


def test_native_epe_equals_the_ego_flows_of_geometry(rng):
    prev = Camera(310.0, 290.0, 200.0, 90.0, 218, 401)
    curr = Camera(305.0, 295.0, 203.0, 92.0, 218, 401)
    depth = rng.uniform(1, 30, prev.shape)
    depth[rng.random(prev.shape) < 0.2] = np.nan
    depth[0, :4] = [0.0, -2.0, np.inf, 1e-9]
    T_true, T_est = se3_exp(0.05 * rng.standard_normal(6)), se3_exp(0.05 * rng.standard_normal(6))
    depth[0, 3] = np.nan
    flows = [ego_flow(depth, T, prev, curr) for T in (T_est, T_true)]
    expected = np.nanmean(np.linalg.norm(flows[0] - flows[1], axis=-1))
    got = pair_errors(T_est, T_true, depth, prev, curr)["epe_l2_px"]
    assert got == pytest.approx(expected, rel=1e-10)


def test_estimate_behind_the_camera_is_finite_and_costs_the_diagonal():
    T_est = make_transform(np.eye(3), np.array([0.0, 0.0, -9.0]))
    errors = pair_errors(T_est, np.eye(4), np.full(CAMERA.shape, 4.0), CAMERA, CAMERA)
    assert errors["epe_l2_px"] == pytest.approx(np.hypot(128, 256))
    assert np.isfinite(errors["epe"])


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([1e-6, 0.05, 1.0]))
def test_rotation_errors_against_scipy(seed, size):
    rng = np.random.default_rng(seed)
    R_est, R_true = (Rotation.from_rotvec(size * rng.uniform(-1, 1, 3)) for _ in range(2))
    T_est, T_true = (make_transform(R.as_matrix(), np.zeros(3)) for R in (R_est, R_true))
    errors = pair_errors(T_est, T_true, np.ones((4, 5)), *[Camera(9, 9, 2, 1.5, 4, 5)] * 2)
    difference = R_est.as_euler("XYZ", degrees=True) - R_true.as_euler("XYZ", degrees=True)
    difference = np.degrees(
        np.arctan2(np.sin(np.radians(difference)), np.cos(np.radians(difference)))
    )
    assert errors["r_err_deg"] == pytest.approx(np.abs(difference).mean(), rel=1e-6, abs=1e-11)
    geodesic = np.degrees((R_est * R_true.inv()).magnitude())
    assert errors["rot_err_deg"] == pytest.approx(geodesic, rel=1e-6, abs=1e-11)


def test_pair_errors_refuses_bad_input():
    depth = np.ones(CAMERA.shape)
    with pytest.raises(InputError, match="T_est: expected a finite"):
        pair_errors(np.full((4, 4), np.nan), np.eye(4), depth, CAMERA, CAMERA)
    with pytest.raises(InputError, match="depth: expected shape"):
        pair_errors(np.eye(4), np.eye(4), depth[:5], CAMERA, CAMERA)


def test_pair_errors_is_fast_enough(rng):
    # measured 9 ms alone on one core for all six; the limit leaves room for a loaded machine
    camera = Camera(1120.0, 1120.0, 511.5, 217.5, 436, 1024)
    depth = rng.uniform(1, 30, camera.shape).astype(np.float32)
    T = se3_exp(0.01 * np.ones(6))
    times = []
    for _ in range(5):
        start = time.perf_counter()
        pair_errors(T, np.eye(4), depth, camera, camera)
        times.append(time.perf_counter() - start)
    assert min(times) < 0.1


def test_mean_pair_errors_by_hand():
    pairs = [
        {
            "r_err_deg": 1.0,
            "t_err": 0.1,
            "epe": 2.0,
            "epe_l2_px": 3.0,
            "rot_err_deg": r,
            "trans_err": t,
        }
        for r, t in ((1.0, 0.1), (2.0, 0.2), (9.0, 0.6))
    ]
    report = mean_pair_errors(pairs)
    assert report["pairs"] == 3
    assert report["rot_err_deg_mean"] == pytest.approx(4.0)
    assert report["rot_err_deg_median"] == 2.0
    assert report["trans_err_mean"] == pytest.approx(0.3)
    assert report["trans_err_median"] == 0.2
    assert report["epe_l2_px"] == 3.0
    assert report["reasons"] == {}


def test_dynamic_fraction_by_hand():
    depth = np.full(CAMERA.shape, 4.0)
    T = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    flow = ego_flow(depth, T, CAMERA, CAMERA).astype(np.float32)
    assert dynamic_fraction(flow, depth, T, CAMERA, CAMERA) == 0.0
    flow[:32, :, 0] += 0.9  # a quarter moves by less than a pixel
    flow[32:64, :, 1] += 1.1  # a quarter by more
    assert dynamic_fraction(flow, depth, T, CAMERA, CAMERA) == 0.25
    flow[64:96] = np.nan  # unknown pixels do not count
    depth[96:] = 0.0
    assert dynamic_fraction(flow, depth, T, CAMERA, CAMERA) == 0.5
    flow[32:48] = 1.666e9  # Middlebury's unknown
    assert dynamic_fraction(flow, depth, T, CAMERA, CAMERA) == pytest.approx(1 / 3)
    assert dynamic_fraction(flow, depth * 0, T, CAMERA, CAMERA) is None


def test_ate_reads_what_write_tum_wrote(tmp_path, rng):
    truth = random_trajectory(rng)
    write_tum(truth, tmp_path / "t")
    assert ate(read_trajectory(tmp_path / "t"), truth).rmse == pytest.approx(0, abs=1e-12)
