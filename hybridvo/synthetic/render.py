"""Scenes of textured solids, rendered with exact depth, flow, visibility and moving objects.

Everything here is ground truth by construction: an oracle, and named so wherever it is used.
"""

from __future__ import annotations

import os
from collections.abc import Sequence as Items
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from hybridvo.data.base import Sequence
from hybridvo.data.image_io import write_cam, write_dpt, write_flo
from hybridvo.errors import InputError
from hybridvo.files import atomic_write, make_folder
from hybridvo.geometry import invert
from hybridvo.synthetic.raycast import cast, motion, screen_bounds, shade
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


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """(H, W, 3) uint8 image, (H, W) float32 depth in metres, inf where nothing is hit, and (H, W)
    int32 object number: 0 static, 1.. movers, -1 where nothing is hit.
    """

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
    def _shapes(self) -> np.ndarray:
        return np.array([s.shape for s in self.solids], dtype=np.int64)

    @property
    def object_ids(self) -> np.ndarray:
        """(P,) int32 object number of every solid; 0 is static."""
        return np.array([s.object_id for s in self.solids], dtype=np.int32)

    def camera(self, index: int) -> Camera:
        """Intrinsics of one frame."""
        return self.cameras[self._check(index)]

    def _check(self, index: int, last: int = 0) -> int:
        if not 0 <= index < self.frames - last:
            what = "pair" if last else "frame"
            raise InputError(
                f"Scene: {what} {index} of {self.frames - last}; "
                f"expected 0 to {self.frames - last - 1}."
            )
        return int(index)

    def _maps(
        self, index: int, camera_index: int, size: tuple[int, int], K: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Maps (P, 3, 4) of the solids of a frame to a camera, their inverses, and their bounds."""
        solids = [s.A_world_body for s in self.solids]
        A = np.stack([A if A.ndim == 2 else A[index] for A in solids])
        E = invert(self.T_world_cam[camera_index])[:3]
        A_cam = E[:, :3] @ A
        A_cam[:, :, 3] += E[:, 3]
        inverse = np.linalg.inv(A_cam[:, :, :3])
        B = np.concatenate([inverse, -inverse @ A_cam[:, :, 3:]], axis=2)
        return A_cam, B, screen_bounds(A_cam, K, *size)

    def _cast(
        self, index: int, size: tuple[int, int], K: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Maps to unit shapes, depth and index of the solid of each pixel of a frame."""
        _, B, bounds = self._maps(index, index, size, K)
        return B, *cast(self._shapes, B, bounds, K, *size)

    def _motion(
        self, index: int, moved: tuple[int, int], size: tuple[int, int], K: Items[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flow of a frame to what ``moved`` says, what is hidden, and the solid of each pixel."""
        B, depth, solid = self._cast(index, size, K[0])
        A1, B1, bounds1 = self._maps(*moved, size, K[1])
        return *motion(depth, solid, B, K[0], self._shapes, A1, B1, bounds1, K[1]), solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        return np.where(solid < 0, np.int32(-1), self.object_ids[solid])

    def render(self, index: int) -> RenderedFrame:
        """One frame: depth and object of the ray through a centre, colour of four rays a pixel."""
        camera = self.camera(index)
        height, width = camera.shape
        _, depth, solid = self._cast(index, camera.shape, camera.K)
        # twice the resolution: u' = 2 u + 0.5 puts the four rays at +-0.25 px of the centre
        K2 = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]) @ camera.K
        B, depth2, solid2 = self._cast(index, (2 * height, 2 * width), K2)
        scale, offset, colours = self._texture()
        light = self.T_world_cam[index][:3, :3].T @ np.asarray(self.light, dtype=float)
        light /= np.linalg.norm(light)
        fine = shade(depth2, solid2, self._shapes, B, K2, scale, offset, colours, light)
        image = 255.0 * fine.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
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
        index = self._check(index, last=1)
        pair = self.cameras[index : index + 2]
        moved = (index + 1, index + 1)
        flow, hidden, solid = self._motion(index, moved, pair[0].shape, [c.K for c in pair])
        return flow.astype(np.float32), hidden, self._object_id(solid) > 0

    def object_id(self, index: int) -> np.ndarray:
        """(H, W) int32 object numbers of a frame, without rendering colour."""
        camera = self.camera(index)
        return self._object_id(self._cast(index, camera.shape, camera.K)[-1])

    def moving_share(self, index: int, width: int = 96) -> tuple[float, float]:
        """Share of the pixels of a frame on movers, and the smallest depth; in a small image."""
        _, depth, hit = self._cast(index, *_small_view(self.cameras[index], width))
        return float(np.mean((self.object_ids[hit] > 0) & (hit >= 0))), float(depth.min())

    def dynamic_share(self, index: int, width: int = 96, threshold_px: float = 1.0) -> float:
        """Share of the pixels whose flow differs from the camera's, in px of the full image."""
        views = [_small_view(camera, width) for camera in self.cameras[index : index + 2]]
        size = views[0][0]
        flows = [
            self._motion(index, (moved, index + 1), size, [K for _, K in views])[0]
            for moved in (index + 1, index)
        ]
        difference = np.linalg.norm(flows[0] - flows[1], axis=-1)
        return float(np.mean(difference > threshold_px * size[1] / self.cameras[index].width))


def _small_view(camera: Camera, width: int) -> tuple[tuple[int, int], np.ndarray]:
    """Size and intrinsics of an image of at most ``width`` columns."""
    ratio = min(1.0, width / camera.width)
    small_width, small_height = round(camera.width * ratio), max(1, round(camera.height * ratio))
    scale = np.diag([small_width / camera.width, small_height / camera.height, 1.0])
    return (small_height, small_width), scale @ camera.K


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
        return self.scene.camera(index)

    def frame(self, index: int) -> Frame:
        """Image and true depth."""
        rendered = self.scene.render(index)
        stamp = float(self.timestamps[index])
        return Frame(rendered.rgb, rendered.depth, self.camera(index), stamp, int(index))

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """True flow from frame ``index`` to the next, (H, W, 2) float32, and no variance."""
        return self.scene.flow(index)[0], None

    def moving(self, index: int) -> np.ndarray:
        """(H, W) bool, True on moving objects."""
        return self.scene.object_id(index) > 0

    def files(self) -> list[Path]:
        """No file is read."""
        return []


def write_sintel(scene: Scene, root: str | os.PathLike[str], name: str) -> None:
    """Writes a scene in the layout of MPI Sintel.

    ``root/training/{clean,depth,camdata_left,invalid}/NAME/frame_0001.*`` for each frame,
    ``{flow,occlusions}`` for each but the last, and ``moving`` (ours: 255 on moving objects).

    Raises:
        InputError: a name that is not a plain folder name.
        OutputError: a file that cannot be written.
    """
    if not name or Path(name).name != name or name in (".", ".."):
        raise InputError(f"sequence name: expected a plain folder name, got {name!r}.")
    base = Path(root) / "training"
    folders = {
        part: base / part / name
        for part in ("clean", "flow", "depth", "camdata_left", "occlusions", "invalid", "moving")
    }
    for folder in folders.values():
        make_folder(folder)
    for index in range(scene.frames):
        stem = f"frame_{index + 1:04d}"
        rendered = scene.render(index)
        camera = scene.camera(index)
        _write_png(folders["clean"] / f"{stem}.png", rendered.rgb[:, :, ::-1])
        write_dpt(folders["depth"] / f"{stem}.dpt", rendered.depth)
        extrinsic = invert(scene.T_world_cam[index])
        write_cam(folders["camdata_left"] / f"{stem}.cam", camera.K, extrinsic)
        _write_png(folders["moving"] / f"{stem}.png", rendered.object_id > 0)
        _write_png(folders["invalid"] / f"{stem}.png", rendered.object_id < 0)
        if index + 1 < scene.frames:
            flow, occlusion, _ = scene.flow(index)
            write_flo(folders["flow"] / f"{stem}.flo", flow)
            _write_png(folders["occlusions"] / f"{stem}.png", occlusion)


def _write_png(path: Path, image: np.ndarray) -> None:
    if image.dtype == bool:
        image = np.where(image, 255, 0).astype(np.uint8)
    with atomic_write(path, "wb") as file:
        file.write(cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes())
