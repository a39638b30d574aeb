"""Description of a rendered world: solids with texture, cameras and the camera path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridvo.data.raycasting import cast, screen_bounds
from hybridvo.errors import InputError
from hybridvo.geometry import invert
from hybridvo.types import Camera

__all__ = ["Solid", "World", "invert_affine", "moving_share"]


@dataclass(frozen=True, eq=False)
class Solid:
    """One textured unit shape under an affine map.

    Args:
        shape: BOX, ELLIPSOID or CYLINDER of :mod:`hybridvo.data.raycasting`.
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
class World:
    """Cameras, camera path and solids of N frames.

    Args:
        cameras: N cameras of one size. T_world_cam: (N, 4, 4) metres.
        solids: at least one. seed: of the texture.
        light: (3,) direction towards the light, world frame.

    Raises:
        InputError: lengths or shapes that do not fit together.
    """

    cameras: tuple[Camera, ...]
    T_world_cam: np.ndarray
    solids: tuple[Solid, ...]
    seed: int = 0
    light: tuple[float, float, float] = (0.4, -0.8, -0.45)

    def __post_init__(self) -> None:
        frames = len(self.cameras)
        if np.shape(self.T_world_cam) != (frames, 4, 4) or frames == 0:
            raise InputError(
                f"World.T_world_cam: expected ({frames}, 4, 4) for {frames} cameras, at least one, "
                f"got {np.shape(self.T_world_cam)}."
            )
        if len({camera.shape for camera in self.cameras}) != 1:
            raise InputError("World.cameras: all images must have one size.")
        if not self.solids:
            raise InputError("World.solids: expected at least one solid, got none.")
        for number, solid in enumerate(self.solids):
            shape = np.shape(solid.A_world_body)
            if shape not in ((3, 4), (frames, 3, 4)):
                raise InputError(
                    f"World.solids[{number}].A_world_body: expected (3, 4) or ({frames}, 3, 4), "
                    f"got {shape}."
                )

    def A_cam_body(self, index: int) -> np.ndarray:
        """(P, 3, 4) affine maps, unit shapes to the camera of frame ``index``."""
        A = np.stack(
            [s.A_world_body if np.ndim(s.A_world_body) == 2 else s.A_world_body[index]
             for s in self.solids]
        )  # fmt: skip
        E = invert(self.T_world_cam[index])[:3]
        out = E[:, :3] @ A
        out[:, :, 3] += E[:, 3]
        return out

    @property
    def shapes(self) -> np.ndarray:
        """(P,) int64 shape of every solid."""
        return np.array([s.shape for s in self.solids], dtype=np.int64)

    @property
    def object_ids(self) -> np.ndarray:
        """(P,) int32 object number of every solid; 0 is static."""
        return np.array([s.object_id for s in self.solids], dtype=np.int32)


def invert_affine(A: np.ndarray) -> np.ndarray:
    """Inverse of (P, 3, 4) affine maps."""
    inverse = np.linalg.inv(A[:, :, :3])
    return np.concatenate([inverse, -inverse @ A[:, :, 3:]], axis=2)


def moving_share(world: World, index: int, width: int = 96) -> tuple[float, float]:
    """Share of the pixels of a frame on movers, and the smallest depth; from a small picture."""
    camera = world.cameras[index]
    ratio = min(1.0, width / camera.width)
    small_width, small_height = round(camera.width * ratio), max(1, round(camera.height * ratio))
    K = np.diag([ratio, small_height / camera.height, 1.0]) @ camera.K
    A = world.A_cam_body(index)
    bounds = screen_bounds(A, K, small_height, small_width)
    depth, hit = cast(world.shapes, invert_affine(A), bounds, K, small_height, small_width)
    return float(np.mean((world.object_ids[hit] > 0) & (hit >= 0))), float(depth.min())
