from __future__ import annotations

import functools
import importlib
import importlib.util

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridvo.api import estimate
from hybridvo.core.errors import InputError
from hybridvo.core.geometry import (
    ego_flow,
    invert,
    make_transform,
    rotation_angle,
    se3_exp,
    se3_log,
)
from hybridvo.core.results import Reason, RelativePose, StageFailed, State
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.pipeline import check_method
from hybridvo_lab import baselines
from hybridvo_lab.baselines import missing
from hybridvo_lab.baselines.correspondences import (
    Correspondences,
    sample,
    with_covariance,
)
from hybridvo_lab.baselines.solvers import SOLVERS
from hybridvo_lab.synthetic.noise_scenarios import Scenario, make_pair

POINT_SOLVERS = ["pnp-ransac", "pnp-ransac-tuned", "usac-magsac", "poselib"]
HEIGHT, WIDTH = 96, 160
CAMERA = Camera(150.0, 155.0, 80.5, 46.0, height=HEIGHT, width=WIDTH)


@pytest.fixture(params=POINT_SOLVERS)
def solver(request):
    return _available(request.param)


def _available(name):
    if reason := missing(name):
        pytest.skip(reason)
    return functools.partial(estimate, method=name)


def _depth(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(2, 9, (7, 11)).astype(np.float32)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)


def _motion(t=(0.08, -0.05, 0.12), rotation=(0.01, -0.02, 0.015)) -> np.ndarray:
    return make_transform(Rotation.from_rotvec(rotation).as_matrix(), np.array(t))


def _pair(
    depth=None, T=None, prev=CAMERA, curr=CAMERA, flow=None, **extra
) -> FramePair:
    """Pair of a static scene whose flow is that of ``T``, exact up to float32."""
    depth = _depth() if depth is None else depth
    if flow is None:
        T = _motion() if T is None else T
        with np.errstate(all="ignore"):
            flow = ego_flow(depth, T, prev, curr).astype(np.float32)
    return FramePair(
        Frame(None, depth, prev), Frame(None, None, curr), flow, **extra
    )


def _assert_sane(result: RelativePose) -> None:
    """What every result keeps, whatever the data: finite, rigid, a proper covariance."""
    T = result.T_curr_prev
    assert T.shape == (4, 4) and np.isfinite(T).all()
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.isfinite(result.covariance).all()
    assert (
        np.linalg.eigvalsh((result.covariance + result.covariance.T) / 2).min() > 0
    )
    assert np.isfinite(
        [result.inlier_ratio, result.cost, result.residual_scale_px]
    ).all()
    if result.status.state is State.FAILED:
        assert (T == np.eye(4)).all()


def _assert_close(
    result: RelativePose, T: np.ndarray, rad: float, metres: float
) -> None:
    assert result.status.state is State.OK, result.status.message
    error = result.T_curr_prev @ invert(T)
    assert rotation_angle(error[:3, :3]) < rad
    assert np.linalg.norm(result.T_curr_prev[:3, 3] - T[:3, 3]) < metres


def test_noisy_pair_with_moving_objects(solver):
    pair, truth = make_pair(Scenario(moving=0.2), 1, height=218, width=512)
    # the peers' medians are 0.05-0.2 px at f = 1120: 0.2 mrad; ten times that is a gross error
    result = solver(pair)
    _assert_sane(result)
    error = result.T_curr_prev @ invert(truth["T_curr_prev"])
    assert rotation_angle(error[:3, :3]) < 5e-3
    assert 0.5 < result.inlier_ratio < 0.95


def test_two_cameras_prev_gives_points_curr_gives_pixels(solver):
    """Worked by hand: with a zoom of 1.2 between the frames and no motion, x' - c' = 1.2 (x - c).

    One K for both would need a motion towards the scene to explain it.
    """
    prev = Camera(150.0, 150.0, 79.5, 47.5, height=HEIGHT, width=WIDTH)
    curr = Camera(180.0, 180.0, 81.5, 46.5, height=HEIGHT, width=WIDTH)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    flow = np.stack([1.2 * (u - 79.5) + 81.5 - u, 1.2 * (v - 47.5) + 46.5 - v], -1)
    zoom = _pair(flow=flow, prev=prev, curr=curr)
    _assert_close(solver(zoom), np.eye(4), 1e-4, 1e-3)
    swapped = _pair(flow=flow, prev=curr, curr=prev)
    result = solver(swapped)
    assert not result.ok or np.linalg.norm(result.T_curr_prev[:3, 3]) > 0.1


# The largest residual of an inlier follows the noise of the flow


def _largest_residual(pair: FramePair) -> float:
    return sample(pair, 0).inlier_px


def test_the_inlier_limit_is_three_times_the_stated_noise():
    variance = np.full((HEIGHT, WIDTH), 0.3**2, np.float32)
    assert _largest_residual(_pair(flow_variance=variance)) == pytest.approx(0.9)
    # DIS states some 0.03 px: rounding and depth err by more than three times that
    assert _largest_residual(_pair(flow_variance=0.01 * variance)) == 0.5


