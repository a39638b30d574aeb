"""A gyroscope beside the images: what it lets expect, and the bias that the images show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import invert, make_transform
from hybridvo.core.results import MotionPrior, RelativePose
from hybridvo.io.data.open import open_sequence
from hybridvo.solver.rotation_factor import with_rotation
from hybridvo.tracking import tracker as tracking
from hybridvo.tracking.gyroscope import Gyroscope
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene
from tests import bags, captures, slow_walk
from tests.io.data.test_stereo import euroc_folder
from tests.io.data.test_video import stray

RATE_HZ = 200
FRAME_S = 1 / 30
BIAS = np.array([0.05, -0.03, 0.02])
R_CAM_IMU = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def samples_between(
    start: float, turn: np.ndarray, bias: np.ndarray = BIAS
) -> hvo.ImuSamples:
    """What a sensor measures while the camera turns by a rotation vector in a frame's time."""
    stamps = start + np.arange(0, FRAME_S, 1 / RATE_HZ)
    rate = R_CAM_IMU.T @ turn / FRAME_S + bias
    return hvo.ImuSamples(stamps, np.tile(rate, (len(stamps), 1)), R_CAM_IMU)


def step_of(turn: np.ndarray, stamp: float) -> hvo.Step:
    """A sure step, whose rotation the images found to a hundredth of a degree."""
    R_prev_curr = Rotation.from_rotvec(turn).as_matrix()
    T = make_transform(R_prev_curr.T, np.zeros(3))
    covariance = np.diag([1e-6] * 3 + [np.deg2rad(0.01) ** 2] * 3)
    return hvo.Step(1, stamp, np.eye(4), RelativePose(T, covariance), 0)


def test_the_bias_is_learned_from_steps() -> None:
    gyroscope = Gyroscope()
    rng = np.random.default_rng(0)
    for k in range(90):
        turn = rng.normal(0, 0.02, 3)
        start = k * FRAME_S
        gyroscope = gyroscope.after(samples_between(start, turn))
        step = step_of(turn, start + FRAME_S)
        gyroscope = gyroscope.corrected(step, start, start + FRAME_S)
        gyroscope = gyroscope.since(start + FRAME_S)
    np.testing.assert_allclose(gyroscope.bias, BIAS, atol=2e-3)
    # it knows how well it knows it, and keeps no more than it needs
    assert 1e-4 < np.sqrt(gyroscope.covariance[0, 0]) < 5e-3
    assert len(gyroscope.samples) < 40


SWAPPED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("fault", "is_false"),
    [
        (np.eye(3), False),
        (SWAPPED, True),
        (np.diag([1.0, -1, 1]), True),
        (np.rad2deg(1) * np.eye(3), True),
    ],
)
def test_a_gyroscope_that_contradicts_the_images_is_left_out(
    fault: np.ndarray, is_false: bool
) -> None:
    gyroscope = Gyroscope()
    rng = np.random.default_rng(0)
    for k in range(40):
        turn = rng.normal(0, 0.02, 3)
        start = k * FRAME_S
        gyroscope = gyroscope.after(samples_between(start, fault @ turn))
        step = step_of(turn, start + FRAME_S)
        if k == 10:
            # one step is wrong, and sure
            step = step_of(turn + 0.5, start + FRAME_S)
        gyroscope = gyroscope.corrected(step, start, start + FRAME_S)
    assert gyroscope.contradicts_images == is_false
    measured = gyroscope.measured(39 * FRAME_S, 40 * FRAME_S)
    assert (measured is None) == is_false


