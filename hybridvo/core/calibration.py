"""Numbers of what every room reads that decide: value, unit, data, how to find them again.

Where a number names neither data nor a command, it was chosen by hand. What a third and three times
of it do on eleven makers stands in docs/results/numbers.json (``tools/calibrate.py --numbers
NAME``: what is chosen for a maker is chosen on all others), and which golden case notices a third
of it in docs/golden_noticed.json.
"""

MIN_PROBABILITY = 0.9
"""Probability of being right below which a motion is degraded: of 220 pairs of kitchen, box and
semi-real 8 of 23 wrong ones lie above it, 16 of 197 right ones below (``tools/calibrate.py``)."""
KERNEL_CUTOFF = 3.0
"""c of the Geman-McClure kernel, standard deviations; a pixel farther away is no inlier.
``tools/golden.py --quick`` shows the effect of a change."""

# What is believed static
#
# By hand, on 18 clips and tripod recordings (``tools/benchmark.py memory``); on recordings kept
# back since, flow was needed in 42 instead of 145 of 180 frames with people before a standing
# camera, at the same error.

KNOWN_LOG_ODDS = 0.5
"""Log odds beyond which a point is believed static or moving."""
MIN_STATIC = 0.12
"""Fraction of the points that must be believed static to do without flow."""
MIN_CERTAINTY = 2.0
"""Log odds of the whole belief that it takes."""
MIN_MOVING = 0.03
"""Fraction of the points that must move before a belief changes the pixels of a fit: below, it is a
majority vote of the past."""
BELIEF_MIDDLE = 0.75
"""Log odds to be static at which a point has half its weight."""
BELIEF_SLOPE = 2.0
"""How fast that weight rises, 1 / nat."""
TEXTURE_MIDDLE = 1.0
"""Log odds to be static at which half of a point's texture counts."""
