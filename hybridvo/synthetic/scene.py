"""Solids with texture, cameras and the camera path: what can be rendered, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import invert
from hybridvo.synthetic.raycast import cast, motion, screen_bounds, shade
from hybridvo.types import Camera


@dataclass(frozen=True, eq=False)
class Solid:
    """One textured unit shape under an affine map.

    Args:
        shape: BOX, ELLIPSOID or CYLINDER of :mod:`hybridvo.synthetic.raycast`.
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
    colours: tuple[Sequence[float], Sequence[float]] = ((0.9, 0.8, 0.7), (0.6, 0.8, 0.9))


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One rendered image.

    Args:
        rgb: (H, W, 3) uint8. depth: (H, W) float32 metres at the pixel centres, inf where nothing
            is hit. object_id: (H, W) int32, 0 static, 1.. movers, -1 where nothing is hit.
    """

    rgb: np.ndarray
    depth: np.ndarray
    object_id: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """Cameras, camera path and solids of N frames, each rendered without memory of the others.

    Args:
        cameras: N cameras of one size.
        T_world_cam: (N, 4, 4) metres.
        solids: at least one.
        seed: of the texture and the noise.
        light: (3,) direction towards the light, world frame.
        noise: standard deviation of the sensor noise, grey levels.

    Raises:
        InputError: noise that is negative or not finite, no solid, or a frame out of range.
    """

    cameras: tuple[Camera, ...]
    T_world_cam: np.ndarray
    solids: tuple[Solid, ...]
    seed: int = 0
    light: tuple[float, float, float] = (0.4, -0.8, -0.45)
    noise: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.noise < 256.0:
            raise InputError(f"Scene.noise: expected 0 to 255 grey levels, got {self.noise}.")
        if not self.solids:
            raise InputError("Scene.solids: expected at least one solid, got none.")

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.cameras)

    @property
    def shapes(self) -> np.ndarray:
        """(P,) int64 shape of every solid."""
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
        return B, *cast(self.shapes, B, bounds, K, *size)

    def _motion(
        self, index: int, moved: tuple[int, int], size: tuple[int, int], K: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flow of a frame, what is hidden, and the solid of each pixel.

        ``moved`` says which frame's solids are seen by which frame's camera in the end.
        """
        B, depth, solid = self._cast(index, size, K[0])
        A1, B1, bounds1 = self._maps(*moved, size, K[1])
        return *motion(depth, solid, B, K[0], self.shapes, A1, B1, bounds1, K[1]), solid

    def _object_id(self, solid: np.ndarray) -> np.ndarray:
        return np.where(solid < 0, np.int32(-1), self.object_ids[solid])

    def render(self, index: int) -> RenderedFrame:
        """Image, depth and object number of one frame.

        Depth and object belong to the ray through the pixel centre; the colour is the mean of four
        rays per pixel.
        """
        camera = self.camera(index)
        height, width = camera.shape
        _, depth, solid = self._cast(index, camera.shape, camera.K)
        # twice the resolution: u' = 2 u + 0.5 puts the four rays at +-0.25 px of the centre
        K2 = np.array([[2.0, 0.0, 0.5], [0.0, 2.0, 0.5], [0.0, 0.0, 1.0]]) @ camera.K
        B, depth2, solid2 = self._cast(index, (2 * height, 2 * width), K2)
        scale, offset, colours = self._texture()
        light = self.T_world_cam[index][:3, :3].T @ np.asarray(self.light, dtype=float)
        light /= np.linalg.norm(light)
        fine = shade(depth2, solid2, self.shapes, B, K2, scale, offset, colours, light)
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
        """Exact flow from frame ``index`` to the next one.

        Returns:
            flow (H, W, 2) float32 pixels, NaN where nothing is hit; occlusion (H, W) bool, True
            where the point of the pixel is not visible in the next frame (hidden, or outside the
            image); moving (H, W) bool, True on moving objects.
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
        """Share of the pixels whose flow differs from the camera's own by more than a threshold.

        Seen in a small image; the threshold is in pixels of the full one. This is the
        ``dynamic_fraction`` of the reports, smaller than the share on movers wherever a mover
        happens to stand nearly still.
        """
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
