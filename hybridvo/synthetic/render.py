"""Scenes of textured solids, rendered with exact depth, flow and moving objects: oracles."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from hybridvo.data.base import Sequence
from hybridvo.data.image_io import write_cam, write_dpt, write_flo
from hybridvo.data.sequence import resize_camera
from hybridvo.files import atomic_write, make_folder
from hybridvo.geometry import backproject, invert, pixel_grid, project
from hybridvo.synthetic.draws import carried
from hybridvo.synthetic.raycast import NEAR, cast, shade
from hybridvo.types import Camera, Frame


@dataclass(frozen=True, eq=False)
class Solid:
    """One textured BOX, ELLIPSOID or CYLINDER of :mod:`hybridvo.synthetic.raycast`."""

    shape: int
    # (3, 4), or (N, 3, 4) where it moves or deforms; metres: the half axes and the centre
    A_world_body: np.ndarray
    object_id: int = 0  # of static solids; those of one mover share a positive number
    wavelength: float = 1.6  # metres of the coarsest texture octave
    # (2, 3) in [0, 1], mixed by the texture
    colours: tuple[ArrayLike, ArrayLike] = ((0.9, 0.8, 0.7), (0.6, 0.8, 0.9))


class RenderedFrame(NamedTuple):
    """Image, depth in metres (inf: nothing is hit) and object (0 static, 1.. movers, -1 none)."""

    rgb: np.ndarray
    depth: np.ndarray
    object_id: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera, its path and the solids of N frames."""

    camera: Camera
    T_world_cam: np.ndarray  # (N, 4, 4) metres
    solids: tuple[Solid, ...]
    seed: int = 0  # of the texture and the noise
    light: tuple[float, float, float] = (0.4, -0.8, -0.45)  # towards it, world frame
    noise: float = 0.0  # standard deviation of the sensor noise, grey levels

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.T_world_cam)

    def _maps(self, index: int, camera_index: int) -> np.ndarray:
        """(P, 3, 4) maps of the solids of a frame to a camera."""
        solids = [s.A_world_body for s in self.solids]
        A = np.stack([A if A.ndim == 2 else A[index] for A in solids])
        return carried(invert(self.T_world_cam[camera_index]), A)

    def _cast(self, index: int, camera: Camera) -> tuple[np.ndarray, ...]:
        """Shapes, maps to them, depth and index of the solid of each pixel of a frame."""
        A = self._maps(index, index)
        inverse = np.linalg.inv(A[:, :, :3])
        B = np.concatenate([inverse, -inverse @ A[:, :, 3:]], axis=2)
        shapes = np.array([s.shape for s in self.solids], dtype=np.int64)
        return shapes, B, *cast(shapes, A, B, camera.K, camera.shape)

    def _flow(self, index: int, camera: Camera, at: int) -> tuple[np.ndarray, np.ndarray]:
        """Flow to the next view of the solids as in the frame ``at``, and which of them is seen."""
        _, B, depth, solid = self._cast(index, camera)
        change = carried(self._maps(at, index + 1), B)[solid]
        points = backproject(np.where(solid >= 0, depth, np.nan), camera)
        points = (change[..., :3] @ points[..., None])[..., 0] + change[..., 3]
        points[~(points[..., 2] > NEAR)] = np.nan
        return project(points, camera) - pixel_grid(*camera.shape), solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        return np.array([*(s.object_id for s in self.solids), -1], np.int32)[solid]

    def render(self, index: int) -> RenderedFrame:
        """One frame: depth and object of the ray through a centre, colour of four rays a pixel."""
        camera = self.camera
        *_, depth, solid = self._cast(index, camera)
        fine = resize_camera(camera, 2 * camera.height, 2 * camera.width)
        light = self.T_world_cam[index][:3, :3].T @ np.asarray(self.light, dtype=float)
        light /= np.linalg.norm(light)
        colour = shade(*self._cast(index, fine), fine.K, *self._texture(), light)
        image = 255.0 * colour.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
        if self.noise > 0:
            rng = np.random.default_rng([self.seed, index])
            image = image + self.noise * rng.standard_normal(image.shape)
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return RenderedFrame(rgb, depth.astype(np.float32), self._object_id(solid))

    def _texture(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lattice scale (P, 3), offset (P, 3) and colours (P, 2, 3) of all solids."""
        first = np.stack([np.reshape(s.A_world_body, (-1, 3, 4))[0, :, :3] for s in self.solids])
        wavelength = np.array([s.wavelength for s in self.solids])
        scale = np.linalg.norm(first, axis=1) / wavelength[:, None]
        offset = np.random.default_rng([self.seed, 1]).uniform(0, 500, (len(self.solids), 3))
        return scale, offset, np.array([s.colours for s in self.solids], dtype=float)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 2) float32 px true flow to the next frame, else NaN; (H, W) bool, what moves."""
        flow, solid = self._flow(index, self.camera, index + 1)
        return flow.astype(np.float32), self._object_id(solid) > 0

    def depth(self, index: int) -> np.ndarray:
        """(H, W) float32 metres of a frame, 0 where nothing is hit."""
        depth = self._cast(index, self.camera)[2]
        return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)

    def object_id(self, index: int) -> np.ndarray:
        """(H, W) int32 object numbers of a frame."""
        return self._object_id(self._cast(index, self.camera)[-1])

    def moving_share(self, index: int, width: int = 96) -> tuple[float, float]:
        """Share of the pixels of a frame on movers, and the smallest depth; in a small image."""
        *_, depth, solid = self._cast(index, self._small(width))
        return float(np.mean(self._object_id(solid) > 0)), float(depth.min())

    def dynamic_share(self, index: int, width: int = 96, threshold_px: float = 1.0) -> float:
        """Share of the pixels whose flow differs from the camera's, in px of the full image."""
        small = self._small(width)
        flow, ego_flow = (self._flow(index, small, at)[0] for at in (index + 1, index))
        ratio = small.width / self.camera.width
        return float(np.mean(np.linalg.norm(flow - ego_flow, axis=-1) > threshold_px * ratio))

    def _small(self, columns: int) -> Camera:
        """The camera of an image of at most so many columns."""
        c, width = self.camera, min(self.camera.width, columns)
        height = max(1, round(c.height * width / c.width))
        u, v = width / c.width, height / c.height
        return Camera(u * c.fx, v * c.fy, u * c.cx, v * c.cy, height, width)


