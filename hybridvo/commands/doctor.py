"""``hybridvo doctor``: what is installed here, which methods can run, what is wrong with data."""

from __future__ import annotations

import platform
from typing import Any

import numpy as np
import pandas as pd

from hybridvo.api import estimate
from hybridvo.calibration import (
    DOUBTFUL_SPREAD,
    EMPTY_DEPTH,
    LATE,
    MIN_FOCUS,
    MIN_TEXTURE,
    MIN_VALID_DEPTH,
    REGISTRATION,
)
from hybridvo.commands.compare import methods_to_run
from hybridvo.commands.inspection import (
    REACH,
    edge_agreement,
    texture_and_focus,
    valid_share,
)
from hybridvo.data.sequence import Sequence
from hybridvo.depth_units import depth_unit_fix, typical_depth
from hybridvo.errors import InputError
from hybridvo.evaluation.scores import true_motion
from hybridvo.files import versions
from hybridvo.flow import contradiction, dis_flow, file_flow, with_flow
from hybridvo.odometry import warm_up
from hybridvo.refinement.covariance import direction_is_known
from hybridvo.refinement.depth import compare_depths
from hybridvo.types import Frame, FramePair

MIN_PAIRS = 6  # fewer do not decide the scale of depth
# relative; noisy ground truth over short motions errs by half of that
MAX_SCALE_ERROR = 0.2
MAX_CONTRADICTED = 0.2  # share of the pairs whose flow may contradict their images


def doctor(
    sequence: Sequence | None = None, pairs: int = 40
) -> tuple[dict[str, Any], int]:
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
        "cuda": [
            torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())
        ],
        "methods": {**dict.fromkeys(ready, ""), **absent},
    }, 0


def diagnose(sequence: Sequence, pairs: int = 40) -> dict[str, Any]:
    """Look for disagreement between depth, poses, images and flow that runs through a sequence."""
    last = len(sequence) - 2
    if pairs < 1 or last < 0:
        got = f"{len(sequence)} frames and --pairs {pairs}"
        raise InputError(
            f"{sequence.name}: expected two frames and one pair, got {got}."
        )
    rows = {}
    unreadable = []
    for index in np.unique(
        np.linspace(0, last, min(pairs, last + 1)).round().astype(int)
    ).tolist():
        try:
            rows[index] = _measure(
                sequence, sequence.frame(index), sequence.frame(index + 1)
            )
        except (InputError, OSError) as error:
            unreadable.append(str(error))
    columns = ["depth", "length", "depth_ratio", "contradiction"]
    columns += ["valid", "texture", "focus", "edges"]
    table = pd.DataFrame(list(rows.values()), index=list(rows), columns=columns)
    answers = {name: question(table) for name, question in QUESTIONS.items()}
    answers["time stamps"] = _stamps(sequence.timestamps)
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
        "not_checked": NOT_CHECKED,
        "ok": not any(differs for differs, _ in answers.values()),
    }


def _measure(sequence: Sequence, prev: Frame, curr: Frame) -> dict[str, Any]:
    """What could be measured of one pair: a row of the table that the questions look at."""
    bare = FramePair(prev, curr, None)
    pair: dict[str, Any] = {}
    if prev.depth is not None:
        pair |= {
            "depth": typical_depth(prev.depth),
            "valid": valid_share(prev.depth),
        }
    if prev.rgb is not None:
        pair["texture"], pair["focus"] = texture_and_focus(prev.rgb)
    if prev.rgb is not None and prev.depth is not None:
        pair["edges"] = edge_agreement(prev.rgb, prev.depth)
    if prev.rgb is None or curr.rgb is None:
        return pair
    if sequence.has_flow:
        on_file = with_flow(bare, file_flow(sequence, strict=False))
        pair["contradiction"] = (
            None if on_file.flow is None else contradiction(on_file) or ""
        )
    by_dis = with_flow(bare, dis_flow())
    motion = estimate(by_dis, method="classical")
    if not motion.usable:
        return pair
    true = true_motion(sequence, prev.index, curr.index)
    if true is not None and direction_is_known(
        motion.T_curr_prev, motion.covariance
    ):
        length = float(np.linalg.norm(true[:3, 3]))
        # m; its part along the true one, for noise makes every length larger
        if length > 0.01:
            pair["length"] = (
                float(motion.T_curr_prev[:3, 3] @ true[:3, 3]) / length**2
            )
    depths = compare_depths(by_dis, motion.T_curr_prev, motion.weights)
    pair["depth_ratio"] = None if depths is None else depths.ratio
    return pair


# -- questions to the pairs: each returns whether they differ (None: unknown), and why -------------


def _units(table: pd.DataFrame) -> tuple[bool | None, str]:
    depths = table["depth"].dropna().astype(float)
    scales = table["length"].dropna().astype(float)
    if depths.empty:
        return None, "no frame has valid depth"
    text = f"median depth {depths.median():.3g} m"
    advice = depth_unit_fix(float(depths.median()))
    if len(scales) < MIN_PAIRS:
        if advice:
            return (
                True,
                f"{text}, which cannot be metres; probable remedy: {advice}",
            )
        # all depths and all translations times s project to the same pixels: no pair can tell
        why = f"true motions (poses.txt) beyond 1 cm: {len(scales)} pairs, {MIN_PAIRS} needed"
        return (
            None,
            f"{text}, as a camera sees, but exact or not only poses can tell; {why}",
        )
    low, value, high = scales.quantile([0.25, 0.5, 0.75]).tolist()
    text += f"; motions are {value:.4g} times as long as the poses on file say"
    if abs(value - 1) <= MAX_SCALE_ERROR or low < 1 < high:
        return False, text
    remedy = (
        f"divide by {value:.4g}" if value > 1 else f"multiply by {1 / value:.4g}"
    )
    return True, f"{text}: depth: {advice or remedy}"


