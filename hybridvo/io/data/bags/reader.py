"""The reader of bags: colour and depth by topic, matched in time, registered where they are not."""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.bags import messages as ros
from hybridvo.io.data.bags.folder import STORAGE_FILES, is_bag_folder
from hybridvo.io.data.bags.source import Bag, Message, storage_ending
from hybridvo.io.data.bags.tape import Tape
from hybridvo.io.data.bags.topics import (
    Topics,
    TopicSummary,
    choose_topics,
    is_rectified,
    is_registered,
)
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.lists import abbreviated
from hybridvo.io.data.registration import register_depth
from hybridvo.io.data.sequence import UndistortionMaps
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    straightened,
    units_per_metre,
)

MILLIMETRES = 1000.0
"""Units per metre of depth in whole numbers, as REP 118 has it."""
MAX_TRANSFORMS = 500
"""Messages of ``/tf`` or ``/tf_static`` that are looked at: fixed frames are known by then."""
SAME_PLACE_M = 1e-4
"""Distance of two cameras, m, below which they are one."""
UNIT_TOLERANCE = 1e-2
"""By which the length of a stated quaternion may differ from 1: of digits left out."""
SAME_ANGLE = 1e-4
"""Entries by which two rotations may differ and be one."""


@dataclass
class _Index:
    """What one pass over a bag finds, by topic."""

    # of image topics, ns: in the headers, and when they were recorded
    stamps: dict[str, array] = field(default_factory=dict)
    times: dict[str, array] = field(default_factory=dict)
    # the first CameraInfo
    infos: dict[str, Any] = field(default_factory=dict)
    # (parent, child) -> T_parent_child, and which of them change
    edges: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    moving: set[tuple[str, str]] = field(default_factory=set)
    poses: list[ros.StampedPose] = field(default_factory=list)
    # of the gyroscope, as ``messages.imu_row`` has them
    imu: list[list[float]] = field(default_factory=list)
    # messages with transforms that were looked at
    looked_at: dict[str, int] = field(default_factory=dict)

    @property
    def fixed(self) -> dict[tuple[str, str], np.ndarray]:
        """The transforms that do not change."""
        return {e: T for e, T in self.edges.items() if e not in self.moving}


REALSENSE_STREAM = re.compile(r"(/device_\d+/sensor_\d+/.+)/(image|imu)/data")
"""Topics of images and of the inertial sensor in a recording of RealSense's tools."""


