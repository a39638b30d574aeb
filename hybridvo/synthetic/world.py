"""Description of a rendered world: solids with texture, cameras and the camera path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hybridvo.errors import InputError
from hybridvo.geometry import invert
from hybridvo.synthetic.raycast import cast, motion, screen_bounds
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

    def A_cam_body(self, index: int, camera_index: int | None = None) -> np.ndarray:
        """(P, 3, 4) maps, unit shapes of frame ``index`` to the camera of ``camera_index``.

        Without ``camera_index``, to the camera of the same frame.
        """
        A = np.stack(
            [s.A_world_body if np.ndim(s.A_world_body) == 2 else s.A_world_body[index]
             for s in self.solids]
        )  # fmt: skip
        E = invert(self.T_world_cam[index if camera_index is None else camera_index])[:3]
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


def _small_view(camera: Camera, width: int) -> tuple[np.ndarray, int, int]:
    """Intrinsics, height and width of a picture of at most ``width`` columns."""
    ratio = min(1.0, width / camera.width)
    small_width, small_height = round(camera.width * ratio), max(1, round(camera.height * ratio))
    scale = np.diag([small_width / camera.width, small_height / camera.height, 1.0])
    return scale @ camera.K, small_height, small_width


def moving_share(world: World, index: int, width: int = 96) -> tuple[float, float]:
    """Share of the pixels of a frame on movers, and the smallest depth; from a small picture."""
    view = _small_view(world.cameras[index], width)
    A = world.A_cam_body(index)
    depth, hit = cast(world.shapes, invert_affine(A), screen_bounds(A, *view), *view)
    return float(np.mean((world.object_ids[hit] > 0) & (hit >= 0))), float(depth.min())


def dynamic_share(world: World, index: int, width: int = 96, threshold_px: float = 1.0) -> float:
    """Share of the pixels whose flow differs from the camera's own by more than a threshold.

    Seen in a small picture; the threshold is in pixels of the full one. This is the
    ``dynamic_fraction`` of the reports, smaller than the share on movers wherever a mover happens
    to stand nearly still.
    """
    view = _small_view(world.cameras[index], width)
    K1, height, small_width = _small_view(world.cameras[index + 1], width)
    A = world.A_cam_body(index)
    B = invert_affine(A)
    depth, hit = cast(world.shapes, B, screen_bounds(A, *view), *view)
    flows = []
    for A1 in (world.A_cam_body(index + 1), world.A_cam_body(index, index + 1)):
        bounds1 = screen_bounds(A1, K1, height, small_width)
        B1 = invert_affine(A1)
        flows.append(motion(depth, hit, B, view[0], world.shapes, A1, B1, bounds1, K1)[0])
    difference = np.linalg.norm(flows[0] - flows[1], axis=-1)
    return float(np.mean(difference > threshold_px * small_width / world.cameras[index].width))
