"""Small recordings of other programs, written byte by byte as their formats have it."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests import sequences as write

FRAMES = 3
SIZE = (24, 32)
"""Height and width of depth."""
K = (40.0, 40.0, 15.5, 11.5)
"""fx fy cx cy of depth."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def millimetres(i: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """(H, W) uint16: a slope, and a hole."""
    height, width = size
    depth = 1000 + 100 * i + np.arange(height * width).reshape(height, width) % 50
    depth[0, 0] = 0
    return depth.astype(np.uint16)


def grey(i: int, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 3) uint8 of one value, which JPEG keeps."""
    return np.full((*size, 3), 40 + 30 * i, np.uint8)


def jpeg(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(image[:, :, ::-1]))[
        1
    ].tobytes()


def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array(
        [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64
    )


def larger(times: int = 2) -> tuple[float, float, float, float]:
    """The intrinsics of the same view with more pixels."""
    fx, fy, cx, cy = K
    return (
        fx * times,
        fy * times,
        times * (cx + 0.5) - 0.5,
        times * (cy + 0.5) - 0.5,
    )


def rows(T: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.9g}" for value in row) for row in T) + "\n"


# -- ScanNet -------------------------------------------------------------------------------------


def scannet(root: Path, times: int = 2) -> Path:
    """What SensReader exports; colour has more pixels than depth."""
    size = (times * SIZE[0], times * SIZE[1])
    for i in range(FRAMES):
        write.text(root / "pose" / f"{i}.txt", rows(write.pose(i)))
        path = root / "color" / f"{i}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(jpeg(grey(i, size)))
        write.png(root / "depth" / f"{i}.png", millimetres(i))
    write.text(root / "intrinsic" / "intrinsic_color.txt", rows(matrix(*larger())))
    write.text(root / "intrinsic" / "intrinsic_depth.txt", rows(matrix(*K)))
    for name in ("extrinsic_color", "extrinsic_depth"):
        write.text(root / "intrinsic" / f"{name}.txt", rows(np.eye(4)))
    return root


def sens_head(frames: int = FRAMES) -> bytes:
    name = b"StructureSensor"
    head = struct.pack("<IQ", 4, len(name)) + name
    for T in (matrix(*larger()), np.eye(4), matrix(*K), np.eye(4)):
        head += struct.pack("<16f", *T.reshape(-1))
    height, width = SIZE
    lengths = (2 * width, 2 * height, width, height)
    return head + struct.pack("<2i4IfQ", 2, 1, *lengths, 1000.0, frames)


def sens_frame(i: int, stamp: int | None = None) -> bytes:
    colour = jpeg(grey(i, (2 * SIZE[0], 2 * SIZE[1])))
    depth = zlib.compress(millimetres(i).astype("<u2").tobytes())
    time = 5_000_000 + 50_000 * i if stamp is None else stamp
    head = struct.pack("<16f", *write.pose(i).reshape(-1))
    head += struct.pack("<4Q", time, time, len(colour), len(depth))
    return head + colour + depth


def sens(path: Path) -> Path:
    """A file of ScanNet, with its frames of the inertial sensor at the end: none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    frames = b"".join(sens_frame(i) for i in range(FRAMES))
    path.write_bytes(sens_head() + frames + struct.pack("<Q", 0))
    return path


# -- color/, depth/ and intrinsics in JSON -------------------------------------------------------


def open3d_camera() -> str:
    """As Open3D writes it: the matrix column by column."""
    fx, fy, cx, cy = K
    columns = [fx, 0, 0, 0, fy, 0, cx, cy, 1]
    return json.dumps(
        {"width": SIZE[1], "height": SIZE[0], "intrinsic_matrix": columns}
    )


def recorder(root: Path, name: str = "camera_intrinsic.json") -> Path:
    for i in range(FRAMES):
        write.png(root / "color" / f"{i:06d}.png", write.image(i, *SIZE))
        write.png(root / "depth" / f"{i:06d}.png", millimetres(i))
    write.text(root / name, open3d_camera())
    return root


# -- Replica -------------------------------------------------------------------------------------


def replica(root: Path, scene_name: str = "room0") -> Path:
    """A scene, whose camera stands beside it; without a name, in it."""
    fx, fy, cx, cy = K
    camera = {"w": SIZE[1], "h": SIZE[0], "fx": fx, "fy": fy, "cx": cx, "cy": cy}
    write.text(
        root / "cam_params.json", json.dumps({"camera": camera | {"scale": 6553.5}})
    )
    scene = root / scene_name
    lines = []
    for i in range(FRAMES):
        write.png(scene / "results" / f"frame{i:06d}.png", write.image(i, *SIZE))
        depth = millimetres(i).astype(np.float64) * 6.5535
        write.png(scene / "results" / f"depth{i:06d}.png", depth.astype(np.uint16))
        lines.append(
            " ".join(f"{value:.17g}" for value in write.pose(i).reshape(-1))
        )
    write.text(scene / "traj.txt", "\n".join(lines) + "\n")
    return scene


# -- transforms.json -----------------------------------------------------------------------------


def nerfstudio(root: Path) -> Path:
    """Images with depth maps of half the size, as of a phone; one camera for each frame."""
    fx, fy, cx, cy = larger()
    frames = []
    for i in reversed(range(FRAMES)):
        write.png(root / "images" / f"frame_{i:05d}.png", write.image(i, 48, 64))
        write.png(root / "depths" / f"frame_{i:05d}.png", millimetres(i))
        frames.append(
            {
                "file_path": f"images/frame_{i:05d}.png",
                "depth_file_path": f"depths/frame_{i:05d}.png",
                "transform_matrix": (write.pose(i) @ OPENGL).tolist(),
                "fl_x": fx + i,
                "fl_y": fy + i,
                # their first pixel has its corner at (0, 0)
                "cx": cx + 0.5,
                "cy": cy + 0.5,
                "w": 64,
                "h": 48,
            }
        )
    content = {"camera_model": "OPENCV", "frames": frames}
    write.text(root / "transforms.json", json.dumps(content))
    return root


def nerfcapture(root: Path) -> Path:
    """As NeRFCapture writes it: names without ending, and a unit of depth of its own."""
    fx, fy, cx, cy = K
    frames = []
    for i in range(FRAMES):
        write.png(root / "images" / f"{i}.png", write.image(i, *SIZE))
        write.png(root / "images" / f"{i}.depth.png", 2 * millimetres(i))
        frames.append(
            {
                "file_path": f"images/{i}",
                "depth_path": f"images/{i}.depth.png",
                "transform_matrix": (write.pose(i) @ OPENGL).tolist(),
            }
        )
    content: dict[str, Any] = {
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx + 0.5,
        "cy": cy + 0.5,
    }
    content |= {"w": SIZE[1], "h": SIZE[0], "integer_depth_scale": 0.0005}
    write.text(root / "transforms.json", json.dumps(content | {"frames": frames}))
    return root


# -- Azure Kinect --------------------------------------------------------------------------------


def element(name: int, content: bytes) -> bytes:
    """An element of EBML: its name, its length in eight bytes, its content."""
    identity = name.to_bytes((name.bit_length() + 7) // 8, "big")
    return identity + (1 << 56 | len(content)).to_bytes(8, "big") + content


def number(name: int, value: int) -> bytes:
    return element(name, value.to_bytes(8, "big"))


def named(name: int, text: str) -> bytes:
    return element(name, text.encode())


COLOUR_SIZE = (720, 1280)
DEPTH_SIZE = (288, 320)


def track(place: int, title: str, code: bytes, size: tuple[int, int]) -> bytes:
    """A track of images, as k4arecorder writes it: of Video for Windows."""
    height, width = size
    bitmap = struct.pack("<IiiHH", 40, width, height, 1, 16) + code + bytes(20)
    inner = number(0xD7, place) + number(0x73C5, 7 * place) + number(0x83, 1)
    inner += named(0x536E, title) + named(0x86, "V_MS/VFW/FOURCC")
    inner += element(0x63A2, bitmap)
    inner += element(0xE0, number(0xB0, width) + number(0xBA, height))
    return element(0xAE, inner)


def kinect_calibration() -> dict[str, Any]:
    """Depth stands 10 cm to the left of colour; nothing is bent but a little of depth."""
    cameras = []
    for purpose, shift, bend in (("Depth", 0.0, 0.01), ("PhotoVideo", -0.1, 0.0)):
        parameters = [0.5, 0.5, 0.5, 0.5, bend, *([0.0] * 9)]
        model = "CALIBRATION_LensDistortionModelBrownConrady"
        cameras.append(
            {
                "Intrinsics": {
                    "ModelParameterCount": 14,
                    "ModelParameters": parameters,
                    "ModelType": model,
                },
                "Purpose": f"CALIBRATION_CameraPurpose{purpose}",
                "Rt": {
                    "Rotation": np.eye(3).reshape(-1).tolist(),
                    "Translation": [shift, 0, 0],
                },
            }
        )
    return {"CalibrationInformation": {"Cameras": cameras}}


def kinect_parts(frames: int = FRAMES) -> list[bytes]:
    """The elements of a segment."""
    info = number(0x2AD7B1, 1_000_000) + named(0x4D80, "libmatroska")
    info += named(0x5741, "k4arecord-1.4.1")
    tracks = track(1, "COLOR", b"MJPG", COLOUR_SIZE)
    tracks += track(2, "DEPTH", b"b16g", DEPTH_SIZE)
    calibration = json.dumps(kinect_calibration()).encode()
    file = named(0x466E, "calibration.json")
    file += named(0x4660, "application/octet-stream") + number(0x46AE, 9)
    attached = element(0x61A7, file + element(0x465C, calibration))
    parts = [
        element(0x1549A966, info),
        element(0x1654AE6B, tracks),
        element(0x1941A469, attached),
    ]
    for i in range(frames):
        blocks = number(0xE7, 100 + 33 * i)
        depth = np.full(DEPTH_SIZE, 1000 + 100 * i, ">u2").tobytes()
        for place, data in ((1, jpeg(grey(i, COLOUR_SIZE))), (2, depth)):
            head = bytes([0x80 | place]) + struct.pack(">hB", 0, 0x80)
            blocks += element(0xA3, head + data)
        parts.append(element(0x1F43B675, blocks))
    return parts


def kinect_file(parts: list[bytes]) -> bytes:
    head = number(0x4286, 1) + number(0x42F7, 1) + number(0x42F2, 4)
    head += number(0x42F3, 8) + named(0x4282, "matroska")
    head += number(0x4287, 4) + number(0x4285, 2)
    return element(0x1A45DFA3, head) + element(0x18538067, b"".join(parts))


def kinect(path: Path, frames: int = FRAMES) -> Path:
    """An ``.mkv`` of an Azure Kinect."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(kinect_file(kinect_parts(frames)))
    return path


# -- EuRoC -----------------------------------------------------------------------------------------


def with_imu(root: Path) -> Path:
    """A recording of EuRoC whose body turns about its x."""
    first = 1_403_715_274_312_143_104
    folder = root / "mav0" / "imu0"
    folder.mkdir()
    lines = ["#timestamp [ns],w_RS_S_x [rad s^-1],..."]
    for k in range(40):
        stamp = first + 5_000_000 * (k - 5)
        lines.append(f"{stamp},0.1,0.0,0.0,0.0,0.0,9.81")
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    return root