class BagSequence(StreamSequence):
    """A ROS 1 bag, a ROS 2 bag (sqlite3 or mcap), or a recording of RealSense's tools.

    Frames are read when they are used. In their order they cost one pass over the bag, which is
    never in memory.
    """

    kind = "bag"
    depth_scale = MILLIMETRES
    choices = (
        *("topic_rgb", "topic_depth", "topic_info", "topic_truth"),
        *("topic_imu", "imu_rotation", "depth_offset_ms", "frame"),
    )
    markers = (("metadata.yaml", "*.mcap"), ("metadata.yaml", "*.db3"))

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is a bag: a file, or a folder of ROS 2."""
        if folder.is_file():
            known = (".bag", *STORAGE_FILES)
            is_open = folder.name.endswith(".bag.active")
            return storage_ending(folder) in known or is_open
        return folder.is_dir() and is_bag_folder(folder)

    def files(self) -> list[Path]:
        """Return the files of the bag."""
        return self._bag.files()

    def _open(self) -> None:
        self._bag = Bag(self.root)
        self.topics = self._choose_topics()
        index = self._read_index()
        if self._bag.notes:
            self.warnings += [*self._bag.notes, self._what_is_used(index)]
        if self.topics.guessed:
            self._warn(self.topics.guessed)
        self._match(index)
        rgb = ros.colour_image(self._decoded(self.topics.rgb, self._rgb_at[0]))
        self._take_lens(index, rgb.shape[:2])
        usual = self._unit_of_realsense() or MILLIMETRES
        self._units = units_per_metre(self._given_scale, usual, self.warnings)
        self._used_scale = self._units
        self._take_registration(index)
        self._take_truth(index)
        self._take_gyroscope(index)
        self._take_frame(index)

    def opened_with(self) -> dict[str, Any]:
        """Return what decides how the bag is read, JSON-ready."""
        topics = self.topics._asdict()
        topics.pop("guessed")
        scale = {"depth_scale": self._used_scale}
        return super().opened_with() | scale | {"topics": topics}

    def _what_is_used(self, index: _Index) -> str:
        """State how much of a damaged bag can be read, and how much there was, where known."""
        stated = self._bag.stated_counts()
        counts = []
        for topic, images in (
            (self.topics.rgb, "colour images"),
            (self.topics.depth, "depth maps"),
        ):
            if not topic:
                continue
            count = len(index.times[topic])
            there_were = f" of {stated[topic]}" if topic in stated else ""
            counts.append(f"{count}{there_were} {images}")
        text = f"{self.root.name}: what is whole is used: {', '.join(counts)}"
        times = [time for each in index.times.values() for time in each]
        if not times:
            return f"{text}."
        span = self._bag.stated_times()
        start = span[0] if span else min(times)
        from_s = (min(times) - start) / 1e9
        to_s = (max(times) - start) / 1e9
        of_s = f" of {(span[1] - start) / 1e9:.1f}" if span else ""
        return f"{text}, seconds {from_s:.1f} to {to_s:.1f}{of_s}."

    def _choose_topics(self) -> Topics:
        bag = self._bag
        chosen = self.chosen
        try:
            return choose_topics(
                summaries_of(bag),
                rgb=chosen.get("topic_rgb"),
                depth=chosen.get("topic_depth"),
                info=chosen.get("topic_info"),
                truth=chosen.get("topic_truth"),
                imu=chosen.get("topic_imu"),
                needs_depth=self._needs_depth,
            )
        except InputError as error:
            notes = "".join(f" {note}" for note in bag.notes)
            raise InputError(f"{self.root}: {error}{notes}") from None

    # -- one pass over the bag ---------------------------------------------------

    def _read_index(self) -> _Index:
        """Go over the bag once: stamps of all images, cameras, transforms and poses."""
        bag = self._bag
        topics = self.topics
        index = _Index()
        for topic in {topics.rgb, topics.depth} - {""}:
            index.stamps[topic] = array("q")
            index.times[topic] = array("q")
        transforms = {t for t, kind in bag.types.items() if kind in ros.TF_TYPES}
        bare = {t for t, kind in bag.types.items() if kind == ros.TRANSFORM_TYPE}
        wanted = {*topics[:5], topics.imu, *transforms, *bare} - {""}
        wanted = {topic for topic in wanted if bag.counts.get(topic)}
        damaged = 0
        for message in bag.all_messages(wanted):
            try:
                self._take_message(index, message)
            except FormatError:
                damaged += 1
        if damaged:
            self._warn(f"{damaged} messages are damaged and left out")
        return index

    def _take_message(self, index: _Index, message: Message) -> None:
        bag = self._bag
        topics = self.topics
        if message.topic in index.stamps:
            # of a damaged header there is a message all the same: they are counted
            index.times[message.topic].append(message.time)
            index.stamps[message.topic].append(-1)
            stamp = ros.stamp_ns(message.data, bag.is_ros1)
            index.stamps[message.topic][-1] = stamp
        elif message.topic in (topics.rgb_info, topics.depth_info):
            if message.topic not in index.infos:
                index.infos[message.topic] = bag.decode(message)
        elif message.topic == topics.imu:
            index.imu.append(ros.imu_row(bag.decode(message)))
        elif message.topic == topics.truth:
            pose = ros.stamped_pose(bag.decode(message))
            if pose is not None:
                index.poses.append(pose)
        else:
            self._take_transforms(index, message)

    def _take_transforms(self, index: _Index, message: Message) -> None:
        count = index.looked_at.get(message.topic, 0)
        index.looked_at[message.topic] = count + 1
        if count >= MAX_TRANSFORMS:
            return
        decoded = self._bag.decode(message)
        if not hasattr(decoded, "transforms"):
            self._take_realsense_extrinsic(index, message.topic, decoded)
            return
        for each in decoded.transforms:
            parent = str(each.header.frame_id).lstrip("/")
            child = str(each.child_frame_id).lstrip("/")
            T = ros.rigid(each.transform.translation, each.transform.rotation)
            if T is None:
                continue
            edge = parent, child
            if edge in index.edges and not _is_same(index.edges[edge], T):
                index.moving.add(edge)
            index.edges.setdefault(edge, T)

    def _take_realsense_extrinsic(
        self, index: _Index, topic: str, transform: Any
    ) -> None:
        """Take the place of a stream in a recording of RealSense's tools.

        ``/device_0/sensor_1/Color_0/tf/0`` maps points of the reference stream 0 into the stream.
        """
        stream, _, group = topic.rpartition("/tf/")
        T_stream_reference = ros.rigid(transform.translation, transform.rotation)
        if stream and T_stream_reference is not None:
            index.edges[(stream, f"reference {group}")] = T_stream_reference

    # -- what the index states -----------------------------------------------------

    def _match(self, index: _Index) -> None:
        """Match colour and depth in time, and fill in the stamps of the frames."""
        rgb_stamps, rgb_order = self._seconds(index, self.topics.rgb)
        times = {
            topic: np.array(each, np.int64) for topic, each in index.times.items()
        }
        self._tape = Tape(self._bag, times)
        if not self.topics.depth:
            self._rgb_at = [int(place) for place in rgb_order]
            self.timestamps = rgb_stamps
            return
        depth_stamps, depth_order = self._seconds(index, self.topics.depth)
        depth_stamps = self._by_colours_clock(depth_stamps)
        pairs = lists.depth_at(rgb_stamps, depth_stamps, self.root, self.warnings)
        self._rgb_at = [int(rgb_order[i]) for i, _ in pairs]
        self._depth_at = [int(depth_order[j]) for _, j in pairs]
        self.timestamps = rgb_stamps[[i for i, _ in pairs]]
        self.depth_timestamps = depth_stamps[[j for _, j in pairs]]

    def _seconds(self, index: _Index, topic: str) -> tuple[np.ndarray, np.ndarray]:
        """The stamps of a topic's images, s, increasing, and the number of each in the bag.

        A message with a damaged header has the stamp -1: it is left out, but keeps its number.
        """
        stamps = np.array(index.stamps[topic], np.int64)
        if not len(stamps):
            notes = "".join(f" {note}" for note in self._bag.notes)
            raise InputError(
                f"{self.root}: no frames: {topic} holds no message.{notes}"
            )
        if not (stamps > 0).any():
            self._warn(
                f"{topic}: headers have no stamps; times of recording are used"
            )
            stamps = np.array(index.times[topic], np.int64)
        order = np.argsort(stamps, kind="stable")
        order = order[stamps[order] >= 0]
        _, first = np.unique(stamps[order], return_index=True)
        if len(first) < len(order):
            count = len(order) - len(first)
            self._warn(
                f"{topic}: {count} images with the stamp of another are left out"
            )
        order = order[first]
        return stamps[order] / 1e9, order

    def _take_lens(self, index: _Index, size: tuple[int, int]) -> None:
        """Take the camera of colour: the user's, else the one in the bag."""
        info = index.infos.get(self.topics.rgb_info)
        self._rgb_frame = self._frame_id(self.topics.rgb)
        if self._given_camera is not None:
            found = parse_camera(self._given_camera, size, self.warnings)
            lens = Lens(found.camera, tuple(found.distortion))
            if self._given_scale is None:
                self._given_scale = found.depth_scale
        elif info is None:
            raise InputError(
                f"{self.root}: no CameraInfo for {self.topics.rgb}: name its topic with "
                "--topic-info, or give --camera fx,fy,cx,cy or FILE."
            )
        else:
            where = f"{self.root}: {self.topics.rgb_info}"
            stated = ros.camera_info(info, where)
            lens = stated.lens
            if is_rectified(self.topics.rgb):
                lens = Lens(stated.rectified)
        if lens.camera.shape != size:
            raise InputError(
                f"{self.root}: images of {self.topics.rgb} are {size[1]}x{size[0]}, the "
                f"camera is for {lens.camera.width}x{lens.camera.height} pixels: give theirs "
                "(--topic-info, or --camera fx,fy,cx,cy or FILE)."
            )
        self._camera = lens.camera
        if not lens.is_straight:
            self._lens = lens.maps()
            model = f" ({lens.model})" if lens.model else ""
            self._warn(
                f"the lens' distortion{model} is taken out of colour and depth"
            )

    def _take_registration(self, index: _Index) -> None:
        """Find out whether depth has to be registered to colour, and by what."""
        self._T_rgb_depth: np.ndarray | None = None
        self._depth_camera: Camera | None = None
        self._depth_lens: UndistortionMaps | None = None
        topics = self.topics
        if not topics.depth:
            return
        size = self._depth_of(0).shape
        same_size = size == self.camera(0).shape
        depth_frame = self._frame_id(topics.depth)
        same_frame = bool(depth_frame) and depth_frame == self._rgb_frame
        if same_size and (is_registered(topics.depth) or same_frame):
            return
        T = ros.transform_between(index.fixed, self._rgb_frame, depth_frame)
        info = index.infos.get(topics.depth_info)
        own_info = topics.depth_info not in ("", topics.rgb_info)
        if T is None or info is None or not own_info:
            self._without_registration(size, same_size, depth_frame)
            return
        stated = ros.camera_info(info, f"{self.root}: {topics.depth_info}")
        lens = stated.lens
        if is_rectified(topics.depth):
            lens = Lens(stated.rectified)
        if lens.camera.shape != size:
            self._without_registration(size, same_size, depth_frame)
            return
        if lens.camera == self.camera(0) and _is_same(T, np.eye(4)):
            return
        self._T_rgb_depth = T
        self._depth_camera = lens.camera
        self._depth_lens = None if lens.is_straight else lens.maps()
        distance = float(np.linalg.norm(T[:3, 3]))
        self._warn(
            f"depth is registered to colour: its camera stands {100 * distance:.3g} cm "
            "from that of colour"
        )

    def _without_registration(
        self, size: tuple[int, ...], same_size: bool, depth_frame: str
    ) -> None:
        """Take depth as registered where it may be, and refuse it where it cannot be."""
        frames = f"frames '{self._rgb_frame}' and '{depth_frame}'"
        if not same_size:
            camera = self.camera(0)
            raise InputError(
                f"{self.root}: depth is {size[1]}x{size[0]}, colour {camera.width}x"
                f"{camera.height} pixels, and the bag has no /tf_static between {frames} with "
                "a CameraInfo of each: record the registered depth (RealSense: "
                "align_depth.enable, topic aligned_depth_to_color)."
            )
        if is_registered(self.topics.depth) or not depth_frame:
            return
        self._assume(
            f"depth is taken as registered to colour, although they are of {frames}: no "
            "/tf_static between them with a CameraInfo of each ('hybridvo doctor' compares "
            "their edges)"
        )

    def _take_truth(self, index: _Index) -> None:
        """Take the true poses of the camera of colour, which may be those of a body."""
        if not index.poses:
            return
        child = index.poses[0].child
        T_child_rgb = ros.transform_between(index.fixed, child, self._rgb_frame)
        if T_child_rgb is None:
            T_child_rgb = np.eye(4)
            whose = f"frame '{child}'" if child else "a frame that is not named"
            self._assume(
                f"{self.topics.truth} holds poses of {whose}: they are taken as those of the "
                "colour camera"
            )
        stamps = np.array([pose.stamp for pose in index.poses]) / 1e9
        poses = np.array([pose.T for pose in index.poses]) @ T_child_rgb
        where = Path(f"{self.root}: {self.topics.truth}")
        self.poses = lists.poses_at(
            self.timestamps, stamps, poses, where, self.warnings
        )

    def _take_gyroscope(self, index: _Index) -> None:
        """Take the samples of the gyroscope, where it is known how it is fixed to the camera."""
        if not index.imu:
            return
        R_rgb_imu = self._R_rgb_imu(index)
        if R_rgb_imu is None:
            return
        samples = np.array(index.imu)
        samples[:, 0] /= 1e9
        self._take_imu(samples, R_rgb_imu)

    def _R_rgb_imu(self, index: _Index) -> np.ndarray | None:
        """Rotation (3, 3) from the axes of the IMU to those of colour; None: it is not known."""
        if stated := self.chosen.get("imu_rotation"):
            return rotation_of(stated)
        frame = self._frame_id(self.topics.imu)
        T_rgb_imu = ros.transform_between(index.fixed, self._rgb_frame, frame)
        if T_rgb_imu is None:
            self._warn(
                f"{self.topics.imu} is not used: no /tf_static between its frame '{frame}' and "
                f"'{self._rgb_frame}' of the images; state its rotation with --imu-rotation "
                "x,y,z,w"
            )
            return None
        R: np.ndarray = T_rgb_imu[:3, :3]
        return R

    def _take_frame(self, index: _Index) -> None:
        """Take the place of the frame of reference whose path the user asks for."""
        name = self.chosen.get("frame")
        if name is None:
            return
        frame = name.lstrip("/")
        self.T_cam_frame = ros.transform_between(
            index.fixed, self._rgb_frame, frame
        )
        if self.T_cam_frame is None:
            there = sorted({each for edge in index.fixed for each in edge})
            raise InputError(
                f"--frame {name[:100]}: {self.root}: no /tf_static between it and "
                f"'{self._rgb_frame}' of the images; fixed frames: {abbreviated(there) or 'none'}."
            )

    def _unit_of_realsense(self) -> float | None:
        """Units per metre in a recording of RealSense's tools, which states metres per unit."""
        if not self.topics.depth:
            return None
        sensor = self.topics.depth.rpartition("/Depth_")[0]
        topic = f"{sensor}/option/Depth_Units/value"
        if self._bag.types.get(topic) not in ros.VALUE_TYPES:
            return None
        first = self._bag.first(topic)
        unit = as_number(getattr(first, "data", None))
        return float(f"{1 / unit:.6g}") if 0 < unit < 1 else None

    # -- frames ------------------------------------------------------------------

    def _images(self, index: int) -> FrameImages:
        try:
            rgb = ros.colour_image(
                self._decoded(self.topics.rgb, self._rgb_at[index])
            )
            depth = self._depth_of(index) if self.topics.depth else None
        except FormatError as error:
            raise FormatError(f"{self.name}: frame {index}: {error}") from None
        if depth is not None and self._T_rgb_depth is not None:
            depth = self._registered(depth)
            return straightened(self._lens, rgb, None)._replace(depth=depth)
        return straightened(self._lens, rgb, depth)

    def _registered(self, depth: np.ndarray) -> np.ndarray:
        if self._depth_lens is not None:
            depth = cv2.remap(depth, *self._depth_lens, cv2.INTER_NEAREST)
        camera = self._depth_camera
        T = self._T_rgb_depth
        if camera is None or T is None:
            return depth
        return register_depth(depth, camera, T, self.camera(0))

    def _depth_of(self, index: int) -> np.ndarray:
        """Depth of a frame as its own camera sees it, (H, W) float32 metres."""
        message = self._decoded(self.topics.depth, self._depth_at[index])
        stored = ros.depth_image(message)
        if stored.dtype == np.float32:
            scale = self._given_scale or 1.0
            self._used_scale = scale
            return stored if scale == 1.0 else stored / np.float32(scale)
        depth = stored.astype(np.float32) / np.float32(self._units)
        depth[stored == np.iinfo(stored.dtype).max] = 0.0
        return depth

    def _decoded(self, topic: str, number: int) -> Any:
        data = self._tape.read(topic, number)
        return self._bag.decode(Message(topic, 0, data))

    def _frame_id(self, topic: str) -> str:
        """The frame of reference that the images of a topic name; empty where they name none."""
        if stream := REALSENSE_STREAM.fullmatch(topic):
            # RealSense's recorder writes the same frame into all headers
            return stream[1]
        first = self._bag.first(topic)
        return "" if first is None else str(first.header.frame_id).lstrip("/")


