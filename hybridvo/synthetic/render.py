"""Rendered sequences with exact depth, flow, visibility, camera path and moving objects.

Everything here is ground truth by construction: an oracle, and named so wherever it is used.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.image_io import write_cam, write_dpt, write_flo
from hybridvo.errors import InputError, OutputError
from hybridvo.files import make_folder
from hybridvo.geometry import invert
from hybridvo.synthetic.raycast import cast, motion, screen_bounds, shade
from hybridvo.synthetic.scenes import compose_world
from hybridvo.synthetic.world import World, invert_affine
from hybridvo.types import Camera, Frame


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One rendered picture.

    Args:
        rgb: (H, W, 3) uint8. depth: (H, W) float32 metres at the pixel centres, inf where nothing
            is hit. object_id: (H, W) int32, 0 static, 1.. movers, -1 where nothing is hit.
    """

    rgb: np.ndarray
    depth: np.ndarray
    object_id: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A world that can be rendered, frame by frame and without memory of other frames.

    Args:
        world: what there is. noise: standard deviation of the sensor noise, grey levels.

    Raises:
        InputError: negative or non-finite noise, or a frame index out of range.
    """

    world: World
    noise: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.noise < 256.0:
            raise InputError(f"Scene.noise: expected 0 to 255 grey levels, got {self.noise}.")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.world.cameras)

    @property
    def T_world_cam(self) -> np.ndarray:
        """(N, 4, 4) camera to world, metres."""
        return self.world.T_world_cam

    def camera(self, index: int) -> Camera:
        """Intrinsics of one frame."""
        return self.world.cameras[self._check(index)]

    def _check(self, index: int, last: int = 0) -> int:
        if not 0 <= index < self.frames - last:
            what = "pair" if last else "frame"
            raise InputError(
                f"Scene: {what} {index} of {self.frames - last}; "
                f"expected 0 to {self.frames - last - 1}."
            )
        return int(index)

    def _cast(self, index: int, K: np.ndarray, height: int, width: int) -> tuple[np.ndarray, ...]:
        """Maps, bounds, depth and solid index of a frame under intrinsics K."""
        A = self.world.A_cam_body(index)
        B = invert_affine(A)
        bounds = screen_bounds(A, K, height, width)
        depth, solid = cast(self.world.shapes, B, bounds, K, height, width)
        return A, B, bounds, depth, solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        return np.where(solid < 0, np.int32(-1), self.world.object_ids[solid])

    def render(self, index: int) -> RenderedFrame:
        """Picture, depth and object number of one frame.

        Depth and object belong to the ray through the pixel centre; the colour is the mean of four
        rays per pixel.
        """
        camera = self.camera(index)
        height, width = camera.shape
        *_, depth, solid = self._cast(index, camera.K, height, width)
        # twice the resolution: u' = 2 u + 0.5 puts the four rays at +-0.25 px of the centre
        K2 = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]) @ camera.K
        _, B, _, depth2, solid2 = self._cast(index, K2, 2 * height, 2 * width)
        scale, offset, colours = self._texture()
        light = self.T_world_cam[index][:3, :3].T @ np.asarray(self.world.light, dtype=float)
        light /= np.linalg.norm(light)
        fine = shade(depth2, solid2, self.world.shapes, B, K2, scale, offset, colours, light)
        image = 255.0 * fine.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))
        if self.noise > 0:
            rng = np.random.default_rng([self.world.seed, index])
            image = image + self.noise * rng.standard_normal(image.shape)
        rgb = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return RenderedFrame(rgb, depth.astype(np.float32), self._object_id(solid))

    def _texture(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lattice scale (P, 3), offset (P, 3) and colours (P, 2, 3) of all solids."""
        solids = self.world.solids
        first = np.stack([np.reshape(s.A_world_body, (-1, 3, 4))[0, :, :3] for s in solids])
        wavelength = np.array([s.wavelength for s in solids])
        scale = np.linalg.norm(first, axis=1) / wavelength[:, None]
        offset = np.random.default_rng([self.world.seed, 1]).uniform(0, 500, (len(solids), 3))
        return scale, offset, np.array([s.colours for s in solids], dtype=float)

    def flow(self, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Exact flow from frame ``index`` to the next one.

        Returns:
            flow (H, W, 2) float32 pixels, NaN where nothing is hit; occlusion (H, W) bool, True
            where the point of the pixel is not visible in the next frame (hidden, or outside the
            image); moving (H, W) bool, True on moving objects.
        """
        index = self._check(index, last=1)
        camera, following = self.world.cameras[index], self.world.cameras[index + 1]
        _, B, _, depth, solid = self._cast(index, camera.K, *camera.shape)
        A1 = self.world.A_cam_body(index + 1)
        bounds1 = screen_bounds(A1, following.K, *following.shape)
        B1, K1 = invert_affine(A1), following.K
        flow, hidden = motion(depth, solid, B, camera.K, self.world.shapes, A1, B1, bounds1, K1)
        return flow.astype(np.float32), hidden, self._object_id(solid) > 0

    def object_id(self, index: int) -> np.ndarray:
        """(H, W) int32 object numbers of a frame, without rendering colour."""
        camera = self.camera(index)
        return self._object_id(self._cast(index, camera.K, *camera.shape)[-1])


def make_scene(
    kind: str,
    seed: int,
    *,
    height: int = 218,
    width: int = 512,
    frames: int | None = None,
    moving: float | None = None,
    zoom: float = 0.0,
    noise: float = 0.0,
) -> Scene:
    """Scene of a family, drawn from a seed.

    Args:
        kind: ``static``; ``light`` (several movers, about 30 % of the pixels); ``pair`` (small
            random); ``heavy_rigid``, ``heavy_deforming``, ``heavy_two``, ``heavy_ten`` (46 to 75 %
            of the pixels moving in every frame).
        seed: the same seed gives the same pictures.
        height: pixels.
        width: pixels.
        frames: default 20, for ``pair`` 2.
        moving: median share of moving pixels; None for the family's own.
        zoom: relative amplitude of a slow change of focal length.
        noise: sensor noise, standard deviation in grey levels.

    Raises:
        InputError: an unknown kind or a value out of range.

    Example:
        >>> scene = make_scene("static", 0, height=16, width=32, frames=2)
        >>> scene.render(0).rgb.shape
        (16, 32, 3)
    """
    if frames is None:
        frames = 2 if kind == "pair" else 20
    world = compose_world(
        kind, seed, height=height, width=width, frames=frames, moving=moving, zoom=zoom
    )
    return Scene(world, noise)


@dataclass(frozen=True, eq=False)
class SyntheticSequence(Sequence):
    """A scene as a sequence, rendered on the fly.

    Args:
        scene: the scene. name: of the sequence. fps: frames per second.
    """

    scene: Scene
    name: str = "synthetic"
    fps: float = 24.0

    kind = "synthetic"
    depth_source = "true"
    has_flow = True
    flow_is_true = True

    @property
    def root(self) -> Path:  # type: ignore[override]
        """There is no folder; the name stands for it."""
        return Path(self.name)

    @property
    def timestamps(self) -> np.ndarray:  # type: ignore[override]
        """(N,) float64 seconds."""
        return np.arange(len(self)) / self.fps

    @property
    def poses(self) -> np.ndarray:  # type: ignore[override]
        """(N, 4, 4) true T_world_cam."""
        return self.scene.T_world_cam

    @property
    def warnings(self) -> list[str]:  # type: ignore[override]
        """Nothing was mended."""
        return []

    def __len__(self) -> int:
        return self.scene.frames

    def camera(self, index: int) -> Camera:
        """Intrinsics of one frame."""
        return self.scene.camera(index)

    def frame(self, index: int) -> Frame:
        """Picture and true depth."""
        rendered = self.scene.render(index)
        stamp = float(self.timestamps[index])
        return Frame(rendered.rgb, rendered.depth, self.camera(index), stamp, int(index))

    def flow(self, index: int) -> tuple[np.ndarray, None]:
        """True flow from frame ``index`` to the next, (H, W, 2) float32, and no variance."""
        return self.scene.flow(index)[0], None

    def occlusion(self, index: int) -> np.ndarray:
        """(H, W) bool, True where a pixel of frame ``index`` is not visible in the next."""
        return self.scene.flow(index)[1]

    def moving(self, index: int) -> np.ndarray:
        """(H, W) bool, True on moving objects."""
        return self.scene.object_id(index) > 0

    def files(self) -> list[Path]:
        """No file is read."""
        return []


def write_sintel(scene: Scene, root: str | os.PathLike[str], name: str) -> None:
    """Writes a scene in the layout of MPI Sintel.

    ``root/training/{clean,depth,camdata_left,invalid}/NAME/frame_0001.*`` for each frame,
    ``{flow,occlusions}`` for each frame but the last, and ``moving`` (ours: 255 on moving objects)
    for each frame.

    Args:
        scene: what to write.
        root: created where absent.
        name: of the sequence, one path part.

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
        _write_mask(folders["moving"] / f"{stem}.png", rendered.object_id > 0)
        _write_mask(folders["invalid"] / f"{stem}.png", rendered.object_id < 0)
        if index + 1 < scene.frames:
            flow, occlusion, _ = scene.flow(index)
            write_flo(folders["flow"] / f"{stem}.flo", flow)
            _write_mask(folders["occlusions"] / f"{stem}.png", occlusion)


def _write_mask(path: Path, mask: np.ndarray) -> None:
    _write_png(path, np.where(mask, 255, 0).astype(np.uint8))


def _write_png(path: Path, image: np.ndarray) -> None:
    done, data = cv2.imencode(".png", np.ascontiguousarray(image))
    if not done:
        raise OutputError(f"{path}: cannot encode a picture of shape {image.shape}.")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot write: {error}.") from error
