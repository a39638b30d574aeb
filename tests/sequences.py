"""Tiny sequences of every data set, written byte by byte, with the values they must read back as.

Nothing here uses hybridvo's own writers: the bytes follow the formats' descriptions.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

N = 3
TAG = struct.pack("<f", 202021.25)
XYZW = np.array([0.5, -0.5, 0.5, 0.5])  # a rotation by 120 degrees
R_XYZW = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


@dataclass
class Written:
    """A sequence on disk and its content: what a reader must return."""

    path: Path
    rgb: list[np.ndarray] = field(default_factory=list)
    depth: list[np.ndarray] = field(default_factory=list)
    flow: list[np.ndarray] = field(default_factory=list)
    valid: list[np.ndarray] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    K: list[tuple[float, float, float, float]] = field(default_factory=list)


def image(seed: int, height: int, width: int) -> np.ndarray:
    """(H, W, 3) uint8 RGB."""
    return np.random.default_rng(seed).integers(
        0, 256, (height, width, 3), dtype=np.uint8
    )


def png(path: Path, array: np.ndarray) -> None:
    """PNG of a grey array or of RGB in channel order R, G, B."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bgr = array if array.ndim == 2 else np.ascontiguousarray(array[:, :, ::-1])
    path.write_bytes(cv2.imencode(".png", bgr)[1].tobytes())


def raw_png(path: Path, array: np.ndarray) -> None:
    """PNG through OpenCV's own channel order, as TartanAir's writer does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", array)[1].tobytes())


def npy(path: Path, array: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, array, allow_pickle=False)


def tagged(path: Path, array: np.ndarray) -> None:
    """.flo or .dpt."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = array.shape[:2]
    path.write_bytes(
        TAG + struct.pack("<ii", width, height) + array.astype("<f4").tobytes()
    )


