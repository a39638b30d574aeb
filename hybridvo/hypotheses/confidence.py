"""How likely an answer is right: the judge's word, corrected by what the pixels say."""

from __future__ import annotations

import math

__all__ = [
    "LEAST_NOISE_PX",
    "MAX_SHARE",
    "RECALIBRATION",
    "REFERENCE_WIDTH",
    "probability_right",
]

RECALIBRATION = {"logit": 1.11, "log_noise_px": 0.43, "share": 0.58, "constant": 1.67}
"""Logistic map to the probability that the answer errs by less than a pixel: of the judge's own
logit, the log of the flow's noise (px at a width of 1024, at least :data:`LEAST_NOISE_PX`) and the
share of the picture that follows the motion. The judge says too little of itself where every pixel
has independent noise, and too much where the flow itself is bent. Fitted on development seeds of
heavy and light scenes and of cells; ``tools/evaluate_hybrid.py`` fits it again to other weights."""
LEAST_NOISE_PX = 0.02
MAX_SHARE = 0.45
"""A larger share counts as this. The map was fitted where most of the picture moves, and there a
large share is a mover's; that most of a usual picture follows one motion is no reason for doubt."""
REFERENCE_WIDTH = 1024
"""px; the judge's "right" is an error of at most one pixel of a picture as wide as this."""


def probability_right(trust: float, noise_px: float, share: float) -> float:
    """Probability that an answer errs by less than a pixel, by :data:`RECALIBRATION`.

    Args:
        trust: probability that the judge states.
        noise_px: standard deviation of the flow about the motion, px at a width of 1024.
        share: of the usable pixels that follow the motion.
    """
    p = min(max(trust, 1e-4), 1 - 1e-4)
    terms = {
        "logit": math.log(p / (1 - p)),
        "log_noise_px": math.log(max(noise_px, LEAST_NOISE_PX)),
        "share": min(share, MAX_SHARE),
        "constant": 1.0,
    }
    return 1 / (1 + math.exp(-sum(RECALIBRATION[name] * terms[name] for name in terms)))
