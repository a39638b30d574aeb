"""Numbers of PWVO and its inputs that decide: value, unit, data, how to find them again."""

# Where no data and no command are named, a number of this section was chosen by hand;
# ``make golden`` shows the effect of a change.

MAX_SCORE_DEFICIT = 3.0
"""Largest difference from the best score at which a candidate is fitted again, nats: it is then a
twentieth as probable."""

# Networks
# Where no data and no command are named, a number of this section was chosen by hand;
# ``make golden`` shows the effect of a change.

SHARPNESS = 4.0
"""Weights of pixels in a fit are exp(-4 s), s the log scale of their uncertainty. Errors
of pixels on one moving object are alike, and an object on two thirds of the image must
not outweigh the rest. On development pairs 8 gave the same answers as 4."""
SEED_SHARPNESS = 1.0
"""Weights of pixels in a refinement are exp(-s), over the largest: for PWVO the probability of a
pixel to be static. ``tools/benchmark.py pwvo_parts`` shows the effect of a change."""
MIN_SEED_WEIGHT = 1e-2
"""Smallest weight of a pixel in the seed of a refinement, over the largest one: pixels
of large uncertainty decide only where there are no others."""
MIN_FIT_SCALE = 1e-4
"""Smallest scale of the kernel of a fit weighted by uncertainty, over the focal length:
0.1 px at 1000 px."""
MIN_NETWORK_PIXELS = 64
"""Fewest pixels of a network's input with flow and depth."""
INVALID_LOG_SCALE = 3.0
"""Smallest log scale of a pixel without flow or depth: 20 degrees or 20 m."""
MAX_NETWORK_SCALE_DEG = 2.0
"""Uncertainty of a rotation above which the answer of a network alone is degraded,
degrees: more than most cameras turn between two frames."""
UNSTATED_ROTATION_DEG = 1.0
"""Uncertainty of a rotation by a network that states none, degrees: a usual motion."""
UNSTATED_TRANSLATION_M = 0.3
"""Uncertainty of a translation by a network that states none, m."""
