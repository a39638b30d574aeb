from __future__ import annotations

import json

import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
from evo.core.sync import associate_trajectories
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import make_transform, se3_exp
from hybridvo.core.trajectory import Trajectory, read_trajectory
from hybridvo_lab.evaluation.metrics import (
    ate,
    evaluate,
    kitti_drift,
    match,
    rpe,
    umeyama,
)
from tests.walks import chained


def random_trajectory(rng: np.random.Generator, frames: int = 40) -> Trajectory:
    relative = [se3_exp(0.2 * rng.standard_normal(6)) for _ in range(frames - 1)]
    return chained(relative, np.arange(frames) * 0.1)


def perturbed(
    trajectory: Trajectory, rng: np.random.Generator, size: float = 0.05
) -> Trajectory:
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
    report = evaluate(*official)
    exact = {"rel": 1e-6}
    assert report["ate_rmse"] == pytest.approx(1.2045074393, **exact)
    assert report["kitti_drift"]["rotation_deg_per_m"] == pytest.approx(
        0.0229947185, **exact
    )
    assert report["kitti_drift"]["translation"] == pytest.approx(
        0.0271438892, **exact
    )
    # TartanAir's lengths
    short = kitti_drift(match(*map(read_trajectory, official)), range(5, 45, 5))
    assert short["rotation_deg_per_m"] == pytest.approx(0.0798719448, **exact)
    assert short["translation"] == pytest.approx(0.0749175164, **exact)
    assert report["alignment"] == "se3"
    assert (report["matched"], report["total"]) == (734, 734)
    assert report["reasons"] == {}
    assert json.loads(json.dumps(report, allow_nan=False)) == report


# -- ATE and RPE ----------------------------------------------------------------------------------


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_errors_do_not_depend_on_the_world(seed):
    rng = np.random.default_rng(seed)
    truth = random_trajectory(rng, 10)
    est = perturbed(truth, rng)
    moved = est.transformed(se3_exp(rng.standard_normal(6)))
    for alignment in ("se3", "sim3", "origin"):
        a, b = (ate(match(path, truth), alignment) for path in (est, moved))
        assert a.rmse == pytest.approx(b.rmse, rel=1e-9)
    errors = [rpe(match(path, truth))[1] for path in (est, moved)]
    np.testing.assert_allclose(*errors, rtol=1e-6)


