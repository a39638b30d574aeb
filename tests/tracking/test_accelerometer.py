"""An accelerometer beside the images: the direction of gravity in the tracker's world."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import hybridvo as hvo
from hybridvo.core.geometry import invert, make_transform
from hybridvo.core.results import RelativePose
from hybridvo.run.commands.stored_state import restored, saved
from hybridvo.tracking.accelerometer import Accelerometer
from hybridvo_lab.synthetic.render import SyntheticSequence
from hybridvo_lab.synthetic.scenes import make_scene

RATE_HZ = 200
FRAME_S = 1 / 30
G = 9.80665
NO_BIAS = np.zeros(3)
EXACT = np.diag([1e-12] * 6)


def step_at(
    stamp: float, R_world_cam: np.ndarray | None = None, covariance=EXACT
) -> hvo.Step:
    R = np.eye(3) if R_world_cam is None else R_world_cam
    motion = RelativePose(covariance=covariance)
    return hvo.Step(1, stamp, make_transform(R, np.zeros(3)), motion, 0)


def readings(
    start: float,
    force: np.ndarray,
    rate: np.ndarray = NO_BIAS,
    R_cam_imu: np.ndarray | None = None,
) -> hvo.ImuSamples:
    """Samples of a frame's time, with one rate and one reading, or (N, 3) of them."""
    stamps = start + (np.arange(6) + 1) / (6 / FRAME_S)
    return hvo.ImuSamples(
        stamps,
        np.tile(rate, (6, 1)),
        R_cam_imu,
        np.broadcast_to(force, (6, 3)).copy(),
    )


def after(samples: hvo.ImuSamples, step: hvo.Step) -> hvo.Gravity:
    found = Accelerometer().after(samples, NO_BIAS, step).gravity()
    assert found is not None
    return found


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    """The angle between two unit vectors."""
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


# -- conventions ---------------------------------------------------------------------------


def test_a_level_camera_at_rest_reads_upwards() -> None:
    found = after(readings(0, np.array([0, -G, 0])), step_at(FRAME_S))
    np.testing.assert_allclose(found.direction, [0, 1, 0], atol=1e-12)
    along = found.T_gravity_world[:3, :3] @ [0, 0, 1]
    np.testing.assert_allclose(along, [1, 0, 0], atol=1e-12)
    # nothing is said of a change along the direction
    np.testing.assert_allclose(found.covariance @ found.direction, 0, atol=1e-15)


def test_a_camera_that_was_level_once_and_looks_down_now() -> None:
    up = np.array([0, -np.sqrt(3) / 2, -0.5])
    # looking down turns about -x: what was level before lies above the middle
    R_world_cam = Rotation.from_rotvec([-np.pi / 6, 0, 0]).as_matrix()
    np.testing.assert_allclose(R_world_cam @ up, [0, -1, 0], atol=1e-12)
    found = after(readings(0, G * up), step_at(FRAME_S, R_world_cam))
    np.testing.assert_allclose(found.direction, [0, 1, 0], atol=1e-12)


def test_axes_of_the_sensor_become_those_of_the_camera() -> None:
    # EuRoC's sensor: its x points up, its z to the back
    R_cam_imu = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    found = after(
        readings(0, np.array([G, 0, 0]), R_cam_imu=R_cam_imu), step_at(FRAME_S)
    )
    np.testing.assert_allclose(found.direction, [0, 1, 0], atol=1e-12)


def test_samples_are_turned_to_the_time_of_the_frame() -> None:
    """A camera that rolls by 3 rad/s, which is six degrees a frame."""
    rate = np.array([0, 0, 3.0])
    samples = readings(0, np.zeros(3), rate)
    up_at_end = np.array([0, -1.0, 0])
    # before it has rolled, up is where it will be after the rest of the roll
    forces = [
        G * Rotation.from_rotvec(rate * (FRAME_S - stamp)).apply(up_at_end)
        for stamp in samples.stamps
    ]
    samples = dataclasses.replace(samples, accelerations=np.array(forces))
    found = after(samples, step_at(FRAME_S))
    np.testing.assert_allclose(found.direction, [0, 1, 0], atol=1e-9)
    # the bias of the gyroscope is taken off
    shifted = dataclasses.replace(samples, rates=samples.rates + [0.5, 0, 0])
    known = Accelerometer().after(shifted, np.array([0.5, 0, 0]), step_at(FRAME_S))
    np.testing.assert_allclose(known.gravity().direction, [0, 1, 0], atol=1e-9)


# -- what is believed ------------------------------------------------------------------------


