"""A pose graph on hybridvo's motions: between factors with their covariance, and a loop closure.

    python docs/examples/pose_graph.py
    python docs/examples/pose_graph.py --sequence path/to/sequence --frames 200

Tracks a walk that comes back to where it began (a rendered one, unless a sequence is given), adds
every usable motion as a factor with its own covariance, closes the loop with one more motion found
by ``hybridvo.estimate`` between the last frame and the first, and optimises: with scipy, and with
GTSAM too where it is installed (``pip install gtsam``). Both find the same poses.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

import hybridvo as hvo
from hybridvo.errors import HybridVOError
from hybridvo.flow import dis_flow
from hybridvo.geometry import invert, se3_exp, se3_log, to_gtsam_covariance

FIRST_SIGMA = 1e-4
"""Of the prior that holds the first pose."""


@dataclass
class Between:
    """The pose of frame j in the frame of i, and the covariance of hybridvo's motion i -> j."""

    i: int
    j: int
    T_i_j: np.ndarray
    covariance: np.ndarray


def track(
    frames: Iterable[hvo.Frame],
) -> tuple[list[hvo.Frame], list[np.ndarray], list[Between]]:
    """The frames of the graph, their chained poses, and a factor for each usable motion.

    A degraded motion is usable: its covariance is wide, and without its factor the graph would fall
    into two parts. A failed motion is no measurement: its frame is left out, and the next motion
    starts from the frame before it.
    """
    vo = hvo.Odometry()
    kept: list[hvo.Frame] = []
    poses: list[np.ndarray] = []
    factors: list[Between] = []
    node: dict[int, int] = {}  # index of a frame -> its number in the graph
    for frame in frames:
        step = vo.track(frame)
        if not step.usable:
            continue
        if step.prev_index is not None:
            if step.prev_index not in node:
                # two motions failed in a row: nothing joins what follows to what was
                print(
                    f"lost before frame {step.index}: the frames from there on are left out"
                )
                break
            i = node[step.prev_index]
            factors.append(Between(i, len(kept), step.T_prev_curr, step.covariance))
        node[step.index] = len(kept)
        kept.append(frame)
        poses.append(step.T_world_cam)
    return kept, poses, factors


def close_loop(kept: list[hvo.Frame]) -> Between | None:
    """The factor between the first frame and the last one, where one sees what the other saw.

    A wrong loop closure bends the whole walk: here the motion has to be ``ok``, not only usable.
    """
    prev = kept[0]
    curr = kept[-1]
    field = dis_flow()(prev, curr)
    pair = hvo.FramePair(
        prev, curr, field.flow, field.variance, field.valid, field.source
    )
    motion = hvo.estimate(pair)
    if not motion.ok:
        return None
    return Between(0, len(kept) - 1, motion.T_prev_curr, motion.covariance)


def optimise_scipy(
    poses: list[np.ndarray], factors: list[Between]
) -> list[np.ndarray]:
    """Poses that fit all factors best, the first one held.

    hybridvo's covariance is of ``Exp(d) T_curr_prev``, d = (translation, rotation): the residual of
    a factor is the logarithm of its motion times the inverse of the estimated one.
    """
    n = len(poses)
    roots = [np.linalg.inv(np.linalg.cholesky(f.covariance)) for f in factors]

    def moved(x: np.ndarray) -> list[np.ndarray]:
        steps = x.reshape(n - 1, 6)
        return [
            poses[0],
            *(T @ se3_exp(d) for T, d in zip(poses[1:], steps, strict=True)),
        ]

    def residuals(x: np.ndarray) -> np.ndarray:
        T = moved(x)
        return np.concatenate(
            [
                root @ se3_log(invert(f.T_i_j) @ invert(T[f.i]) @ T[f.j])
                for f, root in zip(factors, roots, strict=True)
            ]
        )

    sparsity = lil_matrix((6 * len(factors), 6 * (n - 1)), dtype=np.int8)
    for row, f in enumerate(factors):
        for k in (f.i, f.j):
            if k > 0:
                sparsity[6 * row : 6 * row + 6, 6 * k - 6 : 6 * k] = 1
    found = least_squares(
        residuals, np.zeros(6 * (n - 1)), jac_sparsity=sparsity, x_scale="jac"
    )
    return moved(found.x)


