"""``hybridvo doctor``: what is installed, which methods can run, and what is wrong with data."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable
from importlib.util import find_spec
from math import log
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from hybridvo.api import estimate
from hybridvo.compiled.ahead_of_time import compile_ahead
from hybridvo.compiled.shipped_kernels import kernels_in_use
from hybridvo.core import laboratory
from hybridvo.core.depth_units import depth_unit_fix, typical_depth
from hybridvo.core.errors import InputError, printable
from hybridvo.core.files import versions
from hybridvo.core.types import Camera, Frame, FramePair
from hybridvo.flow.providers import contradiction, dis_flow, file_flow, with_flow
from hybridvo.io.cameras.base import LiveCamera
from hybridvo.io.cameras.choose import choose_camera
from hybridvo.io.cameras.folder import FolderCamera
from hybridvo.io.cameras.settings import LIVE_RATE_HZ, read_preset
from hybridvo.io.data.sequence import Sequence
from hybridvo.io.data.truth import true_motion
from hybridvo.io.example import example_frames
from hybridvo.io.resolution import resolution_question
from hybridvo.odometry import Odometry
from hybridvo.run.calibration import (
    EMPTY_DEPTH,
    MAX_SCALE_ERROR,
    MIN_FOCUS,
    MIN_TEXTURE,
    MIN_VALID_DEPTH,
)
from hybridvo.run.commands.arguments import DOCTOR_SECONDS
from hybridvo.run.commands.diagnosis.answer import Diagnosis
from hybridvo.run.commands.diagnosis.capture import Captured, capture
from hybridvo.run.commands.diagnosis.clocks import one_clock
from hybridvo.run.commands.diagnosis.depth_lag import depth_lag
from hybridvo.run.commands.diagnosis.extras import missing_extras
from hybridvo.run.commands.diagnosis.inspection import (
    edge_agreement,
    sharpness,
    valid_fraction,
)
from hybridvo.run.commands.diagnosis.rate import camera_rate, gaps, jitter
from hybridvo.run.commands.diagnosis.registration import (
    registration,
    zoomed_registration,
)
from hybridvo.run.commands.diagnosis.rolling_shutter import rolling_shutter
from hybridvo.run.commands.ready_methods import methods_to_run
from hybridvo.solver.calibration import DOUBTFUL_SPREAD
from hybridvo.solver.covariance import direction_is_known
from hybridvo.solver.depths import compare_depths
from hybridvo.tracking.calibration import MAX_FOCAL_ERROR
from hybridvo.tracking.camera_drift import MIN_CAMERA_STEPS, FocalDrift, bends_of
from hybridvo.tracking.tracker import warm_up

# pairs with a true motion from which the scale of depth is judged
MIN_SCALE_PAIRS = 6
# m, of a true motion that shows the scale: motion capture errs by as much
MIN_PATH_LENGTH_M = 0.01
# fraction of the pairs whose flow may contradict their images without a report
MAX_CONTRADICTED = 0.2

Rows = dict[int, dict[str, Any]]
"""What is measured of pairs, by the index of their first frame."""
STATES = {None: "cannot_tell", True: "differs", False: "agrees"}
"""How an answer is called in the report."""
NOT_CHECKED = (
    "distortion, and a focal length that is off by a few percent: nothing in a recording "
    "without poses.txt separates them from the scene; calibrate, or measure a known length"
)
COMPILED_METHODS = ("hybrid", "hybrid-flow", "classical")
"""Methods that together use all kernels of the pairwise estimates."""
TRACKED_METHODS = ("hybrid", "classical")
"""One that remembers what was static, and one that always computes flow."""
CLOCK_PAIRS = 3
"""Pairs in a row that are looked at for the clocks, for each of ``--pairs``."""


def compile_kernels() -> None:
    """Compile all that ``run`` and ``demo`` need, where it is not compiled yet."""
    compile_ahead()
    if kernels := laboratory.find(laboratory.FUNCTIONS, "kernels"):
        compile_ahead(path=kernels)
    call_kernels()


def call_kernels() -> None:
    """Call all that ``run`` and ``demo`` need; numba compiles what is in no cache."""
    for method in COMPILED_METHODS:
        warm_up(method)
    # what a tracker remembers, and flow from images
    for method in TRACKED_METHODS:
        tracker = Odometry(method=method)
        for frame in example_frames():
            tracker.track(frame)


def installation() -> dict[str, Any]:
    """Return what is installed here and which methods can run, JSON-ready.

    The kernels are compiled, so that no later run has to do it.
    """
    compile_kernels()
    ready, missing = methods_to_run(("all",))
    return {
        "platform": platform.platform(),
        "packages": versions(),
        "kernels": kernels_in_use(),
        "cuda": _cuda_devices(),
        "methods": {**dict.fromkeys(ready, ""), **missing},
        "extras": missing_extras(),
    }


def _cuda_devices() -> list[str]:
    """Return the names of the CUDA devices that torch can use."""
    if find_spec("torch") is None:
        return []
    import torch

    count = torch.cuda.device_count()
    return [torch.cuda.get_device_name(k) for k in range(count)]


def diagnose(sequence: Any, pairs: int = 40) -> dict[str, Any]:
    """Look for disagreement between depth, poses, images and flow that runs through a sequence.

    Args:
        sequence: The :class:`~hybridvo.io.data.sequence.Sequence`, or what a camera gave
            (:class:`~hybridvo.run.commands.diagnosis.capture.Captured`).
        pairs: How many pairs of neighbours are looked at, at most. They are evenly distributed.

    Returns:
        A report, JSON-ready: ``findings`` with a state and a message each, and ``ok``.

    Raises:
        InputError: The sequence has fewer than two frames, or ``pairs`` is not positive.
    """
    last = len(sequence) - 2
    if pairs < 1 or last < 0:
        got = f"{len(sequence)} frames and --pairs {pairs}"
        raise InputError(
            f"{sequence.name}: expected two frames and one pair, got {got}."
        )
    places = np.linspace(0, last, min(pairs, last + 1))
    rows: Rows = {}
    camera = None
    unreadable = []
    for index in np.unique(places.round().astype(int)).tolist():
        try:
            prev = sequence.frame(index)
            curr = sequence.frame(index + 1)
            camera = camera or prev.camera
            rows[index] = _measure(sequence, prev, curr)
        except (InputError, OSError) as error:
            unreadable.append(str(error))
    answers = {name: question(rows) for name, question in QUESTIONS.items()}
    clocks = one_clock(sequence, CLOCK_PAIRS * pairs)
    answers["clocks of colour and depth"] = clocks
    registered = _registration(rows, sequence)
    if clocks.differs and registered.differs:
        remedy = "put the clocks right first, and look again"
        found = registered.message.partition(":")[0]
        registered = Diagnosis(None, f"{found}: {remedy}")
    answers["depth beside images"] = registered
    answers["lag of depth"] = depth_lag(sequence, CLOCK_PAIRS * pairs)
    answers["rolling shutter"] = rolling_shutter(sequence, CLOCK_PAIRS * pairs)
    answers["intrinsics"] = _intrinsics(camera)
    answers["time stamps"] = gaps(sequence.timestamps)
    answers["jitter of the stamps"] = jitter(sequence.timestamps)
    if isinstance(sequence, Captured):
        answers["rate of the camera"] = camera_rate(sequence)
        unreadable += sequence.refused
    findings = [
        {"name": name, "state": STATES[answer.differs], "message": answer.message}
        for name, answer in answers.items()
    ]
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        "pairs": len(rows),
        "unreadable": list(dict.fromkeys(unreadable)),
        "warnings": [
            text
            for text in sequence.warnings
            if not text.endswith(answers["intrinsics"].message)
        ],
        "findings": findings,
        "not_checked": NOT_CHECKED,
        "ok": not unreadable and not any(a.differs for a in answers.values()),
    }


def diagnose_camera(
    name: str | None,
    preset: str | Path | None = None,
    seconds: float = DOCTOR_SECONDS,
    pairs: int = 40,
    *,
    readout_ms: float | None = None,
    depth_lag_ms: float | None = None,
    trust: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Look at what a live camera gives, as :func:`diagnose` looks at a recording.

    Args:
        name: The camera, see :func:`hybridvo.io.cameras.choose.choose_camera`.
        preset: Its settings.
        seconds: How long its frames are kept.
        pairs: How many pairs of neighbours are looked at, at most.
        readout_ms: Time that its rolling shutter takes.
        depth_lag_ms: How much later than the image its depth is measured.
        trust: Whether a recording is read without limits, as in ``open_sequence``.
        quiet: Whether nothing is shown.

    Returns:
        A report, JSON-ready.

    Raises:
        InputError: There is no such camera, or it gives no frames.
    """
    if not seconds > 0:
        raise InputError(f"--seconds {seconds}: expected more than 0.")
    camera = choose_camera(
        name,
        preset,
        readout_ms=readout_ms,
        trust=trust,
        depth_lag_ms=depth_lag_ms,
    )
    if not quiet:
        advice = "turn it to and fro, so that its clocks can be compared"
        text = f"{camera.name}: looking for {seconds:g} s; {advice}"
        print(printable(text), file=sys.stderr)
    captured = capture(camera, seconds, _asked_fps(camera, preset))
    return diagnose(captured, pairs)