def test_ate_by_hand():
    truth = from_positions([[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    est = from_positions([[0, 0, 3], [1, 0, 3], [1, 1, 4]])
    report = evaluate(est, truth, alignment="none")
    assert report["ate_rmse"] == pytest.approx(np.sqrt((9 + 9 + 16) / 3))
    assert report["ate_rmse_unaligned"] == report["ate_rmse"]
    assert ate(match(est, truth), "origin").rmse == pytest.approx(np.sqrt(1 / 3))


def test_rpe_by_hand():
    # the truth goes 1 m a frame; the estimate 1.1 m, and turns by 2 deg a frame about y
    truth = from_positions([[0, 0, k] for k in range(5)])
    step = make_transform(
        Rotation.from_euler("y", 2, degrees=True).as_matrix(), [0, 0, 1.1]
    )
    T = [np.eye(4)]
    for _ in range(4):
        T.append(T[-1] @ step)
    est = Trajectory(truth.timestamps, np.array(T))
    report = evaluate(est, truth)
    assert report["rpe_trans_rmse"] == pytest.approx(0.1)
    assert report["rpe_rot_rmse_deg"] == pytest.approx(2.0)
    found = match(est, truth)
    np.testing.assert_allclose(rpe(found, delta=2)[1], [4.0, 4.0, 4.0])
    # two frames are 0.2 s; what lies further than half a frame from the wanted time is no partner
    for seconds in (0.2, 0.22):
        np.testing.assert_allclose(rpe(found, seconds, "s")[1], [4.0] * 3)
    report = evaluate(est, truth, delta=10.0, delta_unit="s")
    assert (
        report["rpe_trans_rmse"] is None
        and "10 s" in report["reasons"]["rpe_trans_rmse"]
    )


def test_rpe_over_seconds_skips_a_gap():
    stamps = np.array([0.0, 0.1, 0.2, 0.5, 0.6])
    truth = from_positions([[0, 0, t] for t in stamps], stamps)
    est = from_positions([[0, 0, 1.1 * t] for t in stamps], stamps)
    found = match(est, truth)  # 0.2 to 0.5 is no tenth of a second
    np.testing.assert_allclose(rpe(found, 0.1, "s")[0], [0.01] * 3)
    assert len(rpe(found, 1)[0]) == 4


def as_evo(path: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        poses_se3=list(path.T_world_cam), timestamps=path.timestamps
    )


def rmse(metric: APE | RPE, gt: PoseTrajectory3D, est: PoseTrajectory3D) -> float:
    metric.process_data((gt, est))
    return metric.get_statistic(StatisticsType.rmse)


@pytest.mark.parametrize("alignment", ["se3", "sim3", "origin", "none"])
@pytest.mark.parametrize("poses", [(40, 90), (90, 40), (40, 40)])
def test_figures_are_those_of_evo(alignment, poses, rng):
    """Stamps of their own: some poses match none, and none or several are as near."""
    paths = []
    for count in poses:
        stamps = np.sort(rng.uniform(0, 4, count))
        relative = [se3_exp(0.2 * rng.standard_normal(6)) for _ in stamps[1:]]
        paths.append(chained(relative, stamps))
    report = evaluate(*paths, alignment=alignment, delta=3, max_diff=0.05)
    est, gt = associate_trajectories(*map(as_evo, paths), max_diff=0.05)
    assert 0 < len(est.timestamps) < 40
    assert report["matched"] == len(est.timestamps)
    apart = 3, Unit.frames
    expected = [
        rmse(RPE(kind, *apart, all_pairs=True), gt, est)
        for kind in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
    ]
    scale = 1.0
    if alignment == "origin":
        est.align_origin(gt)
    elif alignment != "none":
        _, _, scale = est.align(gt, correct_scale=alignment == "sim3")
    expected += [rmse(APE(PoseRelation.translation_part), gt, est), scale]
    keys = ("rpe_trans_rmse", "rpe_rot_rmse_deg", "ate_rmse", "scale")
    # rounding: 1e-15 of the figures
    assert [report[key] for key in keys] == pytest.approx(expected, rel=1e-9)


def test_a_mirror_image_is_aligned_by_a_rotation_as_evo_does(rng):
    points = rng.standard_normal((20, 3))
    targets = points * [1, 1, -1]
    for with_scale in (False, True):
        R, t, scale = umeyama_alignment(points.T, targets.T, with_scale)
        found, found_scale = umeyama(points, targets, with_scale=with_scale)
        np.testing.assert_allclose(found, make_transform(R, t), atol=1e-12)
        assert found_scale == pytest.approx(scale, rel=1e-12)


def test_errors_over_frames_and_over_as_many_seconds_are_equal(rng):
    truth = random_trajectory(rng, 12)
    matched = match(perturbed(truth, rng), truth)
    np.testing.assert_array_equal(rpe(matched, 3), rpe(matched, 0.3, "s"))


def test_rotations_that_are_off_by_as_much_as_is_allowed_are_compared(rng):
    truth = random_trajectory(rng)
    stretched = truth.T_world_cam.copy()
    stretched[:, :3, :3] *= 1 + 4e-7
    report = evaluate(Trajectory(truth.timestamps, stretched), truth)
    assert report["reasons"].keys() == {"kitti_drift"}
    assert report["rpe_rot_rmse_deg"] < 1e-5


# -- what cannot be computed ----------------------------------------------------------------------


@pytest.mark.parametrize("frames", [1, 2])
def test_one_and_two_poses(frames):
    trajectory = from_positions(np.eye(3)[:frames])
    report = evaluate(trajectory, trajectory)
    assert report["ate_rmse"] is None
    assert "not enough poses" in report["reasons"]["ate_rmse"]
    assert report["ate_rmse_unaligned"] == report["ate_rmse_origin"] == 0.0
    assert report["rpe_trans_rmse"] == (None if frames == 1 else 0.0)
    assert "shorter than" in report["reasons"]["kitti_drift"]
    json.dumps(report, allow_nan=False)


def test_few_matches_give_no_number():
    positions = np.random.default_rng(4).normal(size=(50, 3))
    truth = from_positions(positions)
    # nanoseconds read as seconds elsewhere: one stamp of fifty meets
    report = evaluate(from_positions(positions, truth.timestamps * 1000), truth)
    assert (report["matched"], report["total"]) == (1, 50)
    for key in (
        "ate_rmse",
        "ate_rmse_unaligned",
        "rpe_rot_rmse_deg",
        "kitti_drift",
    ):
        assert report[key] is None
        assert "only 1 of 50 poses match" in report["reasons"][key]
    nothing = evaluate(from_positions(positions, truth.timestamps + 1e6), truth)
    assert nothing["matched"] == 0 and nothing["ate_rmse"] is None


# -- association ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dense_truth", [True, False])
def test_poses_match_by_the_nearest_stamp(dense_truth):
    """Stamps at 100 Hz beside ones at 10 Hz that are late by 4 ms: each has the one before it."""
    dense = from_positions(np.zeros((100, 3)), np.arange(100) / 100)
    late = from_positions(np.zeros((10, 3)), np.arange(10) / 10 + 0.004)
    matched = match(late, dense) if dense_truth else match(dense, late)
    assert matched.by == "time" and matched.reason == ""
    expected = np.arange(10) / 10 + (0.0 if dense_truth else 0.004)
    np.testing.assert_allclose(matched.stamps, expected, atol=1e-12)


def test_a_pose_that_is_too_late_has_no_match():
    truth = from_positions(np.arange(30).reshape(10, 3))
    stamps = truth.timestamps.copy()
    stamps[4] += 0.03
    est = from_positions(np.arange(30).reshape(10, 3), stamps)
    matched = match(est, truth, 0.02)
    kept = np.delete(np.arange(10), 4)
    np.testing.assert_array_equal(matched.stamps, truth.timestamps[kept])
    np.testing.assert_array_equal(matched.est, est.T_world_cam[kept])
    assert len(match(est, truth, 0.04).stamps) == 10


def test_files_without_stamps_match_by_index():
    stamped = from_positions(np.eye(3))
    plain = Trajectory(np.arange(3), stamped.T_world_cam, has_timestamps=False)
    assert (
        match(plain, stamped).by == "index" and len(match(plain, stamped).est) == 3
    )
    short = Trajectory([0, 1], stamped.T_world_cam[:2], has_timestamps=False)
    report = evaluate(short, stamped)
    assert report["ate_rmse"] is None
    assert (
        "the estimate has 2 and the ground truth 3" in report["reasons"]["ate_rmse"]
    )


PATH = from_positions(np.eye(3))


@pytest.mark.parametrize(
    ("arguments", "options", "field"),
    [
        ((PATH, PATH), {"alignment": "affine"}, "alignment"),
        ((PATH, PATH), {"alignment": np.eye(2)}, "alignment"),
        ((PATH, PATH), {"delta": 1.5}, "delta"),
        ((PATH, PATH), {"delta": None}, "delta"),
        ((PATH, PATH), {"delta": np.inf}, "delta"),
        ((PATH, PATH), {"delta_unit": "m"}, "delta_unit"),
        ((PATH, PATH), {"max_diff": -1.0}, "max_diff"),
        ((PATH, PATH), {"max_diff": "soon"}, "max_diff"),
        ((3, PATH), {}, "estimate"),
        ((PATH, from_positions([[0, 0, 0], [1e200, 0, 0]])), {}, "gt"),
        ((PATH, np.eye(4)), {}, "gt"),
    ],
)
def test_bad_arguments(arguments, options, field):
    with pytest.raises(InputError, match=f"{field}: expected .*, got"):
        evaluate(*arguments, **options)


def test_files_that_cannot_be_read_and_spans_without_end(tmp_path):
    for name in ("x" * 300, "", "nul\0", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            evaluate(name, PATH)
    # beyond every float
    with pytest.raises(InputError, match="delta"):
        evaluate(PATH, PATH, delta=10**400)
    assert evaluate(PATH, PATH, delta=10**20)["rpe_trans_rmse"] is None


def test_every_key_is_documented():
    for key in evaluate(PATH, PATH):
        assert f"``{key}``" in evaluate.__doc__


# -- KITTI drift ----------------------------------------------------------------------------------


def test_drift_by_hand():
    # truth: 1 m a frame along z, 0 to 12 m. Estimate: 1.02 m a frame. Length 10 m: the first frame
    # strictly beyond it is 11 frames on, so starts 0 and 1, error 11 * 0.02 = 0.22 m over 10 m.
    gt, est = (
        from_positions([[0, 0, size * k] for k in range(13)])
        for size in (1.0, 1.02)
    )
    drift = kitti_drift(match(est, gt), lengths=[10])
    assert drift["translation"] == pytest.approx(0.022)
    assert drift["rotation_deg_per_m"] == 0.0
    # lengths 5 (6 frames on, 0.12 / 5) and 10: the mean of the lengths that occur
    both = kitti_drift(match(est, gt), lengths=[5, 10, 100])
    assert both["translation"] == pytest.approx((0.024 + 0.022) / 2)
