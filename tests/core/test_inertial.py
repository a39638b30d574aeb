"""The rotation between two frames by a gyroscope."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hybridvo as hvo


def test_a_constant_rate_turns_by_rate_times_time():
    stamps = np.arange(0, 1, 0.005)
    rates = np.tile([0.1, -0.2, 0.3], (len(stamps), 1))
    # between two stamps, and to a time between two others
    prior = hvo.gyro_prior(stamps, rates, 0.1012, 0.6034)
    turned = Rotation.from_rotvec(np.array([0.1, -0.2, 0.3]) * 0.5022)
    np.testing.assert_allclose(
        prior.T_curr_prev[:3, :3], turned.as_matrix().T, atol=1e-12
    )
    # rotation known to noise density sqrt(s), translation to speed times time
    deviations = np.sqrt(np.diag(prior.covariance))
    np.testing.assert_allclose(deviations[:3], 0.5022)
    np.testing.assert_allclose(deviations[3:], 2e-3 * np.sqrt(0.5022))


def test_the_axes_of_the_sensor_become_those_of_the_camera():
    # the sensor's x is the camera's z
    R_cam_imu = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    prior = hvo.gyro_prior(
        np.array([0.0]), np.array([[0.5, 0, 0]]), 0.0, 0.1, R_cam_imu
    )
    found = Rotation.from_matrix(prior.T_curr_prev[:3, :3]).as_rotvec()
    np.testing.assert_allclose(found, [0, 0, -0.05], atol=1e-12)


@pytest.mark.parametrize(
    ("stamps", "rates", "start", "end"),
    [
        ([0.0, 0.1], [[0, 0, 0]], 0.0, 0.1),
        ([0.1, 0.0], [[0, 0, 0]] * 2, 0.1, 0.2),
        ([0.1], [[0, 0, 0]], 0.0, 0.2),
        ([0.0], [[0, 0, np.nan]], 0.0, 0.2),
        ([0.0], [[0, 0, 0]], 0.2, 0.2),
        ([], np.zeros((0, 3)), 0.0, 0.2),
    ],
)
def test_rates_that_do_not_cover_the_motion_are_refused(stamps, rates, start, end):
    with pytest.raises(hvo.InputError, match="gyro_prior"):
        hvo.gyro_prior(np.array(stamps, float), np.array(rates, float), start, end)


@pytest.mark.parametrize("lost", [slice(0, 0), slice(60, 81), slice(100, None)])
def test_lost_samples_are_refused_rather_than_bridged(lost):
    stamps = np.delete(np.arange(0, 0.6, 0.005), lost)
    rates = np.tile([0.1, 0, 0], (len(stamps), 1))
    if lost == slice(0, 0):
        hvo.gyro_prior(stamps, rates, 0.05, 0.6)
        return
    # 0.105 s inside, and as long at the end
    with pytest.raises(hvo.InputError, match="at least every"):
        hvo.gyro_prior(stamps, rates, 0.05, 0.601)


@pytest.mark.parametrize(
    "given",
    [
        {"R_cam_imu": np.eye(4)},
        {"R_cam_imu": [["x"] * 3] * 3},
        {"bias": np.zeros(2)},
        # one number would be taken for all axes
        {"bias": 0.1},
    ],
)
def test_a_mount_or_a_bias_of_another_shape_is_refused(given):
    with pytest.raises(hvo.InputError, match=next(iter(given))):
        hvo.gyro_prior(np.zeros(1), np.zeros((1, 3)), 0.0, 0.1, **given)


def test_a_recorded_gyroscope_agrees_with_the_true_rotation(shared_data):
    euroc = shared_data / "euroc_v1_01"
    imu = np.loadtxt(euroc / "mav0/imu0/data.csv", delimiter=",")
    poses = np.loadtxt(euroc / "cam0_poses.txt")
    # rows of T_BS in cam0/sensor.yaml: camera to body, which is the sensor
    R_imu_cam = np.array(
        [
            [0.0148655429818, -0.999880929698, 0.00414029679422],
            [0.999557249008, 0.0149672133247, 0.025715529948],
            [-0.0257744366974, 0.00375618835797, 0.999660727178],
        ]
    )
    # nanoseconds lose their last digits in doubles: far less than 5 ms
    first = imu[0, 0]
    stamps = (imu[:, 0] - first) / 1e9
    frames = poses[:, 0] - first / 1e9
    # no TUM file: from the world to the camera, the scalar first
    R = Rotation.from_quat(poses[:, [5, 6, 7, 4]]).inv().as_matrix()
    is_covered = (frames >= stamps[0]) & (frames <= stamps[-1])
    frames = frames[is_covered]
    R = R[is_covered]

    # the drone all but stands: its bias is what the sensor reads beyond the true rate
    turned = Rotation.from_matrix(R[0].T @ R[-1]).as_rotvec()
    true_rate = R_imu_cam @ turned / (frames[-1] - frames[0])
    inside = (stamps >= frames[0]) & (stamps < frames[-1])
    bias = imu[inside, 1:4].mean(0) - true_rate

    errors = []
    for k in range(len(frames) - 1):
        prior = hvo.gyro_prior(
            stamps, imu[:, 1:4], frames[k], frames[k + 1], R_imu_cam.T, bias=bias
        )
        R_true = R[k + 1].T @ R[k]
        error = Rotation.from_matrix(prior.T_curr_prev[:3, :3] @ R_true.T)
        errors.append(np.rad2deg(error.magnitude()))
    assert len(errors) >= 20
    # a frame's true rotation is known to some hundredths of a degree
    assert np.median(errors) < 0.05
    assert max(errors) < 0.15
