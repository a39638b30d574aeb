"""Exact scenes of a room with textured walls, what can be wrong with them, and what any answer is.

``world`` casts the rays of two cameras into a convex room, so flow, both depths and both images
agree to rounding. Everything here uses the public names and ``hybridvo.core.geometry`` alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hybridvo.core.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.core.results import State
from hybridvo.core.types import Camera, Frame, FramePair

SIZE = (96, 128)
MOTION = (0.02, -0.01, 0.05, 0.002, 0.004, -0.003)
"""Translation in metres and rotation in radians of the left perturbation, see ``se3_exp``."""
OBJECT_MOTION = (0.15, 0.05, 0.0, 0.0, 0.0, 0.05)
WALLS = (
    (0.0, 0.0, 1.0, 6.0),
    (0.3, 0.0, 1.0, 5.0),
    (0.0, 1.0, 0.1, 1.5),
    (-1.0, 0.0, 0.3, 3.0),
    (0.0, -1.0, 0.2, 2.5),
)
"""Planes n . X = d around the camera, metres; a ray ends at the nearest of them."""
CHI2_3SIGMA = 20.06
"""Quantile 0.9973 of chi-square with six degrees of freedom."""
DEGENERATE = ("line", "patch", "plane", "five_motions", "every_pixel_its_own")


def camera(size: tuple[int, int] = SIZE, focal: float | None = None) -> Camera:
    """A camera whose focal length is the image width, centred."""
    height, width = size
    f = float(width) if focal is None else focal
    return Camera(
        f, f, (width - 1) / 2, (height - 1) / 2, height=height, width=width
    )


def another_camera(first: Camera) -> Camera:
    """A camera with images of the same size, and with all other numbers different."""
    return replace(
        first,
        fx=1.08 * first.fx,
        fy=1.05 * first.fy,
        cx=first.cx + 0.03 * first.width,
        cy=first.cy - 0.02 * first.height,
    )


def world(
    size: tuple[int, int] = SIZE,
    motion: Any = MOTION,
    *,
    noise: tuple[float, float] = (0.0, 0.0),
    movers: int = 0,
    texture: bool = True,
    second_depth: bool = True,
    walls: tuple[tuple[float, ...], ...] = WALLS,
    scale: float = 1.0,
    seed: int = 0,
    two_cameras: bool = False,
) -> tuple[FramePair, np.ndarray]:
    """A pair of frames with flow, and its true ``T_curr_prev``.

    Args:
        size: (height, width) in pixels.
        motion: (6,) tangent or (4, 4) pose, at ``scale`` 1.
        noise: standard deviation of the flow in px and of the log depth.
        movers: boards of a fifth of the image width that move by themselves.
        texture: with images or without.
        second_depth: whether the current frame has depth.
        walls: planes of the room.
        scale: of the whole scene with its motion, dimensionless.
        seed: of the noise and the places of the movers.
        two_cameras: whether the current frame has a camera of its own.
    """
    rng = np.random.default_rng(seed)
    K_prev = camera(size)
    K_curr = another_camera(K_prev) if two_cameras else K_prev
    cameras = (K_prev, K_curr)
    T = (
        se3_exp(np.asarray(motion, float))
        if np.shape(motion) == (6,)
        else np.array(motion)
    )
    boards = [
        (rng.uniform(-0.6, 0.6), rng.uniform(-0.4, 0.4)) for _ in range(movers)
    ]
    T_board = se3_exp(np.array(OBJECT_MOTION)) @ T
    depth, on_board, images = [], [], []
    moved = ((np.eye(4), np.eye(4)), (T, T_board))
    for K, (T_cam_world, T_cam_board) in zip(cameras, moved, strict=True):
        z, points, moves = _cast(K, T_cam_world, T_cam_board, walls, boards)
        depth.append(z)
        on_board.append(moves)
        images.append(_paint(points, moves))
    flow = ego_flow(depth[0], T, K_prev, K_curr)
    flow_of_board = ego_flow(depth[0], T_board, K_prev, K_curr)
    flow = np.where(on_board[0][..., None], flow_of_board, flow)
    flow = flow + noise[0] * rng.standard_normal(flow.shape)
    depth = [
        scale * z * np.exp(noise[1] * rng.standard_normal(z.shape)) for z in depth
    ]
    T[:3, 3] *= scale
    prev, curr = (
        Frame(
            images[i] if texture else None,
            depth[i].astype(np.float32) if i == 0 or second_depth else None,
            cameras[i],
            timestamp=0.1 * i,
            index=i,
        )
        for i in (0, 1)
    )
    return FramePair(
        prev, curr, flow.astype(np.float32), flow_source="synthetic"
    ), T


def _cast(
    K: Camera,
    T_cam_world: np.ndarray,
    T_cam_board: np.ndarray,
    walls: Any,
    boards: Any,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (H, W), points (H, W, 3) in the first camera's frame, and which pixels see a board."""
    v, u = np.mgrid[: K.height, : K.width].astype(float)
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones_like(u)], -1)

    def hit(T: np.ndarray, normal: Any, distance: float) -> np.ndarray:
        """Depth at which the rays meet a plane that is given in the frame that ``T`` maps from."""
        inverse = invert(T)
        slope = rays @ inverse[:3, :3].T @ np.asarray(normal)
        with np.errstate(divide="ignore"):
            z = (distance - inverse[:3, 3] @ np.asarray(normal)) / slope
        return np.where(z > 0, z, np.inf)

    z = np.min([hit(T_cam_world, wall[:3], wall[3]) for wall in walls], axis=0)
    points = _transform(invert(T_cam_world), rays * z[..., None])
    moves = np.zeros(K.shape, bool)
    for x, y in boards:
        z_board = hit(T_cam_board, (0.0, 0.0, 1.0), 2.0)
        on = _transform(invert(T_cam_board), rays * z_board[..., None])
        inside = (
            (np.abs(on[..., 0] - x) < 0.2)
            & (np.abs(on[..., 1] - y) < 0.2)
            & (z_board < z)
        )
        z = np.where(inside, z_board, z)
        points[inside] = on[inside]
        moves |= inside
    return z, points, moves