def walked(
    seconds: float, seed: int, shake: float
) -> tuple[Accelerometer, np.ndarray]:
    """An accelerometer in a hand that turns and shakes, and the true direction of gravity.

    Args:
        seconds: how long.
        seed: of directions and motions.
        shake: standard deviation of the acceleration along each axis, m/s^2.
    """
    rng = np.random.default_rng(seed)
    down = rng.normal(size=3)
    down /= np.linalg.norm(down)
    amplitudes = shake / np.sqrt(3) * np.sqrt(2) * rng.uniform(0.5, 1.5, (3, 3))
    hertz = rng.uniform(0.5, 2.5, (3, 3))
    phases = rng.uniform(0, 2 * np.pi, (3, 3))
    swing = rng.normal(0, 0.3, 3)
    known = Accelerometer()
    stamps = np.arange(1, round(seconds * RATE_HZ) + 1) / RATE_HZ
    turns = Rotation.from_rotvec(np.sin(2 * np.pi * 0.4 * stamps)[:, None] * swing)
    waves = np.sin(2 * np.pi * hertz * stamps[:, None, None] + phases)
    own = (amplitudes * waves).sum(axis=2)
    forces = turns.inv().apply(own - G * down)
    forces += rng.normal(0, 0.05, forces.shape)
    between = (turns[:-1].inv() * turns[1:]).as_rotvec() * RATE_HZ
    rates = np.concatenate([between, between[-1:]])
    for first in range(0, len(stamps), 7):
        part = slice(first, first + 7)
        samples = hvo.ImuSamples(
            stamps[part], rates[part], None, accelerations=forces[part]
        )
        last = min(first + 7, len(stamps)) - 1
        step = step_at(stamps[last], turns[last].as_matrix())
        known = known.drifted(step).after(samples, NO_BIAS, step)
    return known, down


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), shake=st.sampled_from([0.1, 0.5, 2.0]))
def test_it_is_as_near_as_it_says(seed: int, shake: float) -> None:
    for seconds in (1.0, 3.0):
        known, down = walked(seconds, seed, shake)
        found = known.gravity()
        assert found is not None
        assert degrees(found.direction, down) < 4 * np.rad2deg(found.std)
        assert np.linalg.eigvalsh(found.covariance)[0] > -1e-12


def test_turning_averages_the_bias_of_the_sensor_away() -> None:
    """A camera on its tripod, and one that was laid on its other side for as long."""
    bias = np.array([0.4, 0, 0])
    known = Accelerometer()
    half = np.diag([-1.0, -1.0, 1.0])
    found = []
    for k in range(60):
        R_world_cam = np.eye(3) if k < 30 else half
        force = R_world_cam.T @ [0, -G, 0] + bias
        step = step_at((k + 1) * FRAME_S, R_world_cam)
        known = known.after(readings(k * FRAME_S, force), NO_BIAS, step)
        found.append(known.gravity())
    # the second half took back what the first one was off by, along x and not along z
    assert degrees(found[29].direction, np.array([0, 1.0, 0])) > 2.0
    assert degrees(found[59].direction, np.array([0, 1.0, 0])) < 1.0
    before = np.diag(found[29].covariance)
    after_turn = np.diag(found[59].covariance)
    assert after_turn[0] < 0.5 * before[0]
    assert after_turn[2] > 0.5 * before[2]


def test_a_knock_makes_it_less_sure() -> None:
    known, down = walked(2.0, 3, 0.1)
    before = known.gravity()
    knock = readings(known.stamp, np.array([60.0, 0, 0]))
    step = step_at(known.stamp + FRAME_S)
    found = known.after(knock, NO_BIAS, step).gravity()
    assert found.std > 2 * before.std
    assert degrees(found.direction, down) < 2 * np.rad2deg(found.std)


def test_a_sensor_that_reads_wrongly_is_not_believed() -> None:
    """In units of g, or in free fall."""
    honest = after(readings(0, np.array([0, -G, 0])), step_at(FRAME_S))
    in_g = after(readings(0, np.array([0, -1.0, 0])), step_at(FRAME_S))
    assert in_g.std > 5 > honest.std
    assert Accelerometer().gravity() is None
    falling = Accelerometer().after(
        readings(0, np.zeros(3)), NO_BIAS, step_at(FRAME_S)
    )
    assert falling.gravity() is None


def test_errors_of_the_rotation_add_up() -> None:
    known, _ = walked(2.0, 3, 0.1)
    sure = known.gravity()
    turned = np.diag([0.0] * 3 + [0.02**2] * 3)
    drifted = known.drifted(step_at(2.0, covariance=turned)).gravity()
    np.testing.assert_array_equal(drifted.direction, sure.direction)
    # each of the two directions across gravity turns by as much
    expected = np.sqrt(
        sure.std**2 + 2 * 0.02**2 * (known.force @ known.force) / G**2
    )
    assert drifted.std == pytest.approx(expected, rel=1e-2)


