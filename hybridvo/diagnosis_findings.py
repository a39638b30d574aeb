"""What the evidence of a sequence amounts to: one finding a question, with its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hybridvo.depth_steps import is_step
from hybridvo.refinement.registration import LAGS, OffsetCost
from hybridvo.refinement.registration import MAX_PX as LARGEST_PX
from hybridvo.refinement.self_calibration import PARAMETERS
from hybridvo.types import Camera

__all__ = ["Evidence", "findings"]

LEAST_PAIRS = 6
"""Fewer pairs give no standard error worth its name."""
SURE = 4.0
"""Standard errors from which on a difference is called one."""
LEAST_OFFSET_PX = 0.7
LEAST_OFFSET_GAIN = 0.02
"""As in the monitor of the polish: occlusion alone gives up to 0.7 px and 0.007."""
MOST_OFFSET_SE_PX = 1.0
LEAST_LAG = 0.2
"""Frames."""
LEAST_SHUTTER = 0.3
"""Frames from the first row to the last. Rendered global shutters give up to 0.2, and of a real
rolling shutter a third or so is seen: the pictures agree with each other on the rest."""
MOST_LAG_SE = 0.25
LEAST_MOTION_PX = 1.0
"""Motion of the pixels below which a delay cannot be seen."""
LEAST_INTRINSIC_PAIRS = 15
"""Neighbouring pairs see the same things: few of them are alike, and their spread too small."""
LEAST_CENTRE_PX = 0.2
MOST_CENTRE_SE_PX = 0.25
"""A principal point known worse than this says nothing of half a pixel."""
LEAST_FOCAL = 0.01
MOST_FOCAL_SE = 0.01
LEAST_STEP = 0.15
"""Change of the logarithm of the gain that is called a step of the exposure."""
LEAST_SCALE = 0.2
"""Wrong units err by more; truth of a few millimetres' noise by half of that over short motions."""
SHUTTER, CENTRE, FOCAL = "rolling shutter", "principal point", "focal length"
SCALES = (1000.0, 5000.0, 5.0, 256.0, 100.0, 10.0)
"""Factors between units that depth files are written in; with their inverses."""
DEPTHS_M = (0.1, 200.0)
"""Median depths that are usual."""


@dataclass
class Evidence:
    """What the pairs said; one entry a pair that could be used.

    Args:
        looked_at: pairs. unreadable: messages. reasons: of the polish, empty where it was taken.
        offsets: costs of shifts of the depth map. lags: (2, L) costs of its delays. motion_px: of
            the pixels that delays were looked at on. equations: of the intrinsics. gains: (index,
            gain). scales: length of a motion over the true one. depths: median, metres.
            depth_ratios: (index, ratio) of the depth of the next frame to what this one predicts.
            cameras: of the previous frames.
    """

    looked_at: int = 0
    unreadable: list[str] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)
    offsets: list[OffsetCost] = field(default_factory=list)
    lags: list[np.ndarray] = field(default_factory=list)
    motion_px: list[float] = field(default_factory=list)
    equations: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    gains: list[tuple[int, float]] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    depths: list[float] = field(default_factory=list)
    depth_ratios: list[tuple[int, float]] = field(default_factory=list)
    cameras: list[Camera] = field(default_factory=list)


def findings(evidence: Evidence) -> list[dict[str, Any]]:
    """Every finding, JSON-ready; see :func:`hybridvo.diagnosis.diagnose`."""
    registration = [_offset(evidence), _time_offset(evidence)]
    later: tuple[tuple[str, Callable[[Evidence], dict[str, Any]]], ...] = (
        (SHUTTER, _rolling_shutter),
        (CENTRE, _principal_point),
        (FOCAL, _focal_length),
    )
    apart = any(finding["state"] == "differs" for finding in registration)
    why = "depth and colour disagree, see above; mend that first"
    return [
        *registration,
        *(_open(name, why) if apart else look(evidence) for name, look in later),
        *(_depth_units(evidence), _depth_steps(evidence)),
        *(_exposure(evidence), _agreement(evidence)),
    ]


def _finding(
    name: str,
    state: str,
    message: str,
    value: Any = None,
    standard_error: Any = None,
    unit: str = "",
) -> dict[str, Any]:
    return {
        "name": name,
        "state": state,
        "value": value,
        "standard_error": standard_error,
        "unit": unit,
        "message": message,
    }


