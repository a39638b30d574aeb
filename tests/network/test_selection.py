from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import euler_deg_to_matrix
from hybridvo.core.results import PixelwisePrediction
from hybridvo.network.euler import euler_motion, euler_transform
from hybridvo.network.selection import SELECTION_METHODS, select_pose


def random_prediction(
    seed: int, shape=(2, 6, 7, 9), dtype=torch.float64
) -> PixelwisePrediction:
    generator = torch.Generator().manual_seed(seed)
    return PixelwisePrediction(
        *(torch.randn(shape, generator=generator, dtype=dtype) for _ in range(2))
    )


def by_loop(value, s, method, patch):
    """Selection of (6, h, w) maps, written as plainly as possible."""
    _, height, width = value.shape
    if method == "joint":
        s = np.broadcast_to(s.mean(axis=0), s.shape)
    elif method == "parts":
        s = np.stack([s[:3].mean(axis=0)] * 3 + [s[3:].mean(axis=0)] * 3)
    out = []
    for c in range(6):
        if method == "mean":
            out.append(value[c].mean())
            continue
        picked = []
        for top in range(0, height, patch):
            for left in range(0, width, patch):
                cells = [
                    (s[c, i, j], value[c, i, j])
                    for i in range(top, min(top + patch, height))
                    for j in range(left, min(left + patch, width))
                ]
                picked.append(min(cells))
        scales, values = np.array(picked).T
        weights = {
            "argmin": np.ones_like(scales),
            "exp_plus_u": np.exp(np.exp(scales)),
        }
        out.append(np.average(values, weights=weights.get(method, np.exp(-scales))))
    return np.array(out)


@pytest.mark.parametrize("method", SELECTION_METHODS)
@pytest.mark.parametrize(
    ("shape", "patch"), [((8, 8), 4), ((7, 9), 4), ((5, 6), 10), ((3, 2), 1)]
)
def test_equals_a_loop(method, shape, patch):
    prediction = random_prediction(5, (2, 6, *shape))
    got = select_pose(prediction, method, patch)
    for b in range(2):
        value, s = prediction.motion[b].numpy(), prediction.log_scale[b].numpy()
        expected = by_loop(value, s, method, patch)
        np.testing.assert_allclose(got[b], expected, rtol=1e-12, atol=1e-12)


def worked_example() -> PixelwisePrediction:
    """2x4 maps, patches of 2: left winner 1.0 with U = 1, right winner 4.0 with U = 2."""
    value = torch.tensor([[1.0, 9, 9, 9], [9, 9, 9, 4]]).expand(1, 6, 2, 4)
    scale = torch.tensor([[1.0, 5, 7, 5], [3, 4, 6, 2]]).log().expand(1, 6, 2, 4)
    return PixelwisePrediction(value, scale)


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("softmax", (2 * 1 + 1 * 4) / 3),  # 1/U: weights 2/3, 1/3
        ("argmin", (1 + 4) / 2),
        ("mean", (1 + 4 + 6 * 9) / 8),
        ("exp_plus_u", (1 + math.e * 4) / (1 + math.e)),  # exp(1), exp(2)
        ("parts", (2 * 1 + 1 * 4) / 3),
        ("joint", (2 * 1 + 1 * 4) / 3),  # all six have the same U here
    ],
)
def test_worked_by_hand(method, expected):
    motion = select_pose(worked_example(), method, patch=2)
    torch.testing.assert_close(motion, torch.full((1, 6), expected))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    patch=st.integers(1, 10),
    method=st.sampled_from(SELECTION_METHODS),
)
def test_result_lies_within_the_values_and_is_equivariant(
    seed, height, width, patch, method
):
    prediction = random_prediction(seed, (1, 6, height, width))
    motion = select_pose(prediction, method, patch)
    flat = prediction.motion.flatten(2)
    assert (motion >= flat.min(-1).values - 1e-12).all()
    assert (motion <= flat.max(-1).values + 1e-12).all()
    moved = replace(prediction, motion=2 * prediction.motion + 5)
    torch.testing.assert_close(select_pose(moved, method, patch), 2 * motion + 5)
    if method in ("softmax", "argmin"):
        louder = replace(prediction, log_scale=prediction.log_scale + 3)
        torch.testing.assert_close(select_pose(louder, method, patch), motion)


@pytest.mark.parametrize("method", SELECTION_METHODS)
def test_damage_is_not_heard(method):
    clean = random_prediction(2, (2, 6, 8, 8))
    maps = [clean.motion.clone(), clean.log_scale.clone()]
    for x, first, second in (
        (maps[0], torch.nan, torch.inf),
        (maps[1], torch.nan, -torch.inf),
    ):
        for half, broken in ((slice(0, 3), first), (slice(3, 6), second)):
            x[0, half, :4, :4] = broken  # a whole patch, and one pixel of another
            x[0, half, 6, 6] = broken
    prediction = PixelwisePrediction(*maps)
    motion = select_pose(prediction, method, 4)
    assert torch.isfinite(motion).all()
    torch.testing.assert_close(motion[1], select_pose(clean, method, 4)[1])
    # Of three patches, of which the last lacks one pixel, something is chosen among real values.
    real = prediction.motion[0][torch.isfinite(prediction.motion[0])]
    assert motion[0].min() >= real.min() and motion[0].max() <= real.max()


@pytest.mark.parametrize("method", SELECTION_METHODS)
def test_gradcheck(method):
    maps = [
        v.requires_grad_()
        for v in list(vars(random_prediction(3, (1, 6, 3, 4))).values())[:2]
    ]

    def pose(*values):
        return select_pose(PixelwisePrediction(*values), method, 2)

    torch.autograd.gradcheck(pose, maps)
    if method in ("softmax", "exp_plus_u", "parts", "joint"):
        pose(*maps).sum().backward()
        assert maps[1].grad.abs().sum() > 0


def test_transform_matches_scipy_and_is_differentiable():
    angles = torch.tensor(
        [[10.0, -20, 30], [0, 0, 0], [179, 60, -100]], dtype=torch.float64
    )
    translation = torch.tensor(
        [[1.0, 2, 3], [0, 0, 0], [-1, 5, 2]], dtype=torch.float64
    )
    motion = torch.cat([angles, translation], dim=1)
    T = euler_transform(motion)
    torch.testing.assert_close(euler_motion(T), motion)
    np.testing.assert_allclose(
        T[:, :3, :3], euler_deg_to_matrix(angles.numpy()), atol=1e-15
    )
    np.testing.assert_allclose(T[:, :3, 3], translation)
    assert T[:, 3].tolist() == [[0, 0, 0, 1]] * 3
    torch.autograd.gradcheck(euler_transform, motion.requires_grad_())


def test_bad_arguments_are_refused():
    prediction = random_prediction(0)
    with pytest.raises(InputError, match="known: softmax"):
        select_pose(prediction, "best")
    bare = replace(prediction, log_scale=None)
    for method in ("mean", "softmax"):  # without uncertainty there is only the mean
        assert torch.equal(
            select_pose(bare, method), prediction.motion.mean(dim=(2, 3))
        )
