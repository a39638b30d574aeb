"""What a node does with frames that come late, twice, or from another camera."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import hybridvo as hvo
from hybridvo.io.ros.conversions import optical_mount
from hybridvo.io.ros.follower import Follower, Report
from hybridvo.io.ros.inbox import Arrived, Inbox
from hybridvo.io.ros.parameters import NodeOptions
from tests.io.ros import scenes
from tests.io.ros.msgs import Types

TYPES = Types(2)
SCENE = scenes.scene()


def header(seconds: float) -> Any:
    whole, nanoseconds = divmod(round(seconds * 1e9), 10**9)
    kind = "builtin_interfaces/msg/Time"
    time = TYPES.make(kind, sec=whole, nanosec=nanoseconds)
    return TYPES.make("std_msgs/msg/Header", stamp=time, frame_id="optical")


def image(pixels: np.ndarray, encoding: str, seconds: float) -> Any:
    height, width = pixels.shape[:2]
    return TYPES.make(
        "sensor_msgs/msg/Image",
        header=header(seconds),
        height=height,
        width=width,
        encoding=encoding,
        step=pixels.nbytes // height,
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )


def arrived(
    index: int, seconds: float, scale: int = 1, depth: float | None = None
) -> Arrived:
    """A frame of the scene, with every n-th pixel."""
    frame = SCENE.render(index)
    metres = np.where(np.isfinite(frame.depth), frame.depth, 0)
    if depth is not None:
        metres = np.full_like(metres, depth)
    camera = frame.camera
    info = TYPES.make(
        "sensor_msgs/msg/CameraInfo",
        height=camera.height // scale,
        width=camera.width // scale,
        k=(camera.K / [[scale], [scale], [1]]).reshape(-1),
    )
    return Arrived(
        image(frame.rgb[::scale, ::scale], "rgb8", seconds),
        image(metres[::scale, ::scale].astype(np.float32), "32FC1", seconds),
        info,
        optical_mount("optical"),
    )


def covered(seen: Arrived) -> Arrived:
    """The same with a hand on the lens."""
    stamp = seen.rgb.header.stamp
    # another noise in every frame
    rng = np.random.default_rng(stamp.nanosec)
    noise = rng.integers(0, 40, (*scenes.SIZE, 3))
    metres = np.full(scenes.SIZE, 0.1, np.float32)
    seconds = stamp.sec + 1e-9 * stamp.nanosec
    return seen._replace(
        rgb=image(noise.astype(np.uint8), "rgb8", seconds),
        depth=image(metres, "32FC1", seconds),
    )


@pytest.fixture
def said() -> list[str]:
    return []


@pytest.fixture
def follower(said: list[str]) -> Follower:
    return Follower(hvo.Odometry(None), NodeOptions(), said.append)


def follow(follower: Follower, *frames: Arrived) -> list[Report]:
    found = [follower.follow(frame) for frame in frames]
    return [report for report in found if report is not None]


def test_what_moves_is_where_the_motion_is_not_followed() -> None:
    options = NodeOptions(publish_mask=True)
    follower = Follower(hvo.Odometry(None), options, lambda text: None)
    reports = follow(follower, arrived(0, 10.0), arrived(1, 10.1))
    weights = reports[-1].step.motion.weights
    moving = reports[-1].moving
    assert moving is not None and moving.mask.any()
    follows = weights[~moving.mask].mean()
    assert follows > 0.5
    assert weights[moving.mask].mean() < 0.5 * follows


def test_a_frame_that_comes_twice_or_late_is_left_out(
    follower: Follower, said: list[str]
) -> None:
    frames = [
        arrived(0, 10.0),
        arrived(1, 10.1),
        arrived(1, 10.1),
        arrived(0, 10.05),
    ]
    reports = follow(follower, *frames, arrived(2, 10.2))
    assert [report.step.index for report in reports] == [0, 1, 2]
    assert not said


def test_time_that_jumps_back_begins_anew_where_the_camera_is(
    follower: Follower, said: list[str]
) -> None:
    """As where a bag is played in a loop."""
    before = follow(follower, arrived(0, 10.0), arrived(3, 10.1))[-1]
    after = follow(follower, arrived(0, 2.0), arrived(1, 2.1))
    assert said == ["time jumped back; tracking begins anew at the last pose"]
    np.testing.assert_allclose(after[0].T_odom_child, before.T_odom_child)
    assert [report.restarts for report in after] == [1, 1]
    # how it moved meanwhile is not known, but now it is
    assert before.covariance[0, 0] < 1 < 1e4 <= after[0].covariance[0, 0]
    assert after[1].twist.covariance[0, 0] < 1e4
    assert after[1].step.usable


def test_a_path_that_is_found_again_from_a_place(said: list[str]) -> None:
    """The motion starts from a frame that is neither the one before nor a keyframe."""
    tracker = hvo.Odometry(None)
    follower = Follower(tracker, NodeOptions(publish_mask=True), said.append)
    follow(follower, *(arrived(i, 10 + 0.1 * i) for i in range(3)))
    tracker.state = replace(tracker.state, keyframes=())
    dark = [covered(arrived(3, 10.3 + 0.1 * i)) for i in range(2)]
    assert not any(report.step.ok for report in follow(follower, *dark))
    found = follow(follower, arrived(0, 20.0))[0]
    assert (found.step.ok, found.step.prev_index) == (True, 0)
    # where it is is known; how fast it is is not
    assert found.covariance[0, 0] < 1 < 1e4 <= found.twist.covariance[0, 0]
    assert found.moving is not None
    assert found.moving.header.stamp.sec == 10
    after = follow(follower, arrived(1, 20.1))[0]
    assert after.step.prev_index == found.step.index
    assert after.twist.covariance[0, 0] < 1


def test_later_a_frame_without_depth_fails_and_the_next_motion_spans_it(
    follower: Follower,
) -> None:
    frames = [arrived(0, 1.0), arrived(1, 1.1), arrived(2, 1.2, depth=0.0)]
    first, second, blind, after = follow(follower, *frames, arrived(3, 1.3))
    assert not blind.step.usable or blind.covariance[0, 0] > first.covariance[0, 0]
    assert after.step.prev_index == 1
    # two tenths of a second
    from_second = np.linalg.norm(
        after.T_odom_child[:3, 3] - second.T_odom_child[:3, 3]
    )
    speed = np.linalg.norm(after.twist.velocity[:3])
    assert speed == pytest.approx(from_second / 0.2, rel=0.01)
    assert first.covariance[0, 0] < after.covariance[0, 0] < 1


def test_messages_that_cannot_be_read_are_said_once(
    follower: Follower, said: list[str]
) -> None:
    bad = arrived(0, 1.0)
    bad.rgb.encoding = "purple"
    assert not follow(follower, bad, bad)
    assert len(said) == 1
    assert "encoding 'purple' of colour is not read" in said[0]
    assert follow(follower, arrived(0, 1.1))


# -- what waits --------------------------------------------------------------------------


def pair(number: int) -> Any:
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="/optical"), number=number
    )


@pytest.mark.parametrize(
    ("size", "kept"), [(1, [4]), (3, [2, 3, 4]), (9, range(5))]
)
def test_the_newest_frames_count(size: int, kept: Any) -> None:
    inbox = Inbox(NodeOptions(queue_size=size), print)
    for number in range(5):
        inbox.add_images(pair(number), None)
    inbox.add_info("info")
    inbox.close(finish=True)
    taken = list(iter(inbox.take, None))
    assert [each.rgb.number for each in taken] == list(kept)
    assert inbox.dropped == 5 - len(taken)
    assert {each.mount.child for each in taken} == {"optical"}


def fixed(parent: str, child: str) -> Any:
    """A message of ``/tf_static`` with one transform, which does nothing."""
    transform = TYPES.make(
        "geometry_msgs/msg/TransformStamped", child_frame_id=child
    )
    transform.header.frame_id = parent
    transform.transform.rotation.w = 1.0
    return TYPES.make("tf2_msgs/msg/TFMessage", transforms=[transform])


def test_images_of_another_size_begin_anew(
    follower: Follower, said: list[str]
) -> None:
    reports = follow(follower, arrived(0, 1.0), arrived(1, 1.1, scale=2))
    assert said == ["images of another size; tracking begins anew at the last pose"]
    assert reports[1].step.prev_index is None


def test_nothing_begins_without_depth(follower: Follower, said: list[str]) -> None:
    reports = follow(follower, arrived(0, 1.0, depth=0.0), arrived(1, 1.1))
    assert [report.step.index for report in reports] == [0]
    assert said == ["frames without depth; tracking has not begun"]
