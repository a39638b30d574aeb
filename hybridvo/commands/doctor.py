"""``hybridvo doctor``: what is installed here, which methods can run, what is wrong with data.

Of a sequence five questions are asked. What the data do not show is said to be unknown: an answer
is ``agrees``, ``differs`` or ``cannot_tell``, with a sentence and a value.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pandas as pd

from hybridvo.commands.compare import methods_to_run
from hybridvo.commands.run import is_dark
from hybridvo.data.lists import shown
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.estimation import estimate
from hybridvo.evaluation.pair_errors import true_motion
from hybridvo.files import versions
from hybridvo.flow import contradiction, dis_flow, file_flow
from hybridvo.geometry import ego_flow
from hybridvo.refinement.depth import depth_ratio, is_step
from hybridvo.results import RelativePose
from hybridvo.types import Frame, FramePair, depth_advice, typical_depth

MIN_PAIRS = 6
"""Fewer pairs give no usable standard error."""
SIGMAS = 4.0
"""Standard errors from which on a difference is reported."""
MIN_SCALE_ERROR = 0.2
"""Wrong units err by more, noisy ground truth over short motions by half of that."""
MIN_SHIFT_PX = 1.0
MIN_SHIFT_GAIN = 0.0015
"""Fall of the cost: registered sequences give up to 0.0008, shifted by 2 and 3 px over 0.0022."""
MAX_GREY_STEP = 0.15
"""Change of the logarithm of the mean brightness between neighbours that is called a step."""
MAX_CONTRADICTED = 0.2
"""Fraction of the pairs whose flow may contradict their images."""
REACH_PX = 4
"""Largest shift of the depth map that is tried."""
MIN_PIXELS, MAX_PIXELS = 100, 3000
"""Pixels at depth edges that a pair needs, and that are looked at."""

Answer = tuple[str, str, Any]
"""State, why, and a number or None."""
MEASURED = (
    "index",
    "dark",
    "depth",
    "grey",
    "contradiction",
    "scale",
    "depth_ratio",
    "shift_costs",
)
"""Of a pair; what could not be measured is absent."""


def doctor() -> dict[str, Any]:
    """What a bug report should hold, JSON-ready; methods that cannot run have a remedy."""
    import torch

    ready, absent = methods_to_run(("all",))
    return {
        "platform": platform.platform(),
        "packages": versions(),
        "cuda": [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())],
        "methods": {**dict.fromkeys(ready, ""), **absent},
    }


def diagnose(sequence: Sequence, *, pairs: int = 40) -> dict[str, Any]:
    """Look for systematic disagreement in a sequence; JSON-ready.

    At most ``pairs`` pairs of neighbouring frames are looked at, spread evenly. The true poses of
    the sequence serve for nothing but the scale of depth. ``ok``: nothing differs.
    """
    if pairs < 1 or len(sequence) < 2:
        raise InputError(
            f"{sequence.name}: expected at least two frames and one pair, got {len(sequence)} "
            f"frames and --pairs {pairs}."
        )
    measured, unreadable = [], []
    last = len(sequence) - 2
    for index in np.unique(np.linspace(0, last, min(pairs, last + 1)).round().astype(int)).tolist():
        try:
            prev, curr = sequence.frame(index), sequence.frame(index + 1)
        except (InputError, OSError) as error:
            unreadable.append(str(error))
            continue
        measured.append(_measure(sequence, prev, curr))
    table = pd.DataFrame(measured, columns=MEASURED).set_index("index")
    answers = {name: answer(table) for name, answer in QUESTIONS.items()}
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        "pairs": len(measured),
        "unreadable": list(dict.fromkeys(unreadable)),
        "findings": [
            {"name": name, "state": state, "message": message, "value": value}
            for name, (state, message, value) in answers.items()
        ],
        "ok": all(state != "differs" for state, _, _ in answers.values()),
    }


def _measure(sequence: Sequence, prev: Frame, curr: Frame) -> dict[str, Any]:
    """Measurements of one pair: median depth (m), ratio of the brightness, dark frames, ..."""
    pair: dict[str, Any] = {"index": prev.index, "dark": []}
    pair["depth"] = None if prev.depth is None else typical_depth(prev.depth)
    if prev.rgb is None or curr.rgb is None:
        return pair
    pair["dark"] = [frame.index for frame in (prev, curr) if is_dark(frame.rgb)]
    pair["grey"] = (float(curr.rgb.mean()) + 1.0) / (float(prev.rgb.mean()) + 1.0)
    given = file_flow(sequence, strict=False)(prev, curr) if sequence.has_flow else None
    if given is not None and given.flow is not None:
        on_file = FramePair(prev, curr, given.flow, given.variance, given.valid, "file")
        pair["contradiction"] = contradiction(on_file) or ""
    field = dis_flow()(prev, curr)
    if prev.depth is None or field.flow is None:
        return pair
    by_dis = FramePair(prev, curr, field.flow, field.variance, field.valid, "dis")
    motion = estimate(by_dis, method="refine")
    if not motion.usable:
        return pair
    true = true_motion(sequence, prev.index, curr.index)
    if true is not None and motion.translation_direction_valid:
        length = float(np.linalg.norm(true[:3, 3]))
        if length > 0.01:  # metres; along the true one: the noise of a length is always positive
            pair["scale"] = float(motion.T_curr_prev[:3, 3] @ true[:3, 3]) / length**2
    if not sequence.has_flow and motion.weights is not None:
        ego = ego_flow(prev.depth, motion.T_curr_prev, prev.camera, curr.camera)
        rigid = FramePair(prev, curr, ego.astype(np.float32), None, motion.weights > 0.5, "motion")
        pair["contradiction"] = contradiction(rigid) or ""
    pair["depth_ratio"] = depth_ratio(prev, curr, field.flow, motion.T_curr_prev)
    pair["shift_costs"] = _shift_costs(by_dis, motion)
    return pair


# -- where the depth map stands against its image -------------------------------------------------


def _shift_costs(pair: FramePair, motion: RelativePose) -> np.ndarray | None:
    """(9, 9) mean image cost, 0 to 1, of pixels at depth edges under shifts of the depth map."""
    prev, curr, weights = pair.prev, pair.curr, motion.weights
    if weights is None or weights.shape != prev.camera.shape or prev.depth is None:
        return None
    first, second = (
        cv2.GaussianBlur(cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
        for f in (prev, curr)
        if f.rgb is not None
    )
    rows, columns = _edge_pixels(first, prev.depth, weights)
    if len(rows) < MIN_PIXELS:
        return None
    R, t = motion.T_curr_prev[:3, :3], motion.T_curr_prev[:3, 3]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=1) @ np.linalg.inv(prev.camera.K).T

    def difference(down: int, right: int) -> np.ndarray:
        z = prev.depth[rows + down, columns + right]  # type: ignore[index]
        points = (z[:, None] * rays @ R.T + t) @ curr.camera.K.T
        place = (points[:, :2] / np.maximum(points[:, 2:], 1e-6)).astype(np.float32)
        there = cv2.remap(second, place[:, :1], place[:, 1:], cv2.INTER_LINEAR)[:, 0]
        return there - first[rows, columns]

    shifts = range(-REACH_PX, REACH_PX + 1)
    residuals = np.array([[difference(down, right) for right in shifts] for down in shifts])
    residuals -= np.median(residuals, axis=2, keepdims=True)  # a change of brightness
    scale = max(1.4826 * float(np.median(np.abs(residuals))), 1.0)
    return (residuals**2 / (residuals**2 + scale**2)).mean(axis=2)


def _edge_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of textured static pixels near edges of 5 % in depth."""
    valid = np.isfinite(depth) & (depth > 0)
    log = np.log(np.where(valid, depth, 1.0)).astype(np.float32)
    reach = np.ones((2 * REACH_PX + 1,) * 2, np.uint8)
    usable = cv2.dilate(log, reach) - cv2.erode(log, reach) > 0.05
    usable &= cv2.erode(valid.astype(np.uint8), reach) > 0
    usable &= cv2.blur(weights.astype(np.float32), (15, 15)) > 0.5
    inside = np.zeros_like(usable)
    inside[REACH_PX + 1 : -REACH_PX - 1, REACH_PX + 1 : -REACH_PX - 1] = True
    gradient = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    rows, columns = np.nonzero(usable & inside)
    if len(rows):
        strong = gradient[rows, columns] > max(float(np.median(gradient[rows, columns])), 16.0)
        rows, columns = rows[strong], columns[strong]
    step = max(1, len(rows) // MAX_PIXELS)
    return rows[::step], columns[::step]


def _minimum(cost: np.ndarray) -> np.ndarray:
    """(right, down) px of the minimum of a cost over shifts, between the pixels by parabolas."""
    row, column = np.unravel_index(np.argmin(cost), cost.shape)

    def vertex(values: np.ndarray, k: int) -> float:
        if not 0 < k < len(values) - 1:
            return k - REACH_PX
        before, here, after = values[k - 1 : k + 2]
        bend = before - 2 * here + after
        offset = np.clip(0.5 * (before - after) / bend, -0.5, 0.5) if bend > 0 else 0.0
        return k + float(offset) - REACH_PX

    return np.array([vertex(cost[row], int(column)), vertex(cost[:, column], int(row))])


# -- findings -----------------------------------------------------------------------------------


def _furthest(ratios: pd.Series) -> Any:
    """Frame whose ratio is furthest from one."""
    return np.log(ratios.clip(lower=1e-30)).abs().idxmax()


def _units(pairs: pd.DataFrame) -> Answer:
    depths, scales = pairs["depth"].dropna(), pairs["scale"].dropna()
    if depths.empty:
        return "cannot_tell", "no frame has valid depth", None
    median = float(depths.median())
    text, advice = f"median depth {median:.3g} m", depth_advice(median)
    if len(scales) < MIN_PAIRS:
        if advice:
            text += f", which cannot be metres; probable remedy: {advice}"
            return "differs", text, median
        # all depths and all translations times s project to the same pixels: no pair can tell
        text += f"; {len(scales)} pairs with a true motion on file, {MIN_PAIRS} needed"
        return "cannot_tell", text, median
    logs = np.log(scales.astype(float).clip(lower=1e-6))
    value = float(np.exp(logs.median()))
    deviation = 1.4826 * float((logs - logs.median()).abs().median())
    error = value * deviation * math.sqrt(math.pi / 2 / len(logs))
    text += f"; motions are {value:.4g} (+- {error:.2g}) times as long as the poses on file say"
    if abs(value - 1) <= max(MIN_SCALE_ERROR, SIGMAS * error):
        return "agrees", text, value
    remedy = f"divide by {value:.4g}" if value > 1 else f"multiply by {1 / value:.4g}"
    return "differs", f"{text}: depth: {advice or remedy}", value


def _depth_steps(pairs: pd.DataFrame) -> Answer:
    ratios = pairs["depth_ratio"].dropna().astype(float)
    if ratios.empty:
        return "cannot_tell", "no pair has a motion and depth in both frames", None
    steps, k = sum(map(is_step, ratios)), _furthest(ratios)
    text = (
        f"depth changes its scale in {steps} of {len(ratios)} pairs, most from frame {k} "
        f"to the next (times {ratios[k]:.3g})"
    )
    if steps:
        text += ": files of several units, or a scale of its own in every frame"
    return "differs" if steps else "agrees", text, float(ratios[k])


def _depth_against_colour(pairs: pd.DataFrame) -> Answer:
    costs = np.array(pairs["shift_costs"].dropna().tolist())
    n = len(costs)
    if n < MIN_PAIRS:
        return "cannot_tell", f"{n} pairs with textured depth edges, {MIN_PAIRS} needed", None
    total = costs.mean(axis=0)
    value = _minimum(total)
    left_out = np.array([_minimum((n * total - cost) / (n - 1)) for cost in costs])
    spread = float(np.sqrt((n - 1) * left_out.var(axis=0).sum()))  # jackknife
    gain = float(total[REACH_PX, REACH_PX] - total.min())
    is_shifted = float(np.linalg.norm(value)) > max(MIN_SHIFT_PX, SIGMAS * spread)
    if spread > MIN_SHIFT_PX or (is_shifted and gain <= MIN_SHIFT_GAIN):
        return "cannot_tell", "the images do not show whether depth is shifted", None
    text = (
        f"the depth map stands {value[0]:+.1f} px right, {value[1]:+.1f} px down "
        f"(+- {spread:.1f}, searched to {REACH_PX}) of the image"
    )
    if is_shifted:
        text += ": register depth to colour, or give the intrinsics of the colour camera"
    return "differs" if is_shifted else "agrees", text, value.tolist()


def _exposure(pairs: pd.DataFrame) -> Answer:
    greys = pairs["grey"].dropna().astype(float)
    if greys.empty:
        return "cannot_tell", "no pair has two images", None
    steps = int((np.log(greys).abs() > MAX_GREY_STEP).sum())
    dark = sorted(set(pairs["dark"].sum()))
    text = f"brightness changes by over 15 % in {steps} of {len(greys)} pairs"
    if steps:
        k = _furthest(greys)
        text += f", most from frame {k} to the next (times {greys[k]:.2f})"
    if dark:
        text += f"; {len(dark)} frames are dark: {shown(dark)}"
    return "differs" if steps or dark else "agrees", text, steps / len(greys)


def _images_against_flow(pairs: pd.DataFrame) -> Answer:
    reasons = pairs["contradiction"].dropna()
    if reasons.empty:
        return "cannot_tell", "no pair has images with a flow or a motion", None
    against = reasons[reasons != ""]
    share = len(against) / len(reasons)
    text = f"the flow contradicts the images in {len(against)} of {len(reasons)} pairs"
    if share <= MAX_CONTRADICTED:
        return "agrees", text, share
    return "differs", f"{text}; frame {against.index[0]}: {against.iloc[0]}", share


QUESTIONS: dict[str, Callable[[pd.DataFrame], Answer]] = {
    "depth units": _units,
    "depth from frame to frame": _depth_steps,
    "depth against colour": _depth_against_colour,
    "exposure": _exposure,
    "images against flow": _images_against_flow,
}
