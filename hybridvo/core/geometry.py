"""Camera geometry and rigid motions in numpy, for single images in float64."""

from __future__ import annotations

import numpy as np
import scipy

from hybridvo.core.errors import InputError
from hybridvo.core.kept import kept_with_frame
from hybridvo.core.types import Camera, Frame

# fraction of the points that may end behind the camera before the mean length of
# their flow counts as infinite
MAX_BEHIND_CAMERA = 0.1

# pixels of a frame, about, over which the mean length of its ego flow is taken
MEAN_FLOW_PIXELS = 300
# squared angle, rad^2, below which the exponential uses its Taylor series
SMALL_ANGLE_SQUARED = 1e-8


# -- pixels and points -----------------------------------------------------------


def pixel_grid(height: int, width: int) -> np.ndarray:
    """Return the coordinates (u, v) of every pixel of an image.

    Args:
        height: rows of the image.
        width: columns of the image.

    Returns:
        (H, W, 2) float64, px; (0, 0) is the centre of the top-left pixel.

    >>> pixel_grid(2, 3)[1, 2]
    array([2., 1.])
    """
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    return np.stack([u, v], axis=-1)


def nearest_pixels(native: int, count: int) -> np.ndarray:
    """Return which rows (or columns) of an image make a smaller one by picking.

    Args:
        native: rows of the image.
        count: rows of the smaller image.

    Returns:
        (count,) for each small row the row whose centre is nearest to its centre.

    >>> nearest_pixels(8, 2)
    array([2, 6])
    """
    centres = (np.arange(count) + 0.5) * native / count
    return centres.astype(np.intp)


def valid_depth(depth: np.ndarray) -> np.ndarray:
    """Return where depth is finite and positive, in the shape of the map."""
    return np.asarray(np.isfinite(depth) & (depth > 0))


def backproject(
    depth: np.ndarray, camera: Camera, index: np.ndarray | None = None
) -> np.ndarray:
    """Return the points of a depth map in the camera's frame.

    Args:
        depth: (H, W) metres along z.
        camera: its intrinsics.
        index: (N, 2) rows and columns of the pixels that are wanted; None: all.

    Returns:
        (H, W, 3) points, metres, or (N, 3) at the pixels of ``index``.

    >>> camera = Camera(fx=100, fy=100, cx=1, cy=1, height=3, width=3)
    >>> backproject(np.full((3, 3), 2.0), camera)[1, 2]
    array([0.02, 0.  , 2.  ])
    """
    if index is None:
        v, u = np.indices(camera.shape)
        z = depth.astype(np.float64)
    else:
        v, u = index.T
        z = depth[v, u].astype(np.float64)
    x = (u - camera.cx) / camera.fx * z
    y = (v - camera.cy) / camera.fy * z
    return np.stack([x, y, z], axis=-1)


