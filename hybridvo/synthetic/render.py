"""Scenes of textured solids, rendered with exact depth, flow, visibility and moving objects.

Everything here is ground truth by construction: an oracle, and named so wherever it is used.
"""

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
from hybridvo.errors import InputError
from hybridvo.files import atomic_write, make_folder
from hybridvo.geometry import backproject, invert, pixel_grid, project
from hybridvo.synthetic.draws import carried
from hybridvo.synthetic.raycast import NEAR, cast, shade
from hybridvo.types import Camera, Frame


@dataclass(frozen=True, eq=False)
class Solid:
    """One textured BOX, ELLIPSOID or CYLINDER of :mod:`hybridvo.synthetic.raycast`.

    Args:
        A_world_body: (3, 4), or (N, 3, 4) for one that moves or deforms; metres. The columns are
            the half axes and the centre.
        object_id: 0 for static solids; solids of one mover share a positive number.
        wavelength: metres of the coarsest texture octave.
        colours: (2, 3) in [0, 1], mixed by the texture.
    """

    shape: int
    A_world_body: np.ndarray
    object_id: int = 0
    wavelength: float = 1.6
    colours: tuple[ArrayLike, ArrayLike] = ((0.9, 0.8, 0.7), (0.6, 0.8, 0.9))


class RenderedFrame(NamedTuple):
    """Image, depth in metres (inf: nothing is hit) and object (0 static, 1.. movers, -1 none)."""

    rgb: np.ndarray
    depth: np.ndarray
    object_id: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """Cameras of one size, camera path and solids of N frames.

    Args:
        T_world_cam: (N, 4, 4) metres.
        seed: of the texture and the noise.
        light: direction towards the light, world frame.
        noise: standard deviation of the sensor noise, grey levels.
    """

    cameras: tuple[Camera, ...]
    T_world_cam: np.ndarray
    solids: tuple[Solid, ...]
    seed: int = 0
    light: tuple[float, float, float] = (0.4, -0.8, -0.45)
    noise: float = 0.0

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.cameras)

    @property
    def object_ids(self) -> np.ndarray:
        """(P,) int32 object number of every solid; 0 is static."""
        return np.array([s.object_id for s in self.solids], dtype=np.int32)

    @property
    def _shapes(self) -> np.ndarray:
        return np.array([s.shape for s in self.solids], dtype=np.int64)

    def _maps(self, index: int, camera_index: int) -> tuple[np.ndarray, np.ndarray]:
        """Maps (P, 3, 4) of the solids of a frame to a camera, and their inverses."""
        solids = [s.A_world_body for s in self.solids]
        A = np.stack([A if A.ndim == 2 else A[index] for A in solids])
        A = carried(invert(self.T_world_cam[camera_index]), A)
        inverse = np.linalg.inv(A[:, :, :3])
        return A, np.concatenate([inverse, -inverse @ A[:, :, 3:]], axis=2)

    def _cast(self, index: int, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Maps to unit shapes, depth and index of the solid of each pixel of a frame."""
        A, B = self._maps(index, index)
        return B, *cast(self._shapes, A, B, camera.K, pixel_grid(*camera.shape))

    def _motion(
        self, index: int, moved: tuple[int, int], prev: Camera, curr: Camera
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flow of a frame to what ``moved`` says, what is hidden, and the solid of each pixel."""
        B, depth, solid = self._cast(index, prev)
        A1, B1 = self._maps(*moved)
        points = backproject(np.where(solid >= 0, depth, np.nan), prev)
        change = carried(A1, B)[solid]
        points = (change[..., :3] @ points[..., None])[..., 0] + change[..., 3]
        z = points[..., 2]
        points[~(z > NEAR)] = np.nan
        target = project(points, curr)
        inside = ((target >= -0.5) & (target <= np.array(prev.shape[::-1]) - 0.5)).all(axis=-1)
        nearest, _ = cast(self._shapes, A1, B1, curr.K, target)
        seen = inside & (nearest >= z * (1.0 - 1e-6))  # a surface does not hide itself
        return target - pixel_grid(*prev.shape), ~seen, solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        return np.where(solid < 0, np.int32(-1), self.object_ids[solid])

    def render(self, index: int) -> RenderedFrame:
        """One frame: depth and object of the ray through a centre, colour of four rays a pixel."""
        camera = self.cameras[index]
        _, depth, solid = self._cast(index, camera)
        fine = resize_camera(camera, 2 * camera.height, 2 * camera.width)
        B, depth2, solid2 = self._cast(index, fine)
        light = self.T_world_cam[index][:3, :3].T @ np.asarray(self.light, dtype=float)
        light /= np.linalg.norm(light)
        colour = shade(depth2, solid2, self._shapes, B, fine.K, *self._texture(), light)
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

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(H, W, 2) float32 px exact flow from a frame to the next one, NaN where nothing is hit;
        (H, W) bool, True where the point is hidden or outside in the next frame; (H, W) bool,
        True on moving objects.
        """
        cameras = self.cameras[index], self.cameras[index + 1]
        flow, hidden, solid = self._motion(index, (index + 1, index + 1), *cameras)
        return flow.astype(np.float32), hidden, self._object_id(solid) > 0

    def depth(self, index: int) -> np.ndarray:
        """(H, W) float32 metres of a frame, 0 where nothing is hit."""
        depth = self._cast(index, self.cameras[index])[1]
        return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)

    def object_id(self, index: int) -> np.ndarray:
        """(H, W) int32 object numbers of a frame."""
        return self._object_id(self._cast(index, self.cameras[index])[-1])

    def moving_share(self, index: int, width: int = 96) -> tuple[float, float]:
        """Share of the pixels of a frame on movers, and the smallest depth; in a small image."""
        _, depth, solid = self._cast(index, _small(self.cameras[index], width))
        return float(np.mean(self._object_id(solid) > 0)), float(depth.min())

    def dynamic_share(self, index: int, width: int = 96, threshold_px: float = 1.0) -> float:
        """Share of the pixels whose flow differs from the camera's, in px of the full image."""
        small = [_small(camera, width) for camera in self.cameras[index : index + 2]]
        flows = [self._motion(index, (at, index + 1), *small)[0] for at in (index + 1, index)]
        difference = np.linalg.norm(flows[0] - flows[1], axis=-1)
        ratio = small[0].width / self.cameras[index].width
        return float(np.mean(difference > threshold_px * ratio))


def _small(camera: Camera, columns: int) -> Camera:
    """The camera of an image of at most so many columns."""
    width = min(camera.width, columns)
    height = max(1, round(camera.height * width / camera.width))
    u, v = width / camera.width, height / camera.height
    return Camera(u * camera.fx, v * camera.fy, u * camera.cx, v * camera.cy, height, width)


class SyntheticSequence(Sequence):
    """A scene as a sequence, rendered on the fly; there is no folder, the name stands for it."""

    kind = "synthetic"
    depth_source = "true"
    has_flow = True
    flow_is_true = True

    def __init__(self, scene: Scene, name: str = "synthetic", fps: float = 24.0) -> None:
        self.scene, self.name, self.root = scene, name, Path(name)
        self.timestamps = np.arange(scene.frames) / fps
        self.poses, self.warnings = scene.T_world_cam, []

    def __len__(self) -> int:
        return self.scene.frames

    def camera(self, index: int) -> Camera:
        """Intrinsics of one frame."""
        return self.scene.cameras[index]

    def frame(self, index: int) -> Frame:
        """Image and true depth."""
        rendered, stamp = self.scene.render(index), float(self.timestamps[index])
        return Frame(rendered.rgb, rendered.depth, self.camera(index), stamp, int(index))

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """True flow from frame ``index`` to the next, (H, W, 2) float32, and no variance."""
        return self.scene.flow(index)[0], None

    def files(self) -> list[Path]:
        """No file is read."""
        return []


def write_sintel(scene: Scene, root: str | os.PathLike[str], name: str) -> None:
    """Write a scene in the layout of MPI Sintel.

    ``root/training/{clean,depth,camdata_left,invalid}/NAME/frame_0001.*`` for each frame,
    ``{flow,occlusions}`` for each but the last, and ``moving`` (ours: 255 on moving objects).

    Raises:
        InputError: a name that is not a plain folder name.
        OutputError: a file that cannot be written.
    """
    if Path(name).name != name or name in ("", ".."):
        raise InputError(f"sequence name: expected a plain folder name, got {name!r}.")

    def place(part: str, ending: str) -> Path:
        folder = Path(root) / "training" / part / name
        make_folder(folder)
        return folder / f"frame_{index + 1:04d}.{ending}"

    def write_png(part: str, image: np.ndarray) -> None:
        image = np.where(image, np.uint8(255), np.uint8(0)) if image.dtype == bool else image
        with atomic_write(place(part, "png"), "wb") as file:
            file.write(cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes())

    for index in range(scene.frames):
        rendered = scene.render(index)
        write_png("clean", rendered.rgb[:, :, ::-1])
        write_dpt(place("depth", "dpt"), rendered.depth)
        extrinsic = invert(scene.T_world_cam[index])
        write_cam(place("camdata_left", "cam"), scene.cameras[index].K, extrinsic)
        write_png("moving", rendered.object_id > 0)
        write_png("invalid", rendered.object_id < 0)
        if index + 1 < scene.frames:
            flow, occlusion, _ = scene.flow(index)
            write_flo(place("flow", "flo"), flow)
            write_png("occlusions", occlusion)