def _open(name: str, why: str) -> dict[str, Any]:
    return _finding(name, "not_observable", f"not observable from this sequence: {why}")


def _jackknife(estimate: Callable[[np.ndarray], np.ndarray], n: int) -> np.ndarray:
    """Standard error of ``estimate(indices of the pairs)``, by leaving out one pair at a time."""
    every = np.arange(n)
    left = np.array([estimate(np.delete(every, k)) for k in every])
    return np.sqrt((n - 1) * left.var(axis=0))


def _offset(evidence: Evidence) -> dict[str, Any]:
    name = "depth against colour, place"
    costs = evidence.offsets
    n = len(costs)
    if n < LEAST_PAIRS:
        return _open(name, f"{n} pairs with depth edges in textured places, {LEAST_PAIRS} needed")

    def total(chosen: np.ndarray) -> OffsetCost:
        return sum((costs[k] for k in chosen), OffsetCost.nothing())

    whole = total(np.arange(n))
    value = whole.offset_px
    error = _jackknife(lambda chosen: total(chosen).offset_px, n)
    size = float(np.linalg.norm(value))
    spread = float(np.linalg.norm(error))
    if spread > MOST_OFFSET_SE_PX:
        return _open(name, f"known to +- {spread:.1f} px only")
    differs = size > max(LEAST_OFFSET_PX, SURE * spread) and whole.gain > LEAST_OFFSET_GAIN
    where = f"{_signed(value[0])} px right, {_signed(value[1])} px down (+- {spread:.2f})"
    if differs:
        bound = "more than " if np.abs(value).max() >= LARGEST_PX else ""
        # the pixels that a shifted map covers are out of sight
        text = (
            f"the depth map stands {bound}{where} of the picture, or a little more: colour "
            f"and depth look unregistered; register depth to colour, or give the intrinsics of the "
            f"colour camera"
        )
    else:
        text = f"the depth map stands {where} of the picture"
    state = "differs" if differs else "agrees"
    return _finding(name, state, text, value.tolist(), error.tolist(), "px")


def _delay(evidence: Evidence, row: int) -> tuple[float, float, float]:
    """(delay in frames, standard error, fall of the cost per pixel) of one kind of delay."""
    curves = np.array([curve[row] for curve in evidence.lags])

    def vertex(chosen: np.ndarray) -> np.ndarray:
        mean = curves[chosen].mean(axis=0)
        around = np.abs(LAGS - LAGS[mean.argmin()]) <= 1.0
        bend, slope, _ = np.polyfit(LAGS[around], mean[around], 2)
        return np.array(-0.5 * slope / bend if bend > 0 else LAGS[mean.argmin()])

    n = len(curves)
    value = float(np.clip(vertex(np.arange(n)), LAGS[0], LAGS[-1]))
    return value, float(_jackknife(vertex, n)), float(-curves.mean(axis=0).min())


def _unseen_delay(evidence: Evidence) -> str:
    """Why a delay cannot be seen; empty where it can."""
    n = len(evidence.lags)
    if n < LEAST_PAIRS:
        return f"{n} pairs with depth edges in textured places, {LEAST_PAIRS} needed"
    moving = float(np.median(evidence.motion_px))
    if moving < LEAST_MOTION_PX:
        return f"pixels move by {moving:.2f} px a frame, {LEAST_MOTION_PX:g} needed"
    return ""


def _time_offset(evidence: Evidence) -> dict[str, Any]:
    name = "depth against colour, time"
    why = _unseen_delay(evidence)
    if why:
        return _open(name, why)
    value, error, gain = _delay(evidence, 0)
    if error > MOST_LAG_SE:
        return _open(name, f"known to +- {error:.1f} frames only")
    differs = abs(value) > max(LEAST_LAG, SURE * error) and gain > LEAST_OFFSET_GAIN
    text = f"depth is {_signed(value)} frames (+- {error:.2f}) behind colour"
    whole = sum(evidence.offsets, OffsetCost.nothing())
    if differs and whole.gain > gain:
        text += "; a constant shift of the depth map explains it better, see above"
        differs = False
    elif differs:
        text += ", or a little more: their stamps, or the way frames are paired, are off"
    return _finding(name, "differs" if differs else "agrees", text, value, error, "frames")


