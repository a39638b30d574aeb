"""The inertial sensor of a live camera, from its readings to the tracker."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.io.cameras.base import Reading
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.cameras.inertial import CameraImu, ImuBuffer
from hybridvo.io.cameras.predicted import PredictedCamera
from hybridvo.run.commands import live as command
from tests import captures
from tests.io.data.test_stereo import euroc_folder
from tests.io.live.scripted import LONG_S, Clock, ScriptedCamera, Tracker, reading
from tests.io.live.test_stream import run

MOUNT = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])


def samples(*stamps: float) -> hvo.ImuSamples:
    count = len(stamps)
    rates = np.tile([0.0, 0.0, 0.1], (count, 1))
    forces = np.tile([9.8, 0.0, 0.0], (count, 1))
    return hvo.ImuSamples(np.array(stamps), rates, MOUNT, forces)


# -- readings --------------------------------------------------------------------------------


def test_accelerations_are_interpolated_to_the_rates() -> None:
    buffer = ImuBuffer(MOUNT)
    assert buffer.take() is None
    for k in range(3):
        buffer.add_acceleration(0.010 * k, (float(k), 0.0, -9.0))
    for k in range(4):
        buffer.add_rate(0.005 * k, (0.0, 0.1 * k, 0.0))
    taken = buffer.take()
    assert taken is not None
    np.testing.assert_allclose(taken.stamps, [0, 0.005, 0.010, 0.015])
    np.testing.assert_allclose(taken.accelerations[:, 0], [0, 0.5, 1, 1.5])
    np.testing.assert_allclose(taken.rates[:, 1], [0, 0.1, 0.2, 0.3])
    assert buffer.take() is None
    # the last acceleration stands until the next one comes
    buffer.add_rate(0.025, (0.0, 0.0, 0.0))
    buffer.add_acceleration(0.030, (4.0, 0.0, -9.0))
    taken = buffer.take()
    np.testing.assert_allclose(taken.accelerations[0], [3, 0, -9])


def test_rates_come_without_accelerations_that_stopped() -> None:
    buffer = ImuBuffer(MOUNT)
    buffer.add_rate(1.0, (0.0, 0.0, 0.0))
    assert buffer.take().accelerations is None
    buffer.add_acceleration(1.0, (0.0, -9.8, 0.0))
    buffer.add_rate(5.0, (0.0, 0.0, 0.0))
    assert buffer.take().accelerations is None


def test_readings_that_are_malformed_are_left_out() -> None:
    buffer = ImuBuffer(MOUNT)
    for stamp, value in (
        (1.0, 0.1),
        (1.005, np.nan),
        (0.5, 0.1),  # backwards
        (1.010, 0.3),
        (1.010, 0.4),  # twice
        (np.inf, 0.5),
    ):
        buffer.add_rate(stamp, (value, 0.0, 0.0))
        buffer.add_acceleration(stamp, (0.0, value, 0.0))
    taken = buffer.take()
    np.testing.assert_array_equal(taken.stamps, [1.0, 1.010])
    np.testing.assert_array_equal(taken.rates[:, 0], [0.1, 0.3])
    np.testing.assert_array_equal(taken.accelerations[:, 1], [0.1, 0.3])


def test_a_mount_that_is_no_rotation_is_said_and_the_camera_goes_on() -> None:
    with pytest.raises(hvo.InputError, match="R_cam_imu"):
        ImuBuffer(np.zeros((3, 3)))
    imu = CameraImu(lambda: ImuBuffer(np.zeros((3, 3))))
    first = imu.added_to(reading(1.0))
    assert first.imu is None and first.frame is not None
    assert first.note.startswith("its IMU is not used: ImuSamples.R_cam_imu")
    assert imu.added_to(reading(2.0)).note == ""
    assert CameraImu(lambda: None).added_to(reading(1.0)).note == ""


def test_readings_that_nobody_takes_do_not_pile_up() -> None:
    buffer = ImuBuffer(MOUNT)
    for k in range(10_000):
        buffer.add_rate(0.0025 * k, (0.0, 0.0, 0.0))
    taken = buffer.take()
    assert len(taken) == 4000
    assert taken.stamps[-1] == 0.0025 * 9999


# -- a stream --------------------------------------------------------------------------------


def test_samples_of_frames_that_were_replaced_are_not_lost() -> None:
    tracked = threading.Event()
    given = threading.Event()
    tracker = Tracker()

    def busy(count: int) -> None:
        if count == 1:
            tracked.set()
            assert given.wait(LONG_S)

    tracker.on_track = busy
    later = [reading(0.1 * i, imu=samples(0.1 * i - 0.05)) for i in (1, 2, 3)]
    camera = ScriptedCamera(
        reading(0.0), lambda: _waited(tracked), *later, given.set, hasty=True
    )
    steps, _, _ = run(camera, tracker)
    assert steps.counts.replaced == 2
    joined = tracker.samples[1]
    assert joined is not None
    np.testing.assert_allclose(joined.stamps, [0.05, 0.15, 0.25])
    assert joined.accelerations is not None and len(joined.accelerations) == 3


def _waited(event: threading.Event) -> None:
    assert event.wait(LONG_S)


def test_samples_of_frames_that_come_twice_are_not_lost() -> None:
    tracker = Tracker()
    camera = ScriptedCamera(
        reading(5.0),
        reading(5.0, imu=samples(5.02)),
        reading(5.1, imu=samples(5.07)),
    )
    steps, _, _ = run(camera, tracker)
    assert steps.counts.repeated == 1
    np.testing.assert_array_equal(tracker.samples[1].stamps, [5.02, 5.07])


def test_samples_go_evenly_with_frames_whose_clock_jumps() -> None:
    tracker = Tracker()
    camera = ScriptedCamera(
        reading(5.0),
        reading(905.1, imu=samples(905.02, 905.07)),
    )
    steps, found, _ = run(camera, tracker)
    assert steps.counts.clock_jumps == 1
    late = found[1].frame.timestamp - tracker.samples[1].stamps
    np.testing.assert_allclose(late, [0.08, 0.03], atol=1e-6)


def test_what_is_known_survives_images_of_another_size() -> None:
    """The tracker starts anew; its world and the sensor are the same."""
    small = hvo.Camera(fx=40, fy=40, cx=5.5, cy=3.5, height=8, width=12)
    script = [
        reading(1.0, imu=samples(0.98, 0.99, 1.0)),
        reading(1.03, imu=samples(1.01, 1.02, 1.03), camera=small),
    ]
    steps, found, said = run(ScriptedCamera(*script), hvo.Odometry(network=None))
    assert "images of another size" in said[0]
    first, second = (live.step.gravity for live in found)
    for made in (first, second):
        # up to what it turns by in a frame
        np.testing.assert_allclose(made.direction, [0, 1, 0], atol=2e-3)
    assert second.std < first.std
    assert steps.summary()["gravity"] == second.summary()


# -- recordings, networks, the command -----------------------------------------------------------


def played(root: Path, imu: bool) -> list[Reading]:
    clock = Clock()
    camera = FolderCamera(root, clock=clock, sleep=clock.sleep, imu=imu)
    camera.open()
    return [camera.read(9.0) for _ in range(3)]


def test_a_recording_with_an_imu_hands_it_over(tmp_path: Path) -> None:
    root = captures.with_imu(euroc_folder(tmp_path))
    first, second, _ = played(root, imu=True)
    assert first.imu is None
    sequence = hvo.open_sequence(root)
    expected = sequence.imu(*sequence.timestamps[:2])
    np.testing.assert_array_equal(second.imu.stamps, expected.stamps)
    assert all(each.imu is None for each in played(root, imu=False))


def test_a_network_leaves_the_samples_alone() -> None:
    camera = ScriptedCamera(reading(5.0, imu=samples(4.99)), hasty=True)
    predicted = PredictedCamera(camera, [lambda frame: frame])
    np.testing.assert_array_equal(predicted.read(1.0).imu.stamps, [4.99])


def test_lines_of_json_state_gravity_where_it_is_known() -> None:
    tracker = hvo.Odometry(network=None)
    script = [reading(1.0), reading(1.03, imu=samples(1.01, 1.02, 1.03))]
    _, found, _ = run(ScriptedCamera(*script), tracker)
    without, with_it = (command.json_line(live) for live in found)
    assert "gravity" not in without
    line = json.loads(with_it)
    np.testing.assert_allclose(line["gravity"], [0, 1, 0], atol=0.1)
    assert line["gravity_sigma_deg"] > 0
    assert len(with_it) < 1400
