"""``hybridvo doctor --sequence``: what the frames of a sequence say of its own calibration.

Wrong intrinsics, colour and depth that do not belong together and depth in other units spoil every
estimate a little, and no single pair shows them. Over a sequence they keep their sign. Each finding
has a value with its standard error from the spread between the pairs, and is left open where the
sequence does not show it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from hybridvo.depth_steps import depth_ratio
from hybridvo.diagnosis_findings import Evidence, findings
from hybridvo.errors import FormatError, InputError
from hybridvo.flow import FlowProvider, dis_flow
from hybridvo.geometry import invert
from hybridvo.pipeline import refine
from hybridvo.refinement.photometric import PhotometricReport, refine_photometric
from hybridvo.refinement.registration import depth_costs
from hybridvo.refinement.self_calibration import calibration_equations
from hybridvo.types import Frame, FramePair, RelativePose

__all__ = ["diagnose", "diagnosis_text"]

PAIRS = 40
LONG_M = 0.01
"""Translation of a pair, metres, from which on its length is compared with the truth."""


class _Sequence(Protocol):
    """The part of an open sequence that is needed."""

    name: str
    poses: np.ndarray | None

    def __len__(self) -> int: ...

    def frame(self, index: int) -> Frame:
        """Frame ``index``."""


def diagnose(
    sequence: _Sequence, *, pairs: int = PAIRS, flow: FlowProvider | None = None
) -> dict[str, Any]:
    """Look for systematic disagreement in a sequence.

    Args:
        sequence: an open one, see :func:`hybridvo.data.sequence.open_sequence`. Its true poses,
            where it has them, are used for nothing but the scale of depth.
        pairs: most pairs of neighbouring frames looked at, spread evenly.
        flow: provider of the flow; default: OpenCV DIS.

    Returns:
        JSON-ready: ``sequence``, ``frames``, ``pairs`` (looked at), ``used`` (whose images
        sharpened the motion), ``unreadable`` (messages), ``findings`` and ``ok`` (nothing differs).
        A finding has ``name``, ``state`` (``agrees``, ``differs`` or ``not_observable``), ``value``
        and ``standard_error`` (numbers, lists or None), ``unit`` and ``message``.

    Raises:
        InputError: fewer than two frames, or ``pairs`` below 1.

    Example:
        >>> from hybridvo.synthetic.render import SyntheticSequence, make_scene
        >>> scene = make_scene("static", 0, height=48, width=64, frames=2)
        >>> diagnose(SyntheticSequence(scene))["findings"][0]["state"]
        'not_observable'
    """
    if pairs < 1:
        raise InputError(f"diagnose: expected at least one pair, got {pairs!r}.")
    if len(sequence) < 2:
        raise InputError(
            f"{sequence.name}: expected at least two frames to compare, got {len(sequence)}."
        )
    evidence = _gather(sequence, pairs, flow or dis_flow())
    found = findings(evidence)
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        "pairs": evidence.looked_at,
        "used": evidence.reasons.count(""),
        "unreadable": evidence.unreadable,
        "findings": found,
        "ok": all(finding["state"] != "differs" for finding in found),
    }


def diagnosis_text(report: Mapping[str, Any]) -> str:
    """The report for people."""
    signs = {"agrees": "ok     ", "differs": "DIFFERS", "not_observable": "-      "}
    lines = [
        f"{report['sequence']}: {report['frames']} frames, {report['pairs']} pairs looked at, "
        f"{report['used']} of them with images that confirm the motion"
    ]
    for finding in report["findings"]:
        lines.append(f"{signs[finding['state']]} {finding['name']}: {finding['message']}")
    lines += [f"unreadable: {message}" for message in report["unreadable"][:5]]
    if not report["ok"]:
        lines.append("something differs: see above")
    elif all(finding["state"] == "not_observable" for finding in report["findings"]):
        lines.append("nothing could be compared: see above")
    else:
        unread = ", in what could be read" if report["unreadable"] else ""
        lines.append(f"nothing differs{unread}")
    return "\n".join(lines) + "\n"


def _gather(sequence: _Sequence, pairs: int, flow: FlowProvider) -> Evidence:
    evidence = Evidence()
    last = len(sequence) - 1
    chosen = np.unique(np.linspace(0, last - 1, min(pairs, last)).round().astype(int))
    kept: tuple[int, Frame] | None = None
    for index in chosen.tolist():
        try:
            prev = kept[1] if kept and kept[0] == index else sequence.frame(index)
            curr = sequence.frame(index + 1)
        except (InputError, FormatError, OSError) as error:
            evidence.unreadable.append(str(error))
            kept = None
            continue
        kept = index + 1, curr
        _look_at(evidence, sequence, index, prev, curr, flow)
    return evidence


def _look_at(
    evidence: Evidence, sequence: _Sequence, index: int, prev: Frame, curr: Frame, flow: Any
) -> None:
    """Add what one pair says."""
    evidence.looked_at += 1
    if prev.depth is not None:
        valid = prev.depth[np.isfinite(prev.depth) & (prev.depth > 0)]
        if valid.size:
            evidence.depths.append(float(np.median(valid)))
    if prev.rgb is None or curr.rgb is None or prev.depth is None:
        evidence.reasons.append("no_images")
        return
    if curr.camera.shape != prev.camera.shape:
        evidence.reasons.append("no_estimate")
        return
    found = flow(prev, curr)
    pair = FramePair(prev, curr, found.flow, found.variance, found.valid, found.source)
    motion = refine_photometric(pair, refine(pair))
    if motion.usable:
        ratio = depth_ratio(prev, curr, found.flow, motion.T_curr_prev)
        if ratio is not None:
            evidence.depth_ratios.append((index, ratio))
    report = motion.photometric
    assert isinstance(report, PhotometricReport)
    evidence.reasons.append(report.reason)
    if report.pixels:
        evidence.gains.append((index, report.gain))
    _compare_scale(evidence, sequence, index, motion)
    if not report.taken:
        return
    evidence.cameras.append(prev.camera)
    equations = calibration_equations(pair, motion)
    if equations is not None:
        evidence.equations.append(equations)
    offset, lags, size = depth_costs(pair, motion)
    if offset.pixels:
        evidence.offsets.append(offset)
    if size > 0:
        evidence.lags.append(lags)
        evidence.motion_px.append(size)


def _compare_scale(
    evidence: Evidence, sequence: _Sequence, index: int, motion: RelativePose
) -> None:
    """Length of the motion over that of the true poses, where both have one."""
    if sequence.poses is None or not motion.usable or not motion.translation_direction_valid:
        return
    true = invert(sequence.poses[index + 1]) @ sequence.poses[index]
    length = float(np.linalg.norm(true[:3, 3]))
    if np.isfinite(length) and length > LONG_M:
        # along the true one: the noise of a length is always positive
        evidence.scales.append(float(motion.T_curr_prev[:3, 3] @ true[:3, 3]) / length**2)
