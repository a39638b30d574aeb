"""Windows with more unknowns than poses: focal length, scales of depth, depths of pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

import hybridvo as hvo
from hybridvo.core.geometry import ego_flow, invert, se3_exp, se3_log
from hybridvo.core.types import Camera
from hybridvo_lab.synthetic.scenes import make_scene
from hybridvo_lab.windows import window_solver
from hybridvo_lab.windows.window import refine_window

EDGES = [[0, 1], [1, 2], [0, 2], [2, 1]]
FLOW_NOISE_PX = 0.2
DEPTH_NOISE = 0.03
FOCAL_STD = 0.05
SCALE_STD = 0.1
SIZE = (24, 32)
# an edge of fewer pixels has four tiles, from which its covariance is cautious
LARGER = (48, 64)


class Drawn(NamedTuple):
    """A window of a rendered scene, whose depth and focal length are off."""

    batch: hvo.PairBatch
    poses: np.ndarray  # (3, 4, 4) true T_frame_first
    log_focal: float  # of the true focal length over the one that is stated
    log_scale: (
        np.ndarray
    )  # (3,) of the true depth over the measured one, without noise

    def error(self, window) -> np.ndarray:
        """What the unknowns of a window err by, in their order."""
        T = window.T_frame_first.detach().numpy()
        parts = [se3_log(T[k] @ invert(self.poses[k])) for k in range(1, len(T))]
        if window.log_focal is not None:
            parts.append([float(window.log_focal) - self.log_focal])
        if window.log_depth_scale is not None:
            parts.append(window.log_depth_scale.detach().numpy() - self.log_scale)
        return np.concatenate(parts)


def drawn(
    seed: int,
    flow_px: float = FLOW_NOISE_PX,
    depth_noise: float = DEPTH_NOISE,
    focal_std: float = 0.0,
    scale_std: float = 0.0,
    size: tuple[int, int] = SIZE,
    edges: list[list[int]] = EDGES,
) -> Drawn:
    rng = np.random.default_rng(seed)
    height, width = size
    scene = make_scene("static", 0, height=height, width=width, frames=3)
    steps = [rng.normal(0, [0.15] * 3 + [0.05] * 3) for _ in range(2)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(se3_exp(step) @ poses[-1])
    log_focal = focal_std * rng.normal()
    log_scale = scale_std * rng.normal(size=3)
    true = scene.camera
    factor = np.exp(-log_focal)
    stated = Camera(
        true.fx * factor,
        true.fy * factor,
        true.cx,
        true.cy,
        height=height,
        width=width,
    )
    depths = [scene.depth(k) for k in range(3)]
    noise = depth_noise * rng.normal(size=(3, *size)) - log_scale[:, None, None]
    pairs = []
    for prev, curr in edges:
        T = poses[curr] @ invert(poses[prev])
        flow = ego_flow(depths[prev], T, true, true)
        flow = flow + flow_px * rng.normal(size=flow.shape)
        depth = depths[prev] * np.exp(noise[prev])
        frame = hvo.Frame(None, depth, stated)
        pairs.append(hvo.FramePair(frame, hvo.Frame(None, None, stated), flow))
    batch = hvo.PairBatch.from_pairs(pairs, dtype=torch.float64)
    return Drawn(batch, np.stack(poses), log_focal, log_scale)


@pytest.mark.parametrize("shared_depth", [False, True])
def test_focal_length_and_scales_are_found(shared_depth: bool) -> None:
    """Exact flow leaves what the priors pull, which is the factor on all depths."""
    window_of = drawn(1, 0.0, 0.0, FOCAL_STD, SCALE_STD)
    window = refine_window(
        window_of.batch,
        EDGES,
        noise=(0.01, 0.0),
        focal_std=FOCAL_STD,
        depth_scale_std=[0.0, SCALE_STD, SCALE_STD],
        shared_depth=shared_depth,
    )
    assert window.status.ok
    # frame 0 holds the scale, of its own depth
    away = window_of.log_scale - window_of.log_scale[0]
    found = window.log_depth_scale.numpy()
    np.testing.assert_allclose(found, away, atol=2e-4)
    assert float(window.log_focal) == pytest.approx(window_of.log_focal, abs=2e-4)
    true = window_of.poses[2][:3, 3] * np.exp(-window_of.log_scale[0])
    np.testing.assert_allclose(
        window.T_frame_first[2, :3, 3].numpy(), true, atol=2e-4
    )


def test_known_focal_length_and_scales_are_the_poses_alone() -> None:
    batch = drawn(2).batch
    # a window that a gradient is wanted of is solved to the precision of the numbers
    batch = replace(batch, flow=batch.flow.requires_grad_())
    noise = (FLOW_NOISE_PX, DEPTH_NOISE)
    plain = refine_window(batch, EDGES, noise=noise)
    assert plain.log_focal is None
    assert plain.log_depth_scale is None
    assert plain.depth is None
    known = refine_window(
        batch, EDGES, noise=noise, focal_std=1e-9, depth_scale_std=0.0
    )
    sigma = plain.covariance.diagonal().sqrt()
    away = known.SE3.detach() @ plain.SE3.detach().Inv()
    away = away.Log().tensor()[1:].flatten()
    assert float((away / sigma).abs().max()) < 1e-5
    ratio = known.covariance[:12, :12].diagonal() / plain.covariance.diagonal()
    assert float(ratio.log().abs().max()) < 1e-4
    assert float(known.covariance[13:, 13:].abs().max()) == 0.0


class Reference:
    """The same problem for scipy: every depth is an unknown."""

    def __init__(self, batch: hvo.PairBatch, noise: tuple[float, float]) -> None:
        self.batch = batch
        self.noise = noise
        self.count = batch.depth_prev[0].numel()
        self.depth = batch.depth_prev.flatten(1).numpy()
        height, width = batch.depth_prev.shape[1:]
        v, u = np.mgrid[:height, :width].reshape(2, -1).astype(float)
        flow = batch.flow.flatten(1, 2).numpy()
        self.target = np.stack([u, v], axis=1) + flow
        K = batch.K_prev[0].numpy()
        self.rays = np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)])
        self.K = K
        self.at = np.stack([np.eye(4)] * 3)

    def poses(self, x: np.ndarray) -> np.ndarray:
        away = [np.zeros(6), x[:6], x[6:12]]
        return np.stack(
            [se3_exp(d) @ T for d, T in zip(away, self.at, strict=True)]
        )

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Of the flow, and of the priors: focal length, scales, depths."""
        C = self.poses(x)
        v_focal, v_scale, u = x[12], x[13:16], x[16:].reshape(3, -1)
        factor = np.exp(FOCAL_STD * v_focal)
        rows = [x[12:16], x[16:]]
        for k, (prev, curr) in enumerate(EDGES):
            shift = SCALE_STD * v_scale[prev] + self.noise[1] * u[prev]
            X = self.rays * self.depth[k] * np.exp(shift)
            X[:2] /= factor
            T = C[curr] @ invert(C[prev])
            moved = T[:3, :3] @ X + T[:3, 3:]
            ab = moved[:2] / moved[2]
            focal = np.diag(self.K)[:2, None] * factor
            at = focal * ab + self.K[:2, 2:]
            rows.append(((self.target[k].T - at) / self.noise[0]).ravel())
        return np.concatenate(rows)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """By differences: of the depths of all pixels at once, since none meets another."""
        step = 1e-6
        J = np.zeros((len(self.residuals(x)), len(x)))
        for k in range(16):
            J[:, k] = self.slope(x, np.eye(len(x))[k] * step) / step
        N = self.count
        for frame in range(3):
            together = np.zeros(len(x))
            columns = 16 + frame * N + np.arange(N)
            together[columns] = step
            change = self.slope(x, together) / step
            J[4 + frame * N + np.arange(N), columns] = 1.0
            for k, (prev, _) in enumerate(EDGES):
                for half in range(2):
                    first = 4 + 3 * N + (2 * k + half) * N
                    rows = first + np.arange(N)
                    if prev == frame:
                        J[rows, columns] = change[rows]
        return J

    def slope(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        return (self.residuals(x + step) - self.residuals(x - step)) / 2


@pytest.mark.slow
def test_it_is_the_least_squares_solution_with_every_depth_unknown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Against scipy, which solves for all of 16 + 3 N unknowns; and its marginal covariance."""
    noise = (FLOW_NOISE_PX, DEPTH_NOISE)
    window_of = drawn(3, *noise, FOCAL_STD, SCALE_STD, (12, 16))
    # the covariance of the equations alone, whatever the edges say of their errors
    monkeypatch.setattr(
        window_solver,
        "edge_inflation",
        lambda H, _: torch.eye(8).to(H).expand_as(H),
    )
    window = refine_window(
        window_of.batch,
        EDGES,
        noise=noise,
        kernel="l2",
        focal_std=FOCAL_STD,
        depth_scale_std=SCALE_STD,
        shared_depth=True,
    )
    problem = Reference(window_of.batch, noise)
    problem.at = window_of.poses
    start = np.zeros(16 + 3 * problem.count)
    solved = least_squares(
        problem.residuals, start, problem.jacobian, method="trf", xtol=1e-12
    ).x
    C = problem.poses(solved)
    T = window.T_frame_first.numpy()
    away = [se3_log(T[k] @ invert(C[k])) for k in (1, 2)]
    others = [
        [float(window.log_focal) - FOCAL_STD * solved[12]],
        window.log_depth_scale.numpy() - SCALE_STD * solved[13:16],
    ]
    sigma = window.covariance.diagonal().sqrt().numpy()
    # the window stops where its step is below a tenth of a standard deviation
    assert np.abs(np.concatenate([*away, *others]) / sigma).max() < 0.05
    shift = solved[16:].reshape(3, *window.depth.shape[1:]) * DEPTH_NOISE
    scale = SCALE_STD * solved[13:16]
    measured = window_of.batch.depth_prev.numpy()
    for k, (prev, _) in enumerate(EDGES):
        log = np.log(window.depth[k].numpy() / measured[k])
        assert np.abs(log - scale[prev] - shift[prev]).max() < 0.05 * DEPTH_NOISE

    problem.at = C
    solved[:12] = 0.0
    J = problem.jacobian(solved)
    full = np.linalg.inv(J.T @ J)[:16, :16]
    units = np.array([1.0] * 12 + [FOCAL_STD] + [SCALE_STD] * 3)
    expected = units[:, None] * full * units
    outer = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    # both are linearised at the solution, to within that step
    assert np.abs((window.covariance.numpy() - expected) / outer).max() < 0.02


@pytest.mark.slow
def test_the_covariance_covers_the_truth() -> None:
    """Twelve windows with all unknowns: 16 of them each, in the mean of their NEES."""
    nees = []
    for seed in range(12):
        noise = (FLOW_NOISE_PX, DEPTH_NOISE)
        window_of = drawn(seed, *noise, FOCAL_STD, SCALE_STD, LARGER)
        window = refine_window(
            window_of.batch,
            EDGES,
            noise=noise,
            focal_std=FOCAL_STD,
            depth_scale_std=SCALE_STD,
            shared_depth=True,
        )
        error = window_of.error(window)
        nees.append(error @ np.linalg.solve(window.covariance.numpy(), error))
    # chi-square with 192 degrees of freedom: 99.9 % lie within 5.4 of 16
    assert 10.6 < np.mean(nees) < 21.4, nees


@pytest.mark.slow
def test_shared_depths_are_known_to_be_shared() -> None:
    """Three flows of one pair are no independent witnesses of the errors of its depth."""
    noise = (0.02, 0.05)
    edges = [[0, 1]] * 3
    nees: dict[bool, list[float]] = {False: [], True: []}
    for seed in range(8):
        window_of = drawn(seed, *noise, size=LARGER, edges=edges)
        for shared, found in nees.items():
            window = refine_window(
                window_of.batch, edges, noise=noise, shared_depth=shared
            )
            error = window_of.error(window)
            found.append(error @ np.linalg.solve(window.covariance.numpy(), error))
    # 6 numbers, eight windows: 99.9 % within 4 of 6
    assert 2 < np.mean(nees[True]) < 10, nees
    assert np.mean(nees[False]) > 1.5 * np.mean(nees[True]), nees


UNKNOWN = {
    "focal length": {"focal_std": FOCAL_STD},
    "scales": {"depth_scale_std": SCALE_STD},
    "depths": {"shared_depth": True},
    "all": {
        "focal_std": FOCAL_STD,
        "depth_scale_std": SCALE_STD,
        "shared_depth": True,
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("how", UNKNOWN.values(), ids=UNKNOWN)
def test_the_gradient_is_that_of_the_solution(how: dict) -> None:
    window_of = drawn(5, 0.1, 0.02, 0.02, 0.05, (16, 20))
    batch = window_of.batch

    def answers(errors, noise):
        scale, push, focal = errors.split([3, 2, 1])
        depth = batch.depth_prev * scale[prev].exp()[:, None, None]
        column = torch.cat([focal.exp(), focal.exp(), torch.ones_like(focal)])
        K = batch.K_prev * column
        moved = hvo.PairBatch(batch.flow + push, depth, K, K)
        window = refine_window(moved, EDGES, noise=noise, **how)
        assert window.converged
        found = [window.T_frame_first[1:, :3].flatten()]
        if window.log_focal is not None:
            found.append(window.log_focal[None])
        if window.log_depth_scale is not None:
            found.append(window.log_depth_scale)
        if window.depth is not None:
            found.append(window.depth[:, 5, 7])
        return torch.cat(found)

    errors = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    noise = torch.tensor([0.1, 0.02], dtype=torch.float64, requires_grad=True)
    prev = [edge[0] for edge in EDGES]
    assert torch.autograd.gradcheck(
        answers, (errors, noise), eps=1e-5, atol=1e-4, rtol=1e-3, fast_mode=True
    )


def test_a_second_derivative_is_refused() -> None:
    window_of = drawn(6, size=(16, 20))
    flow = window_of.batch.flow.clone().requires_grad_()
    window = refine_window(
        replace(window_of.batch, flow=flow),
        EDGES,
        noise=(FLOW_NOISE_PX, DEPTH_NOISE),
        focal_std=FOCAL_STD,
        shared_depth=True,
    )
    for answer in (window.T_frame_first, window.log_focal, window.depth):
        (first,) = torch.autograd.grad(answer.sum(), flow, create_graph=True)
        assert torch.isfinite(first).all() and first.abs().max() > 0
        with pytest.raises(hvo.InputError, match="second"):
            torch.autograd.grad(first.square().sum(), flow, retain_graph=True)


def test_single_precision_and_estimated_noise_give_the_same_within_the_noise() -> (
    None
):
    batch = drawn(7).batch
    how = {
        "focal_std": FOCAL_STD,
        "depth_scale_std": SCALE_STD,
        "shared_depth": True,
    }
    exact = refine_window(batch, EDGES, noise=(FLOW_NOISE_PX, DEPTH_NOISE), **how)
    single = {
        name: value.float() if value.is_floating_point() else value
        for name, value in vars(batch).items()
        if value is not None
    }
    window = refine_window(hvo.PairBatch(**single), EDGES, **how)
    assert window.status.ok
    sigma = exact.covariance.diagonal().sqrt()
    away = (window.SE3 @ exact.SE3.Inv()).Log().tensor()[1:].flatten()
    assert float((away / sigma[:12]).abs().max()) < 2


def test_an_edge_that_fails_leaves_the_rest() -> None:
    batch = drawn(8).batch
    flow = batch.flow.clone()
    flow[2] = torch.nan
    window = refine_window(
        replace(batch, flow=flow),
        EDGES,
        noise=(FLOW_NOISE_PX, DEPTH_NOISE),
        focal_std=FOCAL_STD,
        depth_scale_std=SCALE_STD,
        shared_depth=True,
    )
    assert window.used.tolist() == [True, True, False, True]
    assert window.status.usable and not window.status.ok
    assert torch.isfinite(window.covariance).all()
    assert torch.isfinite(window.T_frame_first).all()
    assert torch.isfinite(window.depth).all()


def test_a_window_that_fails_has_the_priors() -> None:
    batch = drawn(9).batch
    nothing = torch.full_like(batch.flow, torch.nan)
    window = refine_window(
        replace(batch, flow=nothing),
        EDGES,
        focal_std=FOCAL_STD,
        depth_scale_std=SCALE_STD,
    )
    assert not window.status.usable
    assert window.covariance.shape == (16, 16)
    assert float(window.covariance[12, 12]) == pytest.approx(FOCAL_STD**2)
    assert window.log_depth_scale.tolist() == [0.0] * 3


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("focal_std", 0.0),
        ("focal_std", float("inf")),
        ("focal_std", "wide"),
        ("focal_std", True),
        ("depth_scale_std", -0.1),
        ("depth_scale_std", [0.1, 0.1]),
        ("depth_scale_std", float("nan")),
        ("shared_depth", "yes"),
    ],
)
def test_a_prior_that_is_none_is_refused(name: str, value) -> None:
    batch = drawn(0).batch
    with pytest.raises(hvo.InputError, match=f"refine_window.{name}: expected"):
        refine_window(batch, EDGES, **{name: value})


def test_two_depth_maps_of_one_frame_are_not_shared() -> None:
    batch = drawn(0).batch
    depth = batch.depth_prev.clone()
    depth[2] *= 1.1
    with pytest.raises(hvo.InputError, match="one depth map of frame 0"):
        refine_window(replace(batch, depth_prev=depth), EDGES, shared_depth=True)
