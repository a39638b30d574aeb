"""The reader of ``.mkv`` files of an Azure Kinect, and of Orbbec's Femto, which writes the same.

PyAV takes the packets out of the file. Images are JPEGs or plain pixels, and are decoded here.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from hybridvo.core.checks import as_number
from hybridvo.core.errors import FormatError, InputError, format_errors
from hybridvo.core.files import read_head
from hybridvo.core.geometry import invert
from hybridvo.core.types import Camera
from hybridvo.io.data import lists
from hybridvo.io.data.camera_file import parse_camera
from hybridvo.io.data.image_io import as_pose, decode_bytes
from hybridvo.io.data.streams import (
    FrameImages,
    Lens,
    StreamSequence,
    units_per_metre,
)
from hybridvo.io.data.two_cameras import TwoCameras

SIGNS = (b"K4A_", b"k4arecord")
"""What stands near the begin of such a file, and of no other video."""
SIGN_BYTES = 2**17
"""Bytes at the begin in which it stands: behind the tracks and the calibration."""
MAX_CALIBRATION_BYTES = 2**20
MAX_PACKET_BYTES = 2**26
MICROSECONDS = 1e6
"""Units per second of the times here."""
MILLIMETRES = 1000.0
"""Units per metre of its depth."""
RAW_COLOURS = {
    "nv12": cv2.COLOR_YUV2RGB_NV12,
    "yuyv422": cv2.COLOR_YUV2RGB_YUY2,
    "bgra": cv2.COLOR_BGRA2RGB,
}
"""Formats of colour that is not packed, and the way to RGB."""
PARAMETERS = (
    *("cx", "cy", "fx", "fy", "k1", "k2", "k3", "k4", "k5", "k6"),
    *("codx", "cody", "p2", "p1"),
)
"""Of a camera in the calibration, in this order; the first four by the size of the sensor."""
KEPT = 4
"""Packets of each stream that are kept: a frame is often used twice."""


class Mode(NamedTuple):
    """Which part of the sensor an image shows, as the SDK has it (``transformation``)."""

    sensor: tuple[
        int, int
    ]  # width and height of the whole sensor at this resolution, pixels
    crop: tuple[
        int, int
    ]  # columns and rows that are cut off at the left and the top


DEPTH_MODES = {
    (320, 288): Mode((512, 512), (96, 90)),
    (640, 576): Mode((1024, 1024), (192, 180)),
    (512, 512): Mode((512, 512), (0, 0)),
    (1024, 1024): Mode((1024, 1024), (0, 0)),
}
"""By width and height of depth."""
COLOUR_MODES = {
    (1280, 720): Mode((1280, 960), (0, 120)),
    (1920, 1080): Mode((1920, 1440), (0, 180)),
    (2560, 1440): Mode((2560, 1920), (0, 240)),
    (2048, 1536): Mode((2048, 1536), (0, 0)),
    (3840, 2160): Mode((3840, 2880), (0, 360)),
    (4096, 3072): Mode((4096, 3072), (0, 0)),
}
"""By width and height of colour."""


class KinectSequence(StreamSequence):
    """An ``.mkv`` of an Azure Kinect: colour, depth and the calibration that is attached.

    Depth is registered to colour, and the distortion of both lenses is taken out.
    """

    kind = "kinect"
    choices = ("depth_offset_ms",)
    depth_scale = MILLIMETRES
    markers = (("*.mkv",),)

    @classmethod
    def knows(cls, folder: Path) -> bool:
        """Return whether a path is such a file, or a folder with one."""
        return kinect_file(folder) is not None

    def files(self) -> list[Path]:
        """Return the file."""
        return [self._recording.path]

    def _open(self) -> None:
        path = kinect_file(self.root)
        if path is None:
            raise InputError(f"{self.root}: expected an .mkv of an Azure Kinect.")
        if find_spec("av") is None:
            raise InputError(
                f"{path}: an Azure Kinect recording: PyAV is needed to read it: "
                "pip install 'hybridvo[kinect]'."
            )
        self._recording = recording = KinectPackets(path)
        self._match()
        self._units = units_per_metre(self._given_scale, MILLIMETRES, self.warnings)
        colour, depth, T_colour_depth = calibration_of(
            recording.calibration(),
            recording.colour.size,
            recording.depth.size,
            str(path),
        )
        if self._given_camera is not None:
            shape = colour.camera.shape
            found = parse_camera(self._given_camera, shape, self.warnings)
            colour = Lens(found.camera, tuple(found.distortion))
        self._cameras = TwoCameras(colour, depth, T_colour_depth)
        self._camera = self._cameras.camera

    def _match(self) -> None:
        """Match colour and depth by time."""
        rgb = np.array(self._recording.colour.times) / MICROSECONDS
        depth = np.array(self._recording.depth.times) / MICROSECONDS
        if not len(rgb) or not len(depth):
            lacking = "colour" if not len(rgb) else "depth"
            raise InputError(
                f"{self.root}: no frames: the {lacking} track is empty."
            )
        depth = self._by_colours_clock(depth)
        pairs = lists.depth_at(rgb, depth, self.root, self.warnings)
        self._pairs = [
            (self._recording.colour.times[i], self._recording.depth.times[j])
            for i, j in pairs
        ]
        self.timestamps = rgb[[i for i, _ in pairs]]
        self.depth_timestamps = depth[[j for _, j in pairs]]

    def _images(self, index: int) -> FrameImages:
        where = f"{self._recording.path}: frame {index}"
        colour_time, depth_time = self._pairs[index]
        colour = self._recording.read("colour", colour_time, where)
        rgb = decoded_colour(colour, self._recording.colour, where)
        depth = None
        if self._needs_depth:
            data = self._recording.read("depth", depth_time, where)
            depth = self._depth(data, where)
        return self._cameras.images(rgb, depth)

    def _depth(self, data: bytes, where: str) -> np.ndarray:
        """Depth in metres of big-endian numbers of 16 bits."""
        width, height = self._recording.depth.size
        if len(data) != 2 * width * height:
            raise FormatError(
                f"{where}: depth: expected {2 * width * height} bytes, got {len(data)}."
            )
        stored = np.frombuffer(data, ">u2").reshape(height, width)
        return stored.astype(np.float32) / np.float32(self._units)


def kinect_file(path: Path) -> Path | None:
    """Return the recording that a path is, or that alone is in a folder."""
    if path.is_dir():
        inside = sorted(path.glob("*.mkv"))
        path = inside[0] if len(inside) == 1 else path
    if path.suffix.lower() != ".mkv" or not path.is_file():
        return None
    head = read_head(path, SIGN_BYTES)
    return path if any(sign in head for sign in SIGNS) else None


# -- the file ----------------------------------------------------------------------------


class Track(NamedTuple):
    """A stream of images."""

    place: int  # in the file
    codec: str  # as FFmpeg calls it
    pixels: str  # format of its pixels, likewise
    size: tuple[int, int]  # width and height, pixels
    times: list[int]  # of its images, microseconds, increasing


class KinectPackets:
    """The packets of a recording, by track and time.

    Args:
        path: The file.

    Raises:
        FormatError: It cannot be read, or has no colour or no depth.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._kept: dict[str, dict[int, bytes]] = {"colour": {}, "depth": {}}
        self._container = self._open()
        names = ("COLOR", "DEPTH")
        self.colour, self.depth = (self._track(name) for name in names)
        self._names = {self.colour.place: "colour", self.depth.place: "depth"}
        self._list_times()
        self._packets: Iterator[Any] = iter(())
        self._next_time: int | None = None

    def _open(self) -> Any:
        import av

        try:
            # the format is named, so that no other one is tried
            return av.open(str(self.path), format="matroska")
        # FFmpeg's errors, and those of PyAV
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise FormatError(
                f"{self.path}: expected a Matroska file ({reason})."
            ) from None

    def _track(self, title: str) -> Track:
        """The track of a title; an error where there is none."""
        videos = self._container.streams.video
        found = [s for s in videos if s.metadata.get("title", "").upper() == title]
        if not found:
            there = [str(s.metadata.get("title", "?"))[:40] for s in videos]
            what = "colour" if title == "COLOR" else "depth"
            raise FormatError(
                f"{self.path}: an Azure Kinect recording without {what} (tracks: "
                f"{', '.join(there) or 'none'}): record both."
            )
        stream = found[0]
        codec = stream.codec_context
        if codec is None:
            raise FormatError(
                f"{self.path}: track {title} is of no format that is known."
            )
        size = (int(codec.width), int(codec.height))
        pixels = str(codec.pix_fmt)
        return Track(stream.index, str(codec.name), pixels, size, [])

    def _list_times(self) -> None:
        """Go over the file once: the times of all images."""
        times: dict[str, set[int]] = {"colour": set(), "depth": set()}
        for packet in self._demuxed():
            time = _microseconds(packet)
            name = self._names.get(packet.stream_index)
            if name is not None and time is not None and packet.size:
                times[name].add(time)
        self.colour.times.extend(sorted(times["colour"]))
        self.depth.times.extend(sorted(times["depth"]))

    def _demuxed(self) -> Iterator[Any]:
        """The packets from where the file stands; a damaged rest ends them."""
        wanted = [self._container.streams[place] for place in self._names]
        try:
            yield from self._container.demux(wanted)
        # FFmpeg's errors: what was read before is used
        except Exception:
            return

    def calibration(self) -> dict[str, Any]:
        """The calibration that is attached to the file."""
        for stream in self._container.streams:
            if stream.type != "attachment":
                continue
            name = str(stream.metadata.get("filename", ""))
            if name.endswith(".json") and len(stream.data) <= MAX_CALIBRATION_BYTES:
                return self._parsed(bytes(stream.data))
        raise FormatError(f"{self.path}: no calibration.json is attached to it.")

    def _parsed(self, data: bytes) -> dict[str, Any]:
        try:
            content = json.loads(data.rstrip(b"\0"))
        except (ValueError, RecursionError):
            content = None
        if not isinstance(content, dict):
            raise FormatError(f"{self.path}: calibration.json is no JSON object.")
        return content

    def read(self, name: str, time: int, where: str) -> bytes:
        """Return the bytes of an image.

        Args:
            name: ``colour`` or ``depth``.
            time: Of the image, microseconds.
            where: For a message.
        """
        if time in self._kept[name]:
            return self._kept[name][time]
        if self._next_time is None or time < self._next_time:
            self._seek(time)
        for packet in self._packets:
            passed = _microseconds(packet)
            kind = self._names.get(packet.stream_index)
            if passed is None or kind is None or packet.size > MAX_PACKET_BYTES:
                continue
            self._next_time = passed
            self._keep(kind, passed, bytes(packet))
            if time in self._kept[name]:
                return self._kept[name][time]
            if passed > time and kind == name:
                break
        self._next_time = None
        raise FormatError(f"{where}: {name} is damaged.")

    def _keep(self, name: str, time: int, data: bytes) -> None:
        kept = self._kept[name]
        kept[time] = data
        if len(kept) > KEPT:
            del kept[next(iter(kept))]

    def _seek(self, time: int) -> None:
        """Go to a place before an image."""
        track = self._container.streams[self.colour.place]
        at = int(time / MICROSECONDS / float(track.time_base))
        # tracks are interleaved: the depth of an image may stand before it
        first = min(self.colour.times[0], self.depth.times[0])
        if time <= first:
            at = 0
        self._container.seek(at, stream=track, backward=True, any_frame=False)
        self._packets = self._demuxed()
        self._next_time = time