class SyntheticSequence(Sequence):
    """A scene as a sequence, rendered on the fly; there is no folder, the name stands for it."""

    kind = "synthetic"
    depth_source = "true"
    has_flow = True
    flow_is_true = True

    def __init__(self, scene: Scene, name: str = "synthetic") -> None:
        self.scene, self.name, self.root = scene, name, Path(name)
        self.timestamps, self.poses = np.arange(scene.frames) / 24.0, scene.T_world_cam
        self.warnings, self._camera = [], scene.camera

    def frame(self, index: int) -> Frame:
        """Image and true depth."""
        rgb, depth, _ = self.scene.render(index)
        return Frame(rgb, depth, self.scene.camera, float(self.timestamps[index]), int(index))

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """True flow from frame ``index`` to the next, (H, W, 2) float32, and no variance."""
        return self.scene.flow(index)[0], None

    def files(self) -> list[Path]:
        """No file is read."""
        return []


def write_sintel(scene: Scene, root: str | os.PathLike[str], name: str) -> None:
    """Write a scene as MPI Sintel does: ``root/training/PART/NAME/frame_0001.*`` and on."""

    def place(part: str, ending: str) -> Path:
        folder = Path(root) / "training" / part / name
        make_folder(folder)
        return folder / f"frame_{index + 1:04d}.{ending}"

    for index, T_world_cam in enumerate(scene.T_world_cam):
        rendered = scene.render(index)
        with atomic_write(place("clean", "png"), "wb") as file:
            file.write(cv2.imencode(".png", rendered.rgb[:, :, ::-1])[1].tobytes())
        write_dpt(place("depth", "dpt"), rendered.depth)
        write_cam(place("camdata_left", "cam"), scene.camera.K, invert(T_world_cam))
        if index + 1 < scene.frames:
            write_flo(place("flow", "flo"), scene.flow(index)[0])
