"""The fit to the pixels that a network trusts: exact data, movers, gradients, nothing to fit."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridvo.core.geometry import rotation_angle, se3_exp
from hybridvo.core.torch_geometry import se3
from hybridvo.solver.torch.factors import Pixels, fit_pixels
from hybridvo_lab.paper.weighted_fit import MIN_FIT_SCALE, pixel_weights

COUNT = 600


def scene(
    seed: int, motions: list[np.ndarray], shares: list[float], noise: float = 0.0
) -> tuple[torch.Tensor, ...]:
    """(ray (1, 2, N), inverse depth (1, N), target (1, 2, N), which motion (N,)) in float64."""
    rng = np.random.default_rng(seed)
    ray = rng.uniform(-0.7, 0.7, (2, COUNT))
    depth = rng.uniform(1.0, 8.0, COUNT)
    which = np.searchsorted(
        np.cumsum(shares)[:-1], np.arange(COUNT) / COUNT, side="right"
    )
    target = np.empty_like(ray)
    for k, xi in enumerate(motions):
        T = se3_exp(xi)
        points = np.vstack([ray, np.ones(COUNT)]) * depth
        moved = T[:3, :3] @ points + T[:3, 3:]
        target[:, which == k] = (moved[:2] / moved[2])[:, which == k]
    target += noise * rng.standard_normal(target.shape)
    parts = (ray, 1.0 / depth, target)
    return *(torch.from_numpy(x)[None] for x in parts), torch.from_numpy(which)


def weighted_fit(
    ray: torch.Tensor,
    inverse: torch.Tensor,
    target: torch.Tensor,
    weights: torch.Tensor,
    start,
) -> torch.Tensor:
    """(B, 4, 4) fit over focal lengths, so that the camera is the unit matrix."""
    depth, one = 1 / inverse[:, None], torch.ones_like(inverse)
    K = torch.eye(3).to(ray).expand(len(ray), 3, 3)
    points = torch.cat([ray * depth, depth], dim=1)
    T = fit_pixels(
        Pixels(points, target, one, one, weights, K),
        se3(start.double()),
        MIN_FIT_SCALE,
    )
    return T.matrix().to(ray.dtype)


def error(T: torch.Tensor, xi: np.ndarray) -> float:
    """Radians and metres together."""
    D = T.detach().double().numpy() @ np.linalg.inv(se3_exp(xi))
    return float(rotation_angle(D[:3, :3])) + float(np.linalg.norm(D[:3, 3]))


EYE = torch.eye(4, dtype=torch.float64)[None]
WORLD = np.array([0.05, -0.02, 0.10, 0.01, -0.02, 0.005])
OBJECT = np.array([-0.20, 0.10, 0.05, -0.03, 0.02, 0.01])


@settings(max_examples=25, deadline=None)
@given(
    xi=st.tuples(*[st.floats(-0.1, 0.1)] * 6).map(np.array),
    seed=st.integers(0, 1000),
)
def test_exact_data_give_the_exact_motion(xi: np.ndarray, seed: int) -> None:
    ray, inverse, target, _ = scene(seed, [xi], [1.0])
    T = weighted_fit(
        ray, inverse, target, torch.ones(1, COUNT, dtype=torch.float64), EYE
    )
    # Gauss-Newton has converged quadratically: the damping of 1e-6 is what is left
    assert error(T[0], xi) < 1e-5


def test_weights_say_which_motion_is_the_world() -> None:
    ray, inverse, target, which = scene(3, [WORLD, OBJECT], [0.3, 0.7])
    trusted = (which == 0).double()[None]
    T = weighted_fit(ray, inverse, target, trusted + 1e-3, EYE)
    assert error(T[0], WORLD) < 1e-3
    # consensus alone takes the mover
    T = weighted_fit(ray, inverse, target, torch.ones_like(trusted), EYE)
    assert error(T[0], OBJECT) < 0.1 * error(T[0], WORLD)


def test_samples_do_not_see_each_other() -> None:
    parts = [scene(k, [WORLD], [1.0], 1e-3)[:3] for k in range(3)]
    parts[1][2][0, 0, 5:200] = torch.nan
    weights = torch.rand(
        3, COUNT, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    weights[1] = torch.nan
    batch = [torch.cat([p[i] for p in parts]) for i in range(3)]
    T = weighted_fit(*batch, weights, EYE.repeat(3, 1, 1))
    assert torch.isfinite(T).all()
    for k in (0, 2):
        alone = weighted_fit(*parts[k], weights[k : k + 1], EYE)
        torch.testing.assert_close(T[k : k + 1], alone, rtol=0, atol=1e-10)


def test_weights_of_pixels() -> None:
    s = torch.tensor([[[[0.0, 1.0], [torch.nan, 0.0]]]]).repeat(1, 3, 1, 1)
    valid = torch.tensor([[[True, True], [True, False]]])
    weights = pixel_weights(s, valid)
    # exp(-4) by hand; the damaged pixel and the invalid one weigh nothing
    expected = np.array([[1.0, np.exp(-4.0)], [0.0, 0.0]]) / (1 + np.exp(-4.0))
    np.testing.assert_allclose(weights[0].numpy(), expected, atol=1e-6)
    assert float(pixel_weights(s, torch.zeros_like(valid)).sum()) == 0.0