def _microseconds(packet: Any) -> int | None:
    """The time of a packet; None where it states none."""
    if packet.pts is None or packet.time_base is None:
        return None
    return round(float(packet.pts * packet.time_base) * MICROSECONDS)


def decoded_colour(data: bytes, track: Track, where: str) -> np.ndarray:
    """Decode an image of colour, (H, W, 3) uint8 RGB.

    Args:
        data: The bytes of its packet.
        track: Of the image.
        where: For a message.
    """
    width, height = track.size
    if track.codec == "mjpeg":
        bgr = decode_bytes(data, cv2.IMREAD_COLOR, where, (height, width))
        return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    code = RAW_COLOURS.get(track.pixels)
    if code is None or track.codec != "rawvideo":
        raise FormatError(
            f"{where}: colour is {track.codec} {track.pixels}: expected MJPEG, NV12, YUY2 or "
            "BGRA."
        )
    rows = height * 3 // 2 if track.pixels == "nv12" else height
    channels = {"nv12": 1, "yuyv422": 2, "bgra": 4}[track.pixels]
    if len(data) != rows * width * channels:
        raise FormatError(f"{where}: colour has {len(data)} bytes.")
    pixels = np.frombuffer(data, np.uint8).reshape(rows, width, channels)
    return np.asarray(cv2.cvtColor(pixels, code))


