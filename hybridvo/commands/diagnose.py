"""``hybridvo doctor DIR``: what the frames of a sequence say about their own consistency.

Five questions: units of depth, scale of depth from frame to frame, depth against colour, exposure,
and images against flow. A question that the frames cannot answer is reported as such.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from hybridvo.commands.inputs import is_dark
from hybridvo.data.lists import shown
from hybridvo.data.sequence import Sequence
from hybridvo.errors import InputError
from hybridvo.estimation import estimate
from hybridvo.flow import contradiction, dis_flow, file_flow
from hybridvo.geometry import ego_flow, invert
from hybridvo.refinement.depth import depth_ratio, is_step
from hybridvo.results import RelativePose
from hybridvo.types import Frame, FramePair
from hybridvo.units import depth_advice, typical_depth

PAIRS = 40
MIN_PAIRS = 6
"""Fewer pairs give no usable standard error."""
SIGMAS = 4.0
"""Standard errors from which on a difference is reported."""
MIN_SCALE_ERROR = 0.2
"""Wrong units err by more; ground truth with noise of millimetres by half of that over short
motions."""
MIN_MOTION_M = 0.01
"""Translation of a pair, metres, from which on its length is compared with the ground truth."""
MIN_SHIFT_PX = 1.0
MIN_SHIFT_GAIN = 0.0015
"""Shift and fall of the cost from which on depth is reported as shifted. Five registered sequences,
rendered and real, give up to 0.9 px and 0.0008; shifted by 2 and 3 px 0.0022 to 0.02."""
MAX_SHIFT_SE_PX = 1.0
MAX_SHIFT_PX = 4
"""Largest shift of the depth map that is tried, px."""
EDGE = 0.05
"""Change of log depth within that reach that makes a depth edge."""
EDGE_PIXELS = 3000
MIN_EDGE_PIXELS = 100
STATIC_BLUR_PX = 15
MAX_GREY_STEP = 0.15
"""Change of the logarithm of the mean brightness between neighbours that is called a step."""
MAX_CONTRADICTED = 0.2
"""Fraction of the pairs whose flow may contradict their images."""


@dataclass
class Evidence:
    """Measurements of the pairs; one entry a pair that could be used.

    Args:
        pairs: looked at. unreadable: messages. depths: medians, metres. scales: estimated
            translation over the true one. depth_ratios: (index, depth of the next frame over the
            predicted one). shift_costs: (9, 9) costs of shifts of the depth map. greys: (index,
            ratio of the mean brightness). dark: indices of dark frames. contradictions: (index,
            sentence or None) of the flow files, or of the flow of the estimated motion.
    """

    pairs: int = 0
    unreadable: list[str] = field(default_factory=list)
    depths: list[float] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    depth_ratios: list[tuple[int, float]] = field(default_factory=list)
    shift_costs: list[np.ndarray] = field(default_factory=list)
    greys: list[tuple[int, float]] = field(default_factory=list)
    dark: list[int] = field(default_factory=list)
    contradictions: list[tuple[int, str | None]] = field(default_factory=list)


def diagnose(sequence: Sequence, *, pairs: int = PAIRS) -> dict[str, Any]:
    """Look for systematic disagreement in a sequence.

    Args:
        sequence: an open one. Its true poses serve for nothing but the scale of depth.
        pairs: most pairs of neighbouring frames looked at, spread evenly.

    Returns:
        JSON-ready: ``sequence``, ``frames``, ``pairs``, ``unreadable`` (messages), ``findings`` and
        ``ok`` (nothing differs). A finding has ``name``, ``state`` (``agrees``, ``differs`` or
        ``cannot_tell``), ``value``, ``standard_error``, ``unit`` and ``message``.

    Raises:
        InputError: fewer than two frames, or ``pairs`` below 1.
    """
    if pairs < 1 or len(sequence) < 2:
        raise InputError(
            f"{sequence.name}: expected at least two frames and one pair, got {len(sequence)} "
            f"frames and --pairs {pairs}."
        )
    evidence = Evidence()
    last = len(sequence) - 1
    kept: tuple[int, Frame] | None = None
    for index in np.unique(np.linspace(0, last - 1, min(pairs, last)).round().astype(int)).tolist():
        try:
            prev = kept[1] if kept and kept[0] == index else sequence.frame(index)
            curr = sequence.frame(index + 1)
        except (InputError, OSError) as error:
            evidence.unreadable.append(str(error))
            kept = None
            continue
        kept = index + 1, curr
        _look_at(evidence, sequence, prev, curr)
    found = [
        {"name": name, **dataclasses.asdict(answer(evidence))} for name, answer in QUESTIONS.items()
    ]
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        "pairs": evidence.pairs,
        "unreadable": evidence.unreadable,
        "findings": found,
        "ok": all(finding["state"] != "differs" for finding in found),
    }


def diagnosis_text(report: Mapping[str, Any]) -> str:
    """The report for people."""
    signs = {"agrees": "ok          ", "differs": "DIFFERS     ", "cannot_tell": "cannot tell "}
    lines = [f"{report['sequence']}: {report['frames']} frames, {report['pairs']} pairs looked at"]
    lines += [f"{signs[f['state']]}{f['name']}: {f['message']}" for f in report["findings"]]
    lines += [f"unreadable  {message}" for message in report["unreadable"][:5]]
    unanswered = sum(finding["state"] == "cannot_tell" for finding in report["findings"])
    end = "nothing differs" if report["ok"] else "something differs: see above"
    if unanswered:
        end += f"; {unanswered} of {len(report['findings'])} questions could not be answered"
    lines.append(end)
    return "\n".join(lines)


# -- looking ------------------------------------------------------------------------------------


def _look_at(evidence: Evidence, sequence: Sequence, prev: Frame, curr: Frame) -> None:
    """Add the measurements of one pair."""
    evidence.pairs += 1
    index = prev.index
    if prev.depth is not None and (median := typical_depth(prev.depth)) is not None:
        evidence.depths.append(median)
    if prev.rgb is None or curr.rgb is None:
        return
    evidence.dark += [f.index for f in (prev, curr) if is_dark(f.rgb)]
    grey = float(prev.rgb.mean()), float(curr.rgb.mean())
    evidence.greys.append((index, (grey[1] + 1.0) / (grey[0] + 1.0)))
    if sequence.has_flow:
        given = file_flow(sequence)(prev, curr)
        if given.flow is not None:
            pair = FramePair(prev, curr, given.flow, given.variance, given.valid, "file")
            evidence.contradictions.append((index, contradiction(pair)))
    field = dis_flow()(prev, curr)
    if prev.depth is None or field.flow is None:
        return
    pair = FramePair(prev, curr, field.flow, field.variance, field.valid, "dis")
    motion = estimate(pair, method="refine")
    if motion.status.state.value == "failed":
        return
    ratio = depth_ratio(prev, curr, field.flow, motion.T_curr_prev)
    if ratio is not None:
        evidence.depth_ratios.append((index, ratio))
    _compare_scale(evidence, sequence, index, motion)
    if not sequence.has_flow and motion.weights is not None:
        ego = ego_flow(prev.depth, motion.T_curr_prev, prev.camera, curr.camera)
        rigid = FramePair(prev, curr, ego.astype(np.float32), None, motion.weights > 0.5, "motion")
        evidence.contradictions.append((index, contradiction(rigid)))
    costs = shift_costs(pair, motion)
    if costs is not None:
        evidence.shift_costs.append(costs)


def _compare_scale(
    evidence: Evidence, sequence: Sequence, index: int, motion: RelativePose
) -> None:
    """Length of the motion over that of the true poses, where both have one."""
    if sequence.poses is None or not motion.translation_direction_valid:
        return
    true = invert(sequence.poses[index + 1]) @ sequence.poses[index]
    length = float(np.linalg.norm(true[:3, 3]))
    if np.isfinite(length) and length > MIN_MOTION_M:
        # along the true one: the noise of a length is always positive
        evidence.scales.append(float(motion.T_curr_prev[:3, 3] @ true[:3, 3]) / length**2)


def shift_costs(pair: FramePair, motion: RelativePose) -> np.ndarray | None:
    """(9, 9) image cost of the pixels at depth edges under shifts of the previous depth map.

    A depth map that is shifted against its image gives pixels at the edges of near things the depth
    of what lies beside them, which the motion moves to the wrong place.

    Args:
        pair: both frames with images, the previous one with depth.
        motion: of the pair, with weights of the full image.

    Returns:
        Mean robust cost, 0 to 1 a pixel, for shifts of -4 to 4 px down (rows) and right (columns);
        None where there are too few edges.
    """
    prev, curr, weights = pair.prev, pair.curr, motion.weights
    if weights is None or weights.shape != prev.camera.shape or prev.depth is None:
        return None
    first, second = (
        cv2.GaussianBlur(cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
        for f in (prev, curr)
        if f.rgb is not None
    )
    rows, columns = _edge_pixels(first, prev.depth, weights)
    if len(rows) < MIN_EDGE_PIXELS:
        return None
    R, t = motion.T_curr_prev[:3, :3], motion.T_curr_prev[:3, 3]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=1) @ np.linalg.inv(prev.camera.K).T

    def difference(down: int, right: int) -> np.ndarray:
        z = prev.depth[rows + down, columns + right]  # type: ignore[index]
        points = (z[:, None] * rays @ R.T + t) @ curr.camera.K.T
        place = (points[:, :2] / np.maximum(points[:, 2:], 1e-6)).astype(np.float32)
        there = cv2.remap(second, place[:, :1], place[:, 1:], cv2.INTER_LINEAR)[:, 0]
        return there - first[rows, columns]

    shifts = range(-MAX_SHIFT_PX, MAX_SHIFT_PX + 1)
    residuals = np.array([[difference(down, right) for right in shifts] for down in shifts])
    offsets = np.median(residuals, axis=2, keepdims=True)  # a change of brightness
    scale = max(1.4826 * float(np.median(np.abs(residuals - offsets))), 1.0)
    squared = (residuals - offsets) ** 2
    return (squared / (squared + scale**2)).mean(axis=2)


def _edge_pixels(
    grey: np.ndarray, depth: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of textured static pixels near depth edges."""
    valid = np.isfinite(depth) & (depth > 0)
    log = np.log(np.where(valid, depth, 1.0)).astype(np.float32)
    reach = np.ones((2 * MAX_SHIFT_PX + 1,) * 2, np.uint8)
    usable = cv2.dilate(log, reach) - cv2.erode(log, reach) > EDGE
    usable &= cv2.erode(valid.astype(np.uint8), reach) > 0
    usable &= cv2.blur(weights.astype(np.float32), (STATIC_BLUR_PX,) * 2) > 0.5
    border = MAX_SHIFT_PX + 1
    usable[:border] = usable[-border:] = False
    usable[:, :border] = usable[:, -border:] = False
    gradient = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    rows, columns = np.nonzero(usable)
    if len(rows):
        strong = gradient[rows, columns] > max(float(np.median(gradient[rows, columns])), 16.0)
        rows, columns = rows[strong], columns[strong]
    step = max(1, len(rows) // EDGE_PIXELS)
    return rows[::step], columns[::step]


# -- findings -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """Answer to a question: ``agrees``, ``differs`` or ``cannot_tell``, and why."""

    state: str
    message: str
    value: Any = None
    standard_error: Any = None
    unit: str = ""


def _units(evidence: Evidence) -> Finding:
    if not evidence.depths:
        return Finding("cannot_tell", "no frame has valid depth")
    median = float(np.median(evidence.depths))
    text, advice = f"median depth {median:.3g} m", depth_advice(median)
    if len(evidence.scales) < MIN_PAIRS:
        if advice:
            text += f", which cannot be metres; probable remedy: {advice}"
            return Finding("differs", text, median, unit="m")
        # all depths and all translations times s project to the same pixels: no pair can tell
        text += "; no image knows its scale without true poses"
        return Finding("cannot_tell", text, median, unit="m")
    logs = np.log(np.maximum(evidence.scales, 1e-6))
    value = float(np.exp(np.median(logs)))
    deviation = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
    error = value * deviation * math.sqrt(math.pi / 2 / len(logs))
    text += f"; motions are {value:.4g} (+- {error:.2g}) times as long as the poses on file say"
    if abs(value - 1) <= max(MIN_SCALE_ERROR, SIGMAS * error):
        return Finding("agrees", text, value, error, "ratio")
    remedy = f"divide by {value:.4g}" if value > 1 else f"multiply by {1 / value:.4g}"
    return Finding("differs", f"{text}: depth: {advice or remedy}", value, error, "ratio")


def _depth_steps(evidence: Evidence) -> Finding:
    ratios = evidence.depth_ratios
    if not ratios:
        return Finding("cannot_tell", "no pair has a motion and depth in both frames")
    steps = sum(is_step(ratio) for _, ratio in ratios)
    index, ratio = max(ratios, key=lambda pair: abs(math.log(max(pair[1], 1e-30))))
    text = (
        f"depth changes its scale in {steps} of {len(ratios)} pairs, most from frame {index} to "
        f"the next (times {ratio:.3g})"
    )
    if steps:
        text += ": files of several units, or a scale of its own in every frame"
    return Finding("differs" if steps else "agrees", text, ratio, unit="ratio")


def _depth_against_colour(evidence: Evidence) -> Finding:
    costs = np.array(evidence.shift_costs)
    n = len(costs)
    if n < MIN_PAIRS:
        text = f"{n} pairs with depth edges in textured places, {MIN_PAIRS} needed"
        return Finding("cannot_tell", text)
    total = costs.mean(axis=0)
    value = _minimum(total)
    left_out = np.array([_minimum((n * total - cost) / (n - 1)) for cost in costs])
    error = np.sqrt((n - 1) * left_out.var(axis=0))  # jackknife
    size, spread = float(np.linalg.norm(value)), float(np.linalg.norm(error))
    gain = float(total[MAX_SHIFT_PX, MAX_SHIFT_PX] - total.min())
    text = (
        f"the depth map stands {value[0]:+.1f} px right, {value[1]:+.1f} px down "
        f"(+- {spread:.1f}, searched to {MAX_SHIFT_PX}) of the image"
    )
    state, shifted = "agrees", size > max(MIN_SHIFT_PX, SIGMAS * spread)
    if spread > MAX_SHIFT_SE_PX or (shifted and gain <= MIN_SHIFT_GAIN):
        state = "cannot_tell"
        text = "the images at depth edges do not show whether depth is shifted"
    elif shifted:
        state = "differs"
        text += (
            ": colour and depth look unregistered; register depth to colour, or give the "
            "intrinsics of the colour camera"
        )
    return Finding(state, text, value.tolist(), error.tolist(), "px")


def _minimum(cost: np.ndarray) -> np.ndarray:
    """(right, down) px of the minimum of a cost over shifts, between the pixels by parabolas."""
    row, column = np.unravel_index(np.argmin(cost), cost.shape)

    def vertex(values: np.ndarray, k: int) -> float:
        if not 0 < k < len(values) - 1:
            return 0.0
        before, here, after = values[k - 1 : k + 2]
        bend = before - 2 * here + after
        return float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5)) if bend > 0 else 0.0

    right = column + vertex(cost[row], int(column)) - MAX_SHIFT_PX
    down = row + vertex(cost[:, column], int(row)) - MAX_SHIFT_PX
    # the depth of a pixel is found at x + shift: so far it stands from its image
    return np.array([right, down])