def rotation_of(text: str) -> np.ndarray:
    """Return the rotation (3, 3) that a user states as a quaternion.

    Args:
        text: ``x,y,z,w`` as ROS has them.

    Raises:
        InputError: It is no unit quaternion.

    Example:
        >>> rotation_of("0,0,0.7071,0.7071").round(3).tolist()
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    values = np.array([as_number(part) for part in text.split(",")])
    if values.shape == (4,) and abs(np.linalg.norm(values) - 1) < UNIT_TOLERANCE:
        return np.asarray(Rotation.from_quat(values).as_matrix())
    raise InputError(
        "--imu-rotation: expected the unit quaternion x,y,z,w that turns the axes of the IMU into "
        f"those of the camera (x right, y down, z forward), got '{text[:80]}'. Axes that are those "
        "of the camera: 0,0,0,1."
    )


def summaries_of(bag: Bag) -> list[TopicSummary]:
    """Return what is known of every topic of a bag before it is read."""
    summaries = []
    for name, kind in bag.types.items():
        encoding = ""
        if kind in ros.IMAGE_TYPES:
            first = bag.first(name)
            encoding = "" if first is None else ros.encoding_of(first)
        summaries.append(TopicSummary(name, kind, bag.counts[name], encoding))
    return summaries


def _is_same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two rigid transforms are the same but for rounding."""
    turned = np.abs(a[:3, :3] - b[:3, :3]).max()
    moved = np.linalg.norm(a[:3, 3] - b[:3, 3])
    return bool(turned <= SAME_ANGLE and moved <= SAME_PLACE_M)
