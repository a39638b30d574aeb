"""How many motions of a run are not ok, why, and what the user can do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from hybridvo.core.results import Reason, State
from hybridvo.run.commands.diagnosis.causes import CAUSES

USE = {
    State.DEGRADED: "use them with their covariance",
    State.FAILED: "do not use them, the pose is held",
}
"""How a user should treat motions of a state."""
ADVICE = {
    Reason.NONE: "no reason is stated",
    Reason.AMBIGUOUS_MOTION: (
        "another motion fits nearly as well; mask what moves (--mask). Where nothing does, look "
        "for blur, a rolling shutter, or depth of another moment (hybridvo doctor)"
    ),
    Reason.CONTRADICTED: (
        "images or depth maps lead elsewhere; check that flow, images and depth are of the same "
        "moment and in the right unit (hybridvo doctor)"
    ),
    Reason.REPEATED_FRAME: (
        "the camera handed out an old image or depth map; in the dark, give it more light, or "
        "record fewer frames a second"
    ),
    Reason.FALSE_DEPTH: (
        "the depth map is a bare plane, and the images show a scene; check the file, the network "
        "or the sensor that it comes from"
    ),
    Reason.HIDDEN_WORLD: (
        "something nearer hid what was seen to stand; the pose is held until it is seen again"
    ),
    Reason.LOW_INLIERS: (
        "few pixels follow one motion; look for blur, wrong flow or depth of another moment"
    ),
    Reason.DEGENERATE_GEOMETRY: (
        "the view leaves a direction open, as a bare wall does; show it more texture or depth"
    ),
    Reason.NO_VALID_DEPTH: (
        "the depth map is empty or nearly so, or differs in scale from the one before; see that "
        "the sensor delivers, and that all depth has one unit"
    ),
    Reason.DEPTH_UNIT: (
        "the values of depth cannot be metres; the messages above name the probable unit: state it "
        "with --depth-scale (units per metre)"
    ),
    Reason.NO_FLOW: (
        "no flow could be computed, or the given one does not fit the images; see that the images "
        "are there and have texture, that no frames between them were dropped, and, if the flow is "
        "yours, its sign, unit and frames"
    ),
    Reason.MISSING_FRAME: "the files cannot be read; the messages above name them",
    Reason.NOT_RIGID: "a moving object bends or falls apart; its mask holds, its motion does not",
    Reason.SOLVER_DIVERGED: "no motion fits; check depth, camera and flow (hybridvo doctor)",
}
"""What a reason means for a user, and what to do about it."""


def advice_on(outcomes: Iterable[tuple[str, str]]) -> list[str]:
    """State how many motions are degraded or failed, why, and what to do.

    Args:
        outcomes: State and reason of each motion, as in ``steps.csv``.

    Returns:
        A sentence for each state that is not ok and occurs.

    Example:
        >>> advice_on([("ok", ""), ("failed", "no_flow")])[0][:42]
        '1 of 2 motions failed (do not use them, th'
    """
    outcomes = list(outcomes)
    sentences = []
    for state, use in USE.items():
        reasons = Counter(
            reason for name, reason in outcomes if name == state.value
        )
        if not reasons:
            continue
        explanations = [
            f"{count} {reason or 'unknown'}: {ADVICE[Reason(reason)]}"
            for reason, count in reasons.most_common()
        ]
        count = f"{reasons.total()} of {len(outcomes)} motions"
        sentences.append(
            f"{count} {state.value} ({use}): {'; '.join(explanations)}."
        )
    return sentences


def likely_causes(causes: Iterable[str]) -> list[str]:
    """State what is unusual about the frames of motions that are not ok.

    Args:
        causes: Of each motion; empty where nothing is.

    Returns:
        One sentence with every cause, the most frequent first; none where there is nothing.

    Example:
        >>> likely_causes(["", "blur", "blur"])
        ['likely causes: 2 blur: the image is blurred: a shorter exposure, or the focus.']
    """
    counts = Counter(cause for cause in causes if cause)
    if not counts:
        return []
    explanations = [
        f"{count} {cause}: {CAUSES.get(cause, 'unknown')}"
        for cause, count in counts.most_common()
    ]
    return [f"likely causes: {'; '.join(explanations)}."]
