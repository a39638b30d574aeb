"""``hybridvo doctor``: what is installed here, which methods can run, what is wrong with data."""

from __future__ import annotations

import platform
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.api import estimate
from hybridvo.calibration import DOUBTFUL_SPREAD
from hybridvo.commands.compare import methods_to_run
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.evaluation.scores import true_motion
from hybridvo.files import versions
from hybridvo.flow import contradiction, dis_flow, file_flow, with_flow
from hybridvo.odometry import warm_up
from hybridvo.refinement.covariance import direction_is_known
from hybridvo.refinement.depth import compare_depths
from hybridvo.types import Frame, FramePair, depth_advice, typical_depth

MIN_PAIRS = 6  # fewer do not decide the scale of depth
MAX_SCALE_ERROR = 0.2  # relative; noisy ground truth over short motions errs by half of that
MAX_CONTRADICTED = 0.2  # share of the pairs whose flow may contradict their images


def doctor(sequence: Sequence | None = None, pairs: int = 40) -> tuple[dict[str, Any], int]:
    """Find out what is wrong with a sequence, or what is installed here; returns an exit code too.

    At most ``pairs`` pairs of neighbours, spread evenly over the sequence, are looked at.
    """
    if sequence is not None:
        found = diagnose(sequence, pairs)
        return found, 0 if found["ok"] else 1
    import torch

    warm_up()  # compiles the kernels, so that no later run has to
    ready, absent = methods_to_run(("all",))
    return {
        "platform": platform.platform(),
        "packages": versions(),
        "cuda": [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())],
        "methods": {**dict.fromkeys(ready, ""), **absent},
    }, 0


def diagnose(sequence: Sequence, pairs: int = 40) -> dict[str, Any]:
    """Look for disagreement between depth, poses, images and flow that runs through a sequence."""
    last = len(sequence) - 2
    if pairs < 1 or last < 0:
        got = f"{len(sequence)} frames and --pairs {pairs}"
        raise InputError(f"{sequence.name}: expected two frames and one pair, got {got}.")
    rows, unreadable = {}, []
    for index in np.unique(np.linspace(0, last, min(pairs, last + 1)).round().astype(int)).tolist():
        try:
            rows[index] = _measure(sequence, sequence.frame(index), sequence.frame(index + 1))
        except (InputError, OSError) as error:
            unreadable.append(str(error))
    columns = ["depth", "length", "depth_ratio", "contradiction"]
    table = pd.DataFrame(list(rows.values()), index=list(rows), columns=columns)
    answers = {name: question(table) for name, question in QUESTIONS.items()}
    states = {None: "cannot_tell", True: "differs", False: "agrees"}
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        "pairs": len(rows),
        "unreadable": list(dict.fromkeys(unreadable)),
        "findings": [
            {"name": name, "state": states[differs], "message": message}
            for name, (differs, message) in answers.items()
        ],
        "ok": not any(differs for differs, _ in answers.values()),
    }


def _measure(sequence: Sequence, prev: Frame, curr: Frame) -> dict[str, Any]:
    """What could be measured of one pair: a row of the table that the questions look at."""
    bare = FramePair(prev, curr, None)
    pair: dict[str, Any] = {"depth": None if prev.depth is None else typical_depth(prev.depth)}
    if prev.rgb is None or curr.rgb is None:
        return pair
    if sequence.has_flow:
        on_file = with_flow(bare, file_flow(sequence, strict=False))
        pair["contradiction"] = None if on_file.flow is None else contradiction(on_file) or ""
    by_dis = with_flow(bare, dis_flow())
    motion = estimate(by_dis, method="refine")
    if not motion.usable:
        return pair
    true = true_motion(sequence, prev.index, curr.index)
    if true is not None and direction_is_known(motion.T_curr_prev, motion.covariance):
        length = float(np.linalg.norm(true[:3, 3]))
        if length > 0.01:  # m; its part along the true one, for noise makes every length larger
            pair["length"] = float(motion.T_curr_prev[:3, 3] @ true[:3, 3]) / length**2
    depths = compare_depths(by_dis, motion.T_curr_prev, motion.weights)
    pair["depth_ratio"] = None if depths is None else depths.ratio
    return pair


# -- questions to the pairs: each returns whether they differ (None: unknown), and why -------------


def _units(table: pd.DataFrame) -> tuple[bool | None, str]:
    depths, scales = table["depth"].dropna().astype(float), table["length"].dropna().astype(float)
    if depths.empty:
        return None, "no frame has valid depth"
    text, advice = f"median depth {depths.median():.3g} m", depth_advice(float(depths.median()))
    if len(scales) < MIN_PAIRS:
        if advice:
            return True, f"{text}, which cannot be metres; probable remedy: {advice}"
        # all depths and all translations times s project to the same pixels: no pair can tell
        return None, f"{text}; {len(scales)} pairs with a true motion, {MIN_PAIRS} needed"
    low, value, high = scales.quantile([0.25, 0.5, 0.75]).tolist()
    text += f"; motions are {value:.4g} times as long as the poses on file say"
    if abs(value - 1) <= MAX_SCALE_ERROR or low < 1 < high:
        return False, text
    remedy = f"divide by {value:.4g}" if value > 1 else f"multiply by {1 / value:.4g}"
    return True, f"{text}: depth: {advice or remedy}"


def _depth_steps(table: pd.DataFrame) -> tuple[bool | None, str]:
    ratios = table["depth_ratio"].dropna().astype(float)
    if ratios.empty:
        return None, "no pair has a motion and depth in both frames"
    sizes = np.log(ratios.clip(lower=1e-30)).abs()
    steps, k = int((sizes > DOUBTFUL_SPREAD).sum()), sizes.idxmax()
    text = f"depth changes its scale in {steps} of {len(ratios)} pairs, most from frame {k} "
    text += f"to the next (times {ratios[k]:.3g})"
    cause = ": files of several units, or a scale of its own in every frame"
    return steps > 0, text + cause * (steps > 0)


def _images_against_flow(table: pd.DataFrame) -> tuple[bool | None, str]:
    known = table["contradiction"].dropna()
    if known.empty:
        return None, "no pair has images and a flow on file"
    against = known[known != ""]
    text = f"the flow contradicts the images in {len(against)} of {len(known)} pairs"
    if len(against) <= MAX_CONTRADICTED * len(known):
        return False, text
    return True, f"{text}; frame {against.index[0]}: {against.iloc[0]}"


QUESTIONS = {
    "depth units": _units,
    "depth from frame to frame": _depth_steps,
    "images against flow": _images_against_flow,
}
