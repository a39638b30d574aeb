"""The hybrid on whole rendered sequences and on the solver's cells, one record per answer.

Sequences are tracked by :class:`hybridvo.Odometry` from the first frame to the last, as a user
would: motions are chained, the last one takes part, a failed frame holds the pose. True flow, true
depth and the true mask are oracles.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hybridvo import Odometry
from hybridvo.errors import InputError
from hybridvo.evaluation.calibration import normalised_error
from hybridvo.evaluation.metrics import ate
from hybridvo.evaluation.pairs import dynamic_fraction, pair_errors
from hybridvo.flow import FlowField, dis_flow
from hybridvo.geometry import invert
from hybridvo.hypotheses.confidence import REFERENCE_WIDTH
from hybridvo.learned_judge import LearnedJudge
from hybridvo.pipeline import JUDGED, check_method, estimate, shipped_judge
from hybridvo.synthetic.render import SyntheticSequence, make_scene
from hybridvo.synthetic.scenarios import SCENARIOS, make_pair
from hybridvo.synthetic.scenes import SCENE_KINDS
from hybridvo.trajectory import Trajectory
from hybridvo.types import FramePair, RelativePose

__all__ = [
    "CELL_METHODS",
    "FAILURE_PX",
    "FLOWS",
    "HEAVY_KINDS",
    "ORACLE",
    "Measured",
    "RecordedJudge",
    "SequenceOptions",
    "methods_here",
    "run_cells",
    "run_sequence",
]

HEAVY_KINDS = ("heavy_rigid", "heavy_deforming", "heavy_two", "heavy_ten")
"""Families of :mod:`hybridvo.synthetic.scenes`; the judge is trained on other builders."""
FLOWS = ("true", "true+noise", "dis")
FAILURE_PX = 1.0
"""Mean error of the ego flow, px of the picture, from which a motion is wrong."""
ORACLE = "refine-oracle-static-mask"
"""``refine`` told by the truth which pixels are static: what a perfect mask would give."""
METHODS = ("hybrid-flow", "hybrid", "refine", "poselib", "pnp-ransac-tuned", ORACLE)
CELL_METHODS = ("hybrid-flow", "refine")
NOISE_PX = 0.5
NOISE_LOG_DEPTH = 0.02
"""Gaussian, independent per pixel: what the covariance is derived for."""


@dataclass(frozen=True)
class SequenceOptions:
    """What is rendered.

    Args:
        kinds: families. seeds: of each. frames: of a sequence. height, width: pixels.
        methods: rows, of :func:`methods_here`.
        noisy_stride: every how manieth pair is also measured with the model's noise; 0 for none.

    Raises:
        InputError: fewer than three frames, no kind, seed or method, or an unknown kind.
    """

    kinds: tuple[str, ...] = HEAVY_KINDS
    seeds: tuple[int, ...] = (0,)
    frames: int = 200
    height: int = 218
    width: int = 512
    methods: tuple[str, ...] = METHODS
    noisy_stride: int = 2

    def __post_init__(self) -> None:
        if self.frames < 3 or not (self.kinds and self.seeds and self.methods):
            raise InputError(
                f"SequenceOptions: expected at least 3 frames (for an ATE), one kind, one seed and "
                f"one method, got {self.frames} frames, {self.kinds}, {self.seeds}, {self.methods}."
            )
        for kind in self.kinds:
            if kind not in SCENE_KINDS:
                raise InputError(
                    f"SequenceOptions.kinds: expected some of {', '.join(SCENE_KINDS)}, got {kind}."
                )
        if self.noisy_stride < 0:
            raise InputError(f"SequenceOptions.noisy_stride: expected >= 0: {self.noisy_stride}.")


class RecordedJudge(LearnedJudge):
    """A judge that remembers the last probability it stated; for one tracker at a time.

    Args:
        judge: whose network answers.
    """

    def __init__(self, judge: LearnedJudge) -> None:
        vars(self).update(vars(judge))
        self.probability: float | None = None

    def look_again(self, *args: Any, **options: Any) -> Any:
        """See :class:`hybridvo.pipeline.LearnedJudge`."""
        opinion = super().look_again(*args, **options)
        self.probability = opinion.trust
        return opinion

    def take(self) -> float | None:
        """The probability stated since the last call; None where nobody was asked."""
        probability, self.probability = self.probability, None
        return probability


def methods_here() -> tuple[tuple[str, ...], dict[str, str]]:
    """Rows that can run here, and why the others cannot."""
    able, absent = [], {}
    for name in METHODS:
        try:
            check_method("refine" if name == ORACLE else name)
            able.append(name)
        except InputError as error:
            absent[name] = str(error)
    return tuple(able), absent


def _answer(
    motion: RelativePose,
    T_true: np.ndarray,
    depth: np.ndarray,
    pair: FramePair,
    probability: float | None,
) -> dict[str, Any]:
    """Error of one motion, and what it says about itself."""
    cameras = pair.prev.camera, pair.curr.camera
    error = pair_errors(motion.T_curr_prev, T_true, depth, *cameras)["epe_l2_px"]
    assert error is not None  # rendered depth is valid somewhere
    return {
        "status": motion.status.state.value,
        "reason": motion.status.reason.value,
        "epe_px": error,
        "failure": bool(error > FAILURE_PX or not motion.ok),
        "nees": normalised_error(motion.T_curr_prev, motion.covariance, T_true),
        "probability": probability,
        "noise_px": motion.residual_scale_px * REFERENCE_WIDTH / pair.prev.camera.width,
        "share": motion.inlier_ratio,
        "right": bool(motion.ok and error * REFERENCE_WIDTH / pair.prev.camera.width <= 1.0),
        "ms": motion.ms,
    }


def _trackers(methods: Sequence[str], judge: RecordedJudge) -> dict[str, Odometry]:
    return {
        name: Odometry(
            judge if name in JUDGED else None,
            method="refine" if name == ORACLE else name,
        )
        for name in methods
    }


@dataclass(frozen=True)
class Measured:
    """What came of one sequence.

    Args:
        records: one per flow, method and pair.
        paths: one per flow and method, with ``ate_m`` (RMSE after rigid alignment), ``path_m``
            (true length) and their ratio ``ate_share``.
        cpu_s: processor time.
    """

    records: list[dict[str, Any]]
    paths: list[dict[str, Any]]
    cpu_s: float


def run_sequence(kind: str, seed: int, options: SequenceOptions) -> Measured:
    """Every method on the true and on the DIS flow of one sequence.

    Args:
        kind: family of :data:`hybridvo.synthetic.render.SCENE_KINDS`.
        seed: of the sequence.
        options: of the rendering; its kinds and seeds are not looked at.

    Raises:
        InputError: an unknown kind, or a method that cannot run here.
    """
    started = time.process_time()
    scene = make_scene(
        kind, seed, height=options.height, width=options.width, frames=options.frames
    )
    sequence = SyntheticSequence(scene, name=f"{kind}_{seed}")
    judge = RecordedJudge(shipped_judge())
    flows = tuple(flow for flow in FLOWS if flow != "true+noise")
    # there is nothing for the pictures to sharpen in the true flow
    rows_of = {
        flow: [m for m in options.methods if (flow, m) != ("true", "hybrid")] for flow in flows
    }
    trackers = {flow: _trackers(rows_of[flow], judge) for flow in flows}
    paths: dict[tuple[str, str], list[np.ndarray]] = {}
    facts: dict[str, Any] = {"kind": kind, "seed": seed}
    records = []
    for index, pair, T_true, static in _pairs(sequence):
        depth = np.asarray(pair.prev.depth)
        share = dynamic_fraction(
            np.asarray(pair.flow), depth, T_true, pair.prev.camera, pair.curr.camera
        )
        here = facts | {"index": index, "moving_share": share}
        for flow in flows:
            field = _flow(pair, flow)
            for name, tracker in trackers[flow].items():
                frames = [pair.prev, pair.curr]
                if name == ORACLE:
                    # the mask belongs to the previous frame, which is tracked one step before
                    frames = [replace(f, mask=m) for f, m in zip(frames, static, strict=True)]
                if index == 0:
                    paths[flow, name] = [tracker.track(frames[0]).T_world_cam]
                    judge.take()
                step = tracker.track(frames[1], field)
                paths[flow, name].append(step.T_world_cam)
                answer = _answer(step.motion, T_true, depth, pair, judge.take())
                records.append(here | {"flow": flow, "method": name} | answer)
        if options.noisy_stride and index % options.noisy_stride == 0:
            noisy = _with_noise(pair, [0x4E45, seed, index])
            for name in set(CELL_METHODS) & set(options.methods):
                motion = _estimate(noisy, name, judge)
                answer = _answer(motion, T_true, depth, pair, judge.take())
                records.append(here | {"flow": "true+noise", "method": name} | answer)
    rows = [
        facts | {"flow": flow, "method": name} | _trajectory_error(path, sequence)
        for (flow, name), path in paths.items()
    ]
    return Measured(records, rows, time.process_time() - started)


def _pairs(
    sequence: SyntheticSequence,
) -> Iterator[tuple[int, FramePair, np.ndarray, tuple[np.ndarray, np.ndarray]]]:
    """(index, pair with true flow, T_curr_prev, static masks of both frames) of every pair."""
    curr, still = sequence.frame(0), ~sequence.moving(0)
    for index in range(len(sequence) - 1):
        prev, before = curr, still
        curr, still = sequence.frame(index + 1), ~sequence.moving(index + 1)
        T_true = invert(sequence.poses[index + 1]) @ sequence.poses[index]
        flow = sequence.flow(index)[0]
        pair = FramePair(prev, curr, flow, flow_is_true=True)
        yield index, pair, T_true, (before, still)


def _flow(pair: FramePair, flow: str) -> FlowField:
    if flow == "true":
        return FlowField(pair.flow, source="true", is_true=True)
    return dis_flow()(pair.prev, pair.curr)


def _with_noise(pair: FramePair, seed: list[int]) -> FramePair:
    """The pair with the noise that the refinement assumes on flow and on both depths."""
    rng = np.random.default_rng(seed)
    flow = np.asarray(pair.flow)
    noise = NOISE_PX * rng.standard_normal(flow.shape, dtype=np.float32)
    frames = []
    for frame in (pair.prev, pair.curr):
        depth = np.asarray(frame.depth)
        factor = np.exp(NOISE_LOG_DEPTH * rng.standard_normal(depth.shape, dtype=np.float32))
        frames.append(replace(frame, depth=depth * factor))
    return FramePair(frames[0], frames[1], flow + noise)


def _estimate(pair: FramePair, method: str, judge: RecordedJudge) -> RelativePose:
    judge.take()
    return estimate(pair, method=method, judge=judge if method in JUDGED else None)


def _trajectory_error(path: list[np.ndarray], sequence: SyntheticSequence) -> dict[str, Any]:
    truth = Trajectory(sequence.timestamps, sequence.poses)
    error = ate(Trajectory(sequence.timestamps, np.stack(path)), truth, "se3")
    length = float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum())
    return {
        "ate_m": error.rmse,
        "path_m": length,
        "ate_share": None if error.rmse is None else error.rmse / length,
        "reason": error.reasons.get("rmse", ""),
    }


def run_cells(
    pairs: int,
    seed0: int,
    cells: tuple[str, ...] = tuple(SCENARIOS),
    size: tuple[int, int] = (436, 1024),
) -> list[dict[str, Any]]:
    """The hybrid and the refinement on the solver's cells: known noise, no pictures.

    Args:
        pairs: of each cell.
        seed0: first seed.
        cells: of :data:`hybridvo.synthetic.scenarios.SCENARIOS`.
        size: height and width, px.

    Raises:
        InputError: an unknown cell.
    """
    judge = RecordedJudge(shipped_judge())
    records = []
    for cell in cells:
        for seed in range(seed0, seed0 + pairs):
            pair, truth = make_pair(cell, seed, *size)
            for name in CELL_METHODS:
                motion = _estimate(pair, name, judge)
                answer = _answer(
                    motion, truth["T_curr_prev"], truth["depth_true"], pair, judge.take()
                )
                records.append(
                    {"kind": cell, "seed": seed, "flow": "cell", "method": name} | answer
                )
    return records