def test_the_inlier_limit_is_of_the_pixels_in_use():
    # a flow without noise on the left; on the right it is wrong by 3 px, and is not used
    variance = np.full((HEIGHT, WIDTH), 0.2**2, np.float32)
    left = np.arange(WIDTH) < WIDTH // 4
    variance[:, ~left] = 9.0
    valid = np.broadcast_to(left, (HEIGHT, WIDTH))
    assert _largest_residual(
        _pair(flow_variance=variance, flow_valid=valid)
    ) == pytest.approx(0.6)
    assert _largest_residual(_pair(flow_variance=variance)) == pytest.approx(9.0)


def test_without_a_stated_noise_the_kind_of_flow_decides():
    assert _largest_residual(_pair()) == 1.5  # an estimate: half a pixel
    assert _largest_residual(_pair(flow_is_true=True)) == 0.5
    unknown = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    assert _largest_residual(_pair(flow_variance=unknown)) == 1.5


@pytest.mark.parametrize(
    ("name", "limit_px"),
    [("pnp-ransac-tuned", 0.01), ("poselib", 0.01), ("usac-magsac", 0.2)],
)
def test_an_object_two_pixels_away_is_no_inlier_of_a_precise_flow(name, limit_px):
    """30 % of the pixels are shifted by 2 px; the flow states 0.05 px, and errs by as much.

    The mean over 7000 pixels errs by a few thousandths; USAC_MAGSAC ends with a minimal sample.
    """
    method = _available(name)
    pair = _pair()
    flow = pair.flow.copy()
    flow[:, : int(0.3 * WIDTH), 0] += 2.0
    noise = np.random.default_rng(3).normal(0, 0.05, flow.shape).astype(np.float32)
    variance = np.full((HEIGHT, WIDTH), 0.05**2, np.float32)
    found = method(_pair(flow=flow + noise, flow_variance=variance))
    # with a limit of 2 px both parts are inliers, and the motion errs by half a pixel
    away = ego_flow(_depth(), found.T_curr_prev, CAMERA, CAMERA) - pair.flow
    assert np.nanmedian(np.hypot(*np.moveaxis(away, -1, 0))) < limit_px
    assert found.inlier_ratio == pytest.approx(0.7, abs=0.02)