def _exposure(evidence: Evidence) -> Finding:
    if not evidence.greys:
        return Finding("cannot_tell", "no pair has two images")
    steps = [pair for pair in evidence.greys if abs(math.log(pair[1])) > MAX_GREY_STEP]
    dark = sorted(set(evidence.dark))
    text = f"brightness changes by over 15 % in {len(steps)} of {len(evidence.greys)} pairs"
    if steps:
        index, ratio = max(steps, key=lambda step: abs(math.log(step[1])))
        text += f", most from frame {index} to the next (times {ratio:.2f})"
    if dark:
        text += f"; {len(dark)} frames are dark: {shown(dark)}"
    share = len(steps) / len(evidence.greys)
    return Finding("differs" if steps or dark else "agrees", text, share, unit="fraction of pairs")


def _images_against_flow(evidence: Evidence) -> Finding:
    n = len(evidence.contradictions)
    if not n:
        return Finding("cannot_tell", "no pair has images with a flow or a motion")
    against = [(index, why) for index, why in evidence.contradictions if why is not None]
    share = len(against) / n
    text = f"the flow contradicts the images in {len(against)} of {n} pairs"
    if share <= MAX_CONTRADICTED:
        return Finding("agrees", text, share, unit="fraction of pairs")
    index, why = against[0]
    return Finding("differs", f"{text}; frame {index}: {why}", share, unit="fraction of pairs")


QUESTIONS: dict[str, Callable[[Evidence], Finding]] = {
    "depth units": _units,
    "depth from frame to frame": _depth_steps,
    "depth against colour": _depth_against_colour,
    "exposure": _exposure,
    "images against flow": _images_against_flow,
}