def _rolling_shutter(evidence: Evidence) -> dict[str, Any]:
    name = SHUTTER
    why = _unseen_delay(evidence)
    if why:
        return _open(name, why)
    value, error, _ = _delay(evidence, 1)
    if error > MOST_LAG_SE:
        return _open(name, f"known to +- {error:.1f} frames only")
    differs = abs(value) > max(LEAST_SHUTTER, SURE * error)
    text = f"the last row is {_signed(value)} frames (+- {error:.2f}) after the first, or more"
    if differs:
        text += ": rows look exposed one after the other while depth is not; drive more slowly"
    return _finding(name, "differs" if differs else "agrees", text, value, error, "frames")


def _too_few(evidence: Evidence) -> str:
    n = len(evidence.equations)
    return f"{n} pairs, {LEAST_INTRINSIC_PAIRS} with rotation and parallax needed"


def _intrinsics(evidence: Evidence) -> tuple[np.ndarray, np.ndarray] | None:
    """(estimate, standard errors) of the intrinsics, with the spread between the pairs."""
    if len(evidence.equations) < LEAST_INTRINSIC_PAIRS:
        return None
    H = np.array([equation[0] for equation in evidence.equations])
    g = np.array([equation[1] for equation in evidence.equations])
    total = H.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(total), 1e-30))
    matrix = total / np.outer(scale, scale)
    if np.linalg.eigvalsh(matrix)[0] < 1e-6:
        return None
    inverse = np.linalg.inv(matrix) / np.outer(scale, scale)
    value = inverse @ g.sum(axis=0)
    scores = g - H @ value
    n = len(g)
    covariance = n / (n - 1) * inverse @ (scores.T @ scores) @ inverse
    return value, np.sqrt(np.diag(covariance))


def _principal_point(evidence: Evidence) -> dict[str, Any]:
    name = CENTRE
    found = _intrinsics(evidence)
    if found is None:
        return _open(name, _too_few(evidence))
    value, error = (part[: len(PARAMETERS) - 1] for part in found)
    seen = error < MOST_CENTRE_SE_PX
    if not seen.any():
        return _open(name, f"known to +- {error.min():.2f} px only; rotate and move more")
    off = seen & (np.abs(value) > np.maximum(LEAST_CENTRE_PX, SURE * error))
    parts = [
        f"{axis} is {_signed(v)} px off (+- {e:.2f})" if s else f"{axis} is not observable"
        for axis, v, e, s in zip(("cx", "cy"), -value, error, seen, strict=True)
    ]
    text = ", ".join(parts)
    if off.any():
        text += f"; try {_tried(evidence, value, off)}"
        half = off & (np.abs(np.abs(value) - 0.5) < 0.25)
        if half.any():
            text += (
                ". Half a pixel: pixel (0, 0) is the centre of the top-left pixel here, and its "
                "corner in some calibrations, whose cx and cy are then 0.5 larger"
            )
    state = "differs" if off.any() else "agrees"
    return _finding(name, state, text, (-value).tolist(), error.tolist(), "px")


def _tried(evidence: Evidence, value: np.ndarray, off: np.ndarray) -> str:
    camera = evidence.cameras[-1]
    now = camera.cx, camera.cy
    return ", ".join(
        f"{axis} = {there + v:.2f} instead of {there:.2f}"
        for axis, there, v, o in zip(("cx", "cy"), now, value, off, strict=True)
        if o
    )


def _focal_length(evidence: Evidence) -> dict[str, Any]:
    name = FOCAL
    found = _intrinsics(evidence)
    if found is None:
        return _open(name, _too_few(evidence))
    value, error = -100 * found[0][-1], 100 * found[1][-1]
    if error > 100 * MOST_FOCAL_SE:
        return _open(name, f"known to +- {error:.1f} % only")
    differs = abs(value) > max(100 * LEAST_FOCAL, SURE * error)
    text = f"{_signed(value)} % off (+- {error:.2f})"
    if differs:
        text += ": was the picture resized or cropped without its intrinsics?"
    state = "differs" if differs else "agrees"
    return _finding(name, state, text, float(value), float(error), "%")


