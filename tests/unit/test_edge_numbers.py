"""Numbers at the edge: depths, focal lengths, sizes, layouts, flows and stamps nobody expects.

Every case ends in a finite pose, a status, or an InputError that says what is wrong; numeric
warnings are errors here as everywhere in the tests.
"""

from __future__ import annotations

import numpy as np
import pytest
import sequences as write

from hybridvo.data.sequence import open_sequence
from hybridvo.errors import InputError
from hybridvo.flow import check_field
from hybridvo.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.odometry import Odometry
from hybridvo.pipeline import estimate
from hybridvo.refinement.refine import refine
from hybridvo.trajectory import Trajectory, read_trajectory, write_tum
from hybridvo.types import Camera, Frame, FramePair, RelativePose

CHI2_6_3SIGMA = 20.06  # 0.9973 quantile of chi-square with 6 degrees of freedom
HEIGHT, WIDTH = 96, 128


def camera(focal: float = 120.0, height: int = HEIGHT, width: int = WIDTH) -> Camera:
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, height, width)


def scene(focal: float = 120.0, scale: float = 1.0, noise_px: float = 0.0, size=(HEIGHT, WIDTH)):
    """Depth (H, W) float64 of 2 to 6 ``scale`` metres, flow (H, W, 2) float64, camera, T.

    The motion fills a similar share of the picture at every focal length.
    """
    K = camera(focal, *size)
    u, v = np.arange(K.width), np.arange(K.height)[:, None]
    depth = scale * (4.0 + np.sin(u / 7.0) + np.cos(v / 5.0))
    turn = min(1.0, 120.0 / focal)
    delta = np.array([0.02 * turn, -0.01 * turn, 0.05, 0.002 * turn, 0.004 * turn, -0.003 * turn])
    delta[:3] *= scale
    T = se3_exp(delta)
    flow = ego_flow(depth, T, K, K)
    return depth, flow + noise_px * np.random.default_rng(1).normal(size=flow.shape), K, T


def pair(depth, flow, K, rgb=None) -> FramePair:
    return FramePair(Frame(rgb, depth, K), Frame(rgb, None, K), flow)


def check_finite(motion: RelativePose) -> None:
    """What every answer must be, right or not."""
    for value in (motion.T_curr_prev, motion.covariance, motion.information_eigenvalues):
        assert np.isfinite(value).all()
    assert np.isfinite([motion.inlier_ratio, motion.cost, motion.residual_scale_px]).all()
    assert motion.weights is None or np.isfinite(motion.weights).all()
    assert (
        np.abs(motion.T_curr_prev[:3, :3] @ motion.T_curr_prev[:3, :3].T - np.eye(3)).max() < 1e-9
    )
    assert np.linalg.eigvalsh(motion.covariance)[0] > 0
    if not motion.ok:
        assert motion.status.message and np.array_equal(motion.T_curr_prev, np.eye(4))


def normalised_error(motion: RelativePose, T: np.ndarray) -> float:
    error = se3_log(motion.T_curr_prev @ invert(T))
    return float(error @ np.linalg.solve(motion.covariance, error))