def _asked_fps(camera: LiveCamera, preset: str | Path | None) -> float | None:
    """Return how many frames a second a camera was requested; None for a recording."""
    if isinstance(camera, FolderCamera):
        return None
    return read_preset(preset).fps if preset is not None else LIVE_RATE_HZ


# -- what is measured of a pair ----------------------------------------------------------


def _measure(sequence: Sequence, prev: Frame, curr: Frame) -> dict[str, Any]:
    """Measure what the frames of a pair allow."""
    row: dict[str, Any] = {}
    if prev.depth is not None:
        row["depth"] = typical_depth(prev.depth)
        row["valid"] = valid_fraction(prev.depth)
    if prev.rgb is not None:
        row["texture"], row["focus"] = sharpness(prev.rgb)
    if prev.rgb is not None and prev.depth is not None:
        row["edges"] = edge_agreement(prev.rgb, prev.depth)
    if prev.rgb is not None and curr.rgb is not None:
        row |= _measure_motion(sequence, FramePair(prev, curr, None))
    return row


def _measure_motion(sequence: Sequence, pair: FramePair) -> dict[str, Any]:
    """Measure what needs the two images of a pair, and the motion between them."""
    row: dict[str, Any] = {}
    if sequence.has_flow:
        from_file = with_flow(pair, file_flow(sequence, strict=False))
        if from_file.flow is not None:
            row["contradiction"] = contradiction(from_file) or ""
    by_dis = with_flow(pair, dis_flow())
    motion = estimate(by_dis, method="classical")
    if not motion.usable:
        return row
    T_gt = true_motion(sequence, pair.prev.index, pair.curr.index)
    if T_gt is not None and direction_is_known(
        motion.T_curr_prev, motion.covariance
    ):
        true_length = float(np.linalg.norm(T_gt[:3, 3]))
        if true_length > MIN_PATH_LENGTH_M:
            # The part along the true motion: noise makes every length larger.
            along = float(motion.T_curr_prev[:3, 3] @ T_gt[:3, 3])
            row["length"] = along / true_length**2
    depths = compare_depths(by_dis, motion.T_curr_prev, motion.weights)
    if depths is not None:
        row["depth_ratio"] = depths.ratio
    row["bends"] = bends_of(by_dis.prev, by_dis.curr, motion) if motion.ok else None
    return row