def test_a_limit_that_is_given_decides():
    pair = _pair()
    flow = pair.flow.copy()
    flow[:, : WIDTH // 4, 0] += 1.2
    moved = _pair(flow=flow, flow_is_true=True)
    near = baselines.estimate("pnp-ransac-tuned", moved)
    assert near.inlier_ratio == pytest.approx(0.75, abs=0.05)
    assert (
        baselines.estimate("pnp-ransac-tuned", moved, inlier_px=3.0).inlier_ratio
        > 0.9
    )


# Degenerate geometry; what holds of every method is in tests/api


def test_f12_collinear_answer_of_a_solver_that_is_sure_of_itself():
    """A line of points: turning about it moves none of them, so every solver's pose is refused."""
    x = np.linspace(-1, 1, 50)
    xyz = np.stack([x, 0 * x + 0.3, 0 * x + 4.0], -1)
    uv = xyz[:, :2] / 4.0 * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    with pytest.raises(StageFailed) as failure:
        with_covariance(np.eye(4), Correspondences(xyz, uv), CAMERA, 2.0)
    assert failure.value.reason is Reason.DEGENERATE_GEOMETRY


def test_f14_answer_that_puts_its_points_behind_the_camera_is_refused():
    xyz = np.random.default_rng(0).uniform((-2, -1, 3), (2, 1, 6), (100, 3))
    uv = xyz[:, :2] / xyz[:, 2:] * (CAMERA.fx, CAMERA.fy) + (CAMERA.cx, CAMERA.cy)
    # turned by pi about z and about the centre: X -> -X projects onto the same pixels
    mirrored = make_transform(
        np.diag([-1.0, -1.0, 1.0]), np.array([0.0, 0.0, -12.0])
    )
    with pytest.raises(StageFailed) as failure:
        with_covariance(mirrored, Correspondences(xyz, uv), CAMERA, 1e9)
    assert failure.value.reason is Reason.LOW_INLIERS
    assert failure.value.inlier_ratio == 0.0


def test_a_rejected_motion_says_how_many_pixels_followed_it():
    rng = np.random.default_rng(0)
    flow = rng.uniform(-20, 20, (HEIGHT, WIDTH, 2)).astype(np.float32)
    found = baselines.estimate("pnp-ransac", _pair(flow=flow), inlier_px=1.0)
    assert str(found.status) == "failed(low_inliers)"
    assert 0 < found.inlier_ratio < 0.05


@pytest.mark.parametrize("error", [cv2.error, np.linalg.LinAlgError, RuntimeError])
def test_a_library_that_raises_is_a_failed_status(monkeypatch, error):
    def boom(*args, **kwargs):
        raise error("singular")

    monkeypatch.setattr(cv2, "solvePnPRansac", boom)
    for name in ("pnp-ransac", "pnp-ransac-tuned", "usac-magsac"):
        result = estimate(_pair(), method=name)
        _assert_sane(result)
        assert str(result.status) == "failed(solver_diverged)"


# Covariance


def test_covariance_is_that_of_the_left_perturbation_translation_first(rng):
    """Against J from finite differences of pi(K Exp(delta) T X), sigma known."""
    xyz = rng.uniform((-2, -1, 3), (2, 1, 8), (60, 3))
    T = _motion()

    def project(delta):
        M = se3_exp(delta) @ T
        p = xyz @ M[:3, :3].T + M[:3, 3]
        return np.concatenate(
            [
                CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx,
                CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy,
            ]
        )

    h = 1e-6
    J = np.stack(
        [(project(h * e) - project(-h * e)) / (2 * h) for e in np.eye(6)], axis=1
    )
    uv = project(np.zeros(6)).reshape(2, -1).T
    result = with_covariance(T, Correspondences(xyz, uv), CAMERA, 2.0, sigma_px=0.7)
    np.testing.assert_allclose(
        result.covariance, 0.49 * np.linalg.inv(J.T @ J), rtol=1e-6
    )


def test_covariance_contains_the_error_of_independent_noise():
    """Flow noise alone: NEES of the least-squares answer has mean 6, deviation sqrt(12 / 60)."""
    nees = []
    T = _motion()
    exact = _pair(T=T)
    for seed in range(60):
        noise = (
            np.random.default_rng(seed)
            .normal(0, 0.3, exact.flow.shape)
            .astype(np.float32)
        )
        data = sample(_pair(flow=exact.flow + noise), seed, points=400)
        found = SOLVERS["pnp-ransac-tuned"](data, CAMERA, seed, 2.0)
        result = with_covariance(found, data, CAMERA, 2.0)
        delta = se3_log(result.T_curr_prev @ invert(T))
        nees.append(delta @ np.linalg.solve(result.covariance, delta))
    # five deviations of the mean; a swapped order or side of the tangent gives hundreds
    assert abs(np.mean(nees) - 6) < 5 * np.sqrt(12 / 60)


# RGB-D odometry


def _textured_pair(
    T: np.ndarray, curr: Camera | None = None, flow: bool = False
) -> FramePair:
    """A textured frontal plane at 2 m in both cameras, rendered by inverse warping."""
    height, width = 240, 320
    prev = Camera(260.0, 260.0, 159.5, 119.5, height=height, width=width)
    curr = prev if curr is None else curr
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(
        rng.uniform(0, 255, (height, width)).astype(np.float32), (0, 0), 3
    )
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    R, t = T[:3, :3], T[:3, 3]
    n = np.array([0, 0, 0.5])
    n_curr = R @ n / (1 + (R @ n) @ t)
    v, u = np.mgrid[0:height, 0:width]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(curr.K).T
    depth_curr = 1 / (rays @ n_curr)
    points = rays * depth_curr[..., None] @ invert(T)[:3, :3].T + invert(T)[:3, 3]
    map_u = (prev.fx * points[..., 0] / points[..., 2] + prev.cx).astype(np.float32)
    map_v = (prev.fy * points[..., 1] / points[..., 2] + prev.cy).astype(np.float32)
    image = cv2.remap(
        texture, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    depth = np.full((height, width), 2.0, np.float32)
    frames = [
        Frame(gray.astype(np.uint8), d.astype(np.float32), camera)
        for gray, d, camera in ((texture, depth, prev), (image, depth_curr, curr))
    ]
    true_flow = ego_flow(depth, T, prev, curr).astype(np.float32) if flow else None
    return FramePair(*frames, true_flow)


@pytest.mark.parametrize("name", ["opencv-rgbd", "open3d-rgbd", "sift-pnp"])
@pytest.mark.parametrize("flow", [False, True])
@pytest.mark.parametrize("zoom", [1.0, 1.05])
def test_rgbd_odometry_on_a_textured_plane(name, flow, zoom):
    method = _available(name)
    curr = Camera(260.0 * zoom, 260.0 * zoom, 159.5, 119.5, height=240, width=320)
    T = _motion((0.01, -0.008, 0.005), (0.002, 0.001, 0.004))
    result = method(_textured_pair(T, curr, flow))
    _assert_sane(result)
    # photometric alignment of 8-bit images: a tenth of a pixel is 4e-4 rad and 8e-4 m at 2 m;
    # on a frontal plane the two trade off against each other
    _assert_close(result, T, 5e-3, 1e-2)


def test_an_absent_or_broken_library_is_named_with_its_remedy(monkeypatch):
    def absent(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    assert "pip install" in missing("poselib")
    with pytest.raises(InputError, match="pip install open3d"):
        check_method("open3d-rgbd")

    def broken(name):
        raise ImportError("libusb-1.0.so.0: cannot open shared object file")

    monkeypatch.setattr(importlib, "import_module", broken)
    assert "libusb" in missing("open3d-rgbd") and "pip install" in missing(
        "open3d-rgbd"
    )


def test_opencv_4_has_no_rgbd_odometry(monkeypatch):
    monkeypatch.delattr(cv2, "Odometry", raising=False)
    with pytest.raises(InputError, match="pip install"):
        check_method("opencv-rgbd")