# -- the calibration -----------------------------------------------------------------------


def calibration_of(
    content: dict[str, Any],
    colour_size: tuple[int, int],
    depth_size: tuple[int, int],
    where: str,
) -> tuple[Lens, Lens, np.ndarray]:
    """Return the cameras that a calibration of the sensors states.

    Args:
        content: The attached file.
        colour_size: Width and height of colour, pixels, which tell the mode.
        depth_size: Those of depth.
        where: For messages.

    Returns:
        The camera of colour, that of depth, and the transform from depth to colour, (4, 4).

    Raises:
        FormatError: It states no such cameras.
    """
    colour = _camera_of(content, "PhotoVideo", where)
    depth = _camera_of(content, "Depth", where)
    T_colour_body = _place_of(colour, where)
    T_depth_body = _place_of(depth, where)
    return (
        _lens_of(colour, colour_size, COLOUR_MODES, where),
        _lens_of(depth, depth_size, DEPTH_MODES, where),
        T_colour_body @ invert(T_depth_body),
    )


def _camera_of(content: dict[str, Any], purpose: str, where: str) -> dict[str, Any]:
    """What the calibration states of one of the cameras."""
    information = content.get("CalibrationInformation")
    cameras = information.get("Cameras") if isinstance(information, dict) else None
    for camera in cameras if isinstance(cameras, list) else ():
        if isinstance(camera, dict) and str(camera.get("Purpose")).endswith(
            purpose
        ):
            return camera
    raise FormatError(
        f"{where}: calibration.json: expected a camera for the purpose {purpose}."
    )


