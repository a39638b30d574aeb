"""Whether image and depth of a frame are of one time."""

from __future__ import annotations

from typing import Any

from hybridvo.run.commands.diagnosis.answer import Diagnosis
from hybridvo.run.commands.diagnosis.clocks import middle_frames
from hybridvo.tracking.depth_lag import find_lag

# Standard deviation of the lag, ms, from which on it is not known: a D435 turned to and fro for
# three seconds shows it to 2 or 4 (``hybridvo doctor DIR``).
MAX_LAG_STD_MS = 4.0
# Lag, ms, that needs no remedy: a turn of 150 degrees a second moves the view by half a degree
# meanwhile.
MIN_LAG_MS = 3.0
# Standard deviations by which a lag must exceed that.
LAG_SIGMAS = 2.0

REMEDY = (
    "turn the camera to and fro before things of some structure, at 15 Hz or more"
)


def depth_lag(sequence: Any, pairs: int) -> Diagnosis:
    """Answer whether image and depth of a frame are of one time.

    Args:
        sequence: The :class:`~hybridvo.io.data.sequence.Sequence`, or what is used like one.
        pairs: How many pairs of neighbours in a row are tracked, at most.
    """
    lag = find_lag(middle_frames(sequence, pairs))
    if lag is None:
        return Diagnosis(None, f"too few turns of the camera show it: {REMEDY}")
    when = "after" if lag.ms > 0 else "before"
    text = (
        f"{lag.pairs} turns fit depth that is measured {abs(lag.ms):.0f} +- "
        f"{lag.std_ms:.0f} ms {when} the images"
    )
    if lag.std_ms > MAX_LAG_STD_MS:
        return Diagnosis(None, f"{text}, too uncertain: {REMEDY}")
    stated_ms = sequence.frame(0).camera.depth_lag_ms
    off_ms = abs(lag.ms - stated_ms) - MIN_LAG_MS
    if off_ms < LAG_SIGMAS * lag.std_ms:
        return Diagnosis(False, text)
    return Diagnosis(None, f"{text}: state --depth-lag-ms {lag.ms:.0f}")
