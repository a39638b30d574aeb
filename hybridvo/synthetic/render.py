"""Scenes of textured solids, rendered with exact depth, flow and moving objects: oracles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from hybridvo.data.image_io import write_cam, write_dpt, write_flo
from hybridvo.data.resize import resize_camera
from hybridvo.data.sequence import Sequence
from hybridvo.files import atomic_write, make_folder
from hybridvo.geometry import backproject, invert, pixel_grid, project
from hybridvo.synthetic.draws import carried
from hybridvo.synthetic.raycast import NEAR, cast, shade
from hybridvo.types import Camera, Frame


@dataclass(frozen=True, eq=False)
class Solid:
    """One textured BOX, ELLIPSOID or CYLINDER of :mod:`hybridvo.synthetic.raycast`."""

    shape: int
    # (3, 4), or (N, 3, 4) where it moves or deforms: half axes and centre in the world, metres
    A_world_body: np.ndarray
    # 0: static; the solids of one moving object share a positive number
    object_id: int = 0
    wavelength: float = 1.6  # of the coarsest texture octave, metres
    # two RGB colours in [0, 1] between which the texture varies
    colours: tuple[ArrayLike, ArrayLike] = ((0.9, 0.8, 0.7), (0.6, 0.8, 0.9))


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera that moves among solids for N frames."""

    camera: Camera
    T_world_cam: np.ndarray  # (N, 4, 4) metres
    solids: tuple[Solid, ...]
    seed: int = 0  # of the texture and the sensor noise
    # direction to the light, world frame
    light: tuple[float, float, float] = (0.4, -0.8, -0.45)
    noise: float = 0.0  # standard deviation of the sensor noise, grey levels

    @property
    def frames(self) -> int:
        """The number of frames."""
        return len(self.T_world_cam)

    def render(self, index: int) -> Frame:
        """Render a frame; its depth is inf where the ray through a pixel's centre hits nothing."""
        camera = self.camera
        depth = self._cast(index, camera)[2]
        # the colour is the mean of four rays a pixel
        fine = resize_camera(camera, 2 * camera.height, 2 * camera.width)
        light = self.T_world_cam[index][:3, :3].T @ np.asarray(
            self.light, dtype=float
        )
        light /= np.linalg.norm(light)
        colour = shade(*self._cast(index, fine), fine.K, *self._texture(), light)
        image = 255.0 * colour.reshape(camera.height, 2, camera.width, 2, 3).mean(
            axis=(1, 3)
        )
        if self.noise > 0:
            rng = np.random.default_rng([self.seed, index])
            image = image + self.noise * rng.standard_normal(image.shape)
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return Frame(rgb, depth.astype(np.float32), camera, index / 24, index)

    def depth(self, index: int) -> np.ndarray:
        """Return the depth of a frame, (H, W) float32 metres, 0 where nothing is hit."""
        depth = self._cast(index, self.camera)[2]
        return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)

    def object_id(self, index: int) -> np.ndarray:
        """Return the object of every pixel, (H, W) int32: 0 static, 1.. moving, -1 none."""
        return self._object_id(self._cast(index, self.camera)[3])

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the true flow to the next frame and which pixels lie on moving objects.

        The flow is (H, W, 2) float32 px, NaN where it is undefined; the pixels are (H, W) bool.
        """
        flow, solid = self._flow(index, self.camera, index + 1)
        return flow.astype(np.float32), self._object_id(solid) > 0

    def moving_share(self, index: int, width: int = 96) -> tuple[float, float]:
        """Return the share of pixels on moving objects and the smallest depth, in a small image."""
        *_, depth, solid = self._cast(index, self._small(width))
        return float(np.mean(self._object_id(solid) > 0)), float(depth.min())

    def dynamic_share(
        self, index: int, width: int = 96, threshold_px: float = 1.0
    ) -> float:
        """Return the share of pixels whose flow is over ``threshold_px`` off the ego flow.

        It is measured in a small image; the threshold is in pixels of the full one.
        """
        small = self._small(width)
        flow, ego_flow = (
            self._flow(index, small, at)[0] for at in (index + 1, index)
        )
        ratio = small.width / self.camera.width
        return float(
            np.mean(np.linalg.norm(flow - ego_flow, axis=-1) > threshold_px * ratio)
        )

    def _maps(self, index: int, camera_index: int) -> np.ndarray:
        """(P, 3, 4) maps of the solids, as they are in a frame, to the camera of a frame."""
        solids = [s.A_world_body for s in self.solids]
        A = np.stack([A if A.ndim == 2 else A[index] for A in solids])
        return carried(invert(self.T_world_cam[camera_index]), A)

    def _cast(self, index: int, camera: Camera) -> tuple[np.ndarray, ...]:
        """Shapes, maps from the camera to them, depth, and the index of each pixel's solid."""
        A = self._maps(index, index)
        inverse = np.linalg.inv(A[:, :, :3])
        B = np.concatenate([inverse, -inverse @ A[:, :, 3:]], axis=2)
        shapes = np.array([s.shape for s in self.solids], dtype=np.int64)
        return shapes, B, *cast(shapes, A, B, camera.K, camera.shape)

    def _flow(
        self, index: int, camera: Camera, at: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow to the next view of the solids as in the frame ``at``, and which of them is seen."""
        _, B, depth, solid = self._cast(index, camera)
        change = carried(self._maps(at, index + 1), B)[solid]
        points = backproject(np.where(solid >= 0, depth, np.nan), camera)
        points = (change[..., :3] @ points[..., None])[..., 0] + change[..., 3]
        points[~(points[..., 2] > NEAR)] = np.nan
        return project(points, camera) - pixel_grid(*camera.shape), solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        return np.array([*(s.object_id for s in self.solids), -1], np.int32)[solid]

    def _texture(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lattice scale (P, 3), offset (P, 3) and colours (P, 2, 3) of all solids."""
        first = np.stack(
            [np.reshape(s.A_world_body, (-1, 3, 4))[0, :, :3] for s in self.solids]
        )
        wavelength = np.array([s.wavelength for s in self.solids])
        scale = np.linalg.norm(first, axis=1) / wavelength[:, None]
        offset = np.random.default_rng([self.seed, 1]).uniform(
            0, 500, (len(self.solids), 3)
        )
        return (
            scale,
            offset,
            np.array([s.colours for s in self.solids], dtype=float),
        )

    def _small(self, columns: int) -> Camera:
        """The camera of an image of at most so many columns."""
        c = self.camera
        width = min(self.camera.width, columns)
        height = max(1, round(c.height * width / c.width))
        u = width / c.width
        v = height / c.height
        return Camera(u * c.fx, v * c.fy, u * c.cx, v * c.cy, height, width)


class SyntheticSequence(Sequence):
    """A scene as a sequence that is rendered on the fly; its name stands for the folder."""

    kind = "synthetic"
    depth_source = "true"
    has_flow = True
    flow_is_true = True

    def __init__(self, scene: Scene, name: str = "synthetic") -> None:
        self.scene = scene
        self.name = name
        self.root = Path(name)
        self.timestamps = np.arange(scene.frames) / 24.0
        self.poses = scene.T_world_cam
        self.warnings = []
        self._camera = scene.camera

    def frame(self, index: int) -> Frame:
        """Render a frame: image and true depth."""
        return self.scene.render(index)

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """Return the true flow to the next frame, (H, W, 2) float32 px; all of it counts."""
        return self.scene.flow(index)[0], None

    def files(self) -> list[Path]:
        """Return no file, for none is read."""
        return []


def write_sintel(scene: Scene, root: str | Path, name: str) -> None:
    """Write a scene in MPI Sintel's layout: ``root/training/PART/name/frame_0001.*`` and on."""

    def place(part: str, ending: str) -> Path:
        folder = Path(root) / "training" / part / name
        make_folder(folder)
        return folder / f"frame_{index + 1:04d}.{ending}"

    for index, T_world_cam in enumerate(scene.T_world_cam):
        frame = scene.render(index)
        with atomic_write(place("clean", "png"), "wb") as file:
            bgr = cv2.cvtColor(np.asarray(frame.rgb), cv2.COLOR_RGB2BGR)
            file.write(cv2.imencode(".png", bgr)[1].tobytes())
        write_dpt(place("depth", "dpt"), np.asarray(frame.depth))
        write_cam(place("camdata_left", "cam"), scene.camera.K, invert(T_world_cam))
        if index + 1 < scene.frames:
            write_flo(place("flow", "flo"), scene.flow(index)[0])
