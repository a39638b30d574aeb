from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from hybridvo.core import geometry
from hybridvo.core.types import Camera
from hybridvo_lab.synthetic import paper_samples, sensors, training_scenes


def generator(index: int, seed: int = 3) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=[seed, index]))


def draws(sampler: paper_samples.TailSampler, count: int = 20_000) -> np.ndarray:
    rng = generator(0)
    return np.array([sampler.draw(rng) for _ in range(count)])


@pytest.mark.parametrize(("axis", "expected"), [(0, 0.397), (1, 0.467), (2, 0.372)])
def test_rotation_samplers_have_the_published_statistics(axis, expected):
    values = np.abs(draws(paper_samples.MotionSamplers().rotation_deg[axis]))
    # Four standard errors of the mean; the reference was drawn too, 200 000 times.
    assert values.mean() == pytest.approx(
        expected, abs=4 * values.std() / np.sqrt(values.size)
    )
    assert np.median(values) == pytest.approx(0.15, abs=0.02)
    # 5.6 to 6.9 over the three axes; the quantile of 20 000 draws has a standard error of 0.1.
    assert 5.2 < np.quantile(values, 0.99) < 7.3


@pytest.mark.slow
def test_paper_zero_motion_figures():
    """R_err 0.412 deg, T_err 0.074; EPE 2.4 px, median 0.93, of the background plane."""
    o = paper_samples.PaperOptions(height=32, width=64)
    rotation = []
    translation = []
    flow = []
    for i in range(300):
        sample = o.sample(generator(i, seed=5))
        rotation.append(np.abs(sample.rotation_deg).mean())
        translation.append(np.abs(sample.translation).mean())
        # The reference figure is of the plane without the objects in front of it. Flow scales with
        # the size of the picture: four times that of 32x64.
        plane = np.full((32, 64), sample.depth_prev.max())
        flow.append(
            4
            * np.abs(
                paper_samples.camera_flow(sample.K, plane, sample.T_curr_prev)[0]
            ).mean()
        )
    for values, expected, rounding in (
        (rotation, 0.412, 0.0005),
        (translation, 0.074, 0.0005),
        (flow, 2.4, 0.05),
    ):
        bound = 4 * np.std(values) / np.sqrt(len(values)) + rounding
        assert np.mean(values) == pytest.approx(expected, abs=bound)
    assert np.median(flow) == pytest.approx(0.93, abs=0.2)


def test_paper_sample_obeys_its_equations():
    o = paper_samples.PaperOptions()
    moved = 0
    for i in range(12):
        s = o.sample(generator(i))
        camera = Camera.from_matrix(s.K, o.height, o.width)
        exact = geometry.ego_flow(
            s.depth_true, s.T_curr_prev.astype(np.float64), camera, camera
        )
        ok = np.isfinite(exact).all(axis=-1) & (np.abs(exact).max(axis=-1) < 300)
        # float32: 1e-6 of a normalised coordinate of 1 at fx up to 800 px.
        np.testing.assert_allclose(s.ego_flow[ok], exact[ok], atol=5e-3, rtol=1e-4)
        still = ~s.moving
        np.testing.assert_array_equal(s.flow[still], s.ego_flow[still])
        z = (geometry.backproject(s.depth_true, camera) @ s.T_curr_prev[:3, :3].T)[
            ..., 2
        ]
        np.testing.assert_allclose(
            s.depth_curr[still],
            (z + s.T_curr_prev[2, 3])[still],
            rtol=1e-4,
            atol=1e-3,
        )
        R = geometry.euler_deg_to_matrix(s.rotation_deg)
        np.testing.assert_allclose(s.T_curr_prev[:3, :3], R, atol=1e-6)
        np.testing.assert_array_equal(s.T_curr_prev[:3, 3], s.translation)
        moved += s.moving.any()
    assert moved > 6


def test_rigid_flow_by_hand():
    def seen(inverse_depth: float, *t: float) -> tuple[float, ...]:
        rho = np.full((1, 1), inverse_depth)
        T = geometry.make_transform(np.eye(3), np.array(t))
        flow, ratio = paper_samples.rigid_flow(np.diag([200.0, 100.0, 1.0]), rho, T)
        return (*flow[0, 0], ratio[0, 0])

    # 0.1 m to the right at 2 m with fx 200: 10 px; 1 m closer: the depth halves.
    assert seen(0.5, 0.1, 0, 0) == pytest.approx((10.0, 0.0, 1.0), rel=1e-5)
    assert seen(0.5, 0, 0, -1.0)[2] == pytest.approx(0.5)
    # A translation does not move a point at infinity.
    assert seen(0.0, 5.0, 0, 0) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("size", [(128, 256), (64, 96), (37, 61)])
@pytest.mark.parametrize(
    "kind", [paper_samples.PaperOptions, training_scenes.DiverseOptions]
)
def test_samples_of_any_size_are_finite_and_complete(kind, size):
    options = kind(height=size[0], width=size[1])
    for i in range(8):
        s = options.sample(generator(i))
        for name in ("flow", "ego_flow"):
            assert getattr(s, name).shape == (*size, 2)
        for name in (
            "depth_prev",
            "depth_curr",
            "depth_true",
            "depth_target",
            "moving",
        ):
            assert getattr(s, name).shape == size
        for field in dataclasses.fields(s):
            value = getattr(s, field.name)
            assert value.dtype == (
                bool if field.name == "moving" else np.float32
            ), field.name
            assert field.name == "flow" or np.isfinite(value).all(), field.name
            if field.name.startswith("depth"):
                assert (value >= 0).all()


def test_diverse_samples_obey_the_camera_where_nothing_moves():
    for i in range(6):
        o = training_scenes.DiverseOptions(height=64, width=128, dis_share=0.3)
        s = o.sample(generator(i))
        ok = np.isfinite(s.flow).all(-1) & ~s.moving & (s.depth_true > 0)
        assert np.median(np.linalg.norm(s.flow - s.ego_flow, axis=-1)[ok]) < 2.0
        camera = Camera.from_matrix(s.K, o.height, o.width)
        T = s.T_curr_prev.astype(np.float64)
        exact = geometry.ego_flow(s.depth_true, T, camera, camera)
        seen = np.isfinite(exact).all(-1) & (np.abs(exact).max(-1) < 300)
        # float32 at up to 400 px of focal length.
        np.testing.assert_allclose(
            s.ego_flow[seen], exact[seen], atol=5e-3, rtol=1e-3
        )
        z = (geometry.backproject(s.depth_true, camera) @ T[:3, :3].T)[..., 2] + T[
            2, 3
        ]
        np.testing.assert_allclose(
            s.depth_target[seen], z[seen], rtol=1e-3, atol=1e-4
        )


def test_a_sensor_keeps_holes():
    depth = np.full((64, 128), 2.0, np.float32)
    depth[:8] = 0.0
    for image in sensors.degrade_depth(generator(0), [depth, depth]):
        assert (
            (image[:5] == 0).all()
            and np.isfinite(image).all()
            and (image >= 0).all()
        )
        assert np.median(image[16:]) == pytest.approx(2.0, rel=0.1)
