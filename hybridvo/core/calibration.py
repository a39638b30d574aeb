"""Numbers of what every room reads that decide: value, unit, data, how to find them again."""

MIN_PROBABILITY = 0.9
"""Probability of being right below which a motion is degraded: of 220 pairs of kitchen, box and
semi-real 8 of 23 wrong ones lie above it, 16 of 197 right ones below (``tools/calibrate.py``)."""
PLAUSIBLE_DEPTH_M = (0.1, 200.0)
"""Medians of a depth map in metres, without the sky; outside of them it has another
unit. By hand."""
EVERYDAY_DEPTH_M = (0.3, 8.0)
"""Where the median of an indoor depth map usually lies, m: of several units the one that
leads there is named. By hand."""
SKY_DEPTH_M = 1000.0
"""Depth beyond which a pixel shows the sky, m: renderers state such depths, no sensor
reaches them."""
MIN_NEARER_THAN_SKY = 0.1
"""Ratio of nearer pixels to those beyond, below which the depths are not in metres. By hand."""
MAX_BEHIND_CAMERA = 0.1
"""Fraction of the points of a frame that may end behind the camera before its mean flow under a
motion counts as infinite. By hand."""
IDENTITY_STD = (1.0, 0.3)
"""Standard deviations of the translation, m, and of the rotation, rad, of a step of a
hand-held camera of which nothing is known: at most so large."""

# Refinement on flow and depth
#
# Where no command is named: chosen by hand; ``make golden`` shows what a change does.

KERNEL_CUTOFF = 3.0
"""c of the Geman-McClure kernel, standard deviations; a pixel farther away is no inlier."""

# What is believed static
#
# All by hand, on 18 clips and tripod recordings; on recordings kept back since, flow was needed in
# 42 instead of 145 of 180 frames with people before a standing camera, at the same error.

KNOWN_LOG_ODDS = 0.5
"""Log odds beyond which a point is believed static or moving. Unfitted."""
MIN_STATIC = 0.12
"""Fraction of the points that must be believed static to do without flow. Unfitted."""
MIN_CERTAINTY = 2.0
"""Log odds of the whole belief that it takes. Unfitted."""
MIN_MOVING = 0.03
"""Fraction of the points that must move before a belief changes the pixels of a fit: below, it is a
majority vote of the past. Unfitted."""
BELIEF_MIDDLE = 0.75
"""Log odds to be static at which a point has half its weight. Unfitted."""
BELIEF_SLOPE = 2.0
"""How fast that weight rises, 1 / nat. Unfitted."""
TEXTURE_MIDDLE = 1.0
"""Log odds to be static at which half of a point's texture counts. Unfitted."""
CERTAINTY_BONUS = 2.0
"""Nats that are added to the certainty of a belief where a motion of what it holds static is
judged. By hand: films say 10 (``tools/calibrate.py --direct``), but in none of them is a whole
belief wrong from the start."""

# An upright world

MIN_HORIZONTAL = 0.26
"""Length of the horizontal part of the first camera's optical axis, as a fraction, below which it
gives the upright world no heading: the sine of 15 degrees, where an error of the vertical turns
the heading four times as far. Unfitted."""

# Samples of an inertial sensor

IMU_KEPT_S = 60.0
"""Time over which samples are kept that no frame has taken yet, s: after a minute without a frame
that can be used, the path is lost anyway. Unfitted."""
MAX_LATE_SAMPLE_S = 1.0
"""By how much a sample may be older than one that came before it, s. An older one shows that the
clock jumped back, as where a bag is played again. Unfitted."""