def _transform(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def _paint(points: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """A smooth colour of each point in space, (H, W, 3) uint8."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [
        np.sin(5 * x + 3 * y + 4 * z + k) * np.cos(6 * y - 2 * z + 2 * k)
        + np.sin(11 * x - 7 * y)
        for k in range(3)
    ]
    grey = 128 + 45 * np.stack(waves, -1) * np.where(moves, -1, 1)[..., None]
    return np.clip(grey, 0, 255).astype(np.uint8)


def degenerate(
    kind: str, noise: tuple[float, float] = (0.0, 0.0), seed: int = 0
) -> Any:
    """A pair that does not determine the camera's motion, or not well, and its true motion.

    ``line`` and ``patch``: depth on a line 3 px wide, on 12x12 px. ``plane``: one wall.
    ``five_motions``, ``every_pixel_its_own``: the camera rests and no pixel shows it.
    """
    rng = np.random.default_rng(seed)
    if kind == "plane":
        return world(noise=noise, walls=WALLS[1:2], seed=seed)
    pair, T = world(noise=noise, texture=False, seed=seed)
    height, width = pair.prev.camera.shape
    v, u = np.mgrid[:height, :width]
    if kind in ("line", "patch"):
        line = np.abs(u - width / 2 - 0.4 * (v - height / 2)) <= 1.5
        patch = (np.abs(u - width / 3) < 6) & (np.abs(v - height / 3) < 6)
        return masked(pair, ~(line if kind == "line" else patch), np.nan), T
    if kind == "every_pixel_its_own":
        flow = rng.uniform(-30, 30, (height, width, 2))
    else:
        flow = np.empty((height, width, 2))
        limit = np.array([0.3] * 3 + [0.03] * 3)
        for columns in np.array_split(np.arange(width), 5):
            own = se3_exp(
                rng.uniform(0.5, 1.0, 6) * rng.choice([-1.0, 1.0], 6) * limit
            )
            camera = pair.prev.camera
            flow[:, columns] = ego_flow(pair.prev.depth, own, camera, camera)[
                :, columns
            ]
    curr = replace(pair.curr, depth=None)
    return replace(pair, curr=curr, flow=flow.astype(np.float32)), np.eye(4)


def masked(pair: FramePair, where: np.ndarray, value: float) -> FramePair:
    """The pair with ``value`` in place of the depth of some pixels."""
    depth = np.where(where, np.float32(value), pair.prev.depth)
    return replace(pair, prev=replace(pair.prev, depth=depth.astype(np.float32)))


def _strided(array: np.ndarray) -> np.ndarray:
    wide = np.full(
        (2 * array.shape[0], 3 * array.shape[1], *array.shape[2:]), 1e9, array.dtype
    )
    wide[::2, ::3] = array
    return wide[::2, ::3]


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "float64": lambda a: a.astype(np.float64),
    "big-endian": lambda a: a.astype(">f4"),
    "long-double": lambda a: a.astype(np.longdouble),
    "fortran": np.asfortranarray,
    "backwards": lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
    "strided": _strided,
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape),
    "unaligned": lambda a: np.frombuffer(
        b"x" + a.tobytes(), a.dtype, offset=1
    ).reshape(a.shape),
}
"""The same float32 values in memory as other programs hand them over."""


def with_layout(pair: FramePair, layout: str) -> FramePair:
    """The pair with depth and flow in another memory layout."""
    change = LAYOUTS[layout]
    prev = replace(pair.prev, depth=change(pair.prev.depth))
    return replace(pair, prev=prev, flow=change(pair.flow))


# --- what is asked of an answer -------------------------------------------------------------------


def pose_error(T: np.ndarray, T_expected: np.ndarray) -> tuple[float, float]:
    """Angle in radians and distance in metres between two poses."""
    delta = se3_log(T @ invert(T_expected))
    return float(np.linalg.norm(delta[3:])), float(np.linalg.norm(delta[:3]))


def assert_pose_close(
    T: np.ndarray, T_expected: np.ndarray, *, rad: float, m: float
) -> None:
    angle, distance = pose_error(T, T_expected)
    assert angle <= rad, f"{angle:.3g} rad"
    assert distance <= m, f"{distance:.3g} m"


def normalised_error(motion: Any, T_expected: np.ndarray) -> float:
    """delta^T C^-1 delta, chi-square with six degrees of freedom where the covariance is right."""
    delta = se3_log(motion.T_curr_prev @ invert(T_expected))
    return float(delta @ np.linalg.solve(motion.covariance, delta))


def assert_sane(motion: Any) -> None:
    """What every answer must be, right or wrong: finite, rigid, a status that holds."""
    T, C = motion.T_curr_prev, motion.covariance
    assert T.shape == (4, 4) and C.shape == (6, 6)
    assert np.isfinite(T).all() and np.isfinite(C).all()
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-9
    assert np.linalg.det(T[:3, :3]) > 0 and np.array_equal(T[3], [0, 0, 0, 1])
    assert np.array_equal(C, C.T) and np.linalg.eigvalsh(C)[0] > 0
    numbers = (
        motion.inlier_ratio,
        motion.cost,
        motion.residual_scale_px,
        motion.depth_noise,
    )
    assert np.isfinite(numbers).all() and 0 <= motion.inlier_ratio <= 1
    if motion.weights is not None:
        assert np.isfinite(motion.weights).all()
    assert 0 <= motion.probability <= 1
    assert motion.ok == (motion.status.state is State.OK)
    assert motion.usable == (motion.status.state is not State.FAILED)
    assert "\n" not in repr(motion)
    if not motion.ok:
        assert motion.status.reason.value and motion.status.message
    if not motion.usable:
        assert motion.probability == 0
        assert np.array_equal(T, np.eye(4))


def assert_never_wrong_and_sure(motion: Any, T_expected: np.ndarray) -> None:
    """No answer is ok and outside of three of its own standard deviations."""
    assert_sane(motion)
    if motion.status.state is State.OK:
        assert normalised_error(motion, T_expected) < CHI2_3SIGMA