# --- depth and focal length -----------------------------------------------------------------------
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 2e5])
def test_scale_of_the_scene_scales_translation_and_covariance(scale):
    # 2e5: depths up to 1.2e6 m. Noise of 0.1 px: the error is that of the noise at every scale
    depth, flow, K, T = scene(scale=scale, noise_px=0.1)
    motion = refine(pair(depth, flow, K))
    check_finite(motion)
    assert motion.status.ok and normalised_error(motion, T) < CHI2_6_3SIGMA
    same = refine(pair(depth / scale, flow, K))
    # float32 depths are scaled by rounding: 1e-7 relative, some hundred steps of it in the sum
    np.testing.assert_allclose(
        motion.T_curr_prev[:3, 3] / scale, same.T_curr_prev[:3, 3], rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("focal", [50.0, 1e3, 1e4, 1e5])
def test_focal_lengths(focal):
    depth, flow, K, T = scene(focal=focal, noise_px=0.1)
    motion = refine(pair(depth, flow, K))
    check_finite(motion)
    assert not motion.ok or normalised_error(motion, T) < CHI2_6_3SIGMA
    assert motion.ok  # an angle of view of 0.07 degrees still determines the motion, if weakly


def test_depths_from_one_end_to_the_other():
    _, flow, K, _ = scene()
    rng = np.random.default_rng(0)
    for depth in (
        10.0 ** rng.uniform(-6, 6, K.shape),
        np.full(K.shape, 1e300),
        np.full(K.shape, 3e38),
        np.full(K.shape, 1e-40),
        np.where(np.arange(WIDTH) < 64, 1e6, 1e-6) * np.ones(K.shape),
    ):
        for method in ("refine", "pnp-ransac"):
            check_finite(estimate(pair(depth, flow, K), method=method))


# --- flow -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("method", ["refine", "usac-magsac"])
@pytest.mark.parametrize("value", [1e6, -1e6, 1e30, 3e38, 1e300])
def test_flow_that_leaves_the_world(value, method):
    depth, _, K, _ = scene()
    motion = estimate(pair(depth, np.full((*K.shape, 2), value), K), method=method)
    check_finite(motion)
    assert not motion.ok


def test_half_of_the_flow_leaves_the_world():
    depth, flow, K, T = scene(noise_px=0.1)
    flow[:, : WIDTH // 2] = 1e6
    motion = refine(pair(depth, flow, K))
    check_finite(motion)
    assert motion.ok and normalised_error(motion, T) < CHI2_6_3SIGMA
    field = check_field(np.full((HEIGHT, WIDTH, 2), 1e300), Frame(None, depth, K), "mine")
    assert not field.valid.any() and np.isnan(field.flow).all()


# --- layouts and types ----------------------------------------------------------------------------
def backwards(array: np.ndarray) -> np.ndarray:
    """The same values with negative strides."""
    return array[::-1, ::-1].copy()[::-1, ::-1]


def every_second(array: np.ndarray) -> np.ndarray:
    wide = np.full((2 * array.shape[0], 3 * array.shape[1], *array.shape[2:]), 1e9, array.dtype)
    wide[::2, ::3] = array
    return wide[::2, ::3]


def channels_first(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(array, -1, 0)).transpose(*range(1, array.ndim), 0)


def frozen(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flags.writeable = False
    return array


LAYOUTS = {
    "float64": lambda a: a.astype(np.float64),
    "big-endian-4": lambda a: a.astype(">f4"),
    "big-endian-8": lambda a: a.astype(">f8"),
    "long": lambda a: a.astype(np.longdouble),
    "fortran": np.asfortranarray,
    "backwards": backwards,
    "strided": every_second,
    "channels-first": channels_first,
    "frozen": frozen,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_changes_no_byte(layout):
    depth, flow, K, _ = scene()
    depth, flow = depth.astype(np.float32), flow.astype(np.float32)
    change = LAYOUTS[layout]
    for method in ("refine", "pnp-ransac"):
        expected = estimate(pair(depth, flow, K), method=method).T_curr_prev
        got = estimate(pair(change(depth), change(flow), K), method=method).T_curr_prev
        assert np.array_equal(got, expected), method


def test_half_precision_is_read():
    depth, flow, K, T = scene()
    motion = refine(pair(depth.astype(np.float16), flow.astype(np.float16), K))
    check_finite(motion)
    # 11 bits: 5e-4 of the depth, 1e-3 px of flow of some pixels; averaged over 12 000 of them
    assert np.abs(se3_log(motion.T_curr_prev @ invert(T))).max() < 2e-5


@pytest.mark.parametrize("method", ["hybrid", "refine"])
def test_one_channel_is_three_equal_ones(method):
    depth, flow, K, _ = scene()
    grey = np.random.default_rng(0).integers(0, 256, K.shape, dtype=np.uint8)
    answers = [
        estimate(pair(depth, flow, K, rgb), method=method).T_curr_prev
        for rgb in (grey, grey[..., None], np.repeat(grey[..., None], 3, 2))
    ]
    assert np.array_equal(answers[0], answers[1]) and np.array_equal(answers[0], answers[2])


@pytest.mark.parametrize(
    ("rgb", "reason"),
    [
        (np.zeros((HEIGHT, WIDTH, 2), np.uint8), "expected shape"),
        (np.zeros((HEIGHT, WIDTH, 4), np.uint8), "expected shape"),
        (np.zeros((3, HEIGHT, WIDTH), np.uint8), "expected shape"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint16), "expected uint8"),
        (np.zeros((HEIGHT, WIDTH, 3), np.float16), "expected uint8"),
        (np.zeros((HEIGHT, WIDTH, 3), bool), "expected uint8"),
        (np.zeros((HEIGHT - 1, WIDTH, 3), np.uint8), "to match the camera"),
        (np.zeros((0, 0, 3), np.uint8), "to match the camera"),
    ],
)
def test_images_that_are_none(rgb, reason):
    with pytest.raises(InputError, match=rf"Frame\.rgb: .*{reason}"):
        Frame(rgb, None, camera())


@pytest.mark.parametrize(
    ("depth", "reason"),
    [
        (np.ones((HEIGHT, WIDTH), int), "Convert to metres"),
        (np.ones((HEIGHT, WIDTH), np.uint8), "Convert to metres"),
        (np.ones((HEIGHT, WIDTH), complex), "floating-point"),
        (np.ones((HEIGHT, WIDTH), object), "floating-point"),
        (np.ones((HEIGHT, WIDTH, 2)), "expected shape"),
        (np.ones((WIDTH, HEIGHT)), "to match the camera"),
        (np.ones(HEIGHT * WIDTH), "expected shape"),
        ("depth", "expected shape"),
        (1.0, "expected shape"),
    ],
)
def test_depths_that_are_none(depth, reason):
    with pytest.raises(InputError, match=rf"Frame\.depth: .*{reason}"):
        Frame(None, depth, camera())


# --- sizes ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("size", [(1, 1), (2, 3), (8, 8), (16, 16), (32, 32), (32, 2048)])
def test_small_and_odd_images(size):
    depth, flow, K, T = scene(size=size)
    grey = np.random.default_rng(0).integers(0, 256, K.shape, dtype=np.uint8)
    vo = Odometry(None, method="refine", prepare=False)
    for stamp in (0.0, 0.1):  # DIS has no flow below 12 pixels
        step = vo.track(Frame(grey, depth, K, timestamp=stamp))
        check_finite(step.motion)
    given = estimate(pair(depth, flow, K, grey), method="hybrid")
    check_finite(given)
    assert given.ok == (size[0] * size[1] >= 64)
    assert not given.ok or np.abs(se3_log(given.T_curr_prev @ invert(T))).max() < 1e-5


def test_8192_by_4096_from_strided_views():
    # the depth is one number seen 2^25 times; the flow of a frontal plane grows with the pixel
    K = camera(4000.0, 4096, 8192)
    depth = np.broadcast_to(np.float32(4.0), K.shape)
    flow = np.zeros((*K.shape, 2), np.float32)
    flow[..., 0] = 5.0 + 0.01 * (np.arange(K.width, dtype=np.float32) - K.cx)
    flow[..., 1] = 0.01 * (np.arange(K.height, dtype=np.float32)[:, None] - K.cy)
    # x' = f X / (Z + tz): 1 % larger is tz = -Z / 101, and 5 px are tx = 5 (Z + tz) / f
    expected = np.array([5.0 * (4.0 - 4.0 / 101) / 4000, 0.0, -4.0 / 101])
    motion = refine(pair(depth, flow[:, ::-1][:, ::-1], K))
    check_finite(motion)
    assert motion.ok and np.abs(motion.T_curr_prev[:3, 3] - expected).max() < 1e-5
    assert motion.T_curr_prev[0, 0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("value", [0, -1, 2.5, np.nan, np.inf, None, "480", True, 10**400, [4]])
def test_image_sizes_that_are_none(value):
    if value == "480":  # a number in a text is read as one
        assert Camera(9, 9, 1, 1, value, 4).height == 480
        return
    with pytest.raises(InputError, match=r"Camera\.height: expected a positive integer"):
        Camera(9, 9, 1, 1, value, 4)


@pytest.mark.parametrize("value", [0, -5.0, np.nan, np.inf, 1e-300, 1e300, None, "wide", 10**400])
def test_focal_lengths_that_are_none(value):
    with pytest.raises(InputError, match=r"Camera\.fx: expected a (positive|finite)"):
        Camera(value, 9, 1, 1, 4, 4)


# --- stamps ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, None, "now", 10**400])
def test_stamps_that_are_none(value):
    with pytest.raises(InputError, match=r"Frame\.timestamp: expected finite seconds"):
        Frame(None, None, camera(), timestamp=value)


@pytest.mark.parametrize("start", [-1.0, 0.0, 4_102_444_800.0])  # before 1970, 1970, 2100
def test_stamps_of_1970_and_2100_come_through(start, tmp_path):
    depth, flow, K, T = scene()
    vo = Odometry(None, method="refine", prepare=False)
    steps = [vo.track(Frame(None, depth, K, timestamp=start + i / 30), flow) for i in range(3)]
    assert [step.timestamp for step in steps] == [start + i / 30 for i in range(3)]
    path = tmp_path / "trajectory.tum"
    stamps = np.array([step.timestamp for step in steps])
    write_tum(Trajectory(stamps, np.stack([step.T_world_cam for step in steps])), path)
    # a double holds the seconds of 2100 to half a microsecond
    np.testing.assert_allclose(read_trajectory(path).timestamps, stamps, rtol=0, atol=1e-6)
    assert np.abs(se3_log(steps[2].T_curr_prev @ invert(T))).max() < 1e-5


@pytest.mark.parametrize("epoch_ns", [200_000 * 10**9, 4_102_444_800 * 10**9])
def test_lists_in_nanoseconds_of_1970_and_2100(epoch_ns, tmp_path):
    # nanoseconds of the first day of 1970 cannot be told from seconds: below 1e14
    written = write.write_tum(tmp_path)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        path = written.path / name
        lines = [line.split(maxsplit=1) for line in path.read_text().splitlines()[1:]]
        rows = [f"{epoch_ns + round(float(stamp) * 1e9)} {rest}" for stamp, rest in lines]
        path.write_text("\n".join(rows))
    sequence = open_sequence(written.path)
    expected = epoch_ns / 1e9 + 100 + np.arange(3) / 30
    np.testing.assert_allclose(sequence.timestamps, expected, rtol=0, atol=2e-6)
    assert np.isfinite(sequence.poses).all()
    assert any("nanoseconds" in notice for notice in sequence.notices)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (7, 9)])
def test_a_network_does_not_answer_for_a_handful_of_pixels(size) -> None:
    """Enlarged to the network's input, one pixel is 32 768 that agree with each other."""
    height, width = size
    K = Camera(40, 40, (width - 1) / 2, (height - 1) / 2, height, width)
    found = estimate(
        pair(np.full(size, 2.0, np.float32), np.zeros((*size, 2), np.float32), K), method="pwvo"
    )
    assert str(found.status) == "failed(no_valid_depth)" and "64 needed" in found.status.message
    check_finite(found)


@pytest.mark.parametrize("value", [1e8, 1e30, 3e38])
def test_depth_out_of_this_world_is_none(value: float) -> None:
    depth, flow, K, _ = scene()
    found = estimate(pair(np.full_like(depth, value), flow, K), method="pwvo")
    assert str(found.status) == "failed(no_valid_depth)", found.status
    check_finite(found)
    # a part of it, as the sky in some data sets, costs nothing
    depth[: HEIGHT // 3] = value
    found = estimate(pair(depth, flow, K), method="pwvo")
    assert found.ok and np.isfinite(found.T_curr_prev).all()
