from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from hybridvo.core.errors import InputError
from hybridvo.core.geometry import ego_flow, euler_deg_to_matrix, make_transform
from hybridvo.core.types import Camera, Frame, FramePair, PairBatch
from hybridvo_lab.paper.inputs import NetworkInputs, assemble_inputs

CAMERA = Camera(20.0, 25.0, 3.5, 1.5, height=4, width=8)


def make_pair(
    height=4, width=8, camera=CAMERA, seed=0, flow=None, **changes
) -> FramePair:
    rng = np.random.default_rng(seed)
    prev, curr = rng.uniform(1, 5, (2, height, width)).astype(np.float32)
    if flow is None:
        flow = rng.normal(0, 1, (height, width, 2)).astype(np.float32)
    return FramePair(
        Frame(None, prev, camera), Frame(None, curr, camera), flow, **changes
    )


def test_values_at_native_size_by_hand():
    flow = np.zeros((4, 8, 2), np.float32)
    flow[1, 2] = (3.0, 1.0)  # pixel (2, 1) goes to (5, 2)
    flow[0, 0] = (-1.0, 0.0)  # leaves the picture
    pair = make_pair(flow=flow)
    inputs = assemble_inputs(pair, (4, 8))
    assert inputs.flow.shape == (1, 2, 4, 8)
    assert inputs.flow[0, :, 1, 2].tolist() == pytest.approx([3.0, 1.0])
    assert inputs.inverse_depth[0, 0, 1, 2].item() == pytest.approx(
        1 / pair.prev.depth[1, 2]
    )
    assert inputs.inverse_depth[0, 1, 1, 2].item() == pytest.approx(
        1 / pair.curr.depth[2, 5]
    )
    assert inputs.inverse_depth[0, 1, 0, 0] == 0
    assert inputs.inverse_depth[0, 1, 3, 3].item() == pytest.approx(
        1 / pair.curr.depth[3, 3]
    )
    assert inputs.rays[0, :, 1, 2].tolist() == pytest.approx(
        [(2 - 3.5) / 20, (1 - 1.5) / 25]
    )
    assert inputs.valid.all()
    assert 1 / inputs.inverse_depth[0, 1, 1, 2].item() == pytest.approx(
        pair.curr.depth[2, 5]
    )
    np.testing.assert_allclose(inputs.K_prev[0], CAMERA.K)


def test_a_rigid_scene_keeps_its_equation_after_resizing():
    camera_prev = Camera(300, 300, 160, 110, height=218, width=320)
    camera_curr = Camera(310, 310, 158, 108, height=218, width=320)
    v, u = np.mgrid[0:218, 0:320]
    depth = 4 + 0.005 * u + 0.003 * v
    T = make_transform(
        euler_deg_to_matrix(np.array([0.5, -1, 0.3])), np.array([0.1, -0.05, 0.2])
    )
    flow = ego_flow(depth, T, camera_prev, camera_curr).astype(np.float32)
    depth = depth.astype(np.float32)
    pair = FramePair(
        Frame(None, depth, camera_prev), Frame(None, depth, camera_curr), flow
    )
    inputs = assemble_inputs(pair, (128, 256))
    # F = pi(K', M D ray) - K ray, with the ray of the pixel that was taken: exact to float32.
    X = (
        torch.cat([inputs.rays, torch.ones(1, 1, 128, 256)], dim=1)
        / inputs.inverse_depth[:, :1]
    )
    R, t = (torch.tensor(x, dtype=torch.float32) for x in (T[:3, :3], T[:3, 3]))
    moved = torch.einsum("ij,bjhw->bihw", R, X) + t[None, :, None, None]

    def pixels(K, x):
        return torch.einsum("bij,bjhw->bihw", K, x / x[:, 2:])[:, :2]

    expected = pixels(inputs.K_curr, moved) - pixels(inputs.K_prev, X)
    torch.testing.assert_close(inputs.flow, expected, atol=2e-4, rtol=0)


@pytest.mark.parametrize("damage", [np.nan, np.inf, -np.inf])
def test_damaged_flow_is_zero_and_marked(damage):
    pair = make_pair()
    flow = pair.flow.copy()
    flow[1, 2, 0] = damage
    inputs = assemble_inputs(replace(pair, flow=flow), (4, 8))
    assert inputs.flow[0, :, 1, 2].tolist() == [0, 0]
    assert inputs.inverse_depth[0, 1, 1, 2] == 0
    assert not inputs.valid[0, 1, 2]
    assert inputs.valid.sum() == 31