def test_what_the_gyroscope_added_to_a_step_teaches_nothing() -> None:
    """The bias is that of the images alone, whether or not the step holds its rotation."""
    gyroscope = Gyroscope().after(samples_between(0, np.zeros(3)))
    gyroscope = replace(gyroscope, covariance=0.02**2 * np.eye(3))
    alone = step_of(np.array([0.001, -0.002, 0.0]), FRAME_S)
    measured = gyroscope.measured(0, FRAME_S)
    assert measured is not None
    joint = with_rotation(alone.motion, measured)
    rotations = [each.covariance[3:, 3:] for each in (joint, alone.motion)]
    assert np.trace(rotations[0]) < 0.97 * np.trace(rotations[1])
    by_images = gyroscope.corrected(alone, 0, FRAME_S)
    by_both = gyroscope.corrected(replace(alone, motion=joint), 0, FRAME_S)
    np.testing.assert_allclose(by_both.bias, by_images.bias, rtol=1e-3)
    np.testing.assert_allclose(by_both.covariance, by_images.covariance, rtol=1e-3)

    # what it added nearly alone
    blurred = replace(
        alone, motion=alone.motion.replace(covariance=1e-2 * np.eye(6))
    )
    joint = with_rotation(blurred.motion, measured)
    after = gyroscope.corrected(replace(blurred, motion=joint), 0, FRAME_S)
    assert not after.bias.any()


def test_a_blurred_frame_leans_on_the_gyroscope() -> None:
    frames, poses = slow_walk.frames("static", seed=6, count=6, stride=4)
    at = 4
    soft = cv2.GaussianBlur(frames[at].rgb, (0, 0), 2.5)
    frames[at] = replace(frames[at], rgb=soft)
    errors = []
    for has_gyroscope in (False, True):
        tracker = hvo.Odometry()
        for k, frame in enumerate(frames[: at + 1]):
            imu = None
            if k and has_gyroscope:
                T = invert(poses[k]) @ poses[k - 1]
                turn = Rotation.from_matrix(T[:3, :3].T).as_rotvec()
                imu = samples_between((k - 1) / 30, turn, np.zeros(3))
            step = tracker.track(frame, imu=imu)
        assert ("gyroscope" in step.motion.terms) is has_gyroscope
        true = invert(poses[at]) @ poses[step.prev_index]
        turned = step.T_curr_prev[:3, :3] @ true[:3, :3].T
        errors.append(Rotation.from_matrix(turned).magnitude())
    assert errors[1] < 0.9 * errors[0]


def test_a_step_that_is_not_sure_teaches_nothing() -> None:
    gyroscope = Gyroscope().after(samples_between(0, np.zeros(3)))
    failed = hvo.Step(
        1, FRAME_S, np.eye(4), RelativePose.failed(hvo.Reason.LOW_INLIERS, ""), 0
    )
    after = gyroscope.corrected(failed, 0, FRAME_S)
    assert not after.bias.any()
    assert after.covariance[0, 0] > gyroscope.covariance[0, 0]


def test_the_rotation_is_measured_and_the_translation_goes_on() -> None:
    turn = np.array([0.0, 0.1, 0.0])
    gyroscope = Gyroscope().after(samples_between(0, turn, np.zeros(3)))
    T = make_transform(np.eye(3), np.array([0.0, 0.0, -0.02]))
    expected = MotionPrior(T, np.diag([1e-4] * 3 + [1e-2] * 3))
    prior = gyroscope.prior(0, FRAME_S, expected)
    assert prior is not None
    found = Rotation.from_matrix(prior.T_curr_prev[:3, :3].T).as_rotvec()
    np.testing.assert_allclose(found, turn, atol=1e-6)
    np.testing.assert_allclose(prior.T_curr_prev[:3, 3], T[:3, 3])
    np.testing.assert_allclose(np.diag(prior.covariance)[:3], 1e-4)
    # where samples are missing the velocity alone is left
    assert gyroscope.prior(0, 1.0, expected) is expected
    assert gyroscope.prior(-1.0, FRAME_S, None) is None