def _depth_steps(table: pd.DataFrame) -> tuple[bool | None, str]:
    ratios = table["depth_ratio"].dropna().astype(float)
    if ratios.empty:
        return None, "no pair has a motion and depth in both frames"
    sizes = np.log(ratios.clip(lower=1e-30)).abs()
    steps = int((sizes > DOUBTFUL_SPREAD).sum())
    k = sizes.idxmax()
    text = f"depth changes its scale in {steps} of {len(ratios)} pairs, most from frame {k} "
    text += f"to the next (times {ratios[k]:.3g})"
    cause = ": files of several units, or a scale of its own in every frame"
    return steps > 0, text + cause * (steps > 0)


def _images_against_flow(table: pd.DataFrame) -> tuple[bool | None, str]:
    known = table["contradiction"].dropna()
    if known.empty:
        return None, "no pair has images and a flow on file"
    against = known[known != ""]
    text = (
        f"the flow contradicts the images in {len(against)} of {len(known)} pairs"
    )
    if len(against) <= MAX_CONTRADICTED * len(known):
        return False, text
    return True, f"{text}; frame {against.index[0]}: {against.iloc[0]}"


def _valid_depth(table: pd.DataFrame) -> tuple[bool | None, str]:
    shares = table["valid"].dropna().astype(float)
    if shares.empty:
        return None, "no frame has a depth map"
    empty = shares[shares < EMPTY_DEPTH]
    text = f"{100 * shares.median():.2g} % of the pixels in the median frame"
    if shares.median() < MIN_VALID_DEPTH:
        cause = "distance, sunlight, glass, or a projection that fills one pixel in several"
        return True, f"{text}: too few to be sure of a motion; look for {cause}"
    if len(empty):
        remedy = "see that the sensor delivers; the next motion spans such a frame"
        return (
            True,
            f"{text}, none in {len(empty)} of {len(shares)} (frame {empty.index[0]}): {remedy}",
        )
    return False, text


def _texture_and_focus(table: pd.DataFrame) -> tuple[bool | None, str]:
    known = table[["texture", "focus"]].dropna().astype(float)
    if known.empty:
        return None, "no frame has an image"
    texture, focus = known.median()
    text = f"{100 * texture:.2g} % of the pixels have a gradient; sharpness {focus:.2g}"
    if texture < MIN_TEXTURE:
        return (
            True,
            f"{text}: hardly any texture; more light, a longer exposure, another view",
        )
    if focus < MIN_FOCUS:
        return (
            True,
            f"{text}: blurred or enlarged; check focus, exposure, compression, resizing",
        )
    blurred = known[known["focus"] < MIN_FOCUS]
    some = f"; {len(blurred)} of {len(known)} are blurred, as frame {{}}: a shorter exposure"
    return False, text + (some.format(blurred.index[0]) if len(blurred) else "")


def _registration(table: pd.DataFrame) -> tuple[bool | None, str]:
    maps = table["edges"].dropna()
    if maps.empty:
        return None, "no frame has both an image and depth"
    total = np.mean(np.stack(maps.to_list()), axis=0)
    m, n = (size // 2 for size in total.shape)
    y, x = np.unravel_index(int(total.argmax()), total.shape)
    right = int(x) - n
    down = int(y) - m
    share, certain, better = REGISTRATION
    if total.max() < certain * total.std() or abs(right) == n or abs(down) == m:
        causes = "too few or too soft, or depth is not registered to colour"
        return (
            None,
            f"no shift brings the edges of depth onto those of the images: {causes}",
        )
    text = f"edges of depth lie {right} px right and {down} px down of those in the images"
    limit = max(2.0, share * max(m, n) / REACH)
    near = round(limit)
    here = total[m - near : m + near + 1, n - near : n + near + 1].max()
    if np.hypot(right, down) <= limit or total.max() < better * here:
        return False, text
    remedy = "register depth to colour (RealSense: rs.align; ROS: depth_image_proc/register)"
    return True, f"{text}: {remedy}, or crop and scale both alike"


def _stamps(stamps: np.ndarray) -> tuple[bool | None, str]:
    intervals = np.diff(stamps)
    if len(intervals) < 2:
        return None, "fewer than three frames"
    usual = float(np.median(intervals))
    factor, share = LATE
    late = intervals > factor * usual
    text = f"{1 / usual:.3g} frames a second; {late.sum()} of {len(late)} intervals are gaps"
    if not late.any():
        return False, text
    k = int(np.argmax(intervals))
    text += f", the longest {intervals[k]:.3g} s after frame {k}"
    if late.mean() <= share:
        return False, text
    return (
        True,
        f"{text}: frames were dropped; record slower, smaller, or to a faster disk",
    )


NOT_CHECKED = (
    "focal lengths, distortion, and the clocks of colour and depth: nothing in a recording without "
    "poses.txt tells them apart from the scene; calibrate, or measure a known length"
)
QUESTIONS = {
    "depth units": _units,
    "depth from frame to frame": _depth_steps,
    "valid depth": _valid_depth,
    "depth beside images": _registration,
    "texture and focus": _texture_and_focus,
    "images against flow": _images_against_flow,
}