def text(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def depth_map(i: int, height: int, width: int) -> np.ndarray:
    """(H, W) float32 metres on a grid of 1/256 m, one of them far."""
    depth = (
        np.arange(height * width, dtype=np.float32).reshape(height, width) % 200
        + 256
    ) / 128
    depth[0, 0] = 8.0 + i
    return depth.astype(np.float32)


def flow_map(i: int, height: int, width: int) -> np.ndarray:
    """(H, W, 2) float32 px on a grid of 1/64 px."""
    ramp = np.arange(height * width * 2, dtype=np.float32).reshape(height, width, 2)
    return (ramp % 97 - 48 + i).astype(np.float32) / 64


def pose(i: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R_XYZW
    T[:3, 3] = (0.5 * i, -0.25, 2.0 + i)
    return T


def tum_row(stamp: float | str, i: int) -> str:
    return " ".join(map(str, (stamp, *pose(i)[:3, 3], *XYZW))) + "\n"


def write_sintel(root: Path, name: str = "alley_9", images: bool = True) -> Written:
    height, width = 5, 8
    base = root / "training"
    out = Written(base / "clean" / name)
    for i in range(N):
        stem = f"frame_{i + 1:04d}"
        rgb, depth = image(i, height, width), depth_map(i, height, width)
        if images:
            png(base / "clean" / name / f"{stem}.png", rgb)
        tagged(base / "depth" / name / f"{stem}.dpt", depth)
        K = np.array([[10.0 + i, 0, 3.5], [0, 11.0 + i, 2.0], [0, 0, 1]])
        E = np.linalg.inv(pose(i))
        cam = base / "camdata_left" / name / f"{stem}.cam"
        cam.parent.mkdir(parents=True, exist_ok=True)
        cam.write_bytes(
            TAG + K.astype("<f8").tobytes() + E[:3].astype("<f8").tobytes()
        )
        out.rgb.append(rgb)
        out.depth.append(depth)
        out.poses.append(pose(i))
        out.K.append((10.0 + i, 11.0 + i, 3.5, 2.0))
        invalid = np.zeros((height, width), np.uint8)
        invalid[i, 1] = 255
        png(base / "invalid" / name / f"{stem}.png", invalid)
        if i < N - 1:
            tagged(base / "flow" / name / f"{stem}.flo", flow_map(i, height, width))
            occluded = np.zeros((height, width), np.uint8)
            occluded[0, i] = 255
            png(base / "occlusions" / name / f"{stem}.png", occluded)
            out.flow.append(flow_map(i, height, width))
            out.valid.append(invalid == 0)
    return out


def write_tartanair(root: Path, version: int) -> Written:
    height, width = 6, 8
    out = Written(root / "P000")
    name = "left" if version == 1 else "lcam_front"
    lines = []
    for i in range(N):
        rgb, depth = image(i, height, width), depth_map(i, height, width)
        depth[0, 1] = 1e4  # sky
        png(out.path / f"image_{name}" / f"{i:06d}_{name}.png", rgb)
        stem = out.path / f"depth_{name}" / f"{i:06d}_{name}_depth"
        if version == 1:
            npy(stem.with_suffix(".npy"), depth)
        else:
            raw_png(
                stem.with_suffix(".png"),
                depth.view(np.uint8).reshape(height, width, 4),
            )
        out.rgb.append(rgb)
        out.depth.append(depth)
        # camera i metres forward: x in north-east-down, z in camera axes; heading 90 degrees right
        half = float(np.sqrt(0.5))
        lines.append(f"{i} 0 0 0 0 {half!r} {half!r}\n")
        T = np.eye(4)
        # z looks along world x
        T[:3, :3] = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]
        T[2, 3] = i
        out.poses.append(T)
        out.K.append((4.0, 4.0, 3.5, 2.5))
        if i < N - 1:
            flow = flow_map(i, height, width)
            mask = np.zeros((height, width), np.uint8)
            mask[2, i], mask[3, i] = 1, 100
            pair = f"{i:06d}_{i + 1:06d}"
            if version == 1:
                npy(out.path / "flow" / f"{pair}_flow.npy", flow)
                npy(out.path / "flow" / f"{pair}_mask.npy", mask)
            else:
                encoded = np.dstack([flow * 64 + 32768, mask]).astype(np.uint16)
                raw_png(out.path / "flow_lcam_front" / f"{pair}_flow.png", encoded)
            out.flow.append(flow)
            out.valid.append(mask == 0)
    text(out.path / f"pose_{name}.txt", "".join(lines))
    return out


def write_tum(
    root: Path, name: str = "rgbd_dataset_freiburg3_tiny", ns: bool = False
) -> Written:
    height, width = 480, 640
    out = Written(root / name)
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i in range(N):
        seconds = [100.0 + i / 30, 100.005 + i / 30, 99.99 + i / 30]
        if ns:  # of the present epoch; 100 s in nanoseconds could be seconds
            stamps = [str(1_300_000_000 * 10**9 + round(s * 1e9)) for s in seconds]
        else:
            stamps = [f"{s:.6f}" for s in seconds]
        rgb, depth = image(i, height, width), depth_map(i, height, width)
        units = np.round(depth * 5000).astype(np.uint16)
        units[1, 1] = 0
        png(out.path / "rgb" / f"{i}.png", rgb)
        png(out.path / "depth" / f"{i}.png", units)
        lists["rgb"].append(f"{stamps[0]} rgb/{i}.png\n")
        lists["depth"].append(f"{stamps[1]} depth/{i}.png\n")
        lists["groundtruth"].append(tum_row(stamps[2], i))
        out.rgb.append(rgb)
        out.depth.append(units.astype(np.float32) / np.float32(5000))
        out.poses.append(pose(i))
        out.K.append((535.4, 539.2, 320.1, 247.6))
    for key, lines in lists.items():
        text(out.path / f"{key}.txt", f"# {key}\n" + "".join(lines))
    return out


def write_seven_scenes(root: Path) -> Written:
    height, width = 480, 640
    out = Written(root / "chess" / "seq-01")
    for i in range(N):
        rgb = image(i, height, width)
        units = np.round(depth_map(i, height, width) * 1000).astype(np.uint16)
        units[1, 1], units[1, 2] = 0, 65535
        png(out.path / f"frame-{i:06d}.color.png", rgb)
        png(out.path / f"frame-{i:06d}.depth.png", units)
        rows = "\n".join("\t".join(f"{v:.7e}" for v in row) for row in pose(i))
        text(out.path / f"frame-{i:06d}.pose.txt", rows + "\n")
        depth = units.astype(np.float32) / np.float32(1000)
        depth[1, 2] = 0
        out.rgb.append(rgb)
        out.depth.append(depth)
        out.poses.append(pose(i))
        out.K.append((585.0, 585.0, 320.0, 240.0))
    return out


def write_kitti(root: Path, stereo: bool = False) -> Written:
    height, width = (64, 128) if stereo else (6, 10)
    out = Written(root / "sequences" / "07")
    lines = []
    for i in range(N):
        rgb, depth = image(i, height, width), depth_map(i, height, width)
        png(out.path / "image_2" / f"{i:06d}.png", rgb)
        if stereo:  # everything 8 px nearer in the right image: depth = f b / 8
            depth = np.full((height, width), 20.0 * 0.5 / 8, np.float32)
            right = np.concatenate([rgb[:, 8:], image(i + 50, height, 8)], axis=1)
            png(out.path / "image_3" / f"{i:06d}.png", right)
        else:
            png(
                out.path / "depth" / f"{i:06d}.png", (depth * 256).astype(np.uint16)
            )
        out.rgb.append(rgb)
        out.depth.append(depth)
        # camera 0 moves along z; camera 2 sits 0.25 m to its left: P2 = K [I | (0.25, 0, 0)]
        T = np.eye(4)
        T[2, 3] = i
        lines.append(" ".join(f"{v:.12e}" for v in T[:3].ravel()) + "\n")
        T = T.copy()
        T[0, 3] = -0.25
        out.poses.append(T)
        out.K.append((20.0, 20.0, 4.5, 2.5))
    # baseline (P2 - P3) / fx = (5 + 5) / 20 = 0.5 m
    calibration = "".join(
        f"P{n}: 20 0 4.5 {b} 0 20 2.5 0 0 0 1 0\n"
        for n, b in ((0, 0), (1, -10), (2, 5), (3, -5))
    )
    text(out.path / "calib.txt", calibration + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    text(out.path / "times.txt", "".join(f"{i * 0.1:.6e}\n" for i in range(N)))
    text(root / "poses" / "07.txt", "".join(lines))
    return out


CAMERA_YAML = (
    "fx: 20.0\nfy: 21.0\ncx: 4.5\ncy: 2.5\nwidth: 10\nheight: 6\ndepth_scale: 256\n"
)


def write_folder(root: Path) -> Written:
    height, width = 6, 10
    out = Written(root / "mine")
    for i in range(N):
        rgb, depth = image(i, height, width), depth_map(i, height, width)
        png(out.path / "rgb" / f"f{i + 8}.png", rgb)  # f8, f9, f10: natural order
        png(out.path / "depth" / f"f{i + 8}.png", (depth * 256).astype(np.uint16))
        out.rgb.append(rgb)
        out.depth.append(depth)
        out.poses.append(pose(i))
        out.K.append((20.0, 21.0, 4.5, 2.5))
        if i < N - 1:
            tagged(out.path / "flow" / f"f{i + 8}.flo", flow_map(i, height, width))
            out.flow.append(flow_map(i, height, width))
    text(out.path / "camera.yaml", CAMERA_YAML)
    text(out.path / "poses.txt", "".join(tum_row(i / 4, i) for i in range(N)))
    return out


WRITERS = {
    "sintel": write_sintel,
    "tartanair-v1": lambda root: write_tartanair(root, 1),
    "tartanair-v2": lambda root: write_tartanair(root, 2),
    "tum": write_tum,
    "7scenes": write_seven_scenes,
    "kitti": write_kitti,
    "folder": write_folder,
}
