"""ORB-SLAM3 and RTAB-Map on the frames of a recording; tools/bench/slam_peers.py calls this.

    python -m bench.slam_systems pyorbslam3 FOLDER VOCABULARY OUT

It is a process of its own: RTAB-Map needs a library that is loaded before all others, either may
break down, and the processor time of a process is that of all of its threads. Both have their
defaults. Each frame gets its time, so that the threads of a map keep up.
"""

from __future__ import annotations

import datetime
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo import Camera, Frame, open_sequence
from hybridvo.core.geometry import invert, make_transform

SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {camera.fx}
Camera1.fy: {camera.fy}
Camera1.cx: {camera.cx}
Camera1.cy: {camera.cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {camera.width}
Camera.height: {camera.height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.075
RGBD.DepthMapFactor: 1.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""
"""Of ORB-SLAM3: those of its example for a TUM camera; it refuses a file without a viewer's."""
AXES = make_transform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
"""RTAB-Map's axes (x ahead, y left, z up) of the camera's."""
LOST = [0.5, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0]
"""Quaternion and translation that RTAB-Map's node makes of a matrix of zeros, its empty answer."""
NEW_MAP_M = 0.02
"""A pose at the origin begins a new map, where the last one was this far from it."""
FRAME_S = 0.06
REST_S = 0.03
"""Time that ORB-SLAM3 gets for a frame, of which its other threads have at least the rest."""
PATIENCE_S = 6.0
"""Time after which RTAB-Map has lost a frame."""


class Answer(NamedTuple):
    """A system's pose of a frame; none where it is lost."""

    T_world_cam: np.ndarray | None
    state: str
    ms: float


def main() -> None:
    package, folder, vocabulary, out = sys.argv[1:]
    cv2.setNumThreads(1)
    sequence = open_sequence(folder)
    frames = [sequence.frame(k) for k in range(len(sequence))]
    if package == "depthai":
        answers = by_rtabmap(frames)
    else:
        answers = by_orbslam3(frames, Path(vocabulary), Path(out))
    poses, states, times = [], [], []
    last = np.eye(4)
    for answer in answers:
        last = last if answer.T_world_cam is None else answer.T_world_cam
        poses.append(last.tolist())
        states.append(answer.state)
        times.append(answer.ms)
    found = {"poses": poses, "states": states[1:], "ms": times[1:]}
    (Path(out) / "tracked.json").write_text(json.dumps(found), encoding="utf-8")
    os._exit(0)  # their threads may never end


def metres(frame: Frame) -> np.ndarray:
    """Depth (H, W), 0 where it is unknown."""
    depth = np.asarray(frame.depth, np.float32)
    return np.where(np.isfinite(depth), depth, np.float32(0))


def by_orbslam3(
    frames: list[Frame], vocabulary: Path, out: Path
) -> Iterator[Answer]:
    """ORB-SLAM3, RGB-D. A new map goes on from the last pose."""
    import pyorbslam3

    settings = out / "settings.yaml"
    settings.write_text(SETTINGS.format(camera=frames[0].camera), encoding="utf-8")
    kind = pyorbslam3.Sensor.RGBD
    slam = pyorbslam3.Slam(str(vocabulary), str(settings), kind, False)
    first = frames[0].timestamp or 0.0
    anchor = last = np.eye(4)
    for frame in frames:
        rgb = np.ascontiguousarray(frame.rgb)
        stamp = (frame.timestamp or 0.0) - first + 1.0
        begin, wall = time.process_time(), time.monotonic()
        found = slam.track_rgbd(rgb, metres(frame), stamp)
        time.sleep(max(REST_S, FRAME_S - (time.monotonic() - wall)))
        ms = 1e3 * (time.process_time() - begin)
        if not found.pose_valid or found.pose_wc is None:
            yield Answer(None, "failed", ms)
            continue
        pose = np.array(found.pose_wc, float)
        moved = invert(anchor) @ last
        if np.allclose(pose, np.eye(4), atol=1e-6) and is_away(moved):
            anchor = last
        last = anchor @ pose
        yield Answer(last, "ok" if found.ok else "degraded", ms)


def is_away(moved: np.ndarray) -> bool:
    """Whether a pose (4, 4) in a map is not its origin."""
    return bool(np.abs(moved - np.eye(4)).max() > NEW_MAP_M)


def by_rtabmap(frames: list[Frame]) -> Iterator[Answer]:
    """RTAB-Map's odometry, frame to map. It takes depth in mm."""
    ask = rtabmap_node(frames[0].camera)
    begin = time.monotonic()
    ask(
        frames[0], begin, 0, 1.0
    )  # only initialises the node: the frame is sent twice
    first = frames[0].timestamp or 0.0
    for number, frame in enumerate(frames, start=1):
        stamp = begin + 1 + (frame.timestamp or 0.0) - first
        started = time.process_time()
        found = ask(frame, stamp, number, PATIENCE_S)
        ms = 1e3 * (time.process_time() - started)
        pose = None if found is None else pose_of(found)
        yield Answer(pose, "failed" if pose is None else "ok", ms)


def pose_of(message: Any) -> np.ndarray | None:
    """The pose (4, 4) of a message, in the axes of the camera; None where RTAB-Map is lost."""
    q, t = message.getQuaternion(), message.getTranslation()
    numbers = np.array([q.qx, q.qy, q.qz, q.qw, t.x, t.y, t.z])
    if np.array_equal(numbers, LOST):
        return None
    R = Rotation.from_quat(numbers[:4]).as_matrix()
    T = make_transform(R, numbers[4:])
    return np.asarray(invert(AXES) @ T @ AXES)


def rtabmap_node(camera: Camera) -> Callable[[Frame, float, int, float], Any]:
    """Start RTAB-Map's node on this machine; return what asks it for the pose of a frame."""
    import depthai as dai

    pipeline = dai.Pipeline(False)
    pipeline.setCalibrationData(calibration(camera))
    node = pipeline.create(dai.node.RTABMapVIO)
    node.setUseFeatures(False)
    images = node.rect.createInputQueue(4, True)
    depths = node.depth.createInputQueue(4, True)
    answers = node.transform.createOutputQueue(16, True)
    for each in pipeline.getAllNodes():
        if hasattr(each, "setRunOnHost"):
            each.setRunOnHost(True)
    pipeline.start()

    def message(array: np.ndarray, kind: Any, seconds: float, number: int) -> Any:
        made = dai.ImgFrame()
        made.setCvFrame(array, kind)
        made.setType(kind)
        made.setWidth(camera.width)
        made.setHeight(camera.height)
        made.setInstanceNum(0)
        stamp = datetime.timedelta(seconds=seconds)
        made.setTimestamp(stamp)
        made.setTimestampDevice(stamp)
        made.setSequenceNum(number)
        return made

    def ask(frame: Frame, seconds: float, number: int, patience_s: float) -> Any:
        kept = pipeline  # else it ends with this function's caller
        grey = cv2.cvtColor(np.asarray(frame.rgb), cv2.COLOR_RGB2GRAY)
        depth = (1000 * metres(frame)).clip(0, 65535).astype(np.uint16)
        end = time.monotonic() + patience_s
        images.send(message(grey, dai.ImgFrame.Type.GRAY8, seconds, number))
        depths.send(message(depth, dai.ImgFrame.Type.RAW16, seconds, number))
        answer = None
        while answer is None and time.monotonic() < end and kept.isRunning():
            answer = answers.tryGet()
            time.sleep(0.004)
        return answer

    return ask


def calibration(camera: Camera) -> Any:
    """A calibration of depthai with a camera in place of all three; written to a file as well."""
    import depthai as dai

    sockets, same = dai.CameraBoardSocket, np.eye(3).tolist()
    left, right, colour = sockets.CAM_B, sockets.CAM_C, sockets.CAM_A
    handler = dai.CalibrationHandler()
    for socket in (colour, left, right):
        K = camera.K.tolist()
        handler.setCameraIntrinsics(socket, K, camera.width, camera.height)
        handler.setDistortionCoefficients(socket, [0.0] * 14)
        handler.setCameraType(socket, dai.CameraModel.Perspective)
    apart_cm, half_cm = [-7.5, 0.0, 0.0], [3.75, 0.0, 0.0]
    handler.setCameraExtrinsics(left, right, same, apart_cm, apart_cm)
    handler.setCameraExtrinsics(right, colour, same, half_cm, half_cm)
    handler.setImuExtrinsics(colour, same, [0.0] * 3, [0.0] * 3)
    handler.setStereoLeft(left, same)
    handler.setStereoRight(right, same)
    handler.eepromToJsonFile(os.environ["CALIBRATION_JSON"])
    return handler


if __name__ == "__main__":
    main()