def optimise_gtsam(
    poses: list[np.ndarray], factors: list[Between]
) -> list[np.ndarray] | None:
    """The same with GTSAM; None where it is not installed.

    GTSAM's between factor wants ``T_i_j`` and the covariance of a right perturbation, rotation
    first: :func:`hybridvo.geometry.to_gtsam_covariance`.
    """
    try:
        import gtsam
    except ImportError:
        return None
    graph = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(poses[0]), held))
    for f in factors:
        noise = gtsam.noiseModel.Gaussian.Covariance(
            to_gtsam_covariance(f.covariance)
        )
        graph.add(gtsam.BetweenFactorPose3(f.i, f.j, gtsam.Pose3(f.T_i_j), noise))
    for k, T in enumerate(poses):
        values.insert(k, gtsam.Pose3(T))
    answer = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return [answer.atPose3(k).matrix() for k in range(len(poses))]


def round_trip(
    count: int, height: int, width: int
) -> tuple[list[hvo.Frame], list[np.ndarray]]:
    """A rendered walk forth and back, ending beside its start, with the true poses."""
    from hybridvo.synthetic.scenes import make_scene

    scene = make_scene(
        "static", 3, height=height, width=width, frames=count // 2 + 1
    )
    path = [*range(count // 2 + 1), *range(count // 2 - 1, 0, -1)]
    frames: list[hvo.Frame] = []
    truth: list[np.ndarray] = []
    rendered = {k: scene.render(k) for k in set(path)}
    for index, at in enumerate(path):
        depth = np.where(np.isfinite(rendered[at].depth), rendered[at].depth, 0)
        frames.append(
            hvo.Frame(rendered[at].rgb, depth, scene.camera, index / 24, index)
        )
        truth.append(invert(scene.T_world_cam[0]) @ scene.T_world_cam[at])
    return frames, truth


def main(argv: list[str] | None = None) -> int:
    """Track, close the loop, optimise, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--sequence", metavar="DIR", help="a sequence that ends where it began"
    )
    parser.add_argument(
        "--frames", type=int, default=12, help="at most so many (default 12)"
    )
    parser.add_argument(
        "--size", default="144x320", help="of the rendered pictures"
    )
    args = parser.parse_args(argv)
    truth: list[np.ndarray] = []
    try:
        if args.sequence:
            sequence = hvo.open_sequence(args.sequence)
            frames = [sequence[i] for i in range(min(args.frames, len(sequence)))]
        else:
            frames, truth = round_trip(args.frames, *map(int, args.size.split("x")))
        kept, poses, factors = track(frames)
    except HybridVOError as error:
        print(f"pose_graph.py: {error}", file=sys.stderr)
        return 2
    print(
        f"{len(kept)} of {len(frames)} frames, {len(factors)} motions between them"
    )
    loop = close_loop(kept)
    if loop is None:
        print("no sure motion from the first frame to the last: no loop to close")
        return 1
    error = se3_log(invert(loop.T_i_j) @ invert(poses[loop.i]) @ poses[loop.j])
    print(f"loop closed over an error of {1e3 * np.linalg.norm(error[:3]):.2f} mm")
    found = optimise_scipy(poses, [*factors, loop])
    report("chained", poses, truth)
    report("scipy", found, truth)
    other = optimise_gtsam(poses, [*factors, loop])
    if other is None:
        print("gtsam is not installed: pip install gtsam")
        return 0
    report("gtsam", other, truth)
    apart = max(np.abs(a - b).max() for a, b in zip(found, other, strict=True))
    print(f"scipy and gtsam differ by at most {apart:.1e}")
    return 0


def report(name: str, poses: list[np.ndarray], truth: list[np.ndarray]) -> None:
    """Print how far poses are from the true ones, where these are known."""
    if truth:
        squared = [
            np.sum((a[:3, 3] - b[:3, 3]) ** 2)
            for a, b in zip(poses, truth, strict=True)
        ]
        print(
            f"{name}: {1e3 * np.sqrt(np.mean(squared)):.2f} mm from the ground truth (rms)"
        )


if __name__ == "__main__":
    sys.exit(main())