def test_samples_count_once_and_not_across_a_gap() -> None:
    samples = readings(0, np.array([0, -G, 0]))
    known = Accelerometer().after(samples, NO_BIAS, step_at(FRAME_S))
    assert known.stamp == samples.stamps[-1]
    assert known.after(samples, NO_BIAS, step_at(FRAME_S)) is known
    # what comes later waits for its frame
    assert known.after(readings(1, np.ones(3)), NO_BIAS, step_at(0.5)) is known
    # samples that end long before the frame, whose rotation to it is not known
    assert known.after(readings(1, np.ones(3)), NO_BIAS, step_at(1.5)) is known


# -- in a tracker ----------------------------------------------------------------------------


def recording(
    count: int = 6,
) -> tuple[list[hvo.Frame], list[hvo.ImuSamples], np.ndarray]:
    """Rendered frames, samples with accelerations, and gravity in the first camera."""
    scene = make_scene("static", 3, height=96, width=160, frames=count)
    down = np.array([0.1, 0.9, 0.3])
    down /= np.linalg.norm(down)
    frames = []
    samples = []
    truth = [invert(scene.T_world_cam[0]) @ T for T in scene.T_world_cam]
    for k, frame in enumerate(SyntheticSequence(scene)[i] for i in range(count)):
        frames.append(
            hvo.Frame(frame.rgb, frame.depth, frame.camera, k * FRAME_S, k)
        )
        before = truth[max(k - 1, 0)][:3, :3]
        turn = Rotation.from_matrix(before.T @ truth[k][:3, :3])
        stamps = (k - 1) * FRAME_S + (np.arange(6) + 1) * FRAME_S / 6
        shares = (np.arange(6) + 1) / 6
        R = Rotation.from_matrix(before) * Rotation.from_rotvec(
            shares[:, None] * turn.as_rotvec()
        )
        rates = np.tile(turn.as_rotvec() / FRAME_S, (6, 1))
        samples.append(
            hvo.ImuSamples(stamps, rates, None, -G * R.inv().apply(down))
        )
    return frames, samples, down


def test_a_tracker_states_gravity_in_its_world() -> None:
    frames, samples, down = recording()
    tracker = hvo.Odometry(network=None)
    assert tracker.track(frames[0]).gravity is None
    for frame, imu in zip(frames[1:], samples[1:], strict=True):
        step = tracker.track(frame, imu=imu)
        assert step.gravity is not None
        assert degrees(step.gravity.direction, down) < 1.0
    # the samples are held, and gravity stays without new ones
    still = dataclasses.replace(frames[-1], timestamp=1.0, index=9)
    again = tracker.track(still).gravity
    assert degrees(again.direction, step.gravity.direction) < 0.1
    # in another world
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    T_new = make_transform(quarter, np.zeros(3))
    tracker.set_pose(T_new @ tracker.state.T_world_last)
    np.testing.assert_allclose(
        tracker.state.gravity.direction, quarter @ again.direction
    )
    tracker.reset()
    assert tracker.state.gravity is None


def test_motions_are_the_same_with_and_without_it() -> None:
    frames, samples, _ = recording()
    found = []
    for with_it in (True, False):
        tracker = hvo.Odometry(network=None)
        steps = []
        for frame, imu in zip(frames, samples, strict=True):
            if not with_it:
                imu = dataclasses.replace(imu, accelerations=None)
            steps.append(tracker.track(frame, imu=imu))
        found.append(steps)
    assert found[0][-1].gravity is not None
    for step, other in zip(*found, strict=True):
        assert other.gravity is None
        np.testing.assert_array_equal(step.T_world_cam, other.T_world_cam)
        np.testing.assert_array_equal(step.covariance, other.covariance)
        assert step.status == other.status


def test_a_pose_that_is_not_known_says_little() -> None:
    """Of a motion that failed; the world goes on from the frame before."""
    known, _ = walked(1.0, 5, 0.1)
    sideways = readings(known.stamp, np.array([G, 0, 0]))
    stamp = known.stamp + FRAME_S
    failed = step_at(stamp, covariance=10 * np.eye(6))
    lost = known.after(sideways, NO_BIAS, failed, leads=False)
    sure = known.after(sideways, NO_BIAS, step_at(stamp), leads=False)
    moved = [np.linalg.norm(each.force - known.force) for each in (lost, sure)]
    assert moved[0] < 0.1 * moved[1]


def test_it_costs_constant_memory_and_comes_back_from_disk() -> None:
    known, _ = walked(2.0, 4, 0.5)
    text = json.dumps(saved(known), allow_nan=False)
    assert len(text) < 2000
    back = restored(json.loads(text), None)  # type: ignore[arg-type]
    for name, value in vars(known).items():
        np.testing.assert_array_equal(getattr(back, name), value)