def _place_of(camera: dict[str, Any], where: str) -> np.ndarray:
    """The transform (4, 4) from the device into a camera, metres."""
    stated = camera.get("Rt")
    values = stated if isinstance(stated, dict) else {}
    R = _numbers(values.get("Rotation"), 9, "Rotation", where).reshape(3, 3)
    t = _numbers(values.get("Translation"), 3, "Translation", where)
    return as_pose(np.column_stack([R, t]), f"{where}: calibration.json")


def _lens_of(
    camera: dict[str, Any],
    size: tuple[int, int],
    modes: dict[tuple[int, int], Mode],
    where: str,
) -> Lens:
    """The camera for a size of images: the numbers of the file are for the whole sensor."""
    if size not in modes:
        known = ", ".join(f"{width}x{height}" for width, height in modes)
        raise FormatError(
            f"{where}: {size[0]}x{size[1]} pixels are of no mode of an Azure Kinect: {known}."
        )
    stated = camera.get("Intrinsics")
    values = stated if isinstance(stated, dict) else {}
    numbers = _numbers(
        values.get("ModelParameters"), len(PARAMETERS), "ModelParameters", where
    )
    p = dict(zip(PARAMETERS, numbers.tolist(), strict=True))
    model = str(values.get("ModelType"))
    if "BrownConrady" not in model or p["codx"] or p["cody"]:
        raise FormatError(
            f"{where}: calibration.json: distortion model '{model[:60]}': expected "
            "CALIBRATION_LensDistortionModelBrownConrady, centred."
        )
    width, height = modes[size].sensor
    left, top = modes[size].crop
    with format_errors(f"{where}: calibration.json"):
        pinhole = Camera(
            p["fx"] * width,
            p["fy"] * height,
            p["cx"] * width - left - 0.5,
            p["cy"] * height - top - 0.5,
            height=size[1],
            width=size[0],
        )
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return Lens(pinhole, tuple(p[name] for name in order), "rational_polynomial")


def _numbers(stored: Any, count: int, name: str, where: str) -> np.ndarray:
    """Some finite numbers of the calibration."""
    values = stored if isinstance(stored, list) else []
    # the last may be the radius to which the model holds
    numbers = np.array([as_number(value) for value in values[:count]])
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise FormatError(
            f"{where}: calibration.json: {name}: expected {count} numbers, got "
            f"{str(stored)[:80]}."
        )
    return numbers