# -- questions to the measurements of all pairs ------------------------------------------


def _percent(fraction: float) -> str:
    """Return a fraction as a percentage with two digits."""
    percent = 100 * fraction
    return f"{percent:.0f} %" if percent >= 10 else f"{percent:.2g} %"


def _known(rows: Rows, name: str) -> dict[int, Any]:
    """Return a measurement of all pairs that have it, by the index of their first frame."""
    found = {frame: row.get(name) for frame, row in rows.items()}
    return {frame: value for frame, value in found.items() if value is not None}


def _units(rows: Rows) -> Diagnosis:
    """Answer whether depth is in metres."""
    depths = _known(rows, "depth")
    scales = _known(rows, "length")
    if not depths:
        return Diagnosis(None, "no frame has valid depth")
    depth = median(depths.values())
    text = f"median depth {depth:.3g} m"
    fix = depth_unit_fix(depth)
    if len(scales) < MIN_SCALE_PAIRS:
        if fix:
            return Diagnosis(
                True, f"{text}, which cannot be metres; probable remedy: {fix}"
            )
        # Depths and translations times s project to the same pixels: only poses show the scale.
        return Diagnosis(
            None,
            f"{text}, as a camera sees, but only poses can show whether it is exact; "
            f"true motions (poses.txt) beyond 1 cm: {len(scales)} pairs, "
            f"{MIN_SCALE_PAIRS} needed",
        )
    low, scale, high = np.percentile([*scales.values()], [25, 50, 75]).tolist()
    text += f"; motions are {scale:.4g} times as long as the poses on file state"
    if abs(scale - 1) <= MAX_SCALE_ERROR or low < 1 < high:
        return Diagnosis(False, text)
    if not fix:
        fix = (
            f"divide by {scale:.4g}"
            if scale > 1
            else f"multiply by {1 / scale:.4g}"
        )
    return Diagnosis(True, f"{text}: depth: {fix}")


def _depth_steps(rows: Rows) -> Diagnosis:
    """Answer whether depth keeps its scale from frame to frame."""
    ratios = _known(rows, "depth_ratio")
    if not ratios:
        return Diagnosis(None, "no pair has a motion and depth in both frames")
    change = {frame: abs(log(max(x, 1e-30))) for frame, x in ratios.items()}
    steps = sum(size > DOUBTFUL_SPREAD for size in change.values())
    k = max(change, key=change.__getitem__)
    text = (
        f"depth changes its scale in {steps} of {len(ratios)} pairs, most from frame {k} "
        f"to the next (times {ratios[k]:.3g})"
    )
    if not steps:
        return Diagnosis(False, text)
    cause = "files of several units, or a scale of its own in every frame"
    return Diagnosis(True, f"{text}: {cause}")


