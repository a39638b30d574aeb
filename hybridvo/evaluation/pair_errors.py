"""Errors of one relative pose against the true one: the paper's three, and metric ones."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable

import numpy as np

from hybridvo.data.base import Sequence
from hybridvo.data.image_io import UNKNOWN_FLOW
from hybridvo.data.sequence import resize_camera
from hybridvo.errors import InputError
from hybridvo.geometry import (
    backproject,
    ego_flow,
    invert,
    matrix_to_euler_deg,
    pixel_grid,
    pose_matrix,
    rotation_angle,
)
from hybridvo.trajectory import Trajectory
from hybridvo.types import Camera, Frame

PAPER_SIZE = (128, 256)  # height and width at which the paper measures its EPE
MOVING_PX = 1.0  # of the true flow beside the true ego flow: the pixel moves by itself
ERRORS = ("r_err_deg", "t_err", "epe", "epe_l2_px", "rot_err_deg", "trans_err")


def true_motion(sequence: Sequence, prev: int, curr: int) -> np.ndarray | None:
    """True T_curr_prev (4, 4) between two frames of a sequence, or None where it is not known."""
    if sequence.poses is None:
        return None
    T = invert(sequence.poses[curr]) @ sequence.poses[prev]
    return T if np.isfinite(T).all() else None


def true_trajectory(sequence: Sequence, indices: Iterable[int]) -> Trajectory | None:
    """True poses of those frames that have one; None where there are none."""
    poses = sequence.poses
    known = [] if poses is None else [i for i in indices if np.isfinite(poses[i]).all()]
    if poses is None or not known:
        return None
    # text files carry six digits: made orthonormal as the trajectory demands
    T = np.stack([pose_matrix(poses[i][:3]) for i in known])
    return Trajectory(sequence.timestamps[known], T)


def step_errors(
    sequence: Sequence, prev: Frame | None, curr: int, T_curr_prev: np.ndarray
) -> dict[str, float | None]:
    """:func:`pair_errors` of a motion from a frame to frame ``curr``; none without a true one."""
    T_gt = None if prev is None else true_motion(sequence, prev.index, curr)
    if prev is None or T_gt is None:
        return {}
    depth = prev.depth if prev.depth is not None else np.full(prev.camera.shape, np.nan)
    return pair_errors(T_curr_prev, T_gt, depth, prev.camera, sequence.camera(curr))


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def _paper_epe(
    T_est: np.ndarray, T_gt: np.ndarray, depth: np.ndarray, prev: Camera, curr: Camera
) -> float | None:
    """Mean over pixels *and components* of |F_ego - F~_ego| at 128x256; invalid ones count as 0."""
    # nearest at pixel centres: centre i of the small grid lies at (i + 0.5) / s - 0.5
    rows, columns = (
        ((np.arange(small) + 0.5) * size / small).astype(int)
        for small, size in zip(PAPER_SIZE, prev.shape, strict=True)
    )
    small = np.asarray(depth[np.ix_(rows, columns)], dtype=np.float64)
    valid = np.isfinite(small) & (small > 0)
    if not valid.any():
        return None
    prev, curr = (resize_camera(camera, *PAPER_SIZE) for camera in (prev, curr))
    points = backproject(np.where(valid, small, np.nan), prev)
    flows = []
    for T in (T_est, T_gt):
        moved = (points @ T[:3, :3].T + T[:3, 3]) @ curr.K.T
        # as in the published code ("to avoid reflection"): never undefined
        moved = moved[..., :2] / (np.abs(moved[..., 2:]) + 1e-12)
        flows.append(moved - pixel_grid(*PAPER_SIZE))
    counted = valid & (np.linalg.norm(flows[1], axis=2) < 400.0)  # longer true flow counts as right
    return float(np.abs(flows[0] - flows[1])[counted].sum()) / (2 * valid.size)


def pair_errors(
    T_est: np.ndarray,
    T_gt: np.ndarray,
    depth_prev: np.ndarray,
    camera_prev: Camera,
    camera_curr: Camera,
) -> dict[str, float | None]:
    """Errors of one estimated ``T_curr_prev`` (4, 4), metres.

    The paper's: ``r_err_deg``, mean absolute difference of the Euler angles X-Y-Z; ``t_err``, that
    of the translation's components; ``epe``, px at 128x256. ``epe_l2_px``: mean distance of the ego
    flows at native size; a pixel that the estimate puts behind the camera counts with the image
    diagonal. ``rot_err_deg``: geodesic angle; ``trans_err``: norm of the difference. Both EPE are
    None where no pixel has a valid ``depth_prev`` (H, W), metres.
    """
    depth = np.asarray(depth_prev)
    euler = matrix_to_euler_deg(T_est[:3, :3]) - matrix_to_euler_deg(T_gt[:3, :3])
    euler = (euler + 180.0) % 360.0 - 180.0
    translation = T_est[:3, 3] - T_gt[:3, 3]
    est, gt = (ego_flow(depth, T, camera_prev, camera_curr) for T in (T_est, T_gt))
    native = np.linalg.norm(est - gt, axis=2)[np.isfinite(gt).all(axis=2)]
    native[~np.isfinite(native)] = np.hypot(*camera_prev.shape)
    return {
        "r_err_deg": float(np.abs(euler).mean()),
        "t_err": float(np.abs(translation).mean()),
        "epe": _paper_epe(T_est, T_gt, depth, camera_prev, camera_curr),
        "epe_l2_px": float(native.mean()) if len(native) else None,
        "rot_err_deg": float(np.degrees(rotation_angle(T_est[:3, :3] @ T_gt[:3, :3].T))),
        "trans_err": float(np.linalg.norm(translation)),
    }


def pair_facts(sequence: Sequence, prev: int, curr: int) -> dict[str, float]:
    """What may explain an error: how much moves, how far, before what. What is unknown is absent.

    The true flow, of everything that moves, serves for this alone: no estimate ever sees it.
    """
    T_gt, depth = true_motion(sequence, prev, curr), sequence.frame(prev).depth
    if T_gt is None or depth is None:
        return {}
    facts = {
        "rotation_deg": float(np.degrees(rotation_angle(T_gt[:3, :3]))),
        "translation_m": float(np.linalg.norm(T_gt[:3, 3])),
    }
    known = depth[np.isfinite(depth) & (depth > 0)]
    if len(known):
        low, high = np.quantile(known, [0.1, 0.9])
        facts["depth_spread"] = float(high / low)
    ego = ego_flow(depth, T_gt, sequence.camera(prev), sequence.camera(curr))
    valid = np.isfinite(ego).all(axis=2)
    if valid.any():
        facts["flow_magnitude_px"] = float(np.median(np.linalg.norm(ego[valid], axis=1)))
    # TartanAir's true flow does not show what moves by itself
    whole = sequence.flow_is_true and sequence.kind != "tartanair" and curr == prev + 1
    with contextlib.suppress(InputError, OSError):
        flow_gt = sequence.flow(prev)[0] if whole else np.full_like(ego, np.nan)
        valid &= (np.abs(flow_gt) < UNKNOWN_FLOW).all(axis=2)
        moving = np.linalg.norm(ego[valid] - flow_gt[valid], axis=1) > MOVING_PX
        facts |= {"dynamic_fraction": float(moving.mean())} if len(moving) else {}
    return facts
