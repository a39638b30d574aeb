"""Gradients where a rotation is half a turn, and where Euler angles lock (F38)."""

from __future__ import annotations

import math

import numpy as np
import pypose as pp
import pytest
import torch

from hybridvo.geometry import euler_deg_to_matrix
from hybridvo.network.scale_free import euler_deg
from hybridvo.pose.batched import BatchOptions, refine_batch
from hybridvo.pose.residuals import reproject
from hybridvo.pose.selection import selected_transform
from hybridvo.types import PairBatch

F64 = torch.float64
NEAR = (0.0, 1e-12, 1e-7, -1e-7, 1e-3)


def turn(axis: int, angle: float) -> torch.Tensor:
    w = torch.zeros(1, 3, dtype=F64)
    w[0, axis] = angle
    return pp.so3(w).Exp().matrix()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("angle", [math.pi, math.pi / 2, -math.pi / 2])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_euler_angles_of_half_and_quarter_turns(axis: int, angle: float, dtype) -> None:
    for offset in NEAR:
        R = turn(axis, angle + offset).to(dtype).requires_grad_()
        found = euler_deg(R)
        (gradient,) = torch.autograd.grad(found.sum(), R)
        assert torch.isfinite(gradient).all(), (axis, angle, offset)
        again = euler_deg_to_matrix(found[0].detach().double().numpy())
        # asin next to one knows an angle to the root of the rounding
        np.testing.assert_allclose(again, R[0].detach().numpy(), atol=2e-3)


@pytest.mark.parametrize("angles", [(180.0, 0, 0), (0, 180.0, 0), (0, 0, -180.0), (180.0, 90, 180)])
def test_selected_motion(angles) -> None:
    rotation = torch.tensor([angles], dtype=F64, requires_grad=True)
    translation = torch.tensor([[0.1, -0.2, 0.3]], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(selected_transform, (rotation, translation))


@pytest.mark.parametrize("offset", NEAR)
def test_a_refined_motion_of_half_a_turn(offset: float) -> None:
    """About the axis of the lens: the only half turn whose two pictures show the same things."""
    T = torch.eye(4, dtype=F64)[None]
    T[:, :3, :3] = turn(2, math.pi + offset)
    T[:, :3, 3] = torch.tensor([0.05, -0.02, 0.1], dtype=F64)
    K = torch.tensor([[[40.0, 0, 11.5], [0, 40.0, 7.5], [0, 0, 1]]], dtype=F64)
    v, u = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    depth = (3 + 0.05 * u + torch.sin(v / 3)).to(F64)[None]
    flow = reproject(depth, T, K, K)[0] - torch.stack([u, v], dim=-1).to(F64)
    generator = torch.Generator().manual_seed(0)
    flow = flow + 0.1 * torch.randn(flow.shape, generator=generator, dtype=F64)
    leaves = [x.clone().requires_grad_() for x in (flow, depth, K)]
    found = refine_batch(
        PairBatch(leaves[0], leaves[1], leaves[2], leaves[2]),
        T_init=T,
        noise=(0.1, 0.01),
        options=BatchOptions(tight=True),
    )
    assert found.converged.all() and (found.T_curr_prev - T).abs().max() < 0.05
    C = torch.randn(1, 4, 4, dtype=F64, generator=generator)
    gradients = torch.autograd.grad((C * found.T_curr_prev).sum(), leaves)
    for gradient in gradients:
        assert torch.isfinite(gradient).all() and 0 < gradient.abs().max() < 1e3