def test_a_tracker_learns_the_bias_and_expects_the_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = make_scene("static", 3, height=96, width=160, frames=6)
    frames = [SyntheticSequence(scene)[i] for i in range(6)]
    tracker = hvo.Odometry()
    priors = []
    follow = tracking.follow

    def spied(setup, state, arrival):
        priors.append(arrival.given)
        return follow(setup, state, arrival)

    monkeypatch.setattr(tracking, "follow", spied)
    truth = [invert(T) @ scene.T_world_cam[0] for T in scene.T_world_cam]
    for k, frame in enumerate(frames):
        imu = None
        if k:
            motion = truth[k] @ invert(truth[k - 1])
            turn = Rotation.from_matrix(motion[:3, :3].T).as_rotvec()
            # the test's clock, so that a frame takes the time for which rates are made
            imu = samples_between((k - 1) * FRAME_S, turn)
        stamped = hvo.Frame(frame.rgb, frame.depth, frame.camera, k * FRAME_S, k)
        step = tracker.track(stamped, imu=imu)
        assert step.usable
    gyroscope = tracker.state.sensors.gyroscope
    assert gyroscope is not None
    np.testing.assert_allclose(gyroscope.bias, BIAS, atol=0.02)
    # the last turn was expected before the images were looked at
    motion = truth[5] @ invert(truth[4])
    error = priors[5].T_curr_prev[:3, :3] @ motion[:3, :3].T
    assert Rotation.from_matrix(error).magnitude() < 0.02 * FRAME_S


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((np.array([1.0, 0.0]), np.zeros((2, 3))), "that rise"),
        ((np.arange(2.0), np.zeros((3, 3))), "rates: expected finite numbers"),
        ((np.arange(2.0), np.full((2, 3), np.nan)), "rates: expected finite"),
        ((np.arange(2.0), np.zeros((2, 3)), 2 * np.eye(3)), "R_cam_imu"),
        ((np.arange(2.0), np.zeros((2, 3)), None, np.zeros(2)), "accelerations"),
    ],
)
def test_samples_that_cannot_be_are_refused(arguments: tuple, words: str) -> None:
    with pytest.raises(hvo.InputError, match=words):
        hvo.ImuSamples(*arguments)


def test_samples_are_joined_parted_and_moved_to_another_clock() -> None:
    early = hvo.ImuSamples(
        np.array([0.0, 0.1]), np.zeros((2, 3)), None, np.ones((2, 3))
    )
    late = hvo.ImuSamples(
        np.array([0.1, 0.2]), np.ones((2, 3)), R_CAM_IMU, np.full((2, 3), 2.0)
    )
    joined = early.joined(late)
    np.testing.assert_array_equal(joined.stamps, [0, 0.1, 0.2])
    np.testing.assert_array_equal(joined.accelerations[:, 0], [1, 1, 2])
    np.testing.assert_array_equal(joined.R_cam_imu, R_CAM_IMU)
    assert early.joined(replace(late, accelerations=None)).accelerations is None
    np.testing.assert_allclose(joined.shifted(5.0).stamps, [5, 5.1, 5.2])
    part = joined.part(1)
    np.testing.assert_array_equal(part.stamps, [0.1, 0.2])
    assert part.accelerations is not None and len(part.accelerations) == 2


def test_something_else_than_samples_is_refused() -> None:
    frame = hvo.Frame(
        None, np.ones((4, 4)), hvo.Camera(4, 4, 1.5, 1.5, height=4, width=4)
    )
    with pytest.raises(hvo.InputError, match="imu"):
        hvo.Odometry().track(frame, imu=np.zeros((3, 3)))  # type: ignore[arg-type]


# -- readers ---------------------------------------------------------------------------------------


