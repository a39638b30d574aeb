"""Small sequences on disk whose flow fits their depth, of any length."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from hybridvo.core.geometry import chain, ego_flow, se3_exp
from hybridvo.core.trajectory import Trajectory
from hybridvo.core.types import Camera

REFINE = ("--method", "classical", "--flow", "file", "-q")


def chained(relative, timestamps, T_world_first=None) -> Trajectory:
    """Trajectory of N - 1 motions T_curr_prev and N stamps."""
    poses = [np.eye(4) if T_world_first is None else T_world_first]
    for T_curr_prev in relative:
        poses.append(chain(poses[-1], T_curr_prev))
    return Trajectory(timestamps, np.stack(poses))


def write_walk(
    root: Path,
    frames: int,
    *,
    height: int = 32,
    width: int = 48,
    distinct: int = 40,
    pictures: bool = False,
) -> Path:
    """A sequence in the ``folder`` layout: depth, noisy flow that fits it, true poses.

    Beyond ``distinct`` frames the files are hard links to the first ones.
    """
    camera = Camera(
        width, width, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )
    kinds = {"depth": "npy", "flow": "npy"} | ({"rgb": "png"} if pictures else {})
    for kind in kinds:
        (root / kind).mkdir(parents=True, exist_ok=True)
    lines = [
        f"{name}: {getattr(camera, name)}\n" for name in ("fx", "fy", "cx", "cy")
    ]
    (root / "camera.yaml").write_text(
        f"{''.join(lines)}width: {width}\nheight: {height}\n"
    )
    T, poses = np.eye(4), []
    for i in range(frames):
        k = i % distinct
        xi = np.array(
            [
                0.02 * np.cos(k),
                0.01 * np.sin(k),
                0.015,
                0.002 * np.sin(k),
                0.003,
                0.001,
            ]
        )
        T_curr_prev = se3_exp(xi)
        poses.append(T)
        T = chain(T, T_curr_prev)
        files = {
            kind: root / kind / f"{i:06d}.{suffix}"
            for kind, suffix in kinds.items()
        }
        if i == frames - 1:
            del files["flow"]
        if i < distinct:
            _write_frame(files, k, camera, T_curr_prev)
        else:
            for path in files.values():
                os.link(path.with_stem(f"{k:06d}"), path)
    Trajectory(np.arange(frames) / 30, np.stack(poses)).save(root / "poses.txt")
    return root


def _write_frame(
    files: dict[str, Path], k: int, camera: Camera, T_curr_prev: np.ndarray
) -> None:
    v, u = np.mgrid[: camera.height, : camera.width] / camera.width
    depth = (2 + 0.5 * np.sin(9 * u + k) + 0.3 * np.cos(11 * v)).astype(np.float32)
    np.save(files["depth"], depth)
    if "flow" in files:
        noise = np.random.default_rng(k).normal(0, 0.1, (*camera.shape, 2))
        flow = ego_flow(depth, T_curr_prev, camera, camera) + noise
        np.save(files["flow"], flow.astype(np.float32))
    if "rgb" in files:
        grey = 128 + 50 * np.sin(40 * u + k / 3) + 50 * np.cos(33 * v)
        cv2.imwrite(
            str(files["rgb"]), grey.astype(np.uint8)[..., None].repeat(3, 2)
        )


def command(sequence: Path, out: Path, *options: str) -> list[str]:
    """Arguments of ``hybridvo`` for a run."""
    return ["run", "--sequence", str(sequence), "--out", str(out), *options]
