"""Camera geometry and rotations in numpy, on single images in float64: each fact once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridvo.errors import InputError
from hybridvo.types import Camera


def pixel_grid(height: int, width: int) -> np.ndarray:
    """(H, W, 2) float64 pixel coordinates (u, v); (0, 0) is the centre of the top-left pixel."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    return np.stack([u, v], axis=-1)


def backproject(depth: np.ndarray, camera: Camera, index: np.ndarray | None = None) -> np.ndarray:
    """(H, W, 3) points of a depth map, metres; or (N, 3) of its pixels (N, 2) (row, column)."""
    v, u = np.indices(camera.shape) if index is None else index.T
    z = (depth if index is None else depth[v, u]).astype(np.float64)
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(..., 2) pixels of (..., 3) points in the camera frame; NaN for points not in front of it."""
    z = points[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = camera.fx * points[..., 0] / z + camera.cx
        v = camera.fy * points[..., 1] / z + camera.cy
    uv = np.stack([u, v], axis=-1)
    return np.where((z > 0)[..., None], uv, np.nan)


def projection_rows(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (N, 6) of u and v of points (N, 3) in the left tangent, px."""
    x, y, i = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], 1 / points[:, 2]
    zero = np.zeros_like(i)
    return (
        camera.fx * np.stack([i, zero, -x * i, -x * y, 1 + x * x, -y], axis=-1),
        camera.fy * np.stack([zero, i, -y * i, -1 - y * y, x * y, x], axis=-1),
    )


def ego_flow(
    depth: np.ndarray, T_curr_prev: np.ndarray, camera_prev: Camera, camera_curr: Camera
) -> np.ndarray:
    """(H, W, 2) px, pi(K_curr, T_curr_prev D K_prev^-1 x) - x: flow by the camera motion alone
    (paper, equation 8); NaN where depth is invalid or the moved point behind the camera.
    """
    depth = np.asarray(depth, dtype=np.float64)
    valid = np.isfinite(depth) & (depth > 0)
    points = backproject(np.where(valid, depth, np.nan), camera_prev)
    moved = points @ T_curr_prev[:3, :3].T + T_curr_prev[:3, 3]
    return project(moved, camera_curr) - pixel_grid(*camera_prev.shape)


