"""Poses of several frames from all flow between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.core.types import Camera
from hybridvo_lab.windows.window import refine_window

CAMERA = Camera(60.0, 60.0, 31.5, 23.5, height=48, width=64)
EDGES = [[0, 1], [1, 2], [0, 2]]


def depth_of(T_frame_first: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A bumpy wall, which need not be the same in all frames: each pair rests on its own."""
    u = np.arange(64) / 9.0
    v = np.arange(48)[:, None] / 7.0
    phase = rng.uniform(0, 6)
    return 3.0 + 0.6 * np.sin(u + phase) + 0.5 * np.cos(v - phase)


def window_of(noise_px: float, seed: int = 0, edges=EDGES):
    """Pairs between frames on a path, and the true poses relative to frame 0."""
    rng = np.random.default_rng(seed)
    steps = [rng.normal(0, [0.03] * 3 + [0.01] * 3) for _ in range(2)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(se3_exp(step) @ poses[-1])
    pairs = []
    for prev, curr in edges:
        T = poses[curr] @ invert(poses[prev])
        depth = depth_of(poses[prev], rng)
        flow = ego_flow(depth, T, CAMERA, CAMERA)
        flow = flow + noise_px * rng.normal(size=flow.shape)
        frame = hvo.Frame(None, depth, CAMERA)
        pairs.append(hvo.FramePair(frame, hvo.Frame(None, None, CAMERA), flow))
    return hvo.PairBatch.from_pairs(pairs, dtype=torch.float64), np.stack(poses)


def distance(T: np.ndarray, truth: np.ndarray) -> float:
    return float(np.abs(T - truth).max())


def test_it_finds_the_poses_whichever_way_an_edge_leads() -> None:
    batch, truth = window_of(0.0, edges=[[1, 0], [2, 1], [0, 2]])
    window = refine_window(batch, [[1, 0], [2, 1], [0, 2]], noise=(0.1, 0.0))
    assert window.status.ok and window.converged
    assert distance(window.T_frame_first.numpy(), truth) < 1e-6


def test_one_edge_is_the_refinement_of_a_pair() -> None:
    batch, _ = window_of(0.3, edges=[[0, 1]])
    window = refine_window(batch, [[0, 1]], noise=(0.3, 0.0))
    alone = hvo.refine(batch, noise=(0.3, 0.0))
    assert (window.T_frame_first[1] - alone.T_curr_prev[0]).abs().max() < 1e-4
    ratio = window.covariance_of(1).diagonal() / alone.covariance[0].diagonal()
    assert (ratio.log().abs() < 0.05).all()
    assert float(window.disagreement[0]) < 1e-2


@pytest.mark.slow
def test_flow_over_two_frames_takes_back_what_a_chain_drifts_by() -> None:
    chain = []
    joint = []
    nees = []
    for seed in range(16):
        batch, truth = window_of(0.5, seed)
        window = refine_window(batch, EDGES, noise=(0.5, 0.0))
        alone = window.edges.T_curr_prev.numpy()
        end = window.T_frame_first[2].numpy()
        chain.append(np.square(se3_log(alone[1] @ alone[0] @ invert(truth[2]))))
        away = se3_log(end @ invert(truth[2]))
        joint.append(np.square(away))
        nees.append(away @ np.linalg.solve(window.covariance_of(2).numpy(), away))
    # two ways of equal noise in the chain, and one of half of it beside
    assert np.mean(joint) < 0.6 * np.mean(chain)
    # six numbers, sixteen windows: 99.9 % lie between these
    assert 3.6 < np.mean(nees) < 9.2


@pytest.mark.slow
def test_the_gradient_is_that_of_the_solution() -> None:
    """Of the last pose by log depth scale and flow, against differences."""
    batch, _ = window_of(0.2)
    scale = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    push = torch.zeros(1, 1, 1, 2, dtype=torch.float64, requires_grad=True)

    def last_pose(scale, push):
        depth = batch.depth_prev * scale.exp()[:, None, None]
        moved = replace(batch, depth_prev=depth, flow=batch.flow + push)
        window = refine_window(moved, EDGES, noise=(0.2, 0.0))
        return window.T_frame_first[1:, :3]

    assert torch.autograd.gradcheck(
        last_pose, (scale, push), eps=1e-5, atol=2e-4, rtol=2e-3
    )


def test_edges_that_contradict_each_other_disagree_with_the_window() -> None:
    """Three edges of a triangle cannot tell which of them errs; that one does shows."""
    batch, _ = window_of(0.2)
    agreeing = refine_window(batch, EDGES, noise=(0.2, 0.0))
    assert float(agreeing.disagreement.max()) < 30
    flow = batch.flow.clone()
    flow[2, ..., 0] += 4.0
    window = refine_window(replace(batch, flow=flow), EDGES, noise=(0.2, 0.0))
    assert float(window.disagreement.max()) > 1000


def test_an_edge_without_depth_is_left_out() -> None:
    batch, truth = window_of(0.0)
    depth = batch.depth_prev.clone()
    depth[2] = 0.0
    window = refine_window(
        replace(batch, depth_prev=depth), EDGES, noise=(0.1, 0.0)
    )
    assert window.used.tolist() == [True, True, False]
    assert window.status.usable and not window.status.ok
    assert distance(window.T_frame_first.numpy(), truth) < 1e-6


def test_a_frame_that_no_usable_flow_reaches_is_a_status() -> None:
    batch, _ = window_of(0.0, edges=[[0, 1], [1, 2]])
    depth = batch.depth_prev.clone()
    depth[1] = float("nan")
    window = refine_window(replace(batch, depth_prev=depth), [[0, 1], [1, 2]])
    assert not window.status.usable
    assert torch.isfinite(window.T_frame_first).all()
    assert torch.isfinite(window.covariance).all()


@pytest.mark.parametrize(
    "edges",
    [
        [[0, 1]],
        [[0, 1], [1, 1], [0, 2]],
        [[0, 1], [1, 2], [3, 4]],
        "abc",
        [[0.0, 1]] * 3,
    ],
)
def test_edges_that_join_nothing_are_refused(edges) -> None:
    batch, _ = window_of(0.0)
    with pytest.raises(hvo.InputError, match=r"refine_window\.edges"):
        refine_window(batch, edges)