def _images_against_flow(rows: Rows) -> Diagnosis:
    """Answer whether the flow on file moves the images onto each other."""
    known = _known(rows, "contradiction")
    if not known:
        return Diagnosis(None, "no pair has images and a flow on file")
    contradicted = [(frame, text) for frame, text in known.items() if text]
    text = (
        f"the flow contradicts the images in {len(contradicted)} of "
        f"{len(known)} pairs"
    )
    if len(contradicted) <= MAX_CONTRADICTED * len(known):
        return Diagnosis(False, text)
    frame, reason = contradicted[0]
    return Diagnosis(True, f"{text}; frame {frame}: {reason}")


def _valid_depth(rows: Rows) -> Diagnosis:
    """Answer whether there is enough depth in the frames."""
    fractions = _known(rows, "valid")
    if not fractions:
        return Diagnosis(None, "no frame has a depth map")
    empty = [frame for frame, x in fractions.items() if x < EMPTY_DEPTH]
    typical = median(fractions.values())
    text = f"{_percent(typical)} of the pixels in the median frame"
    if typical < MIN_VALID_DEPTH:
        cause = "distance, sunlight, glass, or a projection that fills one pixel in several"
        return Diagnosis(
            True,
            f"{text}: too few to be sure of a motion; look for {cause}",
        )
    if empty:
        count = f"{len(empty)} of {len(fractions)} (frame {empty[0]})"
        remedy = "see that the sensor delivers; the next motion spans such a frame"
        return Diagnosis(True, f"{text}, none in {count}: {remedy}")
    return Diagnosis(False, text)


def _texture_and_focus(rows: Rows) -> Diagnosis:
    """Answer whether the images have texture, and are sharp."""
    sharp = _known(rows, "focus")
    if not sharp:
        return Diagnosis(None, "no frame has an image")
    texture = median(_known(rows, "texture").values())
    focus = median(sharp.values())
    text = (
        f"{_percent(texture)} of the pixels have a gradient; sharpness {focus:.2g}"
    )
    if texture < MIN_TEXTURE:
        remedy = "more light, a longer exposure, another view"
        return Diagnosis(True, f"{text}: hardly any texture; {remedy}")
    if focus < MIN_FOCUS:
        remedy = "check focus, exposure, compression, resizing"
        return Diagnosis(True, f"{text}: blurred or enlarged; {remedy}")
    blurred = [frame for frame, x in sharp.items() if x < MIN_FOCUS]
    if blurred:
        text += (
            f"; {len(blurred)} of {len(sharp)} are blurred, "
            f"as frame {blurred[0]}: a shorter exposure"
        )
    return Diagnosis(False, text)


def _intrinsics(camera: Camera | None) -> Diagnosis:
    """Answer whether the intrinsics are those of the images."""
    if camera is None:
        return Diagnosis(None, "no frame can be read")
    if question := resolution_question(camera):
        return Diagnosis(None, question)
    place = f"({camera.cx:.4g}, {camera.cy:.4g})"
    size = f"{camera.width}x{camera.height} pixels"
    return Diagnosis(
        False, f"the principal point {place} is that of images of {size}"
    )


def _focal_length(rows: Rows) -> Diagnosis:
    """Answer whether the focal length fits what turns of the camera show."""
    shown = FocalDrift()
    for bends in _known(rows, "bends").values():
        shown = shown.with_bend(bends.focal)
    if shown.is_off:
        return Diagnosis(True, shown.message)
    if not shown.is_known:
        return Diagnosis(
            None,
            f"{shown.steps} motions turn the view; {MIN_CAMERA_STEPS} are needed: turn the "
            f"camera to and fro, or pass more --pairs",
        )
    text = (
        f"{shown.steps} motions fit {shown.factor:.2f} +- {shown.factor * shown.std:.2f} "
        f"times the given one"
    )
    # farther away than distortion and a rolling shutter explain, but not surely
    is_doubtful = abs(shown.error) > MAX_FOCAL_ERROR
    return Diagnosis(None if is_doubtful else False, text)


def _registration(rows: Rows, sequence: Sequence) -> Diagnosis:
    """Answer whether the edges of depth lie on those of the images, shifted or enlarged."""
    answer = registration([*_known(rows, "edges").values()])
    if answer.differs is not None:
        return answer
    return zoomed_registration(sequence) or answer


QUESTIONS: dict[str, Callable[[Rows], Diagnosis]] = {
    "depth units": _units,
    "depth from frame to frame": _depth_steps,
    "valid depth": _valid_depth,
    "texture and focus": _texture_and_focus,
    "images against flow": _images_against_flow,
    "focal length": _focal_length,
}
"""The questions to the measurements, by the name of their finding."""
