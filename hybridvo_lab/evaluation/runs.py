"""What ``hybridvo run`` says of a path whose truth is known: errors of steps and of the whole."""

from __future__ import annotations

from typing import Any

from hybridvo.core.results import Step
from hybridvo.core.trajectory import Trajectory
from hybridvo.core.types import Frame
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.truth import true_motion
from hybridvo_lab.evaluation.belief import normalised_error
from hybridvo_lab.evaluation.metrics import evaluate
from hybridvo_lab.evaluation.scores import pair_scores, pair_table, step_errors
from hybridvo_lab.visualization.trajectory import plot_trajectory

draw = plot_trajectory


def errors_of_step(
    sequence: Sequence, prev: Frame | None, step: Step
) -> dict[str, float | None]:
    """Compute the errors of a step.

    Args:
        sequence: The sequence, which may have true poses.
        prev: The frame from which the motion of the step starts; None of the first step.
        step: The step.

    Returns:
        Those of :func:`step_errors`, and ``nees``, the squared error in units of the covariance.
        None where the truth is not known.
    """
    errors = step_errors(sequence, prev, step.index, step.T_curr_prev)
    T_gt = None if prev is None else true_motion(sequence, prev.index, step.index)
    nees = None
    if T_gt is not None and step.usable:
        nees = normalised_error(step.T_curr_prev, T_gt, step.covariance)
    return errors | {"nees": nees}


def errors_of_run(
    trajectory: Trajectory,
    truth: Trajectory,
    steps: list[dict[str, Any]],
    alignment: Any,
) -> dict[str, Any]:
    """Compute the errors of a path and of its motions.

    Args:
        trajectory: The path.
        truth: The true one.
        steps: A row of each step, with its errors; the first one has no motion.
        alignment: Of the absolute error.

    Returns:
        The content of ``metrics.json``, but for what a run says of itself.
    """
    path_errors = evaluate(trajectory, truth, alignment=alignment)
    motions = [{**row, "ms": row["motion_ms"]} for row in steps[1:]]
    motion_errors = pair_scores(pair_table(motions))
    reasons = path_errors["reasons"] | motion_errors["reasons"]
    return path_errors | motion_errors | {"reasons": reasons}