def _depth_units(evidence: Evidence) -> dict[str, Any]:
    name = "depth units"
    if not evidence.depths:
        return _open(name, "no frame has valid depth")
    median = float(np.median(evidence.depths))
    usual = DEPTHS_M[0] <= median <= DEPTHS_M[1]
    text = f"median depth {median:.3g} m"
    if len(evidence.scales) >= LEAST_PAIRS:
        logs = np.log(np.maximum(evidence.scales, 1e-6))
        value = float(np.exp(np.median(logs)))
        spread = 1.4826 * np.median(np.abs(logs - np.median(logs))) * math.sqrt(math.pi / 2)
        error = value * float(spread / math.sqrt(len(logs)))
        text += f"; motions are {value:.4g} (+- {error:.2g}) times as long as the poses on file say"
        if abs(value - 1) > max(LEAST_SCALE, SURE * error):
            text += f": depth {_unit_hint(value)}"
            return _finding(name, "differs", text, value, error, "ratio")
        return _finding(name, "agrees", text, value, error, "ratio")
    if not usual:
        wrong = [q for s in SCALES for q in (s, 1 / s) if 0.3 < median / q < 30]
        hint = f": depth {_unit_hint(wrong[0])}" if wrong else ""
        return _finding(name, "differs", f"{text}, not in metres?{hint}", median, None, "m")
    # all depths and all translations times s project to the same pixels: no pair can tell
    return _finding(
        name, "not_observable", f"{text}; not observable without true poses", median, None, "m"
    )


def _depth_steps(evidence: Evidence) -> dict[str, Any]:
    name = "depth from frame to frame"
    if not evidence.depth_ratios:
        return _open(name, "no pair has a motion and depth in both frames")
    steps = [pair for pair in evidence.depth_ratios if is_step(pair[1])]
    index, ratio = max(evidence.depth_ratios, key=lambda pair: abs(math.log(max(pair[1], 1e-30))))
    text = (
        f"depth changes its scale in {len(steps)} of {len(evidence.depth_ratios)} pairs, most from "
        f"frame {index} to the next (times {ratio:.3g})"
    )
    if not steps:
        return _finding(name, "agrees", text, ratio, None, "ratio")
    text += ": files of several units, or a scale of its own in every frame"
    return _finding(name, "differs", text, ratio, None, "ratio")


def _unit_hint(ratio: float) -> str:
    """``looks too large, divide it by 1000``: the nearest usual factor, or the ratio itself."""
    size, act, factor = (
        ("large", "divide", ratio) if ratio > 1 else ("small", "multiply", 1 / ratio)
    )
    usual = min(SCALES, key=lambda scale: abs(math.log(factor / scale)))
    if abs(math.log(factor / usual)) < math.log(1.2):
        factor = usual
    return f"looks too {size}, {act} it by {factor:.4g}"


def _exposure(evidence: Evidence) -> dict[str, Any]:
    name = "exposure"
    if not evidence.gains:
        return _open(name, "no pair of images could be compared")
    steps = [(i, g) for i, g in evidence.gains if abs(math.log(max(g, 1e-6))) > LEAST_STEP]
    share = len(steps) / len(evidence.gains)
    text = f"brightness changed by over 15 % in {len(steps)} of {len(evidence.gains)} pairs"
    if steps:
        index, gain = max(steps, key=lambda step: abs(math.log(max(step[1], 1e-6))))
        text += (
            f", most from frame {index} to the next (times {gain:.2f}); evened out by the polish"
        )
    return _finding(name, "differs" if steps else "agrees", text, share, None, "share of pairs")


def _agreement(evidence: Evidence) -> dict[str, Any]:
    name = "images and flow"
    asked = [reason for reason in evidence.reasons if reason != "no_images"]
    if not asked:
        return _open(name, "there are no images with depth")
    against = sum(
        reason in ("no_match", "outside_flow", "higher_cost", "not_finite") for reason in asked
    )
    share = against / len(asked)
    text = f"images speak against the flow's motion in {against} of {len(asked)} pairs"
    differs = share > 0.5 and len(asked) >= LEAST_PAIRS
    if differs:
        text += (
            ": rolling shutter, colour and depth of different times, or wrong intrinsics, if the "
            "other lines do not say"
        )
    return _finding(name, "differs" if differs else "agrees", text, share, None, "share of pairs")


def _signed(value: float) -> str:
    return f"{value:+.2f}" if abs(value) >= 0.005 else "0.00"