@pytest.mark.parametrize("damage", [np.nan, np.inf, -np.inf, 0.0, -2.0, 1e-30])
def test_damaged_depth_is_zero_and_marked(damage):
    pair = make_pair(flow=np.zeros((4, 8, 2), np.float32))
    prev, curr = pair.prev.depth.copy(), pair.curr.depth.copy()
    prev[1, 2] = damage
    curr[3, 4] = damage
    pair = replace(
        pair,
        prev=replace(pair.prev, depth=prev),
        curr=replace(pair.curr, depth=curr),
    )
    inputs = assemble_inputs(pair, (4, 8))
    assert inputs.inverse_depth[0, 0, 1, 2] == 0
    assert inputs.inverse_depth[0, 1, 3, 4] == 0
    assert not inputs.valid[0, 1, 2]
    assert inputs.valid[0, 3, 4]
    for field in fields(NetworkInputs):
        assert torch.isfinite(getattr(inputs, field.name)).all()


def test_masks_are_respected():
    flow_valid, mask = np.ones((2, 4, 8), bool)
    flow_valid[0, 0] = mask[1, 1] = False
    pair = make_pair(flow=np.ones((4, 8, 2), np.float32), flow_valid=flow_valid)
    curr_mask = np.ones((4, 8), bool)
    curr_mask[3, 3] = False
    pair = replace(
        pair,
        prev=replace(pair.prev, mask=mask),
        curr=replace(pair.curr, mask=curr_mask),
    )
    inputs = assemble_inputs(pair, (4, 8))
    assert not inputs.valid[0, 0, 0] and not inputs.valid[0, 1, 1]
    assert inputs.valid.sum() == 30
    assert inputs.inverse_depth[0, 1, 2, 2] == 0  # lands on the masked pixel (3, 3)


def test_missing_flow_or_depth_is_all_invalid_and_finite():
    pair = make_pair()
    for broken in (
        replace(pair, flow=None),
        replace(pair, prev=replace(pair.prev, depth=None)),
    ):
        inputs = assemble_inputs(broken, (8, 8))
        assert not inputs.valid.any()
        assert all(
            torch.isfinite(getattr(inputs, f.name)).all() for f in fields(inputs)
        )
    inputs = assemble_inputs(
        replace(pair, curr=replace(pair.curr, depth=None)), (4, 8)
    )
    assert inputs.valid.all()
    assert (inputs.inverse_depth[:, 1] == 0).all()


def test_batches_equal_single_pairs():
    pairs = [
        make_pair(seed=1),
        replace(make_pair(seed=2), flow=None),
        make_pair(seed=3),
    ]
    flows = [
        np.full((4, 8, 2), np.nan) if p.flow is None else p.flow for p in pairs
    ]
    K = torch.tensor(CAMERA.K, dtype=torch.float32).repeat(3, 1, 1)
    flow, depth_prev, depth_curr = (
        torch.tensor(np.stack(x), dtype=torch.float32)
        for x in (
            flows,
            [p.prev.depth for p in pairs],
            [p.curr.depth for p in pairs],
        )
    )
    batch = PairBatch(flow, depth_prev, K, K, depth_curr)
    batched = assemble_inputs(batch, (8, 16))
    for i, pair in enumerate(pairs):
        alone = assemble_inputs(pair, (8, 16))
        for field in fields(NetworkInputs):
            assert torch.equal(
                getattr(batched, field.name)[i], getattr(alone, field.name)[0]
            )


def test_bad_arguments_are_refused():
    for thing in (None, [], [1, 2], np.zeros((4, 8, 2))):
        with pytest.raises(InputError, match="FramePair"):
            assemble_inputs(thing)
    flow, depth, K = (
        torch.zeros(1, 4, 8, 2),
        torch.ones(1, 4, 8),
        torch.eye(3)[None],
    )
    for changes in (
        {"flow": flow.permute(0, 3, 1, 2)},
        {"depth_prev": None},
        {"K_prev": K[0]},
    ):
        with pytest.raises(InputError, match=r"PairBatch.*: expected"):
            assemble_inputs(replace(PairBatch(flow, depth, K, K), **changes))