def test_samples_of_euroc_are_those_of_the_rectified_camera(tmp_path: Path) -> None:
    sequence = open_sequence(captures.with_imu(euroc_folder(tmp_path)))
    start, end = sequence.timestamps[:2]
    imu = sequence.imu(start, end)
    # one before the first frame's, and those up to the second's
    assert imu is not None and len(imu) in (10, 11)
    assert sequence.poses is not None and sequence.R_cam_imu is not None
    # the body does not turn in the truth: its axes are those of the world
    about_x = sequence.poses[0, :3, :3].T @ [0.1, 0, 0]
    np.testing.assert_allclose(imu.R_cam_imu @ imu.rates[0], about_x, atol=1e-9)
    assert imu.accelerations is not None and imu.accelerations[0, 2] == 9.81
    assert sequence.imu(end + 100, end + 101) is None or len(imu)
    # what a recorder of the gyroscope alone writes
    assert sequence.imu_samples is not None
    sequence.imu_samples[:, 4:] = 0
    alone = sequence.imu(start, end)
    assert alone is not None and alone.accelerations is None


def test_samples_of_a_phone_come_out_of_the_child(tmp_path: Path) -> None:
    root = stray(tmp_path)
    lines = ["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"]
    # upright in the image as it is stored: the phone's left side hangs down
    lines += [f"{99.9 + k / 100}, -9.8, 0, 0, 0.2, 0, 0" for k in range(30)]
    (root / "imu.csv").write_text("\n".join(lines) + "\n")
    sequence = open_sequence(root)
    imu = sequence.imu(*sequence.timestamps[:2])
    assert imu is not None
    # about the phone's x, its right side: upwards in the image as it is stored
    np.testing.assert_allclose(imu.R_cam_imu @ imu.rates[0], [0, -0.2, 0])
    # a phone reads gravity, not the force against it
    assert imu.accelerations is not None
    up = imu.R_cam_imu @ imu.accelerations[0]
    np.testing.assert_allclose(up, [0, -9.8, 0])
    # the app was ended while it wrote
    (root / "imu.csv").write_text("\n".join([*lines, "100.3, 0, -9"]) + "\n")
    sequence = open_sequence(root)
    assert "1 of 31 rows of imu.csv are left out" in " ".join(sequence.warnings)
    assert sequence.imu_samples is not None and len(sequence.imu_samples) == 30


@pytest.mark.parametrize("is_fixed", [True, False])
def test_samples_of_a_bag_need_to_know_how_the_sensor_is_fixed(
    is_fixed: bool, tmp_path: Path
) -> None:
    writer = bags.Writer(tmp_path, "mcap")
    if is_fixed:
        # the sensor's x is the camera's z
        quarter = Rotation.from_matrix(
            [[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]
        ).as_quat()
        place = writer.transform("color", "imu", (0, 0, 0), quarter)
        writer.write("/tf_static", writer.tf(place), bags.START)
    writer.write(bags.INFO, writer.info(), bags.START)
    for i in range(3):
        stamp = bags.stamp(i)
        image = writer.image(bags.rgb(i), "rgb8", stamp)
        depth = writer.image(bags.millimetres(i), "16UC1", stamp)
        writer.write(bags.RGB, image, stamp)
        writer.write(bags.DEPTH, depth, stamp)
        for k in range(4):
            when = stamp + 8_000_000 * k
            message = writer.make(
                "sensor_msgs/msg/Imu",
                header=writer.header(when, "imu"),
                orientation=writer.quaternion((0, 0, 0, 1)),
                orientation_covariance=np.zeros(9),
                angular_velocity=writer.vector((0.5, 0, 0)),
                angular_velocity_covariance=np.zeros(9),
                linear_acceleration=writer.vector((0, 0, 9.8)),
                linear_acceleration_covariance=np.zeros(9),
            )
            writer.write("/imu", message, when)
    sequence = open_sequence(writer.close())
    imu = sequence.imu(*sequence.timestamps[:2])
    if not is_fixed:
        assert imu is None
        assert "/imu is not used: no /tf_static between" in " ".join(
            sequence.warnings
        )
        return
    assert imu is not None and len(imu) == 4
    np.testing.assert_allclose(
        imu.R_cam_imu @ imu.rates[0], [0, 0, 0.5], atol=1e-12
    )
