"""Scenes of textured solids, rendered with exact depth, flow and moving objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from hybridvo.core.files import make_folder
from hybridvo.core.geometry import backproject, invert, pixel_grid, project
from hybridvo.core.types import Camera, Frame
from hybridvo.io.data.image_io import write_cam, write_dpt, write_flo, write_png
from hybridvo.io.data.resize import resize_camera
from hybridvo.io.data.sequence import Sequence
from hybridvo_lab.synthetic.draws import compose
from hybridvo_lab.synthetic.raycast import NEAR, Hits, cast, shade

FRAME_RATE = 24.0
"""Frames a second of a scene, which gives its timestamps."""


@dataclass(frozen=True, eq=False)
class Solid:
    """One textured BOX, ELLIPSOID or CYLINDER of
    :mod:`hybridvo_lab.synthetic.raycast`.
    """

    shape: int
    # (3, 4), or (N, 3, 4) where it moves or deforms: half axes and centre in the
    # world frame, metres
    A_world_body: np.ndarray
    # 0: static; the solids of one moving object share a positive number
    object_id: int = 0
    wavelength: float = 1.6  # of the coarsest texture octave, metres
    # two RGB colours in [0, 1] between which the texture varies
    colours: tuple[ArrayLike, ArrayLike] = ((0.9, 0.8, 0.7), (0.6, 0.8, 0.9))
    # solids of one number, shape and size look alike; None: like no other
    pattern: int | None = None


class Coverage(NamedTuple):
    """What a frame shows of its moving objects."""

    moving_fraction: float  # fraction of the pixels on moving objects
    min_depth: float  # depth of the nearest surface, metres


class _Texture(NamedTuple):
    """Textures of P solids, as :func:`shade` expects them."""

    # (P, 3) lattice steps of the coarsest octave per unit of the unit shape
    scale: np.ndarray
    offset: np.ndarray  # (P, 3)
    colours: np.ndarray  # (P, 2, 3)


class _View(NamedTuple):
    """The solids as one frame sees them."""

    shapes: np.ndarray  # (P,) int64
    B_body_cam: np.ndarray  # (P, 3, 4) maps from the camera to the unit shapes
    hits: Hits


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
        """Render a frame.

        Its depth is inf where the ray through a pixel's centre hits nothing.
        """
        camera = self.camera
        depth = self._view(index, camera).hits.depth
        image = self._shade(index)
        if self.noise > 0:
            rng = np.random.default_rng([self.seed, index])
            image = image + self.noise * rng.standard_normal(image.shape)
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        time_s = index / FRAME_RATE
        return Frame(rgb, depth.astype(np.float32), camera, time_s, index)

    def _shade(self, index: int) -> np.ndarray:
        """The colours of a frame without noise, (H, W, 3) from 0 to 255."""
        camera = self.camera
        R_cam_world = self.T_world_cam[index][:3, :3].T
        light = R_cam_world @ np.asarray(self.light, dtype=float)
        light /= np.linalg.norm(light)
        # the colour is the mean of four rays a pixel
        fine = resize_camera(camera, 2 * camera.height, 2 * camera.width)
        view = self._view(index, fine)
        colours = shade(
            view.shapes,
            view.B_body_cam,
            *view.hits,
            fine.K,
            *self._texture(),
            light,
        )
        blocks = colours.reshape(camera.height, 2, camera.width, 2, 3)
        return 255.0 * blocks.mean(axis=(1, 3))

    def depth(self, index: int) -> np.ndarray:
        """Return the depth of a frame, (H, W) float32
        metres, 0 where nothing is hit.
        """
        depth = self._view(index, self.camera).hits.depth
        return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)

    def object_id(self, index: int) -> np.ndarray:
        """Return the object of every pixel, (H, W) int32: 0
        static, 1.. moving, -1 none.
        """
        return self._object_id(self._view(index, self.camera).hits.solid)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the true flow to the next frame and which
        pixels lie on moving objects.

        The flow is (H, W, 2) float32 px, NaN where it is undefined;
        the pixels are (H, W) bool.
        """
        flow, solid = self._flow(index, self.camera, index + 1)
        return flow.astype(np.float32), self._object_id(solid) > 0

    def coverage(self, index: int, width: int = 96) -> Coverage:
        """Measure the fraction of the moving objects in an image of
        at most ``width`` columns.
        """
        hits = self._view(index, self._small_camera(width)).hits
        fraction = np.mean(self._object_id(hits.solid) > 0)
        return Coverage(float(fraction), float(hits.depth.min()))

    def dynamic_fraction(
        self, index: int, width: int = 96, threshold_px: float = 1.0
    ) -> float:
        """Return the fraction of the pixels whose flow differs from the ego flow.

        Args:
            index: the first frame of the pair.
            width: columns of the small image that is measured.
            threshold_px: difference from which a pixel
                counts, px of the full image.
        """
        small = self._small_camera(width)
        flow, _ = self._flow(index, small, index + 1)
        ego_flow, _ = self._flow(index, small, index)
        threshold = threshold_px * (small.width / self.camera.width)
        return float(np.mean(np.linalg.norm(flow - ego_flow, axis=-1) > threshold))

    def _maps(self, index: int, camera_index: int) -> np.ndarray:
        """(P, 3, 4) maps of the solids at frame ``index`` to the
        camera of ``camera_index``.
        """
        maps = [solid.A_world_body for solid in self.solids]
        A = np.stack([A if A.ndim == 2 else A[index] for A in maps])
        return compose(invert(self.T_world_cam[camera_index]), A)

    def _view(self, index: int, camera: Camera) -> _View:
        """Cast the rays of a frame."""
        A = self._maps(index, index)
        inverse = np.linalg.inv(A[:, :, :3])
        B = np.concatenate([inverse, -inverse @ A[:, :, 3:]], axis=2)
        shapes = np.array([s.shape for s in self.solids], dtype=np.int64)
        return _View(shapes, B, cast(shapes, A, B, camera.K, camera.shape))

    def _flow(
        self, index: int, camera: Camera, solids_at: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow to the next camera pose with the solids placed
        as in frame ``solids_at``.

        Also returns the index of the solid at every pixel.
        """
        view = self._view(index, camera)
        depth, solid = view.hits
        change = compose(self._maps(solids_at, index + 1), view.B_body_cam)[solid]
        points = backproject(np.where(solid >= 0, depth, np.nan), camera)
        points = (change[..., :3] @ points[..., None])[..., 0] + change[..., 3]
        points[~(points[..., 2] > NEAR)] = np.nan
        return project(points, camera) - pixel_grid(*camera.shape), solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        # the last entry is that of the index -1: no solid
        numbers = [*(s.object_id for s in self.solids), -1]
        return np.array(numbers, np.int32)[solid]

    def _texture(self) -> _Texture:
        """The textures of all solids."""
        first = [s.A_world_body.reshape(-1, 3, 4)[0, :, :3] for s in self.solids]
        wavelength = np.array([s.wavelength for s in self.solids])
        scale = np.linalg.norm(np.stack(first), axis=1) / wavelength[:, None]
        rng = np.random.default_rng([self.seed, 1])
        offset = rng.uniform(0, 500, (len(self.solids), 3))
        for i, solid in enumerate(self.solids):
            if solid.pattern is not None:
                alike = np.random.default_rng([self.seed, 2, solid.pattern])
                offset[i] = alike.uniform(0, 500, 3)
        colours = np.array([s.colours for s in self.solids], dtype=float)
        return _Texture(scale, offset, colours)

    def _small_camera(self, columns: int) -> Camera:
        """The camera of an image of at most so many columns."""
        full = self.camera
        width = min(full.width, columns)
        height = max(1, round(full.height * width / full.width))
        u = width / full.width
        v = height / full.height
        return Camera(
            u * full.fx,
            v * full.fy,
            u * full.cx,
            v * full.cy,
            height=height,
            width=width,
        )


class SyntheticSequence(Sequence):
    """A scene as a sequence that is rendered on demand.

    Its name stands for the folder.
    """

    kind = "synthetic"
    depth_source = "true"
    has_flow = True
    flow_is_true = True

    def __init__(self, scene: Scene, name: str = "synthetic") -> None:
        self._begin(Path(name), name, camera=None, depth_scale=None, mask=None)
        self.scene = scene
        self.timestamps = np.arange(scene.frames) / FRAME_RATE
        self.poses = scene.T_world_cam
        self._camera = scene.camera

    def frame(self, index: int) -> Frame:
        """Render a frame: image and true depth."""
        return self.scene.render(index)

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """Return the true flow to the next frame, (H, W, 2)
        float32 px, and no variance.
        """
        return self.scene.flow(index)[0], None

    def files(self) -> list[Path]:
        """Return no file, because none is read."""
        return []


def write_sintel(scene: Scene, root: str | Path, name: str) -> None:
    """Write a scene in MPI Sintel's layout:
    ``root/training/PART/name/frame_0001.*`` and on.
    """

    def path_of(part: str, ending: str) -> Path:
        folder = Path(root) / "training" / part / name
        make_folder(folder)
        return folder / f"frame_{index + 1:04d}.{ending}"

    for index, T_world_cam in enumerate(scene.T_world_cam):
        frame = scene.render(index)
        bgr = cv2.cvtColor(np.asarray(frame.rgb), cv2.COLOR_RGB2BGR)
        write_png(path_of("clean", "png"), bgr)
        write_dpt(path_of("depth", "dpt"), np.asarray(frame.depth))
        T_cam_world = invert(T_world_cam)
        write_cam(path_of("camdata_left", "cam"), scene.camera.K, T_cam_world)
        if index + 1 < scene.frames:
            write_flo(path_of("flow", "flo"), scene.flow(index)[0])
