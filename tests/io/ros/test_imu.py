"""Samples of a gyroscope in a node: which go with which frame, and how long one waits for them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.io.ros.follower import Follower
from hybridvo.io.ros.inbox import Arrived, Inbox
from hybridvo.io.ros.parameters import NodeOptions
from tests.io.ros.msgs import Types
from tests.io.ros.test_follower import arrived, fixed, follow, header

TYPES = Types(2)
LONG_S = 3600.0
"""Longer than any test."""
OPTIONS = NodeOptions(topic_imu="/imu", queue_size=9)


def sample(seconds: float, rate: float = 0.0, frame: str = "optical") -> Any:
    message = TYPES.make("sensor_msgs/msg/Imu", header=header(seconds))
    message.header.frame_id = frame
    message.angular_velocity.x = rate
    return message


def pair(seconds: float) -> Any:
    return SimpleNamespace(header=header(seconds))


def inbox_of(said: list[str], patience_s: float = LONG_S) -> Inbox:
    inbox = Inbox(OPTIONS, said.append, patience_s)
    inbox.add_info("info")
    return inbox


def taken_from(inbox: Inbox) -> list[Arrived]:
    inbox.close(finish=True)
    return list(iter(inbox.take, None))


def stamps(each: Arrived) -> Any:
    """The stamps of the samples of a frame, to be compared with numbers."""
    return pytest.approx([] if each.imu is None else each.imu.stamps.tolist())


def test_a_frame_gets_the_samples_since_the_one_before() -> None:
    said = list[str]()
    inbox = inbox_of(said)
    for seconds in (10.0, 10.1):
        inbox.add_images(pair(seconds), None)
    for k in range(15):
        inbox.add_imu(sample(9.97 + 0.01 * k, rate=float(k)))
    first, second = taken_from(inbox)
    assert stamps(first) == [9.97, 9.98, 9.99]
    assert stamps(second) == [10 + 0.01 * k for k in range(10)]
    assert second.imu is not None
    assert second.imu.rates[:, 0].tolist() == list(range(3, 13))
    # it is only a gyroscope
    assert second.imu.accelerations is None
    np.testing.assert_array_equal(second.imu.R_cam_imu, np.eye(3))
    assert not said


def test_samples_of_a_frame_that_had_to_go_come_with_the_next_one() -> None:
    inbox = Inbox(NodeOptions(topic_imu="/imu"), print)
    inbox.add_info("info")
    for k in range(3):
        inbox.add_images(pair(10.0 + k / 10), None)
        inbox.add_imu(sample(10.05 + k / 10))
    (last,) = taken_from(inbox)
    assert inbox.dropped == 2
    assert stamps(last) == [10.05, 10.15]


def test_a_frame_does_not_wait_long_and_the_next_ones_not_at_all() -> None:
    said = list[str]()
    inbox = inbox_of(said, patience_s=0.0)
    inbox.add_images(pair(10.0), None)
    first = inbox.take()
    assert first is not None and first.imu is None
    # now a frame would wait for an hour, if samples were still expected
    inbox._patience_s = LONG_S
    inbox.add_images(pair(10.1), None)
    assert inbox.take() is not None
    assert said == [
        "no sample on /imu between two frames: tracking goes on without"
    ]
    # they are here again
    inbox.add_imu(sample(10.15))
    inbox.add_images(pair(10.2), None)
    assert inbox._next() is None
    inbox.add_imu(sample(10.25))
    third = inbox.take()
    assert third is not None and stamps(third) == [10.15]


@pytest.mark.parametrize("behind_s", [-1000.0, 1000.0])
def test_a_clock_of_its_own_holds_nothing_up(behind_s: float) -> None:
    said = list[str]()
    inbox = inbox_of(said, patience_s=0.0)
    for k in range(300):
        inbox.add_imu(sample(5000 - behind_s + k))
        inbox.add_images(pair(5000.0 + k), None)
        assert inbox.take() is not None
    # a minute is kept, not all
    assert len(inbox._rates._rows) < 62
    assert all("/imu" in text for text in said) and len(said) <= 1


def test_samples_that_come_late_or_twice_are_left_out() -> None:
    inbox = inbox_of([])
    for seconds in (10.0, 10.01, 10.01, 10.005, 10.02):
        inbox.add_imu(sample(seconds))
    inbox.add_imu(sample(10.03, rate=np.nan))
    inbox.add_images(pair(11.0), None)
    (frame,) = taken_from(inbox)
    assert stamps(frame) == [10.0, 10.01, 10.02]


def test_the_rotation_is_that_of_the_static_transforms() -> None:
    inbox = inbox_of([])
    message = fixed("gyro", "optical")
    rotation = message.transforms[0].transform.rotation
    rotation.z = rotation.w = np.sqrt(0.5)
    inbox.add_transforms(message)
    inbox.add_imu(sample(10.0, frame="/gyro"))
    inbox.add_images(pair(10.1), None)
    (frame,) = taken_from(inbox)
    assert frame.imu is not None
    # the camera is turned by 90 degrees about z: what turns about x there, turns about -y here
    np.testing.assert_allclose(
        frame.imu.R_cam_imu @ [1, 0, 0], [0, -1, 0], atol=1e-12
    )


# -- the tracker -------------------------------------------------------------------------


def of(start: float, end: float) -> hvo.ImuSamples:
    times = np.arange(start, end - 1e-9, 0.01)
    return hvo.ImuSamples(times, np.zeros((len(times), 3)))


class Tracker(hvo.Odometry):
    """Keeps what it is given of a gyroscope."""

    def __init__(self) -> None:
        super().__init__(None)
        self.given = list[hvo.ImuSamples | None]()

    def track(self, *args: Any, **given: Any) -> hvo.Step:
        self.given.append(given["imu"])
        return super().track(*args, **given)


def test_samples_of_a_frame_that_cannot_be_used_go_to_the_next_one() -> None:
    tracker = Tracker()
    follower = Follower(tracker, OPTIONS, lambda text: None)
    first = arrived(0, 10.0)._replace(imu=of(9.9, 10.0))
    bad = arrived(1, 10.1)._replace(imu=of(10.0, 10.1))
    bad.rgb.encoding = "purple"
    after = arrived(2, 10.2)._replace(imu=of(10.1, 10.2))
    last = arrived(3, 10.3)
    assert len(follow(follower, first, bad, after, last)) == 3
    before, between, none = tracker.given
    assert before is first.imu and none is None
    assert between is not None
    np.testing.assert_allclose(between.stamps, np.arange(10.0, 10.195, 0.01))
    assert tracker.state.sensors.gyroscope is not None


def test_an_accelerometer_is_not_taken_for_a_gyroscope() -> None:
    said = list[str]()
    inbox = inbox_of(said, patience_s=0.0)
    for k in range(3):
        message = sample(10.0 + k)
        message.angular_velocity_covariance[0] = -1
        inbox.add_imu(message)
    inbox.add_images(pair(10.5), None)
    assert inbox.take() is not None
    assert said[0] == "/imu states that it has no rates: not used"


def test_a_bag_that_is_played_again_begins_anew() -> None:
    inbox = inbox_of([])
    for seconds in (10.0, 10.01, 5.0, 5.01):
        inbox.add_imu(sample(seconds))
    inbox.add_images(pair(5.02), None)
    (frame,) = taken_from(inbox)
    assert stamps(frame) == [5.0, 5.01]