def make_transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(4, 4) homogeneous transform from a rotation matrix and a translation."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """(4, 4) transform from a (3, 4) one, its rotation made orthonormal (polar decomposition)."""
    U, _, Vt = np.linalg.svd(pose[:, :3])
    return make_transform(U @ Vt, pose[:, 3])


def invert(T: np.ndarray) -> np.ndarray:
    """Inverse of (..., 4, 4) rigid transforms."""
    out = np.array(T, dtype=np.float64)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3:] = -out[..., :3, :3] @ T[..., :3, 3:]
    return out


def chain(T_world_prev: np.ndarray, T_curr_prev: np.ndarray) -> np.ndarray:
    """Next camera pose: ``T_world_curr = T_world_prev @ inv(T_curr_prev)``, (4, 4)."""
    # orthonormal again, so that rounding does not accumulate
    return pose_matrix((T_world_prev @ invert(T_curr_prev))[:3])


def se3_exp(delta: np.ndarray) -> np.ndarray:
    """(4, 4) exponential of a 6-vector (translation, rotation); also compiled, for the kernels."""
    delta = np.asarray(delta)
    x, y, z = delta[3], delta[4], delta[5]
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-8:
        a, b, c = 1 - theta2 / 6, 0.5 - theta2 / 24, 1 / 6 - theta2 / 120
    else:
        theta = np.sqrt(theta2)
        a = np.sin(theta) / theta
        b = 2 * np.sin(theta / 2) ** 2 / theta2
        c = (1 - a) / theta2
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    W2 = np.outer(delta[3:], delta[3:]) - theta2 * np.eye(3)
    T = np.eye(4)
    T[:3, :3] += a * W + b * W2
    V = b * W + c * W2
    for i in range(3):
        T[i, 3] = delta[i] + V[i, 0] * delta[0] + V[i, 1] * delta[1] + V[i, 2] * delta[2]
    return T


def se3_log(T: np.ndarray) -> np.ndarray:
    """6-vector (translation, rotation) with ``se3_exp(se3_log(T)) == T``."""
    R, theta = T[:3, :3], float(rotation_angle(T[:3, :3]))
    phi = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    if theta < 3:
        phi /= np.sinc(theta / np.pi)
    else:  # the sine no longer tells the axis
        phi = Rotation.from_matrix(R).as_rotvec()
    c = 1 / 12 if theta < 1e-3 else (1 - theta / (2 * np.tan(theta / 2))) / theta**2
    x, y, z = phi
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    V_inverse = np.eye(3) - 0.5 * W + c * (W @ W)
    return np.concatenate([V_inverse @ T[:3, 3], phi])


def rotation_angle(R: np.ndarray) -> np.ndarray:
    """Geodesic angle in radians of (..., 3, 3) rotation matrices; exact near 0 and pi."""
    # each entry of the axis times twice the sine stands there two times
    sine2 = np.linalg.norm(R - np.swapaxes(R, -1, -2), axis=(-2, -1)) / np.sqrt(2)
    return np.arctan2(sine2, np.trace(R, axis1=-2, axis2=-1) - 1.0)


def euler_deg_to_matrix(angles_deg: np.ndarray) -> np.ndarray:
    """(3, 3) or (N, 3, 3) R = Rx(x) Ry(y) Rz(z) from angles in degrees, as in the paper."""
    return Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()


def matrix_to_euler_deg(R: np.ndarray) -> np.ndarray:
    """(3,) or (N, 3) Euler angles X-Y-Z in degrees with R = Rx Ry Rz, as in the paper."""
    return Rotation.from_matrix(R).as_euler("XYZ", degrees=True)


def ned_to_camera(T_world_cam_ned: np.ndarray) -> np.ndarray:
    """(..., 4, 4) pose in NED axes (x forward, y right, z down) -> in camera axes, both sides."""
    order = [1, 2, 0, 3]
    return np.asarray(T_world_cam_ned, dtype=np.float64)[..., order, :][..., order]


def to_gtsam_covariance(covariance: np.ndarray) -> np.ndarray:
    """Covariances for a GTSAM ``BetweenFactorPose3`` whose measurement is ``T_prev_curr``.

    The inverse of ``Exp(d) T_curr_prev`` is ``T_prev_curr Exp(-d)``: the same covariance on GTSAM's
    side, in the order (rotation, translation). Takes (6, 6) or (N, 6, 6).
    """
    C = np.asarray(covariance)
    if C.ndim not in (2, 3) or C.shape[-2:] != (6, 6):
        raise InputError(f"to_gtsam_covariance: expected (6, 6) or (N, 6, 6), got {C.shape}.")
    return np.roll(C, 3, axis=(-2, -1))


def to_ros_covariance(covariance: np.ndarray, T_prev_curr: np.ndarray) -> np.ndarray:
    """Covariances for the ``geometry_msgs/PoseWithCovariance`` of ``T_prev_curr``.

    ROS keeps (x, y, z, rotation about x, y, z) about the axes of the parent frame, which is the
    previous camera: ``T_prev_curr Exp(-d)`` turned into them by the rotation of ``T_prev_curr``.
    """
    C, T = np.asarray(covariance), np.asarray(T_prev_curr)
    if C.shape[-2:] != (6, 6) or T.shape != (*C.shape[:-2], 4, 4):
        expected = "(6, 6) and (4, 4), or (N, 6, 6) and (N, 4, 4)"
        raise InputError(f"to_ros_covariance: expected {expected}, got {C.shape} and {T.shape}.")
    A = np.zeros_like(C, dtype=np.float64)
    A[..., :3, :3] = A[..., 3:, 3:] = T[..., :3, :3]
    return A @ C @ np.swapaxes(A, -1, -2)


def as_contiguous(array: np.ndarray, dtype: Any = None) -> np.ndarray:
    """Contiguous read-only view: numba compiles a kernel anew, for seconds, for each other kind."""
    view = np.require(array, dtype, ["C", "A"]).view()
    view.flags.writeable = False
    return view


def njit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``numba.njit`` whose cache on disk may fail: each process then compiles for itself."""
    import numba

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(**options)(function)
        except RuntimeError:  # neither the package nor the user's cache folder can be written
            return numba.njit(**options | {"cache": False})(function)

    return decorate
