"""Camera geometry and rigid motions in numpy, for single images in float64."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hybridvo.errors import InputError
from hybridvo.types import Camera, Frame

# about, of a frame, on which the mean length of a flow is taken
MEAN_FLOW_PIXELS = 300


def pixel_grid(height: int, width: int) -> np.ndarray:
    """Return the pixel coordinates (u, v) of an image, (H, W, 2); (0, 0) is a pixel's centre."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    return np.stack([u, v], axis=-1)


def nearest_pixels(native: int, count: int) -> np.ndarray:
    """Return the row, of ``native`` ones, nearest to the centre of each of so many; or columns."""
    return ((np.arange(count) + 0.5) * native / count).astype(np.intp)


def backproject(
    depth: np.ndarray, camera: Camera, index: np.ndarray | None = None
) -> np.ndarray:
    """Return the points (H, W, 3) of a depth map, metres; or (N, 3) at pixels (row, column)."""
    v, u = np.indices(camera.shape) if index is None else index.T
    z = (depth if index is None else depth[v, u]).astype(np.float64)
    return np.stack(
        [(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z],
        axis=-1,
    )


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Project points (..., 3) of the camera frame to pixels (..., 2), NaN for those behind it."""
    z = points[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = camera.fx * points[..., 0] / z + camera.cx
        v = camera.fy * points[..., 1] / z + camera.cy
    uv = np.stack([u, v], axis=-1)
    return np.where((z > 0)[..., None], uv, np.nan)


def projection_rows(
    points: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (N, 6) of u and of v, px, of points (N, 3) in the left tangent."""
    x = points[:, 0] / points[:, 2]
    y = points[:, 1] / points[:, 2]
    i = 1 / points[:, 2]
    zero = np.zeros_like(i)
    return (
        camera.fx * np.stack([i, zero, -x * i, -x * y, 1 + x * x, -y], axis=-1),
        camera.fy * np.stack([zero, i, -y * i, -1 - y * y, x * y, x], axis=-1),
    )


def ego_flow(
    depth: np.ndarray,
    T_curr_prev: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> np.ndarray:
    """Return the flow of a static scene, pi(K_curr, T_curr_prev D K_prev^-1 x) - x, (H, W, 2) px.

    It is the paper's equation 8; NaN where depth is invalid or the point ends behind the camera.
    """
    depth = np.asarray(depth, dtype=np.float64)
    valid = np.isfinite(depth) & (depth > 0)
    points = backproject(np.where(valid, depth, np.nan), camera_prev)
    moved = points @ T_curr_prev[:3, :3].T + T_curr_prev[:3, 3]
    return project(moved, camera_curr) - pixel_grid(*camera_prev.shape)


def mean_flow(frame: Frame, T_curr_prev: np.ndarray) -> float:
    """Return the mean length of the ego flow of a motion (4, 4), as a share of the image's width.

    It is infinite where the frame has no depth, or a tenth of its points ends behind the camera.
    """
    if frame.depth is None:
        return np.inf
    stride = max(1, round(np.sqrt(frame.depth.size / MEAN_FLOW_PIXELS)))
    rows, columns = np.mgrid[
        stride // 2 : frame.camera.height : stride,
        stride // 2 : frame.camera.width : stride,
    ]
    pixels = np.stack([rows.ravel(), columns.ravel()], axis=1)
    points = backproject(frame.depth, frame.camera, pixels)
    valid = np.isfinite(points[:, 2]) & (points[:, 2] > 0)
    if not valid.any():
        return np.inf
    moved = points[valid] @ T_curr_prev[:3, :3].T + T_curr_prev[:3, 3]
    flow = project(moved, frame.camera) - pixels[valid, ::-1]
    lengths = np.linalg.norm(flow, axis=1)
    seen = np.isfinite(lengths)
    if np.count_nonzero(seen) < 0.9 * len(lengths):
        return np.inf
    return float(lengths[seen].mean() / frame.camera.width)


def make_transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a rotation matrix and a translation."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a (3, 4) one, with the nearest orthonormal rotation."""
    U, _, Vt = np.linalg.svd(pose[:, :3])
    return make_transform(U @ Vt, pose[:, 3])


def invert(T: np.ndarray) -> np.ndarray:
    """Invert rigid transforms (..., 4, 4)."""
    out = np.array(T, dtype=np.float64)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3:] = -out[..., :3, :3] @ T[..., :3, 3:]
    return out


def chain(T_world_prev: np.ndarray, T_curr_prev: np.ndarray) -> np.ndarray:
    """Return the next camera pose, T_world_curr = T_world_prev inv(T_curr_prev), (4, 4)."""
    # orthonormal again, so that rounding does not accumulate
    return pose_matrix((T_world_prev @ invert(T_curr_prev))[:3])


def se3_exp(delta: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a tangent vector (translation, rotation), also for kernels."""
    delta = np.asarray(delta)
    x = delta[3]
    y = delta[4]
    z = delta[5]
    theta2 = x * x + y * y + z * z
    if theta2 < 1e-8:
        a = 1 - theta2 / 6
        b = 0.5 - theta2 / 24
        c = 1 / 6 - theta2 / 120
    else:
        theta = np.sqrt(theta2)
        a = np.sin(theta) / theta
        b = 2 * np.sin(theta / 2) ** 2 / theta2
        c = (1 - a) / theta2
    W = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.eye(4)
    for i in range(3):
        T[i, 3] = delta[i]
        for j in range(3):
            square = delta[3 + i] * delta[3 + j] - theta2 * (i == j)  # of W
            T[i, j] += a * W[i, j] + b * square
            T[i, 3] += (b * W[i, j] + c * square) * delta[j]
    return T


def se3_log(T: np.ndarray) -> np.ndarray:
    """Return the tangent vector (translation, rotation) with ``se3_exp(se3_log(T)) == T``."""
    return np.roll(RigidTransform.from_matrix(T).as_exp_coords(), 3)


def adjoint(T: np.ndarray) -> np.ndarray:
    """Return the matrix (6, 6) with ``T Exp(d) = Exp(adjoint(T) d) T``, of a transform (4, 4)."""
    R = T[:3, :3]
    x, y, z = T[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    A = np.zeros((6, 6))
    A[:3, :3] = R
    A[:3, 3:] = cross @ R
    A[3:, 3:] = R
    return A


def agreement(T: np.ndarray, expected: np.ndarray, covariance: np.ndarray) -> float:
    """Return 1 where a motion is the expected one, less by its distance in standard deviations."""
    delta = se3_log(T @ invert(expected))
    return 1.0 / (
        1.0 + float(delta @ np.linalg.solve(covariance, delta)) / len(delta)
    )


def rotation_angle(R: np.ndarray) -> np.ndarray:
    """Return the angle of rotation matrices (..., 3, 3), radians; it is exact near 0 and pi."""
    # R - R^T holds each component of the axis, times twice the sine of the angle, two times
    sine2 = np.linalg.norm(R - np.swapaxes(R, -1, -2), axis=(-2, -1)) / np.sqrt(2)
    return np.arctan2(sine2, np.trace(R, axis1=-2, axis2=-1) - 1.0)


def euler_deg_to_matrix(angles_deg: np.ndarray) -> np.ndarray:
    """Return R = Rx Ry Rz, (3, 3) or (N, 3, 3), of the paper's Euler angles X-Y-Z, degrees."""
    return Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()


def matrix_to_euler_deg(R: np.ndarray) -> np.ndarray:
    """Return the paper's Euler angles X-Y-Z, degrees, (3,) or (N, 3), with R = Rx Ry Rz."""
    return Rotation.from_matrix(R).as_euler("XYZ", degrees=True)


def ned_to_camera(T_world_cam_ned: np.ndarray) -> np.ndarray:
    """Turn poses (..., 4, 4) from NED axes (x forward, y right, z down) to camera axes."""
    order = [1, 2, 0, 3]
    return np.asarray(T_world_cam_ned, dtype=np.float64)[..., order, :][..., order]


def to_gtsam_covariance(covariance: np.ndarray) -> np.ndarray:
    """Convert (6, 6) or (N, 6, 6) for a GTSAM ``BetweenFactorPose3`` that measures ``T_prev_curr``.

    The inverse of ``Exp(d) T_curr_prev`` is ``T_prev_curr Exp(-d)``, which is GTSAM's side already:
    only the order becomes (rotation, translation).
    """
    C = np.asarray(covariance)
    if C.ndim not in (2, 3) or C.shape[-2:] != (6, 6):
        raise InputError(
            f"to_gtsam_covariance: expected (6, 6) or (N, 6, 6), got {C.shape}."
        )
    return np.roll(C, 3, axis=(-2, -1))


def to_ros_covariance(
    covariance: np.ndarray, T_prev_curr: np.ndarray
) -> np.ndarray:
    """Convert (6, 6) or (N, 6, 6) for ROS's ``PoseWithCovariance`` of ``T_prev_curr``.

    ROS keeps (x, y, z, rotation about x, y, z) in the axes of the parent frame, the previous
    camera, into which the rotation of ``T_prev_curr`` turns the covariance.
    """
    C = np.asarray(covariance)
    T = np.asarray(T_prev_curr)
    if C.shape[-2:] != (6, 6) or T.shape != (*C.shape[:-2], 4, 4):
        expected = "(6, 6) and (4, 4), or (N, 6, 6) and (N, 4, 4)"
        raise InputError(
            f"to_ros_covariance: expected {expected}, got {C.shape} and {T.shape}."
        )
    A = np.zeros_like(C, dtype=np.float64)
    A[..., :3, :3] = A[..., 3:, 3:] = T[..., :3, :3]
    return A @ C @ np.swapaxes(A, -1, -2)