def transform_points(T_target_source: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (..., 3) of the source frame in the target frame, metres.

    >>> T = make_transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    >>> transform_points(T, np.array([[1.0, 2.0, 3.0]]))
    array([[1., 2., 2.]])
    """
    return points @ T_target_source[:3, :3].T + T_target_source[:3, 3]


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Project points of the camera's frame onto its image.

    This is the numpy projection of the package, and its rule for points behind the
    camera: they are not visible.

    Args:
        points: (..., 3) metres.
        camera: intrinsics.

    Returns:
        (..., 2) px, (u, v); NaN where z is not positive.

    >>> camera = Camera(fx=100, fy=100, cx=50, cy=40, height=81, width=101)
    >>> project(np.array([[0.1, 0.0, 2.0], [0.1, 0.0, -2.0]]), camera)
    array([[55., 40.],
           [nan, nan]])
    """
    z = points[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = camera.fx * points[..., 0] / z + camera.cx
        v = camera.fy * points[..., 1] / z + camera.cy
    uv = np.stack([u, v], axis=-1)
    in_front = (z > 0)[..., None]
    return np.where(in_front, uv, np.nan)


def projection_rows(
    points: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return how the pixels of points move with a left perturbation of the motion.

    Args:
        points: (N, 3) metres, already moved into the camera's frame.
        camera: intrinsics.

    Returns:
        The derivatives (N, 6) of u and of v, px, in (translation, rotation).
    """
    i = 1 / points[:, 2]
    x = points[:, 0] / points[:, 2]
    y = points[:, 1] / points[:, 2]
    zero = np.zeros_like(i)
    du = np.stack([i, zero, -x * i, -x * y, 1 + x * x, -y], axis=-1)
    dv = np.stack([zero, i, -y * i, -1 - y * y, x * y, x], axis=-1)
    return camera.fx * du, camera.fy * dv


# -- ego flow ----------------------------------------------------------------------


def ego_flow(
    depth: np.ndarray,
    T_curr_prev: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> np.ndarray:
    """Return the flow of a static scene under a camera motion (paper, eq. 8).

    It is ``pi(K_curr, T_curr_prev D K_prev^-1 x) - x`` at every pixel x.

    Args:
        depth: (H, W) metres, of the previous frame.
        T_curr_prev: (4, 4) points of the previous camera into the current one.
        camera_prev: intrinsics of the previous frame.
        camera_curr: intrinsics of the current frame.

    Returns:
        (H, W, 2) px; NaN where depth is invalid or the point ends behind the
        camera.
    """
    depth = np.asarray(depth, dtype=np.float64)
    depth = np.where(valid_depth(depth), depth, np.nan)
    points = backproject(depth, camera_prev)
    moved = transform_points(T_curr_prev, points)
    return project(moved, camera_curr) - pixel_grid(*camera_prev.shape)


def ego_flow_error(
    T_curr_prev: np.ndarray,
    T_reference: np.ndarray,
    depth: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> float:
    """Return the mean distance between the ego flows of two motions.

    Pixels count where the reference's ego flow is known. A pixel counts with at
    most the image's diagonal, and with all of it where the motion puts its point
    behind the
    camera: one such point must not decide the mean.

    Args:
        T_curr_prev: (4, 4) the motion.
        T_reference: (4, 4) the motion that it is compared with, such as the true
            one.
        depth: (H, W) metres, of the previous frame.
        camera_prev: intrinsics of the previous frame.
        camera_curr: intrinsics of the current frame.

    Returns:
        Pixels; NaN where no pixel counts.

    >>> camera = Camera(fx=100, fy=100, cx=1, cy=1, height=3, width=3)
    >>> right = make_transform(np.eye(3), np.array([0.02, 0.0, 0.0]))
    >>> depth = np.full((3, 3), 2.0)
    >>> error = ego_flow_error(right, np.eye(4), depth, camera, camera)
    >>> round(error, 6)
    1.0
    """
    flow = ego_flow(depth, T_curr_prev, camera_prev, camera_curr)
    reference = ego_flow(depth, T_reference, camera_prev, camera_curr)
    counted = np.isfinite(reference).all(axis=2)
    if not counted.any():
        return float("nan")
    distances = np.linalg.norm(flow - reference, axis=2)[counted]
    diagonal = np.hypot(*camera_prev.shape)
    distances = np.nan_to_num(distances, nan=diagonal, posinf=diagonal)
    return float(np.minimum(distances, diagonal).mean())


def mean_flow(frame: Frame, T_curr_prev: np.ndarray) -> float:
    """Return the mean length of the ego flow of a motion over a grid of pixels.

    Args:
        frame: the previous frame; its camera is taken for both frames.
        T_curr_prev: (4, 4) the motion.

    Returns:
        A fraction of the image's width; infinite where the frame has no depth, or
        where more than :data:`MAX_BEHIND_CAMERA` of the points
        end behind the camera.
    """
    pixels, points = _regular_points(frame)
    if not len(points):
        return np.inf
    moved = transform_points(T_curr_prev, points)
    flow = project(moved, frame.camera) - pixels[:, ::-1]
    lengths = np.linalg.norm(flow, axis=1)
    in_front = np.isfinite(lengths)
    if np.count_nonzero(in_front) < (1 - MAX_BEHIND_CAMERA) * len(lengths):
        return np.inf
    return float(lengths[in_front].mean() / frame.camera.width)


@kept_with_frame
def _regular_points(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (N, 2) of pixels with depth on a regular grid, and their points (N, 3)."""
    if frame.depth is None:
        return np.zeros((0, 2), int), np.zeros((0, 3))
    pixels = _regular_pixels(frame.camera.shape, MEAN_FLOW_PIXELS)
    points = backproject(frame.depth, frame.camera, pixels)
    valid = valid_depth(points[:, 2])
    return pixels[valid], points[valid]


def _regular_pixels(shape: tuple[int, int], count: int) -> np.ndarray:
    """(N, 2) rows and columns of about ``count`` pixels on a regular grid."""
    height, width = shape
    stride = max(1, round(np.sqrt(height * width / count)))
    rows, columns = np.mgrid[
        stride // 2 : height : stride, stride // 2 : width : stride
    ]
    return np.stack([rows.ravel(), columns.ravel()], axis=1)


# -- rigid motions -----------------------------------------------------------------


def make_transform(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a rotation (3, 3) and a translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a matrix (3, 4), with the nearest rotation."""
    U, _, Vt = np.linalg.svd(pose[:, :3])
    return make_transform(U @ Vt, pose[:, 3])


def invert(T: np.ndarray) -> np.ndarray:
    """Return the inverses of rigid transforms (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    R_inverse = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse = T.copy()
    inverse[..., :3, :3] = R_inverse
    inverse[..., :3, 3:] = -R_inverse @ T[..., :3, 3:]
    return inverse


def chain(T_world_prev: np.ndarray, T_curr_prev: np.ndarray) -> np.ndarray:
    """Return the next pose (4, 4), T_world_curr = T_world_prev inv(T_curr_prev)."""
    T_world_curr = T_world_prev @ invert(T_curr_prev)
    # orthonormal again, so that rounding does not accumulate
    return pose_matrix(T_world_curr[:3])


def se3_exp(delta: np.ndarray) -> np.ndarray:
    """Return the transform of a tangent vector; numba can compile this function.

    Args:
        delta: (6,) translation in metres, rotation in radians.

    Returns:
        (4, 4) the exponential.

    >>> se3_exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))[:3, 3]
    array([1., 2., 3.])
    """
    delta = np.asarray(delta)
    x = delta[3]
    y = delta[4]
    z = delta[5]
    theta2 = x * x + y * y + z * z
    if theta2 < SMALL_ANGLE_SQUARED:
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
            # element of W squared
            square = delta[3 + i] * delta[3 + j] - theta2 * (i == j)
            T[i, j] += a * W[i, j] + b * square
            T[i, 3] += (b * W[i, j] + c * square) * delta[j]
    return T


def se3_log(T: np.ndarray) -> np.ndarray:
    """Return the tangent vector (6,) of a transform (4, 4), undoing se3_exp."""
    rotation = rotation_vector(T[:3, :3])
    theta2 = rotation @ rotation
    if theta2 < SMALL_ANGLE_SQUARED:
        c = 1 / 12 + theta2 / 720
    else:
        half = np.sqrt(theta2) / 2
        c = (1 - half / np.tan(half)) / theta2
    W = cross_matrix(rotation)
    # the inverse of the matrix that makes T's translation in se3_exp
    left = np.eye(3) - 0.5 * W + c * (W @ W)
    return np.concatenate((left @ T[:3, 3], rotation))


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Return the axis times the angle (3,), radians, of a rotation (3, 3).

    >>> rotation_vector(se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]))[:3, :3])
    array([0. , 0.1, 0. ])
    """
    angle = rotation_angle(R)
    if angle > np.pi / 2:
        # near half a turn the antisymmetric part hardly shows the axis
        return scipy.spatial.transform.Rotation.from_matrix(R).as_rotvec()
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    length = np.linalg.norm(axis)
    return axis if length == 0 else angle / length * axis


def cross_matrix(v: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) whose product with a vector is the cross product of ``v``."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def adjoint(T: np.ndarray) -> np.ndarray:
    """Return the matrix (6, 6) with ``T Exp(d) = Exp(adjoint(T) d) T``."""
    R = T[:3, :3]
    A = np.zeros((6, 6))
    A[:3, :3] = R
    A[:3, 3:] = cross_matrix(T[:3, 3]) @ R
    A[3:, 3:] = R
    return A


def agreement(T: np.ndarray, expected: np.ndarray, covariance: np.ndarray) -> float:
    """Return how well a motion agrees with an expected one.

    Args:
        T: (4, 4) the motion.
        expected: (4, 4) the expected motion.
        covariance: (6, 6) of the expected motion, in the left tangent.

    Returns:
        1 where they are equal; 1/2 at one standard deviation in each direction.
    """
    return 1.0 / (1.0 + squared_distance(T, expected, covariance) / len(covariance))


def squared_distance(
    T: np.ndarray, other: np.ndarray, covariance: np.ndarray
) -> float:
    """Return the squared Mahalanobis distance of two motions.

    Args:
        T: (4, 4) one of them.
        other: (4, 4) the other one.
        covariance: (6, 6) of their difference, in the left tangent.
    """
    delta = se3_log(T @ invert(other))
    return float(delta @ np.linalg.solve(covariance, delta))


def rotation_angle(R: np.ndarray) -> np.ndarray:
    """Return the angles of rotations (..., 3, 3), radians; exact near 0 and pi."""
    # R - R^T is 2 sin(angle) times the cross-product matrix of the axis, whose norm
    # is sqrt(2)
    antisymmetric = R - np.swapaxes(R, -1, -2)
    twice_sine = np.linalg.norm(antisymmetric, axis=(-2, -1)) / np.sqrt(2)
    twice_cosine = np.trace(R, axis1=-2, axis2=-1) - 1.0
    return np.arctan2(twice_sine, twice_cosine)


def euler_deg_to_matrix(angles_deg: np.ndarray) -> np.ndarray:
    """Return the rotations R = Rx Ry Rz of the paper's Euler angles X-Y-Z.

    Args:
        angles_deg: (3,) or (N, 3) degrees, intrinsic, about x, y and z.

    Returns:
        (3, 3) or (N, 3, 3).
    """
    Rotation = scipy.spatial.transform.Rotation
    return Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()


def matrix_to_euler_deg(R: np.ndarray) -> np.ndarray:
    """Return the paper's Euler angles X-Y-Z, degrees, of rotations R = Rx Ry Rz.

    >>> matrix_to_euler_deg(euler_deg_to_matrix(np.array([10.0, 20.0, 30.0])))
    array([10., 20., 30.])
    """
    Rotation = scipy.spatial.transform.Rotation
    return Rotation.from_matrix(R).as_euler("XYZ", degrees=True)


def ned_to_camera(T_world_cam_ned: np.ndarray) -> np.ndarray:
    """Turn poses from NED axes (x forward, y right, z down) to camera axes.

    Both the world frame and the camera frame are turned.
    """
    order = [1, 2, 0, 3]
    return np.asarray(T_world_cam_ned, dtype=np.float64)[..., order, :][..., order]


def to_gtsam_covariance(covariance: np.ndarray) -> np.ndarray:
    """Convert a covariance for GTSAM's ``BetweenFactorPose3`` of ``T_prev_curr``.

    The inverse of ``Exp(d) T_curr_prev`` is ``T_prev_curr Exp(-d)``: GTSAM perturbs
    on the right as well, so that only the order changes, to (rotation,
    translation).

    Args:
        covariance: (6, 6) or (N, 6, 6) of ``T_curr_prev``, as in a RelativePose.

    Returns:
        The same shape, rotation first.

    Raises:
        InputError: for another shape.

    >>> np.diag(to_gtsam_covariance(np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])))
    array([4., 5., 6., 1., 2., 3.])
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
    """Convert a covariance for ROS's ``PoseWithCovariance`` of ``T_prev_curr``.

    ROS keeps (x, y, z, rotation about x, y, z) in the axes of the parent frame,
    which is the previous camera; the rotation of ``T_prev_curr`` turns the
    covariance into it.

    Args:
        covariance: (6, 6) or (N, 6, 6) of ``T_curr_prev``, as in a RelativePose.
        T_prev_curr: (4, 4) or (N, 4, 4).

    Returns:
        The same shape, in the previous camera's axes.

    Raises:
        InputError: for other shapes.

    A quarter turn about z exchanges the variances along x and y:

    >>> quarter = np.eye(4)
    >>> quarter[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    >>> covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    >>> np.diag(to_ros_covariance(covariance, quarter))
    array([2., 1., 3., 5., 4., 6.])
    """
    C = np.asarray(covariance)
    T = np.asarray(T_prev_curr)
    if C.shape[-2:] != (6, 6) or T.shape != (*C.shape[:-2], 4, 4):
        expected = "(6, 6) and (4, 4), or (N, 6, 6) and (N, 4, 4)"
        raise InputError(
            f"to_ros_covariance: expected {expected}, got {C.shape} and {T.shape}."
        )
    R = T[..., :3, :3]
    turn = np.zeros_like(C, dtype=np.float64)
    turn[..., :3, :3] = R
    turn[..., 3:, 3:] = R
    return turn @ C @ np.swapaxes(turn, -1, -2)
